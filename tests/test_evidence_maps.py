"""tools/evidence_maps.py on a small map, and it finds wrong slots and lines that are not honest."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import evidence_maps as tool
import line_witness
import numpy as np
import pytest
from drive_files import town
from lane_maps import lane, network, pose_on
from line_witness import seen_from

from maplines_can import Gaussian, Slot, map_lines
from maplines_can.maps import Map

LEFT, RIGHT, NEXT_LEFT, NEXT_RIGHT = tool.SLOTS
QUICK = ["--json", "-n", "60", "--draws", "5"]


def result_of(capsys: Any, *arguments: str, status: int = 0) -> Any:
    assert tool.main([*QUICK, *arguments]) == status
    return json.loads(capsys.readouterr().out)


def test_a_map_meets_the_bounds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """All slots are right, no line is refused; the other files are listed."""
    (tmp_path / "README.md").write_text("A map.")
    (tmp_path / "lines.csv").write_text("line,x,y\n0,0,0\n0,9,0\n")
    (tmp_path / "deep").mkdir()
    path = town(tmp_path / "deep")
    result = result_of(capsys, str(tmp_path))
    row = result["maps"]["map.xodr"]
    assert (row["lanes"], row["poses"], row["slots right"], row["refused"]) == (3, 60, 1.0, 0.0)
    assert row["km"] == pytest.approx(1.2, rel=0.01)
    assert max(row["beyond 3 sigma"].values()) <= 0.02
    assert row["values"]["0"] >= 2 * 5 * 60
    assert [Path(name).name for name in result["not used"]] == ["README.md", "lines.csv"]
    assert result["missed"] == []
    assert result_of(capsys, path)["maps"]["map.xodr"] == row


def test_the_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert tool.main([town(tmp_path), "-n", "20"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("map.xodr ") for line in lines) == 1
    assert lines[-1] == "All bounds are met."


def test_without_a_map_there_is_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.xodr").write_text("<OpenDRIVE>")
    assert tool.main([str(tmp_path)]) == 2
    assert "none of the files is a map" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        tool.main([str(tmp_path / "nowhere")])
    assert "there is no such file" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("one", "other"),
    [
        pytest.param(LEFT, RIGHT, id="left is right"),
        pytest.param(RIGHT, NEXT_RIGHT, id="ego is next"),
        pytest.param(NEXT_LEFT, NEXT_RIGHT, id="wrong side"),
    ],
)
def test_wrong_slots_are_found(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    one: Slot,
    other: Slot,
) -> None:
    """Two lines in each other's slots."""
    lines_of = Map.lines

    def exchanged(road_map: Map, pose: Any) -> Any:
        swap = {one: other, other: one}
        return {swap.get(slot, slot): line for slot, line in lines_of(road_map, pose).items()}

    monkeypatch.setattr(Map, "lines", exchanged)
    monkeypatch.setattr(tool, "MIN_POSES", 50)
    result = result_of(capsys, town(tmp_path), status=1)
    assert result["maps"]["map.xodr"]["slots right"] < 0.9
    assert "of the poses are right" in result["missed"][-1]


def test_the_lines_of_another_lane_are_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Left is left and right is right, but a lane too far to the left."""
    lines_of = Map.lines

    def beside(road_map: Map, pose: Any) -> Any:
        return lines_of(road_map, pose + 3.5 * np.array([-np.sin(pose[2]), np.cos(pose[2]), 0]))

    monkeypatch.setattr(Map, "lines", beside)
    result = result_of(capsys, town(tmp_path))
    assert result["maps"]["map.xodr"]["slots right"] < 0.4


def test_dishonest_lines_are_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sigmas of half the size."""

    def halved(*arguments: Any, **options: Any) -> Any:
        lines = map_lines(*arguments, **options)
        for i, line in enumerate(lines):
            lines[i] = replace(line, gaussian=Gaussian(line.gaussian.mean, line.gaussian.cov / 4))
        return lines

    monkeypatch.setattr(tool, "map_lines", halved)
    monkeypatch.setattr(line_witness, "MIN_VALUES", 100)
    result = result_of(capsys, town(tmp_path), status=1)
    assert any("beyond 3 sigma at x = x_min" in text for text in result["missed"])


def test_the_witness_knows_the_lane_and_those_beside_it() -> None:
    """Also for a car that drives against the direction, and only where the boundaries pass it."""
    found = network(
        lane("l", t=3.5), lane("m"), lane("o", t=-3.5, backward=True), rows=["l m"],
        opposite=["m o"], left_hand_traffic=True,
    )  # fmt: skip
    witness = tool.Witness(found)
    pose = pose_on(found.lanes["m"], 50.0, t=0.25)
    expected = {LEFT: 1.5, RIGHT: -2.0, NEXT_LEFT: 5.0, NEXT_RIGHT: -5.5}
    assert witness.expected(found.lanes["m"], pose) == pytest.approx(expected)
    turned = pose + np.array([0, 0, np.pi])
    assert witness.expected(found.lanes["m"], turned) == pytest.approx(
        {RIGHT: -1.5, LEFT: 2.0, NEXT_RIGHT: -5.0, NEXT_LEFT: 5.5}
    )
    assert witness.expected(found.lanes["l"], pose) is None
    assert witness.is_right(expected, pose)
    assert not witness.is_right({LEFT: 1.5, RIGHT: -2.0}, pose)
    assert not witness.is_right(expected | {NEXT_LEFT: 4.5}, pose)
    assert not witness.is_right({slot: -y for slot, y in expected.items()}, pose)


def test_poses_are_on_their_lanes() -> None:
    """Within the offset, and in the direction of the lane."""
    one = lane("1", (10.0, 20.0, 1.0), 100.0, curvature=0.01)
    rng = np.random.default_rng(1)
    for _ in range(50):
        pose = tool.random_pose(one, rng)
        local = seen_from(one.centre.points, pose[None])[0]
        assert np.abs(np.hypot(*local.T)).min() < tool.OFFSET + 1.0
        assert abs(tool.beside(one.centre.points, pose)) <= tool.OFFSET + 0.02
