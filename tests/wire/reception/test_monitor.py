"""The newest line of a slot, with its age and state."""

import numpy as np
import pytest
from support.dbcs import default_codec, new_codec
from support.e2e_streams import CYCLE, MS, SLOT, frames

from maplines_can import (
    MapLine,
)
from maplines_can.wire import E2EState

VALID, NODATA, INIT, INVALID = E2EState


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
