"""Lines along a route: those that a car that follows it has, section by section."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplines_can import Polyline, Slot
from maplines_can.maps import LaneTracker, Map, load, town_path, town_tour
from maplines_can.simulation import PoseSource, drive_along
from maplines_can.values.route_lines import RouteLines, RoutePlace


@pytest.fixture(scope="module")
def town() -> Map:
    return load(town_path())


def test_they_are_those_of_a_tracker_but_where_the_lane_changes(town: Map) -> None:
    """On a third of the tour with pose errors: the tracker changes lanes a little later."""
    tour = town_tour(town)
    along, tracker = town.along(tour), LaneTracker(town, tour)
    drive = drive_along(town, tour)
    times = drive.times(1.0)
    times = times[: len(times) // 3]
    source, place = PoseSource((0.3, 0.15, 0.005), seed=1), None
    equal = other = 0
    for t, true_pose in zip(times.tolist(), drive.at(times).pose, strict=True):
        pose = source.pose(t, true_pose).mean
        tracked = tracker.lines(pose).lines
        place = along.locate(pose, place)
        assert place is not None
        own = along.sections[place.section]
        for slot in own.keys() | tracked.keys():
            both = [lines[slot].points for lines in (own, tracked) if slot in lines]
            # Long lines are cut; what is left is a part of them.
            is_same = len(both) == 2 and set(map(tuple, both[0])) <= set(map(tuple, both[1]))
            equal += is_same
            other += not is_same
    assert equal > 1300
    assert other < 0.004 * equal


def test_sections_follow_each_other(town: Map) -> None:
    tour = town_tour(town)
    along = town.along(tour)
    assert along.starts[0] == 0.0
    assert (np.diff(along.starts) >= 0).all()
    assert len(along.starts) == len(along.sections) > len(tour.lanes)
    assert max(len(line.points) for own in along.sections for line in own.values()) <= 2048


LINE = Polyline([[0, 0], [1, 0]])
#: A loop that passes the x axis twice.
LOOP = RouteLines(
    Polyline(np.array([[0, 0], [200, 0], [200, 50], [-50, 50], [-50, 0.5], [200, 0.5]])),
    (0.0, 300.0, 500.0),
    ({}, {Slot.EGO_LEFT: LINE}, {Slot.EGO_RIGHT: LINE}),
)


def test_a_place_is_sought_near_the_last_one() -> None:
    first, second = LOOP.locate([100.0, 0.2, 0.0]), LOOP.locate([100.0, 0.3, 0.0])
    assert first == RoutePlace(0, 100.0)
    assert second is not None
    assert second.section == 2
    assert LOOP.locate([101.0, 0.4, 0.0], first) == RoutePlace(0, 101.0)
    assert LOOP.locate([101.0, 0.1, 0.0], second) == RoutePlace(2, second.s + 1.0)
    assert LOOP.locate([150.0, 50.0, np.pi], first) == RoutePlace(1, 300.0)  # no other one


@given(
    st.floats(-60, 210), st.floats(-15, 65), st.floats(-4, 4), st.none() | st.floats(0, 850)
)  # fmt: skip
def test_it_is_the_nearest_place(x: float, y: float, heading: float, s: float | None) -> None:
    """Beside points at each 0.1 m of the way that lead in about the direction of the car."""
    path, at = LOOP.path, np.arange(0.05, LOOP.path.length, 0.1)
    if s is not None:
        at = at[(at > s - 30) & (at < s + 100)]
    points = np.transpose([np.interp(at, path.distance, values) for values in path.points.T])
    ends = np.transpose([np.interp(at + 0.01, path.distance, values) for values in path.points.T])
    is_along = (ends - points) @ [np.cos(heading), np.sin(heading)] > 0
    distance = np.where(is_along, np.hypot(*(points - [x, y]).T), np.inf).min(initial=np.inf)
    found = LOOP.locate([x, y, heading], None if s is None else RoutePlace(0, s))
    if found is None:
        assert distance > 9.9
    elif s is None or distance < 9.9:
        nearest = [np.interp(found.s, path.distance, values) for values in path.points.T]
        assert np.hypot(*(np.array(nearest) - [x, y])) <= distance + 0.06


@pytest.mark.parametrize("pose", [[0, 0, np.nan], [np.inf, 0, 0], [0, 20, 0], [100, 0, np.pi]])
def test_a_pose_elsewhere_has_no_place(pose: list[float]) -> None:
    assert LOOP.locate(pose) is None


def test_a_pose_of_another_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"shape \(3,\), got \(2,\)"):
        LOOP.locate([0.0, 0.0])
