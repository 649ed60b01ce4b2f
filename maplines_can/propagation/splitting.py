"""Propagation of a Gaussian as a mixture: split it, and propagate each component."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..gaussian import Gaussian
from ..mixture import GaussianMixture
from .nonlinearity import nonlinearity
from .sigma_points import SigmaPoints
from .transform import Transform

#: Splits of N(0, 1) into 1 to 8 components of equal variance: (weights in units of 1/32, means) of
#: the components with mean <= 0, the others by symmetry. They minimise the criterion of DeMars,
#: Bishop and Jah (J. Guidance, Control, and Dynamics 36, 2013): the squared difference of the
#: densities plus lambda times the variance of a component. There are two additional conditions. The
#: variance of the mixture is 1, so that it is not overconfident; that of the published splits is 3
#: to 5 % less. The weights are multiples of the step of the DBC. Lambda is 0.025 instead of 0.001:
#: narrow components follow a nonlinear function better, and at 0.025 the rate of false negatives in
#: the scenario street-turn-10deg is still 2 % (``maplines accuracy``).
SPLITS: dict[int, tuple[tuple[int, ...], tuple[float, ...]]] = {
    1: ((32,), (0.0,)),
    2: ((16,), (-0.67447659,)),
    3: ((8, 16), (-1.18119087, 0.0)),
    4: ((4, 12), (-1.56524658, -0.4845612)),
    5: ((3, 8, 10), (-1.72078912, -0.77553635, 0.0)),
    6: ((2, 5, 9), (-1.89783659, -1.08014129, -0.35967955)),
    7: ((1, 4, 7, 8), (-2.18955912, -1.32118671, -0.61990638, 0.0)),
    8: ((1, 3, 5, 7), (-2.17884173, -1.42745197, -0.82948607, -0.27778741)),
}
#: Number of weight steps that add up to 1.
WEIGHT_STEPS = 32


@dataclass(frozen=True)
class Mixture:
    """Transform that splits a Gaussian into k components and propagates each.

    The Gaussian is split along the direction in which the function is most nonlinear (for a refit,
    the heading). The components are narrower in that direction and as wide as the Gaussian in the
    others. In a street turn with 10 deg of heading uncertainty a single Gaussian has a third of its
    mass on impossible lines; five components have about 4 %.

    Args:
        k: number of components, 1 to 8.
        transform: moment transform of each component.

    >>> mixture = Mixture(3)(np.square, Gaussian([0.0], [[1.0]]))
    >>> mixture.weights.round(3), mixture.overall.mean.round(9)
    (array([0.25, 0.5 , 0.25]), array([1.]))
    """

    k: int = 3
    transform: Transform = field(default_factory=SigmaPoints)

    def __post_init__(self) -> None:
        if self.k not in SPLITS:
            raise ValueError(f"k must be a whole number from 1 to {max(SPLITS)}, got {self.k!r}")

    def __call__(self, function: Callable[..., Any], gaussian: Gaussian) -> GaussianMixture:
        """Return the mixture that approximates the distribution of the function's value.

        Raises:
            IllPosedError: the function has no value at a point that is needed.
            ValueError: the function returns several outputs (use ``moments``).
        """
        split = self.split(gaussian, function)
        components = tuple(self.transform(function, component) for component in split.components)
        return GaussianMixture(split.weights, components)

    def moments(
        self, function: Callable[..., Any], gaussian: Gaussian
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return weights (k,), means (k, ..., m) and covariances (k, ..., m, m) of all outputs."""
        split = self.split(gaussian, function)
        moments = [self.transform.moments(function, component) for component in split.components]
        mean, cov = (np.array(values) for values in zip(*moments, strict=True))
        return split.weights, mean, cov

    def split(
        self,
        gaussian: Gaussian,
        function: Callable[..., Any] | None = None,
        direction: ArrayLike | None = None,
    ) -> GaussianMixture:
        """Split a Gaussian into a mixture of the same mean and covariance.

        Args:
            gaussian: the Gaussian to split.
            function: split along the direction in which it is most nonlinear.
            direction: (n,) split along this direction of the standardised variables instead.
        """
        if direction is None and function is not None and self.k > 1:
            direction = nonlinearity(function, gaussian).direction
        weights, offsets = standard_split(self.k)
        u = np.zeros(gaussian.dimension) if direction is None else np.asarray(direction, float)
        norm = np.linalg.norm(u)
        u = u / norm if norm else u
        step = gaussian.root @ u
        cov = gaussian.cov - (weights @ offsets**2) * np.outer(step, step)
        components = tuple(Gaussian(gaussian.mean + offset * step, cov) for offset in offsets)
        return GaussianMixture(weights, components)


def standard_split(k: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return weights (k,) and means (k,) of the components of N(0, 1), in ascending order."""
    half_weights, half_means = (np.array(half) for half in SPLITS[k])
    weights = np.append(half_weights, half_weights[: k // 2][::-1]) / WEIGHT_STEPS
    return weights, np.append(half_means, -half_means[: k // 2][::-1])
