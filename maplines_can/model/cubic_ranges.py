"""Cubics of map lines: the longest range in which one follows its line, and what it misses there.

A line is sampled at 64 places of a range, denser near its ends, and a cubic is fitted by least
squares. In terms of w, -1 to 1 in the range, the coefficients are products of fixed rows with the
samples. The cubic is then shifted, so that its largest deviation from the line is least.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import NamedTuple

from .levels import NODES, SHAPE
from .lines import cubic_fit, extrema
from .matrices import Matrix, Row, diagonal, dot_by_halves, total, transposed
from .stretches import Stretches, limited

#: Nodes of the fits in the search for the longest range.
COARSE = extrema(32)[::-1]
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


def _fit_rows(nodes: Row) -> Matrix:
    """Return the (4, n) matrix from values at nodes to the coefficients of w^0 .. w^3."""
    units = diagonal([1.0] * len(nodes))
    return transposed([cubic_fit(nodes, unit, end_weight=1.0)[0] for unit in units])


FIT, COARSE_FIT = _fit_rows(NODES), _fit_rows(COARSE)


class Fitted(NamedTuple):
    """Cubic of a line in a range."""

    begin: float  #: of the range [m]
    end: float
    x: Row  #: nodes, and the line there [m]
    y: Row
    q: Row  #: coefficients of w^0 .. w^3, before the shift [m]
    shift: float  #: [m]
    misfit: float  #: the largest deviation [m]


class Limits(NamedTuple):
    """How far a cubic may go."""

    max_misfit: float  #: largest deviation from the line [m]
    room: float = 0.0  #: distance behind the car at which a range begins at least [m]
    step: float = 0.0  #: of which the ends of ranges are multiples; 0 for any [m]


def cubic_through(rows: Matrix, y: Row) -> Row:
    """Return the coefficients of the cubic through values at the nodes of a fit."""
    return [dot_by_halves(row, y) for row in rows]


def cubic_at(q: Row, w: float) -> float:
    """Return the value of a cubic."""
    return q[0] + w * (q[1] + w * (q[2] + w * q[3]))


def places(begin: float, end: float, nodes: Iterable[float]) -> Row:
    """Return the places of nodes in a range."""
    centre, half = (begin + end) / 2, (end - begin) / 2
    return [centre + half * node for node in nodes]


# ---- the longest range ------------------------------------------------------------------------


def fitted_in(seen: Stretches, line: int, begin: float, end: float) -> Fitted:
    """Return the cubic in a range. Its misfit counts at the nodes and at all points within."""
    x = places(begin, end, NODES)
    y = [seen.lateral(line, u) for u in x]
    q = cubic_through(FIT, y)
    rest = [v - cubic_at(q, w) for v, w in zip(y, NODES, strict=True)]
    centre, half = (begin + end) / 2, (end - begin) / 2
    for u, v in seen.points(line):
        w = (u - centre) / half
        rest.append(0.0 if abs(w) >= 1 else v - cubic_at(q, w))
    least, greatest = min(rest), max(rest)
    return Fitted(begin, end, x, y, q, (greatest + least) / 2, (greatest - least) / 2)


def longest_range(seen: Stretches, line: int, limits: Limits) -> Fitted | None:
    """Return the cubic in the longest range with at most the greatest misfit; None without one."""
    ends = _whole(seen.ranges[line], limits.step)
    found = fitted_in(seen, line, *ends)
    if found.misfit > limits.max_misfit:
        ends = _whole(_search(seen, line, limits), limits.step)
        if ends[0] == ends[1]:
            return None
        found = fitted_in(seen, line, *ends)
    for _ in range(SHRINKS):
        if not found.misfit > limits.max_misfit:
            break
        car = limited(0.0, *ends)
        ends = _whole((car + SHRINK * (ends[0] - car), car + SHRINK * (ends[1] - car)), limits.step)
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
    q = cubic_through(COARSE_FIT, y)
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


def _narrowed(seen: Stretches, line: int, span: float, candidate: _Candidate) -> _Candidate:
    begin, inner, outer, is_found = candidate
    ends = [inner + (outer - inner) * share for share in ENDS]
    good = [i for i, end in enumerate(ends) if follows(seen, line, begin, end, span)]
    if not good:
        return _Candidate(begin, inner, ends[0], is_found)
    return _Candidate(begin, ends[good[-1]], ends[min(good[-1] + 1, len(ends) - 1)], True)


def _search(seen: Stretches, line: int, limits: Limits) -> tuple[float, float]:
    """Return the range with the longest reach, about the room behind the car."""
    low, high = seen.ranges[line]
    car = limited(-limits.room, low, high)
    starts = [car + (low - car) * share for share in STARTS]
    candidates = [_Candidate(start, car, high, start == car) for start in starts]
    for _ in range(ROUNDS):
        candidates = [_narrowed(seen, line, 2 * limits.max_misfit, one) for one in candidates]
        best = max(one.reach(one.inner) for one in candidates)
        candidates = [one for one in candidates if one.outer - BEHIND * one.begin >= best]
    chosen = max(reversed(candidates), key=lambda one: one.reach(one.inner))  # the last one
    return chosen.begin, chosen.inner


# ---- what a cubic misses ----------------------------------------------------------------------


def coefficient_variances(seen: Stretches, line: int, cubic: Fitted, point_sigma: float) -> Row:
    """Return the variances of the coefficients of T_0 .. T_3 that cover what a cubic misses [m^2].

    T_0 has a share of the misfit. T_1 .. T_3 have ``SHAPE`` times a level, the least one with which
    second differences of the rest over 5, 10 and 20 m have an rms of one standard deviation, and
    nearly all are at most 2.9. What errors of the map's points explain of them is taken off.

    Args:
        seen: the stretches.
        line: which of them.
        cubic: its cubic.
        point_sigma: stated error of the map's points [m].
    """
    nodes = [i * (2 / (GRID - 1)) - 1 for i in range(GRID)]
    x = places(cubic.begin, cubic.end, nodes)
    fit = [cubic_at(cubic.q, w) for w in nodes]
    rest = [seen.lateral(line, u) - v for u, v in zip(x, fit, strict=True)]
    noise, stated = 0.0, point_sigma * point_sigma
    if point_sigma > 0:
        shown = shown_noise(seen.points(line), x, fit)
        if shown <= MAX_SHOWN * stated:
            noise = min(stated, SHOWN * shown)
    position = [seen.position(line, u) for u in x] if noise > 0 else None
    squared = cubic.misfit * cubic.misfit
    level = max(MIN_SIGMA * MIN_SIGMA, MIN_SHAPE * squared)
    for spacing in SPACINGS:
        steps = max(1, round((GRID - 1) * spacing / (cubic.end - cubic.begin)))
        if 2 * steps <= GRID - 1:
            level = max(level, least_level(rest, steps, position, noise))
    lateral = LATERAL_SHARE * squared + MIN_SIGMA * MIN_SIGMA
    return [lateral, *(share * level for share in SHAPE[1:])]


def least_level(rest: Row, steps: int, position: Row | None, noise: float) -> float:
    """Return the least squared level for second differences over steps of the grid [m^2]."""
    count = GRID - 2 * steps
    h = steps * 2 / (GRID - 1)
    terms, beyond = [0.0] * GRID, []
    for i in range(count):
        # Second differences of T_2 are 4 h^2, those of T_3 are 24 w h^2, with w in the middle.
        of_cubic = 24 * ((i * (2 / (GRID - 1)) - 1) + h)
        variance = h * h * (h * h) * (16 * SHAPE[2] + of_cubic * of_cubic * SHAPE[3])
        second = rest[i] - 2 * rest[i + steps] + rest[i + 2 * steps]
        explained = 0.0
        if position is not None:
            around = position[i], position[i + steps], position[i + 2 * steps]
            explained = noise * second_difference_variance(around)
        terms[i] = (second * second - explained) / variance
        beyond.append((second * second - NOISE_LIMIT * NOISE_LIMIT * explained) / variance)
    far = sorted(beyond)[math.ceil(SHARE * count) - 1] / (LIMIT * LIMIT)
    return max(far, total(terms) / count)


def shown_noise(points: Sequence[tuple[float, float]], x: Row, fit: Row) -> float:
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
    squares, half = sorted(d * d for d in rest), len(rest) // 2
    median = squares[half] if len(rest) % 2 else (squares[half - 1] + squares[half]) / 2
    return median / (20 * MEDIAN)


def second_difference_variance(position: Sequence[float]) -> float:
    """Return the variance of a second difference for unit errors of the map's points.

    Each of the three places has the weighted mean of the errors of two points.
    """
    below = [math.floor(place) for place in position]
    shares = [place - i for place, i in zip(position, below, strict=True)]
    weights = [f * (1 - share) for f, share in zip((1, -2, 1), shares, strict=True)]
    weights += [f * share for f, share in zip((1, -2, 1), shares, strict=True)]
    points = [*below, *(i + 1 for i in below)]
    variance = 0.0
    for i, a in zip(points, weights, strict=True):
        for j, b in zip(points, weights, strict=True):
            variance += a * b if i == j else 0.0
    return variance
