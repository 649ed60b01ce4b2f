"""First-order propagation: the tangent at the mean."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..values.gaussian import Gaussian
from .transform import Moments, Transform, values_at


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
