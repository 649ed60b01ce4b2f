"""Checksum of AUTOSAR E2E profile 5, for one record or many at once."""

from __future__ import annotations

from binascii import crc_hqx

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Bytes of the CRC (little-endian), which the counter follows.
CRC_BYTES = 2


def _table() -> NDArray[np.uint16]:
    crc = np.arange(256, dtype=np.uint16) << 8
    for _ in range(8):
        crc = (crc << 1) ^ (0x1021 * (crc >> 15))
    return crc.astype(np.uint16)


_TABLE = _table()


def crc16(columns: list[NDArray[np.uint8]], n: int) -> NDArray[np.uint16]:
    """Return the (n,) CRC-16/CCITT-FALSE (polynomial 0x1021, initial 0xFFFF) of n byte strings.

    There is one (n,) column for each byte of the strings.

    >>> text = np.frombuffer(b"123456789", dtype=np.uint8)
    >>> hex(crc16(list(text[:, None]), 1)[0])  # the published check value
    '0x29b1'
    """
    crc = np.full(n, 0xFFFF, dtype=np.uint16)
    for column in columns:
        crc = (crc << np.uint16(8)) ^ _TABLE.take((crc >> np.uint16(8)) ^ column)
    return crc


def record_crc(
    payloads: NDArray[np.uint8], data_id: ArrayLike, offset: int = 0
) -> NDArray[np.uint16]:
    """Return the (N,) checksums of records as in AUTOSAR E2E profile 5 (PRS_E2EProtocol).

    The checksum covers the bytes before the header at ``offset``, the bytes after its CRC (so the
    counter too), and the data ID of 16 bits, (N,) or one for all, low byte first.
    """
    n = len(payloads)
    ids = np.broadcast_to(np.asarray(data_id, dtype=np.uint16), n)
    bytes_ = np.ascontiguousarray(payloads.T)
    columns = [*bytes_[:offset], *bytes_[offset + CRC_BYTES :]]
    columns += [(ids & 0xFF).astype(np.uint8), (ids >> 8).astype(np.uint8)]
    return crc16(columns, n)


def record_crc_one(payload: bytes, data_id: int, offset: int = 0) -> int:
    """Return the checksum of one record: as ``record_crc``, without the cost of arrays."""
    crc = crc_hqx(payload[:offset], 0xFFFF)
    crc = crc_hqx(payload[offset + CRC_BYTES :], crc)
    return crc_hqx(data_id.to_bytes(2, "little"), crc)
