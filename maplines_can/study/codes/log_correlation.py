"""Logarithmic standard deviations and correlations, as ETSI's collective perception message.

ETSI TS 103 324 sends a standard deviation for each state and the lower triangle of the correlation
matrix in steps of 1 %. Nothing keeps the six correlations consistent, so that what is
decoded need not be positive definite.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ...wire.covariance.code import Array, Coded, check_octaves
from ...wire.message.layout import Layout
from ...wire.message.signals import STATE_SIGNALS
from .batch import BatchCode, nearest_raw

__all__ = ["LogCorrelation"]


class LogCorrelation(BatchCode):
    """Standard deviations rounded up, correlations rounded to the nearest."""

    name = "LogCorrelation"
    about = "log2 of the standard deviations, rounded up, and correlations in steps of 1 %"
    positive_definite = False
    covering = False

    def __init__(self, layout: Layout) -> None:
        self.sigmas = [layout[f"Sigma{state}"] for state in STATE_SIGNALS]
        self.correlations = {
            (i, j): layout[f"Corr{STATE_SIGNALS[i]}{STATE_SIGNALS[j]}"]
            for i in range(4)
            for j in range(i + 1, 4)
        }
        self.signals = (*self.sigmas, *self.correlations.values())
        check_octaves(layout, self.sigmas)

    def encode(self, error: Array, resolution: Array) -> Coded:
        variance = np.einsum("nii->ni", error) + resolution
        sigma = np.sqrt(variance)
        raw: dict[str, NDArray[np.int64]] = {}
        cut = np.zeros(len(error), dtype=bool)
        for i, signal in enumerate(self.sigmas):
            steps = np.ceil((np.log2(sigma[:, i]) - signal.offset) / signal.factor - 1e-9)
            raw[signal.name] = signal.limited(steps).astype(np.int64)
            cut |= steps > signal.raw_max
        for (i, j), signal in self.correlations.items():
            value = error[:, i, j] / (sigma[:, i] * sigma[:, j])
            raw[signal.name], _ = nearest_raw(signal, value.clip(-1, 1))
        return Coded(raw, cut, ~cut)

    def decode(self, raw: Mapping[str, NDArray[np.int64]]) -> Array:
        sigma = np.stack([np.exp2(signal.physical(raw[signal.name])) for signal in self.sigmas], -1)
        cov = np.empty((len(sigma), 4, 4))
        for i in range(4):
            cov[:, i, i] = sigma[:, i] ** 2
        for (i, j), signal in self.correlations.items():
            value = signal.physical(raw[signal.name]) * sigma[:, i] * sigma[:, j]
            cov[:, i, j] = cov[:, j, i] = value
        return cov

    def widest(self) -> dict[str, int]:
        none = {signal.name: 0 for signal in self.signals}
        return none | {signal.name: signal.raw_max for signal in self.sigmas}
