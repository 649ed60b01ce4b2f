"""One signal of a record: which bits, and what they mean."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Signal"]


@dataclass(frozen=True)
class Signal:
    """One signal of a record, with the law between raw and physical values.

    Args:
        name: as in the DBC.
        start: first bit within the record, numbered as the DBC numbers it.
        length: bits; 1 to 64, unsigned 1 to 63.
        big_endian: Motorola order; then ``start`` is the most significant bit.
        signed: two's complement.
        factor: physical = raw factor + offset.
        offset: see factor.
        unit: of the physical value.
        raw_min: least raw value within the DBC's range.
        raw_max: greatest raw value within the DBC's range.
        is_float: the raw value is the pattern of an IEEE 754 number of 32 bits, and only
            ``physical`` knows what it means.
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

    def raw(self, physical: ArrayLike) -> NDArray[np.float64]:
        """(...,) nearest raw values, halves to even as cantools does; not limited to the range."""
        return np.rint((np.asarray(physical, dtype=float) - self.offset) / self.factor)

    def physical(self, raw: ArrayLike) -> NDArray[np.float64]:
        """(...,) physical values."""
        if self.is_float:
            pattern = np.asarray(raw, dtype=np.int64).astype(np.uint32)
            with np.errstate(invalid="ignore"):  # any bits may come, also those of a NaN
                return pattern.view(np.float32).astype(float)
        return np.asarray(raw, dtype=float) * self.factor + self.offset

    def physical_one(self, raw: int) -> float:
        """The same for one value, without the cost of arrays."""
        return raw * self.factor + self.offset

    def limited(self, raw: NDArray[np.float64]) -> NDArray[np.float64]:
        """(...,) raw values brought into the range; the caller counts what was out of it."""
        return raw.clip(self.raw_min, self.raw_max)

    @property
    def physical_range(self) -> tuple[float, float]:
        """Least and greatest physical value."""
        low, high = sorted((self.physical(self.raw_min), self.physical(self.raw_max)))
        return float(low), float(high)
