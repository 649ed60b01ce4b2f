"""A decoder as an object: threads, unusual arguments, memory, and the lines that it returns."""

import gc
import pickle
import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from copy import deepcopy
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from support.scene_streams import COMPLETE, CONDITIONAL, PERIOD_NS, new_codec, road_scene

from maplines_can import MapLine, Slot
from maplines_can.wire import POSE, Decoder, Reason, ReceivedFrame


def scene_frames(dbc: str, cycles: int = 6) -> list[ReceivedFrame]:
    """Return the frames of scenes."""
    encoder, scene = new_codec(dbc).encoder(), road_scene(Slot)
    return [
        ReceivedFrame(frame.can_id, frame.data, PERIOD_NS * cycle + 250_000 * i, frame.is_extended)
        for cycle in range(cycles)
        for i, frame in enumerate(
            frame for own in encoder.encode_scene(scene, age=0.02).values() for frame in own
        )
    ]


def test_an_argument_may_use_the_decoder_itself() -> None:
    """What runs while arguments are read is in the same thread: it is decoded first."""
    decoder: Any = new_codec(COMPLETE).decoder()
    frames = scene_frames(COMPLETE, 1)

    class Time:
        def __index__(self) -> int:
            decoder.feed_all(frames)
            return 0

    decoder.feed(*frames[0][:2], Time())
    assert decoder.frames == 1 + len(frames)


@pytest.mark.parametrize("dbc", [COMPLETE, CONDITIONAL])
def test_lines_and_scenes_are_objects_as_any(dbc: str) -> None:
    """They can be copied, pickled, printed and changed as others; arrays are read-only."""
    decoder = new_codec(dbc).decoder()
    decoder.feed_all(scene_frames(dbc))
    line, scene = decoder.latest(Slot.CENTRE, 0).line, decoder.scene()
    assert isinstance(line, MapLine)
    for one in (line, scene):
        assert repr(pickle.loads(pickle.dumps(one))) == repr(deepcopy(one)) == repr(one)  # noqa: S301
    assert [*vars(line)] == [field.name for field in fields(MapLine)]
    assert replace(line, age=1.0).age == 1.0
    with pytest.raises(AttributeError, match="cannot assign to field"):
        line.age = 2.0  # type: ignore[misc]
    with pytest.raises(ValueError, match="read-only"):
        line.gaussian.cov[0, 0] = 1.0


class Eight:
    """What has a length and bytes, but is no buffer."""

    def __len__(self) -> int:
        return 8

    def __bytes__(self) -> bytes:
        return bytes(8)


KNOWN, WHOLE = 0x340, 0x348
#: Calls with unusual arguments, and what comes of them: a reason, a value, or an error.
CALLS: dict[str, tuple[Callable[[Any], Any], Any]] = {
    "bytearray": (lambda one: one.feed(KNOWN, bytearray(8), 0), Reason.PENDING),
    "memoryview": (lambda one: one.feed(KNOWN, memoryview(bytes(16))[::2], 0), Reason.PENDING),
    "list": (lambda one: one.feed(KNOWN, [0] * 8, 0), Reason.PENDING),
    "array": (
        lambda one: one.feed(np.int64(KNOWN), np.zeros(8, np.uint8), np.int64(5)), Reason.PENDING,
    ),
    "bytes by a method": (lambda one: one.feed(KNOWN, Eight(), 0), Reason.PENDING),
    "text": (lambda one: one.feed(KNOWN, "12345678", 0), TypeError),
    "a number": (lambda one: one.feed(KNOWN, 8, 0), TypeError),
    "none": (lambda one: one.feed(KNOWN, None, 0), TypeError),
    "large bytes": (lambda one: one.feed(KNOWN, [256] * 8, 0), ValueError),
    "a payload longer than any": (lambda one: one.feed(WHOLE, bytes(200), 0), Reason.LENGTH),
    "a page longer than any": (lambda one: one.feed(KNOWN, bytes(300), 0), Reason.LENGTH),
    "foreign, whatever it has": (lambda one: one.feed(0x7FF, None, None), Reason.FOREIGN),
    "beyond 32 bits": (lambda one: one.feed(KNOWN + 2**32, bytes(8), 0), Reason.FOREIGN),
    "text for an ID": (lambda one: one.feed("340", bytes(8), 0), Reason.FOREIGN),
    "a float for an ID": (lambda one: one.feed(float(KNOWN), bytes(8), 0), Reason.PENDING),
    "a list for an ID": (lambda one: one.feed([KNOWN], bytes(8), 0), TypeError),
    "one for true": (lambda one: one.feed(KNOWN, bytes(8), 0, is_extended=1), Reason.FOREIGN),
    "numpy's false": (
        lambda one: one.feed(KNOWN, bytes(8), 0, is_extended=np.False_), Reason.PENDING,
    ),
    "none for false": (
        lambda one: one.feed(KNOWN, bytes(8), 0, is_extended=None), Reason.FOREIGN,
    ),
    "keywords": (lambda one: one.feed(t_ns=0, data=bytes(8), can_id=KNOWN), Reason.PENDING),
    "a whole float": (lambda one: one.feed(KNOWN, bytes(8), 5e9), Reason.PENDING),
    "too few": (lambda one: one.feed(KNOWN, bytes(8)), TypeError),
    "too many": (lambda one: one.feed(KNOWN, bytes(8), 0, True), TypeError),
    "latest": (lambda one: one.latest(np.int64(2), np.int64(3)).line, None),
    "latest of no slot": (lambda one: one.latest(88, 0), ValueError),
    "latest of the pose error": (lambda one: one.latest(POSE, 0), ValueError),
    "latest at half a nanosecond": (lambda one: one.latest(0, 0.5), ValueError),
    "latest at no time": (lambda one: one.latest(0, "now"), TypeError),
    "latest, never stale": (lambda one: one.latest(0, 0, stale_cycles=float("inf")).line, None),
    "a scene": (lambda one: one.latest_scene(10**40, stale_cycles=1).scene, None),
    "no scene yet": (
        lambda one: (one.scene(), one.slots(0), one.pose_error(0)), (None, {}, None),
    ),
    "expire": (lambda one: one.expire(-(10**40)), None),
    "a check": (lambda one: one.checks[88], KeyError),
}  # fmt: skip


@pytest.mark.parametrize("call", CALLS)
def test_unusual_arguments(call: str) -> None:
    """What has numbers is taken as such; all else is an error, and changes nothing."""
    decoder, (ask, expected) = new_codec(COMPLETE).decoder(), CALLS[call]
    if isinstance(expected, type):
        with pytest.raises(expected):
            ask(decoder)
        assert (decoder.frames, decoder.pending) == (0, 0)
    else:
        assert ask(decoder) == expected


@pytest.mark.parametrize("dbc", [COMPLETE, CONDITIONAL])
def test_nothing_leaks(dbc: str) -> None:
    """Thousands of frames, scenes and errors leave no object behind."""
    frames = scene_frames(dbc, cycles=16)
    decoder = new_codec(dbc).decoder()

    def repeat(turn: int) -> None:
        for can_id, data, t_ns, is_extended in frames:
            now_ns = t_ns + turn * 16 * PERIOD_NS
            decoder.feed(can_id, data, now_ns, is_extended=is_extended)
        for slot in Slot:
            decoder.latest(slot, now_ns)
        for ask, _ in CALLS.values():
            with suppress(TypeError, ValueError, KeyError):
                ask(decoder)
        assert decoder.latest_scene(now_ns).scene is not None
        gc.collect()

    repeat(0)
    tracemalloc.start()
    try:
        repeat(1)
        before = tracemalloc.get_traced_memory()[0]
        for turn in range(2, 5):
            repeat(turn)
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert grown < 20_000  # of 1700 frames, each of which has a line or a page


def test_a_decoder_is_freed() -> None:
    """Without the collector of cycles: it holds nothing that holds it."""
    gc.disable()
    try:
        before = len([one for one in gc.get_objects() if isinstance(one, Decoder)])
        decoder = new_codec(COMPLETE).decoder()
        assert decoder.checks[Slot.CENTRE].lost == 0
        del decoder
        left = len([one for one in gc.get_objects() if isinstance(one, Decoder)])
    finally:
        gc.enable()
    assert left == before
