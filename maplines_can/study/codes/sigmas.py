"""Logarithmic standard deviations, with or without correlations, or the mean only.

ETSI's collective perception message (TS 103 324) sends a standard deviation for each state and the
lower triangle of the correlation matrix in steps of 1 %. The six rounded correlations need not be
consistent, so that the decoded matrix need not be positive definite.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ...values.line import VAGUE_SIGMA, Status
from ...wire.layout.message_layout import Layout
from ...wire.layout.record_signals import OCTAVES, PARAMETER_SIGNALS, Signal
from .code import ENTRY, Array, Coded, CovarianceCode, check, nearest_raw


def _rounded_up(
    signal: Signal, octaves: Array, slack: float
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the smallest (N,) raw values that are no less, and which exceed the range."""
    steps = np.ceil((octaves - signal.offset) / signal.factor + slack)
    return signal.limited(steps).astype(np.int64), steps > signal.raw_max


class LogCorrelation(CovarianceCode):
    """Standard deviations rounded up, correlations rounded to the nearest."""

    name = "LogCorrelation"
    about = "log2 of the standard deviations, rounded up, and correlations in steps of 1 %"
    positive_definite = False
    covering = False

    def __init__(self, layout: Layout) -> None:
        self.sigmas = [layout[f"Sigma{state}"] for state in PARAMETER_SIGNALS]
        self.correlations = {
            (i, j): layout[f"Corr{PARAMETER_SIGNALS[i]}{PARAMETER_SIGNALS[j]}"]
            for i in range(4)
            for j in range(i + 1, 4)
        }
        self.signals = (*self.sigmas, *self.correlations.values())
        check(layout, self.sigmas, OCTAVES)
        check(layout, self.correlations.values(), ENTRY)

    def encode(self, error: Array, resolution: Array) -> Coded:
        sigma = np.sqrt(np.einsum("nii->ni", error) + resolution)
        raw: dict[str, NDArray[np.int64]] = {}
        cut = np.zeros(len(error), dtype=bool)
        for i, signal in enumerate(self.sigmas):
            raw[signal.name], beyond = _rounded_up(signal, np.log2(sigma[:, i]), -1e-9)
            cut |= beyond
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
        zero = {signal.name: 0 for signal in self.signals}
        return zero | {signal.name: signal.raw_max for signal in self.sigmas}


class Sigmas(CovarianceCode):
    """Four logarithmic standard deviations, rounded up.

    They cover the variances. Correlations are neither sent nor covered; the status of the line
    is DIAGONAL.
    """

    name = "Sigmas"
    about = "log2 of the standard deviations, rounded up; no correlations"
    positive_definite = True
    covering = False
    status = Status.DIAGONAL

    def __init__(self, layout: Layout) -> None:
        self.signals = tuple(layout[f"Sigma{state}"] for state in PARAMETER_SIGNALS)
        check(layout, self.signals, OCTAVES)

    def encode(self, error: Array, resolution: Array) -> Coded:
        # A diagonal matrix covers another one if in each row the surplus of its diagonal is at
        # least the sum of the other entries, in any units. In units of the resolution of the mean
        # all entries are of similar size.
        unit = np.sqrt(resolution)
        bound = (np.abs(error / (unit[:, None] * unit))).sum(axis=2) * unit**2
        raw: dict[str, NDArray[np.int64]] = {}
        cut = np.zeros(len(error), dtype=bool)
        for i, signal in enumerate(self.signals):
            octaves = np.log2(np.maximum(bound[:, i], resolution[i])) / 2
            raw[signal.name], beyond = _rounded_up(signal, octaves, 1e-6)
            cut |= beyond
        return Coded(raw, cut, ~cut)

    def decode(self, raw: Mapping[str, NDArray[np.int64]]) -> Array:
        variance = [np.exp2(2 * signal.physical(raw[signal.name])) for signal in self.signals]
        return np.stack(variance, axis=-1)[:, :, None] * np.eye(4)

    def widest(self) -> dict[str, int]:
        return {signal.name: signal.raw_max for signal in self.signals}


class MeanOnly(CovarianceCode):
    """No covariance, as in most interfaces; the status of the line is UNKNOWN."""

    name = "MeanOnly"
    about = "the mean only"
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

    def widest(self) -> dict[str, int]:
        return {}
