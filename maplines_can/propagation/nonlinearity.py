"""Nonlinearity of a function within a Gaussian, and the direction in which it is largest."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..values.gaussian import Gaussian
from .transform import values_at

#: Distance of the evaluation points from the mean [standard deviations], that of sigma points.
SIGMA_SPREAD = np.sqrt(3.0)
#: Outputs of less spread than this share of the largest value have rounding errors only, such as
#: the curvature of a straight line.
MIN_SPREAD = 1e-9


class Nonlinearity(NamedTuple):
    """Direction and amount of the largest deviation of a function from its tangent."""

    direction: NDArray[np.float64]  #: (n,) unit vector in the standardised variables
    #: Standard deviation of the second-order term along the direction, divided by the total
    #: standard deviation, for the output where this ratio is largest; from 0 to 1.
    amount: float


def nonlinearity(function: Callable[..., Any], gaussian: Gaussian) -> Nonlinearity:
    """Return the direction in which a function is most nonlinear within a Gaussian, and how much.

    Second differences at sqrt(3) standard deviations give the Hessian of each output, in units of
    the standard deviation of that output. The direction maximises the sum of the squares of their
    quadratic forms.

    Raises:
        IllPosedError: the function has no value at a point that is needed.
    """
    n = gaussian.dimension
    axes = np.eye(n)
    pairs = [(i, j) for i in range(n) for j in range(i)]
    diagonals = [(axes[i] + sign * axes[j]) / np.sqrt(2) for i, j in pairs for sign in (1, -1)]
    directions = np.array([*axes, *diagonals])
    places = np.vstack([np.zeros(n), directions, -directions])
    points = gaussian.mean + SIGMA_SPREAD * places @ gaussian.root.T
    values = values_at(function, points).reshape(len(points), -1)  # (P, outputs)
    middle, ahead, behind = np.split(values, [1, 1 + len(directions)])
    bends = (ahead + behind - 2 * middle) / SIGMA_SPREAD**2
    H = np.zeros((values.shape[1], n, n))
    for i in range(n):
        H[:, i, i] = bends[i]
    for k, (i, j) in enumerate(pairs):
        # Along (e_i + e_j) / sqrt(2) and (e_i - e_j) / sqrt(2): half their difference is H_ij.
        H[:, i, j] = H[:, j, i] = (bends[n + 2 * k] - bends[n + 2 * k + 1]) / 2
    slopes = (ahead - behind)[:n] / (2 * SIGMA_SPREAD)
    variance = (slopes**2).sum(axis=0) + (H**2).sum(axis=(1, 2)) / 2
    spread = np.sqrt(variance)
    varies = spread > MIN_SPREAD * np.abs(values).max(initial=0.0)
    H = H[varies] / spread[varies, None, None]

    def strength(u: NDArray[np.float64]) -> float:
        return float((np.einsum("oij,i,j->o", H, u, u) ** 2).sum())

    best = axes[np.argmax([strength(u) for u in axes])]
    for _ in range(30):  # power iteration of a symmetric form of degree four
        next_ = np.einsum("o,oij,j->i", np.einsum("oij,i,j->o", H, best, best), H, best)
        norm = np.linalg.norm(next_)
        if not norm or strength(next_ / norm) <= strength(best):
            break
        best = next_ / norm
    along = np.einsum("oij,i,j->o", H, best, best)
    return Nonlinearity(best, float(np.abs(along).max(initial=0.0) / np.sqrt(2)))
