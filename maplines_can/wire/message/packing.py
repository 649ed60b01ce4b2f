"""Raw values of many records to bytes and back, for any layout that a DBC can describe."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .signals import Signal

__all__ = ["Packing", "Piece", "pieces_of"]

#: Records worked on at a time: one signal of a block stays in the nearest cache.
BLOCK = 4096


class Piece(NamedTuple):
    """Bits of a signal that lie within one 64-bit word of the record."""

    word: int
    shift: int  #: of the piece within the word
    bits: int
    field_shift: int  #: of the piece within the signal


class Packing:
    """Where signals lie in a record, as shifts and masks of 64-bit words.

    Args:
        signals: in the order in which arrays of values are given and returned.
        record_bytes: length of a record.
    """

    def __init__(self, signals: Sequence[Signal], record_bytes: int) -> None:
        self.signals = tuple(signals)
        self.record_bytes = record_bytes
        self._words = -(-record_bytes // 8)
        self._pieces = [list(pieces_of(signal)) for signal in signals]
        self._orders = sorted({signal.big_endian for signal in signals})
        self._shifts = [
            (
                signal.name,
                signal.big_endian,
                _shift(signal, record_bytes),
                2**signal.length,
                signal.signed,
            )
            for signal in signals
        ]

    def pack(self, raw: Mapping[str, NDArray[np.int64]], n: int) -> NDArray[np.uint8]:
        """(n, record_bytes) records of raw values within their signals' lengths.

        Args:
            raw: (n,) values by name; a signal that is not named is 0.
            n: number of records.
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
                    for word, shift, bits, field_shift in pieces:
                        piece = value >> np.uint64(field_shift) if field_shift else value.copy()
                        piece &= np.uint64(2**bits - 1)
                        piece <<= np.uint64(shift)
                        words[word] |= piece
                block.view(">u8" if big_endian else "<u8")[...] |= words.T
        return out[:, : self.record_bytes]

    def unpack(self, payloads: NDArray[np.uint8]) -> dict[str, NDArray[np.int64]]:
        """(N,) raw values of each signal, by name."""
        n = len(payloads)
        out = {signal.name: np.empty(n, dtype=np.int64) for signal in self.signals}
        for rows, name, raw in self._unpacked(payloads):
            out[name][rows] = raw
        return out

    def pack_one(self, raw: Mapping[str, int]) -> bytes:
        """One record: as ``pack``, without the cost of arrays."""
        words = [0, 0]
        for name, big_endian, shift, span, _ in self._shifts:
            words[big_endian] |= (raw.get(name, 0) & span - 1) << shift
        little = words[0].to_bytes(self.record_bytes, "little")
        if not words[1]:
            return little
        big = words[1].to_bytes(self.record_bytes, "big")
        return bytes(a | b for a, b in zip(little, big, strict=True))

    def unpack_one(self, payload: bytes) -> dict[str, int]:
        """The raw values of one record: as ``unpack``, without the cost of arrays."""
        words = int.from_bytes(payload, "little"), int.from_bytes(payload, "big")
        out = {}
        for name, big_endian, shift, span, signed in self._shifts:
            raw = words[big_endian] >> shift & span - 1
            out[name] = raw - span if signed and 2 * raw >= span else raw
        return out

    def unpack_field(self, payload: bytes, name: str) -> int:
        """The raw value of one signal of one record."""
        (signal,) = (entry for entry in self._shifts if entry[0] == name)
        _, big_endian, shift, span, signed = signal
        raw = int.from_bytes(payload, "big" if big_endian else "little") >> shift & span - 1
        return raw - span if signed and 2 * raw >= span else raw

    def physical(self, payloads: NDArray[np.uint8]) -> dict[str, NDArray[np.float64]]:
        """(N,) physical values of each signal, by name."""
        n = len(payloads)
        law = {signal.name: signal for signal in self.signals}
        out = {signal.name: np.empty(n) for signal in self.signals}
        for rows, name, raw in self._unpacked(payloads):
            value = out[name][rows]
            np.multiply(raw, law[name].factor, out=value)
            if law[name].offset:
                value += law[name].offset
        return out

    def _unpacked(
        self, payloads: NDArray[np.uint8]
    ) -> Iterator[tuple[slice, str, NDArray[np.int64]]]:
        """Raw values, a block and a signal at a time; the array is valid until the next."""
        for start in range(0, len(payloads), BLOCK):
            rows = slice(start, start + BLOCK)
            block = np.ascontiguousarray(payloads[rows])
            if self.record_bytes % 8:
                block = np.pad(block, ((0, 0), (0, -self.record_bytes % 8)))
            words = {
                order: np.ascontiguousarray(block.view(">u8" if order else "<u8").T, np.uint64)
                for order in self._orders
            }
            for signal, pieces in zip(self.signals, self._pieces, strict=True):
                word, shift, bits, field_shift = pieces[0]
                # Up to the top of the word and down again: the sign comes by itself.
                raw = words[signal.big_endian][word] << np.uint64(64 - bits - shift)
                if signal.signed and field_shift + bits == signal.length:
                    raw = raw.view(np.int64)
                raw >>= raw.dtype.type(64 - bits)
                raw = raw.view(np.int64)
                if field_shift:
                    raw <<= field_shift
                for word, shift, bits, field_shift in pieces[1:]:
                    rest = words[signal.big_endian][word] >> np.uint64(shift)
                    rest &= np.uint64(2**bits - 1)
                    raw |= rest.view(np.int64) << field_shift
                yield rows, signal.name, raw


def _shift(signal: Signal, record_bytes: int) -> int:
    """Bits below a signal in the record read as one integer, in the signal's byte order."""
    if not signal.big_endian:
        return signal.start
    first = signal.start // 8 * 8 + 7 - signal.start % 8
    return 8 * record_bytes - first - signal.length


def pieces_of(signal: Signal) -> Iterator[Piece]:
    """The pieces of a signal, the most significant first.

    An Intel signal counts bits upwards from its least significant one. A
    Motorola signal counts bytes upwards but bits downwards from its most
    significant one; in words read big-endian its bits are contiguous too.
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
