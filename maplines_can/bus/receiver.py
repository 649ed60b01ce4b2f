"""Receive lines from a link: whole lines come out, everything else is counted."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Collection, Iterator
from typing import NamedTuple, Self

from ..line import MapLine, Slot
from ..wire import Decoder, Monitor, Reason, SlotStats, SlotView
from ..wire.reception.monitor import STALE_CYCLES
from .background import BackgroundThread
from .link import Link
from .stamp_clock import StampClock

#: How long the thread waits for a frame before it checks whether it shall stop [s].
POLL = 0.1


class ReceiverStats(NamedTuple):
    """Counters of a receiver."""

    lines: int  #: complete lines received
    lost: int  #: lines that are missing according to the sender's counters
    frames: int  #: data frames given to the decoder
    error_frames: int  #: error frames of the bus, not given to the decoder
    remote_frames: int  #: remote frames, not given to the decoder
    overflowed: int  #: lines dropped from the full queue, oldest first
    counts: dict[Reason, int]  #: frames by the decoder's reason
    pending: int = 0  #: frames held for lines that are not complete


class Receiver(BackgroundThread):
    """Thread that turns the frames of a link into lines.

    Lines go to the callback ``on_line`` if there is one. Otherwise they wait for
    `get` or for iteration (``for line in receiver``, which ends after `stop`). Lines that wait
    when the receiver stops can still be fetched. The newest ``queue_size`` lines wait. Older
    ones are dropped and counted as overflowed, because a stale line is of no use.

    A control loop needs neither callback nor queue: `latest` returns the newest line of a slot at
    any time, with its age, its E2E state, and whether it is stale.

    Frames sent by this host are received like any others. SocketCAN cannot distinguish this link's
    frames from those of other local programs. A link receives its own frames only if it is opened
    with ``receive_own_messages=True``.

    Nothing that arrives from the bus raises. An exception of the callback ends the thread and
    is raised again by `get`, by the iteration, by `wait` and by `stop`.

    Args:
        link: where to listen. It stays open when the receiver stops. Use one receiver
            for each link: two would take each other's frames.
        decoder: turns frames into lines; used by the receiver's thread only.
        on_line: called by the thread with each line. While it runs, frames that arrive
            wait in the receive queue of the interface.
        queue_size: how many lines may wait.
        can_ids: let the interface drop all frames but those of these CAN IDs,
            such as ``codec.can_ids``. With None all frames pass and are counted.

    Raises:
        ValueError: ``queue_size`` is less than 1.
    """

    def __init__(
        self,
        link: Link,
        decoder: Decoder,
        *,
        on_line: Callable[[MapLine], object] | None = None,
        queue_size: int = 256,
        can_ids: Collection[int] | None = None,
    ) -> None:
        if queue_size < 1:
            raise ValueError(f"queue_size must be 1 line or more, got {queue_size!r}")
        super().__init__("maplines receive")
        self._link, self._decoder, self._on_line = link, decoder, on_line
        self._monitor = Monitor(decoder)
        self._can_ids = can_ids
        self._queue: deque[MapLine] = deque(maxlen=queue_size)
        self._lines = self._frames = 0
        self._error_frames = self._remote_frames = self._overflowed = 0
        self._stamps = StampClock()

    def get(self, timeout: float | None = None) -> MapLine | None:
        """Return the oldest line that waits.

        Args:
            timeout: how long to wait for a line [s]; None for ever.

        Returns:
            The line; None after the timeout, or if the thread has ended and no line waits.

        Raises:
            TypeError: the lines go to a callback.
            Exception: the error that ended the thread, after the lines received before it.
        """
        if self._on_line is not None:
            raise TypeError("the lines of this receiver go to on_line; leave that out to get them")
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._ended, timeout)
            if self._queue:
                return self._queue.popleft()
        self._raise_error()
        return None

    def __iter__(self) -> Iterator[MapLine]:
        while (line := self.get()) is not None:
            yield line

    def latest(
        self, slot: Slot, now_ns: int | None = None, *, stale_cycles: float = STALE_CYCLES
    ) -> SlotView:
        """Return the newest line of a slot with its age, its E2E state, and whether it is stale.

        Call it once in each cycle of a controller. It may be called from any thread, and beside
        `get` and ``on_line``.

        Args:
            slot: which line.
            now_ns: the time now on the clock of the frames' time stamps [ns]. By default it is
                derived from the stamps received so far and the monotonic time since, so that
                neither an adapter with a clock of its own nor a change of the host's clock makes
                a line look younger than it is.  After the start the frames may be a backlog,
                for example on a link that was open before.  The time on that clock is then
                unknown: the age is infinite and the line is stale until the queueing delay has
                stopped falling for 0.2 s, which shows that the backlog is drained.
            stale_cycles: after how many cycle times without a newer line a line is stale;
                see ``Codec.decoder`` for the cycle time.

        Raises:
            ValueError: the DBC has no such slot.
        """
        with self._changed:
            view = self._monitor.latest(slot, self._now(now_ns), stale_cycles=stale_cycles)
            known = now_ns is not None or self._stamps.is_settled
        return view if known else view._replace(age=float("inf"), stale=True)

    def slots(self, now_ns: int | None = None) -> dict[Slot, SlotStats]:
        """Return the statistics of each slot that received anything; ``now_ns`` as in `latest`."""
        with self._changed:
            return self._monitor.slots(self._now(now_ns))

    def _now(self, now_ns: int | None) -> int:
        return self._stamps.now(time.monotonic_ns()) if now_ns is None else now_ns

    def stats(self) -> ReceiverStats:
        """Return a consistent copy of all counters."""
        with self._changed:
            return ReceiverStats(
                lines=self._lines,
                lost=self._decoder.lost,
                frames=self._frames,
                error_frames=self._error_frames,
                remote_frames=self._remote_frames,
                overflowed=self._overflowed,
                counts=dict(self._decoder.counts),
                pending=self._decoder.pending,
            )

    def start(self) -> Self:
        """Set the filter of the interface and start the thread; ``with`` calls this."""
        if self._can_ids:
            self._link.accept_only(self._can_ids)
        return self._start_thread()

    def _run(self) -> None:
        while not self._stopping:
            self._receive()

    def _receive(self) -> None:
        message = self._link.recv(POLL)
        if message is None:
            return
        with self._changed:
            if message.is_error_frame:
                self._error_frames += 1
                return
            if message.is_remote_frame:
                self._remote_frames += 1
                return
            self._frames += 1
            t_ns = round(message.timestamp * 1e9) or time.time_ns()
            self._stamps.add(t_ns, time.monotonic_ns())
            can_id, data = message.arbitration_id, bytes(message.data)
            line = self._monitor.feed(can_id, data, t_ns, is_extended=message.is_extended_id)
            if not isinstance(line, MapLine):
                return
            self._lines += 1
            if self._on_line is None:
                self._overflowed += len(self._queue) == self._queue.maxlen
                self._queue.append(line)
                self._changed.notify_all()
                return
        self._on_line(line)
