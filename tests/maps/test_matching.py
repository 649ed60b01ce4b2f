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


@pytest.mark.parametrize(
    ("y", "heading", "expected"),
    [
        pytest.param(0.01, 0.0, "left", id="just-left-of-the-boundary"),
        pytest.param(-0.01, 0.0, "right", id="just-right-of-it"),
        pytest.param(-4.5, 0.0, "right", id="beside-the-road"),
        pytest.param(4.0, 0.0, "left", id="a-little-in-the-oncoming-lane"),
        pytest.param(5.25, math.pi, "other", id="oncoming"),
        pytest.param(5.25, 0.0, "other", id="overtaking-in-the-oncoming-lane"),
        pytest.param(-20.0, 0.0, "right", id="far-beside-the-road"),
    ],
)
def test_the_lane_of_a_position(y: float, heading: float, expected: str) -> None:
    """The lane that contains the pose wins; the direction counts up to a metre."""
    match = ROAD.match([100.0, y, heading])

    assert match is not None
    assert match.lane == expected
    assert match.is_against == (expected == "other" and heading == 0.0)


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
    match = CROSSING.match(pose_on(one, share * one.length))

    assert match is not None
    assert match.lane == name


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


@given(y=st.floats(-6.0, 6.0), sigma=st.floats(0.05, 3.0), turn=st.floats(-0.2, 0.2))
def test_probabilities_sum_to_one_and_come_in_order(y: float, sigma: float, turn: float) -> None:
    """Whatever the pose near the road."""
    found = ROAD.match([100.0, y, turn], np.diag([sigma**2, sigma**2, 1e-3]))
    probabilities = [match.probability for match in found]

    assert sum(probabilities) == pytest.approx(1.0, abs=1e-5)
    assert probabilities == sorted(probabilities, reverse=True)


@pytest.mark.parametrize(("y", "sigma"), [(0.0, 0.5), (0.4, 0.5), (1.0, 1.5), (-1.0, 0.3)])
def test_probabilities_against_samples(y: float, sigma: float) -> None:
    """As often as samples of the position are in each of the lanes with the car's direction."""
    found = ROAD.match([100.0, y, 0.0], np.diag([1e-6, sigma**2, 1e-8]))
    probability = {match.lane: match.probability for match in found}
    samples = np.random.default_rng(1).normal(y, sigma, 200_000)
    counts = [np.count_nonzero(abs(samples - c) < WIDTH / 2) for c in (WIDTH / 2, -WIDTH / 2)]
    rest = probability["left"] + probability["right"]

    expected = counts[0] / sum(counts)
    assert probability["left"] / rest == pytest.approx(expected, abs=5e-3)


def test_a_heading_that_is_correlated_with_the_position_moves_it() -> None:
    """Heading to the left while the lane is straight: given the correlation, the car is right."""
    cov = np.array([[1e-4, 0, 0], [0, 0.25, 0.045], [0, 0.045, 0.01]])
    lane_of = [ROAD.match([100.0, 0.0, turn], cov)[0].lane for turn in (0.1, -0.1)]

    assert lane_of == ["right", "left"]


def test_a_long_uncertain_position_has_candidates_along_the_road() -> None:
    """Near the end of a lane, half of the probability is on the next one."""
    found = network(
        lane("1", length=50.0), lane("2", (50.0, 0.0, 0.0), length=50.0), links={"1": "2"}
    )
    one, other = found.match([50.0, 0.0, 0.0], np.diag([4.0, 0.01, 1e-4]))

    assert one.probability == pytest.approx(0.5, abs=1e-3)
    assert {one.lane, other.lane} == {"1", "2"}


def test_the_far_end_of_a_skewed_lane_is_still_in_it() -> None:
    """The area is bounded by the boundaries themselves, not by a mean width."""
    wide = network(lane("1", width=(2.0, 12.0)), lane("2", t=-8.0))

    for s, t in ((195.0, 5.7), (195.0, -5.7), (5.0, 1.0)):
        match = wide.match([s, t, 0.0])
        assert match is not None
        assert (match.lane, match.outside) == ("1", 0.0)


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


@given(st.floats(-100.0, 100.0))
def test_wrapped_angles_have_the_same_direction(angle: float) -> None:
    """In (-pi, pi]."""
    found = wrapped(angle)

    assert -math.pi < found <= math.pi
    assert math.cos(found - angle) == pytest.approx(1.0)
