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
from numpy.typing import ArrayLike, NDArray

from ...values.elementary import exp2
from ...values.errors import LayoutError
from ..layout.record_layout import RecordLayout
from ..layout.signals import OCTAVES, PARAMETER_SIGNALS, RATIO, Signal, SignalRow

Array = NDArray[np.float64]

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
        for pivot in self.pivots:
            OCTAVES.check(pivot, layout.source)
        for ratio in chain(*self.ratios):
            RATIO.check(ratio, layout.source)
        if (condition := self._largest_condition()) > MAX_CONDITION:
            raise LayoutError(
                f"{layout.source}: with {', '.join(ratio.name for ratio in chain(*self.ratios))} a "
                f"matrix could have the condition number {condition:.0e}, too large for double "
                "precision; give them smaller factors or fewer bits"
            )
        self._all_ratios = SignalRow(chain(*self.ratios))
        #: Standard deviations of the pivots.
        self.sigmas = [PowersOfTwo(signal) for signal in self.pivots]

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
        """Return the (N, k, k) covariances ``F F^T`` of the ``factors`` F."""
        n, k = len(raw[self.pivots[0].name]), len(self.pivots)
        cov = np.empty((n, k, k))
        for rows, F in self._blocks(raw, scale):
            for i, j, value in _products(F):
                cov[rows, self.order[i], self.order[j]] = value
                cov[rows, self.order[j], self.order[i]] = value
        return cov

    def factors(self, raw: Mapping[str, NDArray[np.int64]], scale: Array | None = None) -> Array:
        """Return (N, k, k) square roots F of covariances; row i belongs to state i.

        They are lower triangular with their rows in the order of the DBC.

        Args:
            raw: (N,) raw values by signal.
            scale: (N,) factors on the standard deviations; None: 1.
        """
        n, k = len(raw[self.pivots[0].name]), len(self.pivots)
        factors = np.zeros((n, k, k))
        for rows, F in self._blocks(raw, scale):
            for i, row in enumerate(F):
                for j, entry in enumerate(row):
                    factors[rows, self.order[i], j] = entry
        return factors

    def _blocks(
        self, raw: Mapping[str, NDArray[np.int64]], scale: Array | None
    ) -> Iterator[tuple[slice, list[list[Array]]]]:
        """Yield the rows of each block, and the rows of their factors in the order of the DBC."""
        for start in range(0, len(raw[self.pivots[0].name]), BLOCK):
            rows = slice(start, start + BLOCK)
            block = {signal.name: raw[signal.name][rows] for signal in self.signals}
            F = []
            for powers, pivot, ratios in zip(self.sigmas, self.pivots, self.ratios, strict=True):
                sigma = powers.of(block[pivot.name])
                sigma = sigma if scale is None else sigma * scale[rows]
                F.append([ratio.physical(block[ratio.name]) * sigma for ratio in ratios] + [sigma])
            yield rows, F

    def decode_one(self, raw: Mapping[str, int], scale: float = 1.0) -> Array:
        """Return one (k, k) covariance: as ``decode`` to the last bit."""
        F, ratios = [], iter(self._all_ratios.physical_one(raw))
        for i, (powers, pivot) in enumerate(zip(self.sigmas, self.pivots, strict=True)):
            sigma = powers.of_one(raw[pivot.name]) * scale
            F.append([ratio * sigma for ratio in islice(ratios, i)] + [sigma])
        cov = [[0.0] * len(F) for _ in F]
        for i, j, value in _products(F):
            cov[self.order[i]][self.order[j]] = cov[self.order[j]][self.order[i]] = value
        return np.array(cov)

    def widest(self) -> dict[str, int]:
        """Return the raw values of the largest pivots without correlations."""
        pivots = {pivot.name: pivot.raw_max for pivot in self.pivots}
        none = {ratio.name: int(ratio.limited(ratio.raw(0.0))) for ratio in chain(*self.ratios)}
        return pivots | none


def _products(F: list[list[Any]]) -> Iterator[tuple[int, int, Any]]:
    """Yield the lower triangle of ``F F^T``, for arrays and single numbers alike.

    The terms are added in the order of the columns.
    """
    for i, row in enumerate(F):
        for j, column in enumerate(F[: i + 1]):
            value = row[0] * column[0]
            for k in range(1, j + 1):
                value = value + row[k] * column[k]
            yield i, j, value


class PowersOfTwo:
    """Powers of 2 whose exponents are the values of a signal; a table unless that is long.

    If there is a table, a raw value outside the DBC's range is clipped to it.

    Args:
        signal: the exponents.
        share: factor on the exponents.
    """

    def __init__(self, signal: Signal, share: float = 1.0) -> None:
        self._signal, self._share = signal, share
        #: Powers by raw value; None if there are more than 65 536.
        self.table: Array | None = None
        if signal.raw_max - signal.raw_min < 1 << 16:
            self.table = self._compute(np.arange(signal.raw_min, signal.raw_max + 1))

    def of(self, raw: NDArray[np.int64]) -> Array:
        """Return the (n,) powers of raw values."""
        if self.table is None:
            return self._compute(raw)
        return self.table.take(raw - self._signal.raw_min, mode="clip")

    def of_one(self, raw: int) -> float:
        """Return the power of one raw value: as ``of`` to the last bit."""
        if self.table is None:
            return float(self._compute(raw))
        return self.table.item(min(max(raw - self._signal.raw_min, 0), len(self.table) - 1))

    def _compute(self, raw: ArrayLike) -> Array:
        return exp2(self._signal.physical(raw) * self._share)
