"""Fault injection as a bus: wraps any python-can bus, and is one."""

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
from .faults import FaultKind, Faults

__all__ = ["FaultyBus", "FaultyOpener"]

#: Frames that come to nothing for which `recv` goes on though its time is over.
PATIENCE = 1000
#: A frame whose time stamp is older was stamped by another clock [s].
LONGEST_WAIT = 10.0
#: Longest that `pump` sends a flood that is faster than it [s].
LONGEST_PUMP = 0.1


class _Carried(NamedTuple):
    """A message as `FaultInjector` sees it."""

    can_id: int
    data: bytes
    is_fd: bool
    is_extended: bool
    message: can.Message | None = None  #: as it came; None of a flood
    at: float = 0.0  #: when it came [s]


class FaultyBus(can.BusABC):
    """A python-can bus that loses, repeats, delays, reorders, damages and floods frames.

    It wraps another bus, of any interface, and does to the frames that are sent and
    received through it what the faults say.  Error and remote frames pass as they are.
    What is delayed has the later time stamp.  What is received is delayed from its time
    stamp on, if that is of the system's clock and at most ten seconds ago; if not, and
    with a clock of one's own, from the moment when `recv` comes upon it.

    Delays and floods of what is sent need something that sends: a thread, or with
    a clock of one's own the calls of `pump`.  At the end (`shutdown`) what is still
    held back is sent.  Filters of CAN IDs work before the faults, and again after them.

    Args:
        bus: is shut down with this one.
        faults: which; or their text, as of ``Faults.parse``.
        clock: a clock that is never set back [s]; by default the system's.
        previous: a bus that was lost; its random numbers and counts go on.

    Raises:
        ValueError: the text is wrong.
        TypeError: the bus or the faults are none.

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
    ) -> None:
        if isinstance(faults, str):
            faults = Faults.parse(faults)
        if not isinstance(bus, can.BusABC):
            raise TypeError(f"bus must be a python-can bus, got {bus!r}")
        if not isinstance(faults, Faults):
            raise TypeError(f"faults must be Faults or a text such as 'loss=0.1', got {faults!r}")
        self.bus, self.faults = bus, faults
        self._clock = clock or time.monotonic
        self._own_thread = clock is None
        #: What happens to what is sent and received; None: nothing.
        self.sending, self.receiving = _injector(faults, "send"), _injector(faults, "receive")
        self.unsent = 0  #: frames that the interface would not take, or that came too late
        if previous is not None:
            self.sending, self.receiving = previous.sending, previous.receiving
            self.unsent = previous.unsent
        self._changed = threading.Condition()  # guards the sending
        self._outgoing: deque[_Carried] = deque()
        self._unfinished: can.Message | None = None
        self._thread: threading.Thread | None = None
        self._closing = False
        self._incoming: deque[can.Message] = deque()
        self._epoch = time.time() - self._clock()  # from the clock to time stamps
        super().__init__(channel=bus.channel_info, can_filters=bus.filters)
        self.channel_info = f"{bus.channel_info} with faults"
        if faults.flood:  # it does not wait for the first frame
            for injector in filter(None, () if previous else (self.sending, self.receiving)):
                injector.due(self._clock())
            if self._own_thread and self.sending is not None:
                with self._changed:
                    self._start_thread()

    @property
    def counts(self) -> Counter[FaultKind]:
        """What was done so far, in both directions."""
        return sum((m.counts for m in (self.sending, self.receiving) if m), Counter())

    def as_dict(self) -> dict[str, int]:
        """All counters of both directions, for machines."""
        total: Counter[str] = Counter()
        for injector in (self.sending, self.receiving):
            total.update(injector.as_dict() if injector else {})
        return {**total, "unsent": self.unsent}

    # ---- sending -------------------------------------------------------------------

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send what becomes of a message.

        Raises:
            can.CanError: as of the wrapped bus.  Who then sends the same message again
                goes on where it stopped.
        """
        if self.sending is None or msg.is_error_frame or msg.is_remote_frame:
            self.bus.send(msg, timeout)
            return
        with self._changed:
            now = self._clock()
            if msg is not self._unfinished:  # else its fate is decided: the queue was full
                self.unsent += len(self._outgoing)
                self._outgoing = deque(self.sending.apply(_carried(msg, now), now))
                self._unfinished = msg
            while self._outgoing:
                self._hand_over(self._outgoing[0], now, timeout)
                self._outgoing.popleft()
            self._unfinished = None
            if self._own_thread and self.sending.next_due < math.inf:
                self._start_thread()

    def pump(self) -> None:
        """Send what is due by now; only with a clock of one's own is there any need to.

        Of a flood that is too fast, what can be sent in a tenth of a second of that clock.
        """
        now = self._clock()
        while self._send_due(now) and self._clock() - now < LONGEST_PUMP:
            pass

    def _send_due(self, now: float) -> bool:
        """Send a batch of what is due by now; whether there is more."""
        with self._changed:
            if self.sending is None or self._closing:
                return False
            self._send_or_count(self.sending.due(now), now)
            return self.sending.next_due <= now

    def _hand_over(self, frame: _Carried, now: float, timeout: float | None) -> None:
        try:
            self.bus.send(self._message(frame, now), timeout)
        except (can.CanError, OSError):
            if frame.message is not None:
                raise
            self.unsent += 1  # a flood is nobody's to try again

    def _send_or_count(self, frames: list[_Carried], now: float) -> None:
        for frame in frames:
            try:
                self._hand_over(frame, now, 0.01)
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
                # A flood that is too fast leaves half of the time to those who wait for the lock.
                wait = max(self.sending.next_due - end, end - start)
                self._changed.wait(min(wait, threading.TIMEOUT_MAX))

    # ---- receiving -----------------------------------------------------------------

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if self.receiving is None:
            return self.bus.recv(timeout), True
        end = math.inf if timeout is None else time.monotonic() + timeout
        patience = PATIENCE  # a frame that is lost does not mean that no more are there
        while not self._incoming and patience:
            left = end - time.monotonic()
            patience -= left <= 0
            wait = min(self.receiving.next_due - self._clock(), left)
            message = self.bus.recv(None if wait == math.inf else max(0.0, wait))
            now = self._clock()
            if message is None:
                self._take(self.receiving.due(now), now)
                break
            if message.is_error_frame or message.is_remote_frame:
                return message, True
            came = now - self._waited(message)
            self._epoch = message.timestamp - came
            self._take(self.receiving.apply(_carried(message, came), came), came)
        return (self._incoming.popleft() if self._incoming else None), True

    def _waited(self, message: can.Message) -> float:
        """How long a message was in the queue of the interface, where that can be told [s]."""
        waited = time.time() - message.timestamp if self._own_thread else 0.0
        return waited if 0 < waited <= LONGEST_WAIT else 0.0

    def _take(self, frames: list[_Carried], now: float) -> None:
        messages = (self._message(frame, now) for frame in frames)
        # The ID may not be the one that passed the filter of the wrapped bus.
        self._incoming.extend(filter(self._matches_filters, messages))

    def _message(self, frame: _Carried, now: float) -> can.Message:
        if frame.message is None:
            message = can.Message(timestamp=now + self._epoch, check=False)
        else:
            message = copy.copy(frame.message)
            message.timestamp += now - frame.at
        message.arbitration_id, message.is_extended_id = frame.can_id, frame.is_extended
        message.data, message.dlc = bytearray(frame.data), len(frame.data)
        return message

    # ---- what the wrapped bus is -----------------------------------------------------

    def shutdown(self) -> None:
        """Send what is held back, and shut down the wrapped bus; any number of times."""
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
        """As of the wrapped bus."""
        self.bus.flush_tx_buffer()

    def fileno(self) -> int:
        """As of the wrapped bus, where what can be read there is what comes.

        Raises:
            NotImplementedError: frames that are received may be held back here.
        """
        if self.receiving is not None:
            raise NotImplementedError("a bus that holds back frames has no file descriptor")
        return self.bus.fileno()

    @property
    def protocol(self) -> can.CanProtocol:
        """As of the wrapped bus."""
        return self.bus.protocol

    @property
    def state(self) -> can.BusState:
        """As of the wrapped bus."""
        return self.bus.state

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        self.bus.state = new_state


class FaultyOpener:
    """Opener of faulty buses for ``Link``: random numbers and counts continue after an outage.

    Args:
        faults: see ``FaultyBus``.
        opener: of the wrapped bus, called with the settings of the link.
        clock: see ``FaultyBus``.

    >>> from maplines_can import Link
    >>> opener = FaultyOpener("loss=1,direction=send")
    >>> with Link(opener, interface="virtual", channel="doc-opener") as link:
    ...     _ = link.send(can.Message(arbitration_id=1))
    >>> opener.as_dict()["lost"]
    1
    """

    def __init__(
        self,
        faults: Faults | str,
        opener: Callable[..., can.BusABC] = can.Bus,
        *,
        clock: Callable[[], float] | None = None,
    ) -> None:
        self._faults, self._opener, self._clock = faults, opener, clock
        self._bus: FaultyBus | None = None

    def __call__(self, **settings: Any) -> FaultyBus:
        bus = self._opener(**settings)
        self._bus = FaultyBus(bus, self._faults, clock=self._clock, previous=self._bus)
        return self._bus

    def as_dict(self) -> dict[str, int]:
        """Return all counters so far; see ``FaultyBus.as_dict``."""
        return {} if self._bus is None else self._bus.as_dict()


def _injector(faults: Faults, way: str) -> FaultInjector[_Carried] | None:
    if faults.direction not in ("both", way):
        return None
    return FaultInjector(faults, stream=way, frame=_Carried)


def _carried(message: can.Message, now: float) -> _Carried:
    return _Carried(
        message.arbitration_id,
        bytes(message.data),
        message.is_fd,
        message.is_extended_id,
        message,
        now,
    )
