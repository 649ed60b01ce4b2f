"""Rounding of physical values to raw ones within the range of a signal; the core has its own."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..wire.layout.signals import Signal

Array = NDArray[np.float64]

#: Tolerance for the floating-point error of the division before directed rounding [steps].
SLACK = 1e-9


def raw_nearest(signal: Signal, physical: float) -> int:
    """Return the nearest raw value within the range."""
    return int(signal.limited(signal.raw(physical)))


def raw_above(signal: Signal, physical: float) -> int:
    """Return the raw value of a physical one that is rounded up; the greatest one if beyond it."""
    raw = np.ceil((physical - signal.offset) / signal.factor - SLACK)
    return int(signal.limited(raw + (signal.physical(raw) < physical)))


def raw_below(signal: Signal, physical: float) -> int:
    """Return the raw value of a physical one that is rounded down; the least one if beyond it."""
    raw = np.floor((physical - signal.offset) / signal.factor + SLACK)
    return int(signal.limited(raw - (signal.physical(raw) > physical)))


class Nearest(NamedTuple):
    """Raw values that are nearest to physical ones."""

    raw: Array  #: (..., k) within the range
    physical: Array  #: (..., k) what they mean
    clipped: NDArray[np.bool_]  #: (..., k) where the nearest one is out of range


class SignalRow:
    """Several signals whose values are the last axis of an array."""

    def __init__(self, signals: Iterable[Signal]) -> None:
        self.signals = tuple(signals)
        columns = [(s.factor, s.offset, s.raw_min, s.raw_max) for s in self.signals]
        self.factor, self._offset, self._raw_min, self._raw_max = np.array(columns, float).T

    def nearest(self, physical: Array) -> Nearest:
        """Return the (..., k) nearest raw values within the ranges, and what they mean."""
        raw = np.rint((physical - self._offset) / self.factor)
        limited = raw.clip(self._raw_min, self._raw_max)
        return Nearest(limited, limited * self.factor + self._offset, raw != limited)

    def physical_of(self, raw: Mapping[str, NDArray[np.int64]]) -> Array:
        """Return the (..., k) physical values of raw values by signal."""
        columns = [raw[signal.name] for signal in self.signals]
        return np.stack(columns, axis=-1) * self.factor + self._offset
