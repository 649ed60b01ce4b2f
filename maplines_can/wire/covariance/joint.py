"""Joint covariances of lines, and what a sum of two lacks to cover a third.

J are the (L, 4, 4) derivatives of ``seen_lines.bases``: in the coefficients of w all entries of a
covariance are in metres squared. All sums have a fixed order, that of ``c/src/joint.c``.
"""

from __future__ import annotations

import math

import numpy as np

from ...values.elementary import log2
from ...values.fixed_order import (
    cholesky,
    congruence,
    inverse,
    lower_solution,
    product,
    total,
    upper_solution,
)
from .code import Array

#: Share of D_i by which a sum must exceed what it covers, so that a check with another algorithm's
#: rounding passes.
SLACK = 1e-6
#: Most factorizations for one direction that lacks; 5 to 8 are usual. Share of the excess to which
#: its eigenvalue is found, and the least excess that counts.
FACTORIZATIONS, PRECISION, LEAST = 64, 2.0**-14, 2.0**-40
#: First guess of an excess, the factor to the next one while it is too small, and the share of the
#: bracket, from the Rayleigh quotient up, at which the next factorization is tried.
FIRST, FARTHER, NEARER = 2.0**-4, 16.0, 2.0**-6
LN_2 = float.fromhex("0x1.62e42fefa39efp-1")
#: Entries of the lower triangle of (4, 4) matrices, row by row.
TRIANGLE = [(i, j) for i in range(4) for j in range(i + 1)]
#: Places in the range of a line, in the normalised variable w.
_PLACES = np.linspace(-1, 1, 9)
#: (K, 4) values of T_0 .. T_3 there, and of their derivatives. All of them are exact.
_VALUES = np.vstack(
    [
        np.polynomial.chebyshev.chebvander(_PLACES, 3),
        np.polynomial.chebyshev.chebval(_PLACES, np.polynomial.chebyshev.chebder(np.eye(4))).T,
    ]
)
#: (10, K) weights in these variances of the entries of the lower triangle, row by row.
_WEIGHTS = np.array([_VALUES[:, i] * _VALUES[:, j] * (1 if i == j else 2) for i, j in TRIANGLE])


@np.errstate(over="ignore", invalid="ignore")
def uncovered(true: Array, spread: Array, own: Array, J: Array) -> Array | None:
    """Return what to add to (L, 4, 4) own covariances, so that they cover a scene; None if they do.

    The scene is covered if ``spread + blockdiag(own)`` minus ``true`` is positive semidefinite. If
    it is not, it lacks a u u^T for some u, each of which has a part u_i in every line. By the
    inequality of Cauchy and Schwarz, for any positive weights t_i,

        a u u^T <= blockdiag(..., a (sum_j t_j) / t_i u_i u_i^T, ...)

    The weights are the sizes of u_i against the whole covariance of their lines, so what is added
    is a similar share of it in each line. It is NaN for lines whose own covariance is not definite
    in double precision, or for all lines if the sum cannot be compared.
    """
    lines = len(J)
    to_metres = inverse(J)  # all coefficients in metres
    L = cholesky(congruence(to_metres, own))
    is_definite = np.isfinite(L).all(axis=(1, 2), keepdims=True)
    if not np.all(is_definite):
        return np.where(is_definite, np.zeros_like(own), np.nan)
    W = lower_solution(L, to_metres)
    excess = _whitened(W, true - spread)
    identity = np.eye(4 * lines)
    if _is_definite(cholesky((1 - SLACK) * identity - excess)):
        return None
    whole = np.eye(4) + congruence(W, _blocks(spread)[range(lines), range(lines)])
    sizes = factor_or_identity(whole)  # a spread of 1e16 times D_i may have none
    lacking = np.zeros_like(own)
    guess = FIRST
    for _ in range(4 * lines):
        found = _largest(excess, 1 - SLACK, guess)
        if found is None:
            return np.full_like(own, np.nan)
        guess, v = found  # the next one is hardly larger
        amount = guess + SLACK
        parts = v.reshape(lines, 4, 1)
        share = lower_solution(sizes, parts)[..., 0]
        weights = np.sqrt(total(share * share)) + 1e-9
        u = product(L, parts)
        lacking = lacking + (amount * total(weights) / weights)[:, None, None] * (u * u.mT)
        excess = excess - amount * v[:, None] * v
        if _is_definite(cholesky((1 - SLACK) * identity - excess)):
            break
    return congruence(J, lacking)


def _largest(S: Array, bound: float, guess: float) -> tuple[float, Array] | None:
    """Return by how much the largest eigenvalue of (n, n) S exceeds a bound, and an eigenvector.

    A factorization of s I - S decides whether s exceeds all eigenvalues. If it does, a step of
    inverse iteration with it gives a vector whose Rayleigh quotient is near the largest one from
    below. The excess that is returned is an upper bound. None if it is infinite.
    """
    low, high = 0.0, math.inf
    identity = np.eye(len(S))
    for _ in range(FACTORIZATIONS):
        L = cholesky((bound + guess) * identity - S)
        if not _is_definite(L):
            low = guess
            guess = FARTHER * guess if math.isinf(high) else (low + high) / 2
            continue
        high = guess
        # The column of the inverse with the largest diagonal entry is nearest to the eigenvector.
        X = lower_solution(L, identity)
        column = int(total((X * X).T).argmax())
        v = upper_solution(L, X[:, column, None])
        v = upper_solution(L, lower_solution(L, v / math.sqrt(total(v[:, 0] * v[:, 0]))))[:, 0]
        v = v / math.sqrt(total(v * v))
        low = max(low, float(total(v * total(S * v))) - bound)
        if high - low <= PRECISION * high or high <= LEAST:
            return high, v
        guess = low + NEARER * (high - low)
    return None


def _whitened(W: Array, S: Array) -> Array:
    """Return blockdiag(W) S blockdiag(W)^T for (L, 4, 4) blocks, exactly symmetric."""
    lines = len(W)
    blocks = product(product(W[:, None], _blocks(S)), W.mT[None])
    whole = blocks.transpose(0, 2, 1, 3).reshape(4 * lines, 4 * lines)
    return np.asarray((whole + whole.T) / 2)


def _blocks(S: Array) -> Array:
    """Return the (L, L, 4, 4) blocks of a (4 L, 4 L) matrix."""
    lines = len(S) // 4
    return S.reshape(lines, 4, lines, 4).transpose(0, 2, 1, 3)


def _is_definite(L: Array) -> bool:
    """Return whether a Cholesky factor exists: its last pivot is a number."""
    return not math.isnan(L[-1, -1])


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def divergence(true: Array, decoded: Array) -> Array:
    """Return the (...,) KL of zero-mean Gaussians with (..., n, n) covariances [nat].

    It is infinite if one of them is not definite.
    """
    by_trace, ratio = compared(true, decoded)
    kl = by_trace + LN_2 * log2(ratio)
    return np.where(np.isfinite(kl), kl, np.inf)


def compared(true: Array, decoded: Array) -> tuple[Array, Array]:
    """Return the (...,) traces, less n and halved, and ratios of roots of determinants, for a KL.

    That is the one plus the logarithm of the other. They are NaN if a matrix is not definite.
    """
    n = true.shape[-1]
    G, L = _factor(true), _factor(decoded)
    trace, ratio = np.zeros(()), np.ones(())  # of L^-1 G: squared norm, and determinant's inverse
    for j in range(n):
        Y: dict[int, Array] = {}
        for i in range(j, n):
            rest = G[i][j]
            for k in range(j, i):
                rest = rest - L[i][k] * Y[k]
            Y[i] = rest / L[i][i]
            trace = trace + Y[i] * Y[i]
        ratio = ratio * (L[j][j] / G[j][j])
    return (trace - n) / 2, ratio


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def largest_ratio(decoded: Array, true: Array) -> Array:
    """Return the (...,) largest ratios of variances of lateral position and direction of lines.

    They are compared at nine places of the range.

    Args:
        decoded: (..., 4, 4) covariances of coefficients of T_0 .. T_3.
        true: the covariances with which they are compared.
    """
    return np.asarray((_variances(decoded) / _variances(true)).max(axis=-1))


def _variances(cov: Array) -> Array:
    """Return the (..., K) variances of lateral position and direction at places in the range."""
    S = entries_first(cov)
    variances = np.zeros(())
    for weight, (i, j) in zip(_WEIGHTS, TRIANGLE, strict=True):
        variances = variances + weight.reshape(-1, *[1] * (S.ndim - 2)) * S[i, j]
    return np.moveaxis(variances, 0, -1)


def _factor(S: Array) -> list[list[Array]]:
    """Return the rows of the Cholesky factors of (..., n, n) matrices; NaN if there is none."""
    M = entries_first(S)
    L: list[list[Array]] = []
    for i in range(len(M)):
        row: list[Array] = []
        for j in range(i):
            rest = M[i, j]
            for k in range(j):
                rest = rest - row[k] * L[j][k]
            row.append(rest / L[j][j])
        pivot = M[i, i]
        for entry in row:
            pivot = pivot - entry * entry
        L.append([*row, np.sqrt(np.where(pivot > 0, pivot, np.nan))])
    return L


def factor_or_identity(S: Array) -> Array:
    """Return the Cholesky factors of (..., n, n) matrices, and 1 for those that have none."""
    L = cholesky(S)
    exists = np.isfinite(L).all(axis=(-2, -1), keepdims=True)
    return np.where(exists, L, np.eye(S.shape[-1]))


def entries_first(matrices: Array) -> Array:
    """Return (n, n, ...) entries of (..., n, n) matrices, each of them contiguous."""
    return np.ascontiguousarray(np.moveaxis(matrices, (-2, -1), (0, 1)))
