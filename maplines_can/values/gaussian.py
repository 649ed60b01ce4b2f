"""Gaussian distributions of any dimension; the covariance may be singular."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import lib
from ..core.memory import new, pointer
from .arrays import floats
from .linalg import (
    MAX_COV,
    asymmetric,
    indefinite,
    rounding_of,
    scale_of,
    solve_lower,
    square_root,
)


@dataclass(frozen=True, eq=False)
class Gaussian:
    """A normal distribution N(mean, cov).

    Args:
        mean: (n,) finite.
        cov: (n, n) finite (up to 1e307), symmetric and positive semidefinite, both up to
            rounding (1e-9 of the standard deviations, 1e-5 for float32). Zero
            variances and exactly singular matrices are allowed.

    Raises:
        ValueError: a shape or a value is wrong, or ``cov`` is not symmetric or
            not positive semidefinite.

    >>> ego = Gaussian([0.0, 0.0, 0.0], [[0.25, 0, 0], [0, 0.25, 0], [0, 0, 0]])
    >>> ego.sigma
    array([0.5, 0.5, 0. ])
    >>> Gaussian([0.0, 0.0], [[1, 2], [2, 1]])
    Traceback (most recent call last):
    ...
    ValueError: cov must be positive semidefinite, but the smallest eigenvalue of its correlation \
matrix is -1; use nearest_covariance(cov), which covers it
    """

    mean: NDArray[np.float64]
    cov: NDArray[np.float64]

    if TYPE_CHECKING:  # the fields have the types after conversion

        def __init__(self, mean: ArrayLike, cov: ArrayLike) -> None: ...

    def __post_init__(self) -> None:
        mean = floats(self.mean, "mean").copy()
        cov = floats(self.cov, "cov").copy()
        rounding = rounding_of(self.cov)
        n = mean.size
        fits = n > 0 and mean.shape == (n,) and cov.shape == (n, n)
        arrays = (pointer(mean), pointer(cov), new("double[]", n * (n + 1))) if fits else ()
        if not fits or not lib.maplines_check_gaussian(n, rounding, *arrays):
            raise _fault(mean, cov, rounding)
        mean.setflags(write=False)
        cov.setflags(write=False)
        self.__dict__.update(mean=mean, cov=cov)

    @classmethod
    def trusted(cls, mean: NDArray[np.float64], cov: NDArray[np.float64]) -> Gaussian:
        """Return a Gaussian of the given arrays without copying or checking them.

        The arrays become read-only. For matrices that are positive semidefinite by
        construction, as in a decoder; otherwise call ``Gaussian(mean, cov)``.
        """
        gaussian = object.__new__(cls)
        mean.setflags(write=False)
        cov.setflags(write=False)
        gaussian.__dict__.update(mean=mean, cov=cov)
        return gaussian

    @property
    def dimension(self) -> int:
        """Number of variables n."""
        return self.mean.size

    @cached_property
    def sigma(self) -> NDArray[np.float64]:
        """(n,) standard deviations, in the units of the mean."""
        return np.sqrt(self.cov.diagonal())

    @cached_property
    def correlation(self) -> NDArray[np.float64]:
        """(n, n) correlation matrix; a variable of zero variance correlates with no other."""
        scale = np.where(self.sigma > 0, self.sigma, 1.0)
        correlation = self.cov / scale[:, None] / scale
        np.fill_diagonal(correlation, 1.0)
        return correlation

    @cached_property
    def root(self) -> NDArray[np.float64]:
        """(n, n) lower-triangular ``L`` with ``L @ L.T`` equal to the covariance."""
        return square_root(self.cov)

    def marginal(self, indices: ArrayLike) -> Gaussian:
        """Return the Gaussian of some of the variables, in the order of ``indices``.

        Raises:
            ValueError: an index is not a whole number from 0 to n - 1.

        >>> Gaussian([1, 2, 3], np.diag([1, 4, 9])).marginal([2, 0]).mean
        array([3., 1.])
        """
        given = floats(indices, "indices")
        known = (given >= 0) & (given < self.dimension) & (given == np.floor(given))
        if given.ndim != 1 or not known.all():
            raise ValueError(f"indices must be (k,) from 0 to {self.dimension - 1}, got {given!r}")
        keep = given.astype(int)
        return Gaussian(self.mean[keep], self.cov[np.ix_(keep, keep)])

    def sample(self, n: int, seed: int | np.random.Generator = 0) -> NDArray[np.float64]:
        """Return (n, dimension) random draws; the same seed gives the same draws."""
        normal = np.random.default_rng(seed).standard_normal((n, self.dimension))
        return self.mean + normal @ self.root.T

    @np.errstate(over="ignore", invalid="ignore")
    def mahalanobis(self, x: ArrayLike) -> NDArray[np.float64]:
        """Return the (...,) Mahalanobis distances of (..., n) points from the mean.

        Distances beyond 1e154 are infinite.

        Raises:
            numpy.linalg.LinAlgError: the covariance is singular.
        """
        d = floats(x, "x") - self.mean
        z = solve_lower(self._factor(), d.reshape(-1, self.dimension).T)
        return np.sqrt((z**2).sum(axis=0)).reshape(d.shape[:-1])

    @np.errstate(over="ignore")
    def coverage(self, samples: ArrayLike, mass: float = 0.99) -> float:
        """Return the share of (N, n) samples inside the central region of probability ``mass``.

        If the Gaussian approximates the distribution of the samples, 1 - share is
        its rate of false negatives (Map Line Interface, section IV).

        Raises:
            ValueError: ``mass`` is not between 0 and 1, or there are no samples.
            numpy.linalg.LinAlgError: the covariance is singular.
        """
        from scipy.special import gammaincinv

        if not 0 < mass < 1:
            raise ValueError(f"mass must be more than 0 and less than 1, got {mass!r}")
        if not np.size(samples):
            raise ValueError("samples must be (N, n) with N >= 1, got none")
        chi2_quantile = 2 * gammaincinv(self.dimension / 2, mass)
        inside = self.mahalanobis(samples) ** 2 <= chi2_quantile
        return float(np.mean(inside))

    def kl(self, other: Gaussian) -> float:
        """Return the Kullback-Leibler divergence KL(self || other) [nat].

        It is infinite if ``self`` is singular: all its samples lie in a subspace
        that has probability 0 under ``other``.

        Raises:
            ValueError: ``other`` has another number of variables.
            numpy.linalg.LinAlgError: the covariance of ``other`` is singular.

        >>> round(Gaussian([0.0], [[1.0]]).kl(Gaussian([1.0], [[1.0]])), 12)
        0.5
        """
        if other.dimension != self.dimension:
            raise ValueError(
                f"other must be over {self.dimension} variables as this one, got {other.dimension}"
            )
        L = other._factor()
        A = solve_lower(L, self.root)
        z = solve_lower(L, self.mean - other.mean)
        with np.errstate(divide="ignore"):
            log_det = np.log(np.abs(A.diagonal())).sum()
        return float(((A**2).sum() + z @ z - self.dimension) / 2 - log_det)

    def _factor(self) -> NDArray[np.float64]:
        """Return ``root``; raises LinAlgError if the covariance is singular."""
        if not self.root.diagonal().all():
            raise np.linalg.LinAlgError(
                "the covariance is singular, so the Gaussian has no density; "
                "take a marginal of fewer variables"
            )
        return self.root


def _fault(mean: NDArray[np.float64], cov: NDArray[np.float64], rounding: float) -> ValueError:
    """Return what is wrong with a mean and a covariance that the core refuses."""
    if mean.ndim != 1 or mean.size == 0 or not np.isfinite(mean).all():
        return ValueError(f"mean must be finite with shape (n,), got {mean!r}")
    if cov.shape != (mean.size, mean.size) or not (np.abs(cov) <= MAX_COV).all():  # or NaN
        return ValueError(f"cov must be finite with shape {(mean.size,) * 2}, got {cov!r}")
    variances = cov.diagonal()
    if (variances < 0).any():
        return ValueError(f"cov must have variances of 0 or more, got {variances!r}")
    if cov[variances == 0].any():
        return ValueError(
            f"cov must be 0 in the row and column of a zero variance, got {cov!r}; "
            "use nearest_covariance(cov)"
        )
    if asymmetric(cov, rounding).any():
        return ValueError(f"cov must be symmetric, got {cov!r}; use (cov + cov.T) / 2")
    cov = (cov + cov.T) / 2
    if indefinite(cov, rounding).any():
        scale = scale_of(cov)
        smallest = np.linalg.eigvalsh(cov / scale / scale[:, None])[0]
        return ValueError(
            "cov must be positive semidefinite, but the smallest eigenvalue of its "
            f"correlation matrix is {smallest:g}; use nearest_covariance(cov), which covers it"
        )
    return ValueError(f"cov is no covariance for the core, got {cov!r}")


def independent(first: Gaussian, second: Gaussian) -> Gaussian:
    """Return the joint Gaussian of two independent ones, the variables of ``first`` first.

    >>> independent(Gaussian([1.0], [[4.0]]), Gaussian([2.0], [[9.0]])).cov
    array([[4., 0.],
           [0., 9.]])
    """
    n = first.dimension
    mean = np.concatenate([first.mean, second.mean])
    cov = np.zeros((len(mean), len(mean)))
    cov[:n, :n], cov[n:, n:] = first.cov, second.cov
    return Gaussian.trusted(mean, cov)


def variances(sigma: ArrayLike) -> NDArray[np.float64]:
    """Return the (...,) squares of standard deviations.

    Raises:
        ValueError: a value is negative or not finite, or its square exceeds 1e307.

    >>> variances([0.5, 2.0])
    array([0.25, 4.  ])
    """
    sigmas = floats(sigma, "sigma")
    most = np.sqrt(MAX_COV)
    if not ((sigmas >= 0) & (sigmas <= most)).all():
        raise ValueError(f"sigma must be 0 or more and finite (up to {most:.2g}), got {sigmas!r}")
    return np.square(sigmas)
