"""Linear algebra of covariances: positive parts, square roots and blocks.

A covariance of mixed units has no eigenvalues of a unit. So what clips or compares eigenvalues here
does so in units of the standard deviations (``nearest_covariance``, ``indefinite``), or in
coordinates of one unit that the caller names (``positive_part``).
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import lib
from ..core.memory import pointer
from .arrays import floats

#: Asymmetry and negative eigenvalues up to this, relative to the standard
#: deviations, count as rounding errors; larger ones are the caller's mistake.
ROUNDING = 1e-9
#: Largest variance or covariance; sums of such values stay within the floats.
MAX_COV = 1e307
#: Most rows of a matrix that the core takes: the parameters of all lines of a scene.
MAX_ROWS = 32
#: Most rows of a covariance whose root the core has, also of a singular one.
ROOT_ROWS = 4


def rounding_of(cov: object) -> float:
    """Return the relative rounding error of a covariance: 1e-9, or 1e-5 in single precision."""
    kind = getattr(getattr(cov, "dtype", None), "char", "")
    return 1e-5 if kind in ("e", "f") else ROUNDING


def asymmetric(cov: NDArray[np.float64], rounding: float = ROUNDING) -> NDArray[np.bool_]:
    """Return (...,) which of (..., n, n) matrices are not symmetric up to rounding."""
    difference = np.abs(cov - np.swapaxes(cov, -1, -2))
    if not difference.any():
        return np.zeros(cov.shape[:-2], dtype=bool)
    scale = scale_of(cov)
    limit = rounding * scale[..., :, None] * scale[..., None, :]
    return np.asarray((difference > limit).any(axis=(-2, -1)))


def indefinite(cov: NDArray[np.float64], rounding: float = ROUNDING) -> NDArray[np.bool_]:
    """Return (...,) which of (..., n, n) symmetric matrices are not positive semidefinite.

    These are the ones whose correlation matrix has an eigenvalue of ``-rounding`` or less.
    """
    scale = scale_of(cov)
    values = np.linalg.eigvalsh(cov / (scale[..., :, None] * scale[..., None, :]))
    return np.asarray(~(values > -rounding).all(axis=-1))


def is_covariance(cov: NDArray[np.float64]) -> bool:
    """Return whether (..., n, n) matrices are covariances up to rounding, as of a ``Gaussian``."""
    variance = np.diagonal(cov, axis1=-2, axis2=-1)
    is_valid = (np.abs(cov) <= MAX_COV).all() and (variance >= 0).all()
    return bool(is_valid and not asymmetric(cov).any() and not indefinite(cov).any())


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
    nearest = _nearest(S, scale_of(S))
    empty = (np.diagonal(nearest, axis1=-2, axis2=-1) == 0) & (nearest != 0).any(axis=-1)
    if empty.any():
        # Covariances of a zero variance that are so small that rounding hides them.
        again = _nearest(S, _scale_of_any(S))
        nearest = np.where(empty.any(axis=-1)[..., None, None], again, nearest)
    variances = np.diagonal(S, axis1=-2, axis2=-1)
    lost = np.diagonal(nearest, axis1=-2, axis2=-1) < variances / 2
    if not lost.any():
        return nearest
    # Variances that rounding hides beside covariances many times larger than they admit: sums of
    # absolute values cover any row.
    sums = np.abs(S).sum(axis=-1)[..., None] * np.eye(S.shape[-1])
    return np.asarray(np.where(np.asarray(lost.any(axis=-1))[..., None, None], sums, nearest))


def _nearest(S: NDArray[np.float64], scale: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``nearest_covariance`` of (..., n, n) matrices, nearest in units of a scale."""
    scale2 = scale[..., :, None] * scale[..., None, :]
    values, vectors = eigen(S / scale2)
    positive = vectors * values.clip(0)[..., None, :]
    lifted = (positive[..., :, None, :] * vectors[..., None, :, :]).sum(axis=-1)
    lifted = (lifted + lifted.mT) / 2 * scale2
    return np.where(values.min(axis=-1)[..., None, None] < 0, lifted, S)


def positive_part(
    matrices: NDArray[np.float64], J: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Return the least (..., n, n) positive semidefinite matrices that cover symmetric ones.

    Negative eigenvalues are set to zero, and those of a covariance stay as they are.

    Args:
        matrices: (..., n, n).
        J: (..., n, n) derivatives of the variables with respect to coordinates of one unit, in
            which the least is meant; None if the variables themselves have one unit.

    >>> positive_part(np.array([[1.0, 2.0], [2.0, 1.0]])).round(9)
    array([[1.5, 1.5],
           [1.5, 1.5]])
    """
    inverse = None if J is None else np.linalg.inv(J)
    E = matrices if inverse is None else inverse @ matrices @ inverse.mT
    values, vectors = np.linalg.eigh((E + E.mT) / 2)
    root = vectors * np.sqrt(values.clip(0))[..., None, :]
    root = root if J is None else J @ root
    return np.asarray(root @ root.mT)


def squared_distance(d: NDArray[np.float64], cov: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (...,) squared Mahalanobis distances of (..., n) differences.

    >>> squared_distance(np.array([3.0, 4.0]), np.diag([1.0, 4.0])).item()
    13.0
    """
    return np.asarray((d * np.linalg.solve(cov, d[..., None])[..., 0]).sum(axis=-1))


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
    given, L = np.ascontiguousarray(cov, dtype=float), np.empty(cov.shape)
    if len(cov) <= ROOT_ROWS:
        lib.maplines_root_of(len(cov), pointer(given), pointer(L))
        return L
    if len(cov) <= MAX_ROWS and lib.maplines_factor_of(len(cov), pointer(given), pointer(L)):
        pivots = L.diagonal()
        if (pivots * pivots > tiny * given.diagonal()).all():
            return L
    return _semidefinite_root(given, tiny)


def _semidefinite_root(cov: NDArray[np.float64], tiny: float) -> NDArray[np.float64]:
    """Return ``square_root`` from the eigenvalues above ``tiny`` of the correlation matrix."""
    scale = scale_of(cov)
    values, vectors = eigen(cov / (scale[:, None] * scale))
    M = vectors * np.sqrt(np.where(values > tiny, values, 0.0))
    L = np.zeros_like(M)
    k = 0
    for j in range(len(M)):
        v = M[j, k:].copy()
        norm = np.sqrt((v * v).sum())
        if norm > tiny:  # reflect the remainder of row j onto column k
            v[0] += np.copysign(norm, v[0])
            share = (M[:, k:] * v).sum(axis=1) * (2 / (v * v).sum())
            M[:, k:] -= share[:, None] * v
            L[j:, j] = M[j:, k] * np.sign(M[j, k])
            k += 1
    return L * np.sqrt(cov.diagonal().clip(0))[:, None]  # zero variance: zero row


def eigen(S: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the (..., n) eigenvalues and (..., n, n) eigenvectors of symmetric matrices.

    They are in no order. Those of up to 32 rows have the same bits on any machine, and small
    eigenvalues of a scaled matrix are relatively exact: by Jacobi's method, in the core.

    >>> values, _ = eigen(np.array([[2.0, 1.0], [1.0, 2.0]]))
    >>> np.sort(values).round(12)
    array([1., 3.])
    """
    n = S.shape[-1]
    if n > MAX_ROWS:
        return np.linalg.eigh(S)
    rest, values, vectors = np.array(S, order="C"), np.empty(S.shape[:-1]), np.empty(S.shape)
    lib.maplines_eigen_of(math.prod(S.shape[:-2]), n, *map(pointer, (rest, values, vectors)))
    return values, vectors


def solve_lower(L: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return L^-1 times (n, ...) values, for a lower-triangular (n, n) matrix L.

    By substitution here, since LAPACK's solver wakes all threads of OpenBLAS even for n = 3. That
    takes longer than all of this, and far longer where the cores are busy.
    """
    x = np.empty_like(right)
    for i, row in enumerate(L):
        x[i] = (right[i] - row[:i] @ x[:i]) / row[i]
    return x


def block_diagonal(blocks: Iterable[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the matrix with square blocks on its diagonal, such as those of an (L, n, n) array.

    As ``scipy.linalg.block_diag``, which takes many times as long for small blocks.

    >>> block_diagonal([np.eye(1), np.full((2, 2), 3.0)])
    array([[1., 0., 0.],
           [0., 3., 3.],
           [0., 3., 3.]])
    """
    blocks = [*blocks]
    matrix, begin = np.zeros((sum(map(len, blocks)),) * 2), 0
    for block in blocks:
        end = begin + len(block)
        matrix[begin:end, begin:end] = block
        begin = end
    return matrix


def scale_of(cov: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (..., n) standard deviations, with 1 in place of 0."""
    variance = np.diagonal(cov, axis1=-2, axis2=-1)
    return np.sqrt(np.where(variance > 0, variance, 1.0))


def _scale_of_any(S: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``scale_of``, but with a variable of zero variance in the scale of its covariances."""
    scale = scale_of(S)
    variance = np.diagonal(S, axis1=-2, axis2=-1)
    size = np.abs(S)
    other = np.where(variance[..., None, :] > 0, scale[..., None, :], np.sqrt(size))
    share = np.divide(size, other, out=np.zeros_like(size), where=other > 0).max(axis=-1)
    return np.where((variance == 0) & (share > 0), share, scale)
