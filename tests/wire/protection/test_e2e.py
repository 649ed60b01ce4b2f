"""AUTOSAR E2E profile 5, compared with the package autosar-e2e."""

from typing import Any

import e2e
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplines_can.wire.protection.e2e import record_crc, record_crc_one


@given(st.binary(min_size=4, max_size=64), st.integers(0, 0xFFFF), st.data())
def test_crc_agrees_with_autosar_e2e(data: bytes, data_id: int, draw: Any) -> None:
    """For any record, data ID and offset of the header."""
    offset = draw.draw(st.integers(0, len(data) - 3))
    protected = bytearray(data)
    e2e.p05.e2e_p05_protect(protected, data_id, offset=offset, increment_counter=False)
    expected = int.from_bytes(protected[offset : offset + 2], "little")

    array = np.frombuffer(data, dtype=np.uint8)[None]
    assert record_crc(array, data_id, offset)[0] == expected
    assert record_crc_one(data, data_id, offset) == expected


def test_published_example_of_a_zero_record() -> None:
    """PRS_E2EProtocol, profile 5: 8 zero bytes, data ID 0x1234, counter 0: bytes 1C CA."""
    zeros = np.zeros((1, 8), dtype=np.uint8)
    assert record_crc(zeros, 0x1234)[0] == 0xCA1C


@pytest.mark.parametrize("bit", range(32 * 8))
def test_every_flipped_bit_is_detected(bit: Any) -> None:
    """Flipping any bit of a 32-byte record makes its checksum wrong."""
    record = np.random.default_rng(1).integers(0, 256, (1, 32), dtype=np.uint8)
    crc = int(record_crc(record, 0x4D40)[0])
    record[0, :2] = crc & 0xFF, crc >> 8
    flipped = record.copy()
    flipped[0, bit // 8] ^= 1 << bit % 8
    stored = int(flipped[0, 0]) | int(flipped[0, 1]) << 8
    assert record_crc(flipped, 0x4D40)[0] != stored


def test_records_of_two_slots_have_different_checksums() -> None:
    """The checksum covers the data ID, so a record of another slot is detected."""
    record = np.zeros((2, 32), dtype=np.uint8)
    a, b = record_crc(record, np.array([0x4D40, 0x4D41]))
    assert a != b


def test_the_header_is_at_the_start_by_default() -> None:
    """Its checksum is not part of what it covers; all other bytes are."""
    record = np.arange(1, 33, dtype=np.uint8)
    wanted = record_crc(record[None], 0x1234, 0)[0]
    for i in range(32):
        changed = record.copy()
        changed[i] ^= 0x55
        crc = record_crc(changed[None], 0x1234)[0]
        assert crc == record_crc_one(changed.tobytes(), 0x1234)
        assert (crc == wanted) == (i < 2)
