"""Eigenvalues of the core and roots of large matrices, against LAPACK and laws of their own."""

import numpy as np
import pytest

from maplines_can.values.linalg import MAX_ROWS, eigen, square_root


def random_covariances(n: int, size: int, seed: int) -> np.ndarray:
    G = np.random.default_rng(seed).normal(size=(n, size, size + 2))
    return np.asarray(G @ G.mT)


@pytest.mark.parametrize("size", [1, 2, 5, MAX_ROWS, MAX_ROWS + 1])
def test_agrees_with_lapack(size: int) -> None:
    """Up to 1e-11 of the largest value, for condition numbers up to 1e4."""
    S = random_covariances(20, size, seed=size)
    values, vectors = eigen(S)
    for ours, expected in (
        (np.sort(values), np.linalg.eigvalsh(S)),
        ((vectors * values[:, None]) @ vectors.mT, S),
        (vectors @ vectors.mT, np.broadcast_to(np.eye(size), S.shape)),
        (square_root(S[0]), np.linalg.cholesky(S[0])),
    ):
        assert np.abs(ours - expected).max() <= 1e-11 * max(1.0, np.abs(expected).max())


def test_eigenvalues_of_a_scaled_matrix_are_relatively_exact() -> None:
    """Demmel and Veselic, SIAM J. Matrix Anal. Appl. 13, 1992: D K D with K well-conditioned."""
    scale = np.array([1e-8, 1e-3, 1.0, 1e5])
    K = random_covariances(50, 4, seed=4) + 4 * np.eye(4)
    values, _ = eigen(scale[:, None] * K * scale)
    inverse_values, _ = eigen(np.linalg.inv(K) / scale[:, None] / scale)
    assert np.abs(np.sort(values) * np.sort(inverse_values)[:, ::-1] - 1).max() < 1e-9
