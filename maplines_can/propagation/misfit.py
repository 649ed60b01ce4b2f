"""What a cubic misses of its line, as a covariance of its four parameters."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..polyline import Stretches
from ..seen_lines import NODES, SHAPE
from .valid_range import Fitted, at_nodes

#: Least misfit that is covered [m]; less is beyond any map, and would leave a singular covariance.
LEAST_MISFIT = 0.001
#: Variance of the coefficient of T_0, in units of the squared misfit.
LATERAL_SHARE = 0.25
#: Least level of the shape squared, in units of the squared misfit.
LEAST_SHAPE = 0.1
#: Distances over which second differences of a line are covered [m].
SPACINGS = (5.0, 10.0, 20.0)
#: Standard deviations within which this share of the second differences of the rest lies. A
#: Gaussian has 99.6 % within them; the others lie at a few places, where a line bends sharply.
LIMIT, SHARE = 2.9, 0.97
#: Intervals of a range, at whose ends the rest is evaluated.
_STEPS = 128
_GRID = np.linspace(-1.0, 1.0, _STEPS + 1)
#: (NODES, _STEPS + 1) matrix from values at the nodes to their cubic fit on the grid.
_TO_GRID = (np.vander(_GRID, 4) @ np.linalg.pinv(np.vander(NODES, 4))).T


def coefficient_variances(stretches: Stretches, fitted: Fitted) -> NDArray[np.float64]:
    """Return the (L, 4) variances of the coefficients of T_0 .. T_3 that cover the rest [m^2].

    A cubic leaves a rest of its line, which looks like T_4 and beyond. At each x it is at most the
    misfit, but curvatures and differences of a line at several x see its shape: the rest bends
    within a few metres, and no uncertainty of y_off alone says so. So what the cubic tells of the
    shape is as uncertain as the rest makes it. T_0 takes a share of the misfit, and T_1 .. T_3 have
    ``SHAPE`` times a common level. It is the least one with which the second differences

        y(x) - 2 y(x + d) + y(x + 2 d)

    of the rest, with d of 5, 10 and 20 m, have an rms of at most one standard deviation, and
    nearly all of them are at most 2.9.

    Args:
        stretches: L lines.
        fitted: the fits of cubics to them.
    """
    rest = stretches.lateral(at_nodes(fitted.x_range, _GRID)) - fitted.y @ _TO_GRID
    misfit = np.maximum(fitted.misfit, LEAST_MISFIT)
    level = LEAST_SHAPE * misfit**2
    lengths = np.diff(fitted.x_range, axis=1)[:, 0]
    for spacing in SPACINGS:
        steps = np.rint(_STEPS * spacing / lengths).astype(np.int64).clip(1)
        long = np.flatnonzero(2 * steps <= _STEPS)
        if len(long):
            level[long] = np.maximum(level[long], _least_level(rest[long], steps[long]))
    variances = level[:, None] * SHAPE
    variances[:, 0] = LATERAL_SHARE * misfit**2
    return np.asarray(variances)


def _least_level(rest: NDArray[np.float64], steps: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the (L,) least squared levels for second differences over steps of the grid [m^2]."""
    first = np.arange(_STEPS + 1)
    steps = steps[:, None]
    count = _STEPS + 1 - 2 * steps
    y0, y1, y2 = (
        np.take_along_axis(rest, (first + k * steps).clip(max=_STEPS), axis=1) for k in range(3)
    )
    # Second differences of T_2 are 4 h^2, those of T_3 are 24 w h^2, with w in the middle.
    h, w = steps * 2 / _STEPS, _GRID[first] + steps * 2 / _STEPS
    variance = h**4 * (4**2 * SHAPE[2] + (24 * w) ** 2 * SHAPE[3])
    squared = np.where(first < count, (y0 - 2 * y1 + y2) ** 2 / variance, np.inf)
    mean = np.where(first < count, squared, 0.0).sum(axis=1) / count[:, 0]
    place = np.ceil(SHARE * count).astype(np.int64) - 1
    greatest = np.take_along_axis(np.sort(squared, axis=1), place, axis=1)[:, 0]
    return np.asarray(np.maximum(mean, greatest / LIMIT**2))
