"""Log-Cholesky without feedback: each pivot and each ratio is rounded on its own.

The signals are those of the default code without its inflation. The decoded covariance need not
cover the true one: an error in one entry propagates to all entries that depend on it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ...wire.covariance.code import Array, Coded
from ...wire.covariance.factor import CholeskyFactor
from ...wire.layout.message_layout import Layout
from .code import CovarianceCode, nearest_raw


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
        return self.factor.decode(raw)

    def widest(self) -> dict[str, int]:
        return self.factor.widest()
