"""The upper triangle of the covariance as floating-point numbers, in SI units.

float16 is DroneCAN's convention, float32 MAVLink's. A DBC has no type for float16, so these are
signals of 16 bits that hold the pattern of IEEE 754 binary16; float32 are signals of type float.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ...errors import LayoutError
from ...wire.covariance.code import Array, Coded
from ...wire.message.layout import Layout
from .batch import BatchCode
from .linear import PAIRS, triangle_name

__all__ = ["Float16Triangle", "Float32Triangle", "half_name"]


def half_name(i: int, j: int) -> str:
    """Return the signal of an entry of half precision."""
    return f"{triangle_name(i, j)}Half"


class _FloatTriangle(BatchCode):
    """Ten floating-point numbers, rounded to the nearest."""

    positive_definite = False
    covering = False
    _type: ClassVar[Any]
    _pattern: ClassVar[Any]
    _is_float: ClassVar[bool]

    def __init__(self, layout: Layout) -> None:
        bits = 8 * np.dtype(self._type).itemsize
        name = triangle_name if self._is_float else half_name
        self.entries = {pair: layout[name(*pair)] for pair in PAIRS}
        self.signals = tuple(self.entries.values())
        for signal in self.signals:
            if signal.length != bits or signal.signed or signal.is_float != self._is_float:
                kind = "a float" if self._is_float else "an unsigned pattern"
                raise LayoutError(
                    f"{layout.source}: signal {signal.name} must be {kind} of {bits} bits"
                )

    def encode(self, error: Array, resolution: Array) -> Coded:
        raw: dict[str, NDArray[np.int64]] = {}
        fits = np.ones(len(error), dtype=bool)
        with np.errstate(over="ignore"):
            target = error + np.diag(resolution)
            for (i, j), signal in self.entries.items():
                value = target[:, i, j].astype(self._type)
                fits &= np.isfinite(value)
                raw[signal.name] = value.view(self._pattern).astype(np.int64)
        return Coded(raw, ~fits, fits)

    def decode(self, raw: Mapping[str, NDArray[np.int64]]) -> Array:
        cov = np.empty((len(raw[self.signals[0].name]), 4, 4))
        with np.errstate(invalid="ignore"):  # any bits may come, also those of a NaN
            for (i, j), signal in self.entries.items():
                value = raw[signal.name].astype(self._pattern).view(self._type)
                cov[:, i, j] = cov[:, j, i] = value
        return cov

    def widest(self) -> dict[str, int]:
        largest = np.array(np.finfo(self._type).max, dtype=self._type).view(self._pattern)
        return {
            signal.name: int(largest) if i == j else 0 for (i, j), signal in self.entries.items()
        }


class Float32Triangle(_FloatTriangle):
    """Ten numbers of single precision."""

    name = "Float32"
    about = "the upper triangle of the covariance as ten float32"
    _type = np.float32
    _pattern = np.uint32
    _is_float = True


class Float16Triangle(_FloatTriangle):
    """Ten numbers of half precision: variances below 6e-8 vanish."""

    name = "Float16"
    about = "the upper triangle of the covariance as ten float16 in SI units"
    _type = np.float16
    _pattern = np.uint16
    _is_float = False
