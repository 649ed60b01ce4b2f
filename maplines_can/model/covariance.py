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
from operator import mul, truediv
from typing import NamedTuple

from ..wire.layout.record_layout import RecordLayout
from ..wire.layout.signals import PARAMETER_SIGNALS, Signal
from .elementary import exp2, log2
from .matrices import (
    Matrix,
    Row,
    diagonal,
    dot,
    eigen,
    entrywise,
    is_definite,
    outer,
    positive_part,
    scale_of,
    subtracted,
    total,
)
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


class Code(NamedTuple):
    """Signals of a covariance, with the rows of its factor in the order of the DBC."""

    order: list[int]  #: state of each row
    pivots: list[Signal]  #: log2 L[i][i]
    ratios: list[list[Signal]]  #: L[i][j] / L[i][i], for j < i
    inflation: Signal  #: log2 of the factor on the whole covariance


@cache
def code_of(layout: RecordLayout, names: tuple[str, ...] = PARAMETER_SIGNALS) -> Code:
    """Return the signals of a covariance of states: with ``RatioC0Beta``, C0 comes after Beta."""
    rows = sorted(names, key=lambda row: sum(f"Ratio{row}{one}" in layout.signals for one in names))
    ratios = [[layout[f"Ratio{row}{column}"] for column in rows[:i]] for i, row in enumerate(rows)]
    pivots = [layout[f"Pivot{row}"] for row in rows]
    return Code([names.index(row) for row in rows], pivots, ratios, layout["Inflation"])


# ---- decode -----------------------------------------------------------------------------------


def factor(code: Code, raw: Raw) -> Matrix:
    """Return F with F F^T = 2^Inflation L L^T, with its rows in the order of the states.

    L_ii = 2^Pivot_i, and L_ij = Ratio_ij L_ii for j < i.
    """
    scale = exp2(value(code.inflation, raw[code.inflation.name]) * 0.5)
    F: Matrix = [[] for _ in code.order]
    for state, pivot, ratios in zip(code.order, code.pivots, code.ratios, strict=True):
        sigma = exp2(value(pivot, raw[pivot.name])) * scale
        row = [value(ratio, raw[ratio.name]) * sigma for ratio in ratios]
        F[state] = [*row, sigma, *[0.0] * (len(F) - 1 - len(row))]
    return F


def decoded(code: Code, raw: Raw) -> Matrix:
    """Return the covariance, with its rows in the order of the states. Any bits are definite."""
    F = factor(code, raw)
    return [[dot(row, other) for other in F] for row in F]


def least_variances(code: Code) -> Row:
    """Return the least variances by state that can be decoded, for targets that are singular."""
    of_state = dict(zip(code.order, code.pivots, strict=True))
    return [exp2(2 * of_state[state].physical_range[0]) for state in range(len(of_state))]


def reachable(code: Code) -> Row:
    """Return the variances by state beyond which no pivot and ratios can cover."""
    variances = [0.0] * len(code.order)
    for state, pivot, ratios in zip(code.order, code.pivots, code.ratios, strict=True):
        reach = 1.0
        for ratio in ratios:
            most = max(map(abs, ratio.physical_range))
            reach += most * most
        variances[state] = exp2(2 * pivot.physical_range[1]) * reach
    return variances


def widest(code: Code) -> dict[str, int]:
    """Return the greatest pivots without correlations: of a line without a covariance."""
    ratios = {ratio.name: nearest_limited(ratio, 0.0) for row in code.ratios for ratio in row}
    return ratios | {signal.name: signal.raw_max for signal in (*code.pivots, code.inflation)}


# ---- encode -----------------------------------------------------------------------------------


class Coded(NamedTuple):
    """A covariance as raw values."""

    raw: dict[str, int]
    is_lifted: bool  #: a pivot is at a distance from its own, since a ratio is out of range
    is_covered: bool  #: the decoded covariance covers the target


def encode(code: Code, target: Matrix, resolution: Sequence[float]) -> Coded:
    """Return the raw values of a covariance that covers a target.

    If the greatest inflation does not cover it, the target is encoded again, wider by what was
    missing. That happens if a value was clipped, or if a DBC has coarse steps.

    Args:
        code: of the covariance.
        target: positive semidefinite, in the order of the states.
        resolution: variances of the rounding of the mean: least squares of the pivots.
    """
    scale, is_lifted, most = 1.0, False, reachable(code)
    is_small = all(row[i] < 4 * x for i, (row, x) in enumerate(zip(target, most, strict=True)))
    M = [[target[i][j] for j in code.order] for i in code.order]
    for _ in range(ATTEMPTS if is_small else 0):
        floor = [resolution[i] * scale for i in code.order]
        raw, L, is_lifted = quantized(code, M, scale, floor)
        W, margin = whitened(L, M)
        raw["Inflation"], is_covered = least_inflation(code.inflation, W, margin)
        if is_covered:
            return Coded(raw, is_lifted, True)
        scale = WIDER * scale * missing_inflation(code.inflation, W, margin)
    return Coded(widest(code), is_lifted, False)


def quantized(
    code: Code, M: Matrix, scale: float, floor: Sequence[float]
) -> tuple[dict[str, int], Matrix, bool]:
    """Return the raw factor of ``scale M + diag(floor)``, what it decodes to, and if it is lifted.

    A pivot is lifted where a ratio would be out of range: that adds variance only in the direction
    that is narrower than the signals can state. The rest of the target then follows the lifted one.
    """
    raw, is_lifted = dict[str, int](), False
    L: Matrix = []  # of the target, given what is already rounded
    decoded_L: Matrix = []  # L'
    A: Matrix = []  # L'^-1 L
    for i, (pivot, ratios) in enumerate(zip(code.pivots, code.ratios, strict=True)):
        row: Row = []
        for j in range(i):
            row.append((scale * M[i][j] - dot(row, L[j][:j])) / L[j][j])
        exact = math.sqrt(max(scale * M[i][i] + floor[i] - dot(row, row), floor[i]))
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
        above = [(row[j] - dot(of_row[j:], _column(A, j))) / sigma for j in range(i)]
        L.append([*row, exact])
        decoded_L.append([*of_row, sigma])
        A.append([*above, exact / sigma])
    return raw, decoded_L, is_lifted


def _column(A: Matrix, j: int) -> Row:
    """Return column j of a lower triangular matrix from the diagonal on."""
    return [row[j] for row in A[j:]]


def rounded_row(
    ratios: Sequence[Signal], target: Row, sigma: float, A: Matrix
) -> tuple[dict[str, int], Row, float]:
    """Round a row left of its pivot, from the diagonal outwards.

    Returns:
        The raw ratios, the decoded entries, and the factor by which sigma is too small for the
        ratios; 1 if they fit.
    """
    raw, row, overflow = dict[str, int](), [sigma] * len(target), 1.0
    for j, ratio in reversed([*enumerate(ratios)]):
        wanted = (target[j] - dot(row[j + 1 :], _column(A, j)[1:])) / (A[j][j] * sigma)
        raw[ratio.name] = nearest_limited(ratio, wanted)
        found = value(ratio, raw[ratio.name])
        if raw[ratio.name] != nearest(ratio, wanted):
            overflow = max(overflow, abs(wanted) / (abs(found) + ratio.factor / 2))
        row[j] = found * sigma
    return raw, row, overflow


def whitened(L: Matrix, M: Matrix) -> tuple[Matrix, float]:
    """Return L^-1 M L^-T, and the margin for its rounding."""
    X: Matrix = []  # L^-1
    for i, row in enumerate(L):
        inverse = 1 / row[i]
        X.append([-inverse * dot(row[j:i], _column(X, j)) for j in range(i)] + [inverse])
    W, amplification = diagonal([0.0] * len(L)), 0.0
    for i, x in enumerate(X):
        XM = [dot(x, [M[k][j] for k in range(i + 1)]) for j in range(i + 1)]
        for j in range(i + 1):
            W[i][j] = W[j][i] = dot(XM[: j + 1], X[j])
        amplification += dot([one * one for one in x], [M[k][k] for k in range(i + 1)])
    return W, MARGIN + AMPLIFIED * amplification


def least_inflation(inflation: Signal, W: Matrix, margin: float) -> tuple[int, bool]:
    """Return the least raw inflation that covers a whitened target, and whether it does.

    The search begins at a lower bound, the greatest entry on the diagonal. Steps double until the
    target is covered, and are halved then.
    """
    bound = max(row[i] for i, row in enumerate(W))
    exponent = log2(bound * (1 + MARGIN) + margin)
    high = limited(inflation, whole(math.ceil, (exponent - inflation.offset) / inflation.factor))
    low, step = high - 1, 1
    is_covered = covers(inflation, high, W, margin)
    while not is_covered and high < inflation.raw_max:
        low, high, step = high, min(high + step, inflation.raw_max), 2 * step
        is_covered = covers(inflation, high, W, margin)
    while is_covered and high - low > 1:
        middle = low + (high - low) // 2
        if covers(inflation, middle, W, margin):
            high = middle
        else:
            low = middle
    return high, is_covered


def covers(inflation: Signal, raw: int, W: Matrix, margin: float) -> bool:
    """Whether a raw inflation covers a whitened target: ``diag - W`` is positive definite."""
    most = (exp2(value(inflation, raw)) - margin) / (1 + MARGIN)
    return is_definite(subtracted(diagonal([most] * len(W)), W))


def missing_inflation(inflation: Signal, W: Matrix, margin: float) -> float:
    """Return the ratio of what a whitened target needs to the greatest inflation, or 1."""
    needed = max(*eigen(W)[0], 0.0) * (1 + MARGIN) + margin
    return max(needed / exp2(value(inflation, inflation.raw_max)), 1.0)


# ---- a caller's covariance --------------------------------------------------------------------


def is_indefinite(S: Matrix) -> bool:
    """Whether a matrix is no covariance beyond rounding: its correlations have no factor."""
    scale, L = scale_of(S), list[Row]()
    correlations = entrywise(truediv, S, outer(scale))
    for i, entries in enumerate(correlations):
        row: Row = []
        for j, other in enumerate(L):
            row.append((entries[j] - dot(row, other[:j])) / other[j])
        pivot = entries[i] + ROUNDING - dot(row, row)
        if not pivot > 0:
            return True
        L.append([*row, math.sqrt(pivot)])
    return False


def nearest_covariance(S: Matrix) -> Matrix:
    """Return the nearest covariance that covers a symmetric matrix, in units of its sigmas."""
    found = _nearest(S, scale_of(S))
    if any(row[i] == 0 and any(row) for i, row in enumerate(found)):
        # Covariances of a zero variance that are so small that rounding hides them.
        found = _nearest(S, _scale_of_any(S))
    if any(row[i] < S[i][i] / 2 for i, row in enumerate(found)):
        # Variances beside covariances many times larger than they admit: sums cover any row.
        return diagonal(total([abs(x) for x in row]) for row in S)
    return found


def _nearest(S: Matrix, scale: Row) -> Matrix:
    """Return the matrix without negative eigenvalues, in units of a scale."""
    E = entrywise(truediv, S, outer(scale))
    has_negative = min(eigen(E)[0]) < 0
    return entrywise(mul, positive_part(E), outer(scale)) if has_negative else S


def _scale_of_any(S: Matrix) -> Row:
    """Return ``scale_of``, but with a variable of zero variance in the scale of its covariances."""
    scale, found = scale_of(S), []
    for i, row in enumerate(S):
        others = [scale[j] if S[j][j] > 0 else math.sqrt(abs(x)) for j, x in enumerate(row)]
        shares = [abs(x) / other for x, other in zip(row, others, strict=True) if other > 0]
        found.append(max(shares) if row[i] <= 0 and any(shares) else scale[i])
    return found
