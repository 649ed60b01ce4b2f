"""The XML files of an FMU: description, terminals, manifest and build."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from enum import IntEnum

from .variables import RX_CLOCK, RX_DATA, TIME, TX_CLOCK, TX_DATA, Role, Row, Store, Variable

#: Type of the binary variables.
MIME_TYPE = 'application/org.fmi-standard.fmi-ls-bus.can; version="1.0.0"'
#: Name of the standard, and so of the folder of its manifest.
BUS = "org.fmi-standard.fmi-ls-bus"
#: Its text for each manifest.
ABOUT_BUS = (
    "Layered Standard for the simulation of bus communication on a Physical Signal Abstraction or "
    "Network Abstraction based level."
)
#: Units with their exponents of SI base units.
UNITS: dict[str, dict[str, int]] = {
    "s": {"s": 1},
    "m": {"m": 1},
    "rad": {"rad": 1},
    "bit/s": {"s": -1},
}
#: Most bytes of a binary variable: as c/fmu/fmu.h has them.
RX_SIZE, TX_SIZE = 32768, 8192
#: Categories of messages, as fmi3.c has them.
CATEGORIES = ("logEvents", "logStatusWarning", "logStatusDiscard", "logStatusError")


def model_description(
    identifier: str, about: str, version: str, token: str, variables: Sequence[Variable]
) -> bytes:
    """Return ``modelDescription.xml``."""
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="3.0",
        modelName=identifier,
        instantiationToken=token,
        description=about,
        version=version,
        generationTool=f"maplines {version}",
        variableNamingConvention="structured",
    )
    ET.SubElement(
        root,
        "CoSimulation",
        modelIdentifier=identifier,
        canGetAndSetFMUState="true",
        canSerializeFMUState="true",
        canHandleVariableCommunicationStepSize="true",
        providesEvaluateDiscreteStates="true",
        hasEventMode="true",
    )
    units = ET.SubElement(root, "UnitDefinitions")
    for name, exponents in UNITS.items():
        unit = ET.SubElement(units, "Unit", name=name)
        ET.SubElement(unit, "BaseUnit", {key: str(value) for key, value in exponents.items()})
    types = ET.SubElement(root, "TypeDefinitions")
    for choices in dict.fromkeys(each.row.choices for each in variables):
        if choices is not None:
            _add_type(types, choices)
    categories = ET.SubElement(root, "LogCategories")
    for category in CATEGORIES:
        ET.SubElement(categories, "Category", name=category)
    ET.SubElement(root, "DefaultExperiment", startTime="0", stepSize="0.001")
    _add_variables(ET.SubElement(root, "ModelVariables"), variables)
    _add_structure(ET.SubElement(root, "ModelStructure"), variables)
    return _written(root)


def _add_type(types: ET.Element, choices: type[IntEnum]) -> None:
    about = (choices.__doc__ or "").splitlines()[0]
    each = ET.SubElement(types, "EnumerationType", name=choices.__name__, description=about)
    for choice in choices:
        ET.SubElement(each, "Item", name=choice.name, value=str(int(choice)))


def _add_variables(parent: ET.Element, variables: Sequence[Variable]) -> None:
    ET.SubElement(
        parent,
        "Float64",
        name="time",
        valueReference=str(TIME),
        causality="independent",
        variability="continuous",
        description="time of the simulation",
        unit="s",
    )
    received = ET.SubElement(
        parent,
        "Binary",
        name="CAN.Rx_Data",
        valueReference=str(RX_DATA),
        causality="input",
        variability="discrete",
        description="operations that come from the bus",
        clocks=str(RX_CLOCK),
        mimeType=MIME_TYPE,
        maxSize=str(RX_SIZE),
    )
    ET.SubElement(received, "Start", value="")
    ET.SubElement(
        parent,
        "Binary",
        name="CAN.Tx_Data",
        valueReference=str(TX_DATA),
        causality="output",
        variability="discrete",
        description="operations that go to the bus",
        clocks=str(TX_CLOCK),
        mimeType=MIME_TYPE,
        maxSize=str(TX_SIZE),
    )
    for reference, name, interval in (
        (RX_CLOCK, "CAN.Rx_Clock", "triggered"),
        (TX_CLOCK, "CAN.Tx_Clock", "countdown"),
    ):
        ET.SubElement(
            parent,
            "Clock",
            name=name,
            valueReference=str(reference),
            causality="input",
            intervalVariability=interval,
        )
    for each in variables:
        ET.SubElement(parent, each.row.store.value[0], _attributes(each))


def _attributes(variable: Variable) -> dict[str, str]:
    """Return the attributes of a variable."""
    row = variable.row
    causality, variability = row.role.value
    if variability is None:
        variability = "continuous" if row.store is Store.REAL else "discrete"
    found = {
        "name": variable.name,
        "valueReference": str(variable.reference),
        "causality": causality,
        "variability": variability,
        "description": row.about,
    }
    if row.choices is not None:
        found["declaredType"] = row.choices.__name__
    if row.unit is not None and row.store is Store.REAL:
        found["unit"] = row.unit
    if row.role is not Role.OUTPUT:
        found["start"] = _start(row, variable.start)
    return found


def _start(row: Row, start: float) -> str:
    if row.store is Store.FLAG:
        return "true" if start else "false"
    return repr(float(start)) if row.store is Store.REAL else str(int(start))


def _add_structure(parent: ET.Element, variables: Sequence[Variable]) -> None:
    """Add what is computed: outputs follow from time and state, and what is sent also from inputs.

    ``Tx_Data`` is clocked, so it is no unknown of the initialization.
    """
    inputs = [each.reference for each in variables if each.row.role is Role.INPUT]
    outputs = [each.reference for each in variables if each.row.role is Role.OUTPUT]
    ET.SubElement(parent, "Output", _unknown(TX_DATA, [TX_CLOCK, *inputs]))
    for output in outputs:
        ET.SubElement(parent, "Output", _unknown(output, [TIME]))
    for output in outputs:
        ET.SubElement(parent, "InitialUnknown", _unknown(output, []))


def _unknown(reference: int, dependencies: Iterable[int]) -> dict[str, str]:
    return {
        "valueReference": str(reference),
        "dependencies": " ".join(map(str, dependencies)),
    }


def terminals() -> bytes:
    """Return ``terminalsAndIcons.xml``: the bus with its clocks, data and configuration."""
    root = ET.Element("fmiTerminalsAndIcons", fmiVersion="3.0")
    terminal = ET.SubElement(
        ET.SubElement(root, "Terminals"),
        "Terminal",
        name="CAN",
        matchingRule="org.fmi-ls-bus.transceiver",
        terminalKind="org.fmi-ls-bus.network-terminal",
        description="CAN bus",
    )
    _add_members(terminal, ("Rx_Data", "Tx_Data", "Rx_Clock", "Tx_Clock"))
    configuration = ET.SubElement(
        terminal,
        "Terminal",
        name="Configuration",
        matchingRule="bus",
        terminalKind="org.fmi-ls-bus.network-terminal.configuration",
    )
    _add_members(configuration, ("BusNotifications",))
    return _written(root)


def _add_members(terminal: ET.Element, names: Iterable[str]) -> None:
    for name in names:
        ET.SubElement(
            terminal,
            "TerminalMemberVariable",
            variableName=f"CAN.{name}",
            memberName=name,
            variableKind="signal",
        )


def manifest() -> bytes:
    """Return the manifest of the layered standard."""
    space = "http://fmi-standard.org/fmi-ls-manifest"
    ET.register_namespace("fmi-ls", space)
    attributes = {
        f"{{{space}}}fmi-ls-name": BUS,
        f"{{{space}}}fmi-ls-version": "1.0.0",
        f"{{{space}}}fmi-ls-description": ABOUT_BUS,
        "isBusSimulationFMU": "false",
    }
    return _written(ET.Element("fmiLayeredStandardManifest", attributes))


def build_description(identifier: str, sources: Iterable[str]) -> bytes:
    """Return ``buildDescription.xml`` of C files in the folder ``sources``."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ET.SubElement(root, "BuildConfiguration", modelIdentifier=identifier)
    files = ET.SubElement(configuration, "SourceFileSet", language="C99")
    for name in sources:
        ET.SubElement(files, "SourceFile", name=name)
    ET.SubElement(files, "PreprocessorDefinition", name="NDEBUG", value="1")
    description = "for a shared library: functions of FMI have no prefix"
    override = {"name": "FMI3_OVERRIDE_FUNCTION_PREFIX", "value": "1", "optional": "true"}
    ET.SubElement(files, "PreprocessorDefinition", override, description=description)
    return _written(root)


def _written(root: ET.Element) -> bytes:
    ET.indent(root)
    return ET.tostring(root, encoding="UTF-8", xml_declaration=True) + b"\n"
