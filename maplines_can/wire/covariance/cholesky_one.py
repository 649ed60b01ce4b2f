"""The code of ``cholesky.py`` for one covariance, in plain numbers.

Arrays of one covariance take ten times as long as its arithmetic. The operations and their order
are those of the arrays, and of ``c/src/cholesky.c``, so the raw values are the same. Sums are
written as loops: ``sum`` of floats rounds in another way since Python 3.12.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ...values import fixed_order
from ...values.elementary import log2_one
from ..layout.signals import Signal
from .code import CodedOne
from .factor import CholeskyFactor, PowersOfTwo

#: Margin of the inflation, so that a check with another algorithm's rounding passes.
MARGIN = 1e-6
#: The same, as a share of the variances of the target in units of the decoded ones: 32 roundings.
AMPLIFIED = 32 * 2.0**-52
#: Tolerance of the division before a pivot is lifted by whole steps.
SLACK = 1e-9
#: Most times that a pivot is lifted. Once is enough, unless rounding moves another ratio out.
LIFTS = 3
#: Most times that a covariance is encoded, and what is added to the scale each time.
ATTEMPTS, WIDER = 8, 1.02

Rows = list[list[float]]


class CholeskyOne:
    """Encoder of one covariance at a time; ``CholeskyCode`` explains what it does.

    Args:
        factor: signals of the factor.
        inflation: signal of the inflation.
        powers: 2^inflation.
        reachable: (k,) see ``CholeskyCode``.
    """

    def __init__(
        self,
        factor: CholeskyFactor,
        inflation: Signal,
        powers: PowersOfTwo,
        reachable: Sequence[float],
    ) -> None:
        self._factor, self._inflation, self._powers = factor, inflation, powers
        self._reachable = reachable
        self._widest = factor.widest() | {inflation.name: inflation.raw_max}

    def encode(self, error: Rows, resolution: Sequence[float]) -> CodedOne:
        """Encode a target: as ``CholeskyCode.encode``.

        Raises:
            ArithmeticError, ValueError: a number is infinite or NaN on the way, with which arrays
                go on.
        """
        order = self._factor.order
        M = [[error[i][j] for j in order] for i in order]
        if not all(error[i][i] < 4 * self._reachable[i] for i in order):
            return CodedOne(self._widest.copy(), False, False)
        scale, lifted = 1.0, False
        for _ in range(ATTEMPTS):
            floor = [resolution[i] * scale for i in order]
            raw, L, lifted = self._quantize(M, scale, floor)
            W, margin = _whitened(L, M)
            raw[self._inflation.name], covered = self._least_inflation(W, margin)
            if covered:
                return CodedOne(raw, lifted, True)
            scale = WIDER * scale * self._excess(W, margin)
        return CodedOne(self._widest.copy(), lifted, False)

    def _quantize(
        self, M: Rows, scale: float, floor: Sequence[float]
    ) -> tuple[dict[str, int], Rows, bool]:
        """Return the raw factor of ``scale M + diag(floor)``, the decoded L', and if it is lifted.

        See ``CholeskyCode._quantize``.
        """
        factor, raw, any_lifted = self._factor, dict[str, int](), False
        L: Rows = []
        A: Rows = []
        decoded: Rows = []
        for i, (sigmas, pivot) in enumerate(zip(factor.sigmas, factor.pivots, strict=True)):
            target, squares = list[float](), 0.0
            for j, column in enumerate(L):
                products = 0.0
                for k in range(j):
                    products += target[k] * column[k]
                x = (scale * M[i][j] - products) / column[j]
                squares += x * x
                target.append(x)
            exact = math.sqrt(max(scale * M[i][i] + floor[i] - squares, floor[i]))
            nearest = pivot.raw_one(log2_one(exact))
            chosen = pivot.limited_one(nearest)
            sigma = sigmas.of_one(chosen)
            row, overflow = _choose_ratios(factor.ratios[i], target, sigma, A, raw)
            for _ in range(LIFTS):
                if not overflow > 1:
                    break
                lift = math.ceil(log2_one(overflow) / pivot.factor + SLACK)
                chosen = pivot.limited_one(chosen + max(lift, 1))
                sigma = sigmas.of_one(chosen)
                row, overflow = _choose_ratios(factor.ratios[i], target, sigma, A, raw)
            if chosen > nearest:
                exact, any_lifted = sigma, True
            raw[pivot.name] = chosen
            above = []
            for j in range(i):
                products = 0.0
                for k in range(j, i):
                    products += row[k] * A[k][j]
                above.append((target[j] - products) / sigma)
            decoded.append([*row, sigma])
            L.append([*target, exact])
            A.append([*above, exact / sigma])
        return raw, decoded, any_lifted

    def _least_inflation(self, W: Rows, margin: float) -> tuple[int, bool]:
        """Return the least raw inflation that covers a whitened target, and whether it does.

        See ``CholeskyCode._least_inflation``.
        """
        signal, most = self._inflation, self._inflation.raw_max
        bound = max([row[i] for i, row in enumerate(W)])
        exponent = log2_one(bound * (1 + MARGIN) + margin)
        high = signal.limited_one(math.ceil((exponent - signal.offset) / signal.factor))
        low, step = high - 1, 1
        covered = self._covers(high, W, margin)
        while not covered and high < most:
            low, high = high, min(high + step, most)
            step *= 2
            covered = self._covers(high, W, margin)
        while covered and high - low > 1:
            middle = low + (high - low) // 2
            if self._covers(middle, W, margin):
                high = middle
            else:
                low = middle
        return high, covered

    def _covers(self, raw: int, W: Rows, margin: float) -> bool:
        """Return whether a raw inflation covers a whitened target."""
        diagonal = (self._powers.of_one(raw) - margin) / (1 + MARGIN)
        rest = [[-value for value in row] for row in W]
        for i, row in enumerate(rest):
            row[i] += diagonal
        return fixed_order.is_definite_one(rest)

    def _excess(self, W: Rows, margin: float) -> float:
        """Return the ratio of what a whitened target needs to the largest inflation, or 1."""
        n = len(W)
        full = np.array([[W[max(i, j)][min(i, j)] for j in range(n)] for i in range(n)])
        largest = fixed_order.eigen(full)[0].max().item()
        needed = max(largest, 0.0) * (1 + MARGIN) + margin
        return max(needed / self._powers.of_one(self._inflation.raw_max), 1.0)


def _choose_ratios(
    ratios: Sequence[Signal], target: list[float], sigma: float, A: Rows, raw: dict[str, int]
) -> tuple[list[float], float]:
    """Quantize a row left of its pivot: see ``CholeskyCode._choose_ratios``."""
    i, overflow = len(target), 1.0
    row = [sigma] * i
    for j in reversed(range(i)):
        products = 0.0
        for k in range(j + 1, i):
            products += row[k] * A[k][j]
        wanted = (target[j] - products) / (A[j][j] * sigma)
        ratio = ratios[j]
        limited, decoded, beyond = ratio.nearest_one(wanted)
        if beyond:
            overflow = max(overflow, abs(wanted) / (abs(decoded) + ratio.factor / 2))
        raw[ratio.name] = limited
        row[j] = decoded * sigma
    return row, overflow


def _whitened(L: Rows, M: Rows) -> tuple[Rows, float]:
    """Return the lower part of L^-1 M L^-T, and the margin for its rounding."""
    X: Rows = []  # rows of L^-1
    W: Rows = []
    amplification = 0.0
    for i, entries in enumerate(L):
        inverse = 1 / entries[i]
        row = []
        for j in range(i):
            products = 0.0
            for k in range(j, i):
                products += entries[k] * X[k][j]
            row.append(-inverse * products)
        row.append(inverse)
        X.append(row)
        XM, whitened, amplified = list[float](), list[float](), 0.0
        for j in range(i + 1):
            products = 0.0
            for k in range(i + 1):
                products += row[k] * M[k][j]
            XM.append(products)
            products, column = 0.0, X[j]
            for k in range(j + 1):
                products += XM[k] * column[k]
            whitened.append(products)
            amplified += row[j] * row[j] * M[j][j]
        W.append(whitened)
        amplification += amplified
    return W, MARGIN + AMPLIFIED * amplification
