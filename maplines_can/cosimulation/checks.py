"""Check an FMU against FMI-LS-BUS 1.0.0, low cut, CAN: what the schemas of FMI do not.

Each finding cites the standard. An error breaks a "shall" or "must" of it, a warning a "should" or
what others rely on.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple

from .fmu_description import (
    BUS_TERMINAL,
    LAYERED_STANDARD,
    MANIFEST,
    Description,
    Terminal,
    Variable,
)

MIME_TYPE = "application/org.fmi-standard.fmi-ls-bus.can"
VERSION = "1.0.0"
TRANSCEIVER = "org.fmi-ls-bus.transceiver"
MEMBERS = ("Tx_Data", "Tx_Clock", "Rx_Data", "Rx_Clock")
#: Intervals of clocks whose ticks the importer makes.
TIME_BASED = ("constant", "fixed", "tunable", "changing", "countdown")
#: Bytes of a CAN Transmit operation of 8, and of a CAN FD Transmit operation of 64 data bytes.
CAN_SIZE, CAN_FD_SIZE = 24, 81
_CONFIGURATION = f"{BUS_TERMINAL}.configuration"
_DESCRIPTION = (
    "Layered Standard for the simulation of bus communication on a Physical Signal Abstraction or "
    "Network Abstraction based level."
)


class Finding(NamedTuple):
    """What is wrong with an FMU."""

    is_error: bool
    where: str
    what: str
    rule: str  #: what the standard says

    def __str__(self) -> str:
        level = "error" if self.is_error else "warning"
        return f"{level}: {self.where}: {self.what}; {self.rule}"


def error(where: str, what: str, rule: str) -> Finding:
    """Return a finding that breaks the standard."""
    return Finding(True, where, what, rule)


def warning(where: str, what: str, rule: str) -> Finding:
    """Return a finding that does not break the standard."""
    return Finding(False, where, what, rule)


def check(fmu: Description) -> list[Finding]:
    """Return what is wrong with an FMU as a node or a simulation of a CAN bus."""
    return [*_manifest(fmu), *_interface(fmu), *_terminals(fmu)]


def mime_version(variable: Variable) -> str | None:
    """Return the version in the MIME type of a binary variable; None for another type."""
    kind, *parameters = [
        part.strip() for part in variable.attributes.get("mimeType", "").split(";")
    ]
    if kind != MIME_TYPE:
        return None
    versions = [one.partition("=")[2] for one in parameters if one.startswith("version=")]
    return versions[0].strip('"') if versions else ""


def _manifest(fmu: Description) -> Iterator[Finding]:
    manifest = fmu.manifest
    if manifest is None:
        yield error("manifest", f"{MANIFEST} is missing", "an FMU of a layered standard has it")
        return
    if manifest.name != LAYERED_STANDARD:
        rule = f"the schema fixes it to {LAYERED_STANDARD!r}"
        yield error("manifest", f"fmi-ls-name is {manifest.name!r}", rule)
    if not re.fullmatch(r"1\.\d+(\.\d+)?", manifest.version):
        yield error(
            "manifest",
            f"fmi-ls-version is {manifest.version!r}",
            f"this is {VERSION}, and by semantic versioning a pre-release or another major version "
            "may differ from it",
        )
    if manifest.description != _DESCRIPTION:
        rule = f"the schema fixes it to {_DESCRIPTION!r}"
        yield warning("manifest", "fmi-ls-description is another text", rule)


def _interface(fmu: Description) -> Iterator[Finding]:
    if fmu.co_simulation is None:
        yield error("CoSimulation", "is missing", "buses are simulated by co-simulation here")
        return
    if not fmu.is_true("hasEventMode"):
        rule = (
            'networked FMUs shall set it to true, since clocks need event mode ("Common Concepts")'
        )
        yield error("CoSimulation", "hasEventMode is not true", rule)
    if not fmu.is_true("canHandleVariableCommunicationStepSize"):
        yield warning(
            "CoSimulation",
            "canHandleVariableCommunicationStepSize is not true",
            'FMUs with a time-based Tx_Clock should set it to true ("Time-based Tx Clocks")',
        )


def _terminals(fmu: Description) -> Iterator[Finding]:
    if fmu.terminals is None:
        rule = "each network shall be described there as a terminal"
        yield error("terminals", "terminalsAndIcons.xml is missing", rule)
        return
    found, most = fmu.bus_terminals, 2 if fmu.is_bus_simulation else 1
    if len(found) < most:
        yield error(
            "terminals",
            f"{len(found) or 'none'} of terminalKind {BUS_TERMINAL!r}",
            "a bus simulation must have one for each FMU, two or more"
            if fmu.is_bus_simulation
            else "each network shall be described as a terminal of this kind",
        )
    owners: dict[str, str] = {}
    for terminal in found:
        yield from _bus_terminal(fmu, terminal)
        for member in terminal.members:
            if owners.setdefault(member.variable, terminal.name) != terminal.name:
                yield error(
                    f"terminal {terminal.name}",
                    f"variable {member.variable} is in terminal {owners[member.variable]}, too",
                    "the same variable in different bus terminals is not allowed",
                )


def _bus_terminal(fmu: Description, terminal: Terminal) -> Iterator[Finding]:
    here = f"terminal {terminal.name}"
    if terminal.matching_rule != TRANSCEIVER:
        rule = f"it must be {TRANSCEIVER!r}"
        yield error(here, f"matchingRule is {terminal.matching_rule!r}", rule)
    rule = "a bus terminal shall contain the members Tx_Data, Tx_Clock, Rx_Data and Rx_Clock"
    names = sorted(member.name for member in terminal.members)
    if names != sorted(MEMBERS):
        yield error(here, f"has the members {', '.join(names) or 'none'}", rule)
    for member in terminal.members:
        if member.kind != "signal":
            what = f"variableKind of {member.name} is {member.kind!r}"
            yield error(here, what, "it must be 'signal'")
        if member.variable not in fmu.variables:
            what = f"{member.name} names the variable {member.variable!r}, which there is not"
            yield error(here, what, "a member refers to a variable of the model description")
    variables = {name: fmu.variables.get(terminal.variable(name)) for name in MEMBERS}
    for direction in ("Tx", "Rx"):
        data, clock = variables[f"{direction}_Data"], variables[f"{direction}_Clock"]
        if data is not None:
            yield from _binary(data, direction, clock)
        if clock is not None:
            yield from _clock(fmu, clock, direction)
    if (data := variables["Tx_Data"]) is not None and data.reference in fmu.initial_unknowns:
        rule = "FMI 3.0: clocked variables are no initial unknowns"
        yield error(f"variable {data.name}", "stands under InitialUnknown", rule)
    yield from _configuration(fmu, terminal)


def _binary(data: Variable, direction: str, clock: Variable | None) -> Iterator[Finding]:
    here = f"variable {data.name}"
    causality = "output" if direction == "Tx" else "input"
    if data.type != "Binary":
        yield error(here, f"is of type {data.type}", f"{direction}_Data is of type Binary")
        return
    if data.causality != causality:
        rule = f"the causality of {direction}_Data shall be {causality}"
        yield error(here, f"causality is {data.causality}", rule)
    if clock is not None and data.clocks != (str(clock.reference),):
        clocks = " ".join(data.clocks) or "none"
        rule = f"{direction}_Data is clocked by {direction}_Clock, so it must be {clock.reference}"
        yield error(here, f"its attribute clocks is {clocks}", rule)
    version = mime_version(data)
    if version != VERSION:
        mime = data.attributes.get("mimeType", "")
        rule = f'it must be {MIME_TYPE}; version="{VERSION}" ("MIME Types")'
        yield error(here, f"mimeType is {mime or 'missing'}", rule)
    size = data.attributes.get("maxSize", "")
    if size.isdecimal() and int(size) < CAN_FD_SIZE:
        is_error = int(size) < CAN_SIZE
        kind, least = ("CAN", CAN_SIZE) if is_error else ("CAN FD", CAN_FD_SIZE)
        rule = f"a {kind} Transmit operation of the longest frame has {least} bytes"
        yield Finding(is_error, here, f"maxSize is {size} bytes", rule)
    if data.dimensions:
        rule = "an operation may be of any length, so one value holds all operations"
        yield warning(here, "is an array", rule)


def _clock(fmu: Description, clock: Variable, direction: str) -> Iterator[Finding]:
    here, kind = f"clock {clock.name}", clock.interval_variability
    if clock.type != "Clock":
        yield error(here, f"is of type {clock.type}", f"{direction}_Clock is of type Clock")
        return
    if kind not in ("triggered", *TIME_BASED):
        yield error(here, f"intervalVariability is {kind!r}", "FMI 3.0 has no such clock")
        return
    if direction == "Rx" and kind != "triggered":
        yield error(here, f"is {kind}", "the input clocks Rx_Clock shall be triggered clocks")
    causality = "output" if direction == "Tx" and kind == "triggered" else "input"
    if clock.causality != causality:
        rule = f"a {kind} {direction}_Clock has the causality {causality}"
        yield error(here, f"causality is {clock.causality}", rule)
    interval = {"intervalDecimal", "intervalCounter"} & set(clock.attributes)
    if kind == "constant" and not interval:
        rule = "the interval of a constant clock is defined in modelDescription.xml"
        yield error(here, "has no interval", rule)
    if causality == clock.causality == "output":
        if clock.reference not in fmu.initial_unknowns:
            rule = "FMI 3.0: a triggered output clock is an output that is calculated at the start"
            yield error(here, "does not stand under InitialUnknown", rule)
        if clock.reference not in fmu.outputs:
            rule = "FMI 3.0: each output stands there"
            yield error(here, "does not stand under Output", rule)


def _configuration(fmu: Description, terminal: Terminal) -> Iterator[Finding]:
    here = f"terminal {terminal.name}"
    inner = [one for one in terminal.nested if one.kind == _CONFIGURATION]
    named = [one for one in terminal.nested if one.name == "Configuration"]
    for one in named:
        if one not in inner:
            rule = f"it must be {_CONFIGURATION!r}"
            yield error(f"{here}, Configuration", f"terminalKind is {one.kind!r}", rule)
    for one in inner:
        if one.name != "Configuration":
            yield error(
                here, f"its configuration is named {one.name!r}", "it must be Configuration"
            )
        if one.matching_rule != "bus":
            rule = "it must be 'bus'"
            yield error(f"{here}, Configuration", f"matchingRule is {one.matching_rule!r}", rule)
    variable = notifications(fmu, terminal)
    if variable is None:
        alike = [name for name in fmu.variables if "busnotification" in name.lower()]
        alike += [m.variable for one in inner for m in one.members if "otification" in m.name]
        rule = "it must be in the configuration terminal with the memberName BusNotifications"
        if fmu.is_bus_simulation:
            rule = "a bus simulation shall indicate by it whether it sends notifications"
            yield error(here, "has no member BusNotifications", rule)
        elif alike:
            yield error(f"variable {alike[0]}", "no terminal has it as BusNotifications", rule)
        return
    rule, allowed = "", {("parameter", "fixed")}
    if fmu.is_bus_simulation:
        allowed = {("calculatedParameter", "fixed"), ("output", "constant")}
    got = variable.type, variable.causality, variable.variability
    if variable.type != "Boolean" or got[1:] not in allowed:
        rule = f"it shall be Boolean, {' or '.join(f'{a}, {b}' for a, b in sorted(allowed))}"
        yield error(f"variable {variable.name}", f"is {', '.join(got)}", rule)
    if not fmu.is_bus_simulation and variable.attributes.get("start") not in ("false", "0"):
        start = variable.attributes.get("start", "missing")
        rule = "the default value of BusNotifications shall be false"
        yield error(f"variable {variable.name}", f"start is {start}", rule)


def notifications(fmu: Description, terminal: Terminal) -> Variable | None:
    """Return the variable that says whether a node awaits notifications; None without it."""
    inner = [one for one in terminal.nested if one.name == "Configuration"]
    names = [one.variable("BusNotifications") for one in inner]
    return next((fmu.variables[name] for name in names if name in fmu.variables), None)
