"""Bits of a signal to its raw value and back, and raw values to physical ones and back."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Literal

from ..values.line import Slot
from ..wire.layout.record_layout import RecordLayout
from ..wire.layout.record_signals import Signal, slot_title
from .elementary import exp2
from .matrices import Vector

#: Raw values by the name of the signal.
Raw = Mapping[str, int]
#: Tolerance for the floating-point error of the division before directed rounding [steps].
SLACK = 1e-9


def read(signal: Signal, record: bytes) -> int:
    """Return the raw value of a signal in a record, or in its first pages.

    The start of an Intel signal is its least significant bit, and bits count upwards. The start of
    a Motorola signal is its most significant bit: bytes count upwards, bits in a byte downwards.

    >>> hex(read(Signal("X", 4, 8, False, False, 1, 0, "", 0, 255), bytes([0x12, 0x34])))
    '0x41'
    >>> hex(read(Signal("X", 3, 8, True, False, 1, 0, "", 0, 255), bytes([0x12, 0x34])))
    '0x23'
    """
    raw = int.from_bytes(record, _order(signal)) >> _shift(signal, len(record))
    raw %= 2**signal.length
    return raw - 2**signal.length if signal.signed and 2 * raw >= 2**signal.length else raw


def packed(signals: Iterable[Signal], raw: Raw, length: int) -> bytes:
    """Return the bytes with the raw values of signals; a signal without a value is 0."""
    data = 0
    for signal in signals:
        bits = raw.get(signal.name, 0) % 2**signal.length << _shift(signal, length)
        data |= int.from_bytes(bits.to_bytes(length, _order(signal)), "big")
    return data.to_bytes(length, "big")


def _order(signal: Signal) -> Literal["big", "little"]:
    return "big" if signal.big_endian else "little"


def _shift(signal: Signal, length: int) -> int:
    """Return the number of bits below a signal, if the bytes are one number in its byte order."""
    if not signal.big_endian:
        return signal.start
    first = signal.start // 8 * 8 + 7 - signal.start % 8  # from the most significant bit of all
    return 8 * length - first - signal.length


def value(signal: Signal, raw: float) -> float:
    """Return the physical value of a signal."""
    return raw * signal.factor + signal.offset


def physical(layout: RecordLayout, raw: Raw, *names: str) -> Vector:
    """Return the physical values of signals."""
    return Vector(value(layout[name], raw[name]) for name in names)


def level(signal: Signal, raw: int) -> float:
    """Return 2 to the power of a physical value; 0 for the raw value 0, which means none."""
    return exp2(value(signal, raw)) if raw else 0.0


def of_slot(slot: Slot, name: str) -> str:
    """Return the name of a signal that the pose error has for each slot: ``EgoLeftCounter``."""
    return f"{slot_title(slot)}{name}"


# ---- rounding: a raw value may be out of range, or infinite, until it is limited ----------------


def nearest(signal: Signal, x: float) -> float:
    """Return the nearest raw value, halves to even."""
    return whole(round, (x - signal.offset) / signal.factor)


def above(signal: Signal, x: float) -> float:
    """Return the least raw value that is not below a value."""
    raw = whole(math.ceil, (x - signal.offset) / signal.factor - SLACK)
    return raw + 1 if value(signal, raw) < x else raw


def below(signal: Signal, x: float) -> float:
    """Return the greatest raw value that is not above a value."""
    raw = whole(math.floor, (x - signal.offset) / signal.factor + SLACK)
    return raw - 1 if value(signal, raw) > x else raw


def whole(function: Callable[[float], float], x: float) -> float:
    """Return a number rounded by a function; infinite numbers and NaN as they are."""
    return float(function(x)) if math.isfinite(x) else x


def limited(signal: Signal, raw: float) -> int:
    """Return a raw value within the range of its signal."""
    return int(min(max(raw, signal.raw_min), signal.raw_max))


def nearest_limited(signal: Signal, x: float) -> int:
    """Return the nearest raw value within the range of its signal."""
    return limited(signal, nearest(signal, x))
