"""Read what an FMU says of itself: model description, terminals, and the manifest of FMI-LS-BUS.

Only the parts that a bus needs are read; `checks` says what is wrong with them.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path, PurePosixPath
from typing import NamedTuple
from xml.etree import ElementTree as ET

from ..values.errors import FmuError

LAYERED_STANDARD = "org.fmi-standard.fmi-ls-bus"
MODEL_DESCRIPTION = "modelDescription.xml"
MANIFEST = f"extra/{LAYERED_STANDARD}/fmi-ls-manifest.xml"
#: Paths of the terminals: that of FMI 3.0, and that of the text of FMI-LS-BUS 1.0.0.
TERMINALS = ("terminalsAndIcons/terminalsAndIcons.xml", "icons/terminalsAndIcons.xml")
BUS_TERMINAL = "org.fmi-ls-bus.network-terminal"
#: Largest XML file that is read [bytes].
MAX_XML = 50_000_000
_FMI_LS = "{http://fmi-standard.org/fmi-ls-manifest}"
_VARIABLE_TYPES = {
    *(f"Float{bits}" for bits in (32, 64)),
    *(f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)),
    *("Boolean", "String", "Binary", "Clock", "Enumeration"),
}


class Variable(NamedTuple):
    """Variable of an FMU; an attribute that it does not have is empty."""

    type: str  #: such as Float64, Binary or Clock
    name: str
    reference: int
    causality: str
    variability: str
    attributes: Mapping[str, str]  #: all of them, as they are written
    #: number of elements of each dimension, or "#" and the reference of the variable that has it
    dimensions: tuple[str, ...]

    @property
    def clocks(self) -> tuple[str, ...]:
        """Value references of the clocks at which the variable changes."""
        return tuple(self.attributes.get("clocks", "").split())

    @property
    def interval_variability(self) -> str:
        """Kind of a clock: triggered, countdown, changing, constant, fixed or tunable."""
        return self.attributes.get("intervalVariability", "")


class Member(NamedTuple):
    """Variable in a terminal."""

    name: str
    variable: str
    kind: str


@dataclass(frozen=True)
class Terminal:
    """Terminal of an FMU, with the terminals in it."""

    name: str
    kind: str
    matching_rule: str
    members: tuple[Member, ...]
    nested: tuple[Terminal, ...]

    def variable(self, member: str) -> str:
        """Return the name of the variable with this member name; empty if there is none."""
        return next((one.variable for one in self.members if one.name == member), "")


class Manifest(NamedTuple):
    """Manifest of the layered standard."""

    name: str
    version: str
    description: str
    is_bus_simulation: bool


@dataclass(frozen=True)
class Description:
    """What an FMU says of itself."""

    path: Path
    fmi_version: str
    token: str  #: instantiation token
    co_simulation: Mapping[str, str] | None  #: attributes of the interface; None without it
    variables: Mapping[str, Variable]  #: by name
    initial_unknowns: frozenset[int]  #: value references
    outputs: frozenset[int]  #: value references
    step: float | None  #: of the default experiment [s]
    terminals: tuple[Terminal, ...] | None  #: None without the file
    manifest: Manifest | None
    platforms: tuple[str, ...]  #: for which there are binaries

    @property
    def bus_terminals(self) -> list[Terminal]:
        """Terminals that connect the FMU to a bus."""
        return [one for one in self.terminals or () if one.kind == BUS_TERMINAL]

    @property
    def is_bus_simulation(self) -> bool:
        """Whether the FMU simulates the bus between nodes."""
        return self.manifest is not None and self.manifest.is_bus_simulation

    def is_true(self, attribute: str) -> bool:
        """Return whether an attribute of the co-simulation interface is true."""
        return (self.co_simulation or {}).get(attribute) in ("true", "1")


def read_description(path: str | PathLike[str]) -> Description:
    """Return what an FMU says of itself.

    Raises:
        FmuError: the file is no FMU of FMI 3.0.
        OSError: the file cannot be opened.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as fmu:
            return _described(path, fmu)
    except zipfile.BadZipFile as error:
        raise FmuError(f"{path}: is no FMU, which is a zip file: {error}") from error


def _described(path: Path, fmu: zipfile.ZipFile) -> Description:
    names = set(fmu.namelist())
    if MODEL_DESCRIPTION not in names:
        raise FmuError(f"{path}: is no FMU: it has no {MODEL_DESCRIPTION}")
    model = _xml(path, fmu, MODEL_DESCRIPTION)
    version = model.get("fmiVersion", "")
    if model.tag != "fmiModelDescription" or not version.startswith("3.0"):
        raise FmuError(f"{path}: is an FMU of FMI {version or '?'}; a bus needs FMI 3.0")
    interface, experiment = model.find("CoSimulation"), model.find("DefaultExperiment")
    terminals = next((_xml(path, fmu, name) for name in TERMINALS if name in names), None)
    # Archives may have entries of folders, too, such as "binaries/".
    files = [PurePosixPath(name).parts for name in names if not name.endswith("/")]
    platforms = {parts[1] for parts in files if parts[0] == "binaries" and len(parts) > 2}
    try:
        variables = [_variable(one) for one in model.iterfind("ModelVariables/*")]
        unknowns = model.iterfind("ModelStructure/InitialUnknown")
        outputs = model.iterfind("ModelStructure/Output")
        step = None if experiment is None else experiment.get("stepSize")
        return Description(
            path,
            version,
            model.get("instantiationToken", ""),
            None if interface is None else dict(interface.attrib),
            {one.name: one for one in variables if one.type in _VARIABLE_TYPES},
            frozenset(int(one.attrib["valueReference"]) for one in unknowns),
            frozenset(int(one.attrib["valueReference"]) for one in outputs),
            None if step is None else float(step),
            None if terminals is None else _terminals(terminals.find("Terminals")),
            _manifest(_xml(path, fmu, MANIFEST)) if MANIFEST in names else None,
            tuple(sorted(platforms)),
        )
    except (KeyError, ValueError) as error:
        raise FmuError(f"{path}: {MODEL_DESCRIPTION} or a terminal is wrong: {error!r}") from error


def _xml(path: Path, fmu: zipfile.ZipFile, name: str) -> ET.Element:
    if fmu.getinfo(name).file_size > MAX_XML:
        raise FmuError(f"{path}: {name} has more than {MAX_XML} bytes")
    try:
        return ET.fromstring(fmu.read(name))  # noqa: S314 - expat limits entities
    except ET.ParseError as error:
        raise FmuError(f"{path}: {name} is no XML: {error}") from error


def _variable(element: ET.Element) -> Variable:
    attributes = dict(element.attrib)
    is_float = element.tag.startswith("Float")
    return Variable(
        element.tag,
        attributes["name"],
        int(attributes["valueReference"]),
        attributes.get("causality", "local"),
        attributes.get("variability", "continuous" if is_float else "discrete"),
        attributes,
        tuple(
            one.get("start") or f"#{one.attrib['valueReference']}"
            for one in element.iterfind("Dimension")
        ),
    )


def _terminals(parent: ET.Element | None) -> tuple[Terminal, ...]:
    if parent is None:
        return ()
    return tuple(
        Terminal(
            element.get("name", ""),
            element.get("terminalKind", ""),
            element.get("matchingRule", ""),
            tuple(
                Member(
                    member.get("memberName", ""),
                    member.get("variableName", ""),
                    member.get("variableKind", ""),
                )
                for member in element.iterfind("TerminalMemberVariable")
            ),
            _terminals(element),
        )
        for element in parent.iterfind("Terminal")
    )


def _manifest(root: ET.Element) -> Manifest:
    return Manifest(
        root.get(f"{_FMI_LS}fmi-ls-name", ""),
        root.get(f"{_FMI_LS}fmi-ls-version", ""),
        root.get(f"{_FMI_LS}fmi-ls-description", ""),
        root.get("isBusSimulationFMU", "false").strip() in ("true", "1"),
    )
