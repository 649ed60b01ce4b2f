"""Signals of a record: their names in the DBC, their bits, and their physical values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...values.line import Slot

#: Bytes of a page, the payload of one classic CAN frame.
PAGE_BYTES = 8
#: Signals that every page repeats: the number of the page, and of the transfer it belongs to.
PAGE, TRANSFER_ID = "Page", "TransferId"
#: Signals of the mean, in the order of the line's parameters.
PARAMETER_SIGNALS = ("YOff", "Beta", "C0", "C1")
#: Signals that every record has in addition to page numbers, mean and covariance.
HEADER_SIGNALS = (
    *("Crc", "Counter", "Status", "Kind", "XMin", "XMax", "Age"),
    *("ComponentIndex", "ComponentCount", "ComponentWeight"),
)
#: Signals that a record has instead, if its covariance is conditional on the pose error.
CONDITIONAL_SIGNALS = (
    *("Crc", "Counter", "Kind", "XMin", "XMax"),
    *("HasCovariance", "OwnLateral", "OwnPoints", "OwnShape", "Quartic"),
)
#: End of the names of the signals that such a record has with a covariance: what is added to each
#: signal of the mean.
FINE = "Fine"
FINE_SIGNALS = tuple(f"{name}{FINE}" for name in PARAMETER_SIGNALS)
#: Signals that every record of the pose error has in addition to page numbers and covariance.
POSE_SIGNALS = ("Crc", "Counter", "Age", "CorrelationTime", "MapOffset", "MapHeading")
#: Rows of the covariance of the pose error.
POSE_ROWS = ("Along", "Across", "Heading")
#: Levels of what a line has of its own: signals of a conditional record.
OWN_SIGNALS = ("OwnLateral", "OwnPoints", "OwnShape")
#: Signals of the pose error, with the name of a slot before them, if its records are complete.
SLOT_SIGNALS = (*OWN_SIGNALS, "Quartic", "FitBehind", "FitAhead")
#: Signals at the end of an authenticated message, in this order, with their largest size [byte].
SECURED_SIGNALS = {"KeyId": 1, "Freshness": 7, "Mac": 8}


@dataclass(frozen=True)
class Signal:
    """One signal of a record, with the conversion between raw and physical values.

    Args:
        name: as in the DBC.
        start: first bit within the record, numbered as in the DBC.
        length: number of bits.
        big_endian: Motorola byte order; ``start`` is then the most significant bit.
        signed: two's complement.
        factor: physical = raw * factor + offset.
        offset: see factor.
        unit: of the physical value.
        raw_min: least raw value within the DBC's range.
        raw_max: greatest raw value within the DBC's range; less than ``raw_min`` if there is none.
        is_float: the raw value is the bit pattern of an IEEE 754 number. Only ``physical``
            supports such a signal, with 32 bits.
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
        """Return the (...,) nearest raw values, which may be out of range.

        Halves are rounded to even, as in cantools.
        """
        return np.rint((np.asarray(physical, dtype=float) - self.offset) / self.factor)

    def physical(self, raw: ArrayLike) -> NDArray[np.float64]:
        """Return the (...,) physical values."""
        if self.is_float:
            pattern = np.asarray(raw, dtype=np.int64).astype(np.uint32)
            with np.errstate(invalid="ignore"):  # the bits may be those of a signalling NaN
                return pattern.view(np.float32).astype(float)
        return np.asarray(raw, dtype=float) * self.factor + self.offset

    def physical_one(self, raw: int) -> float:
        """Return one physical value; as ``physical``, without the array overhead."""
        return raw * self.factor + self.offset

    def limited(self, raw: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (...,) raw values clipped to the range; the caller reports the clipping."""
        return raw.clip(self.raw_min, self.raw_max)

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


def all_raw(length: int, signed: bool) -> tuple[int, int]:
    """Return the least and the greatest integer of a number of bits."""
    least = -(2 ** (length - 1)) if signed else 0
    return least, least + 2**length - 1


def slot_title(slot: Slot) -> str:
    """Return the name of a slot as names of signals and messages have it.

    >>> slot_title(Slot.EGO_LEFT)
    'EgoLeft'
    """
    return "".join(word.capitalize() for word in slot.name.split("_"))
