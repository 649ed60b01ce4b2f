"""tools/evidence_handover.py on a small map, and it finds handovers."""

import json
from pathlib import Path

import evidence_handover as tool
import pytest
import road_sources
from drive_files import town
from random_roads import random_map

from maplines_can import maps


def test_no_handover_on_a_small_map_and_on_random_roads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(road_sources, "ROADS", ("corner", "roundabout-12m"))
    arguments = [town(tmp_path), "-n", "1", "--seconds", "12", "--json"]
    assert tool.main(arguments) == 0
    result = json.loads(capsys.readouterr().out)
    for name in ("map.xodr", "random: corner", "random: roundabout-12m"):
        assert result[name]["handovers, by reason"] == {}


def test_lines_that_reach_too_far_back_make_it_hand_over(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before a corner, the longest range is the straight road behind the car."""
    monkeypatch.setattr(road_sources, "ROADS", ("corner",))
    arguments = ["-n", "1", "--seed", "1", "--seconds", "25", "--window", "-20", "80", "--json"]
    assert tool.main(arguments) == 1
    result = json.loads(capsys.readouterr().out)
    assert {"RANGE"} <= result["random: corner"]["handovers, by reason"].keys()


def test_a_random_road_is_a_map_of_one_lane() -> None:
    found = random_map("motorway", 1)
    assert isinstance(found, maps.Map)
    assert found.lanes["1"].width == pytest.approx(3.5, abs=0.01)
