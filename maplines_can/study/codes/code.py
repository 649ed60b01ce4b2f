"""Interface of the covariance codes for comparison, and functions that they share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...values.line import Status
from ...wire.layout.message_layout import Layout
from ...wire.layout.record_signals import Bounds, Signal

Array = NDArray[np.float64]

#: Tolerance for the floating-point error of the division before directed rounding [steps].
SLACK = 1e-9


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


@dataclass(frozen=True)
class Coded:
    """Covariances as raw values.

    Args:
        raw: (N,) values by signal.
        saturated: (N,) whether a value is at the end of its range.
        covered: (N,) for a covering code, whether the decoded covariance covers the target; for
            another code, whether no value was clipped. If False, the line must not be used.
    """

    raw: dict[str, NDArray[np.int64]]
    saturated: NDArray[np.bool_]
    covered: NDArray[np.bool_]


class CovarianceCode(ABC):
    """Code between covariances and the raw values of a layout's signals.

    Raises:
        LayoutError: a signal is missing, or has an unsuitable factor or range.
    """

    #: Name in the DBC's attribute CovarianceCode.
    name: ClassVar[str]
    #: One line on the signals.
    about: ClassVar[str]
    #: Whether any bits decode to a positive definite covariance.
    positive_definite: ClassVar[bool]
    #: Whether the decoded covariance minus the target is positive semidefinite.
    covering: ClassVar[bool]
    #: Best status that the code supports.
    status: ClassVar[Status] = Status.FULL
    #: Signals that hold the covariance.
    signals: tuple[Signal, ...]

    @abstractmethod
    def __init__(self, layout: Layout) -> None: ...

    @abstractmethod
    def encode(self, error: Array, resolution: Array) -> Coded:
        """Encode covariances.

        Args:
            error: (N, 4, 4) positive semidefinite target that the decoded covariance must cover:
                the covariance plus d d^T, with d the error of the decoded mean.
            resolution: (4,) variances of the mean's rounding error, a floor for singular matrices.
        """

    @abstractmethod
    def decode(self, raw: Mapping[str, NDArray[np.int64]]) -> Array:
        """Return the (N, 4, 4) covariances of (N,) raw values by signal."""

    @abstractmethod
    def widest(self) -> dict[str, int]:
        """Return the raw values of the widest covariance, for a line without a covariance."""


#: Bounds of an entry of a matrix.
ENTRY = Bounds(offset=0)


def check(layout: Layout, signals: Iterable[Signal], bounds: Bounds) -> None:
    """Raise ``LayoutError`` unless the signals are within bounds.

    These are ``ENTRY``, or for exponents of 2 ``OCTAVES``, with which no bits overflow a float.
    """
    for signal in signals:
        bounds.check(signal, layout.source)


def nearest_raw(signal: Signal, physical: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the (N,) nearest raw values within the range, and which were clipped to it."""
    nearest = signal.raw(physical)
    limited = signal.limited(nearest)
    return limited.astype(np.int64), nearest != limited
