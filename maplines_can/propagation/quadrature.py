"""Gauss-Hermite quadrature."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np

from ..values.errors import IllPosedError
from ..values.gaussian import Gaussian
from .transform import Moments, Rule, Transform, weighted_moments, without_value

#: Largest total weight of points that may be excluded.
NEGLIGIBLE = 1e-3
#: Total weight that is lost in rounding; points with less are excluded without a warning.
ROUNDING = 1e-12


@dataclass(frozen=True)
class Quadrature(Transform):
    """order^n points, the tensor product of the Gauss-Hermite rule.

    It is exact for the mean of polynomials of degree up to 2 order - 1 in each variable. Order 13
    (2197 points for a pose) agrees with a million Monte Carlo draws within their sampling error in
    every scenario of this package; order 5 (125 points) does in all but the street turn with a
    heading sigma of 10 deg. Directions of zero variance get one point. Points at which the function
    has no value are excluded with a warning if their total weight is at most 0.001; Monte Carlo
    would draw as few of them.

    Args:
        order: points in each direction, 1 to 64; odd orders have a point at the mean.

    >>> Quadrature(3)(lambda x: x**2, Gaussian([0.0], [[1.0]])).cov.round(9)
    array([[2.]])
    """

    order: int = 13

    def __post_init__(self) -> None:
        if not (isinstance(self.order, int) and 1 <= self.order <= 64):
            raise ValueError(f"order must be a whole number from 1 to 64, got {self.order!r}")

    def rule(self, gaussian: Gaussian) -> Rule:
        """Return the points in units of the root of the covariance, and their weights."""
        return _rule(self.order, tuple(bool(column.any()) for column in gaussian.root.T))

    def _moments(self, function: Callable[..., Any], gaussian: Gaussian) -> Moments:
        rule = self.rule(gaussian)
        points, w = rule.points(gaussian), rule.mean_weights
        values = np.asarray(function(points), dtype=float)
        excluded = without_value(values)
        if excluded.any():
            if excluded[0] or w[excluded].sum() > NEGLIGIBLE:
                raise IllPosedError(
                    f"the function has no value at {points[excluded][0]} and other points, with a "
                    f"total weight of {w[excluded].sum():.2g}; narrow the Gaussian or use "
                    "MonteCarlo, which excludes and counts such points"
                )
            if w[excluded].sum() > ROUNDING:
                warnings.warn(
                    f"{excluded.sum()} of {len(points)} points, with a total weight of "
                    f"{w[excluded].sum():.1e}, are ill-posed and excluded",
                    stacklevel=4,
                )
            values, w = values[~excluded], w[~excluded] / w[~excluded].sum()
        return weighted_moments(values, w, w)


@lru_cache(maxsize=4)
def _rule(order: int, has_variance: tuple[bool, ...]) -> Rule:
    """Return the tensor product in the directions that have a variance."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(order)
    weights = weights / weights.sum()
    directions = np.flatnonzero(has_variance)
    z, w = (np.array(list(product(a, repeat=len(directions)))) for a in (nodes, weights))
    w = w.prod(axis=1)
    nearest = np.argsort((z**2).sum(axis=1), kind="stable")  # the point nearest the mean first
    points = np.zeros((len(w), len(has_variance)))
    points[:, directions] = z[nearest]
    return Rule(points, w[nearest], w[nearest])
