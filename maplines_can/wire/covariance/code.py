"""What every covariance code has: raw values of its own signals, and what it guarantees."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ...errors import LayoutError
from ...line import Status
from ..message.layout import Layout
from ..message.signals import Signal

__all__ = ["Array", "Coded", "CovarianceCode", "check_octaves", "nearest_raw"]

Array = NDArray[np.float64]
#: Farthest power of 2 that a signal may say: its square and products of four stay finite.
FARTHEST_OCTAVE = 200


@dataclass(frozen=True)
class Coded:
    """Covariances as raw values, and what happened to them.

    Args:
        raw: (N,) values by signal.
        saturated: (N,) a value met the end of its range.
        covered: (N,) of a covering code: the decoded covariance covers what was to be sent; of
            another: no value was cut. Where it is False the line must not be used.
    """

    raw: dict[str, NDArray[np.int64]]
    saturated: NDArray[np.bool_]
    covered: NDArray[np.bool_]


class CovarianceCode(ABC):
    """Covariances to raw values of a layout's signals, and back.

    Args:
        layout: whose signals the code uses.

    Raises:
        LayoutError: a signal is missing or does not serve.
    """

    #: As the DBC's attribute CovarianceCode names it.
    name: ClassVar[str]
    #: One line on what is sent.
    about: ClassVar[str]
    #: Whatever the bits, the decoded covariance is positive definite.
    positive_definite: ClassVar[bool]
    #: The decoded covariance less what was to be sent is positive semidefinite.
    covering: ClassVar[bool]
    #: The most that a line can say of its covariance.
    status: ClassVar[Status] = Status.FULL
    #: The signals that hold the covariance.
    signals: tuple[Signal, ...]

    @abstractmethod
    def __init__(self, layout: Layout) -> None: ...

    @abstractmethod
    def encode(self, error: Array, resolution: Array) -> Coded:
        """Code covariances.

        Args:
            error: (N, 4, 4) positive semidefinite: what the decoded covariance is to cover, which
                is the covariance plus d d^T, with d the error of the decoded mean.
            resolution: (4,) variances of the mean's own rounding: a floor for singular matrices.
        """

    @abstractmethod
    def decode(self, raw: Mapping[str, NDArray[np.int64]]) -> Array:
        """(N, 4, 4) covariances as the (N,) raw values of each signal say."""

    @abstractmethod
    def decode_one(self, raw: Mapping[str, int]) -> Array:
        """Return one (4, 4) covariance: as ``decode`` to the last bit."""

    @abstractmethod
    def widest(self) -> dict[str, int]:
        """Return the raw values of the widest covariance: what a line without one carries."""


def nearest_raw(signal: Signal, physical: Array) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """(N,) nearest raw values within the range, and which had to be cut to it."""
    nearest = signal.raw(physical)
    limited = signal.limited(nearest)
    return limited.astype(np.int64), nearest != limited


def check_octaves(layout: Layout, signals: Sequence[Signal]) -> None:
    """Refuse signals that are powers of 2 beyond what floats hold, whatever their bits.

    Raises:
        LayoutError: a factor is not positive, or a signal reaches too far.
    """
    for signal in signals:
        if signal.factor <= 0:
            raise LayoutError(f"{layout.source}: signal {signal.name} needs a positive factor")
        least = -(2 ** (signal.length - 1)) if signal.signed else 0
        ends = signal.physical([least, least + 2**signal.length - 1])
        if not np.abs(ends).max() <= FARTHEST_OCTAVE:
            raise LayoutError(
                f"{layout.source}: signal {signal.name} reaches from 2^{ends[0]:g} to "
                f"2^{ends[1]:g}; it must stay within 2^-{FARTHEST_OCTAVE} and 2^{FARTHEST_OCTAVE}"
            )
