"""Joint covariances of lines: how far two are apart, and what two lack to cover a third."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import reduce
from operator import add

from .elementary import log2
from .matrices import Matrix, Vector, diagonal, dot_by_halves, matrix, total

#: Share of D by which a sum must exceed what it covers, so that another rounding passes.
SLACK = 1e-6
#: Most factorizations for one direction that lacks; the share of the excess to which its eigenvalue
#: is found, and the least excess that counts.
FACTORIZATIONS, PRECISION, LEAST = 64, 2.0**-8, 2.0**-40
#: First guess of an excess, the factor to the next one while it is too small, and the share of the
#: bracket, from the Rayleigh quotient up, at which the next factorization is tried.
FIRST, FARTHER, NEARER = 2.0**-4, 16.0, 2.0**-6
LN_2 = float.fromhex("0x1.62e42fefa39efp-1")
PLACES = [k / 4 - 1 for k in range(9)]
#: Values of T_0 .. T_3 at places of the range, then those of their derivatives; all are exact.
VALUES = [[1.0, w, 2 * w * w - 1, 4 * w * w * w - 3 * w] for w in PLACES]
VALUES += [[0.0, 1.0, 4 * w, 12 * w * w - 3] for w in PLACES]
#: Entries of the lower triangle, row by row, and their weights in the variances of these values.
TRIANGLE = [(i, j) for i in range(4) for j in range(i + 1)]
WEIGHTS = matrix([v[i] * v[j] * (1 if i == j else 2) for i, j in TRIANGLE] for v in VALUES)


# ---- one line ---------------------------------------------------------------------------------


def largest_ratio(decoded: Matrix, true: Matrix) -> float:
    """Return the largest ratio of the variances of lateral position and direction of a line.

    At the places; NaN if one is.
    """
    pairs = zip(_variances(decoded), _variances(true), strict=True)
    ratios = [a / b if b else math.nan for a, b in pairs]
    return math.nan if any(map(math.isnan, ratios)) else max(ratios)


def _variances(S: Matrix) -> list[float]:
    entries = [S[i][j] for i, j in TRIANGLE]
    return [weights @ entries for weights in WEIGHTS]


def compared(true: Matrix, decoded: Matrix) -> tuple[float, float]:
    """Return the trace, less n and halved, and the ratio of the roots of the determinants.

    The divergence is the first one plus the logarithm of the other.
    """
    G, L = true.cholesky(), decoded.cholesky()
    trace, ratio = reduce(add, (y * y for column in L.lower_solution(G).T for y in column)), 1.0
    for x, y in zip(L.diagonal(), G.diagonal(), strict=True):
        ratio *= x / y
    return (trace - len(true)) / 2, ratio


def divergence(true: Matrix, decoded: Matrix) -> float:
    """Return the KL of zero-mean Gaussians [nat]; infinite if one is not definite."""
    by_trace, ratio = compared(true, decoded)
    kl = by_trace + LN_2 * log2(ratio)
    return kl if math.isfinite(kl) else math.inf


def factor_or_identity(S: Matrix) -> Matrix:
    """Return the Cholesky factor, or 1 if there is none."""
    L = S.cholesky()
    return L if L.is_finite() else diagonal([1.0] * len(S))


# ---- all lines --------------------------------------------------------------------------------


def uncovered(
    true: Matrix, spread: Matrix, own: Sequence[Matrix], J: Sequence[Matrix]
) -> list[Matrix] | None:
    """Return what to add to own covariances, so that they cover a scene; None if they do.

    The scene is covered if ``spread + blockdiag(own) - true`` is positive semidefinite. If it is
    not, it lacks a u u^T for some u with a part u_i in every line. For any positive weights t_i,

        a u u^T <= blockdiag(..., a (sum_j t_j) / t_i u_i u_i^T, ...)

    The weights are the sizes of u_i against the whole covariance of their lines. What is added is
    NaN for lines that cannot be compared.
    """
    lines, unknown, bound = range(len(J)), matrix([[math.nan] * 4] * 4), 1 - SLACK
    to_metres = [one.inverse() for one in J]
    factors = [to_metres[i].congruence(own[i]).cholesky() for i in lines]
    lacking = [diagonal([0.0] * 4) for _ in lines]
    if not all(L.is_finite() for L in factors):
        return [lacking[i] if factors[i].is_finite() else unknown for i in lines]
    W = [factors[i].lower_solution(to_metres[i]) for i in lines]
    excess = whitened(W, true - spread)
    if _less_than(bound, excess).is_definite():
        return None
    wholes = [W[i].congruence(spread.block_of(i, i)) for i in lines]
    sizes = [factor_or_identity(diagonal([1.0] * 4) + whole) for whole in wholes]
    guess = FIRST
    for _ in range(4 * len(J)):
        found = largest(excess, bound, guess)
        if found is None:
            return [unknown for _ in lines]
        guess, v = found  # the next one is hardly larger
        amount = guess + SLACK
        parts = [Vector(v[4 * i : 4 * i + 4]) for i in lines]
        weights = [_solved(sizes[i].lower_solution, parts[i]).norm() + 1e-9 for i in lines]
        for i in lines:
            u = Vector(row @ parts[i] for row in factors[i])
            lacking[i] += amount * total(weights) / weights[i] * u.outer()
        excess -= Matrix(amount * a * v for a in v)
        if _less_than(bound, excess).is_definite():
            break
    return [J[i].congruence(lacking[i]) for i in lines]


def _less_than(bound: float, S: Matrix) -> Matrix:
    """Return bound I - S."""
    return diagonal([bound] * len(S)) - S


def _solved(solution: Callable[[Matrix], Matrix], b: Vector) -> Vector:
    """Return the solution of a system with one right-hand side."""
    return solution(Matrix([b]).T).T[0]


def largest(S: Matrix, bound: float, guess: float) -> tuple[float, Vector] | None:
    """Return by how much the largest eigenvalue of S exceeds a bound, and an eigenvector.

    A factorization of s I - S decides whether s exceeds all eigenvalues. If it does, a step of
    inverse iteration gives a vector whose Rayleigh quotient is near the largest one from below.
    None if it is infinite.
    """
    low, high = 0.0, math.inf
    for _ in range(FACTORIZATIONS):
        L = _less_than(bound + guess, S).cholesky()
        if math.isnan(L[-1][-1]):
            low = guess
            guess = FARTHER * guess if math.isinf(high) else (low + high) / 2
            continue
        high = guess
        # The column of the inverse with the largest diagonal entry is nearest to the eigenvector.
        X = L.lower_solution(diagonal([1.0] * len(S))).T
        v = max(X, key=lambda column: dot_by_halves(column, column))
        v = _unit(_solved(L.T.upper_solution, v))
        v = _unit(_solved(L.T.upper_solution, _solved(L.lower_solution, v)))
        low = max(low, dot_by_halves(v, [dot_by_halves(row, v) for row in S]) - bound)
        if high - low <= PRECISION * high or high <= LEAST:
            return high, v
        guess = low + NEARER * (high - low)
    return None


def _unit(v: Vector) -> Vector:
    """Return the vector of length 1."""
    return v / v.norm()


def whitened(W: Sequence[Matrix], S: Matrix) -> Matrix:
    """Return blockdiag(W) S blockdiag(W)^T, exactly symmetric."""
    rows = Matrix()
    for i, one in enumerate(W):
        blocks = [one @ S.block_of(i, j) @ other.T for j, other in enumerate(W)]
        rows.extend(Vector(x for b in blocks for x in b[k]) for k in range(4))
    return rows.symmetric()
