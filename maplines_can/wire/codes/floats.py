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
from ..contract import SignalSpec
from ..layout import STATE_SIGNALS, Layout
from .code import Array, Coded, CovarianceCode
from .linear import PAIRS, UNITS, triangle_name

__all__ = ["Float16Triangle", "Float32Triangle"]


class Float32Triangle(CovarianceCode):
    """Ten numbers of single precision, rounded to the nearest."""

    name = "Float32"
    about = "the upper triangle of the covariance as ten float32"
    positive_definite = False
    covering = False
    _type: ClassVar[Any] = np.float32
    _pattern: ClassVar[Any] = np.uint32
    _is_float: ClassVar[bool] = True

    def __init__(self, layout: Layout) -> None:
        bits = 8 * np.dtype(self._type).itemsize
        self.entries = {pair: layout[self._name(*pair)] for pair in PAIRS}
        self.fields = list(self.entries.values())
        for field in self.fields:
            if field.length != bits or field.signed or field.is_float != self._is_float:
                kind = "a float" if self._is_float else "an unsigned pattern"
                raise LayoutError(
                    f"{layout.source}: signal {field.name} must be {kind} of {bits} bits"
                )

    @classmethod
    def _name(cls, i: int, j: int) -> str:
        return triangle_name(i, j)

    @classmethod
    def signals(cls, finer_bits: int = 0) -> tuple[SignalSpec, ...]:
        if finer_bits:
            raise ValueError(f"finer_bits must be 0 for {cls.name}, got {finer_bits}")
        bits = 8 * np.dtype(cls._type).itemsize
        words = "" if cls._is_float else ", as the bit pattern of IEEE 754 binary16"
        return tuple(
            SignalSpec(
                cls._name(i, j),
                bits,
                1.0,
                " ".join((UNITS[i], UNITS[j])) if cls._is_float else "",
                f"Covariance of {STATE_SIGNALS[i]} and {STATE_SIGNALS[j]} "
                f"[{UNITS[i]} {UNITS[j]}]{words}.",
                f"a float{bits}",
                is_float=cls._is_float,
            )
            for i, j in PAIRS
        )

    def encode(self, error: Array, resolution: Array) -> Coded:
        raw: dict[str, NDArray[np.int64]] = {}
        fits = np.ones(len(error), dtype=bool)
        with np.errstate(over="ignore"):
            target = error + np.diag(resolution)
            for (i, j), field in self.entries.items():
                value = target[:, i, j].astype(self._type)
                fits &= np.isfinite(value)
                raw[field.name] = value.view(self._pattern).astype(np.int64)
        return Coded(raw, ~fits, fits)

    def decode(self, raw: Mapping[str, NDArray[np.int64]]) -> Array:
        cov = np.empty((len(raw[self.fields[0].name]), 4, 4))
        with np.errstate(invalid="ignore"):  # any bits may come, also those of a NaN
            for (i, j), field in self.entries.items():
                value = raw[field.name].astype(self._pattern).view(self._type)
                cov[:, i, j] = cov[:, j, i] = value
        return cov

    def widest(self) -> dict[str, int]:
        largest = np.array(np.finfo(self._type).max, dtype=self._type).view(self._pattern)
        return {field.name: int(largest) if i == j else 0 for (i, j), field in self.entries.items()}


class Float16Triangle(Float32Triangle):
    """Ten numbers of half precision: variances below 6e-8 vanish."""

    name = "Float16"
    about = "the upper triangle of the covariance as ten float16 in SI units"
    _type = np.float16
    _pattern = np.uint16
    _is_float = False

    @classmethod
    def _name(cls, i: int, j: int) -> str:
        return f"{triangle_name(i, j)}Half"
