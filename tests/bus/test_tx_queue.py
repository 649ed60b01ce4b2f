"""Lines are encoded together, a little ahead; counters have no gap."""

from typing import Any

import pytest
from fake_bus import (
    Clock,
    FakeOpener,
    drive,
    map_line,
)
from fake_codec import FakeCodec, sent_values
from hypothesis import given, settings
from hypothesis import strategies as st

from maplines_can.bus import (
    Link,
    Transmitter,
)
from maplines_can.bus.tx_queue import AHEAD, ALLOWANCE, TxQueue
from maplines_can.line import Slot
from maplines_can.wire import Codec


def test_a_retracted_line_is_not_sent_again(link: Any) -> None:
    """The line of another slot stays."""
    transmitter = Transmitter(link, FakeCodec(), period=0.02)  # type: ignore[arg-type]
    transmitter.publish(map_line())
    transmitter.retract(Slot.NEXT_LEFT)
    assert transmitter._tx_queue.wait(0.0) is not None
    transmitter.retract(Slot.EGO_LEFT)
    assert transmitter._tx_queue.wait(0.0) is None


class Recorder(FakeCodec):
    """Codec that records the lines of each call, for a transmitter that is driven step by step."""

    def __init__(self) -> None:
        super().__init__()
        self.batches: list[Any] = []

    def encode_lines(self, lines: Any, *, fd: bool = False, counters: Any = None) -> Any:
        self.batches.append([(x.slot, x.gaussian.mean[0], round(x.age, 9)) for x in lines])
        return super().encode_lines(lines, fd=fd, counters=counters)


def test_lines_are_encoded_together_with_the_ages_at_their_deadlines() -> None:
    """One call a period; each age refers to the line's own deadline and the lateness allowed."""
    opener, clock, codec = FakeOpener(), Clock(), Recorder()
    with Link(opener) as link:
        transmitter = Transmitter(link, codec, period=0.08, clock=clock)  # type: ignore[arg-type]
        transmitter.publish([map_line(slot, age=0.1) for slot in Slot])
        drive(transmitter, clock, 1000.075)

        ages = [round(0.1 + slot / 100 + ALLOWANCE, 9) for slot in Slot]
        assert codec.batches == [[(slot, 1.75, age) for slot, age in zip(Slot, ages, strict=True)]]
        assert sent_values(opener) == [(round(1000 * age), 1750) for age in ages]


@pytest.mark.parametrize("offset", [0.005, 0.035, 0.065])
def test_a_producer_of_the_same_period_is_never_behind(offset: float) -> None:
    """Whenever it publishes: one call a period, and no value is older than a period."""
    opener, clock, codec = FakeOpener(), Clock(), Recorder()
    with Link(opener) as link:
        transmitter = Transmitter(link, codec, period=0.08, clock=clock)  # type: ignore[arg-type]
        for k in range(10):
            transmitter.publish(map_line(slot, y=k) for slot in Slot)
            drive(transmitter, clock, 1000.0 + offset + 0.08 * k)
            if k == 5:
                sent_values(opener)
                codec.batches.clear()

        assert [len(batch) for batch in codec.batches] == [8] * 4
        for batch in codec.batches:
            assert len({y for _, y, _ in batch}) == 1
            assert max(age for _, _, age in batch) < 0.08 + ALLOWANCE


def test_repetitions_are_encoded_half_a_period_ahead_at_most() -> None:
    opener, clock, codec = FakeOpener(), Clock(), Recorder()
    with Link(opener) as link:
        transmitter = Transmitter(link, codec, period=0.08, clock=clock)  # type: ignore[arg-type]
        transmitter.publish(map_line(slot) for slot in Slot)
        drive(transmitter, clock, 1000.0 + 0.08 * 3 - 0.001)

    assert [len(batch) for batch in codec.batches] == [8, 4, 4, 4, 4]


@pytest.mark.parametrize("period", [1.0, 3.0, 60.0])
def test_a_slow_sender_encodes_a_tenth_of_a_second_ahead_at_most(period: float) -> None:
    """A new value is sent at the next deadline, although the period is long."""
    opener, clock, codec = FakeOpener(), Clock(), Recorder()
    with Link(opener) as link:
        transmitter = Transmitter(link, codec, period=period, clock=clock)  # type: ignore[arg-type]
        transmitter.publish(map_line(slot, y=1) for slot in Slot)
        drive(transmitter, clock, 1000.0 + period * 5 / 8 - AHEAD - 0.01)
        transmitter.publish(map_line(slot, y=2) for slot in Slot)
        drive(transmitter, clock, 1000.0 + period * 0.99)

    assert [y for _, y in sent_values(opener)] == [1000] * 5 + [2000] * 3
    assert max(map(len, codec.batches)) <= 1 + AHEAD / (period / 8)


def test_a_line_encoded_before_a_retract_is_not_sent_after_it() -> None:
    opener, clock = FakeOpener(), Clock()
    with Link(opener) as link:
        transmitter = Transmitter(link, FakeCodec(), period=0.08, clock=clock)  # type: ignore[arg-type]
        transmitter.publish(map_line(slot, y=1) for slot in Slot)
        drive(transmitter, clock, 1000.005)
        assert len(transmitter._tx_queue._ahead) == 7
        transmitter.retract(Slot.ROUTE)
        drive(transmitter, clock, 1000.05)
        transmitter.publish(map_line(Slot.ROUTE, y=2))
        drive(transmitter, clock, 1000.075)

        assert [y for _, y in sent_values(opener)] == [1000] * 7 + [2000]


@settings(max_examples=30)
@given(st.lists(st.sampled_from([0.2, 0.9, 1.1, 2.7]), min_size=1, max_size=30), st.integers(1, 3))
def test_counters_have_no_gap_whatever_deadlines_are_skipped(steps: Any, drop_every: int) -> None:
    """Lines that were encoded ahead and not sent do not count as lost."""
    codec, period, now = Codec.from_dbc(), 0.05, 100.0
    tx_queue = TxQueue(codec, period, fd=True, count=None, max_age=1.0)
    decoder = codec.decoder(cycle_ms=1e3 * period)
    for number, step in enumerate(steps):
        tx_queue.put([map_line(slot) for slot in (Slot.EGO_LEFT, Slot.ROUTE)], now)
        if number % drop_every == 0:
            tx_queue.drop(Slot.ROUTE)
        now += step * period
        while (transfer := tx_queue.take(now)) is not None:
            for frame in transfer.frames:
                decoder.feed(frame.can_id, frame.data, round(1e9 * now))
    assert decoder.lost == 0
    assert not any(decoder.counts.values())
