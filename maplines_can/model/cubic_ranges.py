"""Cubics of map lines: the longest range in which one follows its line, and what it misses there.

A line is sampled at 64 places of a range, denser near its ends, and a cubic is fitted by least
squares. In terms of w, -1 to 1 in the range, the coefficients are products of fixed rows with the
samples. The cubic is then shifted, so that its largest deviation from the line is least.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from itertools import pairwise
from statistics import median
from typing import NamedTuple

from .elementary import clipped
from .levels import NODES, SHAPE
from .lines import cubic_fit, extrema, places
from .matrices import Matrix, Vector, diagonal, dot_by_halves, total
from .stretches import Stretches

#: Nodes of the fits in the search for the longest range.
COARSE = Vector(extrema(32)[::-1])
#: Starts of the ranges that are tried, as shares of the way from the car back to the window's end;
#: ends that are tried in a round, as shares of what is left; rounds.
STARTS = (0.0, 0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0)
ENDS, ROUNDS = (0.25, 0.5, 0.75, 1.0), 4
#: A metre behind the car counts this share of a metre ahead.
BEHIND = 0.5
#: Share of a range that is kept if its misfit is still too large, and how often at most.
SHRINK, SHRINKS = 0.97, 10_000
#: Places of a range at which second differences are taken, and over which distances [m].
GRID, SPACINGS = 129, (5.0, 10.0, 20.0)
#: Least level of the shape, and standard deviation of T_0 beside the misfit [m].
MIN_SIGMA = 0.01
#: Variance of T_0, and least one of the level of the shape, in units of the squared misfit.
LATERAL_SHARE, MIN_SHAPE = 0.2, 0.1
#: Standard deviations within which this share of the second differences lies; those within which it
#: lies of what errors of the points explain.
LIMIT, SHARE, NOISE_LIMIT = 2.9, 0.97, 2.17
#: Times the variance that points show is taken for that of their errors, up to the stated one; if
#: they show more than so many times the stated one, it is the shape of the road.
SHOWN, MAX_SHOWN = 4.0, 2.0
#: Least number of points that show a variance; median of a squared standard normal variable.
MIN_POINTS, MEDIAN = 8, 0.455


def _fit_rows(nodes: Vector) -> Matrix:
    """Return the (4, n) matrix from values at nodes to the coefficients of w^0 .. w^3."""
    units = diagonal([1.0] * len(nodes))
    return Matrix(cubic_fit(nodes, unit, end_weight=1.0)[0] for unit in units).T


FIT, COARSE_FIT = _fit_rows(NODES), _fit_rows(COARSE)


class Fitted(NamedTuple):
    """Cubic of a line in a range."""

    begin: float  #: of the range [m]
    end: float
    x: Vector  #: nodes, and the line there [m]
    y: Vector
    q: Vector  #: coefficients of w^0 .. w^3, before the shift [m]
    shift: float  #: [m]
    misfit: float  #: the largest deviation [m]


class Limits(NamedTuple):
    """How far a cubic may go."""

    max_misfit: float  #: largest deviation from the line [m]
    room: float = 0.0  #: distance behind the car at which a range begins at least [m]
    step: float = 0.0  #: of which the ends of ranges are multiples; 0 for any [m]


def cubic_at(q: Vector, w: float) -> float:
    """Return the value of a cubic."""
    return q[0] + w * (q[1] + w * (q[2] + w * q[3]))


# ---- the longest range ------------------------------------------------------------------------


def fitted_in(seen: Stretches, line: int, begin: float, end: float) -> Fitted:
    """Return the cubic in a range. Its misfit counts at the nodes and at all points within."""
    x = places(begin, end, NODES)
    y = Vector(seen.lateral(line, u) for u in x)
    q = Vector(dot_by_halves(row, y) for row in FIT)
    rest = [v - cubic_at(q, w) for v, w in zip(y, NODES, strict=True)]
    centre, half = (begin + end) / 2, (end - begin) / 2
    for u, v in seen.points(line):
        w = (u - centre) / half
        rest.append(0.0 if abs(w) >= 1 else v - cubic_at(q, w))
    least, greatest = min(rest), max(rest)
    return Fitted(begin, end, x, y, q, (greatest + least) / 2, (greatest - least) / 2)


def longest_range(seen: Stretches, line: int, limits: Limits) -> Fitted | None:
    """Return the cubic in the longest range with at most the greatest misfit; None without one.

    It is the whole range, the one that is found by search, or that one, shortened to the car.
    """
    ends = _whole(seen.ranges[line], limits.step)
    found = fitted_in(seen, line, *ends)
    for trial in range(SHRINKS + 1):
        if not found.misfit > limits.max_misfit:
            break
        car = clipped(0.0, *ends)
        shorter = car + SHRINK * (ends[0] - car), car + SHRINK * (ends[1] - car)
        ends = _whole(shorter if trial else _search(seen, line, limits), limits.step)
        if ends[0] == ends[1]:
            return None
        found = fitted_in(seen, line, *ends)
    return found if found.misfit <= limits.max_misfit and math.isfinite(found.misfit) else None


def _whole(ends: tuple[float, float], step: float) -> tuple[float, float]:
    """Return a range with its ends moved inwards to multiples of a step, if it is long."""
    if step == 0:
        return ends
    begin, end = (x / step for x in ends)
    low = math.copysign(math.ceil(begin), begin) * step  # -0.0 remains
    high = math.copysign(math.floor(end), end) * step
    return (low, high) if low + step <= high else ends


def follows(seen: Stretches, line: int, begin: float, end: float, span: float) -> bool:
    """Return whether the deviations of a line from its cubic span no more than this."""
    y = [seen.lateral(line, x) for x in places(begin, end, COARSE)]
    q = Vector(dot_by_halves(row, y) for row in COARSE_FIT)
    rest = [v - cubic_at(q, w) for v, w in zip(y, COARSE, strict=True)]
    return max(rest) - min(rest) <= span


class _Candidate(NamedTuple):
    """A range that is tried: its start, and the interval with the end of the longest one."""

    begin: float
    inner: float
    outer: float
    is_found: bool

    def reach(self, end: float) -> float:
        return end - BEHIND * self.begin if self.is_found else -math.inf


def _search(seen: Stretches, line: int, limits: Limits) -> tuple[float, float]:
    """Return the range with the longest reach, about the room behind the car."""

    def narrowed(candidate: _Candidate) -> _Candidate:
        begin, inner, outer, is_found = candidate
        ends, span = [inner + (outer - inner) * share for share in ENDS], 2 * limits.max_misfit
        good = [i for i, end in enumerate(ends) if follows(seen, line, begin, end, span)]
        if not good:
            return _Candidate(begin, inner, ends[0], is_found)
        return _Candidate(begin, ends[good[-1]], [*ends, ends[-1]][good[-1] + 1], True)

    low, high = seen.ranges[line]
    car = clipped(-limits.room, low, high)
    starts = [car + (low - car) * share for share in STARTS]
    candidates = [_Candidate(start, car, high, start == car) for start in starts]
    for _ in range(ROUNDS):
        candidates = [narrowed(one) for one in candidates]
        best = max(one.reach(one.inner) for one in candidates)
        candidates = [one for one in candidates if one.outer - BEHIND * one.begin >= best]
    chosen = max(reversed(candidates), key=lambda one: one.reach(one.inner))  # the last one
    return chosen.begin, chosen.inner


# ---- what a cubic misses ----------------------------------------------------------------------


def coefficient_variances(seen: Stretches, line: int, cubic: Fitted, point_sigma: float) -> Vector:
    """Return the variances of the coefficients of T_0 .. T_3 that cover what a cubic misses [m^2].

    T_0 has a share of the misfit. T_1 .. T_3 have ``SHAPE`` times a level, the least one with which
    second differences of the rest over 5, 10 and 20 m have an rms of one standard deviation, and
    nearly all are at most 2.9. What errors of the map's points explain of them is taken off, up to
    the stated one.
    """
    nodes = [i * (2 / (GRID - 1)) - 1 for i in range(GRID)]
    x = places(cubic.begin, cubic.end, nodes)
    fit = [cubic_at(cubic.q, w) for w in nodes]
    rest = [seen.lateral(line, u) - v for u, v in zip(x, fit, strict=True)]
    noise, stated = 0.0, point_sigma * point_sigma
    if point_sigma > 0:
        shown = shown_noise(seen.points(line), x, fit)
        noise = min(stated, SHOWN * shown) if shown <= MAX_SHOWN * stated else 0.0
    position = [seen.position(line, u) for u in x] if noise > 0 else []
    squared, floor = cubic.misfit * cubic.misfit, MIN_SIGMA * MIN_SIGMA
    level = max(floor, MIN_SHAPE * squared)
    for spacing in SPACINGS:
        steps = max(1, round((GRID - 1) * spacing / (cubic.end - cubic.begin)))
        if 2 * steps <= GRID - 1:
            level = max(level, least_level(rest, steps, position, noise))
    return Vector([LATERAL_SHARE * squared + floor, *(level * SHAPE.diagonal())[1:]])


def least_level(rest: list[float], steps: int, position: list[float], noise: float) -> float:
    """Return the least squared level for second differences over steps of the grid [m^2]."""
    count = GRID - 2 * steps
    h = steps * 2 / (GRID - 1)
    terms, beyond = [0.0] * GRID, []
    for i in range(count):
        # Second differences of T_2 are 4 h^2, those of T_3 are 24 w h^2, with w in the middle.
        of_cubic = 24 * ((i * (2 / (GRID - 1)) - 1) + h)
        variance = h * h * (h * h) * (16 * SHAPE[2][2] + of_cubic * of_cubic * SHAPE[3][3])
        places = i, i + steps, i + 2 * steps
        a, b, c = (rest[k] for k in places)
        squared, explained = (a - 2 * b + c) * (a - 2 * b + c), 0.0
        if noise > 0:
            explained = noise * second_difference_variance([position[k] for k in places])
        terms[i] = (squared - explained) / variance
        beyond.append((squared - NOISE_LIMIT * NOISE_LIMIT * explained) / variance)
    far = sorted(beyond)[math.ceil(SHARE * count) - 1] / (LIMIT * LIMIT)
    return max(far, total(terms) / count)


def shown_noise(points: Sequence[tuple[float, float]], x: Vector, fit: list[float]) -> float:
    """Return the variance of errors of the map's points that a line shows [m^2].

    It is that of white noise with the same median of the squared third differences.
    """
    rest = []
    for u, v in points:
        if x[0] <= u <= x[-1]:
            i = bisect_right(x, u) - 1
            value = fit[i]
            if i + 1 < len(x) and u > x[i]:
                value = (fit[i + 1] - fit[i]) / (x[i + 1] - x[i]) * (u - x[i]) + fit[i]
            rest.append(v - value)
    if len(rest) < MIN_POINTS:
        return 0.0
    for _ in range(3):
        rest = [b - a for a, b in pairwise(rest)]
    return median([d * d for d in rest]) / (20 * MEDIAN)


def second_difference_variance(position: Sequence[float]) -> float:
    """Return the variance of a second difference for unit errors of the map's points.

    Each of the three places has the weighted mean of the errors of two points.
    """
    behind, ahead = [], []  # points, and the weights of their errors
    for place, factor in zip(position, (1, -2, 1), strict=True):
        point = math.floor(place)
        behind.append((point, factor * (1 - (place - point))))
        ahead.append((point + 1, factor * (place - point)))
    variance = 0.0
    for i, a in (*behind, *ahead):
        for j, b in (*behind, *ahead):
            variance += a * b if i == j else 0.0
    return variance
