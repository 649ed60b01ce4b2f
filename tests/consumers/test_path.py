"""Paths beside lines against circles and straight lines."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import Chebyshev

from maplines_can import Gaussian, MapError, MapLine, Polyline, Scene, Slot, map_scene
from maplines_can.consumers.path import Path, lane_path, mean_path, path_beside, width_of
from maplines_can.simulation import STREETS
from maplines_can.values.line import lateral

LEFT, RIGHT = Slot.EGO_LEFT, Slot.EGO_RIGHT
STILL = Gaussian(np.zeros(3), np.zeros((3, 3)))
COV = np.diag([0.1, 0.002, 1e-5, 1e-8]) ** 2


def line(mean: Any, slot: Slot = LEFT, **rest: Any) -> MapLine:
    return MapLine(slot, Gaussian(mean, COV), **rest)


@pytest.mark.parametrize("x", [0.0, 7.3, 31.0])
@pytest.mark.parametrize("quartic", [0.06, -0.03])
def test_the_rest_of_a_cubic_is_part_of_the_path(x: float, quartic: float) -> None:
    """Against the closed form of T_4 in the fit range, beside any point of it."""
    low, high = -4.0, 36.0
    rest = Chebyshev([0, 0, 0, 0, quartic], domain=[low, high])
    given = line([0, 0, 0, 0], x_min=low, x_max=high)
    path = path_beside(given, 0.0, Gaussian([x, 0, 0], np.zeros((3, 3))), rest)
    assert path is not None
    u, du = (2 * x - low - high) / (high - low), 2 / (high - low)
    assert path.offset == pytest.approx(-quartic * (8 * u**4 - 8 * u**2 + 1), abs=1e-3)
    assert path.heading == pytest.approx(-quartic * (32 * u**3 - 16 * u) * du, abs=1e-3)
    assert path.curvature[0] == pytest.approx(quartic * (96 * u**2 - 16) * du**2, abs=1e-3)


def test_the_quartics_bring_the_path_closer_to_the_lane() -> None:
    """Along a street with a corner of 8 m, the middle of the lane is where the car is."""
    lines = {slot: STREETS["corner"].lines[slot] for slot in (LEFT, RIGHT)}
    centre = STREETS["corner"].lines[Slot.CENTRE]
    errors = []
    for along in np.arange(30.0, 90.0, 1.5):
        at = np.array([along - 0.1, along, along + 0.1])
        x, y = (np.interp(at, centre.distance, values) for values in centre.points.T)
        pose = [x[1], y[1], math.atan2(y[2] - y[0], x[2] - x[0])]
        scene = map_scene(lines, Gaussian(pose, np.diag([1e-6] * 3) ** 2), window=(-4.0, 80.0))
        cubics = replace(scene, quartics=np.zeros(len(scene.lines)))
        paths = [lane_path(given, STILL, 3.5)[0] for given in (scene, cubics)]
        errors.append([(path.offset, path.heading) for path in paths if path is not None])
    with_quartics, without = np.sqrt(np.mean(np.square(errors), axis=0))
    assert (with_quartics < 0.85 * without).all()


def seen(name: str) -> Scene:
    lines = {slot: STREETS[name].lines[slot] for slot in (LEFT, RIGHT)}
    ego = Gaussian(np.zeros(3), np.diag([0.1, 0.1, 0.003]) ** 2)
    return map_scene(lines, ego, window=(-4, 60))


def test_the_line_of_the_route_is_followed_itself() -> None:
    route = line([3.5, 0.1, 0, 0], Slot.ROUTE)
    scene = Scene((route,), COV, seen("exit").pose_error, np.array([[-4.0, 80.0]]))
    path, _ = lane_path(scene, STILL, route=Slot.ROUTE)
    assert path is not None
    assert path.heading == pytest.approx(-0.1)
    assert lane_path(seen("exit"), STILL, 3.5, Slot.ROUTE)[0] is None


class Parallel:
    """Dense points at a distance to the left of a cubic, as seen after a displacement."""

    def __init__(self, given: MapLine, distance: float, displacement: Gaussian) -> None:
        x = np.linspace(-3.0, given.x_max, 40_001)
        _, beta, c0, c1 = given.gaussian.mean
        slope = np.tan(beta) + c0 * x + c1 * x**2 / 2
        angle = np.arctan(slope)
        n = np.column_stack([-np.sin(angle), np.cos(angle)])
        points = np.column_stack([x, lateral(given.gaussian.mean, x)]) + distance * n
        dx, dy, turn = displacement.mean
        arm = points - [dx, dy]
        c, d = math.cos(turn), math.sin(turn)
        self.points = arm @ np.array([[c, -d], [d, c]])
        self.angle = angle - turn
        bend = (c0 + c1 * x) * np.cos(angle) ** 3
        self.bend = bend / (1 - distance * bend)
        self.s = np.append(0.0, np.hypot(*np.diff(self.points, axis=0).T).cumsum())
        J = np.column_stack([np.ones_like(x), (1 + np.tan(beta) ** 2) * x, x**2 / 2, x**3 / 6])
        own = np.einsum("ki,ij,kj->k", J, given.gaussian.cov, J) * np.cos(angle) ** 2
        t = np.column_stack([n[:, 1], -n[:, 0]])
        M = np.column_stack([n, (t * arm).sum(axis=1)])
        self.sigma = np.sqrt(own + np.einsum("ki,ij,kj->k", M, displacement.cov, M))
        self.foot = int((self.points**2).sum(axis=1).argmin())


@settings(max_examples=40)
@given(
    st.floats(-4, 4),
    st.floats(-0.2, 0.2),
    st.floats(-0.02, 0.02),
    st.floats(-2e-4, 2e-4),
    st.sampled_from([0.0, -1.75, 1.75, 3.5]),
    st.tuples(st.floats(-2, 15), st.floats(-1, 1), st.floats(-0.4, 0.4)),
)
def test_a_path_is_the_parallel_of_any_cubic(
    y: float, beta: float, c0: float, c1: float, distance: float, moved: Any
) -> None:
    """Offset, heading, reach, and curvature and sigma all along it, against dense points."""
    A = np.array([[0.1, 0, 0, 0], [2e-3, 2e-3, 0, 0], [0, 1e-4, 1e-4, 0], [0, 0, 1e-6, 1e-6]])
    given = MapLine(LEFT, Gaussian([y, beta, c0, c1], A @ A.T), x_min=-1.0, x_max=30.0)
    B = np.array([[0.3, 0.0, 0.0], [0.1, 0.2, 0.0], [0.0, 0.01, 0.01]])
    displacement = Gaussian(moved, B @ B.T)
    dense = Parallel(given, distance, displacement)
    path = path_beside(given, distance, displacement)
    assert path is not None
    foot = dense.foot
    n = np.array([-math.sin(dense.angle[foot]), math.cos(dense.angle[foot])])
    assert path.offset == pytest.approx(-dense.points[foot] @ n, abs=1e-3)
    assert path.heading == pytest.approx(-dense.angle[foot], abs=2e-3)
    s = dense.s - dense.s[foot]
    assert path.reach == pytest.approx(s[-1], abs=0.02)
    assert path.s[0] == 0
    assert (np.diff(path.s) > 0).all()
    assert np.diff(path.s)[1:].max() < 0.5
    at = path.s.clip(max=s[-1])
    assert path.curvature == pytest.approx(np.interp(at, s, dense.bend), abs=2e-4)
    assert path.sigma == pytest.approx(np.interp(at, s, dense.sigma), rel=5e-3)


@pytest.mark.parametrize("gap", [4.0, 4.0 + 1e-9])
def test_a_line_is_used_up_to_four_metres_behind_its_begin(gap: float) -> None:
    """From 3 m behind the car on, as seen from the line's own pose: its cubic goes on."""
    displacement = Gaussian([1.0, 0, 0], np.zeros((3, 3)))
    path = path_beside(line([0, 0, 0, 0], x_min=1.0 + gap, x_max=30.0), 0.0, displacement)
    assert (path is not None) is (gap == 4.0)
    if path is not None:
        assert path.reach == pytest.approx(29.0)
        assert path.offset == 0


@pytest.mark.parametrize("distance", [-40.0, -19.0, 17.0])
def test_a_parallel_does_not_bend_more_than_ten_times(distance: float) -> None:
    """Towards the centre of a bend it has a cusp there; on the other side there is none."""
    given = line([0, 0, 0.05, 0], x_max=1.0)
    path = path_beside(given, distance, Gaussian([-2.5, distance, 0], np.zeros((3, 3))))
    assert path is not None
    bend = 0.05 / math.hypot(1, 0.05) ** 3
    assert path.curvature[-1] == pytest.approx(bend / max(1 - bend * distance, 0.1))


def test_a_path_that_is_moved_keeps_what_is_ahead() -> None:
    """It begins with interpolated values; beyond its end, or within a step of it, there is none."""
    s = np.array([0.0, 1.0, 3.0, 6.0])
    path = Path(0.1, 0.2, s, np.array([0.0, 0.1, 0.2, 0.5]), np.array([1.0, 2.0, 4.0, 7.0]))
    moved = path.moved(2.0, 0.3, 0.4)
    assert moved is not None
    assert moved[:2] == (0.3, 0.4)
    assert moved.s.tolist() == [0.0, 1.0, 4.0]
    assert moved.curvature == pytest.approx([0.15, 0.2, 0.5])
    assert moved.sigma == pytest.approx([3.0, 4.0, 7.0])
    at_a_point = path.moved(3.0, 0.0, 0.0)
    assert at_a_point is not None
    assert at_a_point.s.tolist() == [0.0, 3.0]
    assert path.moved(5.75, 0.0, 0.0) is None
    assert path.moved(5.74, 0.0, 0.0) is not None


def test_a_mean_path_of_two_is_that_of_both_as_far_as_they_reach() -> None:
    """The largest sigma is taken; beyond the shorter one, it is the longer one."""
    one = Path(0.1, 0.0, np.array([0, 2, 4.0]), np.array([0.1, 0.1, 0.3]), np.array([1, 1, 3.0]))
    two = Path(0.3, 0.2, np.arange(0, 9.0, 2), np.full(5, 0.2), np.full(5, 2.0))
    for pair in ([one, two], [two, one]):
        path = mean_path(pair)
        assert path is not None
        assert path[:2] == pytest.approx((0.2, 0.1))
        assert path.s.tolist() == [0, 2, 4, 6, 8]
        assert path.curvature == pytest.approx([0.15, 0.15, 0.25, 0.2, 0.2])
        assert path.sigma == pytest.approx([2, 2, 3, 2, 2])


@pytest.mark.parametrize(
    ("width", "found"), [(2.0, True), (1.99, False), (8.0, True), (8.01, False)]
)
def test_the_widths_of_lanes(width: float, found: bool) -> None:
    """From 2 m to 6 m, of a scene and as given for one boundary."""
    pair = (line([width / 2, 0, 0, 0], LEFT), line([-width / 2, 0, 0, 0], RIGHT))
    ranges, pose = np.array([[-4.0, 80.0]] * 2), seen("exit").pose_error
    both = Scene(pair, np.kron(np.eye(2), COV), pose, ranges)
    path, got = lane_path(both, STILL)
    assert (path is not None) is found
    assert got == (pytest.approx(width) if found else None)
    for i, side in enumerate((1, -1)):
        one = Scene(pair[i : i + 1], COV, pose, ranges[:1])
        path, _ = lane_path(one, STILL, width)
        assert (path is not None) is found
        if path is not None:
            assert path.offset == pytest.approx(0.0, abs=1e-9), side


@given(st.floats(-0.3, 0.3), st.floats(-10, 40), st.floats(0, 10))
def test_the_width_is_across_the_lane(angle: float, low: float, length: float) -> None:
    """At the place where both lines are seen that is nearest to the car, also behind it."""
    high = low + length
    pair = (
        line([2.0, angle, 0.01, 0], LEFT, x_min=low, x_max=100.0),
        line([-2.0, angle, 0.0, 0], RIGHT, x_min=-100.0, x_max=high),
    )
    scene = Scene(
        pair, np.kron(np.eye(2), COV), seen("exit").pose_error, np.array([[-100.0, 100.0]] * 2)
    )
    x = min(max(low, 0.0), high)
    slope = math.tan(angle) + 0.01 * x / 2
    assert width_of(scene) == pytest.approx((4 + 0.005 * x**2) / math.hypot(1, slope))


def test_lines_that_are_nowhere_seen_together_have_no_width() -> None:
    """That of an earlier scene counts: each line is followed in its own range."""
    pair = (
        line([1.75, 0, 0, 0], LEFT, x_min=-4.0, x_max=5.0),
        line([-1.75, 0, 0, 0], RIGHT, x_min=5.5, x_max=40.0),
    )
    ranges, pose = np.array([[-4.0, 80.0]] * 2), seen("exit").pose_error
    scene = Scene(pair, np.kron(np.eye(2), COV), pose, ranges)
    assert width_of(scene) is None
    assert lane_path(scene, STILL) == (None, None)
    path, width = lane_path(scene, STILL, 3.5)
    assert width == 3.5
    assert path is not None
    assert path.offset == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("heading_sigma", [0.005, 0.02])
def test_the_band_has_all_of_the_heading_error_of_the_map(heading_sigma: float) -> None:
    """Whose part in the lateral position grows with the distance, and in T_0 may be next to none.

    The larger one of two lines is taken, which are uncertain by at least that.
    """
    x = np.arange(-150.0, 151.0, 5.0)
    lines = {
        slot: Polyline(np.column_stack([x, np.full_like(x, y)]))
        for slot, y in ((LEFT, 1.75), (RIGHT, -1.75))
    }
    error = MapError(0.05, 0.05, heading_sigma)
    exact = Gaussian(np.zeros(3), 1e-12 * np.eye(3))
    scene = map_scene(lines, exact, window=(-80, 80), map_error=error)
    path, _ = lane_path(scene, STILL)
    assert path is not None
    assert path.sigma[-1] >= heading_sigma * (path.s[-1] - 1.0)
