"""Scenes of maps and random roads: where they are, their errors, and that they are reproducible."""

import math
from pathlib import Path

import numpy as np
import pytest

from maplines_can import maps
from maplines_can.maps.tour import town_path
from maplines_can.study.scenes.map_scenes import (
    MAPS,
    OFFSET,
    POSES,
    ROADS,
    SLOTS,
    drawn_scenes,
    drivable,
    maps_of,
    random_pose,
)
from maplines_can.study.scenes.random_scenes import POSE_FACTOR
from maplines_can.values.errors import StudyError


@pytest.fixture(scope="module")
def town() -> maps.Map:
    return maps.load(town_path())


def test_scenes_are_of_each_source_with_each_error_in_turn(town: maps.Map) -> None:
    """The same seed gives the same ones, another seed others."""
    kinds = len(POSES) * len(MAPS)
    drawn = list(drawn_scenes({"town": town}, kinds, 3))

    assert [one.source for one in drawn] == ["town"] * kinds + [ROADS] * kinds
    assert {(one.pose, one.error) for one in drawn[:kinds]} == {
        (pose, error) for pose in POSES for error in MAPS
    }
    assert all(one.scene.lines and set(one.scene.index) <= {*SLOTS} for one in drawn)
    again = drawn_scenes({"town": town}, kinds, 3)
    assert all((a.scene.cov == b.scene.cov).all() for a, b in zip(drawn, again, strict=True))
    other = next(drawn_scenes({"town": town}, 1, 4, roads=False))
    assert not np.array_equal(other.scene.means, drawn[0].scene.means)


def test_errors_are_of_the_sizes_of_their_kinds(town: maps.Map) -> None:
    """Up to a factor; an exact map has none."""
    for one in drawn_scenes({"town": town}, 12, 1, roads=False):
        *place, turn = POSES[one.pose]
        cov = one.scene.pose_error.cov
        sigma = math.sqrt(cov[0, 0])
        assert place[0] / POSE_FACTOR <= sigma * (1 + 1e-9) <= place[0] * POSE_FACTOR * (1 + 1e-6)
        assert cov[2, 2] >= (math.radians(turn) / POSE_FACTOR) ** 2 * (1 - 1e-6)
        error = one.scene.map_error
        assert error is not None
        assert (error.point_sigma > 0) == (one.error != "exact")
        assert (error.offset_sigma > 0) == (error.heading_sigma > 0) == (one.error == "drift")


def test_a_random_pose_is_on_a_lane_about_in_its_direction(town: maps.Map) -> None:
    """It is beside a centre, and does not point far from its direction."""
    rng, lanes = np.random.default_rng(5), drivable(town)
    for pose in (random_pose(lanes, rng) for _ in range(20)):
        beside = []
        for lane in lanes:
            begin, step = lane.centre.points[:-1], np.diff(lane.centre.points, axis=0)
            share = (((pose[:2] - begin) * step).sum(1) / (step**2).sum(1)).clip(0, 1)
            distance = np.hypot(*(begin + share[:, None] * step - pose[:2]).T)
            turn = pose[2] - np.arctan2(*step[distance.argmin(), ::-1])
            beside.append(distance.min() <= OFFSET + 1e-6 and math.cos(turn) > 0.94)
        assert any(beside)


def test_maps_are_named_by_their_files_and_must_have_lanes(tmp_path: Path) -> None:
    """Two of the same name are told apart."""
    copy = tmp_path / town_path().name
    copy.write_bytes(town_path().read_bytes())
    assert [*maps_of([town_path(), copy])] == [town_path().name, str(copy)]
    lines = tmp_path / "lines.csv"
    lines.write_text("line,x,y\na,0,0\na,10,0\n")
    with pytest.raises(StudyError, match="no lanes to drive on"):
        maps_of([lines])
