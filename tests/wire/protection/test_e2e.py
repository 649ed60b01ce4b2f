"""AUTOSAR E2E profile 5, compared with the package autosar-e2e."""

from typing import Any

import e2e
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.dbcs import default_codec

from maplines_can import Slot
from maplines_can.model.e2e import checksum
from maplines_can.wire import Reason


@given(st.binary(min_size=4, max_size=64), st.integers(0, 0xFFFF), st.data())
def test_the_model_agrees_with_autosar_e2e(data: bytes, data_id: int, draw: Any) -> None:
    """For any record, data ID and offset of the header."""
    offset = draw.draw(st.integers(0, len(data) - 3))
    protected = bytearray(data)
    e2e.p05.e2e_p05_protect(protected, data_id, offset=offset, increment_counter=False)

    expected = int.from_bytes(protected[offset : offset + 2], "little")
    assert checksum(data, offset, data_id) == expected


def test_published_example_of_a_zero_record() -> None:
    """PRS_E2EProtocol, profile 5: 8 zero bytes, data ID 0x1234, counter 0: bytes 1C CA."""
    assert checksum(bytes(8), 0, 0x1234) == 0xCA1C


@pytest.mark.parametrize("slot", Slot)
def test_records_of_the_core_agree_with_autosar_e2e(slot: Slot) -> None:
    """Their checksum is that of their bytes and of the data ID of their slot."""
    codec = default_codec()
    means = np.random.default_rng(1).normal(0, [2, 0.02, 1e-3, 1e-5], (256, 4))
    covs = np.tile(np.diag([0.1, 0.01, 1e-3, 1e-5]) ** 2, (256, 1, 1))
    records = codec.batch.encode(means, covs, slot=slot)
    for record in records:
        protected = bytearray(record.tobytes())
        data_id, offset = codec.layout.messages[slot].data_id, codec.layout.crc_offset
        e2e.p05.e2e_p05_protect(protected, data_id, offset=offset, increment_counter=False)
        assert protected == record.tobytes()


def test_every_flipped_bit_is_detected() -> None:
    """Flipping any bit of a record makes its checksum, its page or its transfer ID wrong."""
    codec = default_codec()
    record = codec.batch.encode([[1.75, 0.01, 0, 0]], [np.diag([0.1, 0.01, 1e-3, 1e-5]) ** 2])
    assert codec.batch.decode(record).accepted.all()
    flipped = np.packbits(np.unpackbits(record, axis=1) ^ np.eye(256, dtype=np.uint8), axis=1)
    found = codec.batch.decode(flipped)
    assert found.rejects.keys() == {Reason.CRC, Reason.MIXED}
    assert not found.accepted.any()


def test_a_record_of_another_slot_is_detected() -> None:
    """The checksum covers the data ID."""
    codec = default_codec()
    record = codec.batch.encode([[1.75, 0, 0, 0]], slot=Slot.EGO_LEFT)
    assert codec.batch.decode(record, slot=[Slot.EGO_RIGHT]).rejects == {Reason.CRC: 1}
