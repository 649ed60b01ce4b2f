"""Lines around a car: which slot each one has, and how far they continue."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from support.lane_maps import WIDTH, carriageway, crossing, lane, network, pose_on, roundabout

from maplines_can.maps import LaneTracker, Map, link_gaps, view
from maplines_can.propagation.paths import stretches
from maplines_can.values.line import Kind, Slot
from maplines_can.values.polyline import Polyline

RING, CROSSING = roundabout(), crossing()


def lateral(lines: dict[Slot, Polyline], pose: np.ndarray, x: float = 0.0) -> dict[Slot, float]:
    """Return the lateral positions of the lines at a distance ahead [m]."""
    slots = list(lines)
    seen = stretches(list(lines.values()), pose, (-40.0, 120.0))
    return {
        slots[stretch.line]: stretch.lateral(np.array([x])).item()
        for stretch in seen
        if stretch.x_range[0] <= x <= stretch.x_range[1]
    }


@given(
    forward=st.integers(1, 4),
    backward=st.integers(0, 3),
    left_hand=st.booleans(),
    curvature=st.floats(-0.005, 0.005),
    section_of=st.integers(0, 2),
    lane_of=st.integers(0, 6),
    s=st.floats(5.0, 95.0),
    t=st.floats(-1.6, 1.6),
    turn=st.floats(-0.1, 0.1),
)
def test_slots_are_in_order(
    forward: int,
    backward: int,
    left_hand: bool,
    curvature: float,
    section_of: int,
    lane_of: int,
    s: float,
    t: float,
    turn: float,
) -> None:
    """Left is left, next is beyond ego, and the edges are outermost, by one lane width each."""
    found = carriageway(forward, backward, left_hand=left_hand, curvature=curvature)
    ids = [f"{section_of}:{i}" for i in range(-backward, forward + 1) if i]
    one = found.lanes[ids[lane_of % len(ids)]]
    pose = pose_on(one, s, t, turn)

    lines = found.lines(pose)
    y = lateral(lines, pose)

    # Across all lanes from left to right, as this car sees them.
    count = forward + backward
    i = int(one.id.split(":")[1])
    from_left = backward + i - 1 if i > 0 else -i + forward - 1
    if left_hand:
        from_left = forward - i if i > 0 else backward + i
    assert (Slot.NEXT_LEFT in lines) == (from_left > 0)
    assert (Slot.NEXT_RIGHT in lines) == (from_left < count - 1)
    expected = {
        Slot.EGO_LEFT: 0.5,
        Slot.EGO_RIGHT: -0.5,
        Slot.CENTRE: 0.0,
        Slot.NEXT_LEFT: 1.5,
        Slot.NEXT_RIGHT: -1.5,
        Slot.EDGE_LEFT: from_left + 0.5,
        Slot.EDGE_RIGHT: from_left + 0.5 - count,
    }
    for slot in lines:
        at = (expected[slot] * WIDTH - t) / math.cos(turn)
        assert y[slot] == pytest.approx(at, abs=0.1 + abs(at) * 0.02)


def lane_that_ends() -> Map:
    """Return two lanes, of which the right one narrows to nothing in section b."""
    return network(
        lane("a1", length=100.0, t=WIDTH / 2),
        lane("a2", length=100.0, t=-WIDTH / 2),
        lane("b1", (100.0, 0.0, 0.0), 60.0, t=WIDTH / 2),
        lane("b2", (100.0, 0.0, 0.0), 60.0, t=(-WIDTH / 2, 0.0), width=(WIDTH, 0.0)),
        lane("c1", (160.0, 0.0, 0.0), 100.0, t=WIDTH / 2),
        links={"a1": "b1", "a2": "b2", "b1": "c1"},
        rows=["a1 a2", "b1 b2"],
    )


@pytest.mark.parametrize("name", ["0>1", "0>2", "0>3"])
def test_in_a_crossing_the_route_decides(name: str) -> None:
    """At its entry, where the lanes overlap and have the same direction."""
    route = CROSSING.route("in0", f"out{name[-1]}")
    pose = pose_on(CROSSING.lanes["0>2"], 1.0)

    lines = CROSSING.lines(pose, route)

    boundary = CROSSING.lanes[name].left.points
    assert np.hypot(*(lines[Slot.EGO_LEFT].points - boundary[-1]).T).min() < 1e-6


def test_a_car_beside_its_route_still_gets_it() -> None:
    """The lines of its lane lead along the route."""
    found = carriageway(2, 0, sections=3)
    route = found.route("0:1", "2:1")
    pose = pose_on(found.lanes["1:2"], 20.0)

    y = lateral(found.lines(pose, route), pose)

    assert y[Slot.ROUTE] == pytest.approx(WIDTH)
    assert y[Slot.CENTRE] == pytest.approx(0.0, abs=1e-9)


def test_a_lane_that_ends() -> None:
    """The line next to it ends with the lane, and the edge of the road follows the taper."""
    found = lane_that_ends()
    pose = np.array([90.0, WIDTH / 2, 0.0])
    lines = found.lines(pose)

    assert lines[Slot.NEXT_RIGHT].points[-1] == pytest.approx([160.0, 0.0])
    assert lines[Slot.EDGE_RIGHT].points[-1] == pytest.approx([260.0, 0.0])
    assert lateral(lines, pose, 40.0)[Slot.EDGE_RIGHT] == pytest.approx(
        -WIDTH / 2 - WIDTH / 2, abs=0.01
    )
    assert lateral(lines, pose, 100.0)[Slot.EDGE_RIGHT] == pytest.approx(-WIDTH / 2)


def test_a_lane_that_opens_with_its_full_width() -> None:
    """The edge ends there, because no line continues it; the boundary of the ego lane goes on."""
    found = network(
        lane("a", length=100.0),
        lane("b1", (100.0, 0.0, 0.0), 100.0),
        lane("b2", (100.0, 0.0, 0.0), 100.0, t=-WIDTH),
        links={"a": "b1"},
        rows=["b1 b2"],
    )
    lines = found.lines([50.0, 0.0, 0.0])

    assert lines[Slot.EDGE_RIGHT].points[-1] == pytest.approx([100.0, -WIDTH / 2])
    assert lines[Slot.EGO_RIGHT].points[-1] == pytest.approx([200.0, -WIDTH / 2])


def test_a_lane_that_opens_between() -> None:
    """The line next to it is the same one, also where another lane has opened before it."""
    found = network(
        lane("a", length=100.0, t=-WIDTH / 2),
        lane("-a", length=100.0, t=WIDTH / 2, backward=True),
        lane("b", (100.0, 0.0, 0.0), 100.0, t=-WIDTH / 2),
        lane("turn", (100.0, 0.0, 0.0), 100.0, t=(0.0, WIDTH / 2), width=(0.0, WIDTH)),
        lane("-b", (100.0, 0.0, 0.0), 100.0, t=(WIDTH / 2, 1.5 * WIDTH), backward=True),
        links={"a": "b", "-b": "-a"},
        rows=["turn b"],
        opposite=["a -a", "turn -b"],
    )
    lines = found.lines([50.0, -WIDTH / 2, 0.0])

    assert lines[Slot.NEXT_LEFT].points[-1] == pytest.approx([200.0, 2 * WIDTH])
    assert lines[Slot.EDGE_LEFT].points[-1] == pytest.approx([200.0, 2 * WIDTH])


@given(k=st.integers(0, 3), s=st.floats(0.5, 30.9), t=st.floats(-1.5, 1.5))
def test_lines_in_a_roundabout(k: int, s: float, t: float) -> None:
    """The ring ends in itself; its lines end before they return to the car."""
    route = RING.route(f"in{k}", f"out{(k + 2) % 4}")
    pose = pose_on(RING.lanes[f"ring{k}"], s, t)
    lines = RING.lines(pose, route)

    y = lateral(lines, pose)

    assert y[Slot.EGO_LEFT] == pytest.approx(WIDTH / 2 - t, abs=0.02)
    assert y[Slot.EGO_RIGHT] == pytest.approx(-WIDTH / 2 - t, abs=0.02)
    for line in lines.values():
        assert line.length < 2 * math.pi * 22.0


@given(s=st.floats(1.0, 140.0), t=st.floats(-1.5, 1.5))
def test_a_loop_that_returns_beside_itself(s: float, t: float) -> None:
    """A turn by 180 deg between lanes of opposite directions."""
    found = network(
        lane("go", length=80.0, t=-WIDTH / 2),
        lane("turn", (80.0, -WIDTH / 2, 0.0), math.pi * 4.0, curvature=0.25),
        lane("back", length=80.0, t=8.0 - WIDTH / 2, backward=True),
        links={"go": "turn", "turn": "back"},
    )
    route = found.route("go", "back")
    one = "go" if s <= 80 else "turn" if s <= 92 else "back"
    pose = pose_on(found.lanes[one], s - {"go": 0, "turn": 80, "back": 92}[one], t)

    y = lateral(found.lines(pose, route), pose)

    assert y[Slot.EGO_LEFT] == pytest.approx(WIDTH / 2 - t, abs=0.02)
    assert y[Slot.EGO_RIGHT] == pytest.approx(-WIDTH / 2 - t, abs=0.02)


@pytest.mark.parametrize(
    ("step", "is_joined", "reported"),
    [
        pytest.param(0.0, True, "", id="none"),
        pytest.param(0.04, True, "", id="below-the-least"),
        pytest.param(0.06, True, "0.06 m; lines are joined across it", id="reported"),
        pytest.param(0.29, True, "0.29 m; lines are joined across it", id="largest-joined"),
        pytest.param(0.31, False, "0.31 m; lines end there", id="too-large"),
        pytest.param(WIDTH, False, "3.50 m; lines end there", id="another-lane"),
    ],
)
def test_gaps_at_links(step: float, is_joined: bool, reported: str) -> None:
    """Snapped up to 5 cm, joined up to 30 cm; reported from 5 cm on."""
    found = network(lane("1", length=100.0), lane("2", (100.0, step, 0.0), 100.0), links={"1": "2"})
    line = found.lines([50.0, 0.0, 0.0])[Slot.EGO_LEFT]

    assert line.length == pytest.approx(200.0 if is_joined else 100.0, abs=0.4)
    whys = [str(gap) for gap in link_gaps(found.lanes)]
    assert len(whys) == bool(reported)
    assert not reported or reported in whys[0]
    assert not whys or whys[0].startswith("link of lane 1 to lane 2: ")


@given(
    turns=st.lists(st.floats(-0.4, 0.4), min_size=1, max_size=8),
    steps=st.integers(2, 20),
    start=st.floats(0.0, 1.0),
    part=st.floats(0.0, 1.0),
)
def test_lines_that_cannot_turn_back_are_whole(
    turns: list[float], steps: int, start: float, part: float
) -> None:
    """The quick test of several lines finds each one of which a part is not visible."""
    heading = np.repeat(turns, steps).cumsum()
    bend = Polyline(np.cumsum([np.cos(heading), np.sin(heading)], axis=1).T)
    straight = Polyline([[0.0, 0.0], [50.0, 0.0]])
    lines = [straight, bend, straight]
    spans = [(start * line.length * (1 - part), start * line.length) for line in lines]

    found = view.may_turn_back(lines, spans)

    for line, span, may in zip(lines, spans, found, strict=True):
        assert may or view.visible(line, *span) is line
    assert not (found[0] and spans[0][1] - spans[0][0] > view.CHORD)


def test_points_in_any_memory_order() -> None:
    """Points of a caller may be stored by columns."""
    one = lane("1")
    left, right, centre = (
        Polyline(np.asfortranarray(line.points)) for line in (one.left, one.right, one.centre)
    )
    assert left.points.flags.f_contiguous
    stored = network(replace(one, left=left, right=right, centre=centre))

    expected = network(one).lines([50.0, 0.0, 0.0])
    for slot, line in stored.lines([50.0, 0.0, 0.0]).items():
        assert line.points.tolist() == expected[slot].points.tolist()


def test_links_that_loop_end() -> None:
    """A lane that follows itself, and two that follow each other."""
    for links in ({"1": "1"}, {"1": "2", "2": "1"}):
        found = network(lane("1"), lane("2", (200.0, 0.0, 0.0)), links=links)
        assert found.lines([50.0, 0.0, 0.0])[Slot.CENTRE].length <= 400.0


def test_lanes_that_are_their_own_neighbours_end() -> None:
    """Wrong files have them."""
    found = network(lane("1"), lane("2", t=WIDTH), rows=["1 2 1"])

    assert Slot.EGO_LEFT in found.lines([50.0, 0.0, 0.0])


CHANGING = [(0.0, Kind.DASHED), (80.0, Kind.SOLID), (150.0, Kind.DOUBLE)]


def changing(kinds: Any = CHANGING) -> Map:
    """Return two lanes beside each other; the boundary between them changes its kind."""
    right = lane("r", kinds=(Kind.UNKNOWN, Kind.KERB))
    left = replace(lane("l", t=WIDTH), right=Polyline(right.left.points, kinds))
    return network(left, replace(right, left=left.right), rows=["l r"])


@given(s=st.floats(0.0, 199.9), t=st.floats(-0.7, 0.7), lane_of=st.booleans(), turn=st.booleans())
def test_kinds_in_a_bend_change_across_the_lane(
    s: float, t: float, lane_of: bool, turn: bool
) -> None:
    """Also those of an opposite lane: each boundary has its own s, and its own direction."""
    radius, kinds = 80.0, (Kind.DASHED, Kind.SOLID, Kind.DOUBLE)
    lanes = [
        lane("r", curvature=1 / radius, t=-WIDTH / 2),
        lane("o", curvature=1 / radius, t=WIDTH / 2, backward=True),
    ]
    for i, one in enumerate(lanes):
        s_of_change = np.array([0.0, 0.4, 0.7]) * one.right.length
        changing = Polyline(one.right.points, list(zip(s_of_change.tolist(), kinds, strict=True)))
        lanes[i] = replace(one, right=changing)
    found = network(*lanes, opposite=["r o"])
    lines = found.lines(pose_on(lanes[lane_of], s, t, math.pi * turn))
    share = s / lanes[lane_of].length
    assume(min(abs(share - k) for k in (0.3, 0.4, 0.6, 0.7)) > 1e-3)
    own, other = (kinds[sum(at >= k for k in (0.4, 0.7))] for at in (share, 1 - share))
    slots = (Slot.EGO_RIGHT, Slot.EDGE_LEFT) if not turn else (Slot.EGO_LEFT, Slot.EDGE_RIGHT)
    assert [lines[slot].kind for slot in slots] == [own, other]


def test_a_tracked_line_changes_its_kind_and_no_slot() -> None:
    """The line of two slots remains one, and so does that of a kind."""
    found = changing()
    tracker = LaneTracker(found)
    tracked = [tracker.lines([x, WIDTH, 0.0]) for x in range(0, 200, 10)]
    assert [one.lines[Slot.EGO_RIGHT].kind for one in tracked] == [
        *[Kind.DASHED] * 8, *[Kind.SOLID] * 7, *[Kind.DOUBLE] * 5
    ]  # fmt: skip
    assert all(not one.changed for one in tracked[1:])
    assert len({id(one.lines[Slot.EGO_RIGHT]) for one in tracked}) == 3
    assert all(one.lines[Slot.EGO_LEFT] is one.lines[Slot.EDGE_LEFT] for one in tracked)


def test_a_route_has_sections_where_a_kind_changes() -> None:
    """For a sender that has only these: the kinds at each place are those of the map there."""
    found = changing()
    route = found.route("r", "r")
    along = found.along(route)
    assert along.starts == pytest.approx((0.0, 80.0, 150.0))
    for x in np.arange(0.5, 200.0, 1.0):
        place = along.locate([x, 0.0, 0.0])
        assert place is not None
        own, lines = along.sections[place.section], found.lines([x, 0.0, 0.0], route)
        assert {slot: line.kind for slot, line in own.items()} == {
            slot: line.kind for slot, line in lines.items()
        }
