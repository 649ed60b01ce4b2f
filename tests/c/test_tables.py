"""Tables of a DBC in C: the same signals, values and checksums as in Python."""

import struct
from copy import copy
from dataclasses import replace
from pathlib import Path

import c_core
import numpy as np
import pytest
from dbcs import edited
from scene_layouts import layout_of

from maplines_can import Slot
from maplines_can.generation.tables import identifier_of, limits_of, tables_of
from maplines_can.study.codes import CODES as STUDY_CODES
from maplines_can.study.dbc.record_spec import dbc_writer_for
from maplines_can.values.errors import LayoutError
from maplines_can.wire.codec import CODES
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

SHIPPED = ("maplines.dbc", "maplines-pose.dbc", "maplines-secoc.dbc")


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


@pytest.mark.parametrize("name", SHIPPED)
def test_raw_and_physical_values_are_those_of_python(name: str) -> None:
    check_signals(layout_of(name))


def test_motorola_signals(tmp_path: Path) -> None:
    """Bits that are numbered from the other end are the same bits in C."""
    path = edited(
        tmp_path,
        (r"SG_ Counter m0 : 16\|8@1\+", "SG_ Counter m0 : 23|8@0+"),
        (r"SG_ Counter : 16\|8@1\+", "SG_ Counter : 23|8@0+"),
        (r"SG_ YOff m0 : 24\|16@1-", "SG_ YOff m0 : 31|16@0-"),
        (r"SG_ YOff : 24\|16@1-", "SG_ YOff : 31|16@0-"),
        (r"SG_ Kind m0 : 59\|3@1\+", "SG_ Kind m0 : 61|3@0+"),
        (r"SG_ Kind : 59\|3@1\+", "SG_ Kind : 61|3@0+"),
    )
    check_signals(Layout.from_dbc(path))


def test_the_tables_do_not_name_the_folder(tmp_path: Path) -> None:
    """Two copies of a DBC have the same tables."""
    texts = []
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        path = edited(tmp_path / folder, ("EgoLeft", "EgoLeft"))
        texts.append(tables_of(Layout.from_dbc(path)))
    assert texts[0] == texts[1]


def test_the_name_of_a_table_is_an_identifier() -> None:
    for dbc in ("my car.dbc", "ü.dbc", "_x.dbc", "", "9", "a-b.c.dbc"):
        name = identifier_of(dbc)
        assert name.isidentifier()
        assert name.isascii()
        assert name[0] != "_"


def test_limits_of_two_dbcs_are_the_larger_ones() -> None:
    layouts = [layout_of(name) for name in SHIPPED[:2]]
    first, second = (limits_of([layout]) for layout in layouts)
    assert limits_of(layouts) == tuple(map(max, first, second))


@pytest.mark.parametrize("code", sorted(STUDY_CODES.keys() - CODES.keys()))
def test_a_covariance_code_of_the_study_is_refused_by_name(code: str) -> None:
    layout = Layout.from_text(dbc_writer_for(code).dbc(), "study.dbc")
    with pytest.raises(LayoutError, match=rf"study.dbc.*'{code}' has no C"):
        tables_of(layout)


@pytest.mark.parametrize(
    ("name", "length", "words"),
    [
        pytest.param("TransferId0", 9, "TransferId0.*at most 8 bits", id="transfer-ids"),
        pytest.param("Counter", 33, "Counter.*at most 32 bits", id="counter"),
        pytest.param("ComponentCount", 7, "ComponentCount.*at most 6 bits", id="components"),
    ],
)
def test_what_is_larger_than_c_can_hold_is_refused_by_name(
    name: str, length: int, words: str
) -> None:
    layout = layout_of("maplines.dbc")
    wide = copy(layout)  # without the checks of the constructor
    vars(wide)["signals"] = {**layout.signals, name: replace(layout[name], length=length)}
    with pytest.raises(LayoutError, match=words):
        tables_of(wide)
