"""Matching of poses to lanes: exact coordinates, overlapping lanes, probabilities."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.lane_maps import WIDTH, crossing, lane, network, pose_on

from maplines_can.maps import Map
from maplines_can.maps.lane import LaneType
from maplines_can.maps.matching import locate, wrapped
from maplines_can.values.polyline import Polyline

ROAD = network(
    lane("left", t=WIDTH / 2),
    lane("right", t=-WIDTH / 2),
    lane("other", t=3 * WIDTH / 2, backward=True),
    rows=["left right"],
    opposite=["left other"],
)
CROSSING = crossing()
SHARP = np.diag([1e-6, 1e-6, 1e-8])


@given(
    curvature=st.floats(-0.05, 0.05),
    share=st.floats(0.02, 0.98),
    t=st.floats(-1.7, 1.7),
    turn=st.floats(-1.0, 1.0),
    backward=st.booleans(),
)
def test_coordinates_of_an_arc(
    curvature: float, share: float, t: float, turn: float, backward: bool
) -> None:
    """s, t and the heading are those of the closed form, to the accuracy of the sampling."""
    one = lane("1", (5.0, -3.0, 0.7), 60.0, curvature=curvature, backward=backward)
    s = share * 60.0
    x, y, heading = 5.0, -3.0, 0.7
    along = 60.0 - s if backward else s
    at = heading + curvature * along
    if abs(curvature) > 1e-9:
        x += (math.sin(at) - math.sin(heading)) / curvature
        y -= (math.cos(at) - math.cos(heading)) / curvature
    else:
        x, y = x + along * math.cos(heading), y + along * math.sin(heading)
    driven = at + math.pi if backward else at
    pose = [x - t * math.sin(driven), y + t * math.cos(driven), driven + turn]

    match = network(one).match(pose)

    assert match is not None
    assert match.s == pytest.approx(s, abs=0.02)
    assert match.t == pytest.approx(t, abs=2e-3)
    assert match.heading == pytest.approx(turn, abs=0.01)
    assert match.outside == 0.0
    assert match.margins[:2] == pytest.approx((WIDTH / 2 - t, WIDTH / 2 + t), abs=3e-3)


def test_far_from_all_lanes_there_is_no_match() -> None:
    """Beyond 30 m, and on a map without drivable lanes."""
    assert ROAD.match([100.0, -40.0, 0.0]) is None
    assert ROAD.match([1e300, -1e300, 0.0]) is None
    assert ROAD.match([100.0, -40.0, 0.0], SHARP) == ()
    assert ROAD.lines([100.0, -40.0, 0.0]) == {}
    empty = network(lane("1", type=LaneType.SIDEWALK))
    assert empty.match([0.0, 0.0, 0.0]) is None
    assert Map({}, {}).match([0.0, 0.0, 0.0], SHARP) == ()


@pytest.mark.parametrize(
    "pose", [[0.0, 0.0], [0.0, math.nan, 0.0], [math.inf, 0.0, 0.0], [[0.0, 0.0, 0.0]]]
)
def test_a_pose_that_is_none_is_rejected(pose: list[float]) -> None:
    """At once, with its value."""
    with pytest.raises(ValueError, match="pose must be finite with shape"):
        ROAD.match(pose)


@pytest.mark.parametrize("cov", [np.eye(2), np.full((3, 3), np.nan), -np.eye(3)])
def test_a_covariance_that_is_none_is_rejected(cov: np.ndarray) -> None:
    """At once, with its value."""
    with pytest.raises(ValueError, match="cov must be a covariance"):
        ROAD.match([0.0, 0.0, 0.0], cov)


@pytest.mark.parametrize("name", ["0>1", "0>2", "0>3", "1>0", "3>2"])
@pytest.mark.parametrize("share", [0.6, 0.9])
def test_the_direction_decides_where_lanes_overlap(name: str, share: float) -> None:
    """In a crossing, a car that drives along a lane is matched to it."""
    one = CROSSING.lanes[name]
    pose = pose_on(one, share * one.length)
    match = CROSSING.match(pose)

    assert match is not None
    assert match.lane == name
    likeliest, *_ = CROSSING.match(pose, np.diag([0.04, 0.04, 1e-4]))
    assert (likeliest.lane, likeliest.probability > 0.8) == (name, True)


@pytest.mark.parametrize("turn", [-0.008, 0.0, 0.008])
def test_the_straight_lane_is_preferred_where_the_direction_is_the_same(turn: float) -> None:
    """At the entry of the crossing all three lanes have about the direction of the car."""
    match = CROSSING.match(pose_on(CROSSING.lanes["0>2"], 0.05, turn=turn))

    assert match is not None
    assert match.lane == "0>2"


def test_a_sharp_covariance_leaves_the_match() -> None:
    """One candidate with probability 1; also without any spread."""
    for cov in (SHARP, np.zeros((3, 3))):
        (match,) = ROAD.match([100.0, 1.0, 0.0], cov)
        assert match.lane == "left"
        assert match.probability == 1.0


@given(st.floats(-100.0, 100.0))
def test_wrapped_angles_have_the_same_direction(angle: float) -> None:
    """In (-pi, pi]."""
    found = wrapped(angle)

    assert -math.pi < found <= math.pi
    assert math.cos(found - angle) == pytest.approx(1.0)


SPIRAL = (
    5.0
    * (0.1 + np.linspace(0, 3, 5001))[:, None]
    * np.column_stack([np.cos(6 * np.linspace(0, 3, 5001)), np.sin(6 * np.linspace(0, 3, 5001))])
)


@given(x=st.floats(-30.0, 30.0), y=st.floats(-30.0, 30.0), count=st.sampled_from([513, 641, 5001]))
def test_the_nearest_place_of_a_long_line(x: float, y: float, count: int) -> None:
    """The search by boxes finds the same point as a search of all steps."""
    line = Polyline(SPIRAL[:count])
    a, b = line.points[:-1], line.points[1:]
    share = (((x, y) - a) * (b - a)).sum(axis=1) / ((b - a) ** 2).sum(axis=1)
    feet = a + share.clip(0, 1)[:, None] * (b - a)
    expected = np.hypot(*(feet - (x, y)).T).min()

    (place,) = locate([line], np.array([x, y]))

    assert math.hypot(place.t, place.overshoot) == pytest.approx(expected, abs=1e-9)
    foot = [np.interp(place.s, line.distance, values) for values in line.points.T]
    assert math.dist(foot, (x, y)) == pytest.approx(expected, abs=1e-9)
