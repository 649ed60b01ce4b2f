"""A CAN interface that comes back by itself."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterable
from enum import Enum
from types import TracebackType
from typing import Any

import can
from can.typechecking import CanFilter

from ..errors import BusError
from .bus_factory import BusFactory, UnsuitableInterfaceError
from .driver_errors import Fault, classify_error, error_text

__all__ = ["Link", "Sent"]

log = logging.getLogger("maplines_can.bus")


class Sent(Enum):
    """What became of a frame."""

    OK = "handed to the interface"
    FULL = "not sent: the transmit queue is full, try again"
    DOWN = "not sent: the interface is gone, and looked for from time to time"


class Link:
    """An open CAN interface; if it goes away it is looked for until it is back.

    Losing it (set down, deleted, unplugged) and finding it again are each
    reported once: a warning of the logger ``maplines_can.bus``, a call of
    ``on_event``, the property ``up`` and the counter ``outages``; so is once, if it
    comes back as something else, such as without CAN FD.  Looking for it
    happens inside `send` and `recv`: a link has no thread of its own.

    Any number of threads may send and one may receive, at the same time.

    Args:
        opener: returns a new open bus; called again after each loss, with the settings if
            there are any. By default ``can.Bus``; ``testing.FaultyOpener`` injects faults.
        on_event: called with (up, what happened) by the thread that noticed.
        backoff: shortest and longest pause between two attempts to reopen [s].
        settings: of ``can.Bus`` (interface, channel, bitrate, fd, config_context, ...).  What is missing or None
            comes from python-can's environment variables and configuration files.

    Raises:
        BusError: the interface cannot be opened now, or a setting is wrong.
            The first opening is never tried again: it is most often a mistake.

    >>> with Link(interface="virtual", channel="doc") as link:
    ...     link.name, link.up, link.send(can.Message(arbitration_id=1)).name
    ('virtual doc', True, 'OK')
    >>> Link(interface="socketcan", channel="nocan0")
    Traceback (most recent call last):
    ...
    maplines_can.errors.BusError: socketcan nocan0 cannot be opened: there is no such interface; \
'ip -br link' lists those that are
    """

    #: How long a driver may fail without an error number before it counts as gone [s].
    PATIENCE = 1.0

    def __init__(
        self,
        opener: Callable[..., can.BusABC] | None = None,
        /,
        *,
        on_event: Callable[[bool, str], None] | None = None,
        backoff: tuple[float, float] = (0.1, 1.0),
        clock: Callable[[], float] = time.monotonic,
        **settings: Any,
    ) -> None:
        self._factory = BusFactory(opener, settings)
        self._on_event, self._backoff, self._clock = on_event, backoff, clock
        self._lock = threading.Lock()  # guards the state below
        self._send_lock = threading.Lock()  # python-can's buses are not safe for threads
        self._closed = threading.Event()
        self._filters: list[CanFilter] | None = None
        self._failing: dict[str, float] = {}  # since when send or recv fails for unclear reasons
        self._retry_at, self._pause, self._lost_at = 0.0, backoff[0], 0.0
        self._look_at = clock()
        self._unsuitable: str | None = None  # what it is since it came back, already told
        #: True from opening or return until the next loss.
        self.up = True
        #: How many times the interface was lost.
        self.outages = 0
        self._bus: can.BusABC | None = self._factory.open(self._filters)

    @property
    def name(self) -> str:
        """Interface and channel, for messages."""
        return self._factory.name

    @property
    def fd(self) -> bool:
        """Whether CAN FD frames can be sent."""
        return self._factory.fd

    def send(self, message: can.Message) -> Sent:
        """Hand one frame to the interface; answers at once, whatever became of it.

        Raises:
            BusError: the link is closed, or the interface can never send such a frame.
        """
        bus = self._ready()
        if bus is None:
            return Sent.DOWN
        # To most drivers None is "do not wait"; the virtual bus would wait for ever.
        timeout = 0.01 if self._factory.is_virtual else None
        try:
            with self._send_lock:
                bus.send(message, timeout=timeout)
        except (can.CanError, OSError, ValueError) as error:
            return self._failed(bus, error, "send")
        self._worked(bus, "send")
        return Sent.OK

    def recv(self, timeout: float) -> can.Message | None:
        """The next frame, or None after ``timeout`` [s] or sooner if the interface is gone.

        Raises:
            BusError: the link is closed.
        """
        bus = self._ready()
        if bus is None:
            self._closed.wait(min(timeout, max(self._retry_at - self._clock(), 0.001)))
            return None
        try:
            message = bus.recv(timeout)
        except (can.CanError, OSError, ValueError) as error:
            self._failed(bus, error, "recv")
            self._closed.wait(0.001)  # a driver that fails at once must not keep the CPU busy
            return None
        self._worked(bus, "recv")
        if message is None:
            self._look_after_silence(bus)
        return message

    def accept_only(self, can_ids: Iterable[int] | None) -> None:
        """Let the interface drop frames of other CAN IDs; None lets all through.

        In the kernel or the hardware where the driver can, else in python-can.
        A filter without "extended" matches both kinds of identifiers.
        """
        ids = sorted(can_ids or ())
        with self._lock:
            self._filters = [{"can_id": i, "can_mask": 0x1FFFFFFF} for i in ids] or None
            if self._bus is not None:
                self._bus.set_filters(self._filters)

    def close(self) -> None:
        """Close the interface; from any thread, any number of times."""
        with self._lock:
            self._closed.set()
            bus, self._bus, self.up = self._bus, None, False
        if bus is not None:
            bus.shutdown()

    def __enter__(self) -> Link:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    # ---- losing and finding ----------------------------------------------------

    def _ready(self) -> can.BusABC | None:
        """The open bus; None while it is lost and not yet due or able to be reopened."""
        bus = self._bus
        if bus is not None:
            return bus
        news = None
        with self._lock:
            if self._closed.is_set():
                raise BusError(f"{self.name} is closed; stop its users before its link")
            if self._bus is None and self._clock() >= self._retry_at:
                try:
                    self._bus = self._factory.open(self._filters)
                except BusError as error:
                    self._postpone()
                    if (
                        isinstance(error, UnsuitableInterfaceError)
                        and str(error) != self._unsuitable
                    ):
                        news = self._unsuitable = str(error)
            bus = self._bus
        if news:
            self._report(False, news)
        return bus

    def _worked(self, bus: can.BusABC, way: str) -> None:
        """A send or recv went well: the proof that a reopened interface is really back."""
        if self._failing:
            self._failing.pop(way, None)
        if self.up:
            return
        with self._lock:
            if self.up or bus is not self._bus:
                return
            self.up, self._pause, self._unsuitable = True, self._backoff[0], None
            text = f"{self.name} is back after {self._clock() - self._lost_at:.1f} s"
        self._report(True, text)

    def _failed(self, bus: can.BusABC, error: Exception, way: str) -> Sent:
        with self._lock:
            if bus is not self._bus:
                return Sent.DOWN  # an echo of what another thread has already dealt with
            if isinstance(error, ValueError) and not isinstance(error, OSError):
                raise error  # the message itself is wrong: the caller's mistake
            fault = classify_error(error)
            if fault is Fault.REFUSED and way == "send":
                raise BusError(
                    f"{self.name} refuses the frame: {error_text(error)}; a CAN FD frame needs an "
                    "interface with CAN FD that is opened with fd=True"
                ) from error
            # The kernel names every loss by its number; what python-can says
            # without one is "Transmit buffer full", for as long as nobody acknowledges.
            silent = fault is Fault.UNCLEAR and self._factory.is_socketcan
            if fault is Fault.FULL or silent:
                return Sent.FULL
            if fault is not Fault.LOST:
                since = self._failing.setdefault(way, self._clock())
                if self._clock() - since < self.PATIENCE:
                    return Sent.FULL
        self._lose(bus, error_text(error))
        return Sent.DOWN

    def _lose(self, bus: can.BusABC, reason: str) -> None:
        with self._lock:
            if bus is not self._bus:
                return
            self._bus = None
            self._failing.clear()
            news, self.up = self.up, False
            self._postpone()
            if news:
                self.outages += 1
                self._lost_at = self._clock()
        with contextlib.suppress(can.CanError, OSError):  # it may be too dead to be closed
            bus.shutdown()
        if news:
            self._report(False, f"{self.name} is lost ({reason}); looking for it until it is back")

    def _look_after_silence(self, bus: can.BusABC) -> None:
        """A socket of a deleted interface is silent for ever: see `socketcan`."""
        now = self._clock()
        if now >= self._look_at:
            self._look_at = now + 1.0
            if self._factory.deleted():
                self._lose(bus, "it was deleted")

    def _postpone(self) -> None:
        self._retry_at = self._clock() + self._pause
        self._pause = min(2 * self._pause, self._backoff[1])

    def _report(self, up: bool, text: str) -> None:
        log.warning(text)
        if self._on_event:
            self._on_event(up, text)
