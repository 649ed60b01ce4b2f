"""A CAN interface that reconnects by itself after an outage."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterable
from enum import Enum
from typing import TYPE_CHECKING, Any, Self
from weakref import WeakKeyDictionary

from ..values.errors import BusError
from .background import ForkSafeCondition
from .bus_factory import (
    BusFactory,
    DriverError,
    UnsuitableInterfaceError,
    can_error,
    classify_error,
    error_text,
)

if TYPE_CHECKING:
    import can
    from can.typechecking import CanFilter

log = logging.getLogger("maplines_can.bus")

#: Locks for sending on open buses that callers passed, since several links may share one.
_send_locks: WeakKeyDictionary[can.BusABC, ForkSafeCondition] = WeakKeyDictionary()


class Sent(Enum):
    """Result of sending a frame."""

    OK = "handed to the interface"
    FULL = "not sent: the transmit queue is full, try again"
    DOWN = "not sent: the interface is gone; the link tries to reopen it"


class Link:
    """Open CAN interface that is reopened after an outage.

    An outage (the interface is set down, deleted or unplugged) and the reconnect after it are
    each reported once: by a warning of the logger ``maplines_can.bus``, a call of
    ``on_event``, the property ``up`` and the counter ``outages``.  An interface that returns
    without a feature it had, such as CAN FD, is also reported once.  Attempts to reopen
    happen inside `send` and `recv`: a link has no thread of its own.

    Any number of threads may send and one may receive, at the same time.

    ``Link(bus)`` makes a link of an open bus. The bus remains the caller's: the link never shuts it
    down and does not reopen it. After an outage it tries the same bus again, which helps if a
    SocketCAN interface was down, but not if it was deleted. Links that share a bus send one at a
    time. If other code sends on it from another thread, use ``can.ThreadSafeBus``.

    Args:
        opener: bus factory; called with the settings if there are any, and again after each
            outage. By default ``can.Bus``; ``testing.FaultyOpener`` injects faults. An open bus is
            also accepted.
        on_event: called with (up, text) by the thread that noticed the event.
        backoff: shortest and longest pause between two attempts to reopen [s].
        clock: a monotonic clock [s].
        settings: of ``can.Bus`` (interface, channel, bitrate, fd, config_context, ...). Settings
            that are missing or None are read from python-can's environment variables and
            configuration files.

    Raises:
        BusError: the interface cannot be opened now, or a setting is wrong.
            The first opening is not retried: its failure is most often a mistake.
        TypeError: ``opener`` is neither a function nor a bus, or an open bus has settings.

    >>> import can
    >>> with Link(interface="virtual", channel="doc") as link:
    ...     link.name, link.up, link.send(can.Message(arbitration_id=1)).name
    ('virtual doc', True, 'OK')
    >>> Link(interface="socketcan", channel="nocan0")
    Traceback (most recent call last):
    ...
    maplines_can.values.errors.BusError: socketcan nocan0 cannot be opened: there is no such \
interface; 'ip -br link' lists those that are
    """

    #: How long a driver may fail without an error number before the interface counts as lost [s].
    UNCLEAR_TIMEOUT = 1.0

    def __init__(
        self,
        opener: Callable[..., can.BusABC] | can.BusABC | None = None,
        /,
        *,
        on_event: Callable[[bool, str], None] | None = None,
        backoff: tuple[float, float] = (0.1, 1.0),
        clock: Callable[[], float] = time.monotonic,
        **settings: Any,
    ) -> None:
        self._factory = BusFactory(opener, settings)
        self._on_event, self._backoff, self._clock = on_event, backoff, clock
        self._lock = ForkSafeCondition()  # guards the state below
        self._closed = False
        self._filters: list[CanFilter] | None = None
        self._unclear_since: dict[str, float] = {}  # of "send" and "recv"
        self._retry_at, self._pause, self._lost_at = 0.0, backoff[0], 0.0
        self._check_at = clock()
        self._unsuitable: str | None = None  # the last reason that was reported
        #: Whether the interface works: True after opening or a reconnect, until the next outage.
        self.up = True
        #: How many times the interface was lost.
        self.outages = 0
        self._bus: can.BusABC | None = self._factory.open(self._filters)
        # python-can's buses are not safe for threads.
        self._send_lock = (
            _send_locks.setdefault(self._bus, ForkSafeCondition())
            if self._factory.is_given
            else ForkSafeCondition()
        )

    @property
    def name(self) -> str:
        """Interface and channel, for messages."""
        return self._factory.name

    @property
    def fd(self) -> bool:
        """Whether CAN FD frames can be sent."""
        return self._factory.fd

    @property
    def carries_fd(self) -> bool:
        """Whether it is open for CAN FD; `fd` is also true of a virtual bus that is not."""
        return self._factory.is_open_for_fd

    def send(self, message: can.Message) -> Sent:
        """Hand one frame to the interface, without waiting.

        Raises:
            BusError: the link is closed, or the interface can never send such a frame.
        """
        return self.send_all((message,))[0]

    def send_all(self, messages: Iterable[can.Message]) -> tuple[Sent, int]:
        """Hand frames to the interface, back to back and without waiting, until one is not taken.

        Returns:
            The result of the last frame that was tried, and how many were handed over.

        Raises:
            BusError: as `send`.
        """
        bus = self._ready()
        if bus is None:
            return Sent.DOWN, 0
        # For most drivers None means "do not wait"; the virtual bus would wait for ever.
        timeout = 0.01 if self._factory.is_virtual else None
        sent = 0
        try:
            with self._send_lock:
                for message in messages:
                    bus.send(message, timeout=timeout)
                    sent += 1
        except (can_error(), OSError, ValueError) as error:
            if sent:
                self._worked(bus, "send")
            return self._failed(bus, error, "send"), sent
        self._worked(bus, "send")
        return Sent.OK, sent

    def recv(self, timeout: float) -> can.Message | None:
        """Return the next frame; None after ``timeout`` [s], or sooner during an outage.

        Raises:
            BusError: the link is closed.
        """
        bus = self._ready()
        if bus is None:
            self._pause_for(min(timeout, max(self._retry_at - self._clock(), 0.001)))
            return None
        try:
            message = bus.recv(timeout)
        except (can_error(), OSError, ValueError) as error:
            self._failed(bus, error, "recv")
            self._pause_for(0.001)  # limits the CPU load if the driver fails immediately
            return None
        self._worked(bus, "recv")
        if message is None:
            self._check_deleted(bus)
        return message

    def accept_only(self, can_ids: Iterable[int] | None) -> None:
        """Receive only frames of these CAN IDs; None for all frames.

        The kernel or the hardware filters if the driver supports it, otherwise python-can, which
        then also drops error frames. Each ID passes as an 11-bit and as a 29-bit identifier.
        If the driver fails to set the filters, the interface counts as lost.
        """
        ids = sorted(can_ids or ())
        filters: list[CanFilter] = [{"can_id": i, "can_mask": 0x1FFFFFFF} for i in ids]
        with self._lock:
            self._filters = filters or None
            bus = self._bus
        if bus is None:  # the filters are set when it is reopened
            return
        try:
            bus.set_filters(filters or None)
        except (can_error(), OSError, ValueError) as error:
            self._mark_lost(bus, f"its filters cannot be set: {error_text(error)}")

    def close(self) -> None:
        """Close the interface; from any thread, any number of times."""
        with self._lock:
            self._closed = True
            self._lock.notify_all()
            bus, self._bus, self.up = self._bus, None, False
        if bus is not None:
            self._factory.close(bus)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    # ---- outage and reconnect ----------------------------------------------------

    def _ready(self) -> can.BusABC | None:
        """Return the open bus; None if it is lost and cannot be reopened yet."""
        bus = self._bus
        if bus is not None:
            return bus
        report = None
        with self._lock:
            if self._closed:
                raise BusError(f"{self.name} is closed; stop its users before its link")
            if self._bus is None and self._clock() >= self._retry_at:
                try:
                    self._bus = self._factory.open(self._filters)
                except UnsuitableInterfaceError as error:
                    self._back_off()
                    if str(error) != self._unsuitable:
                        report = self._unsuitable = str(error)
                except BusError:
                    self._back_off()
            bus = self._bus
        if report:
            self._report(False, report)
        return bus

    def _worked(self, bus: can.BusABC, way: str) -> None:
        """Note a successful send or recv: only this shows that a reopened interface works."""
        if self.up and not self._unclear_since:
            return  # without the lock: nearly always
        self._unclear_since.pop(way, None)
        with self._lock:
            if self.up or bus is not self._bus:
                return
            self.up, self._pause, self._unsuitable = True, self._backoff[0], None
            text = f"{self.name} is back after {self._clock() - self._lost_at:.1f} s"
        self._report(True, text)

    def _failed(self, bus: can.BusABC, error: Exception, way: str) -> Sent:
        with self._lock:
            if bus is not self._bus:
                return Sent.DOWN  # another thread has handled this loss
            if way == "send" and isinstance(error, ValueError) and not isinstance(error, OSError):
                raise error  # the message itself is wrong: the caller's mistake
            kind = classify_error(error)
            if kind is DriverError.REFUSED and way == "send":
                raise BusError(
                    f"{self.name} refuses the frame: {error_text(error)}; a CAN FD frame needs an "
                    "interface with CAN FD that is opened with fd=True"
                ) from error
            # With SocketCAN, python-can raises an error without errno only for "Transmit buffer
            # full" (e.g. no node acknowledges).
            is_socketcan = self._factory.is_socketcan
            no_ack = kind is DriverError.UNCLEAR and is_socketcan and way == "send"
            if kind is DriverError.FULL or no_ack:
                return Sent.FULL
            if kind is not DriverError.LOST:
                since = self._unclear_since.setdefault(way, self._clock())
                if self._clock() - since < self.UNCLEAR_TIMEOUT:
                    return Sent.FULL
        self._mark_lost(bus, error_text(error))
        return Sent.DOWN

    def _mark_lost(self, bus: can.BusABC, reason: str) -> None:
        with self._lock:
            if bus is not self._bus:
                return
            self._bus = None
            self._unclear_since.clear()
            was_up, self.up = self.up, False
            self._back_off()
            if was_up:
                self.outages += 1
                self._lost_at = self._clock()
        with contextlib.suppress(can_error(), OSError):  # closing a lost interface may fail, too
            self._factory.close(bus)
        if was_up:
            self._report(False, f"{self.name} is lost ({reason}); {self._outlook}")

    @property
    def _outlook(self) -> str:
        if self._factory.is_given:
            return "it is tried again, but not reopened, because the caller opened it"
        return "it is reopened as soon as it is back"

    def _pause_for(self, seconds: float) -> None:
        """Wait; return at once when the link is closed."""
        with self._lock:
            self._lock.wait_for(lambda: self._closed, seconds)

    def _check_deleted(self, bus: can.BusABC) -> None:
        """Check once a second whether the interface was deleted; if so, mark the bus as lost."""
        now = self._clock()
        if now >= self._check_at:
            self._check_at = now + 1.0
            if self._factory.is_deleted():
                self._mark_lost(bus, "it was deleted")

    def _back_off(self) -> None:
        self._retry_at = self._clock() + self._pause
        self._pause = min(2 * self._pause, self._backoff[1])

    def _report(self, up: bool, text: str) -> None:
        log.warning(text)
        if self._on_event:
            self._on_event(up, text)


def link_of(link: Link | can.BusABC) -> Link:
    """Return a link unchanged, or make a link of an open bus.

    Raises:
        TypeError: the argument is neither.
    """
    if isinstance(link, Link):
        return link
    import can

    if isinstance(link, can.BusABC):
        return Link(link)
    raise TypeError(
        "link must be a maplines_can.Link or an open python-can bus, such as can.Bus(...), "
        f"got {link!r}"
    )
