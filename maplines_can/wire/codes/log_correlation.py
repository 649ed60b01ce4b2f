"""Logarithmic standard deviations and correlations, as ETSI's collective perception message.

ETSI TS 103 324 sends a standard deviation for each state and the lower triangle of the correlation
matrix in steps of 1 %. Nothing keeps the six correlations consistent, so that what is
decoded need not be positive definite.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ..contract import SignalSpec
from ..layout import STATE_SIGNALS, Layout
from .code import Array, Coded, CovarianceCode, check_octaves, nearest_raw
from .linear import UNITS

__all__ = ["LogCorrelation", "sigma_signals"]

#: log2 of the least standard deviation [octave], half a step of the mean as a rule.
LEAST_OCTAVES = (-12.0, -18.0, -24.0, -32.0)


def sigma_signals() -> tuple[SignalSpec, ...]:
    """One logarithmic standard deviation for each state."""
    return tuple(
        SignalSpec(
            f"Sigma{state}",
            8,
            0.0625 if least > -20 else 0.109375,
            "octave",
            f"log2 of the standard deviation of {state} [{unit}].",
            "from the mean's own resolution upwards",
            offset=least,
        )
        for state, unit, least in zip(STATE_SIGNALS, UNITS, LEAST_OCTAVES, strict=True)
    )


class LogCorrelation(CovarianceCode):
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
        self.fields = [*self.sigmas, *self.correlations.values()]
        check_octaves(layout, self.sigmas)

    @classmethod
    def signals(cls, finer_bits: int = 0) -> tuple[SignalSpec, ...]:
        correlations = tuple(
            SignalSpec(
                f"Corr{STATE_SIGNALS[i]}{STATE_SIGNALS[j]}",
                8,
                0.01,
                "",
                f"Correlation of {STATE_SIGNALS[i]} and {STATE_SIGNALS[j]}.",
                "steps of 1 %, as ETSI's CorrelationCellValue",
                signed=True,
            )
            for i in range(4)
            for j in range(i + 1, 4)
        )
        return tuple(spec.finer(finer_bits) for spec in (*sigma_signals(), *correlations))

    def encode(self, error: Array, resolution: Array) -> Coded:
        variance = np.einsum("nii->ni", error) + resolution
        sigma = np.sqrt(variance)
        raw: dict[str, NDArray[np.int64]] = {}
        cut = np.zeros(len(error), dtype=bool)
        for i, field in enumerate(self.sigmas):
            steps = np.ceil((np.log2(sigma[:, i]) - field.offset) / field.factor - 1e-9)
            raw[field.name] = field.limited(steps).astype(np.int64)
            cut |= steps > field.raw_max
        for (i, j), field in self.correlations.items():
            value = error[:, i, j] / (sigma[:, i] * sigma[:, j])
            raw[field.name], _ = nearest_raw(field, value.clip(-1, 1))
        return Coded(raw, cut, ~cut)

    def decode(self, raw: Mapping[str, NDArray[np.int64]]) -> Array:
        sigma = np.stack([np.exp2(field.physical(raw[field.name])) for field in self.sigmas], -1)
        cov = np.empty((len(sigma), 4, 4))
        for i in range(4):
            cov[:, i, i] = sigma[:, i] ** 2
        for (i, j), field in self.correlations.items():
            value = field.physical(raw[field.name]) * sigma[:, i] * sigma[:, j]
            cov[:, i, j] = cov[:, j, i] = value
        return cov

    def widest(self) -> dict[str, int]:
        return super().widest() | {field.name: field.raw_max for field in self.sigmas}
