"""What a car asks of a map, against slow searches, closed forms, and moved and mirrored maps."""

import heapq
import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm
from support.lane_maps import WIDTH, carriageway, crossing, end, lane, network, pose_on, roundabout

from maplines_can.maps import Map
from maplines_can.maps.joints import joined_lines
from maplines_can.maps.lane import LaneType
from maplines_can.maps.lane_graph import DirectedLane, LaneGraph
from maplines_can.maps.matching import locate
from maplines_can.maps.tour import tour_from
from maplines_can.maps.view import link_gaps
from maplines_can.values.line import Kind, Slot
from maplines_can.values.polyline import Polyline

CROSSING, RING = crossing(), roundabout()
SHARP = np.diag([1e-6, 1e-6, 1e-8])
ROAD = network(
    lane("left", t=WIDTH / 2),
    lane("right", t=-WIDTH / 2),
    lane("other", t=3 * WIDTH / 2, backward=True),
    lane("walk", t=-3 * WIDTH / 2, type=LaneType.SIDEWALK),
    rows=["left right"],
    opposite=["left other"],
)
MIRRORED = {
    Slot.EGO_LEFT: Slot.EGO_RIGHT,
    Slot.NEXT_LEFT: Slot.NEXT_RIGHT,
    Slot.EDGE_LEFT: Slot.EDGE_RIGHT,
    Slot.CENTRE: Slot.CENTRE,
    Slot.ROUTE: Slot.ROUTE,
}
MIRRORED |= {other: slot for slot, other in MIRRORED.items()}


# ---- places and probabilities ---------------------------------------------------------------


def nearest(line: Polyline, point: Any) -> tuple[float, float, float, float]:
    """s, t, direction and overshoot, step by step."""
    found = []
    for i, (a, b) in enumerate(pairwise(line.points)):
        d = b - a
        length = math.hypot(*d)
        along = float((point - a) @ d) / length
        cross = float(d[0] * (point - a)[1] - d[1] * (point - a)[0]) / length
        clipped = min(max(along, 0.0), length)
        distance = math.hypot(cross, along - clipped)
        over = along - clipped
        is_end = (i == 0 and over < 0) or (i == len(line.points) - 2 and over > 0)
        t = cross if is_end else math.copysign(distance, cross)
        s = float(line.distance[i]) + clipped
        found.append((distance, s, t, math.atan2(d[1], d[0]), over if is_end else 0.0))
    return min(found)[1:]


@given(st.integers(0, 2**32), st.integers(2, 9), st.integers(1, 4))
def test_the_nearest_place_of_each_of_several_lines(seed: int, points: int, lines: int) -> None:
    rng = np.random.default_rng(seed)
    given_ = [Polyline(np.cumsum(rng.uniform(-1, 2, (points, 2)), axis=0)) for _ in range(lines)]
    at = rng.uniform(-3, 2 * points, 2)
    for line, place in zip(given_, locate(given_, at), strict=True):
        s, t, angle, overshoot = nearest(line, at)
        assert (place.s, abs(place.t)) == pytest.approx((s, abs(t)))
        if np.abs(line.distance[1:-1] - s).min(initial=1.0) > 1e-9:  # else a point of two steps
            found = place.t, place.direction, place.overshoot
            assert found == pytest.approx((t, angle, overshoot))


RNG = np.random.default_rng(0)
ANGLE = np.linspace(0, 18, 5001)
NEAR = 0.01 * np.arange(512)
#: Lines of more than 512 points are searched by boxes: spirals, long steps that lead out of a box,
#: and one between dense points.
LONG = [
    *(5 * ((0.1 + ANGLE / 6) * (np.cos(ANGLE), np.sin(ANGLE))).T[:n] for n in (513, 641, 5001)),
    np.cumsum(RNG.uniform(-9, 10, (700, 2)), axis=0) / 15 - [15, 15],
    np.vstack([np.column_stack([side * (9 + NEAR), 0 * NEAR])[::-side] for side in (-1, 1)]),
]


@given(st.floats(-30, 30), st.floats(-30, 30), st.sampled_from(LONG))
def test_the_nearest_place_of_a_long_line(x: float, y: float, points: Any) -> None:
    """By a search of all steps."""
    line = Polyline(points)
    a, d = line.points[:-1], np.diff(line.points, axis=0)
    share = (((x, y) - a) * d).sum(axis=1) / (d**2).sum(axis=1)
    expected = np.hypot(*(a + share.clip(0, 1)[:, None] * d - (x, y)).T).min()
    (place,) = locate([line], np.array([x, y]))
    assert math.hypot(place.t, place.overshoot) == pytest.approx(expected, abs=1e-9)
    foot = [np.interp(place.s, line.distance, values) for values in line.points.T]
    assert math.dist(foot, (x, y)) == pytest.approx(expected, abs=1e-9)


def in_road(pose: Any, P: Any) -> dict[str, float]:
    """Probabilities of the lanes of ``ROAD``, as the documentation of ``Map.match`` states them."""
    x, y, heading = pose
    weights = {}
    for name, centre, direction in (
        ("left", WIDTH / 2, 0.0),
        ("right", -WIDTH / 2, 0.0),
        ("other", 3 * WIDTH / 2, math.pi),
    ):
        turn = math.remainder(heading - direction, 2 * math.pi)
        prior = 0.01 if abs(turn) > math.pi / 2 else 1.0
        skew = math.remainder(turn, math.pi)
        pp = P[2, 2] + math.radians(5) ** 2
        # Along the x axis of the map, whatever the direction of the lane: y given the skew.
        mean = y - P[1, 2] / pp * skew
        sigma = math.sqrt(max(P[1, 1] - P[1, 2] ** 2 / pp, 1e-6))
        across = np.diff(norm.cdf([centre - WIDTH / 2, centre + WIDTH / 2], mean, sigma))[0]
        along = np.diff(norm.cdf([0.0, 200.0], x, math.sqrt(max(P[0, 0], 1e-6))))[0]
        weights[name] = prior * across * along * math.exp(-0.5 * skew**2 / pp)
    return {name: weight / sum(weights.values()) for name, weight in weights.items()}


@given(
    st.floats(-1, 201),
    st.floats(-4, 8),
    st.sampled_from([0.0, 0.1, -0.2, 3.1, -3.0, 1.4, 1.7]),
    st.floats(0.1, 2),
    st.floats(0.1, 2),
    st.floats(0.01, 0.3),
    st.floats(-0.9, 0.9),
)
def test_the_probability_of_each_lane(
    x: float, y: float, heading: float, sx: float, sy: float, sh: float, r: float
) -> None:
    P = np.array([[sx**2, 0, 0], [0, sy**2, r * sy * sh], [0, r * sy * sh, sh**2]])
    expected = in_road((x, y, heading), P)
    found = ROAD.match([x, y, heading], P)
    # A lane that the search for the nearest ones leaves out has next to no probability.
    assert {m.lane for m in found} >= {name for name, p in expected.items() if p > 2e-3}
    for match in found:
        assert match.probability == pytest.approx(expected[match.lane], abs=2e-3)


def test_the_frame_of_a_covariance_is_that_of_the_map() -> None:
    """A road that is turned with the pose and its covariance has the same probabilities."""
    pose, P = (
        np.array([60.0, 0.5, 0.05]),
        np.array([[4, 0.5, 0], [0.5, 0.6, 0.02], [0, 0.02, 4e-3]]),
    )
    for angle in (0.5, -2.0):
        there, move = moved(ROAD, angle, (1000.0, -500.0))
        R = np.eye(3)
        R[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        here = {m.lane: m.probability for m in ROAD.match(pose, P)}
        found = {m.lane: m.probability for m in there.match(move(pose), R @ P @ R.T)}
        assert found == pytest.approx(here)


@given(
    st.floats(-60, 60), st.floats(-60, 60), st.floats(-4, 4), st.sampled_from(["", "0>1", "in0"])
)
def test_the_match_is_the_cheapest_of_all_lanes(
    x: float, y: float, heading: float, preferred: str
) -> None:
    """By a search of all lanes, with the costs that ``Map.match`` states."""
    costs = {}
    for one in CROSSING.lanes.values():
        places = [nearest(line, (x, y)) for line in (one.left, one.right, one.centre)]
        start = places[2][0] + places[2][3]
        sides = max(0.0, places[0][1], -places[1][1])
        outside = math.hypot(sides, max(0.0, -start, start - one.length))
        turn = abs(math.remainder(heading - places[2][2], 2 * math.pi))
        against = turn > math.pi / 2
        bend = 0.0
        if one.junction:
            bend = abs(
                math.remainder(direction(one.centre, -1) - direction(one.centre, 0), math.tau)
            )
        cost = outside + 2 * min(turn, math.pi - turn) + against + 0.02 * bend
        if one.id == preferred and not against and not outside:
            cost -= 1.0
        costs[one.id] = cost
    match = CROSSING.index.match([x, y, heading], {preferred})
    if match is None:
        return
    assert (
        costs[match.lane] == pytest.approx(min(costs.values()), abs=1e-9)
        or min(costs.values()) > 0.5
    )  # a lane that is a little farther away may be better, but is not looked for


def direction(line: Polyline, step: int) -> float:
    dx, dy = np.diff(line.points, axis=0)[step]
    return math.atan2(dy, dx)


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
def test_a_covariance_that_is_none_is_rejected(cov: Any) -> None:
    """At once, with its value."""
    with pytest.raises(ValueError, match="cov must be a covariance"):
        ROAD.match([0.0, 0.0, 0.0], cov)


def test_a_sharp_covariance_leaves_the_match() -> None:
    """One candidate with probability 1; also without any spread."""
    for cov in (SHARP, np.zeros((3, 3))):
        (match,) = ROAD.match([100.0, 1.0, 0.0], cov)
        assert match.lane == "left"
        assert match.probability == 1.0


@pytest.mark.parametrize("distance", [29.9, 30.1])
def test_a_lane_is_a_match_up_to_thirty_metres(distance: float) -> None:
    """From its centre line."""
    assert (ROAD.match([100.0, -WIDTH / 2 - distance, 0.0]) is not None) is (distance < 30)


@given(st.integers(0, 2**32), st.integers(1, 3))
def test_joints_of_lines_part_by_part(seed: int, lines: int) -> None:
    """A part that begins within 5 cm, in any direction, of the end before it: one point of both."""
    rng = np.random.default_rng(seed)
    given_, expected = [], []
    for _ in range(lines):
        at: Any = rng.uniform(-9, 9, 2)
        parts: list[Any] = []
        points: list[Any] = []
        begins: list[float] = []
        for k in range(rng.integers(1, 5)):
            angle = rng.uniform(0, 2 * math.pi)
            far = rng.choice([0.0, 0.049, 0.051, 0.2])
            start = at + far * np.array([math.cos(angle), math.sin(angle)])
            part = start + np.cumsum(rng.uniform(0, 2, (rng.integers(2, 5), 2)), axis=0) * 1.0
            part = np.vstack([start, part])
            at = part[-1]
            parts.append(part)
            length = np.hypot(*np.diff(np.array(points), axis=0).T).sum() if points else 0.0
            if k and far < 0.05:
                begins.append(length)
                points += [*part[1:]]
            else:
                step = math.hypot(*(part[0] - points[-1])) if points else 0.0
                begins.append(length + step)
                points += [*part]
        given_.append((parts, Kind.SOLID))
        expected.append((np.array(points), begins))
    for (line, got), (want, starts) in zip(joined_lines(given_), expected, strict=True):
        assert np.array_equal(line.points, want)
        assert line.distance == pytest.approx(Polyline(want).distance)
        assert got == pytest.approx(starts)
        assert line.kind == Kind.SOLID


# ---- moved and mirrored maps ------------------------------------------------------------------


def changed(road_map: Map, change: Any, *, is_mirror: bool = False) -> Map:
    """The map with all points changed; a mirror swaps left and right."""
    lanes = {}
    for one in road_map.lanes.values():
        left, right, centre = (
            Polyline(change(line.points), line.kind) for line in (one.left, one.right, one.centre)
        )
        if is_mirror:
            left, right = right, left
        lanes[one.id] = replace(one, left=left, right=right, centre=centre)
        if is_mirror:
            lanes[one.id] = replace(
                lanes[one.id],
                left_neighbour=one.right_neighbour,
                right_neighbour=one.left_neighbour,
            )
    return Map(
        lanes, dict(road_map.roads), left_hand_traffic=road_map.left_hand_traffic is not is_mirror
    )


def moved(road_map: Map, angle: float, shift: Any) -> tuple[Map, Any]:
    """The map after a rotation and a shift, and the function that moves a pose."""
    c, s = math.cos(angle), math.sin(angle)
    R = np.array([[c, -s], [s, c]])

    def move(pose: Any) -> Any:
        return np.append(R @ pose[:2] + shift, pose[2] + angle)

    return changed(road_map, lambda points: points @ R.T + shift), move


MAPS = {
    "crossing": CROSSING,
    "roundabout": RING,
    "road": carriageway(2, 2, sections=3, curvature=0.004),
    "left-hand": carriageway(1, 2, left_hand=True),
    "one-way": carriageway(3, 0),
}
ROUTES = {"crossing": ("in0", "out1"), "roundabout": ("in0", "out2"), "road": ("0:1", "2:2")}


def some_poses(road_map: Map) -> list[tuple[str, Any]]:
    """Poses on each lane, along it and against it, beside its middle."""
    poses = []
    for one in road_map.lanes.values():
        for share, t, turn in ((0.2, 0.4, 0.05), (0.85, -0.9, -0.1), (0.5, 0.3, math.pi - 0.04)):
            poses.append((one.id, pose_on(one, share * one.length, t, turn)))
    return poses


def lines_of(road_map: Map, pose: Any, route: Any) -> dict[Slot, Any]:
    lines = road_map.lines(pose, road_map.route(*route) if route else None)
    return {slot: (line.points, line.kind) for slot, line in lines.items()}


@pytest.mark.parametrize("with_route", [False, True])
@pytest.mark.parametrize("name", MAPS)
def test_a_map_that_is_moved_has_moved_lines(name: str, with_route: bool) -> None:
    """Around each pose; a rotation and a shift of 5000 km change nothing else."""
    found, route = MAPS[name], ROUTES.get(name) if with_route else None
    shift = np.array([5e5, -4e6])
    there, move = moved(found, 1.1, shift)
    c, s = math.cos(1.1), math.sin(1.1)
    for _, pose in some_poses(found)[:: 1 if name != "crossing" else 2]:
        here = lines_of(found, pose, route)
        other = lines_of(there, move(pose), route)
        assert other.keys() == here.keys()
        for slot, (points, kind) in here.items():
            expected, got = points @ np.array([[c, s], [-s, c]]) + shift, other[slot][0]
            if slot == Slot.ROUTE:  # points of two lanes may be one, but for rounding
                for point in got[:: len(got) // 10]:
                    (place,) = locate([Polyline(expected)], point)
                    assert math.hypot(place.t, place.overshoot) < 1e-6
            else:
                assert got == pytest.approx(expected, abs=1e-6)
            assert other[slot][1] == kind


@pytest.mark.parametrize("with_route", [False, True])
@pytest.mark.parametrize("name", MAPS)
def test_a_mirrored_map_has_mirrored_lines(name: str, with_route: bool) -> None:
    """Left is right, and right-hand traffic is left-hand traffic."""
    found, route = MAPS[name], ROUTES.get(name) if with_route else None
    there = changed(found, lambda points: points * [1, -1], is_mirror=True)
    for _, pose in some_poses(found):
        here = lines_of(found, pose, route)
        other = lines_of(there, pose * [1, -1, -1], route)
        assert {MIRRORED[slot] for slot in other} == here.keys()
        for slot, (points, kind) in here.items():
            assert other[MIRRORED[slot]][0] == pytest.approx(points * [1, -1], abs=1e-9)
            assert other[MIRRORED[slot]][1] == kind


# ---- lanes as driven --------------------------------------------------------------------------


@pytest.mark.parametrize("shares", ["both", "left", "right", "none"])
@pytest.mark.parametrize("left_hand", [False, True])
def test_the_side_of_an_opposite_lane(left_hand: bool, shares: str) -> None:
    """By the boundary that both lanes have, or else by where the other one is."""
    side = -1 if left_hand else 1
    gap = {"none": 0.4}.get(shares, 0.0)
    one = lane("a")
    other = lane("b", t=side * (WIDTH + gap), backward=True)
    if shares == "both":  # both boundaries are the same ones, as of a lane for both directions
        other = replace(
            other, left=Polyline(one.left.points[::-1]), right=Polyline(one.right.points[::-1])
        )
    if shares in ("left", "right") and (shares == "right") is not left_hand:
        other = lane("b", t=side * WIDTH, backward=True)
    found = network(one, other, opposite=["a b"], left_hand_traffic=left_hand)
    driven = LaneGraph(found.lanes)[DirectedLane("a")]
    beside = driven.on_right if left_hand else driven.on_left
    assert beside == DirectedLane("b", is_against=True)
    assert (driven.on_left if left_hand else driven.on_right) is None


@pytest.mark.parametrize("turns", [(0.02, -0.01), (-0.02, 0.01), (0.005, 0.0)])
@pytest.mark.parametrize("first", [5.0, 29.0, 31.0, 60.0])
def test_the_straightest_way_is_that_of_the_next_thirty_metres(turns: Any, first: float) -> None:
    """Of two ways that begin alike and then turn, over as many lanes as these are."""
    lanes, links = [lane("in", length=50.0)], {"in": "a0 b0"}
    for name, curvature in zip("ab", turns, strict=True):
        start = (50.0, 0.0, 0.0)
        for k in range(3):
            lanes.append(lane(f"{name}{k}", start, first / 2, curvature=curvature))
            start = end(start, first / 2, curvature)
            links[f"{name}{k}"] = f"{name}{k + 1}" if k < 2 else ""
    found = network(*lanes, links=links)
    best = min("ab", key=lambda name: abs(dict(zip("ab", turns, strict=True))[name]))
    assert LaneGraph(found.lanes).straightest(DirectedLane("in")) == DirectedLane(f"{best}0")


@pytest.mark.parametrize(("turns_at", "is_seen"), [(4, True), (5, True), (6, False)])
def test_a_way_of_short_lanes_is_judged_by_the_first_six(turns_at: int, is_seen: bool) -> None:
    """Of 4 m each: its own first one and five after it; what turns later does not count."""
    lanes, links = [lane("in", (-50.0, 0.0, 0.0), 50.0)], {"in": "a0 b0"}
    for name, bends in (("a", {turns_at: 0.2}), ("b", {0: 0.01})):
        start = (0.0, 0.0, 0.0)
        for k in range(9):
            curvature = bends.get(k, 0.0)
            lanes.append(lane(f"{name}{k}", start, 4.0, curvature=curvature))
            start = end(start, 4.0, curvature)
            links[f"{name}{k}"] = f"{name}{k + 1}" if k < 8 else ""
    found = network(*lanes, links=links)
    assert LaneGraph(found.lanes).straightest(DirectedLane("in")) == DirectedLane(
        "b0" if is_seen else "a0"
    )


@pytest.mark.parametrize("arm", [1, 2, 3])
def test_the_line_of_a_route_is_around_the_car(arm: int) -> None:
    """On each lane of a way round the ring: it passes the car, and ends before it comes again."""
    route = RING.route("in0", f"out{arm}", via=["ring0", "ring1", "ring2", "ring3", "ring0"])
    for place, name in enumerate(route.lanes):
        one = RING.lanes[name]
        line = RING.view.with_route(RING.view.around(DirectedLane(name), (), ()), route, place)[
            Slot.ROUTE
        ]
        pose = pose_on(one, 0.5 * one.length, 0.4)
        (at,) = locate([line], pose[:2])
        assert at.t == pytest.approx(0.4, abs=0.02)
        assert abs(math.remainder(at.direction - pose[2], math.tau)) < 0.1
        ahead, behind = line.length - at.s, at.s
        rest = route.line.length - route.starts[place] - 0.5 * one.length
        turn = 1.3 * math.pi * 20  # more than a line is seen in a ring
        assert ahead <= max(turn, 60.0) + 60
        assert ahead >= min(rest, 20.0) - 0.1
        assert behind >= min(route.starts[place] + 0.5 * one.length, 20.0) - 0.1


@given(st.floats(0, 220), st.booleans())
def test_the_points_of_a_line_up_to_a_place(s: float, is_against: bool) -> None:
    """As driven, and the next one; two at least, and all of them at its end."""
    places = [0.0, 1.0, 3.0, 30.0, 31.0, 100.0, 180.0, 200.0]
    left, right, centre = (Polyline([[x, y] for x in places]) for y in (2.0, -2.0, 0.0))
    one = replace(lane("1"), left=left, right=right, centre=centre)
    line = LaneGraph(network(one).lanes)[DirectedLane("1", is_against)].left
    points = line.points_up_to(s)
    distance = np.append(0.0, np.hypot(*np.diff(line.points, axis=0).T).cumsum())
    count = int((distance < s).sum()) + 1
    assert np.array_equal(points, line.points[: max(2, min(count, len(distance)))])


@given(st.floats(-1, 200), st.sampled_from(["in0", "ring0", "out3"]))
def test_the_lanes_that_can_be_reached(distance: float, name: str) -> None:
    """By a search of all ways, whatever their order."""
    graph = LaneGraph(RING.lanes)
    expected, ways = set(), [(DirectedLane(name), 0.0, frozenset([DirectedLane(name)]))]
    while ways:
        key, way, seen = ways.pop()
        for other in graph[key].successors:
            if way <= distance and other not in seen:
                expected.add(other)
                ways.append((other, way + graph[other].length, seen | {other}))
    assert graph.reachable(DirectedLane(name), distance) == expected


def test_gaps_between_lanes_that_cannot_be_driven_are_not_reported() -> None:
    """Whichever comes first, and those of the drivable lanes after them are."""
    walk = lane("walk", (100.0, 1.0, 0.0), 50.0, type=LaneType.SIDEWALK)
    road = lane("road", (100.0, 1.0, 0.0), 50.0)
    found = network(lane("a", length=100.0), walk, road, links={"a": "walk road", "walk": "road"})
    gaps = [*link_gaps(found.lanes)]
    assert [str(one).split(":")[0] for one in gaps] == ["link of lane a to lane road"]


# ---- routes -----------------------------------------------------------------------------------


def cheapest(road_map: Map, start: str, goal: str, start_s: float) -> float | None:
    """Cost of a route from a place to the end of a lane, as ``Map.route`` states the costs."""
    heap, done = [(0.0, 0, start, start_s)], {}
    number = 0
    while heap:
        cost, _, name, s = heapq.heappop(heap)
        if (name, s) in done:
            continue
        done[name, s] = cost
        if name == goal:
            return cost
        one = road_map.lanes[name]
        room = one.length - s * one.length / one.length
        following = [(cost + room, other, 0.0) for other in one.successors]
        for other, line in ((one.left_neighbour, one.left), (one.right_neighbour, one.right)):
            if other and line.kind not in {Kind.ROAD_EDGE, Kind.KERB, Kind.BARRIER}:
                solid = 1000.0 if line.kind in {Kind.SOLID, Kind.DOUBLE} else 0.0
                following.append((cost + 50 + 5 * max(0.0, 60 - room) + solid, other, s))
        for more in following:
            number += 1
            heapq.heappush(heap, (more[0], number, *more[1:]))
    return None


def cost_of(road_map: Map, lanes: Any, start_s: float) -> float:
    """Cost of a way through lanes up to the begin of the last one."""
    cost, s = 0.0, start_s
    for name, other in pairwise(lanes):
        one = road_map.lanes[name]
        room = one.length - s
        if other in one.successors:
            cost, s = cost + room, 0.0
            continue
        line = one.left if one.left_neighbour == other else one.right
        solid = 1000.0 if line.kind in {Kind.SOLID, Kind.DOUBLE} else 0.0
        cost += 50 + 5 * max(0.0, 60 - room) + solid
    return cost


@given(st.integers(0, 2**32))
def test_routes_on_random_roads_cost_the_least(seed: int) -> None:
    """Sections of three lanes with any kinds of lines and links, by another search."""
    rng = np.random.default_rng(seed)
    kinds = [Kind.DASHED, Kind.DASHED, Kind.SOLID, Kind.DOUBLE, Kind.KERB, Kind.UNKNOWN]
    lanes, links, rows, start = [], {}, [], (0.0, 0.0, 0.0)
    for k in range(4):
        length = float(rng.uniform(20, 150))
        between = [kinds[i] for i in rng.integers(0, 6, 4)]
        for i in range(3):
            lanes.append(
                lane(f"{k}{i}", start, length, t=-i * WIDTH, kinds=(between[i], between[i + 1]))
            )
            if k < 3 and rng.random() < 0.7:
                links[f"{k}{i}"] = f"{k + 1}{i}"
        rows.append(f"{k}0 {k}1 {k}2")
        start = (start[0] + length, 0.0, 0.0)
    found = network(*lanes, links=links, rows=rows)
    begin, goal = f"0{rng.integers(3)}", f"3{rng.integers(3)}"
    s = float(rng.uniform(0, 0.9)) * found.lanes[begin].length
    expected = cheapest(found, begin, goal, s)
    if expected is None:
        return
    one = found.lanes[begin]
    x, y = (np.interp(s, one.centre.distance, v) for v in one.centre.points.T)
    route = found.route([x, y, 0.0], goal)
    assert route.lanes[0] == begin
    assert cost_of(found, route.lanes, s) == pytest.approx(expected, rel=1e-4)
    assert route.start == pytest.approx(s)
    assert route.goal == pytest.approx(route.line.length)
    check_changes(found, route)


def check_changes(road_map: Map, route: Any) -> None:
    """Lane changes follow each other, of 60 m or of the room that there is, as smooth steps."""
    for change in route.changes:
        is_left = road_map.lanes[change.origin].left_neighbour == change.target
        assert change.is_left is is_left
        assert 0 < change.end - change.start <= 60 + 1e-9
    for one, other in pairwise(route.changes):
        assert other.start >= one.end - 1e-9
    x, y = route.line.points.T
    target = -WIDTH * int(route.lanes[0][1]) * np.ones_like(x)
    for change in route.changes:
        # Along the lanes: the line itself is a little longer than they are.
        begin = route.starts[route.lanes.index(change.origin)]
        low, high = (
            at - begin + road_map.lanes[change.origin].centre.points[0, 0]
            for at in (change.start, change.end)
        )
        u = ((x - low) / (high - low)).clip(0, 1)
        step = WIDTH if change.is_left else -WIDTH
        target += step * (3 * u**2 - 2 * u**3)
    assert y == pytest.approx(target, abs=1e-6)


def test_the_lanes_around_a_place_of_a_route() -> None:
    """Those that begin up to a distance behind its start, one more, and those ahead of its end."""
    names = [str(k) for k in range(6)]
    found = network(
        *(lane(name, (50.0 * k, 0.0, 0.0), 50.0) for k, name in enumerate(names)),
        links=dict(pairwise(names)),
    )
    route = found.route("0", "5")
    assert route.starts == pytest.approx([50 * k for k in range(6)])
    assert route.extent(2) == pytest.approx((100.0, 50.0))
    assert route.extent(5) == pytest.approx((250.0, 50.0))
    for behind, ahead in ((0, 0), (49, 49), (51, 51), (60, 120), (500, 500)):
        near = route.around(2, behind, ahead)
        low = next(k for k in range(6) if 50 * k >= 100 - behind)
        first = max(0, low - 1)
        last = max(k for k in range(6) if 50 * k <= 150 + ahead)
        assert (near.start, near.stop) == (first, last + 1)


@pytest.mark.parametrize("seed", range(6))
def test_a_tour_leads_from_place_to_place(seed: int) -> None:
    """Each is drawn from those that can be reached, by distance; where there is none, again."""

    def total(lanes: list[str]) -> float:
        return sum(RING.lanes[one].length for one in lanes)

    tour = tour_from(RING, "ring0", 300.0, np.random.default_rng(seed))
    rng, known = np.random.default_rng(seed), [["ring0"]]
    while total(known[-1]) < 300.0:
        ways: dict[str, list[str]] = {}
        todo = [[known[-1][-1]]]
        while todo:
            way = todo.pop(0)
            for other in RING.lanes[way[-1]].successors:
                if other not in ways or total(way) < total(ways[other][:-1]):
                    ways[other] = [*way, other]
                    todo.append(ways[other])
        reached = sorted(ways.values(), key=lambda way: total(way[:-1]))
        if reached:
            known.append(known[-1] + reached[rng.integers(len(reached))][1:])
        else:
            known.pop()
    assert tour.lanes == tuple(known[-1])


@pytest.mark.parametrize(("y", "near"), [(0.0, ["left", "right"]), (1.75, ["left"]),
                                         (3.5, ["left", "other"]), (-3.4, ["right"])])  # fmt: skip
def test_the_lanes_near_a_pose(y: float, near: list[str]) -> None:
    """Those that it is in, and those less than about two metres from it."""
    assert sorted(match.lane for match in ROAD.index.near([100.0, y, 0.0])) == near
