"""Log-Cholesky without feedback: each pivot and each ratio is rounded on its own.

The signals are those of the default code without its inflation. The decoded covariance need not
cover the true one: an error in one entry propagates to all entries that depend on it.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from ...values.elementary import exp2
from ...wire.layout.cholesky import CholeskyFactor
from ...wire.layout.message_layout import Layout
from .code import Array, Coded, CovarianceCode, nearest_raw


class LogCholesky(CovarianceCode):
    """Pivots and ratios, each rounded to the nearest."""

    name = "LogCholesky"
    about = "log2 of the Cholesky pivots, and the rows over their pivots, each rounded on its own"
    positive_definite = True
    covering = False

    def __init__(self, layout: Layout) -> None:
        self.factor = CholeskyFactor(layout)
        self.signals = self.factor.signals

    def encode(self, error: Array, resolution: Array) -> Coded:
        raw: dict[str, NDArray[np.int64]] = {}
        cut = np.zeros(len(error), dtype=bool)
        L: list[list[Array]] = []
        for row, i in enumerate(self.factor.order):
            entries: list[Array] = []
            for column, j in enumerate(self.factor.order[:row]):
                rest = error[:, i, j] - sum(entries[k] * L[column][k] for k in range(column))
                entries.append(rest / L[column][column])
            variance = error[:, i, i] + resolution[i] - sum(entry**2 for entry in entries)
            pivot = np.sqrt(np.maximum(variance, resolution[i]))
            L.append([*entries, pivot])
            wanted = [np.log2(pivot), *(entry / pivot for entry in entries)]
            for signal, value in zip(
                (self.factor.pivots[row], *self.factor.ratios[row]), wanted, strict=True
            ):
                raw[signal.name], beyond = nearest_raw(signal, value)
                cut |= beyond
        return Coded(raw, cut, ~cut)

    def decode(self, raw: Mapping[str, NDArray[np.int64]]) -> Array:
        F: list[list[Array]] = []  # rows, in the order of the DBC
        cov = np.empty((len(raw[self.signals[0].name]), 4, 4))
        order = self.factor.order
        for i, pivot in enumerate(self.factor.pivots):
            sigma = exp2(pivot.physical(raw[pivot.name]))
            ratios = (ratio.physical(raw[ratio.name]) for ratio in self.factor.ratios[i])
            F.append([*(ratio * sigma for ratio in ratios), sigma])
            for j, row in enumerate(F):
                value = F[i][0] * row[0]
                for k in range(1, j + 1):
                    value = value + F[i][k] * row[k]
                cov[:, order[i], order[j]] = cov[:, order[j], order[i]] = value
        return cov

    def widest(self) -> dict[str, int]:
        pivots = {pivot.name: pivot.raw_max for pivot in self.factor.pivots}
        none = {
            ratio.name: int(ratio.limited(ratio.raw(0.0))) for ratio in chain(*self.factor.ratios)
        }
        return pivots | none
