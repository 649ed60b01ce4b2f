"""Raw and physical values of signals in C, compared with Python's."""

from __future__ import annotations

import struct

import c_core
import numpy as np

from maplines_can import Slot
from maplines_can.wire.covariance import CholeskyCode
from maplines_can.wire.layout.message_layout import Layout
from maplines_can.wire.layout.packing import Packing
from maplines_can.wire.layout.record_layout import RecordLayout
from maplines_can.wire.layout.signals import (
    FINE_SIGNALS,
    PARAMETER_SIGNALS,
    POSE_ROWS,
    SLOT_SIGNALS,
    Signal,
    slot_title,
)
from maplines_can.wire.protection.e2e import record_crc


def signals_of(layout: RecordLayout) -> list[Signal]:
    """The signals of a record in the order of c/tests/signals_harness.c."""
    is_line = isinstance(layout, Layout)
    code = CholeskyCode(layout, PARAMETER_SIGNALS if is_line else POSE_ROWS)
    # The pivots, ratios and the inflation come last in the code.
    covariance = [signal.name for signal in code.signals]
    if is_line:
        names = [
            "Page0", "TransferId0", "Counter", *PARAMETER_SIGNALS, "Kind", "XMin", "XMax",
            "Status", "Age", "ComponentIndex", "ComponentCount", "ComponentWeight",
            "HasCovariance", *FINE_SIGNALS, *covariance, *SLOT_SIGNALS,
        ]  # fmt: skip
    else:
        names = [
            "Page0", "TransferId0", "Counter", "Age", "CorrelationTime", "MapOffset", "MapHeading",
            *covariance, *(f"{slot_title(slot)}Counter" for slot in Slot),
            *(f"{slot_title(slot)}{name}" for slot in Slot for name in SLOT_SIGNALS),
        ]  # fmt: skip
    return [layout.signals[name] for name in names if name in layout.signals]


def expected(layout: RecordLayout, records: np.ndarray) -> bytes:
    """What the harness writes, from Python's packing."""
    signals = signals_of(layout)
    packing = Packing(signals, layout.record_bytes)
    raw = packing.unpack(records)
    written = packing.pack(raw, len(records))
    crcs = record_crc(records, 0x4D40, layout.crc_offset)
    out = []
    for i, crc in enumerate(crcs):
        for signal in signals:
            value = int(raw[signal.name][i])
            out.append(struct.pack("<qd", value, signal.physical_one(value)))
        out.append(written[i].tobytes() + struct.pack("<H", crc))
    return b"".join(out)


def check_signals(layout: Layout, n: int = 500) -> None:
    """Compare n random records of each kind, and two of equal bits."""
    rng = np.random.default_rng(n)
    program = c_core.harness("signals", layout)
    records: list[tuple[int, RecordLayout]] = [(0, layout)]
    if layout.pose is not None:
        records.append((1, layout.pose))
    for kind, record in records:
        data = rng.integers(0, 256, (n, record.record_bytes), dtype=np.uint8)
        data[0], data[1] = 0, 255
        sent = b"".join(bytes([kind]) + row.tobytes() for row in data)
        assert c_core.run(program, sent) == expected(record, data)
