"""Gauss-Hermite quadrature."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from ..errors import IllPosedError
from ..gaussian import Gaussian
from .transform import Moments, Transform, weighted_moments

__all__ = ["Quadrature"]


#: Weight of the points that may be left out.
NEGLIGIBLE = 1e-3


@dataclass(frozen=True)
class Quadrature(Transform):
    """order^n points, the tensor product of the Gauss-Hermite rule.

    Exact for the mean of polynomials up to degree 2 order - 1 in each variable.
    Order 13 agrees with a million Monte Carlo draws within their sampling error
    in every scenario here, with 2197 points; order 5 (125 points) in all but the
    street turn with a heading sigma of 10 deg. Directions without variance get
    one point. Outermost points at which the function has no value are left out
    and warned of, as long as they hardly weigh anything (Monte Carlo would draw
    as few).

    Args:
        order: points in each direction, 1 or more; odd orders hold the mean.

    >>> Quadrature(3)(lambda x: x**2, Gaussian([0.0], [[1.0]])).cov.round(9)
    array([[2.]])
    """

    order: int = 13

    def __post_init__(self) -> None:
        if not (isinstance(self.order, int) and 1 <= self.order <= 64):
            raise ValueError(f"order must be a whole number from 1 to 64, got {self.order!r}")

    def _moments(self, function: Callable[..., Any], gaussian: Gaussian) -> Moments:
        nodes, weights = np.polynomial.hermite_e.hermegauss(self.order)
        weights = weights / weights.sum()
        columns = gaussian.root.T[gaussian.root.any(axis=0)]  # (r, n) of the directions that vary
        z, w = (np.array(list(product(a, repeat=len(columns)))) for a in (nodes, weights))
        w = w.prod(axis=1)
        middle = np.argsort((z**2).sum(axis=1), kind="stable")  # the point next the mean first
        z, w = z[middle], w[middle]
        points = gaussian.mean + z @ columns
        values = np.asarray(function(points), dtype=float)
        lost = np.isnan(values.reshape(len(points), -1)).any(axis=1)
        if lost.any():
            if lost[0] or w[lost].sum() > NEGLIGIBLE:
                raise IllPosedError(
                    f"the function has no value at {points[lost][0]} and other points that weigh "
                    f"{w[lost].sum():.2g} of 1; narrow the Gaussian or use MonteCarlo, which "
                    "counts such samples and goes on"
                )
            warnings.warn(
                f"{lost.sum()} of {len(points)} points, which weigh {w[lost].sum():.1e}, are "
                "ill-posed and left out",
                stacklevel=4,
            )
            values, w = values[~lost], w[~lost] / w[~lost].sum()
        return weighted_moments(values, w, w)
