"""Linear algebra with a fixed order against NumPy's, and against its own laws."""

from typing import Any

import numpy as np
import pytest

from maplines_can.values import fixed_order

#: Relative error of what is compared with LAPACK, for matrices of condition numbers up to 1e4.
TOLERANCE = 1e-11


def random_covariances(n: Any, size: Any, seed: Any) -> Any:
    rng = np.random.default_rng(seed)
    G = rng.normal(size=(n, size, size + 2))
    return G @ G.mT


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5, 9, 32])
def test_agrees_with_lapack(size: Any) -> None:
    S = random_covariances(20, size, seed=size)
    B = np.random.default_rng(1).normal(size=(20, size, 3))
    L = fixed_order.cholesky(S)
    values, vectors = fixed_order.eigen(S)
    pairs = [
        (fixed_order.product(S, B), S @ B),
        (fixed_order.congruence(B.mT, S), B.mT @ S @ B),
        (L, np.linalg.cholesky(S)),
        (fixed_order.lower_solution(L, B), np.linalg.solve(L, B)),
        (fixed_order.inverse(S), np.linalg.inv(S)),
        (np.sort(values), np.linalg.eigvalsh(S)),
        ((vectors * values[:, None]) @ vectors.mT, S),
        (vectors @ vectors.mT, np.broadcast_to(np.eye(size), S.shape)),
        (fixed_order.total(B.mT), B.sum(axis=1)),
    ]
    for ours, expected in pairs:
        assert np.abs(ours - expected).max() <= TOLERANCE * max(1.0, np.abs(expected).max())


@pytest.mark.parametrize("name", ["cholesky", "inverse", "eigen"])
def test_a_matrix_does_not_depend_on_the_others(name: Any) -> None:
    function = getattr(fixed_order, name)
    S = random_covariances(5, 4, seed=3) * 10.0 ** np.arange(-8, 12, 4)[:, None, None]
    S[2, 0, 1:] = S[2, 1:, 0] = 0.0
    together = function(S)
    for i, one in enumerate(S):
        alone = function(one)
        parts = zip(together, alone, strict=True) if name == "eigen" else [(together, alone)]
        for many, single in parts:
            assert many[i].tobytes() == single.tobytes()


def test_the_factor_of_a_matrix_that_is_not_definite_ends_with_nan() -> None:
    S = np.diag([4.0, 0.0, 1.0])
    assert np.isnan(fixed_order.cholesky(S)).tolist() == [
        [False, False, False],
        [False, True, False],
        [False, True, True],
    ]


def test_eigenvalues_of_a_scaled_matrix_are_relatively_exact() -> None:
    # Demmel and Veselic, SIAM J. Matrix Anal. Appl. 13, 1992: D K D with K well-conditioned
    scale = np.array([1e-8, 1e-3, 1.0, 1e5])
    K = random_covariances(50, 4, seed=4) + 4 * np.eye(4)
    values, _ = fixed_order.eigen(scale[:, None] * K * scale)
    inverse_values, _ = fixed_order.eigen(np.linalg.inv(K) / scale[:, None] / scale)
    assert np.abs(np.sort(values) * np.sort(inverse_values)[:, ::-1] - 1).max() < 1e-9


@pytest.mark.parametrize("n", range(2, 12))
def test_each_pair_meets_once_in_a_sweep(n: Any) -> None:
    rounds = fixed_order._rounds(n)
    pairs = [pair for p, q in rounds for pair in zip(p, q, strict=True)]
    assert sorted(pairs) == [(p, q) for p in range(n) for q in range(p + 1, n)]
    for p, q in rounds:
        assert len({*p, *q}) == len(p) + len(q)


@pytest.mark.parametrize("n", [1, 3, 4])
def test_a_matrix_is_definite_if_it_has_a_factor(n: int) -> None:
    """One by one and all at once; matrices on the edge included."""
    rng = np.random.default_rng(n)
    roots = rng.standard_normal((3000, n, n))
    roots[::2, -1] = roots[::2, 0] * rng.choice([1.0, 1 + 1e-15, 0.9], (1500, 1))
    S = roots @ roots.mT - rng.choice([0.0, 1e-16, 0.1], (3000, 1, 1)) * np.eye(n)
    expected = ~np.isnan(fixed_order.cholesky(S)).any(axis=(1, 2))
    assert 100 < expected.sum() < 2990
    assert np.array_equal(fixed_order.is_definite(S), expected)
    one_by_one = [bool(fixed_order.is_definite(one[None])[0]) for one in S]
    assert one_by_one == expected.tolist()
