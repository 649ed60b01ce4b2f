"""Routes: the shortest way from lane to lane, with lane changes."""

from __future__ import annotations

import heapq
import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import count

import numpy as np
from numpy.typing import NDArray

from ..values.errors import RouteError
from ..values.line import Kind
from ..values.polyline import Polyline
from .joints import joined
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
        path += _dijkstra(lanes, *start, *goal)[1:]
    return _route(lanes, path, starts[0][1], goals[-1][1])


def _dijkstra(
    lanes: Mapping[str, Lane], start: str, start_s: float, goal: str, goal_s: float
) -> list[str]:
    """Return the ids of the lanes. A state is a lane, and whether it is beside the start."""
    start_share = _share(start_s, lanes[start])
    goal_share = _share(goal_s, lanes[goal])
    order = count()  # of equal costs, the first one
    first = (start, True)
    heap: list[tuple[float, int, tuple[str, bool], tuple[str, bool] | None]] = []
    heapq.heappush(heap, (0.0, next(order), first, None))
    came_from: dict[tuple[str, bool], tuple[str, bool] | None] = {}
    while heap:
        cost, _, state, previous = heapq.heappop(heap)
        if state in came_from:
            continue
        came_from[state] = previous
        lane_id, is_beside_start = state
        if lane_id == goal and (not is_beside_start or goal_share >= start_share):
            path = []
            at: tuple[str, bool] | None = state
            while at is not None:
                path.append(at[0])
                at = came_from[at]
            return path[::-1]
        lane = lanes[lane_id]
        room = lane.length * (1 - start_share if is_beside_start else 1.0)
        for other in lane.successors:
            if lanes[other].type.is_drivable:
                heapq.heappush(heap, (cost + room, next(order), (other, False), state))
        for beside, boundary in (
            (lane.left_neighbour, lane.left),
            (lane.right_neighbour, lane.right),
        ):
            if beside is not None and boundary.kind not in CLOSED:
                extra = SOLID_COST if boundary.kind in {Kind.SOLID, Kind.DOUBLE} else 0.0
                extra += SHORT_COST * max(0.0, CHANGE_LENGTH - room) + CHANGE_COST
                extra += LATE_COST * cost
                state_beside = (beside, is_beside_start)
                heapq.heappush(heap, (cost + extra, next(order), state_beside, state))
    reached = len({lane_id for lane_id, _ in came_from})
    raise RouteError(
        f"there is no route from lane {start!r} to lane {goal!r}: {reached} of {len(lanes)} lanes "
        "can be reached; choose a goal on a road that the links of the map lead to"
    )


def _route(lanes: Mapping[str, Lane], path: Sequence[str], start_s: float, goal_s: float) -> Route:
    parts: list[NDArray[np.float64]] = []
    beside: list[Sequence[str]] = []
    extents: list[list[tuple[float, float]]] = []
    for group in _groups(lanes, path):
        first = start_s if not beside else 0.0
        length = lanes[group[0]].length
        last = _share(goal_s, lanes[path[-1]]) * length if len(group) == len(path) else length
        changes = _extents(len(group) - 1, first, max(first, last))
        extents.append(changes)
        beside.append(group)
        parts.append(_across([lanes[i].centre for i in group], changes))
    line, begins = joined(parts, Kind.VIRTUAL)
    starts = [s for group, s in zip(beside, begins, strict=True) for _ in group]
    goal = begins[-1] + _share(goal_s, lanes[path[-1]]) * (line.length - begins[-1])
    found = [
        LaneChange(a, b, lanes[a].left_neighbour == b, begin + low, begin + high)
        for group, begin, changes in zip(beside, begins, extents, strict=True)
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


def _extents(changes: int, first: float, last: float) -> list[tuple[float, float]]:
    """Return from where to where the lane changes between two positions extend [m]."""
    room = (last - first) / max(changes, 1)
    starts = [first + k * room for k in range(changes)]
    return [(start, start + min(room, CHANGE_LENGTH)) for start in starts]


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
