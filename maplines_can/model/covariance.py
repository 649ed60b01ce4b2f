"""A covariance as pivots, ratios and an inflation.

With L the Cholesky factor of a covariance whose rows are in the order of the DBC, the signals are
log2 of the pivots L[i][i], and the ratios L[i][j] / L[i][i]. They are rounded row by row, each so
that ``L'^-1 L`` is nearest to the identity given those already rounded; L' is the decoded factor.
The inflation is the least one with which the decoded covariance covers the target.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

from ..wire.layout.record_layout import RecordLayout
from ..wire.layout.record_signals import PARAMETER_SIGNALS, Signal
from .elementary import exp2, log2
from .matrices import Matrix, Vector, diagonal, matrix, total
from .signals import Raw, limited, nearest, nearest_limited, value, whole

#: Rounding that a covariance may have, as a share of the variances.
ROUNDING = 1e-9
#: Margin of the inflation, so that a check with another algorithm's rounding passes.
MARGIN = 1e-6
#: The same, as a share of the target's variances in units of the decoded ones: 32 roundings.
AMPLIFIED = 32 * 2.0**-52
#: Tolerance of the division before a pivot is lifted by whole steps.
SLACK = 1e-9
#: Most times that a pivot is lifted: once is enough unless rounding moves another ratio out.
LIFTS = 3
#: Most times that a covariance is encoded, and what is added to its scale each time.
ATTEMPTS, WIDER = 8, 1.02


class CodeRow(NamedTuple):
    """Signals of a row of the factor."""

    state: int  #: whose row it is
    pivot: Signal  #: log2 L[i][i]
    ratios: list[Signal]  #: L[i][j] / L[i][i], for j < i


class Code(NamedTuple):
    """Signals of a covariance."""

    rows: list[CodeRow]  #: in the order of the DBC
    inflation: Signal  #: log2 of the factor on the whole covariance


@cache
def code_of(layout: RecordLayout, names: tuple[str, ...] = PARAMETER_SIGNALS) -> Code:
    """Return the signals of a covariance of states: with ``RatioC0Beta``, C0 comes after Beta."""
    order = sorted(names, key=lambda row: sum(f"Ratio{row}{x}" in layout.signals for x in names))
    rows = [
        CodeRow(
            names.index(name),
            layout[f"Pivot{name}"],
            [layout[f"Ratio{name}{column}"] for column in order[:i]],
        )
        for i, name in enumerate(order)
    ]
    return Code(rows, layout["Inflation"])


def decoded(code: Code, raw: Raw) -> Matrix:
    """Return ``2^Inflation L L^T``, in the order of the states. Any bits are definite.

    L_ii = 2^Pivot_i, and L_ij = Ratio_ij L_ii for j < i.
    """
    F = diagonal([0.0] * len(code.rows))
    scale = exp2(value(code.inflation, raw[code.inflation.name]) * 0.5)
    for i, (state, pivot, ratios) in enumerate(code.rows):
        sigma = exp2(value(pivot, raw[pivot.name])) * scale
        F[state][: i + 1] = [*(value(one, raw[one.name]) * sigma for one in ratios), sigma]
    return F @ F.T


def least_variances(code: Code) -> Vector:
    """Return the least variances by state that can be decoded, for targets that are singular."""
    return Vector(exp2(2 * row.pivot.physical_range[0]) for row in sorted(code.rows))


def reachable(code: Code) -> Vector:
    """Return the variances by state beyond which no pivot and ratios can cover."""
    variances = Vector()
    for _, pivot, ratios in sorted(code.rows):
        reach = 1.0
        for ratio in ratios:
            most = max(map(abs, ratio.physical_range))
            reach += most * most
        variances.append(exp2(2 * pivot.physical_range[1]) * reach)
    return variances


def widest(code: Code) -> dict[str, int]:
    """Return the greatest pivots without correlations: of a line without a covariance."""
    raw = {one.name: nearest_limited(one, 0.0) for row in code.rows for one in row.ratios}
    return raw | {one.name: one.raw_max for one in (*(r.pivot for r in code.rows), code.inflation)}


# ---- encode -----------------------------------------------------------------------------------


class Coded(NamedTuple):
    """A covariance as raw values."""

    raw: dict[str, int]
    is_lifted: bool  #: a pivot is at a distance from its own, since a ratio is out of range
    is_covered: bool  #: the decoded covariance covers the target


def encode(code: Code, target: Matrix, resolution: Sequence[float]) -> Coded:
    """Return the raw values of a covariance that covers a target, which is semidefinite.

    If the greatest inflation does not cover it, the target is encoded again, wider by what was
    missing. That happens if a value was clipped, or if a DBC has coarse steps. The variances of the
    rounding of the mean are the least squares of the pivots.
    """
    scale, is_lifted, order = 1.0, False, [row.state for row in code.rows]
    most, M = 4 * reachable(code), target.block(order, order)
    is_small = all(x < y for x, y in zip(target.diagonal(), most, strict=True))
    for _ in range(ATTEMPTS if is_small else 0):
        raw, L, is_lifted = quantized(code, scale * M, [resolution[i] * scale for i in order])
        W, margin = whitened(L, M)
        raw["Inflation"], is_covered = least_inflation(code.inflation, W, margin)
        if is_covered:
            return Coded(raw, is_lifted, True)
        needed = max(*W.eigen()[0], 0.0) * (1 + MARGIN) + margin
        greatest = exp2(value(code.inflation, code.inflation.raw_max))
        scale = WIDER * scale * max(needed / greatest, 1.0)
    return Coded(widest(code), is_lifted, False)


def quantized(code: Code, M: Matrix, floor: Sequence[float]) -> tuple[dict[str, int], Matrix, bool]:
    """Return the raw factor of ``M + diag(floor)``, what it decodes to, and whether it is lifted.

    A pivot is lifted where a ratio would be out of range: that adds variance only in the direction
    that is narrower than the signals can state. The rest of the target then follows the lifted one.
    """
    raw, is_lifted = dict[str, int](), False
    L = Matrix()  # of the target, given what is already rounded
    decoded_L = Matrix()  # L'
    A = Matrix()  # L'^-1 L
    for i, (_, pivot, ratios) in enumerate(code.rows):
        row = _factor_row(M[i], L)
        exact = math.sqrt(max(M[i][i] + floor[i] - row @ row, floor[i]))
        own = nearest(pivot, log2(exact))  # it may be below the range, and then it is lifted
        chosen = limited(pivot, own)
        for lifts in range(LIFTS + 1):
            sigma = exp2(value(pivot, chosen))
            raw_ratios, of_row, overflow = rounded_row(ratios, row, sigma, A)
            if not overflow > 1 or lifts == LIFTS:
                break
            lift = math.ceil(log2(overflow) / pivot.factor + SLACK)
            chosen = limited(pivot, chosen + max(lift, 1))
        if chosen > own:
            exact, is_lifted = sigma, True
        raw |= {pivot.name: chosen, **raw_ratios}
        shares = [(row[j] - Vector(of_row[j:]) @ _column(A, j)) / sigma for j in range(i)]
        L.append(Vector([*row, exact]))
        decoded_L.append(Vector([*of_row, sigma]))
        A.append(Vector([*shares, exact / sigma]))
    return raw, decoded_L, is_lifted


def _factor_row(entries: Vector, L: Matrix) -> Vector:
    """Return a row of a Cholesky factor left of its pivot, given the rows above it."""
    row = Vector()
    for j, above in enumerate(L):
        row.append((entries[j] - row @ above[:j]) / above[j])
    return row


def _column(A: Matrix, j: int) -> Vector:
    """Return column j of a lower triangular matrix from the diagonal on."""
    return Vector(row[j] for row in A[j:])


def rounded_row(
    ratios: Sequence[Signal], target: Vector, sigma: float, A: Matrix
) -> tuple[dict[str, int], Vector, float]:
    """Round a row left of its pivot, from the diagonal outwards.

    The third result is the factor by which sigma is too small for the ratios; 1 if they fit.
    """
    raw, row, overflow = dict[str, int](), Vector(target), 1.0
    for j, ratio in reversed([*enumerate(ratios)]):
        rest = target[j] - Vector(row[j + 1 :]) @ _column(A, j)[1:]
        wanted = rest / (A[j][j] * sigma)
        raw[ratio.name] = nearest_limited(ratio, wanted)
        found = value(ratio, raw[ratio.name])
        if raw[ratio.name] != nearest(ratio, wanted):
            overflow = max(overflow, abs(wanted) / (abs(found) + ratio.factor / 2))
        row[j] = found * sigma
    return raw, row, overflow


def whitened(L: Matrix, M: Matrix) -> tuple[Matrix, float]:
    """Return L^-1 M L^-T, and the margin for its rounding."""
    X, amplification, n = diagonal([0.0] * len(L)), 0.0, range(len(L))
    for i, row in enumerate(L):
        X[i][i] = 1 / row[i]
        for j in range(i):
            X[i][j] = -X[i][i] * (Vector(row[j:i]) @ _column(X, j))
        amplification += (X[i] * X[i]) @ M.diagonal()
    W = X @ M @ X.T
    return matrix([W[max(i, j)][min(i, j)] for j in n] for i in n), (
        MARGIN + AMPLIFIED * amplification
    )


def least_inflation(inflation: Signal, W: Matrix, margin: float) -> tuple[int, bool]:
    """Return the least raw inflation that covers a whitened target, and whether it does.

    The search begins at a lower bound, the greatest entry on the diagonal. Steps double until the
    target is covered, and are halved then.
    """

    def covers(raw: int) -> bool:
        most = (exp2(value(inflation, raw)) - margin) / (1 + MARGIN)
        return (diagonal([most] * len(W)) - W).is_definite()

    exponent = log2(max(W.diagonal()) * (1 + MARGIN) + margin)
    high = limited(inflation, whole(math.ceil, (exponent - inflation.offset) / inflation.factor))
    low, step = high - 1, 1
    while not (is_covered := covers(high)) and high < inflation.raw_max:
        low, high, step = high, min(high + step, inflation.raw_max), 2 * step
    while is_covered and high - low > 1:
        middle = low + (high - low) // 2
        low, high = (low, middle) if covers(middle) else (middle, high)
    return high, is_covered


# ---- a caller's covariance --------------------------------------------------------------------


def is_indefinite(S: Matrix) -> bool:
    """Whether a matrix is no covariance beyond rounding: its correlations have no factor."""
    L = Matrix()
    for i, entries in enumerate(S / S.scale().outer()):
        row = _factor_row(entries, L)
        pivot = entries[i] + ROUNDING - row @ row
        if not pivot > 0:
            return True
        L.append(Vector([*row, math.sqrt(pivot)]))
    return False


def nearest_covariance(S: Matrix) -> Matrix:
    """Return the nearest covariance that covers a symmetric matrix, in units of its sigmas."""
    found = _nearest(S, S.scale())
    if any(row[i] == 0 and any(row) for i, row in enumerate(found)):
        # Covariances of a zero variance that are so small that rounding hides them.
        found = _nearest(S, _scale_of_any(S))
    if any(row[i] < S[i][i] / 2 for i, row in enumerate(found)):
        # Variances beside covariances many times larger than they admit: sums cover any row.
        return diagonal(total([*map(abs, row)]) for row in S)
    return found


def _nearest(S: Matrix, scale: Vector) -> Matrix:
    """Return the matrix without negative eigenvalues, in units of a scale."""
    E = S / scale.outer()
    return E.positive_part() * scale.outer() if min(E.eigen()[0]) < 0 else S


def _scale_of_any(S: Matrix) -> Vector:
    """Return ``scale_of``, but with a variable of zero variance in the scale of its covariances."""
    scale, found = S.scale(), Vector()
    for i, row in enumerate(S):
        others = [scale[j] if S[j][j] > 0 else math.sqrt(abs(x)) for j, x in enumerate(row)]
        shares = [abs(x) / other for x, other in zip(row, others, strict=True) if other > 0]
        found.append(max(shares) if row[i] <= 0 and any(shares) else scale[i])
    return found
