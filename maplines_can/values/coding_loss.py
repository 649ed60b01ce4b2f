"""What Gaussians of lines lose on the wire: divergence, coverage, lateral position."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .line import lateral, lateral_jacobian

Array = NDArray[np.float64]

#: Distances ahead at which the lateral position is evaluated [m].
LATERAL_X = (0.0, 20.0, 40.0, 80.0)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Figures of merit of N decoded Gaussians, at the X distances ``LATERAL_X``."""

    positive_definite: NDArray[np.bool_]  #: (N,) the decoded covariance has a Cholesky factor
    largest_ratio: Array  #: (N,) largest eigenvalue of S'^-1 (S + d d^T): 1 or less is covered
    kl_covered: Array  #: (N,) KL(N(m', T) || N(m', S')), T = S + d d^T + F [nat]
    kl: Array  #: (N,) KL(N(m, S) || N(m', S')) [nat]; large where S is thinner than the grid
    lateral_error: Array  #: (N, X) decoded less true mean of l(x) [m]
    sigma_ratio: Array  #: (N, X) decoded over true standard deviation of l(x)

    @property
    def overconfident(self) -> NDArray[np.bool_]:
        """(N,) True where S' - (S + d d^T) is not positive semidefinite."""
        return ~(self.largest_ratio <= 1)


def evaluate(
    mean: Array, cov: Array, decoded_mean: Array, decoded_cov: Array, resolution: Array
) -> Evaluation:
    """Compare decoded Gaussians with the true ones.

    Args:
        mean: (N, 4) true means.
        cov: (N, 4, 4) true covariances S, which may be singular.
        decoded_mean: (N, 4) m'; d is the true mean less the decoded one.
        decoded_cov: (N, 4, 4) S'.
        resolution: (4,) variances of the rounding of the mean, factor^2 / 12: the diagonal of F.
    """
    d = mean - decoded_mean
    error = cov + d[:, :, None] * d[:, None, :]
    target = error + np.diag(resolution)
    scale = np.sqrt(np.einsum("nii->ni", decoded_cov))
    scale2 = scale[:, :, None] * scale[:, None, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        L, definite = _cholesky(decoded_cov / scale2)
    # An indefinite matrix covers nothing: computed with the identity, then set to infinity.
    scale2 = np.where(definite[:, None, None], scale2, 1.0)
    scale = np.where(definite[:, None], scale, 1.0)
    penalty = np.where(definite, 0.0, np.inf)
    log_det_decoded = 2 * np.log(np.einsum("nii->ni", L)).sum(axis=1)

    def whitened(S: Array) -> Array:
        half = np.linalg.solve(L, S / scale2)
        return np.asarray(np.linalg.solve(L, np.swapaxes(half, 1, 2)), dtype=float)

    def divergence(S: Array, z: Array) -> Array:
        with np.errstate(divide="ignore"):
            _, log_det = np.linalg.slogdet(S / scale2)
        trace = np.einsum("nii->n", whitened(S))
        return (trace - 4 + log_det_decoded - log_det + (z**2).sum(axis=1)) / 2

    W = whitened(error)
    z = np.asarray(np.linalg.solve(L, (d / scale)[..., None])[..., 0], dtype=float)
    x = np.array(LATERAL_X)
    J, J_decoded = (lateral_jacobian(m[:, None, :], x) for m in (mean, decoded_mean))
    variance = np.einsum("nxi,nij,nxj->nx", J, cov, J)
    decoded_variance = np.einsum("nxi,nij,nxj->nx", J_decoded, decoded_cov, J_decoded)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        sigma_ratio = np.sqrt(decoded_variance / variance)  # NaN where a variance is negative
    return Evaluation(
        positive_definite=definite,
        largest_ratio=np.asarray(np.linalg.eigvalsh((W + np.swapaxes(W, 1, 2)) / 2)[:, -1])
        + penalty,
        kl_covered=divergence(target, np.zeros_like(z)) + penalty,
        kl=divergence(cov, z) + penalty,
        lateral_error=lateral(decoded_mean[:, None, :], x) - lateral(mean[:, None, :], x),
        sigma_ratio=sigma_ratio,
    )


def _cholesky(S: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return Cholesky factors and which matrices have one; the identity for those without.

    ``numpy.linalg.cholesky`` raises for the whole stack if a single matrix is not definite.
    """
    L = np.zeros_like(S)
    definite = np.ones(len(S), dtype=bool)
    for i in range(S.shape[-1]):
        for j in range(i):
            rest = S[:, i, j] - np.einsum("nk,nk->n", L[:, i, :j], L[:, j, :j])
            L[:, i, j] = rest / L[:, j, j]
        pivot = S[:, i, i] - np.einsum("nk,nk->n", L[:, i, :i], L[:, i, :i])
        definite &= pivot > 0
        L[:, i, i] = np.sqrt(np.where(definite, pivot, 1.0))
    L[~definite] = np.eye(S.shape[-1])
    return L, definite
