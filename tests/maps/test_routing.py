"""Routes: the shortest way, lane changes, loops, and none."""

from dataclasses import replace

import numpy as np
import pytest
from support.lane_maps import WIDTH, crossing, lane, network, pose_on, roundabout

from maplines_can.maps import Map
from maplines_can.values.errors import RouteError
from maplines_can.values.line import Kind
from maplines_can.values.polyline import Polyline

CROSSING = crossing()
RING = roundabout()


def motorway(*, kinds: Kind = Kind.DASHED, lengths: tuple[float, ...] = (200.0, 200.0)) -> Map:
    """Return sections "a", "b" ... of three lanes, "a1" on the left; "exit" leaves lane 3."""
    lanes, links, rows = [], {}, []
    x = 0.0
    names = "abcdef"[: len(lengths)]
    for name, after, length in zip(names, [*names[1:], ""], lengths, strict=True):
        for i in (1, 2, 3):
            one = lane(f"{name}{i}", (x, 0.0, 0.0), length, t=-i * WIDTH, kinds=(kinds, kinds))
            lanes.append(one)
            links[one.id] = f"{after}{i}" if after else ""
        rows.append(f"{name}1 {name}2 {name}3")
        x += length
    lanes.append(lane("exit", (x, -3 * WIDTH, 0.0), 50.0, curvature=-0.01))
    links[f"{names[-1]}3"] = "exit"
    return network(*lanes, links=links, rows=rows)


def test_a_route_between_poses_is_as_long_as_the_way() -> None:
    """Start and goal are positions in lanes."""
    start, goal = (CROSSING.lanes[i] for i in ("in0", "out2"))
    route = CROSSING.route(pose_on(start, 30.0, 0.5), pose_on(goal, 25.0))

    assert route.lanes == ("in0", "0>2", "out2")
    assert route.length == pytest.approx(50.0 + 20.0 + 25.0)
    assert (route.start, route.goal) == pytest.approx((30.0, 125.0))


@pytest.mark.parametrize(
    ("start", "goal", "message"),
    [
        pytest.param("out0", "in0", "1 of 20 lanes can be reached", id="no-way"),
        pytest.param("in0", "x", "lane 'x' is not in the map", id="no-such-goal"),
        pytest.param("x", "in0", "lane 'x' is not in the map", id="no-such-start"),
        pytest.param([0, 900, 0], "in0", "no lane is near the start", id="off-the-map"),
        pytest.param("in0", [0, 900, 0], "no lane is near the goal", id="goal-off-the-map"),
    ],
)
def test_a_route_that_is_none(start: object, goal: object, message: str) -> None:
    """The error says why and what to do."""
    with pytest.raises(RouteError, match=message):
        CROSSING.route(start, goal)  # type: ignore[arg-type]


def test_a_route_passes_lanes_and_poses_in_order() -> None:
    """Each part of it is the shortest; without them, it is the direct one."""
    found = motorway(lengths=(200.0,) * 4)
    pose = pose_on(found.lanes["c3"], 100.0)
    passing = found.route("a1", "d1", via=["b2", pose])

    assert found.route("a1", "d1").lanes == ("a1", "b1", "c1", "d1")
    assert "b2" in passing.lanes
    assert passing.lanes.index("b2") < passing.lanes.index("c3")
    assert passing.lanes[-1] == "d1"
    assert [change.is_left for change in passing.changes].count(False) == 2
    assert passing.lanes[: passing.lanes.index("b2") + 1] == found.route("a1", "b2").lanes


def test_a_place_to_pass_must_be_on_the_map() -> None:
    with pytest.raises(RouteError, match="lane 'nowhere' is not in the map"):
        CROSSING.route("in0", "out2", via=["nowhere"])
    with pytest.raises(RouteError, match="no lane is near the via"):
        CROSSING.route("in0", "out2", via=[np.array([1e4, 1e4, 0.0])])


def change_across(*kinds: tuple[float, Kind], exit_s: float = 0.0) -> tuple[float, float] | None:
    """Return from where to where a route changes lanes on 300 m, whose boundary has these kinds."""
    left, right = lane("l", (0.0, 0.0, 0.0), 300.0, t=WIDTH), lane("r", (0.0, 0.0, 0.0), 300.0)
    between = Polyline(right.left.points, kinds)
    lanes = [replace(left, right=between), replace(right, left=between)]
    found = network(*lanes, rows=["l r"])
    try:
        (change,) = found.route([exit_s, WIDTH, 0.0], "r").changes
    except RouteError:
        return None
    return change.start, change.end


@pytest.mark.parametrize(
    ("kinds", "start", "expected"),
    [
        pytest.param([(0, 1), (200, 2)], 0.0, (200, 260), id="where-it-is-dashed"),
        pytest.param([(0, 2), (200, 1)], 0.0, (0, 60), id="at-once"),
        pytest.param([(0, 2), (200, 1)], 170.0, (170, 200), id="rest-of-the-dashes"),
        pytest.param([(0, 5), (100, 2), (140, 5)], 0.0, (100, 140), id="gap-of-a-kerb"),
        pytest.param([(0, 5), (100, 1), (200, 5)], 0.0, (100, 160), id="solid-before-a-kerb"),
        pytest.param([(0, 2), (100, 5)], 150.0, None, id="gap-behind"),
        pytest.param([(0, 5), (100, 6)], 0.0, None, id="closed"),
        pytest.param([(0, 2), (10, 1), (150, 7)], 5.0, (150, 210), id="longest-without-a-line"),
    ],
)
def test_a_lane_change_is_where_the_boundary_permits(
    kinds: list[tuple[float, Kind]], start: float, expected: tuple[float, float] | None
) -> None:
    found = change_across(*kinds, exit_s=start)
    assert found == (None if expected is None else pytest.approx(expected))


def test_the_car_is_on_a_lane_from_half_way_of_a_change() -> None:
    route = motorway().route("a1", "exit")
    begins = dict(zip(route.lanes, route.begins, strict=True))
    first, second = ((change.start + change.end) / 2 for change in route.changes)
    assert (begins["a1"], begins["a2"], begins["a3"]) == pytest.approx((0.0, first, second))
    assert begins["b3"] == pytest.approx(200.0, abs=0.5)


def test_a_route_goes_round_as_often_as_it_is_told() -> None:
    """The same lane can be passed again."""
    twice = RING.route("in1", "out0", via=["ring2", "ring1", "ring2"])

    assert " ".join(twice.lanes) == "in1 ring1 ring2 ring3 ring0 ring1 ring2 ring3 ring0 out0"
    assert twice.length == pytest.approx(sum(RING.lanes[i].length for i in twice.lanes))
