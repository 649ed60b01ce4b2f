"""One signal of a record: its bits, and the conversion between raw and physical values."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...values.errors import EncodeError


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

    def physical(self, raw: ArrayLike) -> NDArray[np.float64]:
        """Return the (...,) physical values."""
        return np.asarray(raw, dtype=float) * self.factor + self.offset

    def physical_one(self, raw: int) -> float:
        """Return one physical value; as ``physical``, without the array overhead."""
        return raw * self.factor + self.offset

    def limited(self, raw: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (...,) raw values clipped to the range; the caller reports the clipping."""
        return raw.clip(self.raw_min, self.raw_max)

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


def all_raw(length: int, signed: bool) -> tuple[int, int]:
    """Return the least and the greatest integer of a number of bits."""
    least = -(2 ** (length - 1)) if signed else 0
    return least, least + 2**length - 1


def first_bit(signal: Signal) -> int:
    """Return the first bit of a signal, counted from the lowest of each byte; Motorola: highest."""
    start = signal.start
    return start // 8 * 8 + 7 - start % 8 if signal.big_endian else start


def place_of(signal: Signal) -> dict[str, int]:
    """Return the members of ``maplines_signal_t``, in order, but for its scale, which is first."""
    return {
        "first": first_bit(signal),
        "length": signal.length,
        "is_motorola": signal.big_endian,
        "is_signed": signal.signed,
    }
