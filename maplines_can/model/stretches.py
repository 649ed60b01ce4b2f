"""Stretches of map lines: what a car sees of them, as functions y(x) in its frame.

A line may run in either direction, turn back, or cross the road. What is seen of it is the run of
steps around the nearest one that all run along the x axis, or all against it, within a window.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from itertools import accumulate, pairwise
from typing import NamedTuple

from .elementary import clipped, hypot, sin_cos

#: Length over which the direction of a line is taken [m].
DIRECTION_BASE = 0.5
#: The least normal number: a step of no length has the square of this one.
LEAST_SQUARE = 2.0**-1022


class Path(NamedTuple):
    """A line of the map."""

    x: list[float]  #: of its points [m]
    y: list[float]
    distance: list[float]  #: arc length from the first point to each [m]


class Look(NamedTuple):
    """Where the car is, and what it looks at."""

    pose: Sequence[float]  #: x, y [m] and heading [rad] in the frame of the map
    low: float  #: window, in the frame of the car [m]
    high: float
    max_turn: float  #: largest angle between a line and the x axis [rad]


class Stretch(NamedTuple):
    """What is seen of a line."""

    x: list[float]  #: of the points, which include those next to both ends [m]
    y: list[float]
    begin: float  #: of the range [m]
    end: float


def start_of(look: Look) -> tuple[float, float, float]:
    """Return the place from which lines are followed, and how far along them [m]."""
    s, c = sin_cos(look.pose[2])
    ahead = clipped(0.0, look.low, look.high)
    reach = (look.high - look.low + abs(ahead)) / sin_cos(look.max_turn)[1]
    return look.pose[0] + ahead * c, look.pose[1] + ahead * s, reach


def directions(path: Path, look: Look) -> list[int]:
    """Return the direction of each step: 1 along the x axis, -1 against it, 0 across it.

    It is that of a chord, which extends half a base to both sides of the middle of the step, if any
    step is shorter than that.
    """
    x, y, distance = path
    s, c = sin_cos(look.pose[2])
    cosine = sin_cos(look.max_turn)[1]
    has_short_steps = any(b - a < DIRECTION_BASE for a, b in pairwise(distance))
    found = []
    for i in range(len(x) - 1):
        begin, end = i, i + 1
        if has_short_steps:
            middle = (distance[end] + distance[begin]) / 2
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
    steps, squares, places = range(len(x) - 1), [], []
    for i in steps:
        dx, dy = x[i + 1] - x[i], y[i + 1] - y[i]
        to_x, to_y = start_x - x[i], start_y - y[i]
        share = (to_x * dx + to_y * dy) / max(LEAST_SQUARE, dx * dx + dy * dy)
        share = clipped(share, 0.0, 1.0)
        to_x, to_y = to_x - share * dx, to_y - share * dy
        squares.append(min(math.inf, to_x * to_x + to_y * to_y))  # NaN by overflow, too
        places.append(distance[i] + share * (distance[i + 1] - distance[i]))
    nearest = min(steps, key=squares.__getitem__)  # the first one
    if direction[nearest]:
        return nearest
    near = [i for i in steps if direction[i] and abs(distance[i] - places[nearest]) <= reach]
    return min(near, key=squares.__getitem__, default=None)


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
    x, y = [], []
    for i in range(first, last + 1):
        to_x, to_y = path.x[i] - look.pose[0], path.y[i] - look.pose[1]
        x.append(c * to_x + s * to_y)
        y.append(c * to_y - s * to_x)
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
        self._stretches = stretches
        self._y = [y for one in stretches for y in one.y]
        self._step = 2 * max((abs(x) for one in stretches for x in one.x), default=0.0) + 1
        keys = (x + line * self._step for line, one in enumerate(stretches) for x in one.x)
        self._keys = [*accumulate(keys, max)]  # close points may run back a little

    def points(self, line: int) -> list[tuple[float, float]]:
        """Return the points of a line."""
        return [*zip(self._stretches[line].x, self._stretches[line].y, strict=True)]

    def lateral(self, line: int, x: float) -> float:
        """Return the lateral position of a line [m], between two of its points."""
        return self._between(self._y, line, x)

    def position(self, line: int, x: float) -> float:
        """Return the index of a point, with a fraction between it and the next one."""
        return self._between(range(len(self._y)), line, x)

    def _between(self, values: Sequence[float], line: int, x: float) -> float:
        """Return the value at a place, by a straight line between the values of two points."""
        key, keys = x + line * self._step, self._keys
        first = sum(len(one.x) for one in self._stretches[:line])
        # The last point whose key is not greater; rounding may take an end to the line before.
        i = max(bisect_right(keys, key) - 1, first - 1, 0)
        if not (key > keys[i] and i + 1 < len(keys)):
            return float(values[i])
        return (values[i + 1] - values[i]) / (keys[i + 1] - keys[i]) * (key - keys[i]) + values[i]
