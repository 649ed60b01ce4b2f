"""What a cubic misses of its line, as a covariance of its four parameters."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..values.seen_lines import NODES, SHAPE
from .stretches import Stretches
from .valid_range import Fitted, at_nodes

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
#: (NODES, _STEPS + 1) matrix from values at the nodes to their cubic fit on the grid.
_TO_GRID = (np.vander(_GRID, 4) @ np.linalg.pinv(np.vander(NODES, 4))).T


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
    x, cubic = at_nodes(fitted.x_range, _GRID), fitted.y @ _TO_GRID
    rest = stretches.lateral(x) - cubic
    position = stretches.position(x)
    noise = np.zeros(len(x))
    for i in range(len(x) if point_sigma > 0 else 0):
        shown = _shown_noise(stretches, i, x[i], cubic[i])
        if shown <= MAX_SHOWN * point_sigma**2:
            noise[i] = min(SHOWN * shown, point_sigma**2)
    level = np.maximum(MIN_SHAPE * fitted.misfit**2, MIN_SIGMA**2)
    lengths = np.diff(fitted.x_range, axis=1)[:, 0]
    for spacing in SPACINGS:
        steps = np.rint(_STEPS * spacing / lengths).astype(np.int64).clip(1)
        long = np.flatnonzero(2 * steps <= _STEPS)
        if len(long):
            least = _least_level(rest[long], steps[long], position[long], noise[long])
            level[long] = np.maximum(level[long], least)
    variances = level[:, None] * SHAPE
    variances[:, 0] = LATERAL_SHARE * fitted.misfit**2 + MIN_SIGMA**2
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
    first = np.arange(_STEPS + 1)
    steps = steps[:, None]
    count = _STEPS + 1 - 2 * steps
    places = [(first + k * steps).clip(max=_STEPS) for k in range(3)]
    y0, y1, y2 = (np.take_along_axis(rest, place, axis=1) for place in places)
    explained = np.zeros_like(rest)
    if noise.any():
        at = np.array([np.take_along_axis(position, place, axis=1) for place in places])
        explained = noise[:, None] * second_difference_variance(at)
    # Second differences of T_2 are 4 h^2, those of T_3 are 24 w h^2, with w in the middle.
    h, w = steps * 2 / _STEPS, _GRID[first] + steps * 2 / _STEPS
    variance = h**4 * (16 * SHAPE[2] + (24 * w) ** 2 * SHAPE[3])
    squared = (y0 - 2 * y1 + y2) ** 2
    mean = np.where(first < count, (squared - explained) / variance, 0.0).sum(axis=1) / count[:, 0]
    far = np.where(first < count, (squared - NOISE_LIMIT**2 * explained) / variance, np.inf)
    place = np.ceil(SHARE * count).astype(np.int64) - 1
    greatest = np.take_along_axis(np.sort(far, axis=1), place, axis=1)[:, 0]
    return np.asarray(np.maximum(mean, greatest / LIMIT**2))


def _shown_noise(
    stretches: Stretches, line: int, x: NDArray[np.float64], cubic: NDArray[np.float64]
) -> float:
    """Return the variance of errors of the map's points that a line shows [m^2].

    It is that of white noise with the same median of the squared third differences.
    """
    inside = (stretches.line == line) & (stretches.x >= x[0]) & (stretches.x <= x[-1])
    rest = stretches.y[inside] - np.interp(stretches.x[inside], x, cubic)
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
    return np.einsum(
        "a...,b...,ab...->...", weights, weights, (indices[:, None] == indices).astype(float)
    )
