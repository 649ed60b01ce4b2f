"""Reception of scenes: lines that wait, bad contents, time-outs and the decoder."""

from __future__ import annotations

from collections import Counter
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import pytest
from support.scene_streams import COMPLETE, CONDITIONAL, PERIOD_NS, codec_of, feed, road_scene

from maplines_can import MapLine, Slot
from maplines_can.wire import POSE, Decoder, E2EState, Frame, Reason, ReceivedFrame

SLOTS = (Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.NEXT_LEFT)


def cycles(dbc: str, n: int, **settings: Any) -> list[dict[Any, list[Frame]]]:
    """Return the frames of a scene in n cycles."""
    codec = codec_of(dbc)
    prepared = codec.encoder().prepare_scene(road_scene(SLOTS))
    return [
        codec.encoder().encode_scene(prepared, counters=dict.fromkeys([POSE, *Slot], n), **settings)
        for n in range(n)
    ]


def accounted(decoder: Decoder) -> bool:
    known = decoder.line_frames + decoder.pose_frames
    return decoder.frames == known + sum(decoder.counts.values()) + decoder.pending


def test_lines_of_another_cycle_do_not_join() -> None:
    """The pose error of a cycle with the lines of the next or of the last one."""
    for dbc in (CONDITIONAL, COMPLETE):
        one, two = cycles(dbc, 2)
        for pose, lines in ((one, two), (two, one)):
            mixed = {POSE: pose[POSE]} | {slot: lines[slot] for slot in SLOTS}
            decoder = codec_of(dbc).decoder()
            feed(decoder, mixed, 0)
            assert decoder.scene() is None


@pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])
@pytest.mark.parametrize("seed", range(3))
def test_frames_that_are_decoded_together_give_the_same(dbc: str, seed: int) -> None:
    """As one by one: frames of many cycles, late, lost, damaged and twice, in any bursts."""
    rng = np.random.default_rng(seed)
    stream: list[tuple[float, Frame]] = []
    for n, frames in enumerate(cycles(dbc, 80)):
        for i, frame in enumerate(frame for own in frames.values() for frame in own):
            t = n + i / 40
            if rng.random() < 0.02:
                data = bytearray(frame.data)
                data[rng.integers(len(data))] ^= 1
                frame = frame._replace(data=bytes(data))
            times = [t, *[t + rng.random() * 2] * (rng.random() < 0.05)]
            stream += [(t + (rng.random() < 0.02) * 8 * rng.random(), frame) for t in times]
    stream.sort(key=lambda one: one[0])
    received = [
        ReceivedFrame(frame.can_id, frame.data, round(t * PERIOD_NS))
        for t, frame in stream
        if rng.random() < 0.98
    ]
    alone, together = codec_of(dbc).decoder(), codec_of(dbc).decoder()
    place, kinds = 0, Counter[Any]()
    while place < len(received):
        burst = received[place : place + int(rng.integers(1, 120))]
        answers = [alone.feed(*frame[:3]) for frame in burst]
        assert [*map(bits, answers)] == [*map(bits, together.feed_all(burst))]
        kinds.update(a if isinstance(a, Reason) else "line" for a in answers)
        place, now_ns = place + len(burst), burst[-1].t_ns
        for decoder in (alone, together):
            assert accounted(decoder)
        assert alone.counts == together.counts
        assert alone.pending == together.pending
        assert alone.slots(now_ns) == together.slots(now_ns)
        assert bits(alone.latest_scene(now_ns)) == bits(together.latest_scene(now_ns))
    assert kinds["line"] > 50
    assert kinds[Reason.CRC]


def bits(found: object) -> Any:
    """Return all that a line or a scene consists of, with the bytes of its arrays."""
    if isinstance(found, np.ndarray):
        return found.shape, found.tobytes()
    if is_dataclass(found):
        return [bits(getattr(found, field.name)) for field in fields(found)]
    return [*map(bits, found)] if isinstance(found, tuple | list) else found


def test_a_full_line_that_is_no_function_of_x_is_in_no_scene() -> None:
    """It is delivered, as by a receiver without scenes, and the scene has the other lines."""
    codec = codec_of(COMPLETE)
    scene = road_scene(SLOTS)
    steep = MapLine.with_sigma(
        Slot.EGO_RIGHT, [0, 0.4, 0.12, 0.03], [0.1, 0.01, 1e-3, 1e-4], x_min=-8, x_max=124
    )
    frames = codec.encoder().encode_scene(scene, counters={}) | {
        Slot.EGO_RIGHT: codec.encoder().encode_lines([steep], counters={})[0]
    }
    decoder = codec.decoder()
    answers, _ = feed(decoder, frames, 0)
    assert sum(isinstance(one, MapLine) for one in answers) == 3
    received = decoder.scene()
    assert received is not None
    assert [line.slot for line in received.scene.lines] == [Slot.EGO_LEFT, Slot.NEXT_LEFT]
    assert np.linalg.eigvalsh(received.scene.joint().cov)[0] > 0


@pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])
def test_the_view_of_the_monitor(dbc: str) -> None:
    """Usable when the pose error is VALID, until no pose error came for three cycles."""
    decoder = codec_of(dbc).decoder()
    view = decoder.latest_scene(0)
    assert (view.scene, view.usable, view.stale, view.state) == (None, False, True, E2EState.NODATA)
    assert (view.age, view.status) == (np.inf, None)
    t_ns = 0
    for n, frames in enumerate(cycles(dbc, 16, age=0.02)):
        _, t_ns = feed(decoder, frames, n * PERIOD_NS)
    last = 15 * PERIOD_NS
    view = decoder.latest_scene(t_ns)
    assert view.usable
    assert view.state is E2EState.VALID
    assert view.age == pytest.approx(0.024 + (t_ns - last) / 1e9)
    assert decoder.latest_scene(last + 3 * PERIOD_NS).usable
    assert not decoder.latest_scene(last + 3 * PERIOD_NS + 1).usable
    assert decoder.latest_scene(last + 3 * PERIOD_NS + 1).stale
    assert not decoder.latest_scene(last - 4 * PERIOD_NS).usable  # a clock set back
    assert not decoder.latest_scene(last + 3 * PERIOD_NS, stale_cycles=2).usable
    for slot in SLOTS:
        assert decoder.latest(slot, t_ns).usable
