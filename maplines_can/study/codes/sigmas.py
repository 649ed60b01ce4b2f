"""Less than a covariance: standard deviations only, or nothing besides the mean."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ...line import VAGUE_SIGMA, Status
from ...wire.covariance.code import Array, Coded, CovarianceCode, check_octaves
from ...wire.message.layout import Layout
from ...wire.message.signals import STATE_SIGNALS
from .batch import BatchCode

__all__ = ["MeanOnly", "Sigmas"]


class Sigmas(BatchCode):
    """Four logarithmic standard deviations, rounded up.

    They cover the variances. Correlations are not sent, and not covered: the
    line's status is DIAGONAL.
    """

    name = "Sigmas"
    about = "log2 of the standard deviations, rounded up; no correlations"
    positive_definite = True
    covering = False
    status = Status.DIAGONAL

    def __init__(self, layout: Layout) -> None:
        self.signals = tuple(layout[f"Sigma{state}"] for state in STATE_SIGNALS)
        check_octaves(layout, self.signals)

    def encode(self, error: Array, resolution: Array) -> Coded:
        # A diagonal matrix covers another when each row's other entries fit into its surplus, in
        # any units; in those of the mean's own resolution they are of one size.
        unit = np.sqrt(resolution)
        bound = (np.abs(error / (unit[:, None] * unit))).sum(axis=2) * unit**2
        raw: dict[str, NDArray[np.int64]] = {}
        cut = np.zeros(len(error), dtype=bool)
        for i, signal in enumerate(self.signals):
            wanted = np.log2(np.maximum(bound[:, i], resolution[i])) / 2
            steps = np.ceil((wanted - signal.offset) / signal.factor + 1e-6)
            raw[signal.name] = signal.limited(steps).astype(np.int64)
            cut |= steps > signal.raw_max
        return Coded(raw, cut, ~cut)

    def decode(self, raw: Mapping[str, NDArray[np.int64]]) -> Array:
        variance = [np.exp2(2 * signal.physical(raw[signal.name])) for signal in self.signals]
        return np.stack(variance, axis=-1)[:, :, None] * np.eye(4)

    def widest(self) -> dict[str, int]:
        return {signal.name: signal.raw_max for signal in self.signals}


class MeanOnly(CovarianceCode):
    """No covariance at all: what most interfaces send. The line's status is UNKNOWN."""

    name = "MeanOnly"
    about = "the mean, and nothing of its covariance"
    positive_definite = True
    covering = False
    status = Status.UNKNOWN

    def __init__(self, layout: Layout) -> None:
        self.signals = ()

    def encode(self, error: Array, resolution: Array) -> Coded:
        n = len(error)
        return Coded({}, np.zeros(n, dtype=bool), np.ones(n, dtype=bool))

    def decode(self, raw: Mapping[str, NDArray[np.int64]]) -> Array:
        n = len(next(iter(raw.values()))) if raw else 0
        return np.tile(np.diag(np.square(VAGUE_SIGMA)), (n, 1, 1))

    def decode_one(self, raw: Mapping[str, int]) -> Array:
        return np.diag(np.square(VAGUE_SIGMA))

    def widest(self) -> dict[str, int]:
        return {}
