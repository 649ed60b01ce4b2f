"""A covariance as pivots, ratios and an inflation.

With L the Cholesky factor of a covariance whose rows are in the order of the DBC, the signals are
log2 of the pivots L[i][i], and the ratios L[i][j] / L[i][i]. They are rounded row by row, each so
that ``L'^-1 L`` is nearest to the identity given those already rounded; L' is the decoded factor.
The inflation is the least one with which the decoded covariance covers the target.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property

from ..wire.layout.record_layout import RecordLayout
from ..wire.layout.signals import PARAMETER_SIGNALS, Signal
from .elementary import exp2, log2
from .matrices import Matrix, Row, eigen, is_definite, positive_part, total
from .rounding import limited, rounded
from .rounding import nearest as nearest_of

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


@dataclass(frozen=True)
class Code:
    """Signals of a covariance in a record.

    Args:
        layout: of the record.
        names: of the states, in the order of the rows of the covariance.
    """

    layout: RecordLayout
    names: Sequence[str] = PARAMETER_SIGNALS

    @cached_property
    def rows(self) -> list[str]:
        """Names in the order of the rows of the factor: row i has i ratios."""
        return sorted(self.names, key=lambda row: len(self._columns(row)))

    def _columns(self, row: str) -> list[str]:
        return [name for name in self.names if f"Ratio{row}{name}" in self.layout.signals]

    @cached_property
    def order(self) -> list[int]:
        """States in the order of the rows."""
        return [list(self.names).index(row) for row in self.rows]

    @cached_property
    def pivots(self) -> list[Signal]:
        """Signal of log2 L[i][i]."""
        return [self.layout[f"Pivot{row}"] for row in self.rows]

    @cached_property
    def ratios(self) -> list[list[Signal]]:
        """Signals of L[i][j] / L[i][i], for j < i."""
        return [
            [self.layout[f"Ratio{row}{column}"] for column in self.rows[:i]]
            for i, row in enumerate(self.rows)
        ]

    @cached_property
    def inflation(self) -> Signal:
        """Signal of log2 of the factor on the whole covariance."""
        return self.layout["Inflation"]

    @cached_property
    def reachable(self) -> Row:
        """Variances by state beyond which no pivot and ratios can cover."""
        variances = [0.0] * len(self.rows)
        for state, pivot, ratios in zip(self.order, self.pivots, self.ratios, strict=True):
            reach = 1.0
            for ratio in ratios:
                reach += max(map(abs, ratio.physical_range)) ** 2
            variances[state] = exp2(2 * pivot.physical_range[1]) * reach
        return variances

    def widest(self) -> dict[str, int]:
        """Return the greatest pivots without correlations: of a line without a covariance."""
        ratios = [ratio for row in self.ratios for ratio in row]
        return {
            **{pivot.name: pivot.raw_max for pivot in self.pivots},
            **{
                ratio.name: limited(ratio, rounded(-ratio.offset / ratio.factor))
                for ratio in ratios
            },
            self.inflation.name: self.inflation.raw_max,
        }


@cache
def code_of(layout: RecordLayout, names: tuple[str, ...] = tuple(PARAMETER_SIGNALS)) -> Code:
    """Return the signals of a covariance in a record."""
    return Code(layout, names)


# ---- encode -----------------------------------------------------------------------------------


@dataclass
class Coded:
    """A covariance as raw values.

    Args:
        raw: by signal.
        is_saturated: whether a value is at the end of its range.
        is_covered: whether the decoded covariance covers the target.
    """

    raw: dict[str, int]
    is_saturated: bool
    is_covered: bool


def encode(code: Code, target: Matrix, resolution: Sequence[float]) -> Coded:
    """Return the raw values of a covariance that covers a target.

    If the greatest inflation does not cover it, the target is encoded again, wider by what was
    missing. That happens if a value was clipped, or if a DBC has coarse steps.

    Args:
        code: of the covariance.
        target: positive semidefinite, in the order of the states.
        resolution: variances of the rounding of the mean: least squares of the pivots.
    """
    if not all(row[i] < 4 * code.reachable[i] for i, row in enumerate(target)):
        return Coded(code.widest(), False, False)
    M = [[target[i][j] for j in code.order] for i in code.order]
    scale, is_lifted = 1.0, False
    for _ in range(ATTEMPTS):
        floor = [resolution[i] * scale for i in code.order]
        raw, L, is_lifted = quantized(code, M, scale, floor)
        W, margin = whitened(L, M)
        raw["Inflation"], is_covered = least_inflation(code.inflation, W, margin)
        if is_covered:
            return Coded(raw, is_lifted, True)
        scale = WIDER * scale * missing_inflation(code.inflation, W, margin)
    return Coded(code.widest(), is_lifted, False)


def quantized(
    code: Code, M: Matrix, scale: float, floor: Sequence[float]
) -> tuple[dict[str, int], Matrix, bool]:
    """Return the raw factor of ``scale M + diag(floor)``, what it decodes to, and if it is lifted.

    A pivot is lifted where a ratio would be out of range: that adds variance only in the direction
    that is narrower than the signals can state. The rest of the target then follows the lifted one.
    """
    raw, is_any_lifted = dict[str, int](), False
    L: Matrix = []  # of the target, given what is already rounded
    decoded: Matrix = []  # L'
    A: Matrix = []  # L'^-1 L
    for i, (pivot, ratios) in enumerate(zip(code.pivots, code.ratios, strict=True)):
        row: Row = []
        for j in range(i):
            row.append((scale * M[i][j] - dot(row, L[j][:j])) / L[j][j])
        variance = scale * M[i][i] + floor[i] - dot(row, row)
        exact = math.sqrt(max(variance, floor[i]))
        nearest = nearest_of(pivot, log2(exact))
        chosen = limited(pivot, nearest)
        for lifts in range(LIFTS + 1):
            sigma = exp2(pivot.physical_one(chosen))
            of_row, overflow = chosen_ratios(ratios, row, sigma, A, raw)
            if not overflow > 1 or lifts == LIFTS:
                break
            lift = math.ceil(log2(overflow) / pivot.factor + SLACK)
            chosen = limited(pivot, chosen + max(lift, 1))
        if chosen > nearest:
            exact, is_any_lifted = sigma, True
        raw[pivot.name] = chosen
        above = [(row[j] - dot(of_row[j:], _column(A, j))) / sigma for j in range(i)]
        L.append([*row, exact])
        decoded.append([*of_row, sigma])
        A.append([*above, exact / sigma])
    return raw, decoded, is_any_lifted


def dot(a: Sequence[float], b: Sequence[float]) -> float:
    """Return the scalar product of two rows, the first terms first; 0 of none."""
    products = 0.0
    for x, y in zip(a, b, strict=True):
        products += x * y
    return products


def _column(A: Matrix, j: int) -> Row:
    """Return column j of a lower triangular matrix from the diagonal on."""
    return [row[j] for row in A[j:]]


def chosen_ratios(
    ratios: Sequence[Signal], target: Row, sigma: float, A: Matrix, raw: dict[str, int]
) -> tuple[Row, float]:
    """Round a row left of its pivot, from the diagonal outwards; its ratios are added to ``raw``.

    Returns:
        The decoded entries, and the factor by which sigma is too small for the ratios; 1 if they
        fit.
    """
    i, overflow = len(target), 1.0
    row = [sigma] * i
    for j in reversed(range(i)):
        wanted = (target[j] - dot(row[j + 1 :], _column(A, j)[1:])) / (A[j][j] * sigma)
        ratio = ratios[j]
        nearest = nearest_of(ratio, wanted)
        raw[ratio.name] = limited(ratio, nearest)
        decoded = ratio.physical_one(raw[ratio.name])
        if raw[ratio.name] != nearest:
            overflow = max(overflow, abs(wanted) / (abs(decoded) + ratio.factor / 2))
        row[j] = decoded * sigma
    return row, overflow


def whitened(L: Matrix, M: Matrix) -> tuple[Matrix, float]:
    """Return L^-1 M L^-T, and the margin for its rounding."""
    X: Matrix = []  # L^-1
    for i, row in enumerate(L):
        inverse = 1 / row[i]
        X.append([-inverse * dot(row[j:i], _column(X, j)) for j in range(i)] + [inverse])
    n = len(L)
    W, amplification = [[0.0] * n for _ in L], 0.0
    for i, x in enumerate(X):
        XM = [dot(x, [M[k][j] for k in range(i + 1)]) for j in range(i + 1)]
        for j in range(i + 1):
            W[i][j] = W[j][i] = dot(XM[: j + 1], X[j])
        amplified = 0.0
        for k in range(i + 1):
            amplified += x[k] * x[k] * M[k][k]
        amplification += amplified
    return W, MARGIN + AMPLIFIED * amplification


def least_inflation(inflation: Signal, W: Matrix, margin: float) -> tuple[int, bool]:
    """Return the least raw inflation that covers a whitened target, and whether it does.

    The search begins at a lower bound, the greatest entry on the diagonal. Steps double until the
    target is covered, and are halved then.
    """
    bound = max(row[i] for i, row in enumerate(W))
    exponent = log2(bound * (1 + MARGIN) + margin)
    high = limited(inflation, _ceil((exponent - inflation.offset) / inflation.factor))
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


def _ceil(x: float) -> float:
    return math.ceil(x) if math.isfinite(x) else x


def covers(inflation: Signal, raw: int, W: Matrix, margin: float) -> bool:
    """Whether a raw inflation covers a whitened target: ``diag - W`` is positive definite."""
    diagonal = (exp2(inflation.physical_one(raw)) - margin) / (1 + MARGIN)
    rest = [[-value for value in row] for row in W]
    for i, row in enumerate(rest):
        row[i] += diagonal
    return is_definite(rest)


def missing_inflation(inflation: Signal, W: Matrix, margin: float) -> float:
    """Return the ratio of what a whitened target needs to the greatest inflation, or 1."""
    largest = max(eigen(W)[0])
    needed = max(largest, 0.0) * (1 + MARGIN) + margin
    return max(needed / exp2(inflation.physical_one(inflation.raw_max)), 1.0)


# ---- a caller's covariance --------------------------------------------------------------------


def scale_of(S: Matrix) -> Row:
    """Return the standard deviations, with 1 in place of 0."""
    return [math.sqrt(row[i] if row[i] > 0 else 1.0) for i, row in enumerate(S)]


def is_indefinite(S: Matrix) -> bool:
    """Whether a matrix is no covariance beyond rounding: its correlations have no factor."""
    scale = scale_of(S)
    L: Matrix = []
    for i, entries in enumerate(S):
        row: Row = []
        for j, other in enumerate(L):
            row.append((entries[j] / (scale[i] * scale[j]) - dot(row, other[:j])) / other[j])
        pivot = entries[i] / (scale[i] * scale[i]) + ROUNDING - dot(row, row)
        if not pivot > 0:
            return True
        L.append([*row, math.sqrt(pivot)])
    return False


def nearest_covariance(S: Matrix) -> Matrix:
    """Return the nearest covariance that covers a symmetric matrix, in units of its sigmas."""
    nearest = _nearest(S, scale_of(S))
    if any(row[i] == 0 and any(row) for i, row in enumerate(nearest)):
        # Covariances of a zero variance that are so small that rounding hides them.
        nearest = _nearest(S, _scale_of_any(S))
    if any(row[i] < S[i][i] / 2 for i, row in enumerate(nearest)):
        # Variances beside covariances many times larger than they admit: sums cover any row.
        sums = [total([abs(x) for x in row]) for row in S]
        return [[x if i == j else 0.0 for j in range(len(S))] for i, x in enumerate(sums)]
    return nearest


def _nearest(S: Matrix, scale: Row) -> Matrix:
    """Return the matrix without negative eigenvalues, in units of a scale."""
    units = [[a * b for b in scale] for a in scale]
    E = [[x / unit for x, unit in pair] for pair in _pairs(S, units)]
    if not min(eigen(E)[0]) < 0:
        return S
    return [[x * unit for x, unit in pair] for pair in _pairs(positive_part(E), units)]


def _pairs(A: Matrix, B: Matrix) -> Iterator[Iterator[tuple[float, float]]]:
    return (zip(a, b, strict=True) for a, b in zip(A, B, strict=True))


def _scale_of_any(S: Matrix) -> Row:
    """Return ``scale_of``, but with a variable of zero variance in the scale of its covariances."""
    scale = scale_of(S)
    found = []
    for i, row in enumerate(S):
        others = [scale[j] if S[j][j] > 0 else math.sqrt(abs(x)) for j, x in enumerate(row)]
        shares = [abs(x) / other for x, other in zip(row, others, strict=True) if other > 0]
        found.append(max(shares) if row[i] <= 0 and any(shares) else scale[i])
    return found
