"""The commands with whole scenes: the pose error and all lines of a cycle in one frame."""

from __future__ import annotations

import json
import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.drive_files import run, town
from support.fixtures import Capture, Patch
from support.secoc_streams import key_file

from maplines_can import Codec, Link, Polyline, Scene, Slot, Transmitter, map_scene, read_lines
from maplines_can.bus import LogWriter
from maplines_can.cli import main
from maplines_can.recordings.plots import panels_of, recorded
from maplines_can.simulation import scenario
from maplines_can.values.line import LeftOut
from maplines_can.wire import SCENE, SCENE2, default_dbc_path

NAME = "maplines-scene.dbc"
DBC = ["--dbc", NAME]
FAST = ["--as-fast-as-possible", "--seconds", "4", "--lines", "8"]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Path of a log of eight lines on a bus that loses frames, and the result of the drive."""
    folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        options = ["--faults", "loss=0.1,seed=1", "--record", "drive.log", "--json"]
        lost: dict[str, Any] = {}
        patch.setattr("builtins.print", lambda text, **_: lost.update(json.loads(text)))
        assert main(["drive", town(folder), *FAST, *DBC, *options]) == 0
    return folder / "drive.log", lost


def scene_with_a_far_line() -> Scene:
    """Return lines of which one is too far beside the car for the message."""
    x = np.linspace(-50.0, 150.0, 101)
    offsets = {Slot.EGO_LEFT: 1.75, Slot.EGO_RIGHT: -1.75, Slot.NEXT_LEFT: 40.0}
    lines = {
        slot: Polyline(np.column_stack([x, np.full_like(x, y)])) for slot, y in offsets.items()
    }
    return map_scene(lines, scenario("production").ego)


def test_demo(capsys: Capture) -> None:
    """CAN FD is implied; six lines take both messages, each with the pose error."""
    assert main(["demo", "--seconds", "0.3", "--lines", "6", "--json", *DBC]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["scene"]["frames"] == {SCENE2: 1, SCENE: 1}
    sent, received = result["sent"], result["received"]
    assert (received["lines"], received["pose_errors"]) == (sent["lines"], sent["frames"])
    assert sent["lines"] == 3 * sent["frames"] > 0
    assert all(1 <= row["sigma_ratio"] < 1.5 for row in result["scene"]["lane"])
    assert main(["demo", "--seconds", "0.1", *DBC]) == 0
    assert re.search(r"frames +1 a cycle, with the pose error", capsys.readouterr().out)


def test_a_log_is_decoded(log: Any, capsys: Capture) -> None:
    """With the DBC that is found; the counters are those of the messages, once for all lines."""
    path, sent = log
    lost = sent["faults"]["lost"]
    assert lost > 5
    assert main(["decode", str(path), "--dbc", "auto", "--scenes"]) == 0
    out, err = capsys.readouterr()
    rows = [json.loads(row) for row in out.splitlines()]
    lines, scenes = ([row for row in rows if key in row] for key in ("slot", "scene"))
    assert f"{NAME}: {sent['frames'] - lost} intact records, with" in err
    assert f"{lost} scene messages lost by their counters; dropped frames: none" in err
    assert re.findall(r"(scene2?): VALID", err) == [SCENE, SCENE2]
    assert {row["slot"] for row in lines} > {"EGO_LEFT", "EDGE_RIGHT", "ROUTE"}
    assert max(len(row["scene"]) for row in scenes) > 4

    table = read_lines(path, dbc=default_dbc_path(NAME))
    _, first = np.unique(table["t_ns"], return_index=True)
    assert (table["ahead"][first].astype(int) - 1).clip(0).sum() == lost
    assert [*table["slot"]] == [row["slot"] for row in lines]


def test_authenticated_logs(tmp_path: Path, monkeypatch: Patch, capsys: Capture) -> None:
    """Three lines a frame; the time stamps complete the freshness values, if they are absolute."""
    monkeypatch.chdir(tmp_path)
    keys = ["--key-file", str(key_file(tmp_path, bytes(range(16)).hex().encode()))]
    drive = [town(tmp_path), *FAST, *DBC, *keys, "--seconds", "2", "--record", "drive.log"]
    sent = run(capsys, *drive)
    assert sent["lines"] <= 3 * sent["frames"]
    for options in ([], ["-o", "drive.csv"]):
        assert main(["decode", "drive.log", *DBC, *keys, *options]) == 0
        assert f"{sent['lines']} lines and {sent['frames']} pose errors" in capsys.readouterr().err
    assert main(["decode", "drive.log", *DBC]) == 1
    assert "whole, but authenticated; take the key of the sender" in capsys.readouterr().err
    text = Path("drive.log").read_text()
    Path("zero.log").write_text(re.sub(r"\((\d+)(\d\.)", r"(\2", text))
    assert main(["decode", "zero.log", *DBC, *keys]) == 1
    assert "a log with absolute time stamps" in capsys.readouterr().err


def test_lines_that_are_left_out_are_named(tmp_path: Path, capsys: Capture) -> None:
    """By a receiver: the frame has the slot and the reason."""
    codec, scene = Codec.from_dbc(default_dbc_path(NAME)), scene_with_a_far_line()
    bus: dict[str, Any] = {"interface": "virtual", "channel": str(tmp_path), "fd": True}
    with Link(**bus) as link, Transmitter(link, codec, period=0.02, fd=True) as transmitter:
        transmitter.publish(scene)
        options = ["--interface", "virtual", "--channel", str(tmp_path), *DBC]
        assert main(["receive", *options, "--count", "40"]) == 0
    out, err = capsys.readouterr()
    assert f"left out: next left ({LeftOut.MEAN})" in err
    assert re.search(r"scene: VALID; \d+ ok", err)
    assert "ego lane" in out
    assert "next left" not in out


def test_a_log_says_what_is_left_out(tmp_path: Path, capsys: Capture) -> None:
    """As rows, as a table, in the summary, and in a plot."""
    codec, scene = Codec.from_dbc(default_dbc_path(NAME)), scene_with_a_far_line()
    path, encoder = tmp_path / "a.log", codec.encoder()
    with LogWriter(path, 1000.0) as log:
        for cycle in range(3):
            for frames in encoder.encode_scene(scene, fd=True).values():
                log.write(frames[0], 1000.0 + 0.05 * cycle)
    assert main(["decode", str(path), *DBC, "--scenes"]) == 0
    out, err = capsys.readouterr()
    rows = [json.loads(row) for row in out.splitlines()]
    assert [row["left_out"] for row in rows if "scene" in row] == 3 * [{"NEXT_LEFT": "MEAN"}]
    assert "; 3 lines left out by the sender;" in err

    scenes = read_lines(path, dbc=codec, scenes=True).scenes
    assert scenes["left_out_next_left"].tolist() == 3 * ["MEAN"]
    assert scenes["left_out_ego_left"].tolist() == 3 * [""]
    recording, _ = recorded(str(path), codec, (20.0,))
    states = panels_of([recording], (20.0,))[-1]
    row = states.rows.index("next left: left out")
    assert [strip.label for strip in states.strips if strip.row == row] == ["MEAN"]
    assert "ego left: left out" not in states.rows
    recording, _ = recorded(str(path), codec, (20.0,), slots=[Slot.EGO_LEFT])
    assert panels_of([recording], (20.0,))[-1].rows == ["ego left"]


def result_of(capsys: Capture, *command: str) -> Any:
    assert main([*command, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_key_leaves_lines_without_a_place(capsys: Capture, tmp_path: Path) -> None:
    """They are told before, and counted."""
    key = tmp_path / "key"
    key.write_text("00112233445566778899aabbccddeeff")
    key.chmod(0o600)
    command = ["send", *DBC, "--interface", "virtual", "--channel", "wholekey", "--count", "2"]
    command += ["--lines", "8", "--key-file", str(key)]
    assert main(command) == 0
    streams = capsys.readouterr()
    assert "the messages have no place for the line" in streams.err
    assert "times, the messages have no place for the line" in streams.out
    assert Counter(result_of(capsys, *command)["left_out"])["PLACE"] >= 2
