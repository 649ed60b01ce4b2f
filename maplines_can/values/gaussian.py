"""Gaussian distributions of any dimension; the covariance may be singular."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import floats

#: Asymmetry and negative eigenvalues up to this, relative to the standard
#: deviations, count as rounding errors; larger ones are the caller's mistake.
ROUNDING = 1e-9
#: Largest variance or covariance; sums of such values stay within the floats.
MAX_COV = 1e307


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
        rounding = rounding_of(self.cov)
        mean = np.array(floats(self.mean, "mean"))
        cov = np.array(floats(self.cov, "cov"))
        if mean.ndim != 1 or mean.size == 0 or not np.isfinite(mean).all():
            raise ValueError(f"mean must be finite with shape (n,), got {mean!r}")
        if cov.shape != (mean.size, mean.size) or not (np.abs(cov) <= MAX_COV).all():
            raise ValueError(f"cov must be finite with shape {(mean.size,) * 2}, got {cov!r}")
        if (cov.diagonal() < 0).any():
            raise ValueError(f"cov must have variances of 0 or more, got {cov.diagonal()!r}")
        if cov[cov.diagonal() == 0].any():
            raise ValueError(
                f"cov must be 0 in the row and column of a zero variance, got {cov!r}; "
                "use nearest_covariance(cov)"
            )
        if asymmetric(cov, rounding):
            raise ValueError(f"cov must be symmetric, got {cov!r}; use (cov + cov.T) / 2")
        cov = (cov + cov.T) / 2
        if indefinite(cov, rounding):
            scale = _scale(cov)
            least = np.linalg.eigvalsh(cov / scale / scale[:, None])[0]
            raise ValueError(
                "cov must be positive semidefinite, but the smallest eigenvalue of its "
                f"correlation matrix is {least:g}; use nearest_covariance(cov), which covers it"
            )
        for name, array in (("mean", mean), ("cov", cov)):
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    @classmethod
    def trusted(cls, mean: NDArray[np.float64], cov: NDArray[np.float64]) -> Gaussian:
        """Return a Gaussian of the given arrays without copying or checking them.

        The arrays become read-only. For matrices that are positive semidefinite by
        construction, as in a decoder; otherwise call ``Gaussian(mean, cov)``.
        """
        gaussian = object.__new__(cls)
        for name, array in (("mean", mean), ("cov", cov)):
            array.flags.writeable = False
            object.__setattr__(gaussian, name, array)
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
        z = _solve_lower(self._factor(), d.reshape(-1, self.dimension).T)
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
        A = _solve_lower(L, self.root)
        z = _solve_lower(L, self.mean - other.mean)
        with np.errstate(divide="ignore"):
            log_det = np.log(np.abs(A.diagonal())).sum()
        return float(((A**2).sum() + z @ z - self.dimension) / 2 - log_det)

    def wasserstein(self, other: Gaussian) -> float:
        """Return the 2-Wasserstein distance, in the units of the mean (Gelbrich 1990).

        It adds the squares of all variables: use it on marginals whose variables
        have the same unit.
        """
        values, vectors = np.linalg.eigh(self.cov)
        root = (vectors * np.sqrt(values.clip(0))) @ vectors.T
        cross = np.sqrt(np.linalg.eigvalsh(root @ other.cov @ root).clip(0)).sum()
        d = self.mean - other.mean
        squared = d @ d + np.trace(self.cov) + np.trace(other.cov) - 2 * cross
        return float(np.sqrt(max(squared, 0.0)))

    def _factor(self) -> NDArray[np.float64]:
        """Return ``root``; raises LinAlgError if the covariance is singular."""
        if not self.root.diagonal().all():
            raise np.linalg.LinAlgError(
                "the covariance is singular, so the Gaussian has no density; "
                "take a marginal of fewer variables"
            )
        return self.root


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


def block_diagonal(blocks: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (L n, L n) matrix with (L, n, n) blocks on its diagonal.

    >>> block_diagonal(np.array([[[1.0]], [[2.0]]]))
    array([[1., 0.],
           [0., 2.]])
    """
    L, n, _ = blocks.shape
    matrix = np.zeros((L, n, L, n))
    matrix[range(L), :, range(L)] = blocks
    return matrix.reshape(L * n, L * n)


def diagonal_blocks(matrix: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    """Return the (L, n, n) blocks on the diagonal of an (L n, L n) matrix."""
    L = len(matrix) // n
    return matrix.reshape(L, n, L, n)[range(L), :, range(L)]


def square_root(cov: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lower-triangular ``L`` with ``L @ L.T == cov``, also for a singular ``cov``.

    This is the Cholesky factor. If a pivot is zero up to rounding, continuing the
    recursion would amplify rounding errors; the root is then computed from the
    eigenvalues and reduced to triangular form by Householder reflections. It has a
    zero column for each variable that depends on the preceding ones.

    Args:
        cov: (n, n) symmetric positive semidefinite.

    >>> square_root(np.array([[4.0, 2.0], [2.0, 1.0]])).round(9)
    array([[2., 0.],
           [1., 0.]])
    """
    tiny = 8 * len(cov) * np.finfo(float).eps
    try:
        L = np.asarray(np.linalg.cholesky(cov), dtype=float)
    except np.linalg.LinAlgError:
        return _semidefinite_root(cov, tiny)
    if (L.diagonal() ** 2 > tiny * cov.diagonal()).all():
        return L
    return _semidefinite_root(cov, tiny)


def _solve_lower(L: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return L^-1 times (n, ...) values, for a lower-triangular (n, n) matrix L.

    By substitution here, since LAPACK's solver wakes all threads of OpenBLAS even for n = 3. That
    takes longer than all of this, and far longer where the cores are busy.
    """
    x = np.empty_like(right)
    for i, row in enumerate(L):
        x[i] = (right[i] - row[:i] @ x[:i]) / row[i]
    return x


def _semidefinite_root(cov: NDArray[np.float64], tiny: float) -> NDArray[np.float64]:
    """Return ``square_root`` from the eigenvalues above ``tiny`` of the correlation matrix."""
    scale = _scale(cov)
    values, vectors = np.linalg.eigh(cov / scale / scale[:, None])
    M = vectors * np.sqrt(np.where(values > tiny, values, 0.0))
    L = np.zeros_like(M)
    k = 0
    for j in range(len(M)):
        v = M[j, k:].copy()
        norm = np.sqrt(v @ v)
        if norm > tiny:  # reflect the remainder of row j onto column k
            v[0] += np.copysign(norm, v[0])
            M[:, k:] -= np.outer(M[:, k:] @ v, v * (2 / (v @ v)))
            L[j:, j] = M[j:, k] * np.sign(M[j, k])
            k += 1
    return L * np.sqrt(cov.diagonal().clip(0))[:, None]  # zero variance: zero row


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


def rounding_of(cov: object) -> float:
    """Return the relative rounding error of a covariance: 1e-9, or 1e-5 in single precision."""
    return 1e-5 if getattr(cov, "dtype", None) in (np.float32, np.float16) else ROUNDING


def asymmetric(cov: NDArray[np.float64], rounding: float = ROUNDING) -> NDArray[np.bool_]:
    """Return (...,) which of (..., n, n) matrices are not symmetric up to rounding."""
    scale = _scale(cov)
    difference = np.abs(cov - np.swapaxes(cov, -1, -2))
    limit = rounding * scale[..., :, None] * scale[..., None, :]
    return np.asarray((difference > limit).any(axis=(-2, -1)))


def indefinite(cov: NDArray[np.float64], rounding: float = ROUNDING) -> NDArray[np.bool_]:
    """Return (...,) which of (..., n, n) symmetric matrices are not positive semidefinite.

    A matrix counts as indefinite if the Cholesky recursion on its correlation
    matrix, with ``rounding`` added to the diagonal, has a pivot of 0 or less.
    """
    S = np.moveaxis(cov, (-2, -1), (0, 1))
    scale = np.moveaxis(_scale(cov), -1, 0)
    bad = np.zeros(cov.shape[:-2], dtype=bool)
    L: list[list[NDArray[np.float64]]] = []
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for i in range(len(S)):
            row: list[NDArray[np.float64]] = []
            for j in range(i):
                rest = S[i, j] / (scale[i] * scale[j]) - sum(row[k] * L[j][k] for k in range(j))
                row.append(rest / L[j][j])
            pivot = S[i, i] / scale[i] ** 2 + rounding - sum(x * x for x in row)
            bad |= ~(pivot > 0)
            L.append([*row, np.sqrt(pivot)])
    return bad


def _scale(cov: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (..., n) standard deviations, with 1 in place of 0."""
    variance = np.diagonal(cov, axis1=-2, axis2=-1)
    return np.sqrt(np.where(variance > 0, variance, 1.0))


def _scale_of_any(S: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``_scale``, but with a variable of zero variance in the scale of its covariances."""
    scale = _scale(S)
    variance = np.diagonal(S, axis1=-2, axis2=-1)
    size = np.abs(S)
    other = np.where(variance[..., None, :] > 0, scale[..., None, :], np.sqrt(size))
    share = np.divide(size, other, out=np.zeros_like(size), where=other > 0).max(axis=-1)
    return np.where((variance == 0) & (share > 0), share, scale)


def nearest_covariance(cov: ArrayLike) -> NDArray[np.float64]:
    """Return the nearest positive semidefinite matrices that cover symmetric ones.

    Negative eigenvalues of the correlation matrix are set to zero. The result
    minus ``cov`` is positive semidefinite, so the result is never overconfident.

    Args:
        cov: (..., n, n) symmetric, with variances of 0 or more.

    Raises:
        ValueError: a shape or a value is wrong, a variance is negative, or a
            matrix is not symmetric.

    >>> nearest_covariance([[1, 2], [2, 1]])
    array([[1.5, 1.5],
           [1.5, 1.5]])
    """
    rounding = rounding_of(cov)
    S = floats(cov, "cov")
    if S.ndim < 2 or S.shape[-1] != S.shape[-2] or not (np.abs(S) <= MAX_COV).all():
        raise ValueError(f"cov must be finite with shape (..., n, n), got {cov!r}")
    if (np.diagonal(S, axis1=-2, axis2=-1) < 0).any():
        raise ValueError(f"cov must have variances of 0 or more, got {cov!r}")
    if asymmetric(S, rounding).any():
        raise ValueError(f"cov must be symmetric, got {cov!r}; use (cov + cov.T) / 2")
    nearest = _nearest(S, _scale(S))
    empty = (np.diagonal(nearest, axis1=-2, axis2=-1) == 0) & (nearest != 0).any(axis=-1)
    if not empty.any():
        return nearest
    # Covariances of a zero variance that are so small that rounding hides them.
    again = _nearest(S, _scale_of_any(S))
    return np.where(empty.any(axis=-1)[..., None, None], again, nearest)


def _nearest(S: NDArray[np.float64], scale: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``nearest_covariance`` of (..., n, n) matrices, nearest in units of a scale."""
    scale2 = scale[..., :, None] * scale[..., None, :]
    values, vectors = np.linalg.eigh(S / scale2)
    lifted = (vectors * values.clip(0)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    lifted = (lifted + np.swapaxes(lifted, -1, -2)) / 2 * scale2
    return np.where(values[..., :1, None] < 0, lifted, S)
