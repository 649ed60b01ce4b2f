"""Cholesky factor of a covariance as signals: log pivots, and rows divided by their pivots.

Let ``S = L L^T`` be the covariance in the order of the rows, with L lower triangular. The signals
are the pivots ``log2 L_ii`` and the ratios ``L_ij / L_ii`` (Pinheiro and Bates, Statistics and
Computing 6, 1996, with each row divided by its pivot). Any bits decode to a positive definite
matrix.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, combinations, islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...values.errors import LayoutError
from ..layout.record_layout import RecordLayout
from ..layout.signals import PARAMETER_SIGNALS, RATIO, Signal, SignalRow
from .code import Array, check_octaves

#: Rows processed at a time: all arrays of a block stay in the cache.
BLOCK = 2048
#: Largest condition number of a decoded correlation matrix that double precision holds.
MAX_CONDITION = 1e13


class CholeskyFactor:
    """Cholesky factor as the signals ``Pivot<row>`` and ``Ratio<row><column>`` of a layout.

    The names give the order of the rows: with ``RatioC0Beta``, C0 comes after Beta.

    Args:
        layout: has the signals.
        rows: names of the rows, in the order of the states of the covariance.

    Raises:
        LayoutError: a signal is missing, the ratios do not define an order of the rows, a factor
            is not positive, or a decoded matrix could be too ill-conditioned.
    """

    def __init__(self, layout: RecordLayout, rows: Sequence[str] = PARAMETER_SIGNALS) -> None:
        below = {
            row: [column for column in rows if f"Ratio{row}{column}" in layout.signals]
            for row in rows
        }
        names = sorted(rows, key=lambda state: len(below[state]))
        if [len(below[name]) for name in names] != list(range(len(rows))):
            missing = [
                f"Ratio{a}{b} or Ratio{b}{a}"
                for a, b in combinations(rows, 2)
                if a not in below[b] and b not in below[a]
            ]
            raise LayoutError(
                f"{layout.source}: the ratios must order the rows, Ratio<row><column> for each "
                f"pair of {', '.join(rows)}, but there are {below}"
                f"{'; add ' if missing else ''}{' and '.join(missing)}"
            )
        #: Order of the rows, as indices into the states.
        self.order = [rows.index(name) for name in names]
        self.pivots = [layout[f"Pivot{name}"] for name in names]
        self.ratios = [
            [layout[f"Ratio{row}{column}"] for column in names[:i]] for i, row in enumerate(names)
        ]
        self.signals: tuple[Signal, ...] = (*self.pivots, *chain(*self.ratios))
        check_octaves(layout, self.pivots)
        for ratio in chain(*self.ratios):
            RATIO.check(ratio, layout.source)
        if (condition := self._largest_condition()) > MAX_CONDITION:
            raise LayoutError(
                f"{layout.source}: with {', '.join(ratio.name for ratio in chain(*self.ratios))} a "
                f"matrix could have the condition number {condition:.0e}, too large for double "
                "precision; give them smaller factors or fewer bits"
            )
        self._all_ratios = SignalRow(chain(*self.ratios))
        #: Standard deviations by raw pivot, for ``lookup``.
        self.sigmas = [exp2_table(signal) for signal in self.pivots]

    def _largest_condition(self) -> float:
        """Return the largest trace of the inverse correlation matrix of any bits.

        The condition number is at most this times the number of rows.
        """
        reach = np.zeros((len(self.ratios), len(self.ratios)))
        for i, ratios in enumerate(self.ratios):
            reach[i, :i] = [max(map(abs, ratio.reach)) for ratio in ratios]
        inverse = np.eye(len(reach))  # of I - reach, which has the worst signs; no term cancels
        for i in range(1, len(reach)):
            inverse[i] += reach[i, :i] @ inverse[:i]
        norm = np.sqrt(1 + (reach**2).sum(axis=1))
        return float(((inverse * norm) ** 2).sum())

    def decode(self, raw: Mapping[str, NDArray[np.int64]], scale: Array | None = None) -> Array:
        """Return (N, k, k) covariances ``scale L L^T``; without (N,) scales they are 1."""
        n, k = len(raw[self.pivots[0].name]), len(self.pivots)
        cov = np.empty((n, k, k))
        for start in range(0, n, BLOCK):
            rows = slice(start, start + BLOCK)
            block = {signal.name: raw[signal.name][rows] for signal in self.signals}
            L = []
            for table, pivot, ratios in zip(self.sigmas, self.pivots, self.ratios, strict=True):
                sigma = lookup(table, pivot, block[pivot.name])
                L.append([ratio.physical(block[ratio.name]) * sigma for ratio in ratios] + [sigma])
            for i, j, value in _products(L, 1.0 if scale is None else scale[rows]):
                cov[rows, self.order[i], self.order[j]] = value
                cov[rows, self.order[j], self.order[i]] = value
        return cov

    def decode_one(self, raw: Mapping[str, int], scale: float = 1.0) -> Array:
        """Return one (k, k) covariance: as ``decode`` to the last bit."""
        L, ratios = [], iter(self._all_ratios.physical_one(raw))
        for i, (table, pivot) in enumerate(zip(self.sigmas, self.pivots, strict=True)):
            sigma = lookup_one(table, pivot, raw[pivot.name])
            L.append([ratio * sigma for ratio in islice(ratios, i)] + [sigma])
        cov = [[0.0] * len(L) for _ in L]
        for i, j, value in _products(L, scale):
            cov[self.order[i]][self.order[j]] = cov[self.order[j]][self.order[i]] = value
        return np.array(cov)

    def widest(self) -> dict[str, int]:
        """Return the raw values of the largest pivots without correlations."""
        pivots = {pivot.name: pivot.raw_max for pivot in self.pivots}
        none = {ratio.name: int(ratio.limited(ratio.raw(0.0))) for ratio in chain(*self.ratios)}
        return pivots | none


def _products(L: list[list[Any]], factor: Any) -> Iterator[tuple[int, int, Any]]:
    """Yield the lower triangle of ``factor L L^T``, for arrays and single numbers alike."""
    for i, row in enumerate(L):
        scaled = [factor * entry for entry in row]
        for j, column in enumerate(L[: i + 1]):
            value = scaled[0] * column[0]
            for k in range(1, j + 1):
                value += scaled[k] * column[k]
            yield i, j, value


def exp2_table(signal: Signal) -> Array | None:
    """Return 2 to the power of each physical value; None if there are more than 65 536."""
    if signal.raw_max - signal.raw_min >= 1 << 16:
        return None
    return np.exp2(signal.physical(np.arange(signal.raw_min, signal.raw_max + 1)))


def lookup(table: Array | None, signal: Signal, raw: NDArray[np.int64]) -> Array:
    """Return 2 to the power of the physical values of raw values, with a table of ``exp2_table``.

    If there is a table, a raw value outside the DBC's range is clipped to it.
    """
    if table is None:
        return np.exp2(signal.physical(raw))
    return table.take(raw - signal.raw_min, mode="clip")


def lookup_one(table: Array | None, signal: Signal, raw: int) -> float:
    """Return one value: as ``lookup`` to the last bit."""
    if table is None:
        return float(np.exp2(signal.physical_one(raw)))
    return table.item(min(max(raw - signal.raw_min, 0), len(table) - 1))
