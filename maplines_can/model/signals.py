"""Bits of a signal to its raw value and back, and raw values to physical ones."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Literal

from ..values.line import Slot
from ..wire.layout.signals import Signal, slot_title
from .elementary import exp2

#: Raw values by the name of the signal.
Raw = Mapping[str, int]


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


def physical(signal: Signal, raw: Raw) -> float:
    """Return the physical value of a signal: raw * factor + offset."""
    return raw[signal.name] * signal.factor + signal.offset


def nearest_raw(signal: Signal, value: float) -> int:
    """Return the raw value nearest to a physical one, halves to even; it may be out of range."""
    return round((value - signal.offset) / signal.factor)


def power(signal: Signal, raw: Raw) -> float:
    """Return 2 to the power of a physical value, such as that of ``PivotYOff``."""
    return exp2(physical(signal, raw))


def level(signal: Signal, raw: Raw) -> float:
    """Return the level of a signal such as ``MapOffset``: the raw value 0 means that it is 0."""
    return power(signal, raw) if raw[signal.name] else 0.0


def of_slot(slot: Slot, name: str) -> str:
    """Return the name of a signal that the pose error has for each slot: ``EgoLeftCounter``."""
    return f"{slot_title(slot)}{name}"
