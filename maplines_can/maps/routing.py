"""Routes: the shortest way from lane to lane, with lane changes."""

from __future__ import annotations

import heapq
import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import count, pairwise
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..values.errors import RouteError
from ..values.line import Kind
from ..values.polyline import Polyline, extents, merged
from .joints import gap, joined
from .lane import Lane

#: Driving that costs as much as a lane change [m].
CHANGE_COST = 50.0
#: Length of a lane change [m]. It is shorter if the lanes are; each metre less costs as much as
#: ``SHORT_COST`` metres of driving.
CHANGE_LENGTH = 60.0
SHORT_COST = 5.0
#: Share of the way to a lane change that it costs in addition, so that it is done early.
LATE_COST = 1e-6
#: Driving that costs as much as to cross a solid line [m].
SOLID_COST = 1000.0
#: Boundaries that no lane change crosses.
CLOSED = frozenset({Kind.ROAD_EDGE, Kind.KERB, Kind.BARRIER})
#: Distance of the points of a lane change [m].
_STEP = 1.0


@dataclass(frozen=True)
class LaneChange:
    """A lane change of a route.

    Args:
        origin: id of the lane before it.
        target: id of the lane after it.
        is_left: whether it is to the left.
        start: position along the line of the route at which it starts [m].
        end: position at which it ends [m].
    """

    origin: str
    target: str
    is_left: bool
    start: float
    end: float


@dataclass(frozen=True, eq=False)
class Route:
    """A way through lanes.

    Args:
        lanes: ids in driving order; before and after a lane change, both lanes.
        line: centre line through all of them, whole from the start of the first lane to the end of
            the last one. A lane change is a smooth transition.
        starts: position along ``line`` at which each lane begins [m]; lanes beside each other
            begin at the same one.
        changes: lane changes.
        start: position along ``line`` at which the route starts [m].
        goal: position at which it ends [m].
    """

    lanes: tuple[str, ...]
    line: Polyline = field(repr=False)
    starts: tuple[float, ...] = field(repr=False)
    changes: tuple[LaneChange, ...]
    start: float
    goal: float

    @cached_property
    def lane_set(self) -> frozenset[str]:
        """Ids of the lanes."""
        return frozenset(self.lanes)

    @property
    def length(self) -> float:
        """Length from start to goal [m]."""
        return self.goal - self.start

    def around(self, index: int, behind: float, ahead: float) -> slice:
        """Return which of the lanes are around one of them.

        Args:
            index: of the lane.
            behind: distance behind its start [m].
            ahead: distance ahead of its end [m].
        """
        start, length = self.extent(index)
        first = bisect_left(self.starts, start - behind)
        return slice(max(0, first - 1), bisect_right(self.starts, start + length + ahead))

    @cached_property
    def begins(self) -> tuple[float, ...]:
        """Positions along ``line`` from which the car is on each lane [m]: half way in a change."""
        changes = iter(self.changes)
        change = next(changes, None)
        begins = list(self.starts)
        for i, pair in enumerate(pairwise(self.lanes), 1):
            if change and pair == (change.origin, change.target):
                begins[i] = (change.start + change.end) / 2
                change = next(changes, None)
        return tuple(begins)

    def extent(self, index: int) -> tuple[float, float]:
        """Return where on the line a lane starts [m], and its length there [m]."""
        start = self.starts[index]
        k = bisect_right(self.starts, start)
        end = self.starts[k] if k < len(self.starts) else self.line.length
        return start, end - start


def shortest_route(lanes: Mapping[str, Lane], stops: Sequence[tuple[str, float | None]]) -> Route:
    """Return the shortest route by Dijkstra's algorithm: see ``Map.route``.

    Args:
        lanes: by their ids.
        stops: start, places to pass and goal: the id of the lane, and the arc length in it [m].
            None is the start of the lane for what follows, and its end for what precedes.

    Raises:
        RouteError: there is no route.
    """
    for lane_id, _ in stops:
        if lane_id not in lanes:
            raise RouteError(f"lane {lane_id!r} is not in the map; see Map.lanes for the ids")
    starts = [(lane_id, 0.0 if s is None else s) for lane_id, s in stops]
    goals = [(lane_id, lanes[lane_id].length if s is None else s) for lane_id, s in stops]
    path = [starts[0][0]]
    for start, goal in zip(starts, goals[1:], strict=False):
        path += _shortest_path(lanes, *start, *goal)[1:]
    return route_through(lanes, path, starts[0][1], goals[-1][1])


def _shortest_path(
    lanes: Mapping[str, Lane], start: str, start_s: float, goal: str, goal_s: float
) -> list[str]:
    """Return the ids of the lanes."""
    is_ahead = _share(goal_s, lanes[goal]) >= _share(start_s, lanes[start])
    reached: dict[str, None] = {}
    for state, path in ways_from(lanes, start, start_s):
        if state.lane == goal and (is_ahead or not state.is_beside_start):
            return path()
        reached[state.lane] = None
    raise RouteError(
        f"there is no route from lane {start!r} to lane {goal!r}: {len(reached)} of {len(lanes)} "
        "lanes can be reached; choose a goal on a road that the links of the map lead to"
    )


class Reached(NamedTuple):
    """A lane that is reached, and whether it is beside the start."""

    lane: str
    is_beside_start: bool


def ways_from(
    lanes: Mapping[str, Lane],
    start: str,
    start_s: float = 0.0,
    least_change: float = 0.0,
    max_gap: float = math.inf,
) -> Iterator[tuple[Reached, Callable[[], list[str]]]]:
    """Yield the lanes that are reached by Dijkstra's algorithm, and the ids on the way to each.

    Args:
        lanes: by their ids.
        start: lane from which the ways lead.
        start_s: arc length in it [m].
        least_change: least length of a lane change [m].
        max_gap: largest distance from the end of a lane to the start of the next one [m].
    """
    start_share = _share(start_s, lanes[start])
    order = count()  # of equal costs, the first one
    heap: list[tuple[float, int, Reached, Reached | None, int]] = []
    heapq.heappush(heap, (0.0, next(order), Reached(start, True), None, 1))
    came_from: dict[Reached, Reached | None] = {}

    def path(state: Reached | None) -> list[str]:
        found = []
        while state is not None:
            found.append(state.lane)
            state = came_from[state]
        return found[::-1]

    while heap:
        cost, _, state, previous, in_row = heapq.heappop(heap)
        if state in came_from:
            continue
        came_from[state] = previous
        yield state, partial(path, state)
        lane = lanes[state.lane]
        first = start_share if state.is_beside_start else 0.0
        for other in lane.successors:
            following = lanes[other]
            is_near = math.isinf(max_gap) or gap(lane.centre, following.centre) <= max_gap
            if is_near and following.type.is_drivable:
                ahead = cost + lane.length * (1 - first)
                heapq.heappush(heap, (ahead, next(order), Reached(other, False), state, 1))
        for beside, boundary in (
            (lane.left_neighbour, lane.left),
            (lane.right_neighbour, lane.right),
        ):
            crossing = beside and _crossing(boundary, lane.length, first, 1.0)
            if beside and crossing and crossing.room >= in_row * least_change:
                total = cost + crossing.cost + CHANGE_COST + LATE_COST * cost
                other_state = Reached(beside, state.is_beside_start)
                heapq.heappush(heap, (total, next(order), other_state, state, in_row + 1))


class _Crossing(NamedTuple):
    """A stretch of a boundary in which a lane change crosses it."""

    cost: float  #: of crossing it there [m]
    room: float  #: its length [m]
    start: float  #: as a share of the boundary
    end: float


def _crossing(boundary: Polyline, length: float, first: float, last: float) -> _Crossing | None:
    """Return the stretch at which it costs least to cross a boundary; None if it is closed.

    Args:
        boundary: between two lanes.
        length: of the lane [m].
        first: share of the boundary from which on it may be crossed.
        last: share up to which it may be.
    """
    pieces = [(s / boundary.length, kind) for s, kind in boundary.kinds] or [(0.0, boundary.kind)]
    costs = merged([(share, _crossing_cost(kind)) for share, kind in pieces])
    found = []
    for (start, end), cost in extents(costs, 1.0):
        low, high = max(start, first), min(end, last)
        room = length * (high - low)
        if math.isfinite(cost) and low <= high:
            cost += SHORT_COST * max(0.0, CHANGE_LENGTH - room)
            found.append(_Crossing(cost, room, low, high))
    return min(found, key=itemgetter(0), default=None)


def _crossing_cost(kind: Kind) -> float:
    if kind in CLOSED:
        return math.inf
    return SOLID_COST if kind in {Kind.SOLID, Kind.DOUBLE} else 0.0


def route_through(
    lanes: Mapping[str, Lane], path: Sequence[str], start_s: float, goal_s: float
) -> Route:
    """Return the route through lanes that continue each other or are beside each other.

    Args:
        lanes: by their ids.
        path: ids of the lanes in driving order.
        start_s: arc length in the first one at which it starts [m].
        goal_s: arc length in the last one at which it ends [m].
    """
    parts: list[NDArray[np.float64]] = []
    beside: list[Sequence[str]] = []
    spans: list[list[tuple[float, float]]] = []
    for group in _groups(lanes, path):
        first = start_s if not beside else 0.0
        length = lanes[group[0]].length
        last = _share(goal_s, lanes[path[-1]]) * length if len(group) == len(path) else length
        changes = _changes(lanes, group, first, max(first, last))
        spans.append(changes)
        beside.append(group)
        parts.append(_across([lanes[i].centre for i in group], changes))
    line, begins = joined(parts, Kind.VIRTUAL)
    starts = [s for group, s in zip(beside, begins, strict=True) for _ in group]
    goal = begins[-1] + _share(goal_s, lanes[path[-1]]) * (line.length - begins[-1])
    found = [
        LaneChange(a, b, lanes[a].left_neighbour == b, begin + low, begin + high)
        for group, begin, changes in zip(beside, begins, spans, strict=True)
        for a, b, (low, high) in zip(group, group[1:], changes, strict=False)
    ]
    return Route(tuple(path), line, tuple(starts), tuple(found), start_s, goal)


def _share(s: float, lane: Lane) -> float:
    """Return an arc length as a share of the length of a lane."""
    return min(s / lane.length, 1.0) if lane.length > 0 else 0.0


def _groups(lanes: Mapping[str, Lane], path: Sequence[str]) -> Iterator[list[str]]:
    """Yield the lanes of a path that are beside each other."""
    group: list[str] = []
    for lane_id in path:
        if group:
            last = lanes[group[-1]]
            if lane_id not in (last.left_neighbour, last.right_neighbour):
                yield group
                group = []
        group.append(lane_id)
    yield group


def _changes(
    lanes: Mapping[str, Lane], group: Sequence[str], first: float, last: float
) -> list[tuple[float, float]]:
    """Return from where to where the lane changes between two positions extend [m]."""
    length = lanes[group[0]].length
    room = (last - first) / max(len(group) - 1, 1)
    found = []
    for k, (origin, target) in enumerate(pairwise(group)):
        start, end = first + k * room, first + (k + 1) * room
        lane = lanes[origin]
        boundary = lane.left if lane.left_neighbour == target else lane.right
        if (
            boundary.kinds
            and length > 0
            and (best := _crossing(boundary, length, start / length, end / length))
        ):
            start, end = best.start * length, best.end * length
        found.append((start, min(end, start + CHANGE_LENGTH)))
    return found


def _across(
    centres: Sequence[Polyline], changes: Sequence[tuple[float, float]]
) -> NDArray[np.float64]:
    """Return the points of a line that changes from one centre line to the next, and so on."""
    if not changes:
        return centres[0].points
    length = centres[0].length
    shares = [line.distance / line.length for line in centres]
    for low, high in changes:
        steps = max(2, math.ceil((high - low) / _STEP))
        shares.append(np.linspace(low, high, steps + 1) / length)
    share = np.unique(np.concatenate(shares).clip(0, 1))
    at = [
        np.column_stack([np.interp(share * line.length, line.distance, p) for p in line.points.T])
        for line in centres
    ]
    points = at[0]
    for (low, high), target in zip(changes, at[1:], strict=True):
        u = ((share * length - low) / max(high - low, 1e-9)).clip(0, 1)[:, None]
        points = points + u * u * (3 - 2 * u) * (target - points)
    return points
