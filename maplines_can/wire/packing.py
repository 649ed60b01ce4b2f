"""Raw values of many records to bytes and back, for any layout that a DBC can describe."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .field import Field

__all__ = ["Packing", "Piece", "pieces_of"]

#: Records worked on at a time: one field of a block stays in the nearest cache.
BLOCK = 4096


class Piece(NamedTuple):
    """Bits of a field that lie within one 64-bit word of the record."""

    word: int
    shift: int  #: of the piece within the word
    bits: int
    field_shift: int  #: of the piece within the field


class Packing:
    """Where fields lie in a record, as shifts and masks of 64-bit words.

    Args:
        fields: in the order in which arrays of values are given and returned.
        record_bytes: length of a record.
    """

    def __init__(self, fields: Sequence[Field], record_bytes: int) -> None:
        self.fields = tuple(fields)
        self.record_bytes = record_bytes
        self._words = -(-record_bytes // 8)
        self._pieces = [list(pieces_of(field)) for field in fields]
        self._orders = sorted({field.big_endian for field in fields})
        self._shifts = [
            (
                field.name,
                field.big_endian,
                _shift(field, record_bytes),
                2**field.length,
                field.signed,
            )
            for field in fields
        ]

    def pack(self, raw: Mapping[str, NDArray[np.int64]], n: int) -> NDArray[np.uint8]:
        """(n, record_bytes) records of raw values within their fields' lengths.

        Args:
            raw: (n,) values by name; a field that is not named is 0.
            n: number of records.
        """
        out = np.zeros((n, 8 * self._words), dtype=np.uint8)
        for start in range(0, n, BLOCK):
            block = out[start : start + BLOCK]
            for big_endian in self._orders:
                words = np.zeros((self._words, len(block)), dtype=np.uint64)
                for field, pieces in zip(self.fields, self._pieces, strict=True):
                    if field.big_endian != big_endian or field.name not in raw:
                        continue
                    value = raw[field.name][start : start + BLOCK].view(np.uint64)
                    for word, shift, bits, field_shift in pieces:
                        piece = value >> np.uint64(field_shift) if field_shift else value.copy()
                        piece &= np.uint64(2**bits - 1)
                        piece <<= np.uint64(shift)
                        words[word] |= piece
                block.view(">u8" if big_endian else "<u8")[...] |= words.T
        return out[:, : self.record_bytes]

    def unpack(self, payloads: NDArray[np.uint8]) -> dict[str, NDArray[np.int64]]:
        """(N,) raw values of each field, by name."""
        n = len(payloads)
        out = {field.name: np.empty(n, dtype=np.int64) for field in self.fields}
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
        """The raw value of one field of one record."""
        (field,) = (entry for entry in self._shifts if entry[0] == name)
        _, big_endian, shift, span, signed = field
        raw = int.from_bytes(payload, "big" if big_endian else "little") >> shift & span - 1
        return raw - span if signed and 2 * raw >= span else raw

    def physical(self, payloads: NDArray[np.uint8]) -> dict[str, NDArray[np.float64]]:
        """(N,) physical values of each field, by name."""
        n = len(payloads)
        law = {field.name: field for field in self.fields}
        out = {field.name: np.empty(n) for field in self.fields}
        for rows, name, raw in self._unpacked(payloads):
            value = out[name][rows]
            np.multiply(raw, law[name].factor, out=value)
            if law[name].offset:
                value += law[name].offset
        return out

    def _unpacked(
        self, payloads: NDArray[np.uint8]
    ) -> Iterator[tuple[slice, str, NDArray[np.int64]]]:
        """Raw values, a block and a field at a time; the array is valid until the next."""
        for start in range(0, len(payloads), BLOCK):
            rows = slice(start, start + BLOCK)
            block = np.ascontiguousarray(payloads[rows])
            if self.record_bytes % 8:
                block = np.pad(block, ((0, 0), (0, -self.record_bytes % 8)))
            words = {
                order: np.ascontiguousarray(block.view(">u8" if order else "<u8").T, np.uint64)
                for order in self._orders
            }
            for field, pieces in zip(self.fields, self._pieces, strict=True):
                word, shift, bits, field_shift = pieces[0]
                # Up to the top of the word and down again: the sign comes by itself.
                raw = words[field.big_endian][word] << np.uint64(64 - bits - shift)
                if field.signed and field_shift + bits == field.length:
                    raw = raw.view(np.int64)
                raw >>= raw.dtype.type(64 - bits)
                raw = raw.view(np.int64)
                if field_shift:
                    raw <<= field_shift
                for word, shift, bits, field_shift in pieces[1:]:
                    rest = words[field.big_endian][word] >> np.uint64(shift)
                    rest &= np.uint64(2**bits - 1)
                    raw |= rest.view(np.int64) << field_shift
                yield rows, field.name, raw


def _shift(field: Field, record_bytes: int) -> int:
    """Bits below a field in the record read as one integer, in the field's byte order."""
    if not field.big_endian:
        return field.start
    first = field.start // 8 * 8 + 7 - field.start % 8
    return 8 * record_bytes - first - field.length


def pieces_of(field: Field) -> Iterator[Piece]:
    """The pieces of a field, the most significant first.

    An Intel field counts bits upwards from its least significant one. A
    Motorola field counts bytes upwards but bits downwards from its most
    significant one; in words read big-endian its bits are contiguous too.
    """
    left = field.length
    if field.big_endian:
        position = field.start // 8 * 8 + 7 - field.start % 8  # from the most significant end
        while left:
            bits = min(left, 64 - position % 64)
            left -= bits
            yield Piece(position // 64, 64 - position % 64 - bits, bits, left)
            position += bits
    else:
        end = field.start + field.length
        while left:
            bits = min(left, (end - 1) % 64 + 1)
            left -= bits
            end -= bits
            yield Piece(end // 64, end % 64, bits, left)
