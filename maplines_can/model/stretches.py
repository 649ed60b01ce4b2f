"""Stretches of map lines: what a car sees of them, as functions y(x) in its frame.

A line may run in either direction, turn back, or cross the road. What is seen of it is the run of
steps around the nearest one that all run along the x axis, or all against it, within a window.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from .elementary import hypot, sin_cos
from .matrices import Row

#: Length over which the direction of a line is taken [m].
DIRECTION_BASE = 0.5
#: The least normal number: a step of no length has the square of this one.
LEAST_SQUARE = 2.0**-1022


class Path(NamedTuple):
    """A line of the map."""

    x: Row  #: of its points [m]
    y: Row
    distance: Row  #: arc length from the first point to each [m]


class Look(NamedTuple):
    """Where the car is, and what it looks at."""

    pose: Row  #: x, y [m] and heading [rad] in the frame of the map
    low: float  #: window, in the frame of the car [m]
    high: float
    max_turn: float  #: largest angle between a line and the x axis [rad]


class Stretch(NamedTuple):
    """What is seen of a line."""

    x: Row  #: of the points, which include those next to both ends [m]
    y: Row
    begin: float  #: of the range [m]
    end: float


def start_of(look: Look) -> tuple[float, float, float]:
    """Return the place from which lines are followed, and how far along them [m]."""
    s, c = sin_cos(look.pose[2])
    ahead = limited(0.0, look.low, look.high)
    reach = (look.high - look.low + abs(ahead)) / sin_cos(look.max_turn)[1]
    return look.pose[0] + ahead * c, look.pose[1] + ahead * s, reach


def limited(value: float, low: float, high: float) -> float:
    """Return the value nearest to another one in an interval."""
    return min(high, max(low, value))


def directions(path: Path, look: Look) -> list[int]:
    """Return the direction of each step: 1 along the x axis, -1 against it, 0 across it.

    It is that of a chord, which extends half a base to both sides of the middle of the step, if any
    step is shorter than that.
    """
    x, y, distance = path
    s, c = sin_cos(look.pose[2])
    cosine = sin_cos(look.max_turn)[1]
    steps = range(len(x) - 1)
    has_short_steps = any(distance[i + 1] - distance[i] < DIRECTION_BASE for i in steps)
    found = []
    for i in steps:
        begin, end = i, i + 1
        if has_short_steps:
            middle = (distance[i + 1] + distance[i]) / 2
            begin = max(bisect_right(distance, middle - DIRECTION_BASE / 2) - 1, 0)
            end = min(bisect_left(distance, middle + DIRECTION_BASE / 2), len(x) - 1)
        dx, dy = x[end] - x[begin], y[end] - y[begin]
        advance, least = c * dx + s * dy, cosine * hypot(dx, dy)
        found.append((advance >= least) - (advance <= -least))
    return found


def nearest_step(path: Path, look: Look, direction: Sequence[int]) -> int | None:
    """Return the step nearest to the start that is not across the x axis; None without one.

    If the very nearest is across it, others are sought up to the reach along the line.
    """
    x, y, distance = path
    start_x, start_y, reach = start_of(look)
    steps = range(len(x) - 1)
    shares, squares = [], []
    for i in steps:
        dx, dy = x[i + 1] - x[i], y[i + 1] - y[i]
        to_x, to_y = start_x - x[i], start_y - y[i]
        share = (to_x * dx + to_y * dy) / max(LEAST_SQUARE, dx * dx + dy * dy)
        shares.append(limited(share, 0.0, 1.0))
        to_x, to_y = to_x - shares[i] * dx, to_y - shares[i] * dy
        squares.append(min(math.inf, to_x * to_x + to_y * to_y))  # NaN by overflow, too
    nearest = min(steps, key=squares.__getitem__)  # the first one
    if direction[nearest]:
        return nearest
    place = distance[nearest] + shares[nearest] * (distance[nearest + 1] - distance[nearest])
    near = [i for i in steps if direction[i] and abs(distance[i] - place) <= reach]
    return min(near, key=squares.__getitem__) if near else None


def stretch_of(path: Path, look: Look) -> Stretch | str:
    """Return what is seen of a line, or why nothing is."""
    direction = directions(path, look)
    nearest = nearest_step(path, look, direction)
    if nearest is None:
        return "ACROSS"
    first, last = nearest, nearest + 1  # points
    while first > 0 and direction[first - 1] == direction[nearest]:
        first -= 1
    while last < len(direction) and direction[last] == direction[nearest]:
        last += 1
    s, c = sin_cos(look.pose[2])
    to_x = [v - look.pose[0] for v in path.x[first : last + 1]]
    to_y = [v - look.pose[1] for v in path.y[first : last + 1]]
    x = [c * u + s * v for u, v in zip(to_x, to_y, strict=True)]
    y = [c * v - s * u for u, v in zip(to_x, to_y, strict=True)]
    inside = [
        i
        for i, (u, v) in enumerate(pairwise(x))
        if not ((u <= look.low and v <= look.low) or (u >= look.high and v >= look.high))
    ]
    if not inside:
        return "NOT_IN_WINDOW"
    part = slice(inside[0], inside[-1] + 2)
    x, y = x[part][:: direction[nearest]], y[part][:: direction[nearest]]
    begin, end = max(look.low, x[0]), min(look.high, x[-1])
    return Stretch(x, y, begin, end) if begin < end else "NOT_IN_WINDOW"


class Stretches:
    """Stretches of several lines, one after the other.

    The keys of their points ascend: x, plus a multiple of a step that keeps the lines apart.
    """

    def __init__(self, stretches: Sequence[Stretch]) -> None:
        self.ranges = [(one.begin, one.end) for one in stretches]
        self.first = [0]  #: point of each, and the number of all
        for one in stretches:
            self.first.append(self.first[-1] + len(one.x))
        self.x = [x for one in stretches for x in one.x]
        self.y = [y for one in stretches for y in one.y]
        self._step = 2 * max((abs(x) for x in self.x), default=0.0) + 1
        self._keys: Row = []
        greatest = -math.inf
        for line, one in enumerate(stretches):
            for x in one.x:  # close points may run back a little
                greatest = max(greatest, x + line * self._step)
                self._keys.append(greatest)

    def points(self, line: int) -> list[tuple[float, float]]:
        """Return the points of a line."""
        part = slice(self.first[line], self.first[line + 1])
        return [*zip(self.x[part], self.y[part], strict=True)]

    def lateral(self, line: int, x: float) -> float:
        """Return the lateral position of a line [m], between two of its points."""
        i, beyond = self._place(line, x)
        if not (beyond > 0 and i + 1 < len(self.y)):
            return self.y[i]
        slope = (self.y[i + 1] - self.y[i]) / (self._keys[i + 1] - self._keys[i])
        return slope * beyond + self.y[i]

    def position(self, line: int, x: float) -> float:
        """Return the index of a point, with a fraction between it and the next one."""
        i, beyond = self._place(line, x)
        if not (beyond > 0 and i + 1 < len(self.y)):
            return float(i)
        return 1 / (self._keys[i + 1] - self._keys[i]) * beyond + i

    def _place(self, line: int, x: float) -> tuple[int, float]:
        """Return the last point whose key is not greater, and by how much it is less."""
        key = x + line * self._step
        first = max(self.first[line] - 1, 0)  # rounding may take an end to the line before
        i = max(bisect_right(self._keys, key) - 1, first)
        return i, key - self._keys[i]
