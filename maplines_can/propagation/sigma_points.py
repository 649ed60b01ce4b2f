"""The scaled unscented transform."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from ..values.gaussian import Gaussian
from .transform import Moments, Rule, Transform, values_at, weighted_moments


@dataclass(frozen=True)
class SigmaPoints(Transform):
    """2n + 1 points (Map Line Interface, eq. 4 to 12; van der Merwe 2004).

    The mean of a cubic and the covariance of an affine function are exact. With the
    defaults the points lie at sqrt(n) standard deviations, no weight is negative and
    the result is always positive semidefinite. A small alpha moves the points towards
    the mean (and the result towards that of Linear); the covariance may then be indefinite.

    Args:
        alpha: spread of the points, more than 0 (the paper: up to 1).
        kappa: second scaling, n + kappa > 0 (the paper: 0 or more).
        beta: prior knowledge of the distribution, 2 for a Gaussian.

    >>> SigmaPoints()(lambda x: x**2, Gaussian([1.0], [[4.0]])).mean
    array([5.])
    """

    alpha: float = 1.0
    kappa: float = 0.0
    beta: float = 2.0

    def __post_init__(self) -> None:
        if not 0 < self.alpha < np.inf:
            raise ValueError(f"alpha must be more than 0, got {self.alpha!r}")
        for name in ("kappa", "beta"):
            if not np.isfinite(getattr(self, name)):
                raise ValueError(f"{name} must be finite, got {getattr(self, name)!r}")

    def rule(self, gaussian: Gaussian) -> Rule:
        """Return the points, the mean first, and their weights (eq. 4 to 10)."""
        return _rule(self, gaussian.mean.size)

    def _moments(self, function: Callable[..., Any], gaussian: Gaussian) -> Moments:
        rule = self.rule(gaussian)
        values = values_at(function, rule.points(gaussian))
        return weighted_moments(values, rule.mean_weights, rule.cov_weights)


#: The default transform of lines, motions and predictions.
SIGMA_POINTS = SigmaPoints()


@lru_cache(maxsize=16)
def _rule(transform: SigmaPoints, n: int) -> Rule:
    if not n + transform.kappa > 0:
        raise ValueError(f"kappa must be more than -{n} for {n} variables, got {transform.kappa!r}")
    n_plus_lambda = transform.alpha**2 * (n + transform.kappa)
    steps = math.sqrt(n_plus_lambda) * np.eye(n)
    mean = np.full(2 * n + 1, 1 / (2 * n_plus_lambda))
    mean[0] = 1 - n / n_plus_lambda
    cov = mean.copy()
    cov[0] += 1 - transform.alpha**2 + transform.beta
    return Rule(np.vstack([np.zeros(n), steps, -steps]), mean, cov)
