"""A decoder in C that several threads use at the same time: refused, and nothing is lost."""

import threading
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from scene_streams import COMPLETE, CONDITIONAL, new_codec, road_scene

from maplines_can import Slot, native

pytestmark = pytest.mark.skipif(not native.is_active, reason="there is no C path")

THREADS, BLOCKS = 3, 4
REFUSED = "not thread-safe; give each thread a decoder of its own"


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
def test_calls_of_other_threads_are_refused_meanwhile(dbc: str) -> None:
    """Each block is decoded whole, or raises; so does each other call. All frames are counted."""
    decoder, arrays = recorded(dbc, 200)
    first = int(arrays[0][0]), arrays[4][0].tobytes()
    calls: list[Callable[[], Any]] = [
        lambda: decoder.feed(*first, 0),
        lambda: decoder.feed_all([(*first, 0, False)]),
        lambda: decoder.expire(0),
        lambda: decoder.latest(Slot.EGO_LEFT, 0),
        lambda: decoder.latest_scene(0),
        decoder.scene,
        lambda: decoder.slots(0),
        lambda: decoder.pending,
        lambda: decoder.counts,
    ]
    seen, done = Counter[str](), threading.Event()

    def count(name: str, call: Callable[[], Any]) -> None:
        try:
            call()
        except RuntimeError as error:
            name += " refused" if REFUSED in str(error) else " failed"
        seen[name] += 1  # under the GIL: each thread has names of its own

    def feed(number: int) -> None:
        for _ in range(BLOCKS):
            own = [*arrays[:6], np.zeros_like(arrays[6]), 2]
            count(f"block {number}", partial(decoder.feed_arrays, *own))

    def ask() -> None:
        while not done.is_set():
            for i, call in enumerate(calls):
                count(f"call {i}", call)

    asking = threading.Thread(target=ask)
    feeding = [threading.Thread(target=feed, args=(number,)) for number in range(THREADS)]
    asking.start()
    for thread in feeding:
        thread.start()
    for thread in feeding:
        thread.join()
    done.set()
    asking.join()
    blocks = sum(seen[f"block {number}"] for number in range(THREADS))
    refused = sum(seen[f"block {number} refused"] for number in range(THREADS))
    assert (blocks + refused, blocks > 0) == (THREADS * BLOCKS, True)
    fed = blocks * len(arrays[0]) + seen["call 0"] + seen["call 1"]
    counted = decoder.line_frames + decoder.pose_frames + decoder.counts.total() + decoder.pending
    assert decoder.frames == counted == fed


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
