"""Records of the pose error and conditional records: raw values to bytes and back."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cantools
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplines_can.values.errors import EncodeError
from maplines_can.values.line import Kind, Slot
from maplines_can.wire import POSE, Layout, Owner, Reason, default_dbc_path
from maplines_can.wire.layout.pose_layout import PoseLayout
from maplines_can.wire.layout.record_layout import RecordLayout
from maplines_can.wire.protection.e2e import record_crc_one
from maplines_can.wire.records.raw_format import RawFormat, absent_counter
from maplines_can.wire.records.record import RawRecord, RecordReader

DBCS = ["maplines.dbc", "maplines-secoc.dbc", "maplines-pose.dbc"]
CONDITIONAL = Layout.from_dbc(default_dbc_path("maplines-pose.dbc"))
LINES = RawFormat.of_lines(CONDITIONAL)


def pose_of(dbc: str) -> PoseLayout:
    """Layout of the pose error in a DBC of the project."""
    pose = Layout.from_dbc(default_dbc_path(dbc)).pose
    assert pose is not None
    return pose


def read(form: RawFormat, payload: bytes, owner: Owner = Slot.CENTRE) -> RawRecord | Reason:
    """What a reader of the format makes of a record."""
    return RecordReader(form).read(payload, owner)


def raws(layout: RecordLayout, *but: str) -> Any:
    """Strategy of raw values of all signals but those that are filled in."""
    service = ("Crc", "Counter", "Page", "TransferId", "HasCovariance", *but)
    return st.fixed_dictionaries(
        {
            name: st.integers(signal.raw_min, signal.raw_max)
            for name, signal in layout.signals.items()
            if not name.startswith(service)
        }
    )


@pytest.mark.parametrize("dbc", DBCS)
def test_pose_records_are_as_cantools_decodes_them(dbc: str) -> None:
    """Every signal, in classic pages and in one frame, and back."""
    layout = pose_of(dbc)
    database: Any = cantools.database.load_file(default_dbc_path(dbc))
    classic, fd = (database.get_message_by_name(name) for name in ("Pose", "PoseFd"))
    records = RawFormat.of_pose(layout)

    @given(raws(layout), st.integers(0, 255))
    def check(raw: dict[str, int], counter: int) -> None:
        record = RawRecord(POSE, counter, raw)
        payload = records.write(record)
        assert read(records, payload, POSE) == record
        assert layout.slot_counters(raw)[Slot.ROUTE] == raw["RouteCounter"]
        pages: dict[str, Any] = {}
        for start in range(0, len(payload), 8):
            pages |= classic.decode(payload[start : start + 8], decode_choices=False, scaling=False)
        padded = payload.ljust(fd.length, b"\0")
        whole = fd.decode(padded, decode_choices=False, scaling=False)
        for signals in (pages, whole):
            assert {name: signals[name] for name in raw} == raw
            assert signals["Counter"] == counter
            assert signals["PoseTransferId1"] == counter % 4

    check()


SHORT = {
    "Kind": 1,
    "Quartic": -2,
    "XMin": 12,
    "XMax": 60,
    "YOff": 900,
    "Beta": -3,
    "C0": 7,
    "C1": -9,
}
LEVELS = {"OwnLateral": 50, "OwnPoints": 20, "OwnShape": 3}
WIDE = {
    name: s.raw_max
    for name, s in CONDITIONAL.signals.items()
    if name.startswith(("Pivot", "Ratio", "Inflation"))
}
FINE = {"YOffFine": -4, "BetaFine": 3, "C0Fine": 1, "C1Fine": -8}
LONG = SHORT | dict.fromkeys(LEVELS, 0) | WIDE | FINE | {"Inflation": 2}


@given(raws(CONDITIONAL), st.booleans(), st.integers(0, 255), st.sampled_from(Slot))
def test_a_conditional_record_has_two_or_four_pages(
    raw: dict[str, int], has_covariance: bool, counter: int, slot: Slot
) -> None:
    """It comes back as it was, and its bytes are those of a shorter or a longer record."""
    if has_covariance:
        raw |= dict.fromkeys(("OwnLateral", "OwnPoints", "OwnShape"), 0)
    else:
        raw = {name: value for name, value in raw.items() if name not in WIDE | FINE}
    record = RawRecord(slot, counter, raw)
    if raw["XMin"] - 32 >= raw["XMax"]:
        with pytest.raises(EncodeError, match="XMin must be less than XMax"):
            LINES.write(record)
        return
    payload = LINES.write(record)
    assert len(payload) == (32 if has_covariance else 16)
    assert read(LINES, payload, slot) == record


@pytest.mark.parametrize("raw", [SHORT | LEVELS, LONG])
def test_each_flipped_bit_is_found(raw: dict[str, int]) -> None:
    """By the checksum, the page numbers, the transfer ID, or the length."""
    payload = LINES.write(RawRecord(Slot.CENTRE, 77, raw))
    for bit in range(8 * len(payload)):
        damaged = bytearray(payload)
        damaged[bit // 8] ^= 1 << bit % 8
        assert read(LINES, bytes(damaged)) in (Reason.CRC, Reason.MIXED)
    assert read(LINES, payload, Slot.ROUTE) is Reason.CRC
    assert read(LINES, payload[:-8]) in (Reason.LENGTH, Reason.CRC)
    assert read(LINES, payload + bytes(8)) is Reason.LENGTH


def forged(payload: bytes, bit: int) -> bytes:
    """Return a record with one other bit and the checksum that goes with it."""
    data = bytearray(payload)
    data[bit // 8] ^= 1 << bit % 8
    crc = record_crc_one(bytes(data), CONDITIONAL.messages[Slot.CENTRE].data_id)
    return crc.to_bytes(2, "little") + bytes(data[2:])


@pytest.mark.parametrize("raw", [SHORT | LEVELS, LONG])
def test_the_form_of_a_record_is_as_it_says(raw: dict[str, int]) -> None:
    """A short record that says it has a covariance, and the reverse, are of no sender."""
    payload = LINES.write(RawRecord(Slot.CENTRE, 5, raw))
    assert read(LINES, forged(payload, CONDITIONAL["HasCovariance"].start)) is Reason.LENGTH


@pytest.mark.parametrize("change", [{"OwnPoints": 1}, {"XMin": 63, "XMax": 31}])
def test_values_that_no_sender_may_send_are_rejected(change: dict[str, int]) -> None:
    """A level beside a covariance, an empty range: neither written nor read."""
    raw = LONG | change
    with pytest.raises(EncodeError):
        LINES.write(RawRecord(Slot.CENTRE, 5, raw))
    data_id = CONDITIONAL.messages[Slot.CENTRE].data_id
    payload = LINES.packer.pack_one(raw | {"HasCovariance": 1, "Counter": 5}, data_id)
    assert read(LINES, payload) is Reason.CONTENT


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
    record = RawRecord(Slot.CENTRE, 5, SHORT | LEVELS | change)
    with pytest.raises(EncodeError, match=words):
        LINES.write(record)


def test_a_pose_record_needs_the_counter_of_each_slot() -> None:
    """The message names those that lack."""
    layout = pose_of("maplines-pose.dbc")
    raw = pose_raw(layout)
    del raw["RouteCounter"]
    with pytest.raises(EncodeError, match="RouteCounter differ"):
        RawFormat.of_pose(layout).write(RawRecord(POSE, 0, raw))


def pose_raw(layout: PoseLayout) -> dict[str, int]:
    """Least raw values of the pose error."""
    service = ("Crc", "Counter", "Page", "TransferId")
    return {n: s.raw_min for n, s in layout.signals.items() if not n.startswith(service)}


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


def moved(**changes: dict[str, int]) -> Layout:
    """The conditional layout with some signals changed."""
    signals = {name: replace(CONDITIONAL[name], **change) for name, change in changes.items()}  # type: ignore[arg-type]
    return replace(CONDITIONAL, signals={**CONDITIONAL.signals, **signals})


def test_records_of_one_form_have_a_covariance_or_not() -> None:
    """If a signal of the short record is in the last page, both have all pages."""
    lines = RawFormat.of_lines(moved(HasCovariance={"start": 250}))
    for raw in (SHORT | LEVELS, LONG):
        record = RawRecord(Slot.CENTRE, 5, raw)
        payload = lines.write(record)
        assert len(payload) == 32
        assert read(lines, payload) == record


def test_a_kind_that_has_no_meaning_is_rejected() -> None:
    """A signal of 4 bits holds 8, one more than the last kind; it is neither sent nor read."""
    layout = moved(Kind={"length": 4, "raw_max": 15}, HasCovariance={"start": 250})
    lines, data_id = RawFormat.of_lines(layout), layout.messages[Slot.CENTRE].data_id
    last = RawRecord(Slot.CENTRE, 5, SHORT | LEVELS | {"Kind": max(Kind)})
    assert read(lines, lines.write(last)) == last
    raw = SHORT | LEVELS | {"Kind": max(Kind) + 1}
    with pytest.raises(EncodeError, match="Kind must be at most 7, got 8"):
        lines.write(RawRecord(Slot.CENTRE, 5, raw))
    payload = lines.packer.pack_one(raw | {"HasCovariance": 0, "Counter": 5}, data_id)
    assert read(lines, payload) is Reason.CONTENT


@pytest.mark.parametrize("name", ["Page0", "Page1", "TransferId1", "Page3", "TransferId3"])
def test_pages_of_several_records_are_mixed(name: str) -> None:
    """Also if the checksum over them is correct."""
    payload = LINES.write(RawRecord(Slot.CENTRE, 77, LONG))
    assert read(LINES, forged(payload, CONDITIONAL[name].start)) is Reason.MIXED


def test_a_damaged_record_of_the_pose_error_is_rejected() -> None:
    """By its length or its checksum."""
    layout = pose_of("maplines-pose.dbc")
    records = RawFormat.of_pose(layout)
    payload = records.write(RawRecord(POSE, 0, pose_raw(layout)))
    assert isinstance(read(records, payload, POSE), RawRecord)
    assert read(records, payload[:-1], POSE) is Reason.LENGTH
    assert read(records, payload[:5] + bytes([payload[5] ^ 4]) + payload[6:], POSE) is Reason.CRC


def test_a_pose_record_has_no_counter_of_a_slot_that_the_dbc_lacks() -> None:
    """It is no part of the record."""
    pose = pose_of("maplines-pose.dbc")
    signals = {name: s for name, s in pose.signals.items() if name != "RouteCounter"}
    layout, raw = replace(pose, signals=signals), pose_raw(pose)
    with pytest.raises(EncodeError, match="RouteCounter differ"):
        RawFormat.of_pose(layout).write(RawRecord(POSE, 0, raw))
    del raw["RouteCounter"]
    assert len(RawFormat.of_pose(layout).write(RawRecord(POSE, 0, raw))) == 16
