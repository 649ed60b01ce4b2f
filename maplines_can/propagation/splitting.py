"""Propagation of a Gaussian as a mixture: split it, and propagate each component."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..values.errors import IllPosedError
from ..values.gaussian import Gaussian
from ..values.mixture import GaussianMixture
from .nonlinearity import nonlinearity
from .quadrature import NEGLIGIBLE, Quadrature
from .sigma_points import SigmaPoints
from .transform import Transform, without_value

#: Cuts of N(0, 1) into 1 to 8 intervals, as probabilities in units of 1/32: those of the lower
#: half and of the middle interval; the others follow by symmetry. The intervals cover the whole
#: Gaussian, so together they have its moments of every order. A split into Gaussians of equal
#: variance (DeMars, Bishop and Jah, J. Guidance, Control, and Dynamics 36, 2013) only has those of
#: the first three orders. Its tails are too light: at the vertex of a parabola, the sigma of five
#: such components is 11 % too small. Of all probabilities that are multiples of the step of the
#: DBC, these have the least squared deviation of z^2 from a straight line within each interval.
SPLITS: dict[int, tuple[int, ...]] = {
    1: (32,),
    2: (16,),
    3: (7, 18),
    4: (3, 13),
    5: (2, 8, 12),
    6: (1, 5, 10),
    7: (1, 4, 7, 8),
    8: (1, 3, 5, 7),
}
#: Points without a function value are moved inwards if they are farther out than this [standard
#: deviations]. Their probability is 0.001, as of the points that ``Quadrature`` may exclude.
TAIL = -NormalDist().inv_cdf(NEGLIGIBLE / 2)


@dataclass(frozen=True)
class Mixture:
    """Transform that cuts a Gaussian into k parts and propagates each.

    The Gaussian is cut across the direction in which the function is most nonlinear (for a refit,
    nearly the heading). Each component has the moments of the function within its part. By the law
    of total variance, the mixture as a whole has the moments of the function over the whole
    Gaussian, except for the error of the transform within the parts, and is not overconfident.

    ``Quadrature(7)`` keeps that error small: in all scenes of this package the variance of the
    mixture in its worst direction is at most 6 % too small. ``SigmaPoints()`` needs a fiftieth of
    the points, but may make that variance too small by a factor of 6 with 2 components, 2 with 3,
    and 1.2 with 5. In a street turn with 10 deg of heading uncertainty a single Gaussian has a
    third of its mass on impossible lines; five components have about 4 %.

    If the function has no value at a point more than 3.3 standard deviations from the mean in that
    direction (0.1 % of the probability), the value at a point nearer to the mean is used.

    Args:
        k: number of components, 1 to 8.
        transform: moment transform within each part; None for ``Quadrature(7)``, or
            ``SigmaPoints()`` if k is 1.

    >>> mixture = Mixture(3)(np.square, Gaussian([0.0], [[1.0]]))
    >>> mixture.weights * 32, mixture.overall.mean.round(3), mixture.overall.cov.round(2)
    (array([ 7., 18.,  7.]), array([1.]), array([[2.]]))
    """

    k: int = 3
    transform: Transform | None = None

    def __post_init__(self) -> None:
        if self.k not in SPLITS:
            raise ValueError(f"k must be a whole number from 1 to {max(SPLITS)}, got {self.k!r}")

    def __call__(self, function: Callable[..., Any], gaussian: Gaussian) -> GaussianMixture:
        """Return the mixture that approximates the distribution of the function's value.

        Raises:
            IllPosedError: the function has no value at a point that is needed.
            ValueError: the function returns several outputs (use ``moments``).
        """
        weights, means, covs = self.moments(function, gaussian)
        if means.ndim != 2:
            raise ValueError(
                f"the function has {means.shape[1]} outputs; use moments() for all of them at once"
            )
        return GaussianMixture(weights, tuple(map(Gaussian, means, covs)))

    def moments(
        self, function: Callable[..., Any], gaussian: Gaussian
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return weights (k,), means (k, ..., m) and covariances (k, ..., m, m) of all outputs.

        Raises:
            IllPosedError: the function has no value at a point that is needed.
        """
        if self.k == 1:
            mean, cov = (self.transform or SigmaPoints()).moments(function, gaussian)
            return np.ones(1), mean[None], cov[None]
        transform = self.transform or Quadrature(7)
        weights, _, _ = standard_split(self.k)
        direction = nonlinearity(function, gaussian).direction
        moments = []
        for i in range(self.k):
            part = _Part(function, gaussian, direction, weights, i)
            try:
                moments.append(transform.moments(part, part.standard))
            except IllPosedError as error:
                raise IllPosedError(
                    f"in the standardised variables of component {i + 1} of {self.k}, {error}"
                ) from error
        mean, cov = (np.array(values) for values in zip(*moments, strict=True))
        return weights, mean, cov


@cache
def standard_split(
    k: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return (k,) weights, means and variances of N(0, 1) cut into k intervals, in ascending order.

    >>> weights, means, variances = standard_split(2)
    >>> weights, means.round(3), variances.round(3)
    (array([0.5, 0.5]), array([-0.798,  0.798]), array([0.363, 0.363]))
    """
    from scipy.special import ndtri  # loads scipy, which the start of a program does not need

    half = SPLITS[k]
    weights = np.array(half + half[: k // 2][::-1]) / 32
    edges = ndtri(np.cumsum(weights)[:-1])
    density = np.exp(-(edges**2) / 2) / np.sqrt(2 * np.pi)
    means = -np.diff(density, prepend=0, append=0) / weights
    variances = 1 - np.diff(edges * density, prepend=0, append=0) / weights - means**2
    for array in (weights, means, variances):
        array.flags.writeable = False
    return weights, means, variances


class _Part:
    """A function within one part of a Gaussian, as a function of standard normal variables.

    One of the variables is mapped to the part by matching quantiles.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        gaussian: Gaussian,
        direction: NDArray[np.float64],
        weights: NDArray[np.float64],
        i: int,
    ) -> None:
        self._function = function
        self._mean = gaussian.mean
        self._below, self._above = weights[:i].sum(), weights[i + 1 :].sum()
        self._weight = weights[i]
        self.noise_cov = getattr(function, "noise_cov", None)
        varies = gaussian.root.any(axis=0)
        #: N(0, I), without the variables that do not vary.
        self.standard = Gaussian(np.zeros(gaussian.dimension), np.diag(varies.astype(float)))
        u = np.where(varies, direction, 0.0)
        self._axis = int(np.argmax(np.abs(u)))
        # The reflection maps that axis to u, and leaves directions perpendicular to both unchanged.
        reflection = np.eye(len(u))
        v = u / (np.copysign(np.linalg.norm(u), u[self._axis]) or 1.0) - reflection[self._axis]
        if v.any():
            reflection -= 2 * np.outer(v, v) / (v @ v)
        self._root = gaussian.root @ reflection

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        from scipy.special import ndtr, ndtri

        y = points[:, self._axis]
        p, q = self._below + self._weight * ndtr(y), self._above + self._weight * ndtr(-y)
        z = np.where(p < q, ndtri(p), -ndtri(q))  # both tails to full precision
        values = np.array(self._at(points, z))
        while (move := without_value(values) & (np.abs(z) > TAIL)).any():
            z[move] = np.copysign(np.maximum(0.97 * np.abs(z[move]), TAIL), z[move])
            values[move] = self._at(points[move], z[move])
        return values

    def _at(self, points: NDArray[np.float64], z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the values at points, with z in place of the variable of the cut."""
        points = points.copy()
        points[:, self._axis] = z
        return np.asarray(self._function(self._mean + points @ self._root.T), dtype=float)
