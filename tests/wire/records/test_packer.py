"""Packing of records: one by one, and many at once."""

import numpy as np
import pytest
from scene_layouts import COMPLETE, layout_of

from maplines_can.wire.records.packer import FEW, RecordPacker


@pytest.mark.parametrize("n", [1, FEW, FEW + 1, 50])
def test_many_records_at_once_are_as_one_by_one(n: int) -> None:
    """Bytes, raw values and checksums."""
    rng, layout = np.random.default_rng(0), layout_of(COMPLETE)
    packer, filled = RecordPacker(layout), ("Crc", "Page", "TransferId")
    raw = {
        name: rng.integers(signal.raw_min, signal.raw_max + 1, n)
        for name, signal in layout.signals.items()
        if not name.startswith(filled)
    }
    data_ids = rng.integers(0, 2**16, n).astype(np.uint16)
    payloads = packer.pack(raw, data_ids)
    decoded, verdict = packer.unpack(payloads, data_ids)
    assert not verdict.any()
    for i, payload in enumerate(payloads):
        one = {name: int(values[i]) for name, values in raw.items()}
        assert packer.pack_one(one, int(data_ids[i])) == payload.tobytes()
        values = packer.unpack_one(payload.tobytes(), int(data_ids[i]))
        assert values == {name: int(array[i]) for name, array in decoded.items()}
    payloads[:, 3] ^= 1
    assert packer.unpack(payloads, data_ids)[1].all()
