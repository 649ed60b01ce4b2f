"""One signal of a record: its bits, and the conversion between raw and physical values."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...values.errors import EncodeError

#: Tolerance for the floating-point error of the division before directed rounding [steps].
SLACK = 1e-9


@dataclass(frozen=True)
class Signal:
    """One signal of a record, with the conversion between raw and physical values.

    Args:
        name: as in the DBC, without the prefix.
        start: first bit within the record, numbered as in the DBC.
        length: number of bits.
        big_endian: Motorola byte order; ``start`` is then the most significant bit.
        signed: two's complement.
        factor: physical = raw * factor + offset.
        offset: see factor.
        unit: of the physical value.
        raw_min: least raw value within the DBC's range.
        raw_max: greatest raw value within the DBC's range; less than ``raw_min`` if there is none.
        is_float: the raw value is the bit pattern of an IEEE 754 number; no signal of the core is.
        prefix: of the name in the DBC, for messages.
    """

    name: str
    start: int
    length: int
    big_endian: bool
    signed: bool
    factor: float
    offset: float
    unit: str
    raw_min: int
    raw_max: int
    is_float: bool = False
    prefix: str = field(default="", compare=False)

    @property
    def dbc_name(self) -> str:
        """Name in the DBC."""
        return f"{self.prefix}{self.name}"

    def raw(self, physical: ArrayLike) -> NDArray[np.float64]:
        """Return the (...,) nearest raw values, which may be out of range.

        Halves are rounded to even, as in cantools.
        """
        return np.rint((np.asarray(physical, dtype=float) - self.offset) / self.factor)

    def raw_one(self, physical: float) -> int:
        """Return one nearest raw value; as ``raw``, without the array overhead."""
        return round((physical - self.offset) / self.factor)

    def physical(self, raw: ArrayLike) -> NDArray[np.float64]:
        """Return the (...,) physical values."""
        return np.asarray(raw, dtype=float) * self.factor + self.offset

    def physical_one(self, raw: int) -> float:
        """Return one physical value; as ``physical``, without the array overhead."""
        return raw * self.factor + self.offset

    def limited(self, raw: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (...,) raw values clipped to the range; the caller reports the clipping."""
        return raw.clip(self.raw_min, self.raw_max)

    def nearest(self, physical: ArrayLike) -> Nearest:
        """Return the (...,) nearest raw values within the range, and what they mean."""
        raw = self.raw(physical)
        limited = self.limited(raw)
        return Nearest(limited, self.physical(limited), raw != limited)

    def nearest_one(self, physical: float) -> NearestOne:
        """Return ``nearest`` of one number, which may be infinite."""
        steps = (physical - self.offset) / self.factor
        if self.raw_min <= steps <= self.raw_max:
            raw, clipped = round(steps), False
        else:
            raw = self.raw_min if steps < self.raw_min else self.raw_max
            clipped = math.isinf(steps) or round(steps) != raw
        return NearestOne(raw, raw * self.factor + self.offset, clipped)

    def limited_one(self, raw: float) -> int:
        """Return ``limited`` of one raw value."""
        return int(min(max(raw, self.raw_min), self.raw_max))

    def raw_above(self, physical: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (...,) raw values of physical values, rounded up."""
        raw = np.ceil((physical - self.offset) / self.factor - SLACK)
        return raw + (self.physical(raw) < physical)

    def raw_below(self, physical: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (...,) raw values of physical values, rounded down."""
        raw = np.floor((physical - self.offset) / self.factor + SLACK)
        return raw - (self.physical(raw) > physical)

    def above_one(self, physical: float) -> tuple[int, bool]:
        """Return ``raw_above`` of one number within the range, and whether that clips it."""
        steps = (physical - self.offset) / self.factor - SLACK
        if not self.raw_min - 2 < steps <= self.raw_max:
            return (self.raw_max if steps > self.raw_max else self.raw_min), True
        raw = math.ceil(steps)
        raw += self.physical_one(raw) < physical
        limited = self.limited_one(raw)
        return limited, raw != limited

    def below_one(self, physical: float) -> tuple[int, bool]:
        """Return ``raw_below`` of one number within the range, and whether that clips it."""
        steps = (physical - self.offset) / self.factor + SLACK
        if not self.raw_min <= steps < self.raw_max + 2:
            return (self.raw_min if steps < self.raw_min else self.raw_max), True
        raw = math.floor(steps)
        raw -= self.physical_one(raw) > physical
        limited = self.limited_one(raw)
        return limited, raw != limited

    def whole(self, values: NDArray[Any], most: int | None = None) -> NDArray[np.int64]:
        """Return the (n,) raw values of numbers, such as those of an enumeration.

        Raises:
            EncodeError: one is not whole, or not in the range or from 0 to ``most``.
        """
        raw = self.raw(values)
        low, high = self.physical_range
        high = high if most is None else min(high, most)
        physical = self.physical(raw)
        bad = (raw != self.limited(raw)) | (physical > high) | (physical != values)
        if bad.any():
            raise EncodeError(
                f"signal {self.name}: {values[bad][0]!r} is not a whole number from {low:g} to "
                f"{high:g}"
            )
        return raw.astype(np.int64)

    @property
    def all_raw(self) -> tuple[int, int]:
        """Least and greatest raw value of any bits, including those outside the DBC's range."""
        return all_raw(self.length, self.signed)

    @property
    def reach(self) -> tuple[float, float]:
        """Least and greatest physical value of any bits."""
        low, high = sorted(self.physical_one(raw) for raw in self.all_raw)
        return low, high

    @property
    def physical_range(self) -> tuple[float, float]:
        """Least and greatest physical value."""
        low, high = sorted((self.physical(self.raw_min), self.physical(self.raw_max)))
        return float(low), float(high)

    def __str__(self) -> str:
        """Return the signal in the notation of a DBC, with its start bit in the record."""
        kind, low, high = f" (float{self.length})", "", ""
        if not self.is_float:
            kind = ""
            ends = (self.raw_min, self.raw_max)
            low, high = (f"{self.physical_one(raw):.12g}" for raw in ends)
        order, sign = int(not self.big_endian), "-" if self.signed else "+"
        return (
            f"{self.start}|{self.length}@{order}{sign} ({self.factor:.12g},{self.offset:.12g}) "
            f'[{low}|{high}] "{self.unit}"{kind}'
        )


class Nearest(NamedTuple):
    """Raw values that are nearest to physical ones."""

    raw: NDArray[np.float64]  #: (...,) within the range
    physical: NDArray[np.float64]  #: (...,) what they mean
    clipped: NDArray[np.bool_]  #: (...,) where the nearest one is out of range


class NearestOne(NamedTuple):
    """Raw value that is nearest to a physical one."""

    raw: int  #: within the range
    physical: float  #: what it means
    clipped: bool  #: whether the nearest one is out of range


class SignalRow:
    """Several signals whose values are the last axis of an array; see ``Signal``."""

    def __init__(self, signals: Iterable[Signal]) -> None:
        self.signals = tuple(signals)
        columns = [(s.factor, s.offset, s.raw_min, s.raw_max) for s in self.signals]
        self.factor, self._offset, self._raw_min, self._raw_max = (
            np.array(columns, float).reshape(-1, 4).T
        )

    def nearest(self, physical: NDArray[np.float64]) -> Nearest:
        """Return the (..., k) nearest raw values within the ranges, and what they mean."""
        raw = np.rint((physical - self._offset) / self.factor)
        limited = raw.clip(self._raw_min, self._raw_max)
        return Nearest(limited, self.physical(limited), raw != limited)

    def physical(self, raw: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (..., k) physical values."""
        return raw * self.factor + self._offset

    def physical_of(self, raw: Mapping[str, NDArray[np.int64]]) -> NDArray[np.float64]:
        """Return the (..., k) physical values of raw values by signal."""
        columns = [raw[signal.name] for signal in self.signals]
        return self.physical(np.stack(columns, axis=-1).astype(float))

    def physical_one(self, raw: Mapping[str, int]) -> list[float]:
        """Return the k physical values of raw values by signal, without the array overhead."""
        return [raw[s.name] * s.factor + s.offset for s in self.signals]


def all_raw(length: int, signed: bool) -> tuple[int, int]:
    """Return the least and the greatest integer of a number of bits."""
    least = -(2 ** (length - 1)) if signed else 0
    return least, least + 2**length - 1


def first_bit(signal: Signal) -> int:
    """Return the first bit of a signal, counted from the lowest of each byte; Motorola: highest."""
    start = signal.start
    return start // 8 * 8 + 7 - start % 8 if signal.big_endian else start


def signal_values(signal: Signal) -> tuple[float, float, int, int, int, int, bool, bool]:
    """Return the members of ``maplines_signal_t``, in order, such as for the core."""
    return (
        signal.factor,
        signal.offset,
        signal.raw_min,
        signal.raw_max,
        first_bit(signal),
        signal.length,
        signal.big_endian,
        signal.signed,
    )
