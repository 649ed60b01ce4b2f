"""The interface of the moment transforms: Gaussian and function in, Gaussian out; a linear one."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from ..core import lib
from ..core.memory import pointer
from ..values.errors import IllPosedError
from ..values.gaussian import Gaussian


class Moments(NamedTuple):
    """Means and covariances of one or several outputs, as ``BatchCodec.encode`` takes them."""

    mean: NDArray[np.float64]  #: (..., m)
    cov: NDArray[np.float64]  #: (..., m, m)


@dataclass(frozen=True, eq=False)
class Rule:
    """Points of a transform: the mean and the root of the covariance times z, and their weights.

    The first one is at the mean, or the nearest to it.
    """

    z: NDArray[np.float64]  #: (N, n)
    mean_weights: NDArray[np.float64]  #: (N,)
    cov_weights: NDArray[np.float64]  #: (N,)

    def points(self, gaussian: Gaussian) -> NDArray[np.float64]:
        """Return the (N, n) points of a Gaussian."""
        # The terms are added one after the other, on any machine.
        terms = self.z.T[:, :, None] * gaussian.root.T[:, None]
        return gaussian.mean + np.add.reduce(terms, axis=0)


class Transform(ABC):
    """Moment transform: mean and covariance of ``function(x)`` for a Gaussian ``x``.

    The function is vectorised: it takes (N, n) points and returns (N, m) values,
    or (N, L, m) for L outputs. A row of NaN means that it has no value at the point.
    It may have an attribute ``noise_cov`` of shape (m, m) or (L, m, m): the covariance
    of an independent error, such as that of a map, which is added to the result.
    """

    @final
    def __call__(self, function: Callable[..., Any], gaussian: Gaussian) -> Gaussian:
        """Return the Gaussian with the moments of the function's value.

        Raises:
            IllPosedError: the function has no value at a point that the transform needs.
            ValueError: the function returns several outputs (use ``moments``).
        """
        mean, cov = self.moments(function, gaussian)
        if mean.ndim != 1:
            raise ValueError(
                f"the function has {mean.shape[0]} outputs; use moments() for all of them at once"
            )
        return Gaussian(mean, cov)

    @final
    def moments(self, function: Callable[..., Any], gaussian: Gaussian) -> Moments:
        """Return mean (m,) and cov (m, m); or (L, m) and (L, m, m) of L outputs of the function.

        Raises:
            IllPosedError: the function has no value at a point that the transform needs.
        """
        mean, cov = self._moments(function, gaussian)
        noise_cov = getattr(function, "noise_cov", None)
        if noise_cov is not None:
            cov = cov + noise_cov
        return Moments(mean, (cov + cov.swapaxes(-1, -2)) / 2)

    @abstractmethod
    def _moments(self, function: Callable[..., Any], gaussian: Gaussian) -> Moments:
        """Return the moments without ``noise_cov``."""


def without_value(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the (N,) points at which a function has no value, by its (N, ...) values."""
    if not np.isnan(values.max(initial=0.0)):  # the most frequent case, in one pass
        return np.zeros(len(values), bool)
    return np.asarray(np.isnan(values.reshape(len(values), -1)).any(axis=1))


def values_at(function: Callable[..., Any], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the values of a function at points, all of which must have one.

    Raises:
        IllPosedError: the function has no value at a point.
        ValueError: the number of values is not the number of points.
    """
    values = np.asarray(function(points), dtype=float)
    if len(values) != len(points):
        raise ValueError(
            "the function must return one row per point, "
            f"got shape {values.shape} for points of shape {points.shape}"
        )
    missing = without_value(values)
    if missing.any():
        raise IllPosedError(
            f"the function has no value at {points[missing][0]}, {missing.sum()} of the "
            f"{len(points)} points of the transform; narrow the Gaussian or use MonteCarlo, "
            "which excludes and counts such points"
        )
    return values


def weighted_moments(
    values: NDArray[np.float64], mean_weights: NDArray[np.float64], cov_weights: NDArray[np.float64]
) -> Moments:
    """Return mean and covariance of weighted points (Map Line Interface, eq. 11 and 12).

    The sums are over differences from the first of the (N, ..., m) values, that of the mean or a
    point near it, whose weight may be large and negative. This avoids cancellation. The (N,)
    weights of the mean have the sum 1.
    """
    n, *outputs, m = values.shape
    given = map(np.ascontiguousarray, (mean_weights, cov_weights, values))
    mean, cov = np.empty((*outputs, m)), np.empty((*outputs, m, m))
    arrays = map(pointer, (*given, np.empty(m), mean, cov))
    lib.maplines_moments_of(n, math.prod(outputs), m, *arrays)
    return Moments(mean, cov)


@dataclass(frozen=True)
class Linear(Transform):
    """Mean ``f(m)`` and covariance ``J P J^T``: the first-order expansion of f at the mean m.

    It is exact for an affine function and the cheapest transform, but ignores curvature: in a turn
    with several degrees of heading uncertainty it misses the shift of the mean and most of the
    spread of c0 and c1. No derivative is needed: the product of J and a column of the square root
    of P is a fourth-order central difference along that column.

    Args:
        step: step of the difference, in standard deviations.

    >>> doubled = Linear()(lambda x: 2 * x, Gaussian([1.0], [[4.0]]))
    >>> float(doubled.mean[0]), round(float(doubled.cov[0, 0]), 9)
    (2.0, 16.0)
    """

    step: float = 0.01

    def __post_init__(self) -> None:
        if not 0 < self.step < np.inf:
            raise ValueError(f"step must be more than 0 standard deviations, got {self.step!r}")

    def _moments(self, function: Callable[..., Any], gaussian: Gaussian) -> Moments:
        columns = gaussian.root.T  # (n, n), row i is column i of the root
        steps = self.step * np.array([1, -1, 2, -2])
        offsets = (steps[:, None, None] * columns).reshape(-1, gaussian.dimension)
        values = values_at(
            function, gaussian.mean + np.vstack([np.zeros_like(columns[:1]), offsets])
        )
        near, anti_near, far, anti_far = values[1:].reshape(4, len(columns), *values.shape[1:])
        slopes = (8 * (near - anti_near) - (far - anti_far)) / (12 * self.step)
        cov = np.einsum("k...i,k...j->...ij", slopes, slopes)
        return Moments(values[0], cov)
