"""FMUs for tests: nodes of a CAN bus, compiled from tests/cosimulation/node.c."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import zipfile
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import pytest

SOURCE = Path(__file__).parents[1] / "cosimulation" / "node.c"
#: Environment variable: folder of the official examples (fmi-ls-bus-examples), with the headers of
#: FMI 3.0 and FMI-LS-BUS beside it.
OFFICIAL = "MAPLINES_FMI_LS_BUS_EXAMPLES"
COMPILER = shutil.which("gcc") or shutil.which("clang")
HAS_PLATFORM = (platform.system(), platform.machine()) == ("Linux", "x86_64")
needs_compiler = pytest.mark.skipif(
    COMPILER is None or not HAS_PLATFORM, reason="needs a C compiler on Linux, x86_64"
)
needs_official = pytest.mark.skipif(OFFICIAL not in os.environ, reason=f"{OFFICIAL} is not set")

MIME = 'mimeType="application/org.fmi-standard.fmi-ls-bus.can; version=&quot;1.0.0&quot;"'
TX_CLOCKS = {
    "countdown": '<Clock name="Can.Tx_Clock" valueReference="3" causality="input" '
    'intervalVariability="countdown"/>',
    "fraction": '<Clock name="Can.Tx_Clock" valueReference="3" causality="input" '
    'intervalVariability="countdown" supportsFraction="true" resolution="1000000000"/>',
    "changing": '<Clock name="Can.Tx_Clock" valueReference="3" causality="input" '
    'intervalVariability="changing"/>',
    "constant": '<Clock name="Can.Tx_Clock" valueReference="3" causality="input" '
    'intervalVariability="constant" intervalDecimal="0.05" shiftDecimal="0.05"/>',
    "triggered": '<Clock name="Can.Tx_Clock" valueReference="3" causality="output" '
    'intervalVariability="triggered"/>',
}
MODEL = f"""\
<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="TestNode" instantiationToken="test-node">
  <CoSimulation modelIdentifier="TestNode" hasEventMode="true"
    canHandleVariableCommunicationStepSize="true"/>
  <DefaultExperiment stepSize="0.01"/>
  <ModelVariables>
    <Float64 name="time" valueReference="1024" causality="independent" variability="continuous"/>
    <Binary name="Can.Rx_Data" valueReference="0" causality="input" variability="discrete"
      maxSize="2048" clocks="2" {MIME}><Start value=""/></Binary>
    <Binary name="Can.Tx_Data" valueReference="1" causality="output" variability="discrete"
      maxSize="2048" clocks="3" {MIME}/>
    <Clock name="Can.Rx_Clock" valueReference="2" causality="input"
      intervalVariability="triggered"/>
    TX_CLOCK
    <Boolean name="notifications" valueReference="4" causality="parameter" variability="fixed"
      start="false"/>
    <Float64 name="period" valueReference="10" causality="parameter" variability="fixed"
      start="0.1"/>
    <UInt32 name="can_id" valueReference="11" causality="parameter" variability="fixed"
      start="291"/>
    <Float64 name="gain" valueReference="12" causality="input" variability="discrete" start="0"/>
    <UInt32 name="bit_rate" valueReference="13" causality="parameter" variability="fixed"
      start="0"/>
    <Boolean name="discard" valueReference="14" causality="parameter" variability="fixed"
      start="false"/>
    <Float64 name="fail_at" valueReference="15" causality="parameter" variability="fixed"
      start="1e9"/>
    <Boolean name="corrupt" valueReference="16" causality="parameter" variability="fixed"
      start="false"/>
    <Float64 name="end_at" valueReference="17" causality="parameter" variability="fixed"
      start="1e9"/>
    <String name="name" valueReference="18" causality="parameter" variability="fixed">
      <Start value=""/></String>
    <UInt32 name="received" valueReference="20" causality="output"/>
    <Float64 name="last" valueReference="21" causality="output" variability="discrete">
      <Dimension start="2"/></Float64>
    <Float64 name="last.at" valueReference="22" causality="output" variability="discrete"/>
    <UInt32 name="confirmed" valueReference="23" causality="output"/>
    <UInt32 name="lost" valueReference="24" causality="output"/>
    <UInt32 name="errors" valueReference="25" causality="output"/>
    <Float64 name="store" valueReference="26" causality="input" variability="discrete"
      start="0 0"><Dimension start="2"/></Float64>
  </ModelVariables>
  <ModelStructure>
    <Output valueReference="1"/>CLOCK_OUTPUT
    OUTPUTS
    CLOCK_UNKNOWN
  </ModelStructure>
</fmiModelDescription>
"""
REFERENCES = (20, 21, 22, 23, 24, 25)
TERMINALS = """\
<?xml version="1.0" encoding="UTF-8"?>
<fmiTerminalsAndIcons fmiVersion="3.0"><Terminals>
  <Terminal terminalKind="org.fmi-ls-bus.network-terminal" name="Can"
    matchingRule="org.fmi-ls-bus.transceiver">
    <TerminalMemberVariable memberName="Rx_Clock" variableKind="signal"
      variableName="Can.Rx_Clock"/>
    <TerminalMemberVariable memberName="Rx_Data" variableKind="signal"
      variableName="Can.Rx_Data"/>
    <TerminalMemberVariable memberName="Tx_Clock" variableKind="signal"
      variableName="Can.Tx_Clock"/>
    <TerminalMemberVariable memberName="Tx_Data" variableKind="signal"
      variableName="Can.Tx_Data"/>
    <Terminal terminalKind="org.fmi-ls-bus.network-terminal.configuration" name="Configuration"
      matchingRule="bus">
      <TerminalMemberVariable variableKind="signal" variableName="notifications"
        memberName="BusNotifications"/>
    </Terminal>
  </Terminal>
</Terminals></fmiTerminalsAndIcons>
"""
MANIFEST = """\
<?xml version="1.0" encoding="UTF-8"?>
<fmiLayeredStandardManifest xmlns:fmi-ls="http://fmi-standard.org/fmi-ls-manifest"
  fmi-ls:fmi-ls-name="org.fmi-standard.fmi-ls-bus" fmi-ls:fmi-ls-version="1.0.0"
  fmi-ls:fmi-ls-description="Layered Standard for the simulation of bus communication on a Physical Signal Abstraction or Network Abstraction based level."
  isBusSimulationFMU="false"/>
"""  # noqa: E501 - the standard has this text


@cache
def library() -> bytes:
    """Return the compiled node."""
    folder = Path(mkdtemp(prefix="maplines-test-node-"))
    try:
        out = folder / "TestNode.so"
        command = [str(COMPILER), "-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-fPIC"]
        subprocess.run([*command, "-shared", str(SOURCE), "-o", str(out)], check=True)
        return out.read_bytes()
    finally:
        shutil.rmtree(folder)


def texts(clock: str = "countdown") -> dict[str, str]:
    """Return the XML files of a node, by path in the FMU."""
    unknown = "".join(f'<InitialUnknown valueReference="{one}"/>' for one in REFERENCES)
    is_output = clock == "triggered"
    model = MODEL.replace("TX_CLOCK", TX_CLOCKS[clock])
    model = model.replace("CLOCK_OUTPUT", '<Output valueReference="3"/>' * is_output)
    model = model.replace("OUTPUTS", "".join(f'<Output valueReference="{i}"/>' for i in REFERENCES))
    triggered = '<InitialUnknown valueReference="3"/>' * is_output
    return {
        "modelDescription.xml": model.replace("CLOCK_UNKNOWN", unknown + triggered),
        "terminalsAndIcons/terminalsAndIcons.xml": TERMINALS,
        "extra/org.fmi-standard.fmi-ls-bus/fmi-ls-manifest.xml": MANIFEST,
    }


def write_node(
    path: Path, clock: str = "countdown", *changes: tuple[str, str], with_binary: bool = True
) -> Path:
    """Write the FMU of a node.

    Args:
        path: of the FMU.
        clock: kind of its Tx clock.
        changes: texts of the XML files to be replaced, and what by; each must be there.
        with_binary: whether it can be run here.
    """
    files = texts(clock)
    for old, new in changes:
        assert any(old in text for text in files.values()), old
        files = {name: text.replace(old, new) for name, text in files.items()}
    with zipfile.ZipFile(path, "w") as fmu:
        for name, text in files.items():
            fmu.writestr(name, text)
        if with_binary:
            fmu.writestr("binaries/x86_64-linux/TestNode.so", library())
    return path


@cache
def official(name: str) -> Path:
    """Return the FMU of an official example, compiled as it stands."""
    examples = Path(os.environ[OFFICIAL])
    headers = [examples.parent / "fmi3" / "headers", examples.parent / "ls-bus" / "headers"]
    sources, described = examples / name / "src", examples / name / "description"
    folder = Path(mkdtemp(prefix="maplines-official-"))
    identifier = "".join(f"{word.capitalize()}" for word in f"demo-{name}".split("-"))
    flags = ["-D_strdup=strdup", "-DFMI3_OVERRIDE_FUNCTION_PREFIX", "-O1", "-w", "-fPIC", "-shared"]
    include = [f"-I{path}" for path in (*headers, sources)]
    binary = folder / f"{identifier}.so"
    files = [str(path) for path in sources.glob("*.c")]
    subprocess.run([str(COMPILER), *flags, *include, *files, "-o", str(binary)], check=True)
    path = folder / f"{name}.fmu"
    with zipfile.ZipFile(path, "w") as fmu:
        fmu.write(described / "modelDescription.xml", "modelDescription.xml")
        terminals = "terminalsAndIcons.xml"
        fmu.write(described / terminals, f"terminalsAndIcons/{terminals}")
        manifest = "fmi-ls-manifest.xml"
        fmu.write(described / manifest, f"extra/org.fmi-standard.fmi-ls-bus/{manifest}")
        fmu.write(binary, f"binaries/x86_64-linux/{binary.name}")
    return path
