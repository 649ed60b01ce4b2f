"""The command ``maplines restbus``: the example, virtual time, commands over a pipe, errors."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import cantools
import pytest
from support.fixtures import Capture

from maplines_can.bus import read_log
from maplines_can.cli import main
from maplines_can.restbus.config import EXAMPLE

MAPLINES = [sys.executable, "-m", "maplines_can"]
CONFIG = """\
[bus]
interface = "virtual"
[[message]]
name = "Motion"
dbc = "example-car.dbc"
cycle_ms = 10
"""


@pytest.fixture(name="config")
def _config(tmp_path: Path) -> Path:
    path = tmp_path / "restbus.toml"
    path.write_text(CONFIG)
    return path


def test_the_example_runs_as_it_stands(tmp_path: Path, capsys: Capture) -> None:
    assert main(["restbus", "--example"]) == 0
    text = capsys.readouterr().out
    assert text == EXAMPLE.read_text()
    config, log = tmp_path / "restbus.toml", tmp_path / "out.log"
    config.write_text(text)
    arguments = ["restbus", str(config), "--virtual-time", "--json", "--record", str(log)]
    assert main(arguments) == 0
    result = json.loads(capsys.readouterr().out)
    frames = list(read_log(log))
    assert (result["seconds"], result["frames"]) == (20.0, len(frames))
    assert result["commands"] == 5
    assert result["faults"]["lost"] > 100
    database = cantools.database.load_file(EXAMPLE.with_name("example-car.dbc"))
    motion = [frame for frame in frames if frame.can_id == 257 and frame.t_ns < 10_000_000_000]
    assert [frame.t_ns for frame in motion] == [5_000_000 + 20_000_000 * k for k in range(500)]
    speeds = [database.decode_message(257, frame.data)["Speed"] for frame in motion]  # type: ignore[union-attr,call-overload]
    assert speeds == pytest.approx([13.9] * 250 + [27.8] * 250)
    horn = [frame.t_ns // 1_000_000 for frame in frames if frame.can_id == 1024]
    assert horn[:6] == [8000, 8030, 8060, 9000, 9030, 9060]


def test_seconds_seed_and_existing_files(config: Path, capsys: Capture) -> None:
    command = ["restbus", str(config), "--virtual-time"]
    assert main(command) == 1
    assert "--virtual-time needs an end; give --seconds" in capsys.readouterr().err
    assert main([*command, "--seconds", "1"]) == 0
    assert "sent 101 frames in 1.000 s" in capsys.readouterr().out
    assert main([*command, "--seconds", "1", "--record", str(config.with_suffix(".log"))]) == 0
    assert main([*command, "--seconds", "1", "--record", str(config.with_suffix(".log"))]) == 1
    assert "exists already" in capsys.readouterr().err


def test_commands_over_a_pipe_while_it_runs(config: Path) -> None:
    process = subprocess.Popen(
        [*MAPLINES, "restbus", str(config), "--json"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    out, errors = process.communicate("set Motion.Speed 3\nset Motion.Sped 3\nquit\n", timeout=30)
    assert process.returncode == 0
    assert json.loads(out)["commands"] == 1
    assert errors == "maplines: Motion.Sped: Motion has no signal 'Sped'; did you mean 'Speed'?\n"


@pytest.mark.skipif(os.name == "nt", reason="Windows sends no SIGINT to one process")
def test_ctrl_c_ends_it_with_its_counters(config: Path) -> None:
    script = (
        "import signal, sys\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # ignored in the background
        "from maplines_can.cli import main\n"
        "raise SystemExit(main(['restbus', sys.argv[1]]))"
    )
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    command = [sys.executable, "-c", script, str(config)]
    with subprocess.Popen(command, text=True, **pipes) as process:  # type: ignore[call-overload]
        assert "1 message on virtual" in process.stderr.readline()
        process.send_signal(signal.SIGINT)
        out, errors = process.communicate(timeout=30)
    assert (process.returncode, errors) == (0, "")
    assert out.startswith("sent ")
