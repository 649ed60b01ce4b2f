"""Authenticated lines over a bus."""

import uuid
from typing import Any

import can
import pytest
from support.fake_bus import Clock as SecondsClock
from support.fake_bus import drive, wait_until
from support.lines import scenario_lines
from support.secoc_streams import MS, NOW, OTHER, SECRET, Clock, S, codec_of, feed, names

from maplines_can import Link, Receiver, Transmitter
from maplines_can.bus.tx_queue import AHEAD, TxQueue
from maplines_can.simulation import scenario
from maplines_can.wire import Key, Reason


@pytest.fixture
def clock() -> Any:
    return Clock()


@pytest.fixture
def channel() -> str:
    return f"test-{uuid.uuid4()}"


def test_an_attacker_and_a_key_change(channel: str) -> None:
    """All lines are received once; the frames of the attacker are counted."""
    old, new, seconds = Key(SECRET, 1), Key(OTHER, 2), SecondsClock()

    def clock() -> int:
        return round(seconds.now * S)

    sender, receiver = codec_of(old, clock=clock), codec_of(old, new, clock=clock)
    bus = {"interface": "virtual", "channel": channel, "fd": True}
    with Link(**bus) as out, Link(**bus) as back, can.Bus(**bus) as attacker:  # type: ignore[arg-type]
        with Receiver(back, receiver.decoder()) as listening:
            transmitter = Transmitter(out, sender, period=0.01, fd=True, count=40, clock=seconds)
            transmitter.publish(scenario_lines(scenario("highway"), 2))
            heard = 0
            while not transmitter._tx_queue.over:
                drive(transmitter, seconds, seconds.now + 0.002)
                while (message := attacker.recv(0)) is not None:
                    heard += 1
                    attacker.send(changed(message, message.data))  # again
                    forged = message.data[:-1] + bytes([message.data[-1] ^ 1])
                    attacker.send(changed(message, forged))
                    if heard == 15:
                        sender.authenticator.add(new)
                        sender.authenticator.use(2)
            wait_until(lambda: listening.stats().frames == 3 * heard)
        stats = listening.stats()
    assert stats.lines == transmitter.stats().lines == heard == 2 * 40
    assert stats.counts == {Reason.REPLAY: heard, Reason.MAC: heard}


@pytest.mark.parametrize("period", [0.01, 0.05, 0.4, 3.0, 3600.0])
def test_a_slow_sender_signs_just_before_it_sends(clock: Any, period: float) -> None:
    """At any rate no line is older than 0.1 s, so the window can be short."""
    sender, receiver = codec_of(clock=clock), codec_of(clock=clock, window_ns=AHEAD * S + MS)
    decoder = receiver.decoder(cycle_ms=min(1e3 * period, 60_000))
    tx_queue = TxQueue(sender, period, fd=True, count=3, max_age=1.0)
    tx_queue.put(scenario_lines(scenario("highway"), 8), 0.0)
    now, answers = 0.0, []
    while not tx_queue.over:
        now += tx_queue.wait(now) + 1e-6  # type: ignore[operator]
        clock.now = NOW + round(now * S)
        answers += feed(decoder, tx_queue.take(now).frames, clock.now)  # type: ignore[union-attr]

    assert names(answers) == ["line"] * 24


def changed(message: Any, data: Any) -> Any:
    return can.Message(
        arbitration_id=message.arbitration_id, is_extended_id=False, is_fd=True, data=data
    )
