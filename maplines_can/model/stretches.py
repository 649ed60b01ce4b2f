"""Stretches of map lines: what a car sees of them, as functions y(x) in its frame.

A line may run in either direction, turn back, or cross the road. What is seen of it is the run of
steps around the nearest one that all run along the x axis, or all against it, within a window.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise
from typing import NamedTuple

from .elementary import clipped, hypot, sin_cos
from .matrices import Vector

#: Length over which the direction of a line is taken [m].
DIRECTION_BASE = 0.5
#: The least normal number: a step of no length has the square of this one.
LEAST_SQUARE = 2.0**-1022
#: Largest error that a point shows, and largest distance from a chord [m]; more is a corner.
MOST_ERROR, MOST_SAGITTA = 1.0, 3.0
#: Points of which errors, and distances from chords, are taken, if the line has so many.
ERRORS, SAGITTAS = 30.0, 8.0
#: Squared fourth differences for a degree of freedom.
PER_FREEDOM = 2.63
#: Error that is typical by the squared spacing of points [1/m], at most [m], and the degrees of
#: freedom for which it counts.
TYPICAL, MOST_TYPICAL, TYPICAL_COUNT = 1.8e-4, 0.06, 1.5
#: Of the widening by Student's t, which holds 3 sigma from 3 degrees of freedom on.
STUDENT = 1.3
#: Variance of a line between its points by the squared sagitta, if there are many; number of points
#: with which it is twice as much.
BETWEEN, FEW_POINTS = 7e-4, 9.0
#: The same by the square of the typical error, by that of the errors that points show if they are
#: far apart, and the spacing at which half of that counts [m].
BY_TYPICAL, BY_ERROR, FAR_APART = 0.3, 0.1, 10.0
#: Distance of points that show kinks, at least [m]; intensity of kinks by their squared error and
#: distance to the power -3.
COARSE, PER_KINK = 12.0, 26.2
#: Of the errors of close points, what explains those of points far apart, and of points that are no
#: closer.
AS_ERRORS, AS_ERRORS_FAR = 1.4, 0.5
#: Kinks that errors can hide, by their variance [1/m^3], and over which distance these are averaged
#: [m].
HIDING, AVERAGED = 0.04, 5.0


@dataclass(frozen=True, eq=False)
class Path:
    """A line of the map."""

    x: list[float]  #: of its points [m]
    y: list[float]
    distance: list[float]  #: arc length from the first point to each [m]

    @cached_property
    def errors(self) -> list[float]:
        """Sums of the squared errors that points show, before each point [m^2]."""
        known = range(2, len(self.x) - 2)
        terms = (shown_error(self, i) if i in known else 0.0 for i in range(len(self.x)))
        return [*accumulate(terms, initial=0.0)][:-1]

    @cached_property
    def sagittas(self) -> list[float]:
        """Sums of their squared distances from the chords of their neighbours [m^2]."""
        known = range(1, len(self.x) - 1)
        terms = (squared_sagitta(self, i) if i in known else 0.0 for i in range(len(self.x)))
        return [*accumulate(terms, initial=0.0)][:-1]

    @cached_property
    def coarse(self) -> tuple[list[float], list[float], tuple[int, int]]:
        """Sums of the squared errors that points far apart show, before each point [m^2].

        And those of their distances [m], and between which points they are known.
        """
        errors, distances, known = [0.0], [0.0], []
        for i in range(len(self.x)):
            at, error, distance = far_points(self.distance, i), 0.0, 0.0
            if at is not None:
                known.append(i)
                error = error_of(self, at)
                distance = (self.distance[at[4]] - self.distance[at[0]]) / 4
            errors.append(errors[-1] + error)
            distances.append(distances[-1] + distance)
        ends = (known[0], known[-1] + 1) if known else (0, 0)
        return errors[:-1], distances[:-1], ends


class Look(NamedTuple):
    """Where the car is, and what it looks at."""

    pose: Sequence[float]  #: x, y [m] and heading [rad] in the frame of the map
    low: float  #: window, in the frame of the car [m]
    high: float
    max_turn: float  #: largest angle between a line and the x axis [rad]
    max_unseen: float = math.inf  #: most that a line may bend between points, as a sigma [m]


class Shown(NamedTuple):
    """What the points of a line show of their errors, and of the line between them [m^2]."""

    error: float = 0.0  #: variance of the errors of the points
    widened: float = 0.0  #: the same, as far as so many points can tell it
    sagitta: float = 0.0  #: mean square of the distances of points from chords
    bends: float = 0.0  #: variance of the line between points, by the bends that they show
    unseen: float = 0.0  #: the same in all
    kinks: float = 0.0  #: that errors hide: variance of the direction by length [1/m]


class Stretch(NamedTuple):
    """What is seen of a line."""

    x: list[float]  #: of the points, which include those next to both ends [m]
    y: list[float]
    begin: float  #: of the range [m]
    end: float
    shown: Shown


class Cells(NamedTuple):
    """Cells of equal length in a range of a stretch, which is -1 to 1 in w."""

    y: Vector  #: means of the line [m]
    square: Vector  #: of what the chords between its points exceed w^2 by
    cube: Vector  #: and w^3
    position: list[float]  #: of their ends: indices of points, with fractions


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
    x, y, distance = path.x, path.y, path.distance
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
    x, y, distance = path.x, path.y, path.distance
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
    if not begin < end:
        return "NOT_IN_WINDOW"
    shown = shown_by(path, first + inside[0], direction[nearest], x, (begin, end))
    if shown.bends > look.max_unseen * look.max_unseen:
        return "FEW_POINTS"
    return Stretch(x, y, begin, end, shown)


# ---- errors of points -------------------------------------------------------------------------


def capped(square: float, most: float) -> float:
    """Return the square of a length up to the square of another one; 0 if it is not a number."""
    positive = square if square > 0 else 0.0
    return positive if positive < most * most else most * most


def quotient(a: float, b: float) -> float:
    """Return a / b as IEEE 754 has it, also for b = 0."""
    if b == 0:
        is_negative = math.copysign(1.0, a) * math.copysign(1.0, b) < 0
        return math.nan if a == 0 or math.isnan(a) else math.copysign(math.inf, -is_negative or 1)
    return a / b


def shown_error(path: Path, i: int) -> float:
    """Return the squared error that a point and the two next to it on each side show [m^2]."""
    return error_of(path, range(i - 2, i + 3))


def error_of(path: Path, at: Sequence[int]) -> float:
    """Return the squared error that five points show [m^2].

    It is their fourth divided difference, in standard deviations for independent errors of 1 m.
    Errors along the line cancel.
    """
    x, y, distance = path.x, path.y, path.distance
    sum_x = sum_y = squares = 0.0
    for n, j in enumerate(at):
        product = 1.0
        for m, k in enumerate(at):
            if m != n:
                product *= distance[j] - distance[k]
        weight = quotient(1.0, product)
        sum_x += weight * (x[j] - x[at[2]])
        sum_y += weight * (y[j] - y[at[2]])
        squares += weight * weight
    return capped(quotient(sum_x * sum_x + sum_y * sum_y, squares), MOST_ERROR)


def far_points(distance: Sequence[float], i: int) -> list[int] | None:
    """Return a point and the two nearest on each side that are not closer than ``COARSE``.

    None if there are none.
    """
    at = [i]
    for _ in range(2):
        least = distance[at[0]] - COARSE
        if distance[0] > least:
            return None
        at.insert(0, min(bisect_right(distance, least), at[0]) - 1)
    for _ in range(2):
        at.append(bisect_left(distance, distance[at[-1]] + COARSE))
        if at[-1] == len(distance):
            return None
    return at


def squared_sagitta(path: Path, i: int) -> float:
    """Return the squared distance of a point from the chord of its neighbours [m^2]."""
    x, y = path.x, path.y
    before, after = (x[i] - x[i - 1], y[i] - y[i - 1]), (x[i + 1] - x[i], y[i + 1] - y[i])
    chord_x, chord_y = before[0] + after[0], before[1] + after[1]
    across = before[0] * after[1] - before[1] * after[0]
    return capped(quotient(across * across, chord_x * chord_x + chord_y * chord_y), MOST_SAGITTA)


def mean_of(
    sums: Sequence[float], ends: tuple[int, int], low: float, high: float, least: float
) -> tuple[float, float]:
    """Return the mean of terms of points from one place among them to another, and their number.

    There are sums before each point. A term extends half a point to both sides. Those from the
    first end to before the other are known. If there are too few, those around count, too.
    """
    first, last = (float(end) for end in ends)
    wider = max(0.0, (least - (high - low)) / 2)
    if not last > first:
        return 0.0, 0.0
    begin, end = low + 0.5 - wider, high + 0.5 + wider
    begin = begin if begin < last - least else last - least
    begin = begin if begin > first else first
    end = end if end > first + least else first + least
    end = end if end < last else last
    i, j = int(begin), int(end)
    of_begin = (begin - i) * (sums[i + 1] - sums[i])
    of_end = (end - j) * (sums[j + 1] - sums[j]) if j + 1 < len(sums) else 0.0
    return ((sums[j] - sums[i]) + (of_end - of_begin)) / (end - begin), end - begin


def hidden_kinks(
    path: Path, low: float, high: float, error: float, typical: float, spacing: float
) -> float:
    """Return the kinks of a line that errors of its points hide [1/m].

    They are the variance of what its direction changes in a metre, if it changes at random. Fourth
    differences of points h apart have a variance of 8/3 h^3 by kinks, and of 70 by errors. So those
    are kinks that points far apart show beside the errors of close ones, up to what these can hide.
    """
    errors, distances, ends = path.coarse
    coarse, _ = mean_of(errors, ends, low, high, ERRORS)
    distance, _ = mean_of(distances, ends, low, high, ERRORS)
    ratio = quotient(spacing, distance)
    closeness = 1 - ratio * ratio if ratio < 1 else 0.0
    explained = (AS_ERRORS_FAR + (AS_ERRORS - AS_ERRORS_FAR) * closeness) * error
    rest = coarse - explained - typical * typical
    kinks = quotient(PER_KINK * rest, distance * distance * distance)
    most = HIDING * error / (1 + quotient(AVERAGED, spacing))
    product = kinks * most
    return product / (kinks + most) if product > 0 else 0.0


def shown_by(
    path: Path, first: int, direction: int, x: Sequence[float], ends: tuple[float, float]
) -> Shown:
    """Return what the points of a stretch show; ``first`` is the first of them in the path.

    A typical error stands for what a line of few points cannot show. Two points are a straight
    line.
    """
    behind = (ends[0] - x[0]) / (x[1] - x[0]) if x[1] > x[0] else 0.0
    ahead = (x[-1] - ends[1]) / (x[-1] - x[-2]) if x[-1] > x[-2] else 0.0
    low = first + (behind if direction > 0 else ahead)
    high = (first + (len(x) - 1)) - (ahead if direction > 0 else behind)
    error, errors = mean_of(path.errors, (2, len(path.x) - 2), low, high, ERRORS)
    square, sagittas = mean_of(path.sagittas, (1, len(path.x) - 1), low, high, SAGITTAS)
    sagitta = square - 1.5 * error
    sagitta = sagitta if sagitta > 0 else 0.0
    spacing = quotient(ends[1] - ends[0], high - low)
    usual = TYPICAL * spacing * spacing
    typical = 0.0 if len(path.x) == 2 else usual if usual < MOST_TYPICAL else MOST_TYPICAL
    freedom = errors / PER_FREEDOM
    full = freedom + TYPICAL_COUNT
    share = TYPICAL_COUNT / full * (typical * typical)
    ratio = (full + 2.0) / (full + 2.0 - STUDENT)
    widened = (freedom / full * error + share) * (ratio * ratio) * (ratio * ratio)
    few = FEW_POINTS / (sagittas + 2.0)
    bends = BETWEEN * sagitta * (1.0 + few * few * few * (few * few * few))
    apart = 1 / (1 + quotient(FAR_APART, spacing))
    unseen = bends + BY_TYPICAL * share + BY_ERROR * error * apart
    kinks = hidden_kinks(path, low, high, error, typical, spacing)
    return Shown(error, widened, sagitta, bends, unseen, kinks)


# ---- values of stretches ----------------------------------------------------------------------


class Stretches:
    """Stretches of several lines, one after the other.

    The keys of their points ascend: x, plus a multiple of a step that keeps the lines apart.
    """

    def __init__(self, stretches: Sequence[Stretch]) -> None:
        self.ranges = [(one.begin, one.end) for one in stretches]
        self.shown = [one.shown for one in stretches]
        self._y = [y for one in stretches for y in one.y]
        self._first = [*accumulate((len(one.x) for one in stretches), initial=0)]
        self._step = 2 * max((abs(x) for one in stretches for x in one.x), default=0.0) + 1
        keys = (x + line * self._step for line, one in enumerate(stretches) for x in one.x)
        self.keys = [*accumulate(keys, max)]  # close points may run back a little
        self._integrals = [self._integrals_of(line) for line in range(len(stretches))]

    def _integrals_of(self, line: int) -> list[tuple[float, float, float]]:
        """Return, for each point, integrals from the first one.

        They are of y, and of what the chords of x^2 and x^3 exceed these by.
        """
        found, shift = [(0.0, 0.0, 0.0)], line * self._step
        for i in range(self._first[line], self._first[line + 1] - 1):
            low, high = self.keys[i] - shift, self.keys[i + 1] - shift
            length = high - low
            more = length * length * length / 6
            area, square, cube = found[-1]
            found.append(
                (
                    area + (self._y[i] + self._y[i + 1]) / 2 * length,
                    square + more,
                    cube + more * (1.5 * (low + high)),
                )
            )
        return found

    def cells(self, line: int, begin: float, end: float, count: int) -> Cells:
        """Return the cells of a range."""
        first, last, shift = self._first[line], self._first[line + 1] - 1, line * self._step
        centre, half, length = (begin + end) / 2, (end - begin) / 2, (end - begin) / count
        scale = quotient(1.0, half * half * length)
        integrals, position = [], []
        for k in range(count + 1):
            x = begin + k * length if k < count else end
            # The last point of the stretch whose key is not greater.
            i = max(bisect_right(self.keys, x + shift, first, last + 1) - 1, first)
            low = self.keys[i] - shift
            beyond = x - low
            area, square, cube = self._integrals[line][i - first]
            place = float(i)
            if beyond > 0 and i < last:
                step = self.keys[i + 1] - self.keys[i]
                slope = (self._y[i + 1] - self._y[i]) / step
                beyond2 = beyond * beyond
                by_two = step * beyond2 / 2 - beyond2 * beyond / 3
                by_three = step * (beyond2 * beyond) / 3 - beyond2 * beyond2 / 4
                area += beyond * (self._y[i] + slope * beyond / 2)
                square += by_two
                cube += by_three + (2 * low + self.keys[i + 1] - shift) * by_two
                place += beyond / step
            integrals.append((area, square, cube))
            position.append(place)
        found = []
        for before, after in pairwise(integrals):
            area, square, cube = (b - a for a, b in zip(before, after, strict=True))
            cube = (cube - 3 * centre * square) * scale / half
            found.append((area / length, square * scale, cube))
        of_y, of_square, of_cube = zip(*found, strict=True)
        return Cells(Vector(of_y), Vector(of_square), Vector(of_cube), position)
