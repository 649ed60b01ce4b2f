"""A CAN bus of a test, in virtual or in real time, which nodes join."""

from __future__ import annotations

import uuid
from collections.abc import Callable
from typing import Any, Self

import can

from ..bus.clock import Clock, RealClock, TimerHandle, VirtualClock, to_ns
from ..bus.virtual_time import VirtualNetwork, VirtualTimeBus

#: The virtual time begins here [ns]: python-can takes a time stamp of 0 for none.
START_NS = 1_000_000_000_000


class Bench:
    """CAN bus of a test, and its time.

    In virtual time, only `run_for`, and ``recv`` with a timeout, let the time pass, and without
    waiting. In real time, the bus is any interface of python-can.

    Args:
        interface: of python-can; None: a bus in virtual time.
        channel: of the interface. Of python-can's ``virtual``, it is a new one if it is None.
        bitrate: in virtual time [bit/s]; None: frames take no time.
        fd: open the interface with CAN FD.

    >>> with Bench() as bench, bench.open() as one, bench.open() as other:
    ...     _ = bench.call_at(0.5, lambda: one.send(can.Message(arbitration_id=7)))
    ...     message = other.recv(timeout=60.0)
    >>> message.arbitration_id, bench.now
    (7, 0.5)
    """

    def __init__(
        self,
        interface: str | None = None,
        channel: str | None = None,
        *,
        bitrate: float | None = None,
        fd: bool = False,
    ) -> None:
        if interface == "virtual" and channel is None:
            channel = f"maplines-{uuid.uuid4()}"  # tests beside this one have another
        self.interface, self.channel, self._fd = interface, channel, fd
        self._buses: list[can.BusABC] = []
        self._notifiers: list[can.Notifier] = []
        self.clock: Clock
        self._network: VirtualNetwork | None = None
        if interface is None:
            self.clock = VirtualClock(START_NS)
            self._network = VirtualNetwork(self.clock, bitrate=bitrate)
        else:
            self.clock = RealClock()
        self._start_ns = self.clock.now_ns
        self._passed = 0.0

    @property
    def is_virtual(self) -> bool:
        """Whether the time is virtual."""
        return self._network is not None

    @property
    def now(self) -> float:
        """Time since the begin [s]."""
        return (self.clock.now_ns - self._start_ns) / 1e9

    def open(self) -> can.BusABC:
        """Return another node of the bus, such as for the controller under test."""
        if self._network is not None:
            bus: can.BusABC = VirtualTimeBus(self._network)
        else:
            fd: dict[str, Any] = {"fd": True} if self._fd else {}
            bus = can.Bus(interface=self.interface, channel=self.channel, **fd)
        self._buses.append(bus)
        return bus

    def listen(self, bus: can.BusABC, listener: Callable[[can.Message], object]) -> None:
        """Call a listener with each message of a bus, stamped with the time of this bench."""

        def stamped(message: can.Message) -> None:
            message.timestamp = self.clock.now  # adapters have clocks of their own
            listener(message)

        if isinstance(bus, VirtualTimeBus):
            bus.add_listener(listener)
        else:
            self._notifiers.append(can.Notifier(bus, [stamped]))

    def call_at(self, t: float, function: Callable[[], object]) -> TimerHandle:
        """Call a function at a time since the begin [s], while the time passes."""
        return self.clock.call_at(self._start_ns + to_ns(t), function)

    @property
    def present(self) -> float:
        """Begin of what a test takes as now [s]: in real time, the end of the last `run_for`."""
        return self.now if self.is_virtual else self._passed

    def run_for(self, seconds: float) -> None:
        """Let the time pass [s]."""
        self.clock.run_for(seconds)
        self._passed = self.now

    def run_until(self, is_done: Callable[[], bool], timeout: float, step: float) -> bool:
        """Let the time pass until something is so; return whether it is, or False at the timeout.

        Args:
            is_done: whether it is so.
            timeout: longest time [s].
            step: time between two looks [s].
        """
        end = self.now + timeout
        while not is_done():
            left = end - self.now
            if left <= 1e-9:
                return False
            self.run_for(min(step, left))
        return True

    def close(self) -> None:
        """Shut down all that was opened."""
        for notifier in self._notifiers:
            notifier.stop()
        for bus in self._buses:
            bus.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
