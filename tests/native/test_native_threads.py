"""A decoder in C that several threads use at the same time: one waits for another."""

import threading
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scene_streams import COMPLETE, CONDITIONAL, new_codec, road_scene

from maplines_can import Slot, native
from maplines_can.wire import Reason

pytestmark = pytest.mark.skipif(not native.is_active, reason="there is no C path")

THREADS, BLOCKS = 3, 4


def recorded(dbc: str, scenes: int) -> tuple[Any, list[Any]]:
    """Return a decoder, and the arrays of ``feed_arrays`` of so many scenes."""
    codec = new_codec(dbc)
    encoder = codec.encoder()
    prepared = encoder.prepare_scene(road_scene())
    frames = [
        frame
        for _ in range(scenes)
        for own in encoder.encode_scene(prepared).values()
        for frame in own
    ]
    n = len(frames)
    return codec.decoder(), [
        np.array([frame.can_id for frame in frames], np.uint32),
        np.zeros(n, bool),
        np.arange(n) * 10**6,
        np.full(n, 8, np.uint8),
        np.array([list(frame.data) for frame in frames], np.uint8),
        np.arange(n),
        np.zeros(n, np.uint8),
        2,
    ]


@pytest.mark.parametrize("dbc", [COMPLETE, CONDITIONAL])
def test_threads_wait_for_each_other(dbc: str) -> None:
    """No frame and no line is lost, and each line is that of its frame."""
    decoder, arrays = recorded(dbc, 200)
    can_ids, data = arrays[0].tolist(), arrays[4]
    asked: list[Callable[[], Any]] = [
        lambda: decoder.expire(0),
        lambda: decoder.latest(Slot.EGO_LEFT, 0),
        lambda: decoder.latest_scene(0),
        decoder.scene,
        lambda: decoder.slots(0),
        lambda: decoder.pending,
        lambda: decoder.counts,
    ]
    of_id = new_codec(dbc).layout.message_of_id
    done, fed = threading.Event(), Counter[str]()
    failed: list[BaseException] = []

    def watched(work: Callable[[], None]) -> None:
        try:
            work()
        except BaseException as error:  # noqa: BLE001
            failed.append(error)

    def feed_block() -> None:
        for _ in range(BLOCKS):
            lines, *_ = decoder.feed_arrays(*arrays[:6], np.zeros_like(arrays[6]), 2)
            fed["lines of blocks"] += len(lines)

    def feed_frames() -> None:
        for i, can_id in enumerate(can_ids):
            found = decoder.feed(can_id, data[i].tobytes(), i * 10**6)
            if not isinstance(found, Reason):
                fed["lines"] += len(found)
                own = of_id.get((can_id, False))
                assert own is None or [line.slot for line in found] == [own[0]]

    def ask() -> None:
        while not done.is_set():
            for one in asked:
                one()

    feeding = [
        threading.Thread(target=watched, args=(work,))
        for work in (*[feed_block] * THREADS, feed_frames)
    ]
    asking = threading.Thread(target=watched, args=(ask,))
    for thread in (asking, *feeding):
        thread.start()
    for thread in feeding:
        thread.join()
    done.set()
    asking.join()
    assert failed == []
    assert decoder.frames == (THREADS * BLOCKS + 1) * len(can_ids)
    assert decoder.lines == fed["lines"] + fed["lines of blocks"] > 0
    counted = decoder.line_frames + decoder.pose_frames + decoder.counts.total() + decoder.pending
    assert decoder.frames == counted


def test_an_argument_may_use_the_decoder_itself() -> None:
    """What runs while arguments are read is in the same thread: it is decoded first."""
    decoder, arrays = recorded(COMPLETE, 1)
    first = int(arrays[0][0]), arrays[4][0].tobytes()

    class Time:
        def __index__(self) -> int:
            decoder.feed_arrays(*arrays)
            return 0

    decoder.feed(*first, Time())
    assert decoder.frames == 1 + len(arrays[0])
