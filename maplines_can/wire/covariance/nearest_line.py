"""The line within the ranges of a message that is nearest to one that exceeds them.

To clip one parameter alone moves the line by up to tens of metres: the others have to make up for
it. In a short range they do so to a few centimetres, since there the parameters of a cubic can be
told apart only poorly.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...values.line import PARAMETERS
from ...values.seen_lines import NODES
from ..layout.signals import Signal
from .code import Array

#: Largest deviation of such a line from the given one in its range [m]: as much as a cubic may
#: deviate from the line of the map.
MAX_DEVIATION = 0.1
#: Factor by which a range is shortened towards the car, until the deviation is that small, and the
#: most times.
SHORTER, TRIALS = 0.8, 24
#: Greatest direction of such a line [rad].
STEEPEST = 1.5
#: Steps of its signal that a parameter keeps from the end of its range, for the rounding.
STEPS = 8
#: Share of the largest standard deviation of a parameter that may make up for its deviation.
SHARE = 0.7
#: Nodes at which lines are compared, in the normalised variable of a range.
_NODES = NODES[::3]


class NearestLine(NamedTuple):
    """A line within the ranges of a message."""

    mean: Array  #: (4,)
    x_range: Array  #: (2,) where it deviates by at most ``MAX_DEVIATION`` [m]


def nearest_line(
    signals: Sequence[Signal], mean: Array, x_range: Array, least: float, reach: Array
) -> NearestLine | None:
    """Return the line that is nearest to a given one, by least squares in the longest range.

    The range is shortened towards the car as far as necessary.

    Args:
        signals: of y_off, beta, c0 and c1.
        mean: (4,) line.
        x_range: (2,) range of the line [m].
        least: least length of the range [m].
        reach: (4,) standard deviations that a covariance can have.

    Returns:
        None if no line within the ranges of the signals is near enough in any range that is long
        enough.
    """
    # loads scipy, which a decoder does not need
    from scipy.optimize import lsq_linear

    bounds = np.array([_bounds(signal) for signal in signals])  # (4, 2)
    away = SHARE * reach
    bounds = np.column_stack(
        [np.maximum(bounds[:, 0], mean - away), np.minimum(bounds[:, 1], mean + away)]
    )
    line = np.array(mean)
    bounds[1], line[1] = np.tan(bounds[1].clip(-STEEPEST, STEEPEST)), np.tan(mean[1])
    if not (np.diff(bounds)[:, 0] > 1e-9 * np.abs(bounds).max(axis=1)).all():
        return None
    scale = np.abs(bounds).max(axis=1)
    car = np.clip(0.0, *x_range)
    for trial in range(TRIALS):
        low, high = car + SHORTER**trial * (x_range - car)
        if high - low < least:
            return None
        x = (low + high) / 2 + (high - low) / 2 * _NODES
        A = np.vander(x, len(PARAMETERS), increasing=True) / [1, 1, 2, 6] * scale
        y = A @ (line / scale)
        found = lsq_linear(A, y, (bounds.T / scale), method="bvls").x
        if np.abs(A @ found - y).max() <= MAX_DEVIATION:
            found = (found * scale).clip(*bounds.T)
            found[1] = np.arctan(found[1])
            return NearestLine(found, np.array([low, high]))
    return None


def slope_error(mean: Array, near: Array) -> Array:
    """Return the (..., 4) errors of lines whose first-order effect is that of their slopes.

    The lateral position depends on beta by its tangent, so that the error of a line is another one
    than the difference of the parameters if that of beta is large.
    """
    error = mean - near
    error[..., 1] = (np.tan(mean[..., 1]) - np.tan(near[..., 1])) * np.cos(near[..., 1]) ** 2
    return np.asarray(error)


def is_within(signals: Sequence[Signal], means: Array) -> NDArray[np.bool_]:
    """Return which of (..., 4) lines are within the ranges of the signals."""
    low, high = np.array([_bounds(signal) for signal in signals]).T
    return np.asarray(((low <= means) & (means <= high)).all(axis=-1))


def _bounds(signal: Signal) -> tuple[float, float]:
    """Return the least and the greatest value of a parameter, some steps within its range."""
    low, high = signal.physical_range
    step = STEPS * abs(signal.factor)
    return low + step, high - step
