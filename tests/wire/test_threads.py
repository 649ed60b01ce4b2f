"""Encoders, a decoder, batches and refits in threads at the same time; see c_checks.py threads."""

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from support.scene_streams import COMPLETE, CONDITIONAL, new_codec, road_scene

from maplines_can import Slot

SCENES = 40


@pytest.mark.parametrize("dbc", [COMPLETE, CONDITIONAL])
def test_threads_share_an_encoder_and_a_decoder(dbc: str) -> None:
    """No frame is lost, and no counter is sent twice."""
    codec = new_codec(dbc)
    encoder, decoder = codec.encoder(), codec.decoder()
    prepared = encoder.prepare_scene(road_scene())
    frames = [
        frame
        for _ in range(SCENES)
        for own in encoder.encode_scene(prepared).values()
        for frame in own
    ]
    first = codec.encoder().encode_scene(prepared)
    sent: list[Any] = []
    failed: list[BaseException] = []

    def send() -> None:
        sent.extend(encoder.encode_scene(prepared) for _ in range(SCENES))

    def prepare() -> None:
        for _ in range(5):
            frames_of = codec.encoder().encode_scene(road_scene())
            assert frames_of == first

    def feed() -> None:
        for i, frame in enumerate(frames):
            decoder.feed(frame.can_id, bytes(frame.data), i * 10**6)

    def feed_block() -> None:
        n = len(frames)
        data = np.array([list(frame.data) for frame in frames], np.uint8)
        numbers = np.array([frame.can_id for frame in frames], np.uint32)
        decoder.feed_arrays(
            numbers, np.zeros(n, bool), np.arange(n) * 10**6, np.full(n, 8, np.uint8), data,
            np.arange(n), np.zeros(n, np.uint8), 2,
        )  # fmt: skip

    def ask() -> None:
        for _ in range(5 * SCENES):
            decoder.latest(Slot.EGO_LEFT, 0)
            decoder.latest_scene(0)
            decoder.scene()
            decoder.slots(0)
            decoder.expire(0)

    def batch() -> Any:
        cov = np.tile(np.diag([0.1, 1e-3, 1e-7, 1e-11]), (50, 1, 1))
        return codec.batch.encode(np.zeros((50, 4)), cov, slot=[0] * 50)

    def encode_batches() -> None:
        for _ in range(0 if codec.layout.is_conditional else 10):
            assert np.array_equal(batch(), expected)

    expected: Any = None if codec.layout.is_conditional else batch()

    def watched(work: Callable[[], None]) -> None:
        try:
            work()
        except BaseException as error:  # noqa: BLE001 - the test shows it
            failed.append(error)

    works = (feed, feed, feed_block, ask, send, send, prepare, encode_batches, encode_batches)
    threads = [threading.Thread(target=watched, args=(work,)) for work in works]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failed == []
    assert decoder.frames == 3 * len(frames)
    counted = decoder.line_frames + decoder.pose_frames + decoder.counts.total() + decoder.pending
    assert decoder.frames == counted
    scenes = {tuple(bytes(frame.data) for own in one.values() for frame in own) for one in sent}
    assert len(scenes) == len(sent) == 2 * SCENES
