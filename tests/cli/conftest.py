"""Fixtures of the tests of the command."""

import threading
import uuid
from collections.abc import Callable, Iterator
from typing import Any

import can
import pytest
from can.interfaces import virtual
from support.fake_bus import LONG, FakeTime, message_of, wait_until
from support.fixtures import Capture, Patch

from maplines_can import MapLine, Receiver


@pytest.fixture
def channel() -> str:
    """Name of a virtual channel that no other test uses."""
    return f"test-{uuid.uuid4()}"


@pytest.fixture
def replay(channel: str, monkeypatch: Patch) -> Iterator[Callable[..., None]]:
    """Return a function that sends transfers to the receiver that this process runs next.

    It takes (time stamp [s], frames) of each transfer, and an event to wait for after the first.
    The present time of the receiver is the last stamp, however busy the machine is.
    """
    monkeypatch.setattr("maplines_can.bus.receiver.time", FakeTime())
    threads: list[threading.Thread] = []

    def start(transfers: Any, after_first: threading.Event | None = None) -> None:
        def send() -> None:
            with can.Bus(interface="virtual", channel=channel, preserve_timestamps=True) as bus:
                wait_until(lambda: len(virtual.channels[channel]) == 2)
                for number, (stamp, frames) in enumerate(transfers):
                    for frame in frames:
                        bus.send(message_of(frame, timestamp=stamp))
                    if number == 0 and after_first is not None:
                        assert after_first.wait(LONG)

        threads.append(threading.Thread(target=send))
        threads[-1].start()

    yield start
    for thread in threads:
        thread.join()


@pytest.fixture
def slot_notes(capsys: Capture) -> Any:
    """Return a function for the rows of standard error about slots, after the total."""

    def notes() -> Any:
        rows = capsys.readouterr().err.splitlines()
        ends = [k for k, row in enumerate(rows) if "lost by their counters" in row]
        return rows[ends[-1] + 1 :]

    return notes


@pytest.fixture
def patient_timeout(monkeypatch: Patch) -> None:
    """Let no time of ``receive`` pass before a line or a reason comes, and none while lines come.

    A machine that is busy sends late, but not never.
    """
    clock, get = FakeTime(), Receiver.get

    def get_and_pass_time(receiver: Receiver, timeout: float | None = None) -> MapLine | None:
        line = get(receiver, timeout)
        stats = receiver.stats()
        if line is None and (stats.lines or stats.counts):
            clock.ns += 1_000_000_000
        return line

    monkeypatch.setattr("maplines_can.cli.receive.time", clock)
    monkeypatch.setattr(Receiver, "get", get_and_pass_time)
