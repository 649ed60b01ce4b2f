"""Frames of the pose error and of conditional records, and their reassembly."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scene_layouts import pose_record

from maplines_can.values.errors import EncodeError
from maplines_can.values.line import Kind, Slot
from maplines_can.wire import (
    Authenticator,
    Codec,
    Decoder,
    E2EConfig,
    E2EState,
    Frame,
    Key,
    Layout,
    ProfileStatus,
    Reason,
    Verifier,
    default_dbc_path,
)
from maplines_can.wire.layout.pose_layout import POSE, Owner
from maplines_can.wire.layout.signals import FINE_SIGNALS
from maplines_can.wire.reception.reassembly import Reassembler, Record
from maplines_can.wire.reception.settings import decoder_settings
from maplines_can.wire.records.frames import FrameWriter
from maplines_can.wire.records.raw_format import RawFormat
from maplines_can.wire.records.record import RawRecord, RecordReader

CYCLE = 50_000_000  # [ns]
LAYOUTS = {
    name: Layout.from_dbc(default_dbc_path(name)) for name in ("maplines.dbc", "maplines-pose.dbc")
}
LAYOUT = LAYOUTS["maplines-pose.dbc"]
#: What a decoder answers to the frames of a pose error for which no line waits.
QUIET = (Reason.PENDING, Reason.DUPLICATE)
RECORDS = RawFormat.of_lines(LAYOUT)
LEVELS = {"OwnLateral": 50, "OwnPoints": 20, "OwnShape": 3}
SHORT = {"Quartic": -2, "XMin": 12, "XMax": 60, "YOff": 900, "Beta": -3, "C0": 7, "C1": -9} | LEVELS
LONG = SHORT | dict.fromkeys(LEVELS, 0)
LONG |= {
    name: signal.raw_max
    for name, signal in LAYOUT.signals.items()
    if name.startswith(("Pivot", "Ratio", "Inflation")) or name in FINE_SIGNALS
}


def line(counter: int, raw: dict[str, int] = SHORT, slot: Slot = Slot.CENTRE) -> RawRecord:
    """A conditional record."""
    return RawRecord(slot, counter, raw | {"Kind": Kind.SOLID})


def pose(layout: Layout, counter: int) -> RawRecord:
    """A record of the pose error."""
    assert layout.pose is not None
    filled = ("Crc", "Counter", "Page", "TransferId")
    raw = {
        name: signal.raw_max - 1
        for name, signal in layout.pose.signals.items()
        if not name.startswith(filled) and not name.endswith("Counter")
    }
    return pose_record(layout.pose, counter, raw, dict.fromkeys(Slot, counter))


def reassembler(
    layout: Layout = LAYOUT, verifiers: dict[Owner, Verifier] | None = None
) -> Reassembler[RawRecord]:
    """A reassembler of pose errors and conditional records."""
    timeouts_ns = {owner: own.timeout_ns for owner, own in decoder_settings(layout).items()}
    assert layout.pose is not None
    reader = RecordReader(RECORDS, RawFormat.of_pose(layout.pose))
    return Reassembler(layout, reader, timeouts_ns, verifiers)


def receiver(layout: Layout, keys: Authenticator | None = None, **settings: Any) -> Decoder:
    """A decoder of all records."""
    return Codec(layout, keys).decoder(**settings)


def frames_of(record: RawRecord, *, fd: bool = False) -> list[Frame]:
    """Frames of a conditional record."""
    return FrameWriter(LAYOUT, None).write(RECORDS.write(record), record.owner, fd)


@pytest.mark.parametrize(("raw", "frames"), [(SHORT, 2), (LONG, 4)])
def test_a_record_is_complete_with_its_last_page(raw: dict[str, int], frames: int) -> None:
    """In any order of the pages; with HasCovariance 0, the last one is page 1."""
    sent = frames_of(line(5, raw))
    assert len(sent) == frames
    for order in permutations(sent):
        state = reassembler()
        answers = [state.feed(frame.can_id, frame.data, i) for i, frame in enumerate(order)]
        assert answers[:-1] == [Reason.PENDING] * (frames - 1)
        assert isinstance(answers[-1], Record)
        assert answers[-1].content == line(5, raw)
        assert (answers[-1].frames, answers[-1].t_ns, state.pending) == (frames, 0, 0)


@pytest.mark.parametrize("raw", [SHORT, LONG])
def test_one_can_fd_frame_holds_either_form(raw: dict[str, int]) -> None:
    """With padding after the shorter one."""
    (frame,) = frames_of(line(7, raw), fd=True)
    assert len(frame.data) == 32
    answer = reassembler().feed(frame.can_id, frame.data, 0)
    assert isinstance(answer, Record)
    assert answer.content == line(7, raw)


def test_pages_of_another_record_are_counted() -> None:
    """Pages 2 and 3 of a long record that lost its first pages, then a short one of the same ID."""
    state = reassembler()
    for frame in frames_of(line(4, LONG))[2:] + frames_of(line(8))[:1]:
        assert state.feed(frame.can_id, frame.data, 0) is Reason.PENDING
    last = frames_of(line(8))[1]
    answer = state.feed(last.can_id, last.data, 1)
    assert isinstance(answer, Record)
    assert answer.content == line(8)
    assert (state.counts, state.pending) == ({Reason.INCOMPLETE: 2}, 0)


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_each_record_is_one_that_was_sent(data: st.DataObject) -> None:
    """Frames of short and long records are lost, duplicated and swapped; none is mixed."""
    forms = data.draw(st.lists(st.booleans(), min_size=1, max_size=20))
    sent = [line(i, LONG if is_long else SHORT) for i, is_long in enumerate(forms)]
    arrivals = []
    for i, record in enumerate(sent):
        for j, frame in enumerate(frames_of(record)):
            copies = data.draw(st.sampled_from([0, 1, 1, 1, 2]))
            delay = data.draw(st.sampled_from([0.0, 0.0, 0.3, 1.2]))
            arrivals += [(i + 0.1 * j + delay + 0.01 * c, frame) for c in range(copies)]
    state, answered = reassembler(), 0
    arrivals.sort(key=lambda arrival: arrival[0])
    for frames, (t, frame) in enumerate(arrivals, 1):
        answer = state.feed(frame.can_id, frame.data, int(t * CYCLE))
        if isinstance(answer, Record):
            answered += answer.frames
            assert isinstance(answer.content, Reason) or answer.content in sent
        assert frames == answered + sum(state.counts.values()) + state.pending


@pytest.mark.parametrize("fd", [False, True])
@pytest.mark.parametrize("dbc", LAYOUTS)
def test_the_pose_error_is_received(dbc: str, fd: bool) -> None:
    """In classic frames or one CAN FD frame; duplicates and lost records as for a slot."""
    layout = LAYOUTS[dbc]
    assert layout.pose is not None
    state, decoder = reassembler(layout), receiver(layout)
    records, writer, check = (
        RawFormat.of_pose(layout.pose),
        FrameWriter(layout, None),
        decoder.checks[POSE],
    )
    ahead, counters = list[int | None](), [*range(250, 260), 262]
    for i, counter in enumerate(counters):
        sent = pose(layout, counter % 256)
        frames = writer.write(records.write(sent), POSE, fd=fd)
        assert len(frames) == (1 if fd else layout.pose.pages)
        *_, got = (state.feed(f.can_id, f.data, i * CYCLE) for f in frames)
        assert isinstance(got, Record)
        assert (got.owner, got.content) == (POSE, sent)
        for frame in frames + frames[-1:] * (i == 5):
            assert decoder.feed(frame.can_id, frame.data, i * CYCLE) in QUIET
        ahead.append(check.ahead)
    assert ahead == [1] * 10 + [3]
    assert (check.state, check.lost) == (E2EState.VALID, 2)
    assert decoder.counts == {Reason.DUPLICATE: 1}
    assert decoder.pose_errors == len(counters)
    assert decoder.frames == decoder.pose_frames + 1


def test_a_damaged_pose_error_is_rejected() -> None:
    """Each flipped bit, and a frame that is too short."""
    layout = LAYOUT
    assert layout.pose is not None
    records = RawFormat.of_pose(layout.pose)
    (frame,) = FrameWriter(layout, None).write(records.write(pose(layout, 3)), POSE, fd=True)
    state = receiver(layout)
    for bit in range(8 * layout.pose.record_bytes):
        data = bytearray(frame.data)
        data[bit // 8] ^= 1 << bit % 8
        assert state.feed(frame.can_id, bytes(data), 0) in (Reason.CRC, Reason.MIXED)
    assert state.feed(frame.can_id, frame.data[:15], 0) is Reason.LENGTH


def test_after_a_restart_the_records_follow_a_break() -> None:
    """A receiver must not join lines of before the restart."""
    assert LAYOUT.pose is not None
    state, records = receiver(LAYOUT), RawFormat.of_pose(LAYOUT.pose)
    ahead = list[int | None]()
    for i, counter in [*enumerate(range(100, 110)), *enumerate(range(5), 30)]:
        (frame,) = FrameWriter(LAYOUT, None).write(
            records.write(pose(LAYOUT, counter)), POSE, fd=True
        )
        state.feed(frame.can_id, frame.data, i * CYCLE)
        ahead.append(state.checks[POSE].ahead)
    assert ahead == [1] * 10 + [None] + [1] * 4


@pytest.mark.parametrize("dbc", ["maplines-secoc.dbc", "maplines-pose.dbc"])
def test_pose_errors_and_lines_are_authenticated(dbc: str) -> None:
    """With SecOC; without a key, or with a wrong MAC, nothing is accepted."""
    layout = Layout.from_dbc(default_dbc_path(dbc))
    assert layout.pose is not None
    assert layout.pose.secured is not None
    key = Authenticator(Key(bytes(range(16))), clock=lambda: 1_750_000_000_000_000_000)
    writer, records = FrameWriter(layout, key), RawFormat.of_pose(layout.pose)
    (frame,) = writer.write(records.write(pose(layout, 9)), POSE, fd=True)
    verifiers: dict[Owner, Verifier] = {POSE: Verifier(key, layout.pose.secured)}
    got = reassembler(layout, verifiers).feed(frame.can_id, frame.data, 0)
    assert isinstance(got, Record)
    assert got.content == pose(layout, 9)
    state = receiver(layout, key)
    assert state.feed(frame.can_id, frame.data, 0) is Reason.PENDING
    assert state.feed(frame.can_id, frame.data, 0) is Reason.REPLAY
    assert state.feed(frame.can_id, frame.data[:-1] + b"\0", 0) is Reason.MAC
    assert state.feed(frame.can_id, frame.data[:15], 0) is Reason.LENGTH
    assert state.checks[POSE].statuses == {ProfileStatus.OK: 1}
    assert receiver(layout).feed(frame.can_id, frame.data, 0) is Reason.KEY
    (plain,) = FrameWriter(layout, None).write(records.write(pose(layout, 9)), POSE, fd=True)
    assert state.feed(plain.can_id, plain.data, 0) is Reason.UNAUTHENTICATED
    with pytest.raises(EncodeError, match="classic CAN is not authenticated"):
        writer.write(records.write(pose(layout, 9)), POSE, fd=False)
    if layout.is_conditional:
        assert layout.secured is not None
        for raw in (SHORT, LONG):
            (frame,) = writer.write(RECORDS.write(line(1, raw)), Slot.CENTRE, fd=True)
            verifiers = {Slot.CENTRE: Verifier(key, layout.secured)}
            got = reassembler(verifiers=verifiers).feed(frame.can_id, frame.data, 0)
            assert isinstance(got, Record)
            assert got.content == line(1, raw)


def test_a_dbc_without_a_pose_error_cannot_send_one() -> None:
    """The message says so."""
    layout = replace(LAYOUTS["maplines.dbc"], pose=None)
    with pytest.raises(EncodeError, match="has no classic message for the pose error"):
        FrameWriter(layout, None).write(bytes(40), POSE, fd=False)
    assert LAYOUTS["maplines.dbc"].pose is not None
    assert LAYOUTS["maplines.dbc"].pose.message_of_id[0x35C, False] == (POSE, False)


def pose_frames(counter: int, *, fd: bool = False) -> list[Frame]:
    """Frames of a pose error with this counter."""
    assert LAYOUT.pose is not None
    payload = RawFormat.of_pose(LAYOUT.pose).write(pose(LAYOUT, counter))
    return FrameWriter(LAYOUT, None).write(payload, POSE, fd=fd)


def receive(state: Decoder, counter: int, t_ns: int) -> None:
    """Feed a pose error with this counter, which must be new."""
    (frame,) = pose_frames(counter % 256, fd=True)
    before = state.pose_errors
    assert state.feed(frame.can_id, frame.data, t_ns) is Reason.PENDING
    assert state.pose_errors == before + 1


@pytest.mark.parametrize(
    ("max_delta", "in_sequence"), [(16, 16), (40, 40), (100, 64)], ids=["default", "40", "most"]
)
def test_pose_errors_may_be_lost(max_delta: int, in_sequence: int) -> None:
    """As records of a slot, up to a quarter of the counters; more is a sequence break."""
    assert LAYOUT.pose is not None
    for ahead in (in_sequence, in_sequence + 1):
        state = receiver(LAYOUT, e2e=E2EConfig(max_delta_counter=max_delta))
        receive(state, 9, 0)
        receive(state, 9 + ahead, ahead * CYCLE)
        assert state.checks[POSE].ahead == (ahead if ahead == in_sequence else None)


def test_a_fast_sender_of_pose_errors_may_lose_many() -> None:
    """Its rate is learnt, so that those after 40 lost ones are new: 8 cycles of the DBC."""
    state = receiver(LAYOUT)
    for i in range(40):
        receive(state, i, i * CYCLE // 5)
    receive(state, 80, 80 * CYCLE // 5)


def test_damaged_pose_errors_are_checks() -> None:
    """A wrong checksum, page or length is an ERROR; a repeated one is REPEATED once."""
    state = receiver(LAYOUT)
    frames = pose_frames(3)
    (whole,) = pose_frames(4, fd=True)
    for frame in frames + frames:
        state.feed(frame.can_id, frame.data, 0)
    assert (state.checks[POSE].stats().repeated, state.checks[POSE].stats().errors) == (1, 0)
    damaged = whole._replace(data=bytes([whole.data[0] ^ 1, *whole.data[1:]]))
    wrong_page = frames[0]._replace(data=bytes([*frames[0].data[:7], 0xFF]))
    short = whole._replace(data=whole.data[:15])
    for errors, (frame, reason) in enumerate(
        [(damaged, Reason.CRC), (wrong_page, Reason.PAGE), (short, Reason.LENGTH)], 1
    ):
        assert state.feed(frame.can_id, frame.data, 1) is reason
        assert state.checks[POSE].stats().errors == errors
    assert state.feed(0x7FF, b"", 1) is Reason.FOREIGN
    assert state.feed(whole.can_id, whole.data, 1, is_extended=True) is Reason.FOREIGN
    assert state.checks[POSE].stats().errors == 3
    assert (state.frames, state.pose_errors, state.pose_frames) == (
        2 * len(frames) + 5,
        1,
        len(frames),
    )
    assert sum(state.counts.values()) == len(frames) + 5
