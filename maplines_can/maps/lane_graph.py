"""Lanes in the direction in which a car drives on them, and the way ahead through them.

A car may drive against the direction of a lane: when it overtakes, or reverses. Whatever it does,
the lanes beside it and the way ahead are those of its own direction. So the way behind a car is the
way ahead of one that drives against it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..values.polyline import Polyline
from .lane import Lane
from .matching import locate, wrapped

#: Length over which the turn of a way is taken [m].
TURN_LENGTH = 30.0
#: Most lanes of a way over which its turn is taken.
TURN_DEPTH = 5


class DirectedLane(NamedTuple):
    """A lane, and whether it is driven against its direction."""

    lane: str
    is_against: bool = False

    @property
    def back(self) -> DirectedLane:
        """The same lane in the other direction."""
        return DirectedLane(self.lane, not self.is_against)


@dataclass(eq=False, slots=True)
class DrivenLine:
    """A line of a lane as driven.

    Args:
        key: the lane.
        side: "left", "right" or "centre", as driven.
        line: the line, in the direction of the lane.
        points: (n, 2) its points, as driven [m].
        start: the first one.
        end: the last one.
        length: of the line [m].

    Attributes:
        back: the same line in the other direction.
    """

    key: DirectedLane
    side: str
    line: Polyline
    points: NDArray[np.float64]
    start: tuple[float, float]
    end: tuple[float, float]
    length: float
    back: DrivenLine = field(init=False)

    @property
    def polyline(self) -> Polyline:
        """The line as driven; its points are not copied."""
        if not self.key.is_against:
            return self.line
        distance = self.length - self.line.distance[::-1]
        return Polyline.trusted(self.points, self.line.kind, distance)

    def points_up_to(self, s: float) -> NDArray[np.float64]:
        """Return the points up to an arc length [m] and the next one, at least two."""
        if s >= self.length:
            return self.points
        distance = self.line.distance
        if self.key.is_against:
            k = len(distance) - int(distance.searchsorted(self.length - s, "right"))
        else:
            k = int(distance.searchsorted(s))
        return self.points[: max(2, k + 1)]


@dataclass(frozen=True, eq=False, slots=True)
class DrivenLane:
    """A lane as seen by a car that drives along it or against it.

    Args:
        left: left boundary.
        right: right boundary.
        centre: centre line.
        successors: drivable lanes ahead.
        on_left: drivable lane on the left.
        on_right: drivable lane on the right.
    """

    left: DrivenLine
    right: DrivenLine
    centre: DrivenLine
    successors: tuple[DirectedLane, ...]
    on_left: DirectedLane | None
    on_right: DirectedLane | None

    @property
    def length(self) -> float:
        """Length of the centre line [m]."""
        return self.centre.length


class LaneGraph:
    """Drivable lanes of a map in both directions.

    Args:
        lanes: by their ids.
    """

    def __init__(self, lanes: Mapping[str, Lane]) -> None:
        self._lanes = lanes
        self._driven: dict[DirectedLane, DrivenLane] = {}
        self._rows: dict[DirectedLane, tuple[DirectedLane, ...]] = {}
        self._straightest: dict[DirectedLane, DirectedLane] = {}

    def __getitem__(self, key: DirectedLane) -> DrivenLane:
        """Return a lane in a direction; it and its lines are always the same objects."""
        known = self._driven.get(key)
        if known is None:
            self._add(self._lanes[key.lane])
            known = self._driven[key]
        return known

    def _add(self, lane: Lane) -> None:
        """Add a lane in both directions."""
        along, against = DirectedLane(lane.id), DirectedLane(lane.id, True)
        left = _driven_line(lane.left, along, "left", "right")
        right = _driven_line(lane.right, along, "right", "left")
        centre = _driven_line(lane.centre, along, "centre", "centre")
        on_left, on_right = self._beside(lane)
        after, before = (
            [i for i in links if self._lanes[i].type.is_drivable]
            for links in (lane.successors, lane.predecessors)
        )
        self._driven[along] = DrivenLane(
            left, right, centre, tuple(map(DirectedLane, after)), on_left, on_right
        )
        self._driven[against] = DrivenLane(
            right.back,
            left.back,
            centre.back,
            tuple(DirectedLane(i, True) for i in before),
            on_right and on_right.back,
            on_left and on_left.back,
        )

    def _beside(self, lane: Lane) -> tuple[DirectedLane | None, DirectedLane | None]:
        """Return the lanes on the left and on the right."""
        beside = [i and DirectedLane(i) for i in (lane.left_neighbour, lane.right_neighbour)]
        if other := lane.opposite_left:
            side = 0 if _is_on_left(lane, self._lanes[other]) else 1
            beside[side] = beside[side] or DirectedLane(other, is_against=True)
        on_left, on_right = beside
        return on_left or None, on_right or None

    def row(self, key: DirectedLane) -> tuple[DirectedLane, ...]:
        """Return the lanes beside each other, from left to right, as seen from one of them."""
        if key not in self._rows:
            self._rows[key] = tuple(self._find_row(key))
        return self._rows[key]

    def _find_row(self, key: DirectedLane) -> Iterable[DirectedLane]:
        if key.is_against:
            return [other.back for other in reversed(self.row(key.back))]
        row = [key]
        while (other := self[row[0]].on_left) and other not in row:
            row.insert(0, other)
        while (other := self[row[-1]].on_right) and other not in row:
            row.append(other)
        return row

    def way(
        self, key: DirectedLane, path: Sequence[DirectedLane], reach: float
    ) -> Iterator[DirectedLane]:
        """Yield the lanes ahead of a lane, up to a length [m]; each lane once.

        The way follows the path. Where the path changes lanes, the way remains beside it as far as
        the lanes do. Without a path it takes the straightest lane.

        Args:
            key: lane to start from.
            path: lanes to follow; it may start with those beside ``key``.
            reach: length that the lanes yielded have together, if the map has it [m].
        """
        seen = {key.lane}
        lane = self[key]
        i = 0
        while reach > 0:
            while i < len(path) and path[i] in self.row(key):
                i += 1
            after = [other for other in lane.successors if other.lane not in seen]
            if not after:
                return
            if len(after) > 1:
                straightest = self.straightest(key)
                key = straightest if straightest in after else after[0]
                if i < len(path):
                    target = path[i]
                    beside = (other for other in after if target in self.row(other))
                    key = target if target in after else next(beside, key)
            else:
                key = after[0]
            lane = self[key]
            seen.add(key.lane)
            reach -= lane.length
            yield key

    def reachable(self, key: DirectedLane, distance: float) -> set[DirectedLane]:
        """Return the lanes ahead that begin up to a distance [m] from the end of a lane."""
        least = {key: 0.0}
        open_keys = [key]
        while open_keys:
            at = open_keys.pop()
            for other in self[at].successors:
                length = least[at] + self[other].length
                if least[at] <= distance and length < least.get(other, math.inf):
                    least[other] = length
                    open_keys.append(other)
        del least[key]
        return set(least)

    def straightest(self, key: DirectedLane) -> DirectedLane | None:
        """Return the successor whose way turns least."""
        after = self[key].successors
        if len(after) < 2:
            return after[0] if after else None
        if key not in self._straightest:
            heading = _direction(self[key].centre, math.inf)
            self._straightest[key] = min(
                after, key=lambda other: self._turn(other, heading, TURN_LENGTH, TURN_DEPTH)
            )
        return self._straightest[key]

    def _turn(self, key: DirectedLane, heading: float, reach: float, depth: int) -> float:
        """Return the least angle between a heading and the directions of the ways at a distance."""
        lane = self[key]
        rest = reach - lane.length
        if rest <= 0 or depth == 0 or not lane.successors:
            return abs(wrapped(_direction(lane.centre, reach) - heading))
        return min(self._turn(other, heading, rest, depth - 1) for other in lane.successors)


def _is_on_left(lane: Lane, opposite: Lane) -> bool:
    """Return whether a lane with the opposite direction is on the left."""
    shares_left, shares_right = (
        line.points[0].tolist() == other.points[-1].tolist()
        and line.points[-1].tolist() == other.points[0].tolist()
        for line, other in ((lane.left, opposite.left), (lane.right, opposite.right))
    )
    if shares_left != shares_right:
        return shares_left
    points = opposite.centre.points
    (place,) = locate([lane.centre], points[len(points) // 2])
    return place.t > 0


def _driven_line(line: Polyline, key: DirectedLane, side: str, back_side: str) -> DrivenLine:
    """Return a line of a lane; ``back`` is the same as driven against it."""
    points, length = line.points, line.length
    (x0, y0), (x1, y1) = points[0].tolist(), points[-1].tolist()
    start, end = (x0, y0), (x1, y1)
    found = DrivenLine(key, side, line, points, start, end, length)
    found.back = DrivenLine(key.back, back_side, line, points[::-1], end, start, length)
    found.back.back = found
    return found


def _direction(line: DrivenLine, s: float) -> float:
    """Return the direction of a line at an arc length, or at its end [rad]."""
    (x0, y0), (x1, y1) = line.points_up_to(s)[-2:].tolist()
    return math.atan2(y1 - y0, x1 - x0)
