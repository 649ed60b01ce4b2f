"""Inject faults into a python-can bus: a wrapper that is a bus itself."""

from __future__ import annotations

import copy
import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Any, NamedTuple

import can
from can.typechecking import CanFilters

from .fault_injector import FaultInjector
from .faults import Faults
from .scripted_fault import FaultKind

#: Most frames that `recv` reads after its timeout while all of them are lost or held back.
MAX_LATE_READS = 1000
#: A frame whose time stamp is older than this was stamped by another clock [s].
MAX_QUEUE_TIME = 10.0
#: Longest time for which one call of `pump` sends a flood [s].
MAX_PUMP_TIME = 0.1
#: Longest time after which `recv` looks for faults that were set [s].
MAX_WAIT = 0.1


class _BusFrame(NamedTuple):
    """Message of python-can in the form of ``FrameLike``."""

    can_id: int
    data: bytes
    is_fd: bool
    is_extended: bool
    message: can.Message | None = None  #: the original; None if it is of a flood
    at: float = 0.0  #: when the message was taken [s]


class FaultyBus(can.BusABC):
    """A python-can bus that loses, duplicates, delays, reorders, damages and floods frames.

    It wraps another bus, of any interface, and injects faults into the frames that are sent and
    received through it.  Error and remote frames pass unchanged.
    A delayed frame has a delayed time stamp.  The delay of a received frame starts at its time
    stamp if that is from the system's clock and at most ten seconds old. Otherwise, and
    if ``clock`` is given, it starts when `recv` reads the frame from the wrapped bus.

    Delays and floods of sent frames are sent by a thread of this bus or, if ``clock`` is given,
    by `pump`.  `shutdown` sends the frames that are still held back.  Filters of CAN IDs are
    applied before the faults, and again after them.

    The faults may be set at any time, by any thread, and None clears them::

        bus.faults = "loss=1"  # from the next frame on
        bus.faults = None

    Frames that are held back remain so until they are due. Intervals (``loss=1@2.0-2.6``) count
    from the time at which the faults were set; those of the constructor, from its call.

    Args:
        bus: the bus to wrap; it is shut down with this one.
        faults: the faults, or their text for ``Faults.parse``.
        clock: a monotonic clock [s]; None for the system's.
        previous: a bus that was lost, whose faults, random numbers, intervals and counters this one
            continues.
        on_sent: called with each data frame that was handed to the wrapped bus, such as to log it.

    Raises:
        ValueError: the text of the faults is wrong.
        TypeError: ``bus`` or ``faults`` has a wrong type.

    >>> import can
    >>> faults = "loss=0.5,seed=1"
    >>> with (
    ...     can.Bus(interface="virtual", channel="doc-faults") as sender,
    ...     FaultyBus(can.Bus(interface="virtual", channel="doc-faults"), faults) as bus,
    ... ):
    ...     for number in range(100):
    ...         sender.send(can.Message(arbitration_id=number, is_extended_id=False))
    ...     received = [message for message in iter(lambda: bus.recv(0), None)]
    >>> len(received), bus.counts[FaultKind.LOST]
    (44, 56)
    """

    def __init__(
        self,
        bus: can.BusABC,
        faults: Faults | str,
        *,
        clock: Callable[[], float] | None = None,
        previous: FaultyBus | None = None,
        on_sent: Callable[[Any], None] | None = None,
    ) -> None:
        if not isinstance(bus, can.BusABC):
            raise TypeError(f"bus must be a python-can bus, got {bus!r}")
        faults = parsed(faults)
        self.bus = bus
        self._clock, self._on_sent = clock or time.monotonic, on_sent
        self._own_thread = clock is None
        #: Injectors of the two directions; None if the direction never had faults.
        self.sending: FaultInjector[_BusFrame] | None = None
        self.receiving: FaultInjector[_BusFrame] | None = None
        self.unsent = 0  #: frames that the wrapped bus refused, or that were given up
        self._changed = threading.Condition()  # guards the sending
        self._taking = threading.Lock()  # guards the injector of the receiving
        self._outgoing: deque[_BusFrame] = deque()
        self._unfinished: can.Message | None = None
        self._thread: threading.Thread | None = None
        self._closing = False
        self._incoming: deque[can.Message] = deque()
        self._epoch = time.time() - self._clock()  # time stamp minus clock
        super().__init__(channel=bus.channel_info, can_filters=bus.filters)
        self.channel_info = f"{bus.channel_info} with faults"
        if previous is None:
            self.faults = faults
        else:
            self._faults, self.unsent = previous.faults, previous.unsent
            self.sending, self.receiving = previous.sending, previous.receiving
            self._begin()

    @property
    def faults(self) -> Faults:
        """The faults that are injected; see the class."""
        return self._faults

    @faults.setter
    def faults(self, faults: Faults | str | None) -> None:
        self._faults, now = parsed(Faults() if faults is None else faults), self._clock()
        with self._changed:
            self.sending = self._renewed(self.sending, "send", now)
        with self._taking:
            self.receiving = self._renewed(self.receiving, "receive", now)
        self._begin()

    def _renewed(
        self, injector: FaultInjector[_BusFrame] | None, direction: str, now: float
    ) -> FaultInjector[_BusFrame] | None:
        """Return the injector with the faults, a new one if there was none, or None."""
        faults = self._faults if self._faults.direction in ("both", direction) else Faults()
        if injector is not None:
            injector.faults = faults
        elif faults is self._faults:
            injector = FaultInjector(faults, stream=direction, make_frame=_BusFrame)
        if injector is not None:
            injector.start(now)
        return injector

    def _begin(self) -> None:
        """Send what is due, such as a flood, before the first frame."""
        with self._changed:
            if self._own_thread and self.sending is not None and self.sending.next_due < math.inf:
                self._start_thread()

    @property
    def counts(self) -> Counter[FaultKind]:
        """Faults injected so far, in both directions."""
        return sum((i.counts for i in (self.sending, self.receiving) if i), Counter())

    def as_dict(self) -> dict[str, int]:
        """Return the sums of all counters over both directions, for JSON."""
        total: Counter[str] = Counter()
        for injector in (self.sending, self.receiving):
            total.update(injector.as_dict() if injector else {})
        return {**total, "unsent": self.unsent}

    # ---- sending -------------------------------------------------------------------

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send the frames that a message becomes.

        Raises:
            can.CanError: from the wrapped bus.  If the same message is then sent again, no
                new faults are drawn, and sending continues with the frame that failed.
        """
        if self.sending is None or msg.is_error_frame or msg.is_remote_frame:
            self.bus.send(msg, timeout)
            if self._on_sent is not None and not (msg.is_error_frame or msg.is_remote_frame):
                self._on_sent(_bus_frame(msg, 0.0))
            return
        with self._changed:
            now = self._clock()
            if msg is not self._unfinished:  # otherwise it is a retry, the queue was full
                self.unsent += len(self._outgoing)
                self._outgoing = deque(self.sending.apply(_bus_frame(msg, now), now))
                self._unfinished = msg
            while self._outgoing:
                self._send_frame(self._outgoing[0], now, timeout)
                self._outgoing.popleft()
            self._unfinished = None
            if self._own_thread and self.sending.next_due < math.inf:
                self._start_thread()

    def pump(self) -> None:
        """Send the frames that are due by now; only needed if ``clock`` was given.

        If a flood is faster than the bus, sending stops after a tenth of a second of that clock.
        """
        now = self._clock()
        while self._send_due(now) and self._clock() - now < MAX_PUMP_TIME:
            pass

    def _send_due(self, now: float) -> bool:
        """Send a batch of the frames that are due by now; return whether there are more."""
        with self._changed:
            if self.sending is None or self._closing:
                return False
            self._send_or_count(self.sending.due(now), now)
            return self.sending.next_due <= now

    def _send_frame(self, frame: _BusFrame, now: float, timeout: float | None) -> None:
        try:
            self.bus.send(self._message(frame, now), timeout)
            if self._on_sent is not None:
                self._on_sent(frame)
        except (can.CanError, OSError):
            if frame.message is not None:
                raise
            self.unsent += 1  # the caller cannot retry a frame of the flood

    def _send_or_count(self, frames: list[_BusFrame], now: float) -> None:
        for frame in frames:
            try:
                self._send_frame(frame, now, 0.01)
            except (can.CanError, OSError, ValueError):
                self.unsent += 1

    def _start_thread(self) -> None:
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="faulty bus", daemon=True)
            self._thread.start()
        self._changed.notify_all()

    def _run(self) -> None:
        with self._changed:
            while not self._closing and self.sending is not None:
                start = self._clock()
                self._send_due(start)
                end = self._clock()
                # Even if the flood is too fast, other threads get the lock half of the time.
                wait = max(self.sending.next_due - end, end - start)
                self._changed.wait(min(wait, threading.TIMEOUT_MAX))

    # ---- receiving -----------------------------------------------------------------

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if self.receiving is None:  # there may be faults soon
            return self.bus.recv(MAX_WAIT if timeout is None else min(timeout, MAX_WAIT)), True
        end = math.inf if timeout is None else time.monotonic() + timeout
        late_reads = 0  # after a lost frame there may be others in the queue
        while not self._incoming and late_reads < MAX_LATE_READS:
            left = end - time.monotonic()
            late_reads += left <= 0
            wait = min(self.receiving.next_due - self._clock(), left, MAX_WAIT)
            message = self.bus.recv(max(0.0, wait))
            now = self._clock()
            if message is None:
                with self._taking:
                    self._take(self.receiving.due(now), now)
                break
            if message.is_error_frame or message.is_remote_frame:
                return message, True
            arrived = now - self._queue_time(message)
            self._epoch = message.timestamp - arrived
            with self._taking:
                self._take(self.receiving.apply(_bus_frame(message, arrived), arrived), arrived)
        return (self._incoming.popleft() if self._incoming else None), True

    def _queue_time(self, message: can.Message) -> float:
        """Return how long a message waited in the receive queue [s]; 0 if it is unknown."""
        waited = time.time() - message.timestamp if self._own_thread else 0.0
        return waited if 0 < waited <= MAX_QUEUE_TIME else 0.0

    def _take(self, frames: list[_BusFrame], now: float) -> None:
        messages = (self._message(frame, now) for frame in frames)
        # Filter again: faults may have changed the ID, and a flood passed no filter.
        self._incoming.extend(filter(self._matches_filters, messages))

    def _message(self, frame: _BusFrame, now: float) -> can.Message:
        if frame.message is None:
            message = can.Message(timestamp=now + self._epoch, check=False)
        else:
            message = copy.copy(frame.message)
            message.timestamp += now - frame.at
        message.arbitration_id, message.is_extended_id = frame.can_id, frame.is_extended
        message.data, message.dlc = bytearray(frame.data), len(frame.data)
        return message

    # ---- the wrapped bus -------------------------------------------------------------

    def shutdown(self) -> None:
        """Send the frames that are held back and shut down the wrapped bus; any number of times."""
        if self._is_shutdown:
            return
        super().shutdown()
        with self._changed:
            self._closing = True
            self._changed.notify_all()
            if self.sending is not None:
                self._send_or_count(self.sending.flush(), self._clock())
        if self._thread is not None:
            self._thread.join()
        self.bus.shutdown()

    def _apply_filters(self, filters: CanFilters | None) -> None:
        self.bus.set_filters(filters)

    def flush_tx_buffer(self) -> None:
        """Flush the transmit buffer of the wrapped bus."""
        self.bus.flush_tx_buffer()

    def fileno(self) -> int:
        """Return the file descriptor of the wrapped bus.

        Raises:
            NotImplementedError: received frames get faults, so that a readable descriptor would
                not mean that there is a frame.
        """
        descriptor = self.bus.fileno()  # raises for a bus in virtual time
        if self.receiving is not None:
            raise NotImplementedError("a bus that holds back frames has no file descriptor")
        return descriptor

    @property
    def protocol(self) -> can.CanProtocol:
        """Protocol of the wrapped bus."""
        return self.bus.protocol

    @property
    def state(self) -> can.BusState:
        """State of the wrapped bus."""
        return self.bus.state

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        self.bus.state = new_state


def parsed(faults: Faults | str) -> Faults:
    """Return faults; a text is read as that of ``--faults``."""
    if isinstance(faults, str):
        return Faults.parse(faults)
    if not isinstance(faults, Faults):
        raise TypeError(f"faults must be Faults or a text such as 'loss=0.1', got {faults!r}")
    return faults


def _bus_frame(message: can.Message, now: float) -> _BusFrame:
    return _BusFrame(
        message.arbitration_id,
        bytes(message.data),
        message.is_fd,
        message.is_extended_id,
        message,
        now,
    )
