"""Nodes in FMUs, driven step by step as an importer does, and operations of FMI-LS-BUS."""

from __future__ import annotations

import ctypes
import hashlib
import struct
import subprocess
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from support import c_core

from maplines_can import Kind, MapError, Polyline, Slot
from maplines_can.generation.fmu import SentRoute, compilers, fmu_of, written
from maplines_can.generation.fmu.archive import sources_of
from maplines_can.values.route_lines import RouteLines
from maplines_can.wire import Frame
from maplines_can.wire.layout.message_layout import Layout

RX_DATA, TX_DATA, RX_CLOCK, TX_CLOCK = 1, 2, 3, 4
#: That of the package, which compiles each time.
library = compilers.library
#: Qualifiers of an interval in FMI.
NOT_YET_KNOWN, UNCHANGED, CHANGED = 0, 1, 2
GETTERS = {"Float64": "getFloat64", "Enumeration": "getInt64", "UInt64": "getUInt64",
           "Boolean": "getBoolean"}  # fmt: skip


def straight_route() -> SentRoute:
    """Return a route along the x axis with two lines that end, and a bend behind them."""
    x = np.arange(-100.0, 300.0, 2.0)
    left, right, bend = (
        Polyline(np.column_stack([x, y]), Kind.SOLID)
        for y in (np.full_like(x, 1.75), np.full_like(x, -1.75), 5.0 + 1e-4 * x**2)
    )
    first = {Slot.EGO_LEFT: left, Slot.EGO_RIGHT: right, Slot.NEXT_LEFT: bend}
    lines = RouteLines(Polyline([[-100, 0], [300, 0]]), (0.0, 150.0), (first, {Slot.CENTRE: left}))
    return SentRoute("a test", lines, list(Slot), (-4.0, 80.0), MapError(), 2.0)


def sources_of_node(node: str) -> dict[str, str]:
    """Return the C files of a node with maplines.dbc."""
    route = straight_route() if node == "map_sender" else None
    return sources_of(node.removeprefix("map_"), Layout.from_dbc(), route)[0]


def generate(node: str, path: Path) -> None:
    """Write the FMU of a node with maplines.dbc."""
    route = straight_route() if node == "map_sender" else None
    fmu = fmu_of(node.removeprefix("map_"), Layout.from_dbc(), route)
    path.write_bytes(written(fmu))


def library_once(compiler: str, name: str, folder: Path, sources: Iterable[str]) -> bytes:
    """Do as ``compilers.library``, but compile each source once: also in another process."""
    platform, _, file = name.partition("/")
    more = compilers.MORE[platform.partition("-")[2]]
    command = [compiler, *compilers.OPTIONS, *more]
    objects = [_object(command, folder, source) for source in sources]
    subprocess.run([*command, *objects, "-lm", "-o", file], check=True, cwd=folder)
    return (folder / file).read_bytes()


def _object(command: list[str], folder: Path, source: str) -> Path:
    """Return the object file of a source, which is known by what the preprocessor makes of it."""
    text = subprocess.check_output([*command, "-E", "-P", source], cwd=folder)
    digest = hashlib.sha256(repr(command).encode() + text).hexdigest()
    kept = c_core.cache_folder() / f"{digest[:32]}.fmu.o"
    if not kept.exists():
        with tempfile.TemporaryDirectory(dir=kept.parent) as place:
            out = Path(place) / "object.o"
            subprocess.run([*command, "-c", source, "-o", out], check=True, cwd=folder)
            out.replace(kept)  # in one step: another process may compile the same
    return kept


class Operation(NamedTuple):
    """An operation: its code, and the bytes after code and length."""

    code: int
    arguments: bytes

    def packed(self) -> bytes:
        return struct.pack("<II", self.code, 8 + len(self.arguments)) + self.arguments


def transmission(frame: Frame) -> Operation:
    """Return the operation that transmits a frame."""
    if frame.is_fd:
        head = struct.pack("<IBBBH", frame.can_id, frame.is_extended, 1, 0, len(frame.data))
        return Operation(0x11, head + frame.data)
    head = struct.pack("<IBBH", frame.can_id, frame.is_extended, 0, len(frame.data))
    return Operation(0x10, head + frame.data)


def operations_of(value: bytes) -> list[Operation]:
    """Return the operations of a binary value, which must be well-formed."""
    found = []
    while value:
        code, length = struct.unpack_from("<II", value)
        assert 8 <= length <= len(value)
        found.append(Operation(code, value[8:length]))
        value = value[length:]
    return found


def frames_of(operations: Iterable[Operation]) -> list[Frame]:
    """Return the frames that some operations transmit."""
    frames = []
    for code, arguments in operations:
        if code == 0x10:
            can_id, extended, remote, count = struct.unpack_from("<IBBH", arguments)
            assert remote == 0
            assert count == len(arguments) - 8
            frames.append(Frame(can_id, arguments[8:], False, bool(extended)))
        elif code == 0x11:
            can_id, extended, _, _, count = struct.unpack_from("<IBBBH", arguments)
            assert count == len(arguments) - 9
            frames.append(Frame(can_id, arguments[9:], True, bool(extended)))
    return frames


class Node:
    """An instance of an FMU in the event mode at a time."""

    def __init__(
        self, path: Path, folder: Path, start: Mapping[str, Any] | None = None, t: float = 0.0
    ) -> None:
        import fmpy
        from fmpy.fmi3 import FMU3Slave

        self.description = fmpy.read_model_description(str(path))
        if not folder.exists():
            fmpy.extract(str(path), str(folder))
        self.variables = {each.name: each for each in self.description.modelVariables}
        self.messages: list[tuple[int, str]] = []
        self.fmu = FMU3Slave(
            guid=self.description.guid,
            unzipDirectory=str(folder),
            modelIdentifier=self.description.coSimulation.modelIdentifier,
            instanceName="node",
        )
        self.fmu.instantiate(
            eventModeUsed=True,
            logMessage=lambda _, status, __, text: self.messages.append((status, text.decode())),
        )
        self.set(start or {})
        self.t = t
        self.tick: float | None = None  #: when the node sends, as it has said [s]
        self.fmu.enterInitializationMode(startTime=t)
        self.fmu.exitInitializationMode()
        self.fmu.updateDiscreteStates()

    def close(self) -> None:
        self.fmu.terminate()
        self.fmu.freeInstance()

    def get(self, name: str) -> Any:
        """Return a variable, or a list of those whose names begin with ``name[``."""
        each = self.variables.get(name)
        if each is not None:
            return getattr(self.fmu, GETTERS[each.type])([each.valueReference])[0]
        return [self.get(full) for full in self.variables if full.startswith(f"{name}[")]

    def set(self, values: Mapping[str, Any]) -> None:
        for name, value in values.items():
            each = self.variables[name]
            setter = GETTERS[each.type].replace("get", "set")
            getattr(self.fmu, setter)([each.valueReference], [value])

    def step(self, t: float) -> bool:
        """Go to a time in the step mode, and enter the event mode; return whether it is needed."""
        self.fmu.enterStepMode()
        needed, *_ = self.fmu.doStep(self.t, t - self.t)
        self.t = t
        self.fmu.enterEventMode()
        return bool(needed)

    def take(self, value: bytes) -> None:
        """Hand over what comes from the bus."""
        self.fmu.setBinary([RX_DATA], [value])
        self.fmu.setClock([RX_CLOCK], [True])
        self.fmu.updateDiscreteStates()

    def interval(self) -> float | None:
        """Return the time until the node sends; None if it is unknown."""
        qualifier, interval = self.announcement()
        if qualifier == CHANGED:
            self.tick = self.t + interval
        assert (self.tick is None) == (qualifier == NOT_YET_KNOWN)
        return None if self.tick is None else self.tick - self.t

    def announcement(self) -> tuple[int, float]:
        """Return the qualifier and the interval that the node gives for Tx_Clock [s]."""
        intervals, qualifiers = (ctypes.c_double * 1)(), (ctypes.c_int * 1)()
        self.fmu.getIntervalDecimal((ctypes.c_uint * 1)(TX_CLOCK), intervals, qualifiers)
        return qualifiers[0], float(intervals[0])

    def send(self) -> bytes:
        """Let the clock tick by which the node sends; return what it sends."""
        self.tick = None
        self.fmu.setClock([TX_CLOCK], [True])
        value = self.fmu.getBinary([TX_DATA])[0]
        self.fmu.updateDiscreteStates()
        return value or b""
