"""Fakes of a python-can bus, of its factory and of clocks, and helpers of the tests of the bus."""

import errno
import itertools
import queue
import time
from typing import Any

import can

from maplines_can.bus import Sent
from maplines_can.values.line import MapLine, Slot

LONG = 120.0  #: how long a test waits for something that must happen [s]

GONE = OSError(errno.ENODEV, "No such device")
FULL = can.CanOperationError("No buffer space available", errno.ENOBUFS)
NO_NUMBER = can.CanOperationError("something went wrong")
FRAME = can.Message(arbitration_id=0x100, data=b"\x01", is_extended_id=False)


class FakeBus(can.BusABC):
    """A bus that raises the errors of a script, one a call, and works where the script has None."""

    def __init__(self, script: Any = (), sent: Any = None) -> None:
        super().__init__(channel="fake")
        self.channel_info = "fake"
        self.script = script if isinstance(script, list) else list(script)
        self.sent = queue.SimpleQueue() if sent is None else sent
        self.open = True

    def send(self, msg: Any, timeout: Any = None) -> None:  # noqa: ARG002
        if self.script and (error := self.script.pop(0)):
            raise error
        self.sent.put(msg)

    def _recv_internal(self, timeout: Any) -> Any:  # noqa: ARG002
        if self.script and (error := self.script.pop(0)):
            raise error
        return None, True

    def shutdown(self) -> None:
        super().shutdown()
        self.open = False


class FakeOpener:
    """Factory of fake buses, which share one script of errors and one record of sent frames."""

    def __init__(self, *script: Any) -> None:
        self.script, self.sent = list(script), queue.SimpleQueue[Any]()
        self.cannot_open = False
        self.opened: list[Any] = []
        self.settings = None

    def __call__(self, **settings: Any) -> Any:
        self.settings = settings  # type: ignore[assignment]
        if self.cannot_open:
            raise OSError(errno.ENODEV, "No such device")
        self.opened.append(FakeBus(self.script, self.sent))
        return self.opened[-1]


class Clock:
    """A clock that a test sets [s]."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> Any:
        return self.now


class FakeTime:
    """Stands in for the module ``time`` in a module under test; `ns` is the time of all clocks."""

    def __init__(self, ns: int = 1_700_000_000_000_000_000) -> None:
        self.ns = ns

    def time_ns(self) -> Any:
        return self.ns

    def monotonic_ns(self) -> Any:
        return self.ns

    def time(self) -> Any:
        return self.ns / 1e9

    def monotonic(self) -> Any:
        return self.ns / 1e9


def map_line(slot: Any = Slot.EGO_LEFT, y: float = 1.75, **rest: Any) -> Any:
    return MapLine.with_sigma(slot, [y, 0, 0, 0], [0.1, 0.01, 0.001, 0.0001], **rest)


def message_of(frame: Any, **rest: Any) -> Any:
    return can.Message(
        arbitration_id=frame.can_id,
        data=frame.data,
        is_fd=frame.is_fd,
        is_extended_id=False,
        **rest,
    )


def send_frames(link: Any, *frames: Any) -> None:
    for frame in frames:
        assert link.send(message_of(frame)) is Sent.OK


def collect(receiver: Any, n: Any) -> Any:
    """The next n lines of a receiver."""
    lines = list(itertools.islice(iter(lambda: receiver.get(LONG), None), n))
    assert len(lines) == n
    return lines


def drive(transmitter: Any, clock: Any, end: Any) -> None:
    """Do what the transmitter's thread does until ``end`` on a fake clock, never late."""
    while (step := transmitter._tx_queue.wait(clock.now)) is not None and clock.now + step < end:
        clock.now += step
        transmitter._send(transmitter._next_transfer())
    clock.now = end


def wait_until(condition: Any) -> None:
    """Wait for a condition that another thread makes true."""
    end = time.monotonic() + LONG
    while not condition():
        assert time.monotonic() < end, "the condition did not become true"
        time.sleep(0.001)
