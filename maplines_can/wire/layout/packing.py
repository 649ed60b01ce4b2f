"""Raw values of signals as the bits of records, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ...core import ffi, lib
from ...core.memory import pointer, shaped
from .record_signals import PAGE_BYTES
from .signal import Signal, first_bit, place_of


class Packing:
    """Raw values of signals as the bits of records, and back.

    Args:
        signals: of the records.
        record_bytes: length of a record: whole pages.

    Raises:
        ValueError: the length is another one, or a signal is not within a record.
    """

    def __init__(self, signals: Sequence[Signal], record_bytes: int) -> None:
        if record_bytes % PAGE_BYTES:
            raise ValueError(f"record_bytes must be those of whole pages, got {record_bytes}")
        for signal in signals:
            if signal.length > 64 or first_bit(signal) + signal.length > 8 * record_bytes:
                raise ValueError(f"signal {signal.name} is not within {record_bytes} bytes")
        self._names, self._bytes = [signal.name for signal in signals], record_bytes
        self._signals = ffi.new("maplines_signal_t[]", [*map(place_of, signals)])

    def pack(self, raw: Mapping[str, NDArray[np.int64]], n: int) -> NDArray[np.uint8]:
        """Return (n, record_bytes) records of (n,) raw values by name; one without values is 0.

        Of each value only the signal's low bits are written.
        """
        values = np.zeros((len(self._names), n), dtype=np.int64)
        for row, name in zip(values, self._names, strict=True):
            row[:] = raw.get(name, 0)
        records = np.zeros((n, self._bytes), dtype=np.uint8)
        given = len(self._names), self._signals, n, self._bytes
        lib.maplines_pack(*given, pointer(values), pointer(records))
        return records

    def unpack(self, records: NDArray[np.uint8]) -> dict[str, NDArray[np.int64]]:
        """Return the (n,) raw values of each signal, by name, of (n, record_bytes) records."""
        n = len(records)
        values = np.empty((len(self._names), n), dtype=np.int64)
        given = len(self._names), self._signals, n, self._bytes
        lib.maplines_unpack(*given, shaped(records, (n, self._bytes)), pointer(values))
        return dict(zip(self._names, values, strict=True))

    def pack_one(self, raw: Mapping[str, int]) -> bytes:
        """Return one record: see ``pack``."""
        values, record = [int(raw.get(name, 0)) for name in self._names], bytearray(self._bytes)
        given = len(values), self._signals, 1, self._bytes, values
        lib.maplines_pack(*given, ffi.from_buffer("uint8_t[]", record))
        return bytes(record)
