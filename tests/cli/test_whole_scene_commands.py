"""Commands that send whole scenes: CAN FD by the DBC, two frames for eight lines."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from maplines_can.cli import main
from maplines_can.wire import default_dbc_path

DBC = default_dbc_path("maplines-scene.dbc")
SEND = ["--dbc", str(DBC)]
FIRST, SECOND = 0x379, 0x378


def result_of(capsys: pytest.CaptureFixture[str], *command: str) -> Any:
    assert main([*command, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_drive_writes_two_frames_a_cycle(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Scene2 goes before Scene, whose age has the time in between."""
    log = tmp_path / "drive.log"
    command = ["drive", *SEND, "--lines", "8", "--seconds", "2", "--record", str(log)]
    result = result_of(capsys, *command, "--as-fast-as-possible")
    ids = [int(line.split()[2].partition("##")[0], 16) for line in log.read_text().splitlines()]
    assert ids == [SECOND, FIRST] * result["cycles"]
    assert (result["frames"], result["pose_errors"]) == (len(ids), len(ids))
    assert result["lines"] > 5 * result["cycles"]


def test_a_key_leaves_lines_without_a_place(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """They are told before, and counted."""
    key = tmp_path / "key"
    key.write_text("00112233445566778899aabbccddeeff")
    key.chmod(0o600)
    command = ["send", *SEND, "--interface", "virtual", "--channel", "wholekey", "--count", "2"]
    command += ["--lines", "8", "--key-file", str(key)]
    assert main(command) == 0
    streams = capsys.readouterr()
    assert "the messages have no place for the line" in streams.err
    assert "times, the messages have no place for the line" in streams.out
    assert Counter(result_of(capsys, *command)["left_out"])["PLACE"] >= 2
