"""Lines of a received scene: their valid ranges, ages and covariances."""

import math
from typing import Any

import numpy as np
import pytest
from pose_bits import POSE, PRODUCTION
from scene_layouts import CONDITIONAL, layout_of, scene_code, scene_encoder

from maplines_can import Gaussian, Kind, MapError, MapLine, PoseError, Scene, Slot
from maplines_can.values.seen_lines import SeenLines, valid_ranges
from maplines_can.wire import POSE as OWNER
from maplines_can.wire.records.record import RawRecord
from maplines_can.wire.records.scene_reader import Member, SceneReader

SIGMA = np.array([0.05, 2e-3, 1e-4, 3e-6])
CODE = scene_code(CONDITIONAL)
READER = SceneReader(layout_of(CONDITIONAL), POSE, CODE)


def received(scene: Scene, late_ns: Any = (0, 0), raw_age: int = 5, **raw: int) -> Scene:
    """What the reader makes of an encoded scene; ``raw`` changes values of the Pose record."""
    sent = scene_encoder(CONDITIONAL).encode(scene)
    pose = READER.pose(RawRecord(OWNER, 0, sent.pose | {"Age": raw_age} | raw), 1000)
    members = [
        Member(RawRecord(scene.lines[i].slot, 0, row | {"Kind": scene.lines[i].kind}), 1000 + late)
        for (i, row), late in zip(sent.lines.items(), late_ns, strict=True)
    ]
    return READER.scene(pose, READER.lines(pose, members))


def scene_of(ranges: Any, map_error: MapError | None = None, pose: Any = PRODUCTION) -> Scene:
    means = np.array([[1.75, 0.02, 1e-3, 1e-6], [-1.75, 0.0, -2e-3, 0.0]])
    own: Any = np.diag(SIGMA**2)
    cov: Any = np.kron(np.eye(2), own)
    lines = tuple(
        MapLine(slot, Gaussian(mean, own), kind)
        for slot, mean, kind in zip(
            (Slot.EGO_LEFT, Slot.ROUTE), means, (Kind.SOLID, Kind.VIRTUAL), strict=True
        )
    )
    return Scene(lines, cov, PoseError(pose, 4.0), ranges, map_error)


@pytest.mark.parametrize("heading", [0.0, 1e-3, 2e-3])
@pytest.mark.parametrize("ranges", [[[-20, 80], [-10, 40]], [[0, 3], [5, 60]], [[-20, 1], [2, 4]]])
def test_valid_ranges_end_on_tenths_of_a_metre_inside(ranges: Any, heading: float) -> None:
    """Within those of the errors of pose and map, but for ranges that are shorter than these."""
    scene = scene_of(np.array(ranges, float), MapError(0.02, 0.05, heading))
    found = received(scene)
    step = 2.0 ** POSE["MapHeading"].factor
    assert found.map_error is not None
    assert found.specific_covs is not None
    inside = valid_ranges(
        found.means,
        found.fit_ranges,
        found.pose_error.cov,
        found.specific_covs,
        found.map_error.heading_sigma * step,
    )
    for line, (low, high) in zip(found.lines, inside, strict=True):
        if high - low > 0.3:
            for end, limit, sign in ((line.x_min, low, 1), (line.x_max, high, -1)):
                assert end * 10 == pytest.approx(round(end * 10), abs=1e-9)
                assert -1e-9 <= sign * (end - limit) <= 0.1 + 1e-9
        elif high < low:
            assert line.x_min == line.x_max == pytest.approx((low + high) / 2)
        assert line.x_min <= line.x_max


def test_the_greatest_heading_error_of_a_map_may_be_a_greater_one() -> None:
    """Then as much of it as the variance of Beta has room for shortens the range."""
    greatest = POSE["MapHeading"].raw_max
    scene = scene_of(np.array([[-20.0, 80.0], [-10.0, 40.0]]), MapError(0.02, 0.05, 0.0))
    found, less = (received(scene, MapHeading=raw) for raw in (greatest, greatest - 1))
    assert found.specific_covs is not None
    seen = SeenLines(found.means, found.fit_ranges, found.quartics)
    turn = np.abs(seen.jacobian()[:, 1, 2])
    assert found.map_error is not None
    sigma = np.sqrt(found.specific_covs[:, 1, 1]) / turn
    stated = found.map_error.heading_sigma * 2.0 ** POSE["MapHeading"].factor
    heading = np.maximum(sigma, stated)
    expected = valid_ranges(
        found.means, found.fit_ranges, found.pose_error.cov, found.specific_covs, heading
    )
    for line, (low, high) in zip(found.lines, expected, strict=True):
        assert [line.x_min, line.x_max] == pytest.approx([low, high], abs=0.1 + 1e-9)
    assert found.lines[0].x_max < less.lines[0].x_max + 0.1


@pytest.mark.parametrize("late_ns", [0, 30_000_000, -60_000_000, -10])
def test_the_age_of_a_line_is_that_of_the_pose_when_it_came(late_ns: int) -> None:
    """By the times of their first frames, and never negative; too old remains so."""
    scene = scene_of(np.array([[-20.0, 80.0], [-10.0, 40.0]]))
    age = POSE["Age"].physical_one(5) / 1000
    found = received(scene, (0, late_ns))
    assert found.lines[0].age == pytest.approx(age)
    assert found.lines[1].age == pytest.approx(max(0.0, age + late_ns * 1e-9))
    assert [line.t_ns for line in found.lines] == [1000, 1000 + late_ns]
    old = received(scene, (0, late_ns), POSE["Age"].raw_max)
    assert [line.age for line in old.lines] == [math.inf, math.inf]
    nearly = received(scene, (0, 0), POSE["Age"].raw_max - 1)
    assert math.isfinite(nearly.lines[0].age)


def test_lines_have_their_part_of_the_joint_gaussian() -> None:
    scene = scene_of(np.array([[-20.0, 80.0], [-10.0, 40.0]]), MapError(0.02, 0.05, 1e-3))
    found = received(scene)
    assert [line.slot for line in found.lines] == [Slot.EGO_LEFT, Slot.ROUTE]
    assert [line.kind for line in found.lines] == [Kind.SOLID, Kind.VIRTUAL]
    assert found.pose_error.correlation_time == pytest.approx(4.0, rel=0.5)
    for i, line in enumerate(found.lines):
        block = slice(4 * i, 4 * i + 4)
        assert np.array_equal(line.gaussian.cov, found.cov[block, block])
        assert np.array_equal(line.gaussian.mean, found.means[i])
