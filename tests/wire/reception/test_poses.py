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
from maplines_can.wire.layout.pose_layout import POSE
from maplines_can.wire.layout.signals import FINE_SIGNALS
from maplines_can.wire.reception.poses import PoseReceiver, ReceivedPose
from maplines_can.wire.reception.reassembly import Reassembler, Record
from maplines_can.wire.reception.settings import decoder_settings, pose_settings
from maplines_can.wire.records.frames import FrameWriter
from maplines_can.wire.records.raw_format import RawFormat
from maplines_can.wire.records.record import RawRecord, RecordReader

CYCLE = 50_000_000  # [ns]
LAYOUTS = {
    name: Layout.from_dbc(default_dbc_path(name)) for name in ("maplines.dbc", "maplines-pose.dbc")
}
LAYOUT = LAYOUTS["maplines-pose.dbc"]
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
    verify: Verifier | None = None, layout: Layout = LAYOUT
) -> Reassembler[Slot, RawRecord]:
    """A reassembler of conditional records."""
    timeouts, _, _ = decoder_settings(layout)
    return Reassembler(layout, RecordReader(RECORDS), timeouts, verify)


def receiver(layout: Layout, verifier: Verifier | None = None) -> PoseReceiver:
    """A receiver of the pose error."""
    assert layout.pose is not None
    return PoseReceiver(layout.pose, verifier, *pose_settings(layout.pose), E2EConfig())


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
    state, records = receiver(layout), RawFormat.of_pose(layout.pose)
    writer = FrameWriter(layout, None)
    answers: list[Any] = []
    for i, counter in enumerate([*range(250, 260), 262]):
        frames = writer.write(records.write(pose(layout, counter % 256)), POSE, fd=fd)
        assert len(frames) == (1 if fd else layout.pose.pages)
        assert all(state.knows(frame.can_id) for frame in frames)
        answers += [
            state.feed(f.can_id, f.data, i * CYCLE) for f in frames + frames[-1:] * (i == 5)
        ]
    got = [answer for answer in answers if isinstance(answer, ReceivedPose)]
    assert [p.record for p in got] == [pose(layout, c % 256) for c in [*range(250, 260), 262]]
    assert [p.ahead for p in got] == [1] * 10 + [3]
    assert (state.check.state, state.check.lost) == (E2EState.VALID, 2)
    assert state.counts == {Reason.DUPLICATE: 1}
    assert state.frames == state.record_frames + sum(state.counts.values()) + state.pending


def test_a_damaged_pose_error_is_rejected() -> None:
    """Each flipped bit, and the frames of other messages."""
    layout = LAYOUT
    assert layout.pose is not None
    records = RawFormat.of_pose(layout.pose)
    (frame,) = FrameWriter(layout, None).write(records.write(pose(layout, 3)), POSE, fd=True)
    for bit in range(8 * layout.pose.record_bytes):
        data = bytearray(frame.data)
        data[bit // 8] ^= 1 << bit % 8
        answer = receiver(layout).feed(frame.can_id, bytes(data), 0)
        assert answer in (Reason.CRC, Reason.MIXED)
    state = receiver(layout)
    assert state.feed(0x360, frame.data, 0) is Reason.FOREIGN
    assert state.feed(frame.can_id, frame.data[:15], 0) is Reason.LENGTH


def test_after_a_restart_the_records_follow_a_break() -> None:
    """A receiver must not join lines of before the restart."""
    assert LAYOUT.pose is not None
    state, records = receiver(LAYOUT), RawFormat.of_pose(LAYOUT.pose)
    got: list[Any] = []
    for i, counter in [*enumerate(range(100, 110)), *enumerate(range(5), 30)]:
        (frame,) = FrameWriter(LAYOUT, None).write(
            records.write(pose(LAYOUT, counter)), POSE, fd=True
        )
        got.append(state.feed(frame.can_id, frame.data, i * CYCLE))
    assert [answer.ahead for answer in got] == [1] * 10 + [None] + [1] * 4


@pytest.mark.parametrize("dbc", ["maplines-secoc.dbc", "maplines-pose.dbc"])
def test_pose_errors_and_lines_are_authenticated(dbc: str) -> None:
    """With SecOC; without a key, or with a wrong MAC, nothing is accepted."""
    layout = Layout.from_dbc(default_dbc_path(dbc))
    assert layout.pose is not None
    assert layout.pose.secured is not None
    key = Authenticator(Key(bytes(range(16))), clock=lambda: 1_750_000_000_000_000_000)
    writer, records = FrameWriter(layout, key), RawFormat.of_pose(layout.pose)
    (frame,) = writer.write(records.write(pose(layout, 9)), POSE, fd=True)
    state = receiver(layout, Verifier(key, layout.pose.secured))
    answer = state.feed(frame.can_id, frame.data, 0)
    assert isinstance(answer, ReceivedPose)
    assert answer.record == pose(layout, 9)
    assert state.feed(frame.can_id, frame.data, 0) is Reason.REPLAY
    assert state.feed(frame.can_id, frame.data[:-1] + b"\0", 0) is Reason.MAC
    assert state.feed(frame.can_id, frame.data[:15], 0) is Reason.LENGTH
    assert state.check.statuses == {ProfileStatus.OK: 1}
    assert receiver(layout).feed(frame.can_id, frame.data, 0) is Reason.KEY
    (plain,) = FrameWriter(layout, None).write(records.write(pose(layout, 9)), POSE, fd=True)
    assert state.feed(plain.can_id, plain.data, 0) is Reason.UNAUTHENTICATED
    with pytest.raises(EncodeError, match="classic CAN is not authenticated"):
        writer.write(records.write(pose(layout, 9)), POSE, fd=False)
    if layout.is_conditional:
        assert layout.secured is not None
        for raw in (SHORT, LONG):
            (frame,) = writer.write(RECORDS.write(line(1, raw)), Slot.CENTRE, fd=True)
            got = reassembler(Verifier(key, layout.secured)).feed(frame.can_id, frame.data, 0)
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


def received(state: PoseReceiver, counter: int, t_ns: int) -> ReceivedPose | Reason:
    """Answer to a pose error with this counter."""
    (frame,) = pose_frames(counter % 256, fd=True)
    return state.feed(frame.can_id, frame.data, t_ns)


@pytest.mark.parametrize(
    ("max_delta", "in_sequence"), [(16, 16), (40, 40), (100, 64)], ids=["default", "40", "most"]
)
def test_pose_errors_may_be_lost(max_delta: int, in_sequence: int) -> None:
    """As records of a slot, up to a quarter of the counters; more is a sequence break."""
    assert LAYOUT.pose is not None
    for ahead in (in_sequence, in_sequence + 1):
        state = PoseReceiver(
            LAYOUT.pose, None, *pose_settings(LAYOUT.pose), E2EConfig(max_delta_counter=max_delta)
        )
        received(state, 9, 0)
        answer = received(state, 9 + ahead, ahead * CYCLE)
        assert isinstance(answer, ReceivedPose)
        assert answer.ahead == (ahead if ahead == in_sequence else None)


def test_a_fast_sender_of_pose_errors_may_lose_many() -> None:
    """Its rate is learnt, so that those after 40 lost ones are new: 8 cycles of the DBC."""
    state = receiver(LAYOUT)
    for i in range(40):
        assert isinstance(received(state, i, i * CYCLE // 5), ReceivedPose)
    assert isinstance(received(state, 80, 80 * CYCLE // 5), ReceivedPose)


def test_damaged_pose_errors_are_checks() -> None:
    """A wrong checksum, page or length is an ERROR; a repeated one is REPEATED once."""
    state = receiver(LAYOUT)
    frames = pose_frames(3)
    (whole,) = pose_frames(4, fd=True)
    for frame in frames + frames:
        state.feed(frame.can_id, frame.data, 0)
    assert (state.check.stats().repeated, state.check.stats().errors) == (1, 0)
    damaged = whole._replace(data=bytes([whole.data[0] ^ 1, *whole.data[1:]]))
    wrong_page = frames[0]._replace(data=bytes([*frames[0].data[:7], 0xFF]))
    short = whole._replace(data=whole.data[:15])
    for errors, (frame, reason) in enumerate(
        [(damaged, Reason.CRC), (wrong_page, Reason.PAGE), (short, Reason.LENGTH)], 1
    ):
        assert state.feed(frame.can_id, frame.data, 1) is reason
        assert state.check.stats().errors == errors
    assert state.feed(0x7FF, b"", 1) is Reason.FOREIGN
    assert state.feed(whole.can_id, whole.data, 1, is_extended=True) is Reason.FOREIGN
    assert not state.knows(whole.can_id, is_extended=True)
    assert state.check.stats().errors == 3
    assert (state.frames, state.records, state.record_frames) == (
        2 * len(frames) + 5,
        1,
        len(frames),
    )
    assert sum(state.counts.values()) == len(frames) + 5


def test_a_pose_error_that_is_not_complete_times_out() -> None:
    """Its frames are counted."""
    state = receiver(LAYOUT)
    first, *_ = pose_frames(3)
    assert state.feed(first.can_id, first.data, 0) is Reason.PENDING
    timeout_ns, _ = pose_settings(LAYOUT.pose)  # type: ignore[arg-type]
    state.expire(timeout_ns)
    assert (state.pending, state.counts) == (1, {})
    state.expire(timeout_ns + 1)
    assert (state.pending, state.counts) == (0, {Reason.TIMEOUT: 1})
