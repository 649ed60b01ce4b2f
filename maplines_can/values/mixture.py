"""Gaussian mixtures, for distributions that one Gaussian does not describe well."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import floats
from .gaussian import Gaussian

Array = NDArray[np.float64]


def moments(weights: Array, means: Array, covs: Array) -> tuple[Array, Array]:
    """Return the (..., n) mean and the (..., n, n) covariance of mixtures.

    The components are added one after the other, as a receiver in C does.

    Args:
        weights: (..., k).
        means: (..., k, n).
        covs: (..., k, n, n) symmetric.
    """
    mean = _weighted_sum(weights, means)
    d = means - mean[..., None, :]
    return mean, _weighted_sum(weights, covs + d[..., :, None] * d[..., None, :])


def _weighted_sum(weights: Array, values: Array) -> Array:
    """Return the (..., ...) sums of (..., k, ...) values, the first one first."""
    w = weights.reshape(*weights.shape, *[1] * (values.ndim - weights.ndim))
    return np.add.reduce(w * values, axis=weights.ndim - 1)


@dataclass(frozen=True, eq=False)
class GaussianMixture:
    """The distribution ``sum_i weights[i] N(components[i])``.

    Args:
        weights: (k,) positive, with sum 1 up to 1e-9.
        components: k Gaussians of the same dimension.

    Raises:
        ValueError: a weight is not positive, their sum is not 1, their number is not
            that of the components, or the components differ in dimension.

    >>> two = GaussianMixture([0.5, 0.5], [Gaussian([-1.0], [[1.0]]), Gaussian([1.0], [[1.0]])])
    >>> two.overall.cov
    array([[2.]])
    """

    weights: NDArray[np.float64]
    components: tuple[Gaussian, ...]

    if TYPE_CHECKING:  # the fields have the types after conversion

        def __init__(self, weights: ArrayLike, components: Iterable[Gaussian]) -> None: ...

    def __post_init__(self) -> None:
        weights = np.array(floats(self.weights, "weights"))
        components = tuple(self.components)
        if weights.shape != (len(components),) or not components:
            raise ValueError(
                f"weights must have shape ({len(components)},), one for each component, "
                f"got {weights.shape}"
            )
        if not ((weights > 0) & (weights < 2)).all() or not abs(weights.sum() - 1) < 1e-9:
            raise ValueError(f"weights must be positive with sum 1, got {weights!r}")
        if len({component.dimension for component in components}) > 1:
            dimensions = [component.dimension for component in components]
            raise ValueError(f"components must have the same dimension, got {dimensions}")
        weights.flags.writeable = False
        object.__setattr__(self, "weights", weights)
        object.__setattr__(self, "components", components)

    @property
    def dimension(self) -> int:
        """Number of variables n."""
        return self.components[0].dimension

    @cached_property
    def means(self) -> NDArray[np.float64]:
        """(k, n) means of the components."""
        return np.array([component.mean for component in self.components])

    @cached_property
    def covs(self) -> NDArray[np.float64]:
        """(k, n, n) covariances of the components."""
        return np.array([component.cov for component in self.components])

    @cached_property
    def overall(self) -> Gaussian:
        """The Gaussian with the mean and covariance of the mixture."""
        with np.errstate(over="ignore", invalid="ignore"):  # Gaussian raises for such a result
            return Gaussian(*moments(self.weights, self.means, self.covs))

    def marginal(self, indices: ArrayLike) -> GaussianMixture:
        """Return the mixture of some of the variables, in the order of ``indices``."""
        return GaussianMixture(self.weights, tuple(c.marginal(indices) for c in self.components))

    def sample(self, n: int, seed: int | np.random.Generator = 0) -> NDArray[np.float64]:
        """Return (n, dimension) random draws; the same seed gives the same draws."""
        rng = np.random.default_rng(seed)
        chosen = rng.choice(len(self.weights), size=n, p=self.weights / self.weights.sum())
        roots = np.array([component.root for component in self.components])
        normal = rng.standard_normal((n, self.dimension))
        return self.means[chosen] + np.einsum("nij,nj->ni", roots[chosen], normal)

    def density(self, x: ArrayLike) -> NDArray[np.float64]:
        """Return the (...,) probability density at (..., n) points.

        Raises:
            numpy.linalg.LinAlgError: the covariance of a component is singular.
        """
        x = floats(x, "x")
        total = np.zeros(x.shape[:-1])
        for weight, component in zip(self.weights, self.components, strict=True):
            norm = np.sqrt(2 * np.pi) ** self.dimension * component.root.diagonal().prod()
            total += weight / norm * np.exp(-(component.mahalanobis(x) ** 2) / 2)
        return total

    def coverage(self, samples: ArrayLike, mass: float = 0.99, draws: int = 200_000) -> float:
        """Return the share of (N, n) samples inside the highest-density region of ``mass``.

        The density at the edge of the region is estimated from draws of the mixture.
        The standard error of the share is about sqrt(mass (1 - mass) / draws).

        Raises:
            numpy.linalg.LinAlgError: the covariance of a component is singular.
        """
        edge = np.quantile(self.density(self.sample(draws)), 1 - mass)
        return float(np.mean(self.density(samples) >= edge))
