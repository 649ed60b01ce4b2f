"""The newest line of a slot, with its age and state."""

import numpy as np
import pytest
from dbcs import default_codec, new_codec
from e2e_streams import CYCLE, MS, SLOT, frames

from maplines_can import MapLine, Monitor
from maplines_can.wire import E2EState

VALID, NODATA, INIT, INVALID = E2EState


@pytest.mark.parametrize("every", [1, 5, 10])
def test_a_slot_with_two_senders_is_not_usable(every: int) -> None:
    """Once the second sender is known, however slow it is."""
    monitor = Monitor(decoder := default_codec().decoder())
    usable = 0
    for cycle in range(400):
        senders = [(0, 0)] + ([(20, 77)] if cycle % every == 0 else [])
        for ms, ahead in senders:
            counter = (cycle // every if ms else cycle) + ahead
            for i, frame in enumerate(frames(counter % 256, which=(counter + 9 * ms) % 256)):
                monitor.feed(frame.can_id, frame.data, cycle * CYCLE + ms * MS + i * MS // 4)
        usable += cycle >= 200 and monitor.latest(SLOT, cycle * CYCLE + 40 * MS).usable
    assert decoder.checks[SLOT].two_senders
    assert usable == 0


def test_a_line_becomes_stale() -> None:
    """After three cycles; its age counts from its pose, and the state changes at 275 ms."""
    codec = new_codec()
    monitor = Monitor(codec.decoder())
    before = monitor.latest(SLOT, 0)
    assert before == (SLOT, None, np.inf, True, NODATA, None, False)
    for k in range(10):
        line = MapLine.mean_only(SLOT, [1.0 + k / 8, 0, 0, 0], age=0.04)
        for frame in codec.encode(line):
            monitor.feed(frame.can_id, frame.data, k * CYCLE)
    last = 9 * CYCLE
    for waited_ms, stale, state in [
        (0, False, VALID),
        (150, False, VALID),
        (151, True, VALID),
        (274, True, VALID),
        (275, True, INVALID),
        (10**6, True, INVALID),
    ]:
        view = monitor.latest(SLOT, last + waited_ms * MS)
        assert view.line.gaussian.mean[0] == pytest.approx(1.0 + 9 / 8, abs=1e-3)  # type: ignore[union-attr]
        assert view.age == pytest.approx(0.04 + waited_ms / 1000)
        assert (view.stale, view.state) == (stale, state)
        assert view.usable == (not stale and state is VALID)


def test_a_line_is_not_usable_before_the_state_is_valid() -> None:
    """After the first line it is INIT, whatever the age of the line."""
    monitor = Monitor(default_codec().decoder())
    *_, answer = [monitor.feed(frame.can_id, frame.data, 0) for frame in frames(0)]
    view = monitor.latest(SLOT, 0)
    assert view.line is answer
    assert (view.state, view.stale, view.two_senders, view.usable) == (INIT, False, False, False)


def test_the_caller_defines_stale() -> None:
    """By a number of cycles, and by the cycle time of the decoder."""
    monitor = Monitor(default_codec().decoder())
    slow = Monitor(default_codec().decoder(cycle_ms=200))
    for frame in frames(0):
        monitor.feed(frame.can_id, frame.data, 0)
        slow.feed(frame.can_id, frame.data, 0)
    assert monitor.latest(SLOT, 60 * MS, stale_cycles=1).stale
    assert not monitor.latest(SLOT, 400 * MS, stale_cycles=8).stale
    assert not slow.latest(SLOT, 600 * MS).stale
    assert slow.latest(SLOT, 601 * MS).stale
    assert monitor.latest(SLOT, -(10**12)).stale  # the clock was set back


def test_a_slot_that_the_dbc_does_not_have_raises() -> None:
    """The message names the slots of the DBC."""
    with pytest.raises(ValueError, match=r"slot must be one of the DBC's, EGO_LEFT, .* got 99"):
        Monitor(default_codec().decoder()).latest(99, 0)  # type: ignore[arg-type]


def test_the_statistics_are_those_of_now() -> None:
    """Cycles without a record count although nothing was received or asked for since."""
    decoder = default_codec().decoder()
    monitor = Monitor(decoder)
    assert monitor.slots(0) == {}
    for counter in range(10):
        for frame in frames(counter):
            monitor.feed(frame.can_id, frame.data, counter * CYCLE)
    stats = monitor.slots(9 * CYCLE)
    assert stats.keys() == {SLOT}
    assert (stats[SLOT].ok, stats[SLOT].no_new_data, stats[SLOT].state) == (10, 0, VALID)
    stats = monitor.slots(19 * CYCLE)
    assert (stats[SLOT].ok, stats[SLOT].no_new_data, stats[SLOT].state) == (10, 9, INVALID)


@pytest.mark.parametrize("now_ns", [0.5, float("nan")])
def test_the_current_time_is_whole(now_ns: float) -> None:
    """In seconds, it would be refused, not taken for nanoseconds."""
    with pytest.raises(ValueError, match=r"now_ns must be whole \[ns\], got"):
        Monitor(default_codec().decoder()).latest(SLOT, now_ns)  # type: ignore[arg-type]
