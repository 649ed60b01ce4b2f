"""The interface of FMI: states, instances, wrong calls; and any bytes on the bus."""

import ctypes
import os
import shutil
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.fmu_nodes import (
    Node,
    Operation,
    generate,
    operations_of,
    sources_of_node,
    transmission,
)

from maplines_can import Codec, MapLine, Slot

fmpy = pytest.importorskip("fmpy", reason="the headers of FMI and the importer come from fmpy")
C = Path(__file__).parents[2] / "c"
LS_BUS = Path(__file__).parents[3] / "shared" / "fmi" / "ls-bus" / "headers"


NODES = ["receiver", "sender", "map_sender"]


@pytest.fixture(scope="module", params=NODES)
def fmu(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fmu") / f"{request.param}.fmu"
    generate(request.param, path)
    return path


def drive(node: Node, cycles: int, seed: int) -> bytes:
    """Let a node send and receive for some cycles; return what it sends and all its outputs."""
    rng = np.random.default_rng(seed)
    encoder = Codec.from_dbc().encoder()
    found = bytearray()
    for _ in range(cycles):
        if "EGO_LEFT.valid" in node.variables:
            node.set(
                {"EGO_LEFT.valid": True, "EGO_LEFT.mean[1]": rng.normal(), "EGO_LEFT.x_max": 50.0}
            )
        if "pose.valid" in node.variables:
            node.set({"pose.valid": True, "pose.mean[1]": 40.0 * rng.normal(), "pose.cov[1,1]": 0.1,
                      "pose.cov[2,2]": 0.02, "pose.cov[3,3]": 1e-4})  # fmt: skip
        interval = node.interval()
        node.step(node.t + (interval or 0.05))
        found += node.send()
        line = MapLine.with_sigma(Slot.EGO_RIGHT, rng.normal(0, 0.001, 4), [0.1, 0.01, 1e-3, 1e-5])
        node.take(b"".join(transmission(frame).packed() for frame in encoder.encode(line)))
        for each in node.description.modelVariables:
            if each.causality == "output" and each.type != "Binary":
                found += repr((each.name, node.get(each.name))).encode()
    return bytes(found)


def test_a_state_is_restored(fmu: Path) -> None:
    """In the same instance, and as bytes in another one: what follows is the same."""
    node = Node(fmu, fmu.with_suffix(""))
    drive(node, 5, 1)
    state, t = node.fmu.getFMUState(), node.t
    stored = node.fmu.serializeFMUState(state)
    after = drive(node, 5, 2)
    node.fmu.setFMUState(state)
    node.t = t
    assert drive(node, 5, 2) == after
    other = Node(fmu, fmu.with_suffix(""))
    restored = other.fmu.deserializeFMUState(stored)
    other.fmu.setFMUState(restored)
    other.t = t
    assert drive(other, 5, 2) == after
    for each, own in ((node, state), (other, restored)):
        each.fmu.freeFMUState(own)
        each.close()


def test_bytes_of_another_state_are_refused(fmu: Path) -> None:
    node = Node(fmu, fmu.with_suffix(""))
    state = node.fmu.getFMUState()
    stored = bytearray(node.fmu.serializeFMUState(state))
    for wrong in (stored[:-1], stored[:100], bytes([stored[0] ^ 1]) + stored[1:],
                  stored[:-1] + bytes([stored[-1] ^ 1])):  # fmt: skip
        with pytest.raises(Exception, match="Deserialize"):
            node.fmu.deserializeFMUState(bytes(wrong))
    node.fmu.freeFMUState(state)
    node.close()


def test_two_instances_share_nothing(fmu: Path) -> None:
    """They do what each one does alone."""
    alone = []
    for seed in (3, 4):
        node = Node(fmu, fmu.with_suffix(""))
        alone.append(b"".join(drive(node, 1, seed) for _ in range(4)))
        node.close()
    pair = [Node(fmu, fmu.with_suffix("")) for _ in range(2)]
    together = [b"", b""]
    for _ in range(4):
        for i, node in enumerate(pair):
            together[i] += drive(node, 1, 3 + i)
    assert together == alone
    for node in pair:
        node.close()


def test_after_a_reset_it_starts_again(fmu: Path) -> None:
    node = Node(fmu, fmu.with_suffix(""))
    first = drive(node, 3, 1)
    node.fmu.terminate()
    node.fmu.reset()
    node.fmu.enterInitializationMode(startTime=0.0)
    node.fmu.exitInitializationMode()
    node.t = 0.0
    assert drive(node, 3, 1) == first
    node.close()


def wrong_calls(node: Node) -> Iterator[tuple[str, object]]:
    fmu = node.fmu
    yield "must not be called", lambda: fmu.doStep(0.0, 0.1)
    yield "must not be called", lambda: fmu.enterEventMode()
    yield "must not be called", lambda: fmu.exitInitializationMode()
    yield "no Float64 with the value reference 77", lambda: fmu.getFloat64([77])
    yield "no UInt64", lambda: fmu.getUInt64([399_999])
    yield "must not be set now", lambda: node.set({"cycle_time": 0.1})
    yield "must not be set now", lambda: node.set({"CAN.frames_sent": 1})
    yield "3 values", lambda: fmu.getFloat64([0, 0], 3)
    yield "not an output clock", lambda: fmu.getClock([4])
    yield "not a clock", lambda: fmu.setClock([1], [True])
    yield "only Rx_Data", lambda: fmu.setBinary([2], [b"x"])
    yield "32768 bytes at most", lambda: fmu.setBinary([1], [bytes(32769)])
    yield "fmi3SetTime is not supported", lambda: fmu.fmi3SetTime(fmu.component, 1.0)
    yield (
        "not a countdown",
        lambda: fmu.getIntervalDecimal(
            (ctypes.c_uint * 1)(3), (ctypes.c_double * 1)(), (ctypes.c_int * 1)()
        ),
    )


def test_wrong_calls_are_errors_with_a_message(fmu: Path) -> None:
    """And the node goes on as if they were not."""
    node = Node(fmu, fmu.with_suffix(""))
    for message, call in wrong_calls(node):
        node.messages.clear()
        with pytest.raises(Exception, match="fmi3"):
            call()  # type: ignore[operator]
        assert any(status == 3 and message in text for status, text in node.messages), message
    other = Node(fmu, fmu.with_suffix(""))
    assert drive(node, 3, 1) == drive(other, 3, 1)
    node.fmu.enterStepMode()
    with pytest.raises(Exception, match="fmi3DoStep"):
        node.fmu.doStep(node.t, float("nan"))
    node.close()
    other.close()


def test_wrong_parameters_are_refused(fmu: Path) -> None:
    for values in ({"cycle_time": -1.0}, {"CAN.baud_rate": 0}, {"CAN.arbitration_lost": 3}):
        with pytest.raises(Exception, match="fmi3"):
            Node(fmu, fmu.with_suffix(""), values)


def test_an_instance_needs_its_token_and_the_event_mode(fmu: Path) -> None:
    from fmpy.fmi3 import FMU3Slave

    description = fmpy.read_model_description(str(fmu))
    folder = fmu.with_suffix("")
    if not folder.exists():
        fmpy.extract(str(fmu), str(folder))
    for guid, has_events in (("{other}", True), (description.guid, False)):
        node = FMU3Slave(
            guid=guid,
            unzipDirectory=str(folder),
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName="node",
        )
        with pytest.raises(Exception, match="instantiate"):
            node.instantiate(eventModeUsed=has_events, logMessage=lambda *_: None)


# ---- the bus ----------------------------------------------------------------------------------

MALFORMED = [
    b"\x10",
    struct.pack("<II", 0x10, 7),
    struct.pack("<II", 0x10, 0xFFFFFFFF),
    struct.pack("<II", 0x77, 8),
    Operation(0x10, struct.pack("<IBBH", 0x800, 0, 0, 0)).packed(),
    Operation(0x10, struct.pack("<IBBH", 1, 2, 0, 0)).packed(),
    Operation(0x10, struct.pack("<IBBH", 1, 0, 0, 9) + bytes(9)).packed(),
    Operation(0x10, struct.pack("<IBBH", 1, 0, 0, 8) + bytes(7)).packed(),
    Operation(0x10, struct.pack("<IBBH", 1, 0, 0, 8)).packed(),
    Operation(0x10, struct.pack("<IBBH", 1, 0, 1, 8) + bytes(7)).packed(),
    Operation(0x10, struct.pack("<IBBH", 1, 0, 1, 9)).packed(),
    Operation(0x11, struct.pack("<IBBBH", 1, 0, 1, 0, 65) + bytes(65)).packed(),
    Operation(0x12, bytes(3)).packed(),
    Operation(0x20, bytes(3)).packed(),
    Operation(0x31, struct.pack("<IBBB", 1, 9, 1, 1)).packed(),
    Operation(0x40, bytes([1, 2])).packed(),
    Operation(0x41, bytes([9])).packed(),
    Operation(0x42, bytes(1)).packed(),
    Operation(0x01, struct.pack("<H", 5)).packed(),
]


def test_malformed_operations_are_counted_and_answered(fmu: Path) -> None:
    """Each one with a format error that has its bytes; what follows it is read."""
    node = Node(fmu, fmu.with_suffix(""))
    node.send()
    good = Operation(0x42, b"").packed()
    for k, wrong in enumerate(MALFORMED):
        node.take(good + wrong)
        assert node.get("CAN.malformed") == k + 1
        (answer,) = operations_of(node.send())
        assert answer == Operation(0x01, struct.pack("<H", len(wrong)) + wrong)
    node.take(MALFORMED[4] + Operation(0x01, struct.pack("<H", 1) + b"x").packed())
    assert node.get("CAN.format_errors") == 1
    node.close()


@pytest.mark.parametrize("data", [b"", bytes(4)], ids=["without-data", "with-data"])
def test_a_remote_frame_states_the_length_that_it_asks_for(fmu: Path, data: bytes) -> None:
    """FMI-LS-BUS since its pull request 393: no data; before it, its header wrote them."""
    node = Node(fmu, fmu.with_suffix(""))
    node.send()
    node.take(Operation(0x10, struct.pack("<IBBH", 1, 0, 1, 4) + data).packed())
    assert node.get("CAN.malformed") == 0
    assert operations_of(node.send()) == []
    node.close()


def build(node: str, folder: Path, command: list[str]) -> Path:
    """Return the program of fmu_harness.c with the sources of a node."""
    sources = sources_of_node(node)
    for name, text in sources.items():
        (folder / name).write_text(text)
    shutil.copy(C / "tests" / "fmu_harness.c", folder)
    files = [*(name for name in sources if name.endswith(".c")), "fmu_harness.c"]
    arguments = ["-std=c99", "-ffp-contract=off", *files, "-lm", "-o", "harness.exe"]
    subprocess.run([*command, *arguments], check=True, cwd=folder)
    return folder / "harness.exe"


def any_bytes(seed: int) -> str:
    """Return values of a bus: frames, notifications, and these with some bits changed."""
    rng = np.random.default_rng(seed)
    encoder = Codec.from_dbc().encoder()
    rows = []
    for k in range(400):
        line = MapLine.with_sigma(Slot(k % 8), rng.normal(0, 1e-3, 4), [0.1, 0.01, 1e-3, 1e-5])
        value = bytearray(b"".join(transmission(f).packed() for f in encoder.encode(line)))
        value += Operation(0x20 + 0x10 * (k % 2), struct.pack("<I", 0x340 + k % 16)).packed()
        value += Operation(0x31, struct.pack("<IBBB", 0x340 + k % 16, 1, 1, k % 2)).packed()
        for _ in range(rng.integers(0, 4)):
            value[rng.integers(len(value))] ^= 1 << rng.integers(8)
        rows.append(bytes(value[: rng.integers(1, len(value) + 1)] if k % 5 == 0 else value).hex())
    return "\n".join([*rows, ""])


def output(command: list[str], text: str, **variables: str) -> str:
    done = subprocess.run(
        command, input=text, capture_output=True, text=True, check=False, env=os.environ | variables
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("node", NODES)
def test_any_bytes_pass_the_sanitizers(node: str, tmp_path: Path) -> None:
    if shutil.which("clang") is None:
        pytest.skip("there is no clang")
    checks = "-fsanitize=address,undefined,float-cast-overflow"
    # Optimised, sanitizers take ten times as long to compile.
    command = ["clang", "-g", "-O0", checks, "-fno-sanitize-recover=all"]
    printed = output([str(build(node, tmp_path, command))], any_bytes(3))
    assert int(printed.split()[0]) > 1000


@pytest.mark.parametrize("node", NODES)
def test_on_windows_a_node_sends_the_same(node: str, tmp_path: Path) -> None:
    """Bytes sent and real variables are the same in Wine as here."""
    mingw = shutil.which("x86_64-w64-mingw32-gcc")
    wine = shutil.which("wine64") or shutil.which("wine") or shutil.which("/usr/lib/wine/wine64")
    if mingw is None or wine is None:
        pytest.skip("there is no MinGW, or no Wine")
    (tmp_path / "here").mkdir()
    here = build(node, tmp_path / "here", ["cc", "-O2", "-DNDEBUG"])
    there = build(node, tmp_path, [mingw, "-O2", "-DNDEBUG", "-static-libgcc"])
    text = any_bytes(4)
    prefix = {"WINEPREFIX": str(tmp_path / "wine"), "WINEDEBUG": "-all"}
    assert output([wine, str(there)], text, **prefix).split() == output([str(here)], text).split()


@pytest.mark.skipif(not LS_BUS.exists(), reason="the headers of FMI-LS-BUS are not here")
def test_operations_are_those_of_the_official_header(tmp_path: Path) -> None:
    """Each one that a node writes, and each one that it reads."""
    sources = sources_of_node("sender")
    for name, text in sources.items():
        (tmp_path / name).write_text(text)
    shutil.copy(C / "tests" / "bus_harness.c", tmp_path)
    command = ["cc", "-std=gnu11", f"-I{LS_BUS}", "-I.", "-include", "names.h",
               "bus_harness.c", "bus.c", "-lm", "-o", "harness"]  # fmt: skip
    subprocess.run(command, check=True, cwd=tmp_path)
    done = subprocess.run([str(tmp_path / "harness")], capture_output=True, text=True, check=False)
    assert done.stdout == "7 written and 13 read operations agree\n"
    assert done.returncode == 0
