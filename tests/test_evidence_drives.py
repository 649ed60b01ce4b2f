"""tools/evidence_drives.py on a short part of the tour, without waiting."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplines_can import Gaussian, MapLine, Slot, maps

TOOLS = Path(__file__).parents[1] / "tools"


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The tool as a module."""
    monkeypatch.syspath_prepend(str(TOOLS))
    import evidence_drives

    return evidence_drives


def line(slot: Slot, y: float, age: float = 0.0) -> MapLine:
    return MapLine(slot, Gaussian([y, 0, 0, 0], 0.01 * np.eye(4)), x_min=-8, x_max=80, age=age)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The folder of a lane change on the motorway, and the process that recorded it."""
    folder = tmp_path_factory.mktemp("drive")
    command = [sys.executable, str(TOOLS / "evidence_drives.py"), "--simulated", "--json"]
    command += ["--route", "3:0:-4..3:0:-3", "--folder", str(folder)]
    return folder, subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)


def test_the_slots_of_a_lane_change_are_right(recorded: Any) -> None:
    """The exit status tells."""
    _, done = recorded
    result = json.loads(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr
    slots = result["slots"]
    assert slots["lane changes of the route"] == len(slots["lane changes seen"]) == 1
    assert "to the left, 3:0:-4 to 3:0:-3" in slots["lane changes seen"][0]
    assert slots["slots with another line"] == result["bus"]["sender"]["slot_changes"] > 0
    assert slots["moments at which slots change"] == slots["all slots right after it"]


def test_a_wrong_slot_is_found(recorded: Any, tool: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """If ego left and ego right are exchanged from the middle of the drive on."""
    road_map = maps.load(maps.town_path())
    route = road_map.route("3:0:-4", "3:0:-3")
    folder, _ = recorded
    lines = tool.decoded(folder / "drive.log")
    exchanged = {Slot.EGO_LEFT: Slot.EGO_RIGHT, Slot.EGO_RIGHT: Slot.EGO_LEFT}
    for i, one in enumerate(lines):
        if 2 * i > len(lines) and one.slot in exchanged:
            lines[i] = replace(one, slot=exchanged[one.slot])
    monkeypatch.setattr(tool, "decoded", lambda _: lines)
    result = tool.slots_of(folder, road_map, route)
    assert result["wrong"]
    assert not result["met"]


def test_a_line_is_followed_from_cycle_to_cycle(tool: Any) -> None:
    """The car drives 1 m and 0.2 m to the left: the same line is 0.2 m more to the right."""
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.2, 0.0]])
    before = {Slot.EGO_LEFT: (line(Slot.EGO_LEFT, 1.75), 0)}
    for y, expected in ((1.55, 0.0), (5.05, 3.5)):
        now = {Slot.EGO_LEFT: (line(Slot.EGO_LEFT, y), 1)}
        jump = tool.jump(before, now, Slot.EGO_LEFT, poses, 1)
        assert jump == pytest.approx(expected, abs=1e-9)
    assert np.isnan(tool.jump(before, {}, Slot.EGO_LEFT, poses, 1))
    assert np.isinf(tool.jump({}, before, Slot.EGO_LEFT, poses, 1))
