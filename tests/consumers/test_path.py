"""Paths beside lines against circles and straight lines."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import Chebyshev

from maplines_can import STREETS, Gaussian, MapLine, Scene, Slot, map_scene
from maplines_can.consumers.path import lane_path, mean_path, path_beside, width_of

LEFT, RIGHT = Slot.EGO_LEFT, Slot.EGO_RIGHT
STILL = Gaussian(np.zeros(3), np.zeros((3, 3)))
COV = np.diag([0.1, 0.002, 1e-5, 1e-8]) ** 2


def line(mean: Any, slot: Slot = LEFT, **rest: Any) -> MapLine:
    return MapLine(slot, Gaussian(mean, COV), **rest)


@given(
    y=st.floats(-4, 4),
    angle=st.floats(-0.3, 0.3),
    distance=st.floats(-2, 2),
    x=st.floats(0, 20),
    shift=st.floats(-1, 1),
    turn=st.floats(-0.3, 0.3),
)
def test_a_straight_line_from_any_pose(
    y: float, angle: float, distance: float, x: float, shift: float, turn: float
) -> None:
    """Offset and heading are those of the pose in the frame of the line."""
    path = path_beside(
        line([y, angle, 0, 0], x_min=-20, x_max=80),
        distance,
        Gaussian([x, shift, turn], np.zeros((3, 3))),
    )
    assert path is not None
    offset = (shift - y) * math.cos(angle) - x * math.sin(angle) - distance
    assert path.offset == pytest.approx(offset, abs=1e-9)
    assert path.heading == pytest.approx(turn - angle, abs=1e-9)
    along = x * math.cos(angle) + (shift - y) * math.sin(angle)
    assert path.reach == pytest.approx(80 / math.cos(angle) - along, abs=1e-6)
    assert path.curvature == pytest.approx(np.zeros(len(path.s)), abs=1e-12)


@pytest.mark.parametrize("bend", [1 / 50, -1 / 50, 1 / 12])
def test_the_curvature_beside_a_bend_is_that_of_the_parallel(bend: float) -> None:
    path = path_beside(line([1.75, 0, bend, 0], x_min=-5, x_max=20), -1.75, STILL)
    assert path is not None
    assert 1 / path.curvature[0] == pytest.approx(1 / bend + 1.75, rel=1e-3)
    assert path.offset == pytest.approx(0, abs=1e-3)


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


def test_the_rest_goes_on_straight_beyond_its_range() -> None:
    rest = Chebyshev([0, 0, 0, 0, 0.05], domain=[5.0, 25.0])
    path = path_beside(line([0, 0, 0, 0], x_min=3.0, x_max=25.0), 0.0, STILL, rest)
    assert path is not None
    slope = -16 * 0.05 * 2 / 20
    expected = -(0.05 - 5.0 * slope) * math.cos(math.atan(slope))
    assert path.offset == pytest.approx(expected, abs=2e-2)
    assert path.heading == pytest.approx(-math.atan(slope), abs=1e-9)
    assert path.curvature[path.s < 4.0] == pytest.approx(0.0, abs=1e-9)


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
    assert (with_quartics < 0.8 * without).all()


def test_the_standard_deviation_is_across_the_path() -> None:
    """At the line's begin its own, ahead by its direction, after a turn of the displacement too."""
    path = path_beside(line([1.75, 0, 0, 0]), 0.0, STILL)
    assert path is not None
    expected = np.hypot(0.1, 0.002 * path.s)
    assert path.sigma[:100] == pytest.approx(expected[:100], rel=1e-3)
    turned = Gaussian(np.zeros(3), np.diag([0.5, 0.0, 0.01]) ** 2)
    path = path_beside(line([0, 0, 0, 0]), 0.0, turned)
    assert path is not None
    assert path.sigma[80] == pytest.approx(math.hypot(0.1, 20 * 0.002, 20 * 0.01), rel=2e-3)


@pytest.mark.parametrize(
    ("x_min", "x_max", "x"),
    [
        pytest.param(0.0, 10.0, 10.1, id="behind-its-end"),
        pytest.param(4.1, 30.0, 0.0, id="far-before-its-begin"),
    ],
)
def test_no_path_outside_of_the_line(x_min: float, x_max: float, x: float) -> None:
    displacement = Gaussian([x, 0, 0], np.zeros((3, 3)))
    assert path_beside(line([1, 0, 0, 0], x_min=x_min, x_max=x_max), 0.0, displacement) is None


def test_a_line_that_begins_a_little_ahead_is_used() -> None:
    path = path_beside(line([1, 0, 0, 0], x_min=3.9, x_max=30.0), -1.0, STILL)
    assert path is not None
    assert path.reach == pytest.approx(30.0)


def seen(name: str) -> Scene:
    lines = {slot: STREETS[name].lines[slot] for slot in (LEFT, RIGHT)}
    ego = Gaussian(np.zeros(3), np.diag([0.1, 0.1, 0.003]) ** 2)
    return map_scene(lines, ego, window=(-4, 60))


@pytest.mark.parametrize(("name", "radius"), [("roundabout-12m", 12.0), ("roundabout-50m", 50.0)])
def test_the_middle_of_a_roundabout(name: str, radius: float) -> None:
    path, width = lane_path(seen(name), STILL)
    assert path is not None
    assert width == pytest.approx(3.5, abs=0.05)
    assert path.offset == pytest.approx(0.0, abs=0.05)
    assert path.heading == pytest.approx(0.0, abs=0.03)
    near = path.s < path.reach / 2
    assert 1 / path.curvature[near].mean() == pytest.approx(radius, rel=0.1)


def test_one_boundary_is_enough_if_the_width_is_known() -> None:
    scene = seen("lane-ends")
    both, width = lane_path(scene, STILL)
    assert both is not None
    one = Scene(scene.lines[:1], scene.cov[:4, :4], scene.pose_error, scene.fit_ranges[:1])
    assert lane_path(one, STILL) == (None, None)
    path, kept = lane_path(one, STILL, width)
    assert path is not None
    assert kept == width
    assert path.offset == pytest.approx(both.offset, abs=0.02)
    assert path.reach > 50


def test_the_line_of_the_route_is_followed_itself() -> None:
    route = line([3.5, 0.1, 0, 0], Slot.ROUTE)
    scene = Scene((route,), COV, seen("exit").pose_error, np.array([[-4.0, 80.0]]))
    path, _ = lane_path(scene, STILL, route=Slot.ROUTE)
    assert path is not None
    assert path.heading == pytest.approx(-0.1)
    assert lane_path(seen("exit"), STILL, 3.5, Slot.ROUTE)[0] is None


@pytest.mark.parametrize("half", [0.9, 3.1])
def test_no_lane_of_an_impossible_width(half: float) -> None:
    lines = (line([half, 0, 0, 0], LEFT), line([-half, 0, 0, 0], RIGHT))
    ranges = np.array([[-4.0, 80.0]] * 2)
    scene = Scene(lines, np.kron(np.eye(2), COV), seen("exit").pose_error, ranges)
    assert width_of(scene) == pytest.approx(2 * half)
    assert lane_path(scene, STILL) == (None, None)


def test_a_mean_path_continues_where_one_ends() -> None:
    short = path_beside(line([0.2, 0, 0.02, 0], x_max=10.0), 0.0, STILL)
    long = path_beside(line([0.0, 0, 0, 0], x_max=40.0), 0.0, STILL)
    assert short is not None
    assert long is not None
    path = mean_path([short, long])
    assert path is not None
    assert path.offset == pytest.approx(-0.1)
    assert path.reach == long.reach
    assert path.curvature_at(np.array([0.0, 5.0, 30.0])) == pytest.approx([0.01, 0.01, 0], abs=1e-3)
    assert mean_path([]) is None
