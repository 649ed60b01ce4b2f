"""Records of the pose error and conditional records: raw values to bytes and back."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cantools
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplines_can.values.errors import EncodeError
from maplines_can.values.line import Kind, Slot
from maplines_can.wire import Layout, Reason, default_dbc_path
from maplines_can.wire.layout.pose_layout import PoseLayout
from maplines_can.wire.layout.record_layout import RecordLayout
from maplines_can.wire.protection.e2e import record_crc_one
from maplines_can.wire.records.pose_records import (
    ConditionalRecord,
    ConditionalRecords,
    PoseRecord,
    PoseRecords,
    absent_counter,
)
from maplines_can.wire.records.raw_records import RawRecords

DBCS = ["maplines.dbc", "maplines-secoc.dbc", "maplines-pose.dbc"]
CONDITIONAL = Layout.from_dbc(default_dbc_path("maplines-pose.dbc"))
LINES = ConditionalRecords(CONDITIONAL)


def pose_of(dbc: str) -> PoseLayout:
    """Layout of the pose error in a DBC of the project."""
    pose = Layout.from_dbc(default_dbc_path(dbc)).pose
    assert pose is not None
    return pose


def raws(layout: RecordLayout, *but: str) -> Any:
    """Strategy of raw values of all signals but those that are filled in."""
    service = ("Crc", "Counter", "Page", "TransferId", "Kind", "HasCovariance", *but)
    return st.fixed_dictionaries(
        {
            name: st.integers(signal.raw_min, signal.raw_max)
            for name, signal in layout.signals.items()
            if not name.startswith(service) and not name.endswith("Counter")
        }
    )


@pytest.mark.parametrize("dbc", DBCS)
def test_pose_records_are_as_cantools_decodes_them(dbc: str) -> None:
    """Every signal, in classic pages and in one frame, and back."""
    layout = pose_of(dbc)
    database: Any = cantools.database.load_file(default_dbc_path(dbc))
    classic, fd = (database.get_message_by_name(name) for name in ("Pose", "PoseFd"))
    records = PoseRecords(layout)
    counters = st.integers(0, 255)

    @given(raws(layout), counters, st.lists(counters, min_size=8, max_size=8))
    def check(raw: dict[str, int], counter: int, of_slots: list[int]) -> None:
        record = PoseRecord(raw, counter, dict(zip(Slot, of_slots, strict=True)))
        payload = records.write(record)
        low = {slot: value % 8 for slot, value in record.slot_counters.items()}
        assert records.read(payload) == replace(record, slot_counters=low)
        pages: dict[str, Any] = {}
        for start in range(0, len(payload), 8):
            pages |= classic.decode(payload[start : start + 8], decode_choices=False, scaling=False)
        padded = payload.ljust(fd.length, b"\0")
        whole = fd.decode(padded, decode_choices=False, scaling=False)
        for signals in (pages, whole):
            assert {name: signals[name] for name in raw} == raw
            assert signals["Counter"] == counter
            assert signals["RouteCounter"] == low[Slot.ROUTE]
            assert signals["TransferId1"] == counter % 4

    check()


SHORT = {"Quartic": -2, "XMin": 12, "XMax": 60, "YOff": 900, "Beta": -3, "C0": 7, "C1": -9}
LEVELS = {"OwnLateral": 50, "OwnPoints": 20, "OwnShape": 3}
WIDE = {
    name: s.raw_max
    for name, s in CONDITIONAL.signals.items()
    if name.startswith(("Pivot", "Ratio", "Inflation"))
}
FINE = {"YOffFine": -4, "BetaFine": 3, "C0Fine": 1, "C1Fine": -8}
LONG = SHORT | dict.fromkeys(LEVELS, 0) | WIDE | FINE | {"Inflation": 2}


@given(
    raws(CONDITIONAL), st.booleans(), st.integers(0, 255), st.sampled_from(Kind),
    st.sampled_from(Slot),
)  # fmt: skip
def test_a_conditional_record_has_two_or_four_pages(
    raw: dict[str, int], has_covariance: bool, counter: int, kind: Kind, slot: Slot
) -> None:
    """It comes back as it was, and its bytes are those of a shorter or a longer record."""
    if has_covariance:
        raw |= dict.fromkeys(("OwnLateral", "OwnPoints", "OwnShape"), 0)
    else:
        raw = {name: value for name, value in raw.items() if name not in WIDE | FINE}
    record = ConditionalRecord(raw, counter, kind, slot)
    if raw["XMin"] - 32 >= raw["XMax"]:
        with pytest.raises(EncodeError, match="XMin must be less than XMax"):
            LINES.write(record)
        return
    payload = LINES.write(record)
    assert len(payload) == (32 if has_covariance else 16)
    assert LINES.read(payload, slot) == record


@pytest.mark.parametrize("raw", [SHORT | LEVELS, LONG])
def test_each_flipped_bit_is_found(raw: dict[str, int]) -> None:
    """By the checksum, the page numbers, the transfer ID, or the length."""
    payload = LINES.write(ConditionalRecord(raw, 77, Kind.SOLID, Slot.CENTRE))
    for bit in range(8 * len(payload)):
        damaged = bytearray(payload)
        damaged[bit // 8] ^= 1 << bit % 8
        assert LINES.read(bytes(damaged), Slot.CENTRE) in (Reason.CRC, Reason.MIXED)
    assert LINES.read(payload, Slot.ROUTE) is Reason.CRC
    assert LINES.read(payload[:-8], Slot.CENTRE) in (Reason.LENGTH, Reason.CRC)
    assert LINES.read(payload + bytes(8), Slot.CENTRE) is Reason.LENGTH


def test_the_form_of_a_record_is_as_it_says() -> None:
    """A short record with a checksum over four pages, and the reverse, are of no sender."""
    data_id = CONDITIONAL.messages[Slot.CENTRE].data_id
    for pages, flag in ((4, 0), (2, 1)):
        raw = LONG | {"HasCovariance": flag}
        payload = RawRecords(CONDITIONAL, pages).pack_one(raw, 5, data_id)
        assert LINES.read(payload, Slot.CENTRE) is Reason.LENGTH


@pytest.mark.parametrize("change", [{"OwnPoints": 1}, {"XMin": 63, "XMax": 31}])
def test_values_that_no_sender_may_send_are_rejected(change: dict[str, int]) -> None:
    """A level beside a covariance, an empty range: neither written nor read."""
    raw = LONG | change
    with pytest.raises(EncodeError):
        LINES.write(ConditionalRecord(raw, 5, Kind.SOLID, Slot.CENTRE))
    data_id = CONDITIONAL.messages[Slot.CENTRE].data_id
    payload = RawRecords(CONDITIONAL).pack_one(raw | {"HasCovariance": 1}, 5, data_id)
    assert LINES.read(payload, Slot.CENTRE) is Reason.CONTENT


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"YOff": 2**12}, "signal YOff: the raw value 4096 is not from -4096 to 4095"),
        ({"OwnLateral": -1}, "signal OwnLateral"),
        ({"Status": 1}, "Status differ"),
        ({"PivotC0": 1}, "PivotBeta, PivotC1"),
    ],
)
def test_a_value_that_does_not_fit_raises(change: dict[str, int], words: str) -> None:
    """Nothing is clipped."""
    record = ConditionalRecord(SHORT | LEVELS | change, 5, Kind.SOLID, Slot.CENTRE)
    with pytest.raises(EncodeError, match=words):
        LINES.write(record)


def test_a_pose_record_needs_the_counter_of_each_slot() -> None:
    """The message names those of the DBC, and those that were given."""
    layout = pose_of("maplines-pose.dbc")
    raw = {name: layout[name].raw_min for name in raws_names(layout)}
    with pytest.raises(EncodeError, match=r"slot_counters must be of EGO_LEFT, .* got ROUTE"):
        PoseRecords(layout).write(PoseRecord(raw, 0, {Slot.ROUTE: 1}))


def raws_names(layout: PoseLayout) -> list[str]:
    """Signals of the pose error that are not filled in."""
    service = ("Crc", "Counter", "Page", "TransferId")
    names = [name for name in layout.signals if not name.startswith(service)]
    return [name for name in names if not name.endswith("Counter")]


@pytest.mark.parametrize(("bits", "near"), [(3, 3), (4, 7), (8, 127)])
def test_an_absent_slot_has_a_counter_that_no_near_record_has(bits: int, near: int) -> None:
    """Neither the last records nor the next ones, to half a round; also around a mixture."""
    for last in range(0, 300, 7):
        for components in (0, *range(2, 9)):
            following = last + 1 + components
            stated = absent_counter(last, following, bits)
            others = {last - i for i in range(near)} | {following + i for i in range(near)}
            assert stated not in {counter % 2**bits for counter in others}
    assert absent_counter(9, 10, bits) == (10 + 2 ** (bits - 1)) % 2**bits


@pytest.mark.parametrize("pages", [2, 4])
def test_many_records_at_once_are_as_one_by_one(pages: int) -> None:
    """Bytes, raw values and checksums."""
    rng = np.random.default_rng(0)
    records = RawRecords(CONDITIONAL, pages)
    filled = ("Crc", "Counter", "Page", "TransferId")
    raw = {
        name: rng.integers(signal.raw_min, signal.raw_max + 1, 50)
        for name, signal in CONDITIONAL.signals.items()
        if not name.startswith(filled)
    }
    counters, data_ids = rng.integers(0, 256, 50), rng.integers(0, 2**16, 50).astype(np.uint16)
    payloads = records.pack(raw, counters, data_ids)
    decoded, valid = records.unpack(payloads, data_ids)
    assert valid.all()
    for i, payload in enumerate(payloads):
        one = {name: int(values[i]) for name, values in raw.items()}
        assert records.pack_one(one, int(counters[i]), int(data_ids[i])) == payload.tobytes()
        values = records.unpack_one(payload.tobytes(), int(data_ids[i]))
        assert values == {name: int(array[i]) for name, array in decoded.items()}
    payloads[:, 3] ^= 1
    assert not records.unpack(payloads, data_ids)[1].any()


def moved(**changes: dict[str, int]) -> Layout:
    """The conditional layout with some signals changed."""
    signals = {name: replace(CONDITIONAL[name], **change) for name, change in changes.items()}  # type: ignore[arg-type]
    return replace(CONDITIONAL, signals={**CONDITIONAL.signals, **signals})


def test_records_of_one_form_have_a_covariance_or_not() -> None:
    """If a signal of the short record is in the last page, both have all pages."""
    lines = ConditionalRecords(moved(HasCovariance={"start": 250}))
    for raw in (SHORT | LEVELS, LONG):
        record = ConditionalRecord(raw, 5, Kind.SOLID, Slot.CENTRE)
        payload = lines.write(record)
        assert len(payload) == 32
        assert lines.read(payload, Slot.CENTRE) == record


def test_a_kind_that_has_no_meaning_is_rejected() -> None:
    """A signal of 4 bits holds 8, one more than the last kind; it is neither sent nor read."""
    layout = moved(Kind={"length": 4, "raw_max": 15}, HasCovariance={"start": 250})
    lines, data_id = ConditionalRecords(layout), layout.messages[Slot.CENTRE].data_id
    last = ConditionalRecord(SHORT | LEVELS, 5, max(Kind), Slot.CENTRE)
    assert lines.read(lines.write(last), Slot.CENTRE) == last
    raw = SHORT | LEVELS | {"Kind": max(Kind) + 1}
    payload = RawRecords(layout, layout.short_pages).pack_one(raw, 5, data_id)
    assert lines.read(payload, Slot.CENTRE) is Reason.CONTENT


@pytest.mark.parametrize("first", ["YOff", "PivotC1", "RatioBetaYOff"])
def test_the_first_signal_of_a_page_is_in_it(first: str) -> None:
    """Of 2 pages of 4, those signals belong to the record that start in them."""
    records = RawRecords(CONDITIONAL, 2)
    raw = {name: signal.raw_max for name, signal in CONDITIONAL.signals.items()}
    unpacked = records.unpack_one(records.pack_one(raw, 3, 0x4D60), 0x4D60)
    assert isinstance(unpacked, dict)
    assert (first in unpacked) is (CONDITIONAL[first].start < 128)


@pytest.mark.parametrize("name", ["Page0", "Page1", "TransferId1", "Page3", "TransferId3"])
def test_pages_of_several_records_are_mixed(name: str) -> None:
    """Also if the checksum over them is correct, one by one and many at once."""
    data_id = CONDITIONAL.messages[Slot.CENTRE].data_id
    payload = bytearray(LINES.write(ConditionalRecord(LONG, 77, Kind.SOLID, Slot.CENTRE)))
    payload[CONDITIONAL[name].start // 8] ^= 1 << CONDITIONAL[name].start % 8
    payload[:2] = record_crc_one(bytes(payload), data_id).to_bytes(2, "little")
    records = RawRecords(CONDITIONAL)
    assert records.unpack_one(bytes(payload), data_id) is Reason.MIXED
    array = np.frombuffer(bytes(payload), np.uint8)[None]
    assert not records.unpack(array, np.array([data_id], np.uint16))[1].any()


def test_a_damaged_record_of_the_pose_error_is_rejected() -> None:
    """By its length or its checksum."""
    layout = pose_of("maplines-pose.dbc")
    records = PoseRecords(layout)
    raw = {name: layout[name].raw_min for name in raws_names(layout)}
    payload = records.write(PoseRecord(raw, 0, dict.fromkeys(Slot, 1)))
    assert isinstance(records.read(payload), PoseRecord)
    assert records.read(payload[:-1]) is Reason.LENGTH
    assert records.read(payload[:5] + bytes([payload[5] ^ 4]) + payload[6:]) is Reason.CRC


def test_a_pose_record_has_no_counter_of_a_slot_that_the_dbc_lacks() -> None:
    """Neither one more nor none at all."""
    pose = pose_of("maplines-pose.dbc")
    signals = {name: s for name, s in pose.signals.items() if name != "RouteCounter"}
    layout = replace(pose, signals=signals)
    raw = {name: layout[name].raw_min for name in raws_names(layout)}
    for slots, words in ((tuple(Slot), r"got EGO_LEFT, .*, ROUTE$"), ((), "got no slot$")):
        with pytest.raises(EncodeError, match=words):
            PoseRecords(layout).write(PoseRecord(raw, 0, dict.fromkeys(slots, 1)))
