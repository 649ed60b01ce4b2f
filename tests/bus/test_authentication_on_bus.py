"""Authenticated lines over a bus."""

import uuid
from typing import Any

import can
import pytest
from support.fake_bus import Clock as SecondsClock
from support.fake_bus import drive, wait_until
from support.lines import scenario_lines
from support.secoc_streams import OTHER, SECRET, Clock, S, codec_of

from maplines_can import Link, Receiver, Transmitter
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


def changed(message: Any, data: Any) -> Any:
    return can.Message(
        arbitration_id=message.arbitration_id, is_extended_id=False, is_fd=True, data=data
    )
