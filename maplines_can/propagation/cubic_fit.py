"""Cubics fitted to lines of the map: how far they follow a line, and what they miss of it.

``longest_ranges`` gives the longest range in which the cubic of a line deviates from it by no more
than a limit; ``coefficient_variances`` turns what it misses there into variances.

What decides is computed in a fixed order, which ``c/propagation`` follows: so both find the same.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..values.cubics import cubic_fit
from ..values.elementary import sin_cos
from ..values.fixed_order import row_total, total
from ..values.seen_lines import NODES, SHAPE
from .stretches import Stretches

#: As ``NODES``, for the search, which fits many ranges.
_COARSE = sin_cos(np.pi * np.arange(32) / 31)[1][::-1]
#: Starts of the ranges that are tried, as shares of the way from the car back to the window's end.
_STARTS = np.array([0.0, 0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0])
#: A metre behind the car counts this share of a metre ahead.
BEHIND = 0.5
#: Ends that are tried in each round of the search, as shares of the interval that contains the
#: end of the longest range, and the number of rounds.
_ENDS = np.array([0.25, 0.5, 0.75, 1.0])
_ROUNDS = 4
#: Least level of the shape, and standard deviation of T_0 beside the misfit [m]: no map is exact to
#: a centimetre, and a covariance that says so is far from singular.
MIN_SIGMA = 0.01
#: Variance of the coefficient of T_0, in units of the squared misfit.
LATERAL_SHARE = 0.2
#: Least level of the shape squared, in units of the squared misfit.
MIN_SHAPE = 0.1
#: Distances over which second differences of a line are covered [m].
SPACINGS = (5.0, 10.0, 20.0)
#: Standard deviations within which this share of the second differences of the rest lies. A
#: Gaussian has 99.6 % within them; the others lie at a few places, where a line bends sharply.
LIMIT, SHARE = 2.9, 0.97
#: The same for the part of it that errors of the map's points explain: 97 % are within it.
NOISE_LIMIT = 2.17
#: Errors of the points are taken to be as stated if these times the variance that they show is.
SHOWN = 4.0
#: Points that show more than this times the stated variance are not what is stated: all that they
#: leave is taken for the shape of the road.
MAX_SHOWN = 2.0
#: Least number of points that show it, and median of a squared standard normal variable.
MIN_POINTS, MEDIAN = 8, 0.455
#: Intervals of a range, at whose ends the rest is evaluated.
_STEPS = 128
_GRID = np.linspace(-1.0, 1.0, _STEPS + 1)


def _fit_matrix(nodes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (K, 4) matrix from values at nodes to the coefficients of their cubic fit.

    Coefficients are those of w^0 first.
    """
    units, weights = np.eye(len(nodes)), np.ones(len(nodes))
    return cubic_fit(np.tile(nodes[:, None], len(nodes)), units, weights).coefficients.T


#: (K, 4) from values at the nodes to the coefficients of their cubic fit, of w^0 first.
FIT, _COARSE_FIT = _fit_matrix(NODES), _fit_matrix(_COARSE)


def at_nodes(
    x_range: NDArray[np.float64], nodes: NDArray[np.float64] = NODES
) -> NDArray[np.float64]:
    """Return the (..., K) positions of the nodes in (..., 2) ranges."""
    low, high = x_range[..., :1], x_range[..., 1:]
    return (low + high) / 2 + (high - low) / 2 * nodes


def _cubics(y: NDArray[np.float64], fit: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (4, L) coefficients of the cubics through (L, K) values at the nodes of a fit."""
    return row_total(fit[:, :, None] * y.T[:, None])


def _values(q: NDArray[np.float64], w: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (L, K) values of (4, L) cubics at (K,) places in the ranges."""
    q0, q1, q2, q3 = q[:, :, None]
    return q0 + w * (q1 + w * (q2 + w * q3))


class Fitted(NamedTuple):
    """Least-squares fits of cubics to L lines in ranges of them."""

    x_range: NDArray[np.float64]  #: (L, 2) [m]
    x: NDArray[np.float64]  #: (L, K) positions of the nodes [m]
    y: NDArray[np.float64]  #: (L, K) lateral positions of the lines at the nodes [m]
    q: NDArray[np.float64]  #: (4, L) coefficients of w^0 .. w^3, before the shift [m]
    shift: NDArray[np.float64]  #: (L,) of the cubics, that makes their largest deviations least [m]
    misfit: NDArray[np.float64]  #: (L,) largest deviation of a line from its shifted cubic [m]


def fit(stretches: Stretches, x_range: NDArray[np.float64]) -> Fitted:
    """Return the fits in the (L, 2) ranges of all stretches.

    The deviations are those at the nodes and at all points of the lines within the ranges.
    """
    x = at_nodes(x_range)
    y = stretches.lateral(x)
    q = _cubics(y, FIT)
    at_node = y - _values(q, NODES)
    low, high = x_range.T
    of_line = np.vstack([q, (low + high) / 2, (high - low) / 2])
    q0, q1, q2, q3, centre, half = of_line[:, stretches.line]
    w = (stretches.x - centre) / half
    at_point = stretches.y - (q0 + w * (q1 + w * (q2 + w * q3)))
    at_point[np.abs(w) >= 1] = 0.0  # between the extremes, as the residuals have the mean 0
    least = np.minimum(at_node.min(axis=1), np.minimum.reduceat(at_point, stretches.first))
    greatest = np.maximum(at_node.max(axis=1), np.maximum.reduceat(at_point, stretches.first))
    return Fitted(x_range, x, y, q, (greatest + least) / 2, (greatest - least) / 2)


def longest_ranges(
    stretches: Stretches, max_misfit: float, room: float = 0.0, step: float = 0.0
) -> Fitted:
    """Return the fits in the longest ranges of the stretches with a misfit of at most a limit.

    The ranges begin at least ``room`` [m] behind the car, if the line does. With a ``step``, their
    ends are multiples of it, but for ranges that are too short for that [m].

    The least-squares fit is shifted to halve the span of its deviations. This matters for points
    that are far apart in a bend: the line between them is all on one side of the bend.
    """
    fits = fit(stretches, _whole(stretches.x_range, step))
    bad = np.flatnonzero(fits.misfit > max_misfit)
    if len(bad):
        x_range = _whole(stretches.x_range, step)
        x_range[bad] = _whole(_search(stretches, bad, max_misfit, room), step)
        while len(bad := np.flatnonzero((fits := fit(stretches, x_range)).misfit > max_misfit)):
            car = np.clip(0.0, *x_range[bad].T)[:, None]
            x_range[bad] = _whole(car + 0.97 * (x_range[bad] - car), step)
    return fits


def _whole(x_range: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Return (L, 2) ranges with their ends moved inwards to multiples of a step, if it is not 0."""
    if not step:
        return x_range.copy()
    inner = np.column_stack([np.ceil(x_range[:, 0] / step), np.floor(x_range[:, 1] / step)]) * step
    return np.where(inner[:, :1] + step <= inner[:, 1:], inner, x_range)


def _search(
    stretches: Stretches, lines: NDArray[np.intp], max_misfit: float, room: float
) -> NDArray[np.float64]:
    """Return the (B, 2) ranges with the longest reach of B lines, about ``room`` behind the car.

    Each start that is tried is a candidate. The interval that contains the end of its longest
    range is narrowed in rounds. Candidates that cannot become the best of their line are dropped.
    """
    low, high = stretches.x_range[lines].T[:, :, None]  # (B, 1)
    car = np.clip(-room, low, high)
    begin = (car + (low - car) * _STARTS).ravel()
    which = np.arange(len(lines)).repeat(len(_STARTS))
    inner, outer = car[which, 0], high[which, 0]
    found = begin == inner
    for _ in range(_ROUNDS):
        ends = inner[:, None] + (outer - inner)[:, None] * _ENDS  # (C, E)
        x_range = np.stack(np.broadcast_arrays(begin[:, None], ends), axis=-1)
        x = at_nodes(x_range.reshape(-1, 2), _COARSE)
        y = stretches.lateral(x, lines[which].repeat(len(_ENDS)))
        residual = y - _values(_cubics(y, _COARSE_FIT), _COARSE)  # (C E, K)
        span = residual.max(axis=1) - residual.min(axis=1)
        good = (span <= 2 * max_misfit).reshape(ends.shape)
        some = good.any(axis=1)
        rows, last = np.arange(len(ends)), len(_ENDS) - 1
        farthest = last - good[:, ::-1].argmax(axis=1)
        outer = np.where(some, ends[rows, (farthest + 1).clip(max=last)], ends[:, 0])
        inner = np.where(some, ends[rows, farthest], inner)
        found |= some
        reach = np.where(found, inner - BEHIND * begin, -np.inf)
        best = np.full(len(lines), -np.inf)
        np.maximum.at(best, which, reach)
        kept = outer - BEHIND * begin >= best[which]
        begin, inner, outer, found, which, reach = (
            values[kept] for values in (begin, inner, outer, found, which, reach)
        )
    order = np.lexsort([reach, which])
    chosen = order[np.searchsorted(which[order], np.arange(len(lines)), side="right") - 1]
    return np.column_stack([begin, inner])[chosen]


def coefficient_variances(
    stretches: Stretches, fitted: Fitted, point_sigma: float = 0.0
) -> NDArray[np.float64]:
    """Return the (L, 4) variances of the coefficients of T_0 .. T_3 that cover the rest [m^2].

    A cubic leaves a rest of its line, which looks like T_4 and beyond. At each x it is at most the
    misfit, but curvatures and differences of a line at several x see its shape: the rest bends
    within a few metres, and no uncertainty of y_off alone says so. So what the cubic tells of the
    shape is as uncertain as the rest makes it. T_0 takes a share of the misfit, and T_1 .. T_3 have
    ``SHAPE`` times a common level. It is the least one with which the second differences

        y(x) - 2 y(x + d) + y(x + 2 d)

    of the rest, with d of 5, 10 and 20 m, have an rms of at most one standard deviation, and
    nearly all of them are at most 2.9.

    Errors of the map's points are part of the rest, too, and bend it within metres, but the line
    itself is smooth. As far as the points show such errors, and they are stated, their part of the
    second differences is taken off.

    Args:
        stretches: L lines.
        fitted: the fits of cubics to them.
        point_sigma: stated error of the map's points [m].
    """
    x, cubic = at_nodes(fitted.x_range, _GRID), _values(fitted.q, _GRID)
    rest = stretches.lateral(x) - cubic
    position = stretches.position(x)
    noise, stated = np.zeros(len(x)), point_sigma * point_sigma
    for i in range(len(x) if point_sigma > 0 else 0):
        shown = _shown_noise(stretches, i, x[i], cubic[i])
        if shown <= MAX_SHOWN * stated:
            noise[i] = min(SHOWN * shown, stated)
    level = np.maximum(MIN_SHAPE * fitted.misfit**2, MIN_SIGMA * MIN_SIGMA)
    lengths = np.diff(fitted.x_range, axis=1)[:, 0]
    for spacing in SPACINGS:
        steps = np.rint(_STEPS * spacing / lengths).clip(1, _STEPS).astype(np.int64)
        long = np.flatnonzero(2 * steps <= _STEPS)
        if len(long):
            least = _least_level(rest[long], steps[long], position[long], noise[long])
            level[long] = np.maximum(level[long], least)
    variances = level[:, None] * SHAPE
    variances[:, 0] = LATERAL_SHARE * fitted.misfit**2 + MIN_SIGMA * MIN_SIGMA
    return np.asarray(variances)


def _least_level(
    rest: NDArray[np.float64],
    steps: NDArray[np.int64],
    position: NDArray[np.float64],
    noise: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the (L,) least squared levels for second differences over steps of the grid [m^2].

    ``position`` are (L, _STEPS + 1) fractional indices of the grid among the map's points, which
    have errors with the (L,) variances ``noise``.
    """
    first, lines = np.arange(_STEPS + 1), np.arange(len(rest))[:, None]
    steps = steps[:, None]
    count = _STEPS + 1 - 2 * steps
    places = (first + np.arange(3)[:, None, None] * steps).clip(max=_STEPS)  # (3, L, K)
    y0, y1, y2 = rest[lines, places]
    explained = np.zeros_like(rest)
    if noise.any():
        explained = noise[:, None] * second_difference_variance(position[lines, places])
    # Second differences of T_2 are 4 h^2, those of T_3 are 24 w h^2, with w in the middle.
    h, w = steps * 2 / _STEPS, _GRID[first] + steps * 2 / _STEPS
    square = h * h
    variance = square * square * (16 * SHAPE[2] + (24 * w) ** 2 * SHAPE[3])
    squared = (y0 - 2 * y1 + y2) ** 2
    mean = total(np.where(first < count, (squared - explained) / variance, 0.0)) / count[:, 0]
    beyond = squared - NOISE_LIMIT * NOISE_LIMIT * explained
    far = np.where(first < count, beyond / variance, np.inf)
    place = np.ceil(SHARE * count).astype(np.int64) - 1
    greatest = np.take_along_axis(np.sort(far, axis=1), place, axis=1)[:, 0]
    return np.asarray(np.maximum(mean, greatest / (LIMIT * LIMIT)))


def _shown_noise(
    stretches: Stretches, line: int, x: NDArray[np.float64], cubic: NDArray[np.float64]
) -> float:
    """Return the variance of errors of the map's points that a line shows [m^2].

    It is that of white noise with the same median of the squared third differences.
    """
    own = stretches.line == line
    at, y = stretches.x[own], stretches.y[own]
    inside = (at >= x[0]) & (at <= x[-1])
    rest = y[inside] - np.interp(at[inside], x, cubic)
    if len(rest) < MIN_POINTS:
        return 0.0
    return float(np.median(np.diff(rest, 3) ** 2)) / (20 * MEDIAN)


def second_difference_variance(position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (...,) variances of second differences for unit errors of the map's points.

    ``position`` are (3, ...) fractional indices among the points: those of the three places, each
    of which has the weighted mean of its two neighbours.
    """
    below = np.floor(position)
    share = position - below
    factor = np.array([1.0, -2.0, 1.0]).reshape(3, *[1] * (position.ndim - 1))
    indices = np.concatenate([below, below + 1])
    weights = np.concatenate([factor * (1 - share), factor * share])
    pairs = np.where(indices[:, None] == indices, weights[:, None] * weights, 0.0)
    return np.add.reduce(pairs.reshape(-1, *position.shape[1:]), axis=0)  # one after the other
