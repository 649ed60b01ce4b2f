"""The newest line of a slot, with its age and state."""

import math

import numpy as np
import pytest
from answers import one
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support import scene_streams, sender_pairs
from support.dbcs import default_codec, new_codec
from support.e2e_streams import CYCLE, MS, SLOT, frames
from support.scene_streams import CONDITIONAL

from maplines_can import (
    Decoder,
    Gaussian,
    GaussianMixture,
    MapLine,
    SceneView,
    Slot,
    SlotView,
)
from maplines_can.wire import E2EState
from maplines_can.wire.reception.views import CLOCK_JITTER_NS as JITTER

VALID, NODATA, INIT, INVALID = E2EState


@pytest.mark.parametrize("every", [1, 5, 10])
def test_a_slot_with_two_senders_is_not_usable(every: int) -> None:
    """Once the second sender is known, however slow it is."""
    decoder = default_codec().decoder()
    usable = 0
    for cycle in range(400):
        senders = [(0, 0)] + ([(20, 77)] if cycle % every == 0 else [])
        for ms, ahead in senders:
            counter = (cycle // every if ms else cycle) + ahead
            for i, frame in enumerate(frames(counter % 256, which=(counter + 9 * ms) % 256)):
                decoder.feed(frame.can_id, frame.data, cycle * CYCLE + ms * MS + i * MS // 4)
        usable += cycle >= 200 and decoder.latest(SLOT, cycle * CYCLE + 40 * MS).usable
    assert decoder.checks[SLOT].two_senders
    assert usable == 0


def test_a_line_becomes_stale() -> None:
    """After three cycles; its age counts from its pose, and the state changes at 275 ms."""
    codec = new_codec()
    encoder = codec.encoder()
    decoder = codec.decoder()
    before = decoder.latest(SLOT, 0)
    assert before == (SLOT, None, np.inf, True, NODATA, None, False, None)
    for k in range(10):
        line = MapLine.mean_only(SLOT, [1.0 + k / 8, 0, 0, 0], age=0.04)
        for frame in encoder.encode(line):
            decoder.feed(frame.can_id, frame.data, k * CYCLE)
    last = 9 * CYCLE
    for waited_ms, stale, state in [
        (0, False, VALID),
        (150, False, VALID),
        (151, True, VALID),
        (274, True, VALID),
        (275, True, INVALID),
        (10**6, True, INVALID),
    ]:
        view = decoder.latest(SLOT, last + waited_ms * MS)
        assert view.line.gaussian.mean[0] == pytest.approx(1.0 + 9 / 8, abs=1e-3)  # type: ignore[union-attr]
        assert view.age == pytest.approx(0.04 + waited_ms / 1000)
        assert (view.stale, view.state) == (stale, state)
        assert view.usable == (not stale and state is VALID)


def test_a_line_is_not_usable_before_the_state_is_valid() -> None:
    """After the first line it is INIT, whatever the age of the line."""
    decoder = default_codec().decoder()
    *_, answer = [one(decoder.feed(frame.can_id, frame.data, 0)) for frame in frames(0)]
    view = decoder.latest(SLOT, 0)
    assert view.line is answer
    assert (view.state, view.stale, view.two_senders, view.usable) == (INIT, False, False, False)


def test_the_caller_defines_stale() -> None:
    """By a number of cycles, and by the cycle time of the decoder."""
    decoder = default_codec().decoder()
    slow = default_codec().decoder(cycle_ms=200)
    for frame in frames(0):
        decoder.feed(frame.can_id, frame.data, 0)
        slow.feed(frame.can_id, frame.data, 0)
    assert decoder.latest(SLOT, 60 * MS, stale_cycles=1).stale
    assert not decoder.latest(SLOT, 400 * MS, stale_cycles=8).stale
    assert not slow.latest(SLOT, 600 * MS).stale
    assert slow.latest(SLOT, 601 * MS).stale
    assert decoder.latest(SLOT, -(10**12)).stale  # the clock was set back


def test_a_slot_that_the_dbc_does_not_have_raises() -> None:
    """The message names the slots of the DBC."""
    with pytest.raises(ValueError, match=r"slot must be one of the DBC's, EGO_LEFT, .* got 99"):
        default_codec().decoder().latest(99, 0)  # type: ignore[arg-type]


def test_the_statistics_are_those_of_now() -> None:
    """Cycles without a record count although nothing was received or asked for since."""
    decoder = default_codec().decoder()
    decoder = decoder
    assert decoder.slots(0) == {}
    for counter in range(10):
        for frame in frames(counter):
            decoder.feed(frame.can_id, frame.data, counter * CYCLE)
    stats = decoder.slots(9 * CYCLE)
    assert stats.keys() == {SLOT}
    assert (stats[SLOT].ok, stats[SLOT].no_new_data, stats[SLOT].state) == (10, 0, VALID)
    stats = decoder.slots(19 * CYCLE)
    assert (stats[SLOT].ok, stats[SLOT].no_new_data, stats[SLOT].state) == (10, 9, INVALID)


@pytest.mark.parametrize("now_ns", [0.5, float("nan")])
def test_the_current_time_is_whole(now_ns: float) -> None:
    """In seconds, it would be refused, not taken for nanoseconds."""
    with pytest.raises(ValueError, match=r"now_ns must be whole \[ns\], got"):
        default_codec().decoder().latest(SLOT, now_ns)  # type: ignore[arg-type]


@settings(max_examples=12)
@given(st.integers(-300 * MS, 300 * MS), st.sampled_from([0.0, 0.04]))
@example(0, 0.0)
@example(-1, 0.0)
@example(-JITTER, 0.0)
@example(-JITTER - 1, 0.0)
@example(3 * CYCLE, 0.04)
@example(3 * CYCLE + 1, 0.04)
def test_what_comes_after_now_is_stale(now_ns: int, age: float) -> None:
    """Lines, mixtures and scenes: if the clock of the caller was set back, no age is known."""
    last, is_known = 9 * CYCLE, now_ns >= -JITTER
    scenes = scenes_until(age)
    views: list[SlotView | SceneView] = [
        *(lines_until(age).latest(slot, last + now_ns) for slot in (SLOT, Slot.EGO_RIGHT)),
        scenes.latest(SLOT, last + now_ns),
        scenes.latest_scene(last + now_ns),
    ]
    for view in views:
        assert view.stale is not (is_known and now_ns <= 3 * CYCLE)
        assert view.usable is not view.stale
        assert math.isfinite(view.age) is is_known
        if is_known:  # stated ages are multiples of 8 ms
            assert view.age == pytest.approx(age + max(now_ns, 0) / 1e9)


def lines_until(age: float) -> Decoder:
    """A decoder after ten lines and ten mixtures, the last ones at 9 CYCLE."""
    codec = new_codec()
    encoder = codec.encoder()
    decoder = codec.decoder()
    line = MapLine.mean_only(SLOT, [1.0, 0, 0, 0], age=age)
    mixture = GaussianMixture(
        np.array([0.5, 0.5]), tuple(Gaussian([y, 0, 0, 0], 1e-6 * np.eye(4)) for y in (1.0, 2.0))
    )
    both = MapLine(Slot.EGO_RIGHT, mixture.overall, x_max=80.0, age=age, mixture=mixture)
    for k in range(10):
        for frame in (*encoder.encode(line), *encoder.encode(both)):
            decoder.feed(frame.can_id, frame.data, k * CYCLE)
    return decoder


def scenes_until(age: float) -> Decoder:
    """A decoder after ten scenes, the last one at 9 CYCLE."""
    codec = scene_streams.new_codec(scene_streams.CONDITIONAL)
    encoder = codec.encoder()
    decoder, scene = codec.decoder(), sender_pairs.prepared(CONDITIONAL, 0, (SLOT,))
    for k in range(10):
        scene_streams.feed(decoder, encoder.encode_scene(scene, age=age), k * CYCLE, apart_ns=0)
    return decoder
