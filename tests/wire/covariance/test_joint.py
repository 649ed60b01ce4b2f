"""Block matrices, and what a sum of two covariances lacks to cover a third."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import block_diag
from strategies import ENTRIES, covariances, mild_lines, symmetric

from maplines_can.values.linalg import block_diagonal, diagonal_blocks, positive_part
from maplines_can.values.seen_lines import bases
from maplines_can.wire.covariance.joint import uncovered

RANGES = np.array([[-20.0, 80.0], [-5.0, 40.0], [0.0, 20.0]])


@given(arrays(float, (3, 4, 4), elements=ENTRIES))
def test_blocks_are_those_on_the_diagonal(parts: Any) -> None:
    whole = block_diagonal(parts)
    assert np.array_equal(whole, block_diag(*parts))
    assert np.array_equal(diagonal_blocks(whole + (whole == 0), 4), parts + (parts == 0))


@given(symmetric(), symmetric(), mild_lines())
def test_the_positive_part_covers_and_changes_no_covariance(
    first: Any, second: Any, mean: Any
) -> None:
    """In metres, it exceeds a symmetric matrix by its negative eigenvalues."""
    J = bases(np.stack([mean, mean]), RANGES[:2])
    E = np.stack([first, second])
    part = positive_part(J @ E @ J.swapaxes(1, 2), J)
    inverse = np.linalg.inv(J)
    in_metres = inverse @ part @ inverse.swapaxes(1, 2)
    for given_, got in zip(E, in_metres, strict=True):
        size = max(np.abs(given_).max(), 1e-30)
        values = np.linalg.eigvalsh(given_)
        assert np.linalg.eigvalsh(got - given_)[0] >= -1e-7 * size
        assert np.trace(got) == pytest.approx(values.clip(0).sum(), rel=1e-6, abs=1e-7 * size)


def joint_case(data: Any, lines: int) -> tuple[Any, Any, Any, Any]:
    """Joint covariance of lines, the spread of a pose, own covariances, and bases [m]."""
    n = 4 * lines
    A, B = (data.draw(arrays(float, (n, k), elements=ENTRIES)) for k in (n, 3))
    own = np.array([data.draw(covariances(4, (1e-3, 1.0))) for _ in range(lines)])
    size = own.reshape(lines, -1).max(axis=1)[:, None, None]
    own = own / np.where(size > 0, size, 1.0) + 1e-3 * np.eye(4)
    J = bases(np.array([data.draw(mild_lines()) for _ in range(lines)]), RANGES[:lines])
    W = block_diagonal(J)
    true, spread = W @ A @ A.T @ W.T, W @ B @ B.T @ W.T
    return true, spread, J @ own @ J.swapaxes(1, 2), J


@given(st.data(), st.integers(1, 3))
def test_what_lacks_makes_the_sum_cover(data: Any, lines: int) -> None:
    """With it, next to nothing lacks; without it, the sum does not cover."""
    true, spread, own, J = joint_case(data, lines)
    W = np.linalg.inv(block_diagonal(J))
    excess = W @ (spread + block_diagonal(own) - true) @ W.T
    least = np.linalg.eigvalsh((excess + excess.T) / 2)[0]
    lacking = uncovered(true, spread, own, J)
    if lacking is None:
        assert least > -1e-9
        return
    assert least < 1e-3
    inverse = np.linalg.inv(J)
    in_metres = inverse @ lacking @ inverse.swapaxes(1, 2)
    size = np.abs(in_metres).max()
    assert np.linalg.eigvalsh(in_metres).min() >= -1e-9 * size
    rest = uncovered(true, spread, own + lacking, J)
    if rest is not None:  # the slack of what was added
        assert np.abs(inverse @ rest @ inverse.swapaxes(1, 2)).max() <= 1e-3 * size
        assert uncovered(true, spread, own + lacking + 2 * rest, J) is None


def test_what_covers_by_a_little_lacks_nothing() -> None:
    """And what misses by as little lacks about that: the slack is a millionth."""
    J = np.tile(np.eye(4), (2, 1, 1))
    own = np.tile(np.eye(4), (2, 1, 1))
    spread = np.ones((8, 8))
    true = spread + np.eye(8)
    assert uncovered(true - 1e-5 * np.eye(8), spread, own, J) is None
    lacking = uncovered(true + 1e-5 * np.eye(8), spread, own, J)
    assert lacking is not None
    assert 1e-5 <= np.linalg.eigvalsh(lacking).max() <= 1e-3


def test_only_the_lines_concerned_lack() -> None:
    """Two of three lines have a common error that the spread does not know."""
    J = np.tile(np.eye(4), (3, 1, 1))
    own = np.tile(0.01 * np.eye(4), (3, 1, 1))
    u = np.zeros(12)
    u[0] = u[4] = 0.3
    lacking = uncovered(block_diagonal(own) * 0.9 + np.outer(u, u), np.zeros((12, 12)), own, J)
    assert lacking is not None
    assert lacking[0, 0, 0] == pytest.approx(lacking[1, 0, 0])
    assert 0.15 <= lacking[0, 0, 0] <= 0.2  # twice u^2, less what is covered
    assert np.abs(lacking[2]).max() <= 1e-6


@pytest.mark.parametrize("excess", [-2e-6, -5e-7, 0.0, 1e-3])
def test_a_sum_covers_with_a_slack(excess: float) -> None:
    """Of a millionth of the own covariance; what is added makes it two."""
    J = own = np.eye(4)[None]
    true = np.diag([1 + excess, 0.5, 0.5, 0.5])
    lacking = uncovered(true, np.zeros((4, 4)), own, J)
    assert (lacking is None) is (excess < -1e-6)
    if lacking is not None:
        assert excess + 1e-6 < lacking[0, 0, 0] < excess + 2.1e-6
        assert np.abs(lacking[0, 1:]).max() < 1e-9
        assert uncovered(true, np.zeros((4, 4)), own + lacking, J) is None


def test_a_spread_of_any_size_leaves_the_weights_finite() -> None:
    """1e20 times what lines have of their own: what is added is finite, and semidefinite."""
    rng = np.random.default_rng(6)
    J = bases(rng.uniform(-1, 1, (3, 4)) * [5, 0.2, 2e-3, 1e-5], RANGES)
    W = block_diagonal(J)
    B, d = rng.standard_normal((12, 3)), rng.standard_normal(12)
    for size in 10.0 ** np.arange(0, 22, 3):
        spread = size * W @ B @ B.T @ W.T
        lacking = uncovered(
            spread + W @ np.outer(d, d) @ W.T, spread, 1e-2 * J @ J.swapaxes(1, 2), J
        )
        if lacking is not None:
            assert np.isfinite(lacking).all()


def test_lines_that_cannot_be_compared_are_named() -> None:
    """An own covariance that is not definite has no factor; a sum that is not finite has none."""
    J = np.tile(np.eye(4), (2, 1, 1))
    own = np.stack([np.eye(4), np.diag([1.0, 1.0, 1.0, -1.0])])
    lacking = uncovered(np.eye(8), np.zeros((8, 8)), own, J)
    assert lacking is not None
    assert np.isfinite(lacking).all(axis=(1, 2)).tolist() == [True, False]
    lacking = uncovered(np.full((8, 8), np.inf), np.zeros((8, 8)), J, J)
    assert lacking is not None
    assert np.isnan(lacking).all()
