"""``maplines fmu``: options, files, texts and exit statuses."""

import csv
import json
from contextlib import ExitStack
from pathlib import Path

import can
import pytest
from support import fmus
from support.fixtures import Capture, Patch

from maplines_can.cli import main
from maplines_can.cli.fmu_run import LOG_START, _recorder
from maplines_can.cosimulation import CoSimulation
from maplines_can.cosimulation.bus_operations import Transmit

pytest.importorskip("fmpy")
pytestmark = fmus.needs_compiler


@pytest.fixture
def node(tmp_path: Path, monkeypatch: Patch) -> str:
    monkeypatch.chdir(tmp_path)
    fmus.write_node(tmp_path / "node.fmu")
    return "node.fmu"


def test_check_lists_findings(node: str, capsys: Capture) -> None:
    assert main(["fmu", "check", node]) == 0
    assert capsys.readouterr().out == "node.fmu: no findings\n"
    fmus.write_node(Path("bad.fmu"), "countdown", ('hasEventMode="true"', ""), with_binary=False)
    assert main(["fmu", "check", node, "bad.fmu"]) == 1
    assert "bad.fmu: error: CoSimulation: hasEventMode is not true" in capsys.readouterr().out
    assert main(["fmu", "check", "bad.fmu", "--json"]) == 1
    (finding,) = json.loads(capsys.readouterr().out)["bad.fmu"]
    assert finding["is_error"]


@pytest.mark.parametrize("log", ["can.blf", "can.log", "can.asc"])
def test_run_writes_a_log_and_counters(node: str, log: str, capsys: Capture) -> None:
    command = ["fmu", "run", node, node, "--until", "1", "--log", log, "--bitrate", "500000"]
    assert main([*command, "--set", "node.gain=2.5", "--set", "node_2.can_id=0x200"]) == 0
    out = capsys.readouterr().out
    assert "node.Can: sent 10 frames, received 9, 0 confirmed" in out
    assert "bus: 18 frames, load 0.5 %" in out
    with can.LogReader(log) as reader:
        frames = list(reader)
    assert [frame.arbitration_id for frame in frames] == [0x123, 0x200] * 9
    times = [frame.timestamp - LOG_START.get(Path(log).suffix, 0.0) for frame in frames[:2]]
    assert times == pytest.approx([0.10027, 0.10054], abs=1.1e-6)
    assert main([*command]) == 1
    assert "exists already" in capsys.readouterr().err


def test_run_reads_inputs_and_writes_outputs(node: str) -> None:
    Path("in.csv").write_text("time,node.gain,node_2.store\n0,1,\n0.15,2,1 2\n")
    command = ["fmu", "run", node, node, "--until", "0.3", "--step", "0.1", "--input", "in.csv"]
    assert main([*command, "--output", "out.csv"]) == 0
    rows = list(csv.DictReader(Path("out.csv").read_text().splitlines()))
    assert [float(row["time"]) for row in rows] == [0.0, 0.1, 0.2, 0.3]
    assert [float(row["node_2.last[1]"]) for row in rows] == [0.0, 1.0, 2.0, 2.0]
    assert [int(row["node_2.received"]) for row in rows] == [0, 1, 2, 3]


def test_run_injects_faults(node: str, capsys: Capture) -> None:
    command = ["fmu", "run", node, node, "--until", "1", "--faults", "loss=0.5,seed=1", "--json"]
    assert main(command) == 0
    result = json.loads(capsys.readouterr().out)
    lost = result["faults"]["lost"]
    assert 0 < lost < 20
    assert result["frames"] == 20 - lost
    assert result["nodes"]["node.Can"]["sent"] == 10


def test_ctrl_c_ends_the_run_with_its_counters(
    node: str, capsys: Capture, monkeypatch: Patch
) -> None:
    advance = CoSimulation.advance

    def interrupted(self: CoSimulation, end_ns: int) -> None:
        advance(self, end_ns)
        if self.now >= 0.35:
            raise KeyboardInterrupt

    monkeypatch.setattr(CoSimulation, "advance", interrupted)
    assert main(["fmu", "run", node, node, "--json", "--log", "can.log"]) == 0
    captured = capsys.readouterr()
    assert "stopped by Ctrl-C after 0.350 s" in captured.err
    result = json.loads(captured.out)
    assert result["stopped"]
    assert result["frames"] == 6
    assert len(Path("can.log").read_text().splitlines()) == 6


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["gone.fmu"], "gone.fmu: there is no such file"),
        (["node.fmu", "--set", "node.gain"], "--set must be NODE.VARIABLE=VALUE"),
        (["node.fmu", "--set", "other.gain=1"], "must be NODE.variable; the nodes are node"),
        (["node.fmu", "--log", "can.txt"], "cannot be written in the format '.txt'"),
        (["node.fmu", "--input", "bad.csv"], "line 3: time must not fall, got 0 after 1 s"),
        (["node.fmu", "--input", "empty.csv"], "the first column must be 'time'"),
        (["bad.fmu"], "hasEventMode is not true; networked FMUs shall set it to true"),
    ],
)
def test_errors_are_one_line(node: str, options: list[str], message: str, capsys: Capture) -> None:
    fmus.write_node(Path("bad.fmu"), "countdown", ('hasEventMode="true"', ""))
    Path("bad.csv").write_text("time,node.gain\n1,2\n0,1\n")
    Path("empty.csv").touch()
    assert main(["fmu", "run", *options]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


def test_findings_are_noted_if_they_are_ignored(node: str, capsys: Capture) -> None:
    fmus.write_node(Path("odd.fmu"), "countdown", ('"1.0.0"', '"1.0.0-beta.1"'))
    assert main(["fmu", "run", "odd.fmu", "--until", "0.1"]) == 1
    assert "--ignore-findings runs it all the same" in capsys.readouterr().err
    assert main(["fmu", "run", "odd.fmu", node, "--until", "0.1", "--ignore-findings"]) == 0
    assert "odd.fmu: error: manifest: fmi-ls-version" in capsys.readouterr().err


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf"])
def test_a_log_has_the_length_that_a_remote_frame_asks_for(tmp_path: Path, suffix: str) -> None:
    """Whether or not the operation had data."""
    path = tmp_path / f"can{suffix}"
    with ExitStack() as stack:
        record = _recorder(stack, str(path))
        record(Transmit(0x12, b"", is_remote=True, requested=4), 0.5)
        record(Transmit(0x12, bytes(2), is_remote=True, requested=2), 0.6)
    with can.LogReader(path) as reader:
        found = [(message.is_remote_frame, message.dlc) for message in reader]
    assert found == [(True, 4), (True, 2)]
