"""Frames of the pose error and of conditional records: all pages of one, and their checks."""

from typing import Any

import pytest
from scene_layouts import layout_of
from support.scene_streams import COMPLETE, CONDITIONAL, PERIOD_NS, SECURED, new_codec, road_scene

from maplines_can.values.errors import EncodeError
from maplines_can.values.line import Slot
from maplines_can.wire import (
    POSE,
    Authenticator,
    Codec,
    E2EState,
    Frame,
    Key,
    ProfileStatus,
    Reason,
)

CYCLE = PERIOD_NS
#: What a decoder answers to the frames of a pose error for which no line waits.
QUIET = (Reason.PENDING, Reason.DUPLICATE)
SLOT = Slot.EGO_LEFT


def sent(dbc: str, counter: int, owner: Any = POSE, *, fd: bool = False) -> list[Frame]:
    """Return the frames of the record of an owner with this counter."""
    counters = dict.fromkeys((POSE, *Slot), counter % 256)
    codec = new_codec(dbc)
    return codec.encoder().encode_scene(road_scene(), counters=counters, fd=fd)[owner]


@pytest.mark.parametrize("fd", [False, True])
@pytest.mark.parametrize("dbc", [COMPLETE, CONDITIONAL])
def test_the_pose_error_is_received(dbc: str, fd: bool) -> None:
    """In classic frames or one CAN FD frame; duplicates and lost records as for a slot."""
    decoder, pose = new_codec(dbc).decoder(), layout_of(dbc).pose
    assert pose is not None
    assert decoder.checks[POSE].counter is None
    check, ahead = decoder.checks[POSE], list[int | None]()
    counters = [*range(250, 260), 262]
    for i, counter in enumerate(counters):
        frames = sent(dbc, counter, fd=fd)
        assert len(frames) == (1 if fd else pose.pages)
        for frame in frames + frames[-1:] * (i == 5):
            assert decoder.feed(frame.can_id, frame.data, i * CYCLE) in QUIET
        ahead.append(check.ahead)
    assert ahead == [1] * 10 + [3]
    assert (check.state, check.lost, check.counter) == (E2EState.VALID, 2, counters[-1] % 256)
    assert decoder.counts == {Reason.DUPLICATE: 1}
    assert decoder.pose_errors == len(counters)
    assert decoder.frames == decoder.pose_frames + 1


def test_a_damaged_pose_error_is_rejected() -> None:
    """Each flipped bit, and a frame that is too short."""
    (frame,) = sent(CONDITIONAL, 3, fd=True)
    pose = layout_of(CONDITIONAL).pose
    assert pose is not None
    state = new_codec(CONDITIONAL).decoder()
    for bit in range(8 * pose.record_bytes):
        data = bytearray(frame.data)
        data[bit // 8] ^= 1 << bit % 8
        assert state.feed(frame.can_id, bytes(data), 0) in (Reason.CRC, Reason.MIXED)
    assert state.feed(frame.can_id, frame.data[:15], 0) is Reason.LENGTH


@pytest.mark.parametrize("dbc", [SECURED, CONDITIONAL])
def test_pose_errors_and_lines_are_authenticated(dbc: str) -> None:
    """With SecOC; without a key, or with a wrong MAC, nothing is accepted."""
    layout = layout_of(dbc)
    key = Authenticator(Key(bytes(range(16))), clock=lambda: 1_750_000_000_000_000_000)
    codec = Codec(layout, key)
    frames = codec.encoder().encode_scene(road_scene([SLOT]), fd=True)
    (frame,), (line,), state = frames[POSE], frames[SLOT], codec.decoder()
    assert state.feed(frame.can_id, frame.data, 0) is Reason.PENDING
    assert state.feed(frame.can_id, frame.data, 0) is Reason.REPLAY
    assert state.feed(frame.can_id, frame.data[:-1] + b"\0", 0) is Reason.MAC
    assert state.feed(frame.can_id, frame.data[:15], 0) is Reason.LENGTH
    assert state.checks[POSE].statuses == {ProfileStatus.OK: 1}
    assert not isinstance(state.feed(line.can_id, line.data, 0), Reason)
    assert Codec(layout).decoder().feed(frame.can_id, frame.data, 0) is Reason.KEY
    (plain,) = sent(dbc, 9, fd=True)
    assert state.feed(plain.can_id, plain.data, 0) is Reason.UNAUTHENTICATED
    with pytest.raises(EncodeError, match="classic CAN is not authenticated"):
        codec.encoder().encode_scene(road_scene())


def test_damaged_pose_errors_are_checks() -> None:
    """A wrong checksum, page or length is an ERROR; a repeated one is REPEATED once."""
    state = new_codec(CONDITIONAL).decoder()
    frames = sent(CONDITIONAL, 3)
    (whole,) = sent(CONDITIONAL, 4, fd=True)
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
