"""Scan matching: rays, derivatives, NDT against ICP of small_gicp, and the filter."""

import math
import sys
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from shapely.geometry import LineString, MultiLineString, Point
from support.fixtures import Patch

from maplines_can import Polyline
from maplines_can.localisation.scan_matching import (
    ScanMatch,
    ScanReference,
    match_icp,
    match_ndt,
    simulated_scan,
)
from maplines_can.localisation.scan_matching.match import placed
from maplines_can.localisation.scan_matching.ndt import LikelihoodScore, cells_of
from maplines_can.maps import Landmark, LandmarkKind, Map
from maplines_can.values.errors import MissingExtraError


def house(x: float, y: float, length: float = 12.0, width: float = 8.0) -> Polyline:
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]]) / 2
    return Polyline([x, y] + corners * [length, width])


#: A street along x with houses on both sides, every second one farther back, and poles.
STREET = Map(
    {}, {},
    buildings=tuple(
        house(x + shift, side * (12.0 + x % 40 / 8))
        for x in range(-40, 60, 20)
        for side, shift in ((1, 0), (-1, 7))
    ),
    landmarks=tuple(Landmark(f"{x}", LandmarkKind.POLE, x, 6.0) for x in range(-30, 60, 20)),
)  # fmt: skip
REFERENCE = ScanReference(STREET)
POSE = np.array([3.0, 1.0, 0.2])
START_SIGMA = np.array([0.3, 0.3, math.radians(0.5)])


def methods() -> list[Any]:
    return [pytest.param(match_ndt, id="ndt"), pytest.param(match_icp, id="icp")]


def matched(method: Any, *arguments: Any) -> ScanMatch:
    """Return the match, or skip the test without small_gicp."""
    if method is match_icp:
        pytest.importorskip("small_gicp")
    found: ScanMatch = method(*arguments)
    return found


def scans(n: int, seed: int = 1) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return n scans at POSE, and starts near it."""
    rng = np.random.default_rng(seed)
    return [
        (simulated_scan(REFERENCE, POSE, rng), POSE + START_SIGMA * rng.standard_normal(3))
        for _ in range(n)
    ]


def test_rays_end_at_the_nearest_surface() -> None:
    """As those that shapely intersects with all walls."""
    walls = MultiLineString([LineString(segment) for segment in REFERENCE.segments])
    bearings = np.linspace(-3.0, 3.0, 60)
    found = REFERENCE.ranges(POSE, bearings, 40.0)
    for bearing, distance in zip(bearings, found, strict=True):
        angle = POSE[2] + bearing
        end = POSE[:2] + 40 * np.array([math.cos(angle), math.sin(angle)])
        hits = LineString([POSE[:2], end]).intersection(walls)
        expected = Point(POSE[:2]).distance(hits) if not hits.is_empty else math.nan
        assert distance == pytest.approx(expected, nan_ok=True)


def test_the_derivatives_of_the_score() -> None:
    """Gradient and Hessian by central differences, where no point changes its cell.

    A point counts as one of the map beyond a likelihood of 0.1.
    """
    rng = np.random.default_rng(3)
    points = rng.uniform(-9, 9, (400, 2))
    scan, pose = rng.uniform(-5, 5, (30, 2)), np.array([0.3, -0.2, 0.4])
    grids = [cells_of(points, size, np.ones(2), 0.05) for size in (50.0, 60.0)]
    score = LikelihoodScore(scan, grids)
    far = placed(2 * scan, pose)
    best = np.max([score.likelihood(far, one)[0] for one in grids], axis=0)
    used = LikelihoodScore(2 * scan, grids).terms(pose)[1]
    assert used == (best > 0.1).sum() != (best > 0.3).sum()
    step = 1e-5
    for k in range(3):
        w = step * np.eye(3)[k]
        slope = (score.value(pose + w) - score.value(pose - w)) / (2 * step)
        assert score.gradient(pose)[k] == pytest.approx(slope, abs=1e-6)
        change = (score.gradient(pose + w) - score.gradient(pose - w)) / (2 * step)
        assert score.hessian(pose)[k] == pytest.approx(change, abs=1e-5)


@pytest.mark.parametrize("method", methods())
def test_the_pose_is_found(method: Any) -> None:
    """Within 3 cm and 0.1 deg, from 0.3 m and 0.5 deg away; the covariance covers the errors."""
    squared = []
    for scan, start in scans(8):
        found = matched(method, REFERENCE, scan, start)
        assert found.is_valid
        assert found.used > 0.8 * len(scan)
        e = found.pose - POSE
        assert np.hypot(*e[:2]) < 0.03
        assert abs(e[2]) < math.radians(0.1)
        squared.append(e @ np.linalg.solve(found.cov, e))
    assert np.mean(squared) < 3.7


@pytest.mark.parametrize("method", methods())
@pytest.mark.parametrize("turns", [-2, 1])
def test_the_heading_stays_near_the_start(method: Any, turns: int) -> None:
    scan, start = scans(1)[0]
    found = matched(method, REFERENCE, scan, start + np.array([0, 0, 2 * math.pi * turns]))
    assert found.pose[2] == pytest.approx(POSE[2] + 2 * math.pi * turns, abs=2e-3)


@pytest.mark.parametrize("method", methods())
def test_what_is_not_in_the_map_is_not_valid(method: Any) -> None:
    """Points at random, too few points, and no map within reach."""
    rng = np.random.default_rng(5)
    start = POSE
    assert not matched(method, REFERENCE, rng.uniform(-30, 30, (200, 2)), start).is_valid
    assert not matched(method, REFERENCE, rng.uniform(-30, 30, (9, 2)), start).is_valid
    scan = scans(1)[0][0]
    assert not matched(method, REFERENCE, scan, start + np.array([1e4, 0, 0])).is_valid


@pytest.mark.parametrize("method", methods())
def test_one_wall_does_not_determine_the_place_along_it(method: Any) -> None:
    """The match is not valid, or its variance along the wall is large."""
    wall = ScanReference(Map({}, {}, buildings=(Polyline([[-500, 5], [500, 5]]),)))
    rng = np.random.default_rng(6)
    x = rng.uniform(-20, 20, 200)
    scan = np.column_stack([x, 5 + 0.03 * rng.standard_normal(200)])
    found = matched(method, wall, scan, np.zeros(3))
    assert not found.is_valid or found.cov[0, 0] > 100 * found.cov[1, 1]


@pytest.mark.parametrize(
    ("scan", "start", "match"),
    [
        (np.zeros((40, 3)), np.zeros(3), "scan must be finite with shape"),
        (np.full((40, 2), np.nan), np.zeros(3), "scan must be finite"),
        (np.zeros((40, 2)), np.zeros(2), "start must be finite"),
    ],
)
def test_wrong_arguments_are_refused(scan: Any, start: Any, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        match_ndt(REFERENCE, scan, start)


def test_a_map_without_surfaces_is_refused() -> None:
    with pytest.raises(ValueError, match="neither buildings nor landmarks"):
        ScanReference(Map({}, {}, name="empty"))


@pytest.mark.parametrize("method", methods())
def test_the_error_of_an_object_is_that_of_the_pose(method: Any) -> None:
    """Where the scan sees one house only, from inside, the pose is off by as much as the house."""
    room = ScanReference(Map({}, {}, buildings=(house(0, 0, 20, 14),)))
    scan = simulated_scan(room, POSE, np.random.default_rng(3))
    without, found = (matched(method, room, scan, POSE, (0.0, 0.0, 0.0), e) for e in (0.0, 0.2))
    assert not without.shared.any()
    assert found.shared == pytest.approx(np.diag([0.04, 0.04, 0.0]), rel=0.1, abs=2e-3)
    assert found.cov - found.shared == pytest.approx(without.cov)
    with pytest.raises(ValueError, match="map_error must be finite and 0 m or more"):
        method(room, scan, POSE, map_error=-0.1)


def test_without_small_gicp_the_message_names_the_extra(monkeypatch: Patch) -> None:
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    with pytest.raises(MissingExtraError, match='"scan"'):
        match_icp(REFERENCE, *scans(1)[0])
