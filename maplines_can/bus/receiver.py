"""Receives lines: frames in, whole lines out, everything else counted."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from enum import Enum
from typing import Any, NamedTuple, Protocol, Self

from ..line import MapLine, Slot
from ..wire import SequenceCheck, SlotStats
from ..wire.reception.monitor import STALE_CYCLES, Monitor, SlotView
from .background import Running, Worker
from .link import Link
from .stamp_clock import StampClock

__all__ = ["Receiver", "ReceiverStats"]

#: How long the thread listens before it looks whether it shall stop [s].
SLICE = 0.1


class FrameDecoder(Protocol):
    """What the receiver needs of ``wire.Decoder``."""

    @property
    def counts(self) -> Mapping[Any, int]: ...
    @property
    def lost(self) -> int: ...
    @property
    def checks(self) -> Mapping[Slot, SequenceCheck]: ...
    def feed(
        self, can_id: int, data: bytes, t_ns: int, *, is_extended: bool = False
    ) -> MapLine | Enum: ...


class ReceiverStats(NamedTuple):
    """Counters of a receiver."""

    lines: int  #: complete lines received
    lost: int  #: lines that the sender's counters show missing
    frames: int  #: data frames given to the decoder
    error_frames: int  #: error frames of the bus, not given to the decoder
    remote_frames: int  #: remote frames, not given to the decoder
    overflowed: int  #: lines dropped, oldest first, because nobody fetched them
    counts: dict[Any, int]  #: frames by the decoder's reason
    pending: int = 0  #: frames held for lines that are not complete


class Receiver(Running):
    """One thread that turns the frames of a link into lines.

    Lines go to the callback ``on_line`` if there is one; otherwise they wait for
    iteration (``for line in receiver``, ends after `stop`) or `get`, after `stop` too.  The newest
    ``queue_size`` lines wait; older ones are dropped and counted as overflowed,
    for a stale line is worth less than the memory.

    A controller needs neither: `latest` has the newest line of a slot at any time,
    with its age, its E2E state, and whether it has grown stale.

    Frames that this host sent are lines like any other: SocketCAN marks those
    of *every* local program in the same way, and a link hears its own only if
    it is opened with ``receive_own_messages=True``.

    What the bus sends never raises.  What the callback raises ends the thread and
    comes up again at `get`, at the iteration and at `stop`: a mistake of the
    program must not scroll by in a log.

    Args:
        link: where to listen; stays open when the receiver stops.  One receiver
            for each link: two would take each other's frames.
        decoder: turns frames into lines; used by the receiver's thread only.
        on_line: called by the thread with each line; while it works, the
            interface's own queue has to hold what arrives.
        queue_size: how many lines may wait.
        can_ids: let the interface drop all frames but those of these CAN IDs,
            such as ``codec.can_ids``; None lets all through, to be counted.

    Raises:
        ValueError: ``queue_size`` is less than 1.
    """

    def __init__(
        self,
        link: Link,
        decoder: FrameDecoder,
        *,
        on_line: Callable[[MapLine], object] | None = None,
        queue_size: int = 256,
        can_ids: Collection[int] | None = None,
    ) -> None:
        if queue_size < 1:
            raise ValueError(f"queue_size must be 1 line or more, got {queue_size!r}")
        self._link, self._decoder, self._on_line = link, decoder, on_line
        self._monitor = Monitor(decoder)
        self._can_ids = can_ids
        self._changed = threading.Condition()  # guards all that follows
        self._queue: deque[MapLine] = deque(maxlen=queue_size)
        self._lines = self._frames = 0
        self._error_frames = self._remote_frames = self._overflowed = 0
        self._stopping = self._ended = False
        self._stamps = StampClock()
        self._worker = Worker("maplines receive", self._run, at_end=self._wake_all)

    def get(self, timeout: float | None = None) -> MapLine | None:
        """The oldest line that waits; None if none comes in ``timeout`` [s] or ever again.

        Raises:
            TypeError: the lines go to a callback.
            Exception: what ended the thread; the lines before it come first.
        """
        if self._on_line is not None:
            raise TypeError("the lines of this receiver go to on_line; leave that out to get them")
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._ended, timeout)
            if self._queue:
                return self._queue.popleft()
        self._worker.check()
        return None

    def __iter__(self) -> Iterator[MapLine]:
        while (line := self.get()) is not None:
            yield line

    def latest(
        self, slot: Slot, now_ns: int | None = None, *, stale_cycles: float = STALE_CYCLES
    ) -> SlotView:
        """The newest line of a slot with its age, its E2E state, and whether it is stale.

        One call for each cycle of a controller; from any thread, beside all other ways to
        the lines.

        Args:
            slot: which line.
            now_ns: on the clock of the frames' time stamps [ns]; by default the stamp
                of the last frame of any slot and the time since, so that neither an adapter
                with a clock of its own nor a host whose clock is set makes a line young.
                As long as frames may be of a backlog, such as that of a link that was open
                before, what time it is on that clock is not known: the age is infinite and the
                line stale, until frames have come for 0.2 s as fast as time goes by.
            stale_cycles: after how many cycle times without a newer one a line is stale;
                see ``Codec.decoder`` for the cycle time.

        Raises:
            ValueError: the DBC has no such slot.
        """
        with self._changed:
            view = self._monitor.latest(slot, self._now(now_ns), stale_cycles=stale_cycles)
            known = now_ns is not None or self._stamps.steady
        return view if known else view._replace(age=float("inf"), stale=True)

    def slots(self, now_ns: int | None = None) -> dict[Slot, SlotStats]:
        """What is known of each slot on which anything came; ``now_ns`` as for `latest`."""
        with self._changed:
            return self._monitor.slots(self._now(now_ns))

    def _now(self, now_ns: int | None) -> int:
        if now_ns is not None:
            return now_ns
        return self._stamps.now(time.monotonic_ns())

    def stats(self) -> ReceiverStats:
        """A consistent copy of all counters."""
        with self._changed:
            return ReceiverStats(
                lines=self._lines,
                lost=self._decoder.lost,
                frames=self._frames,
                error_frames=self._error_frames,
                remote_frames=self._remote_frames,
                overflowed=self._overflowed,
                counts=dict(self._decoder.counts),
                pending=getattr(self._decoder, "pending", 0),
            )

    def start(self) -> Self:
        """Start the thread; ``with`` does it too."""
        if self._can_ids:
            self._link.accept_only(self._can_ids)
        self._worker.start()
        return self

    def _run(self) -> None:
        while not self._stopping:
            self._receive()

    def _receive(self) -> None:
        message = self._link.recv(SLICE)
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
            self._stamps.heard(t_ns, time.monotonic_ns())
            line = self._monitor.feed(
                message.arbitration_id,
                bytes(message.data),
                t_ns,
                is_extended=message.is_extended_id,
            )
            if not isinstance(line, MapLine):
                return
            self._lines += 1
            if self._on_line is None:
                self._overflowed += len(self._queue) == self._queue.maxlen
                self._queue.append(line)
                self._changed.notify_all()
                return
        self._on_line(line)

    def _wake_all(self) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _end(self) -> None:
        self._stopping = True
        self._worker.join()
        if not self._worker.alive:  # it may never have started: nobody shall wait for it
            self._wake_all()
