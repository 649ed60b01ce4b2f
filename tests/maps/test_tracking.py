"""Tracking of a car: slots remain until it changes lanes, and then all change in one cycle."""

import math
from collections.abc import Iterable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from support.lane_maps import WIDTH, crossing, lane, network, pose_on, roundabout

from maplines_can.maps import LaneTracker, Map, Route, TrackedLines
from maplines_can.values.line import Slot
from maplines_can.values.polyline import Polyline

CROSSING = crossing()
RING = roundabout()
EGO = {Slot.EGO_LEFT, Slot.EGO_RIGHT}


def two_lanes(sections: int = 5) -> Map:
    """Return a road of two lanes, "k1" on the left and "k2", in sections of 60 m."""
    lanes, links = [], {}
    for k in range(sections):
        for i in (1, 2):
            lanes.append(lane(f"{k}{i}", (60.0 * k, 0.0, 0.0), 60.0, t=(1.5 - i) * WIDTH))
            links[f"{k}{i}"] = f"{k + 1}{i}" if k + 1 < sections else ""
    return network(*lanes, links=links, rows=[f"{k}1 {k}2" for k in range(sections)])


ROAD = two_lanes()


def drive(
    road_map: Map, poses: Iterable[ArrayLike], route: Route | None = None
) -> list[TrackedLines]:
    """Return the tracked lines along a drive."""
    tracker = LaneTracker(road_map, route)
    return [tracker.lines(pose) for pose in poses]


def along(line: Polyline, step: float = 1.0) -> list[np.ndarray]:
    """Return poses on a line."""
    points = line.resampled(step).points
    dx, dy = np.gradient(points, axis=0).T
    return list(np.column_stack([points, np.arctan2(dy, dx)]))


@pytest.mark.parametrize(("sign", "slots"), [(1, "left"), (-1, "right")])
def test_a_lane_change_changes_all_slots_of_the_lane_in_one_cycle(sign: int, slots: str) -> None:
    """When the car is 0.3 m beyond the boundary."""
    t = -sign * WIDTH / 2 + sign * WIDTH * np.linspace(0, 1, 81)
    tracked = drive(ROAD, [(20.0 + i, y, 0.05 * sign) for i, y in enumerate(t)])

    changes = [i for i, each in enumerate(tracked) if each.lane_changed]
    assert len(changes) == 1
    (at,) = changes
    assert 0.3 <= sign * t[at] < 0.3 + WIDTH / 80 + 1e-9
    assert {*EGO, Slot.CENTRE} <= tracked[at].changed
    assert not any(each.changed for i, each in enumerate(tracked) if i not in (0, at))
    assert slots == ("left" if sign > 0 else "right")


@given(st.lists(st.floats(-0.29, 0.29), min_size=2, max_size=30))
def test_a_car_on_the_boundary_keeps_its_lane(t: list[float]) -> None:
    """Noise of less than 0.3 m changes nothing, wherever it began."""
    tracked = drive(ROAD, [(30.0 + 0.1 * i, y, 0.0) for i, y in enumerate(t)])

    assert len({each.lane for each in tracked}) == 1
    assert not any(each.lane_changed for each in tracked)


def test_a_car_a_little_beyond_the_boundary_changes_after_10_m() -> None:
    """And a car that stands there does not."""
    start = (20.0, -0.5, 0.0)
    standing = drive(ROAD, [start, *[(25.0, 0.1, 0.0)] * 100])
    driving = drive(ROAD, [start, *[(25.0 + 0.5 * i, 0.1, 0.0) for i in range(40)]])

    assert standing[-1].lane == "02"
    assert [i for i, each in enumerate(driving) if each.lane_changed] == [21]


@pytest.mark.parametrize("start", ["in0", "in1", "in2", "in3"])
@pytest.mark.parametrize("turn", [1, 2, 3])
def test_a_crossing_on_a_route_is_no_lane_change(start: str, turn: int) -> None:
    """Straight on and at turns; only the slots that end or begin at the crossing change."""
    goal = f"out{(int(start[2:]) + turn) % 4}"
    route = CROSSING.route(start, goal)
    tracked = drive(CROSSING, along(route.line), route)

    lanes = list(dict.fromkeys(each.lane for each in tracked))
    assert lanes == list(route.lanes)
    assert not any(each.lane_changed for each in tracked)
    assert not any(each.changed & {*EGO, Slot.CENTRE, Slot.ROUTE} for each in tracked[1:])


def test_around_the_ring_and_out() -> None:
    """A roundabout on a route has no lane change, also where the route returns to its start."""
    route = RING.route("in0", "out3")
    tracked = drive(RING, along(route.line), route)

    assert not any(each.lane_changed for each in tracked)
    assert tracked[-1].lane == "out3"
    assert all(Slot.ROUTE in each.lines for each in tracked)
    first = RING.lanes["ring0"]
    route = RING.route(pose_on(first, 20.0), pose_on(first, 10.0))
    tracked = drive(RING, along(route.line)[20:], route)
    assert len(tracked) > 120
    assert not any(each.lane_changed for each in tracked)


def test_a_lane_that_ends_is_left() -> None:
    """At the latest where it has no width."""
    found = network(
        lane("1", length=100.0, t=WIDTH / 2),
        lane("2", length=100.0, t=(-WIDTH / 2, 0.0), width=(WIDTH, 0.0)),
        lane("3", (100.0, 0.0, 0.0), 100.0, t=WIDTH / 2),
        links={"1": "3"},
        rows=["1 2"],
    )
    t = np.linspace(-WIDTH / 2, WIDTH / 2, 100)
    tracked = drive(found, [(5.0 + i, y, 0.035) for i, y in enumerate(t)])

    assert [each.lane for each in tracked if each.lane_changed] == ["1"]
    assert tracked[-1].lane == "3"


def test_lanes_that_merge_and_split() -> None:
    """By links: the way through them is no lane change; leaving the expected branch is one."""
    found = network(
        lane("a", length=100.0),
        lane("ramp", (0.0, -5.0, math.atan(0.05)), math.hypot(100.0, 5.0)),
        lane("b", (100.0, 0.0, 0.0), 100.0),
        lane("c", (200.0, 0.0, 0.0), 100.0),
        lane("exit", (200.0, 0.0, 0.0), 100.0, curvature=-0.004),
        links={"a": "b", "ramp": "b", "b": "c exit"},
    )
    for lanes, changes in (("ramp b c", 0), ("a b c", 0), ("a b exit", 1)):
        names = lanes.split()
        poses = [pose for name in names for pose in along(found.lanes[name].centre)]
        tracked = drive(found, poses)
        on_route = drive(found, poses, found.route(names[0], names[-1]))

        assert sum(each.lane_changed for each in tracked) == changes
        assert sum(each.lane_changed for each in on_route) == 0
        assert tracked[-1].lane == names[-1]


def test_off_the_map_and_back() -> None:
    """There are no lines off the map; afterwards they are new."""
    tracked = drive(
        ROAD, [(20.0, 1.0, 0.0), (20.0, 500.0, 0.0), (21.0, 500.0, 0.0), (20.0, 1.0, 0.0)]
    )
    on, off, still_off, back = tracked

    assert (off.lines, off.lane, off.lane_changed) == ({}, None, True)
    assert off.changed == set(on.lines)
    assert not still_off.lane_changed
    assert not back.lane_changed
    assert back.changed == set(back.lines)


@settings(max_examples=25)
@given(seed=st.integers(0, 10**6), left_to_right=st.booleans())
def test_lines_that_have_not_changed_are_where_they_were(seed: int, left_to_right: bool) -> None:
    """On drives with noise and lane changes, a slot that is not reported as changed has no jump."""
    rng = np.random.default_rng(seed)
    route = ROAD.route(*(("01", "42") if left_to_right else ("02", "41")))
    poses = [pose + rng.normal(0, [0.1, 0.1, 0.01]) for pose in along(route.line)]
    tracked = drive(ROAD, poses, route)

    for before, after in pairwise(tracked):
        for slot in before.lines.keys() & after.lines.keys() - after.changed - {Slot.ROUTE}:
            ys = [each.lines[slot].points[0][1] for each in (before, after)]
            assert ys[0] == pytest.approx(ys[1])
        assert after.lane_changed == (after.changed >= EGO)
    assert sum(each.lane_changed for each in tracked) == 1
