"""Lanes in the direction in which a car drives on them, and the way ahead through them.

A car may drive against the direction of a lane: when it overtakes, or reverses. Whatever it does,
the lanes beside it and the way ahead are those of its own direction. So the way behind a car is the
way ahead of one that drives against it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ..polyline import Polyline
from .lane import Lane
from .matching import locate, wrapped

#: Length over which the turn of a way is taken [m].
TURN_LENGTH = 30.0
#: Most lanes of a way over which its turn is taken.
TURN_DEPTH = 5


class Key(NamedTuple):
    """A lane, and whether it is driven against its direction."""

    lane: str
    is_against: bool = False

    @property
    def back(self) -> Key:
        """The same lane in the other direction."""
        return Key(self.lane, not self.is_against)


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

    left: Polyline
    right: Polyline
    centre: Polyline
    successors: tuple[Key, ...]
    on_left: Key | None
    on_right: Key | None


class LaneGraph:
    """Drivable lanes of a map in both directions.

    Args:
        lanes: by their ids.
    """

    def __init__(self, lanes: Mapping[str, Lane]) -> None:
        self._lanes = lanes
        self._driven: dict[Key, DrivenLane] = {}
        self._rows: dict[Key, tuple[Key, ...]] = {}
        self._straightest: dict[Key, Key] = {}

    def __getitem__(self, key: Key) -> DrivenLane:
        """Return a lane in a direction; always the same object."""
        known = self._driven.get(key)
        if known is None:
            lane = self._lanes[key.lane]
            left, right, centre = lane.left, lane.right, lane.centre
            on_left, on_right = self._beside(lane)
            after = lane.successors
            if key.is_against:
                left, right, centre = (_reversed(line) for line in (right, left, centre))
                on_left, on_right = (other and other.back for other in (on_right, on_left))
                after = lane.predecessors
            ahead = (i for i in after if self._lanes[i].type.is_drivable)
            known = self._driven[key] = DrivenLane(
                left, right, centre, tuple(Key(i, key.is_against) for i in ahead), on_left, on_right
            )
        return known

    def _beside(self, lane: Lane) -> tuple[Key | None, Key | None]:
        """Return the lanes on the left and on the right."""
        beside = [i and Key(i) for i in (lane.left_neighbour, lane.right_neighbour)]
        if other := lane.opposite_left:
            side = 0 if _is_on_left(lane, self._lanes[other]) else 1
            beside[side] = beside[side] or Key(other, is_against=True)
        on_left, on_right = beside
        return on_left or None, on_right or None

    def row(self, key: Key) -> tuple[Key, ...]:
        """Return the lanes beside each other, from left to right, as seen from one of them."""
        if key not in self._rows:
            self._rows[key] = tuple(self._find_row(key))
        return self._rows[key]

    def _find_row(self, key: Key) -> Iterable[Key]:
        if key.is_against:
            return [other.back for other in reversed(self.row(key.back))]
        row = [key]
        while (other := self[row[0]].on_left) and other not in row:
            row.insert(0, other)
        while (other := self[row[-1]].on_right) and other not in row:
            row.append(other)
        return row

    def way(self, key: Key, path: Sequence[Key], reach: float) -> Iterator[Key]:
        """Yield the lanes ahead of a lane, up to a length [m]; each lane once.

        The way follows the path. Where the path changes lanes, the way remains beside it as far as
        the lanes do. Without a path it takes the straightest lane.

        Args:
            key: lane to start from.
            path: lanes to follow; it may start with those beside ``key``.
            reach: length that the lanes yielded have together, if the map has it [m].
        """
        seen = {key.lane}
        i = 0
        while reach > 0:
            row = self.row(key)
            while i < len(path) and path[i] in row:
                i += 1
            after = [other for other in self[key].successors if other.lane not in seen]
            if not after:
                return
            straightest = self.straightest(key)
            key = straightest if straightest in after else after[0]
            if i < len(path) and len(after) > 1:
                target = path[i]
                beside = (other for other in after if target in self.row(other))
                key = target if target in after else next(beside, key)
            seen.add(key.lane)
            reach -= self[key].centre.length
            yield key

    def reachable(self, key: Key, distance: float) -> set[Key]:
        """Return the lanes ahead that begin up to a distance [m] from the end of a lane."""
        least = {key: 0.0}
        open_keys = [key]
        while open_keys:
            at = open_keys.pop()
            for other in self[at].successors:
                length = least[at] + self[other].centre.length
                if least[at] <= distance and length < least.get(other, math.inf):
                    least[other] = length
                    open_keys.append(other)
        del least[key]
        return set(least)

    def straightest(self, key: Key) -> Key | None:
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

    def _turn(self, key: Key, heading: float, reach: float, depth: int) -> float:
        """Return the least angle between a heading and the directions of the ways at a distance."""
        lane = self[key]
        rest = reach - lane.centre.length
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


def _reversed(line: Polyline) -> Polyline:
    """Return the line in the other direction, without a copy of its points."""
    return Polyline.trusted(line.points[::-1], line.kind, line.length - line.distance[::-1])


def _direction(line: Polyline, s: float) -> float:
    """Return the direction of a line at an arc length, or at its end [rad]."""
    k = min(int(line.distance.searchsorted(s)), len(line.points) - 1)
    (x0, y0), (x1, y1) = line.points[k - 1 : k + 1].tolist() if k else line.points[:2].tolist()
    return math.atan2(y1 - y0, x1 - x0)
