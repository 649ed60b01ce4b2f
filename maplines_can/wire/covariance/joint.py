"""Joint covariances of lines, and what a sum of two lacks to cover a third.

J are the (L, 4, 4) derivatives of ``seen_lines.bases``: in the coefficients of w all entries of a
covariance are in metres squared.
"""

from __future__ import annotations

import numpy as np

from ...values.linalg import block_diagonal, diagonal_blocks
from .code import Array

#: Share of D_i by which a sum must exceed what it covers, so that a check with another algorithm's
#: rounding passes.
SLACK = 1e-6
#: Places in the range of a line, in the normalised variable w.
_PLACES = np.linspace(-1, 1, 9)
#: (K, 4) values of T_0 .. T_3 there, and of their derivatives.
_VALUES = np.vstack(
    [
        np.polynomial.chebyshev.chebvander(_PLACES, 3),
        np.polynomial.chebyshev.chebval(_PLACES, np.polynomial.chebyshev.chebder(np.eye(4))).T,
    ]
)
#: (16, K) products of these, for variances of lateral position and direction.
_PRODUCTS = (_VALUES[:, :, None] * _VALUES[:, None]).reshape(-1, 16).T


def uncovered(true: Array, spread: Array, own: Array, J: Array) -> Array | None:
    """Return what to add to (L, 4, 4) own covariances, so that they cover a scene; None if they do.

    The scene is covered if ``spread + blockdiag(own)`` minus ``true`` is positive semidefinite. If
    it is not, it lacks a u u^T for some u, each of which has a part u_i in every line. By the
    inequality of Cauchy and Schwarz, for any positive weights t_i,

        a u u^T <= blockdiag(..., a (sum_j t_j) / t_i u_i u_i^T, ...)

    The weights are the sizes of u_i against the whole covariance of their lines, so what is added
    is a similar share of it in each line.
    """
    # loads scipy, which a decoder does not need
    from scipy.linalg import eigh

    inverse = np.linalg.inv(J)  # all coefficients in metres
    D = inverse @ own @ inverse.swapaxes(1, 2)
    L = np.linalg.cholesky((D + D.swapaxes(1, 2)) / 2)
    whitening = block_diagonal(np.linalg.inv(L) @ inverse)
    whitened = whitening @ (true - spread) @ whitening.T
    # That of NumPy wakes all threads of OpenBLAS for more than 6 lines; this one does not, and
    # finds only the few eigenvalues that count.
    values, vectors = eigh((whitened + whitened.T) / 2, subset_by_value=(1 - SLACK, np.inf))
    if not len(values):
        return None
    v = vectors.reshape(len(J), 4, -1)
    u = L @ v
    inverses = np.linalg.inv(np.eye(4) + diagonal_blocks(whitening @ spread @ whitening.T, 4))
    weights = np.sqrt(np.einsum("lik,lij,ljk->lk", v, inverses, v).clip(0)) + 1e-9
    amount = (values - 1 + 2 * SLACK) * weights.sum(axis=0) / weights
    return np.asarray(J @ np.einsum("lk,lik,ljk->lij", amount, u, u) @ J.swapaxes(1, 2))


@np.errstate(invalid="ignore", divide="ignore")
def divergence(true: Array, decoded: Array) -> Array:
    """Return the (...,) KL of zero-mean Gaussians with (..., n, n) covariances [nat].

    It is infinite if a determinant is not positive.
    """
    n = true.shape[-1]
    sign, log_det = np.linalg.slogdet(decoded)
    regular = np.where((sign > 0)[..., None, None], decoded, np.eye(n))
    ratio = np.linalg.solve(regular, np.broadcast_to(true, decoded.shape))
    trace = np.trace(ratio, axis1=-2, axis2=-1)
    true_sign, true_log_det = np.linalg.slogdet(true)
    kl = (trace - n + log_det - true_log_det) / 2
    return np.where((sign > 0) & (true_sign > 0), kl, np.inf)


@np.errstate(invalid="ignore", divide="ignore")
def largest_ratio(decoded: Array, true: Array) -> Array:
    """Return the (...,) largest ratios of variances of lateral position and direction of lines.

    They are compared at nine places of the range.

    Args:
        decoded: (..., 4, 4) covariances of coefficients of T_0 .. T_3.
        true: the covariances with which they are compared.
    """
    a, b = (cov.reshape(*cov.shape[:-2], 16) @ _PRODUCTS for cov in (decoded, true))
    return np.asarray((a / b).max(axis=-1))
