"""Checks of FMUs: each rule is broken alone, and found."""

import zipfile
from pathlib import Path

import pytest
from support import fmus

from maplines_can.cosimulation import check, read_description
from maplines_can.values.errors import FmuError

SIMULATION = ('isBusSimulationFMU="false"', 'isBusSimulationFMU="true"')
#: Changed text, what it becomes, and the finding.
BROKEN = [
    ('fmi-ls-version="1.0.0"', 'fmi-ls-version="1.0.0-beta.1"', "fmi-ls-version is '1.0.0-beta.1'"),
    ('fmi-ls-version="1.0.0"', 'fmi-ls-version="2.0.0"', "fmi-ls-version is '2.0.0'"),
    ('"org.fmi-standard.fmi-ls-bus"', '"org.other"', "fmi-ls-name is 'org.other'"),
    ("fmi-ls-description=", 'fmi-ls-description="My own." fmi-ls-other=', "another text"),
    ('hasEventMode="true"', "", "hasEventMode is not true"),
    ('StepSize="true"', 'StepSize="false"', "canHandleVariableCommunicationStepSize is not true"),
    ("network-terminal\" name", "other\" name", "none of terminalKind"),
    ("org.fmi-ls-bus.transceiver", "bus.x", "matchingRule is 'bus.x'"),
    ('memberName="Tx_Data"', 'memberName="TxData"', "has the members"),
    ('Data" variableKind="signal"', 'Data" variableKind="inflow"', "variableKind of"),
    ('variableName="Can.Tx_Data"', 'variableName="Gone"', "'Gone', which there is not"),
    ('<Binary name="Can.Tx_Data" valueReference="1" causality="output"',
     '<Binary name="Can.Tx_Data" valueReference="1" causality="local"', "causality is local"),
    ('clocks="3"', 'clocks="2"', "its attribute clocks is 2"),
    ('clocks="3"', "", "its attribute clocks is none"),
    ("version=&quot;1.0.0&quot;", "version=&quot;1.0.0-beta.1&quot;", "mimeType is appl"),
    ("fmi-ls-bus.can;", "fmi-ls-bus.lin;", "fmi-ls-bus.lin"),
    (fmus.MIME, "", "mimeType is missing"),
    ('maxSize="2048" clocks="3"', 'maxSize="20" clocks="3"', "maxSize is 20 bytes"),
    ('maxSize="2048" clocks="3"', 'maxSize="64" clocks="3"', "maxSize is 64 bytes"),
    ('<Start value=""/></Binary>', '<Dimension start="1"/><Start value=""/></Binary>', "an array"),
    ('intervalVariability="triggered"', 'intervalVariability="countdown"', "is countdown"),
    ('"Can.Tx_Clock" valueReference="3" causality="input"',
     '"Can.Tx_Clock" valueReference="3" causality="output"', "causality is output"),
    ('intervalVariability="countdown"', 'intervalVariability="constant"', "has no interval"),
    ('intervalVariability="countdown"', 'intervalVariability="odd"', "ariability is 'odd'"),
    ('<InitialUnknown valueReference="20"/>',
     '<InitialUnknown valueReference="1"/>', "stands under InitialUnknown"),
    ('terminal.configuration"', 'terminal.config"', "terminalKind is"),
    ('name="Configuration"', 'name="Config"', "named 'Config'"),
    ('matchingRule="bus"', 'matchingRule="plug"', "matchingRule is 'plug'"),
    ('memberName="BusNotifications"', 'memberName="BusNotification"', "as BusNotifications"),
    ('name="notifications" valueReference="4" causality="parameter"',
     'name="notifications" valueReference="4" causality="structuralParameter"',
     "is Boolean, structuralParameter, fixed"),
    ('variability="fixed"\n      start="false"/>\n    <Float64', 'variability="fixed"\n      '
     'start="true"/>\n    <Float64', "start is true"),
]  # fmt: skip
#: Findings that break no rule of the standard.
WARNINGS = {"another text", "canHandleVariableCommunicationStepSize is not true", "an array",
            "maxSize is 64 bytes"}  # fmt: skip


def findings(tmp_path: Path, clock: str, *changes: tuple[str, str]) -> list[str]:
    path = fmus.write_node(tmp_path / "node.fmu", clock, *changes, with_binary=False)
    return [str(finding) for finding in check(read_description(path))]


@pytest.mark.parametrize("clock", fmus.TX_CLOCKS)
def test_a_good_node_has_no_findings(tmp_path: Path, clock: str) -> None:
    assert findings(tmp_path, clock) == []


@pytest.mark.parametrize(("old", "new", "found"), BROKEN)
def test_a_broken_rule_is_found(tmp_path: Path, old: str, new: str, found: str) -> None:
    messages = findings(tmp_path, "countdown", (old, new))
    level = "warning" if found in WARNINGS else "error"
    assert [text.partition(":")[0] for text in messages if found in text][:1] == [level], messages


@pytest.mark.parametrize("under", ["InitialUnknown", "Output"])
def test_a_triggered_clock_stands_in_the_model_structure(tmp_path: Path, under: str) -> None:
    (message,) = findings(tmp_path, "triggered", (f'<{under} valueReference="3"/>', ""))
    assert f"clock Can.Tx_Clock: does not stand under {under}" in message


def test_a_bus_simulation_needs_two_terminals_and_says_what_it_sends(tmp_path: Path) -> None:
    messages = findings(tmp_path, "countdown", SIMULATION)
    assert any("two or more" in message for message in messages)
    assert any("it shall be Boolean, calculatedParameter, fixed or output" in m for m in messages)
    there = ("BusNotifications", "Other")
    messages = findings(tmp_path, "countdown", SIMULATION, there)
    assert any("has no member BusNotifications" in message for message in messages)


def test_a_variable_is_in_one_terminal(tmp_path: Path) -> None:
    start, end = fmus.TERMINALS.index("  <Terminal "), fmus.TERMINALS.index("</Terminals>")
    second = fmus.TERMINALS[start:end].replace('name="Can"', 'name="Second"')
    messages = findings(tmp_path, "countdown", ("</Terminals>", f"{second}</Terminals>"))
    assert any("variable Can.Tx_Data is in terminal Can, too" in message for message in messages)


def test_files_that_are_missing_are_found(tmp_path: Path) -> None:
    path = tmp_path / "node.fmu"
    with zipfile.ZipFile(path, "w") as fmu:
        fmu.writestr("modelDescription.xml", fmus.texts()["modelDescription.xml"])
    messages = [str(finding) for finding in check(read_description(path))]
    assert any("fmi-ls-manifest.xml is missing" in message for message in messages)
    assert any("terminalsAndIcons.xml is missing" in message for message in messages)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"no zip", "is no FMU, which is a zip file"),
        ({}, "it has no modelDescription.xml"),
        ({"modelDescription.xml": "<broken"}, "is no XML"),
        ({"modelDescription.xml": '<fmiModelDescription fmiVersion="2.0"/>'}, "FMU of FMI 2.0"),
        (
            {
                "modelDescription.xml": '<fmiModelDescription fmiVersion="3.0"><ModelVariables>'
                '<Clock name="a" valueReference="x"/></ModelVariables></fmiModelDescription>'
            },
            "is wrong",
        ),
    ],
)
def test_what_is_no_fmu_is_refused(tmp_path: Path, content: object, message: str) -> None:
    path = tmp_path / "node.fmu"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif isinstance(content, dict):
        with zipfile.ZipFile(path, "w") as fmu:
            for name, text in content.items():
                fmu.writestr(name, text)
    with pytest.raises(FmuError, match=message):
        read_description(path)


def test_the_former_path_of_the_terminals_is_read(tmp_path: Path) -> None:
    path = tmp_path / "node.fmu"
    with zipfile.ZipFile(path, "w") as fmu:
        for name, text in fmus.texts().items():
            fmu.writestr(name.replace("terminalsAndIcons/", "icons/"), text)
    assert check(read_description(path)) == []
