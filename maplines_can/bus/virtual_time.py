"""CAN buses on a virtual clock: what they send arrives at the time of that clock."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

import can
from can.broadcastmanager import CyclicSendTaskABC

from .clock import TimerHandle, VirtualClock, to_ns
from .frame_timing import frame_bits


class VirtualNetwork:
    """CAN network on a virtual clock, which `VirtualTimeBus` joins.

    Without a bit rate, a frame arrives in the moment in which it is sent. With one, it takes its
    longest time on the wire (``frame_bits``), one frame after the other. If several nodes
    have frames, that with the lowest identifier comes first; each node sends in order::

        node A sends    0x300 0x100
        node B sends    0x200
        on the wire     0x200 | 0x300 | 0x100      B wins; 0x100 waits for the frame before it

    Args:
        clock: the clock; its time stamps the frames.
        bitrate: nominal bit rate [bit/s]; None: frames take no time.
        data_bitrate: of the data phase of CAN FD frames with bit-rate switch [bit/s]; None: the
            nominal one.

    Raises:
        ValueError: a bit rate is not positive, or there is only that of the data phase.
    """

    def __init__(
        self,
        clock: VirtualClock,
        *,
        bitrate: float | None = None,
        data_bitrate: float | None = None,
    ) -> None:
        for name, rate in (("bitrate", bitrate), ("data_bitrate", data_bitrate)):
            if rate is not None and not 0 < rate < math.inf:
                raise ValueError(f"{name} must be positive and finite [bit/s], got {rate!r}")
        if bitrate is None and data_bitrate is not None:
            raise ValueError(f"data_bitrate={data_bitrate!r} bit/s needs a bitrate as well")
        self.clock = clock
        #: Nominal bit rate, and that of the data phase [bit/s]; None: frames take no time.
        self.bitrates = None if bitrate is None else (bitrate, data_bitrate or bitrate)
        self._buses: list[VirtualTimeBus] = []
        self._is_busy = False  # a frame is on the wire, or arbitration is about to begin

    def join(self, bus: VirtualTimeBus) -> None:
        """Add a bus; ``VirtualTimeBus`` does so."""
        self._buses.append(bus)

    def leave(self, bus: VirtualTimeBus) -> None:
        """Remove a bus, and the frames that it has not sent yet."""
        self._buses = [other for other in self._buses if other is not bus]

    def send(self, bus: VirtualTimeBus, message: can.Message) -> None:
        """Send a message of a bus to the others."""
        if self.bitrates is None:
            self._deliver(bus, message)
            return
        bus.outgoing.append((message, _duration_ns(message, *self.bitrates)))
        if not self._is_busy:  # what is sent in the same moment takes part in the arbitration
            self._is_busy = True
            self.clock.call_at(self.clock.now_ns, self._arbitrate)

    def _arbitrate(self) -> None:
        """Begin to transmit the frame that wins, if there is one."""
        nodes = [bus for bus in self._buses if bus.outgoing]
        self._is_busy = bool(nodes)
        if nodes:
            winner = min(nodes, key=lambda bus: _priority(bus.outgoing[0][0]))
            message, duration_ns = winner.outgoing.popleft()
            self.clock.call_at(
                self.clock.now_ns + duration_ns, lambda: self._finish(winner, message)
            )

    def _finish(self, bus: VirtualTimeBus, message: can.Message) -> None:
        self.clock.call_at(self.clock.now_ns, self._arbitrate)  # after what the frame causes
        self._deliver(bus, message)

    def _deliver(self, sender: VirtualTimeBus, message: can.Message) -> None:
        for bus in tuple(self._buses):  # a listener may shut one down
            if bus is not sender or bus.receive_own_messages:
                bus.take(message, is_rx=bus is not sender)


def _duration_ns(message: can.Message, bitrate: float, data_bitrate: float) -> int:
    bits = frame_bits(
        0 if message.is_remote_frame else len(message.data),
        is_extended=message.is_extended_id,
        is_fd=message.is_fd,
    )
    data_rate = data_bitrate if message.bitrate_switch else bitrate
    return to_ns(bits.nominal / bitrate + bits.data / data_rate)


class _Priority(NamedTuple):
    """Fields of a frame in the order of arbitration: the smallest wins (ISO 11898-1)."""

    base: int
    format: int  # after the base ID: data frame, remote frame, extended frame
    extension: int
    is_remote: bool


def _priority(message: can.Message) -> _Priority:
    if message.is_extended_id:
        base, extension = message.arbitration_id >> 18, message.arbitration_id & 0x3FFFF
        return _Priority(base, 2, extension, message.is_remote_frame)
    is_remote = message.is_remote_frame
    return _Priority(message.arbitration_id, int(is_remote), 0, is_remote)


class VirtualTimeBus(can.BusABC):
    """A python-can bus on the virtual clock of its network.

    `recv` with a timeout lets the time of the network pass until a frame arrives or the timeout is
    over, so that a program with one thread works as it does on a real bus, and without waiting.

    A time stamp is that of the clock at the end of the frame. `add_listener` takes the place of
    ``can.Notifier``, whose thread would let the time pass by itself. Inside a listener, and in all
    other calls of the clock, the time stands still: only ``recv(timeout=0)`` is possible there.

    Args:
        network: the network that the bus joins.
        receive_own_messages: receive what this bus sends, as well.
        can_filters: see ``can.BusABC.set_filters``.

    >>> network = VirtualNetwork(VirtualClock(), bitrate=500_000)
    >>> with VirtualTimeBus(network) as sender, VirtualTimeBus(network) as receiver:
    ...     task = sender.send_periodic(can.Message(arbitration_id=1), 0.1)
    ...     stamps = [receiver.recv(timeout=1.0).timestamp for _ in range(3)]
    >>> [f"{stamp:.6f}" for stamp in stamps]
    ['0.000160', '0.100160', '0.200160']
    """

    def __init__(
        self,
        network: VirtualNetwork,
        *,
        receive_own_messages: bool = False,
        can_filters: can.typechecking.CanFilters | None = None,
    ) -> None:
        if not isinstance(network, VirtualNetwork):
            raise TypeError(f"network must be a VirtualNetwork, got {network!r}")
        self.network, self.clock = network, network.clock
        self.receive_own_messages = receive_own_messages
        #: Frames that wait for the wire, each with its time on it [ns].
        self.outgoing: deque[tuple[can.Message, int]] = deque()
        self.channel_info = "virtual time"
        self._can_protocol = can.CanProtocol.CAN_FD
        self._received: deque[can.Message] = deque()
        self._listeners: list[Callable[[can.Message], object]] = []
        super().__init__(channel="virtual time", can_filters=can_filters)
        network.join(self)

    def add_listener(self, listener: Callable[[can.Message], object]) -> None:
        """Call a listener with each frame when it arrives.

        A ``can.Listener`` is one, such as a ``can.Logger``. As with a ``can.Notifier``, `recv`
        then gets no frames.
        """
        self._listeners.append(listener)

    def remove_listener(self, listener: Callable[[can.Message], object]) -> None:
        """Remove a listener.

        Raises:
            ValueError: it is none of this bus.
        """
        self._listeners.remove(listener)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002 - of python-can
        """Send a frame; with a bit rate, it waits for the wire, and this call does not.

        Raises:
            can.CanOperationError: the bus is shut down.
            ValueError: with a bit rate, no frame has this length.
        """
        self._check_open()
        self.network.send(self, _copy(msg, msg.timestamp, is_rx=False))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Let the time pass until a frame arrives, and return it; None after ``timeout`` [s].

        Raises:
            can.CanOperationError: the bus is shut down; or there is no timeout, and no call of the
                clock is left that could send a frame.
            RuntimeError: with a timeout inside a call of the clock, see ``VirtualClock``.
        """
        self._check_open()
        received, clock = self._received, self.clock
        if received:
            return received.popleft()
        if timeout is not None and timeout <= 0 and clock.is_running:
            return None
        end_ns = None if timeout is None else clock.now_ns + to_ns(max(timeout, 0.0))
        while clock.step(end_ns):
            if received:
                return received.popleft()
        if end_ns is None:
            raise can.CanOperationError(
                "no frame can arrive any more: nothing is to be done on the virtual clock; "
                "give recv a timeout, or start what sends"
            )
        clock.run_until(end_ns)
        return None

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return self.recv(timeout), True

    def take(self, message: can.Message, *, is_rx: bool) -> None:
        """Receive a frame now; ``VirtualNetwork`` calls this."""
        if not self._matches_filters(message):
            return
        received = _copy(message, self.clock.now, is_rx=is_rx)
        if not self._listeners:
            self._received.append(received)
        for listener in tuple(self._listeners):
            listener(received)

    def _send_periodic_internal(
        self,
        msgs: Sequence[can.Message] | can.Message,
        period: float,
        duration: float | None = None,
        autostart: bool = True,
        modifier_callback: Callable[[can.Message], None] | None = None,
    ) -> CyclicSendTaskABC:
        task = VirtualCyclicTask(self, msgs, period, duration, modifier_callback)
        if autostart:
            task.start()
        return task

    def fileno(self) -> int:
        """Raise an error: nothing but the clock can say when to read.

        A ``can.Notifier`` asks for it when it is made, so that is refused before its thread runs.

        Raises:
            TypeError: always.
        """
        raise TypeError(
            "a can.Notifier cannot read a bus in virtual time: its thread would let the time pass "
            "by itself; call bus.add_listener(listener) instead, or recv in the thread of the test"
        )

    def flush_tx_buffer(self) -> None:
        """Discard the frames that wait for the wire."""
        self.outgoing.clear()

    def shutdown(self) -> None:
        """Leave the network; any number of times."""
        super().shutdown()
        self.outgoing.clear()
        self.network.leave(self)

    def _check_open(self) -> None:
        if self._is_shutdown:
            raise can.CanOperationError("the bus is shut down; make a new VirtualTimeBus")


class VirtualCyclicTask(
    can.LimitedDurationCyclicSendTaskABC,
    can.ModifiableCyclicTaskABC,
    can.RestartableCyclicTaskABC,
):
    """Periodic sending on a virtual clock, as ``can.BusABC.send_periodic`` returns it."""

    def __init__(
        self,
        bus: VirtualTimeBus,
        messages: Sequence[can.Message] | can.Message,
        period: float,
        duration: float | None,
        modifier: Callable[[can.Message], None] | None,
    ) -> None:
        super().__init__(messages, period, duration)
        if self.period_ns <= 0:
            raise ValueError(f"period must be 1 ns or more, got {period!r} s")
        self._bus, self._modifier = bus, modifier
        self._index = self._then_ns = 0
        self._end_ns: int | None = None
        self._next: TimerHandle | None = None

    def start(self) -> None:
        """Start, or start again; the first frame is sent now."""
        self.stop()
        self._then_ns = now_ns = self._bus.clock.now_ns
        self._index = 0
        self._end_ns = None if self.duration is None else now_ns + to_ns(self.duration)
        self._next = self._bus.clock.call_at(now_ns, self._send)

    def stop(self) -> None:
        """Stop; nothing is sent after this."""
        if self._next is not None:
            self._next.cancel()
            self._next = None

    def _send(self) -> None:
        message = self.messages[self._index]
        self._index = (self._index + 1) % len(self.messages)
        self._then_ns += self.period_ns
        is_last = self._end_ns is not None and self._then_ns >= self._end_ns
        self._next = None if is_last else self._bus.clock.call_at(self._then_ns, self._send)
        if self._modifier is not None:
            self._modifier(message)
        self._bus.send(message)


def _copy(message: can.Message, timestamp: float, *, is_rx: bool) -> can.Message:
    return can.Message(
        timestamp=timestamp,
        arbitration_id=message.arbitration_id,
        is_extended_id=message.is_extended_id,
        is_remote_frame=message.is_remote_frame,
        is_error_frame=message.is_error_frame,
        channel=message.channel,
        dlc=message.dlc,
        data=bytes(message.data),
        is_fd=message.is_fd,
        is_rx=is_rx,
        bitrate_switch=message.bitrate_switch,
        error_state_indicator=message.error_state_indicator,
        check=False,
    )
