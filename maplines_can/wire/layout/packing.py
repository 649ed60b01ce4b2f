"""Packing of raw values into bytes and back, for any layout that a DBC can describe."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .signals import Signal

#: Records processed at a time, so that one signal of a block stays in the first-level cache.
BLOCK = 4096


class Piece(NamedTuple):
    """Bits of a signal that lie within one 64-bit word of the record."""

    word: int
    shift: int  #: of the piece within the word
    bits: int
    signal_shift: int  #: of the piece within the signal


class Packing:
    """Signals of a record as shifts and masks of 64-bit words."""

    def __init__(self, signals: Sequence[Signal], record_bytes: int) -> None:
        self.signals = tuple(signals)
        self.record_bytes = record_bytes
        self._words = -(-record_bytes // 8)
        self._pieces = [list(pieces_of(signal)) for signal in signals]
        self._orders = sorted({signal.big_endian for signal in signals})
        self._shifts = [
            (s.name, s.big_endian, _shift(s, record_bytes), 2**s.length, s.signed) for s in signals
        ]

    def pack(self, raw: Mapping[str, NDArray[np.int64]], n: int) -> NDArray[np.uint8]:
        """Return (n, record_bytes) records of (n,) raw values by name; one without values is 0.

        Of each value only the signal's low bits are written.
        """
        out = np.zeros((n, 8 * self._words), dtype=np.uint8)
        for start in range(0, n, BLOCK):
            block = out[start : start + BLOCK]
            for big_endian in self._orders:
                words = np.zeros((self._words, len(block)), dtype=np.uint64)
                for signal, pieces in zip(self.signals, self._pieces, strict=True):
                    if signal.big_endian != big_endian or signal.name not in raw:
                        continue
                    value = raw[signal.name][start : start + BLOCK].view(np.uint64)
                    for word, shift, bits, signal_shift in pieces:
                        piece = value >> np.uint64(signal_shift) if signal_shift else value.copy()
                        piece &= np.uint64(2**bits - 1)
                        piece <<= np.uint64(shift)
                        words[word] |= piece
                block.view(">u8" if big_endian else "<u8")[...] |= words.T
        return out[:, : self.record_bytes]

    def unpack(self, payloads: NDArray[np.uint8]) -> dict[str, NDArray[np.int64]]:
        """Return the (N,) raw values of each signal, by name, of (N, record_bytes) records."""
        n = len(payloads)
        out = {signal.name: np.empty(n, dtype=np.int64) for signal in self.signals}
        for start in range(0, n, BLOCK):
            rows = slice(start, start + BLOCK)
            block = np.ascontiguousarray(payloads[rows])
            if self.record_bytes % 8:
                block = np.pad(block, ((0, 0), (0, -self.record_bytes % 8)))
            words = {
                order: np.ascontiguousarray(block.view(">u8" if order else "<u8").T, np.uint64)
                for order in self._orders
            }
            for signal, pieces in zip(self.signals, self._pieces, strict=True):
                word, shift, bits, signal_shift = pieces[0]
                # Shifted to the top of the word and down again, which extends the sign.
                raw = words[signal.big_endian][word] << np.uint64(64 - bits - shift)
                if signal.signed and signal_shift + bits == signal.length:
                    raw = raw.view(np.int64)
                raw >>= raw.dtype.type(64 - bits)
                raw = raw.view(np.int64)
                if signal_shift:
                    raw <<= signal_shift
                for word, shift, bits, signal_shift in pieces[1:]:
                    low = words[signal.big_endian][word] >> np.uint64(shift)
                    low &= np.uint64(2**bits - 1)
                    raw |= low.view(np.int64) << signal_shift
                out[signal.name][rows] = raw
        return out

    def pack_one(self, raw: Mapping[str, int]) -> bytes:
        """Return one record: as ``pack``, without the cost of arrays."""
        words = [0, 0]
        for name, big_endian, shift, span, _ in self._shifts:
            words[big_endian] |= (raw.get(name, 0) & span - 1) << shift
        little = words[0].to_bytes(self.record_bytes, "little")
        if not words[1]:
            return little
        big = words[1].to_bytes(self.record_bytes, "big")
        return bytes(a | b for a, b in zip(little, big, strict=True))

    def unpack_one(self, payload: bytes) -> dict[str, int]:
        """Return the raw values of one record: as ``unpack``, without the cost of arrays."""
        words = int.from_bytes(payload, "little"), int.from_bytes(payload, "big")
        out = {}
        for name, big_endian, shift, span, signed in self._shifts:
            raw = words[big_endian] >> shift & span - 1
            out[name] = raw - span if signed and 2 * raw >= span else raw
        return out


def _shift(signal: Signal, record_bytes: int) -> int:
    """Return the bits below a signal in the record, read as one integer of its byte order."""
    if not signal.big_endian:
        return signal.start
    first = signal.start // 8 * 8 + 7 - signal.start % 8
    return 8 * record_bytes - first - signal.length


def pieces_of(signal: Signal) -> Iterator[Piece]:
    """Yield the pieces of a signal, the most significant first.

    The start of an Intel signal is its least significant bit, and bits count upwards. The start of
    a Motorola signal is its most significant bit; bytes count upwards, but bits downwards within
    a byte. In words that are read big-endian its bits are contiguous too.
    """
    left = signal.length
    if signal.big_endian:
        position = signal.start // 8 * 8 + 7 - signal.start % 8  # from the most significant end
        while left:
            bits = min(left, 64 - position % 64)
            left -= bits
            yield Piece(position // 64, 64 - position % 64 - bits, bits, left)
            position += bits
    else:
        end = signal.start + signal.length
        while left:
            bits = min(left, (end - 1) % 64 + 1)
            left -= bits
            end -= bits
            yield Piece(end // 64, end % 64, bits, left)
