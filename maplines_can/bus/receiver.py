"""Receive lines from a link by a thread; the rest is counted."""

from __future__ import annotations

import contextlib
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from inspect import iscoroutinefunction
from typing import TYPE_CHECKING, Literal, NamedTuple, Self

from ..values.line import MapLine, Slot
from ..wire import Decoder, Owner, Reason, ReceivedFrame, SceneView, SlotStats, SlotView
from ..wire.reception.views import STALE_CYCLES
from .background import BackgroundThread, ForkSafeCondition
from .bus_factory import can_error
from .link import Link, link_of
from .stamp_clock import StampClock

if TYPE_CHECKING:
    import can
    from can.typechecking import CanFilters

#: How long the thread waits for a frame before it checks whether it shall stop [s].
POLL = 0.1
#: Most frames that have arrived meanwhile and are decoded together, while `latest` waits. With a
#: callback they are decoded one by one: it gets a line before the next frame counts.
BURST = 64


class ReceiverStats(NamedTuple):
    """Counters of a receiver."""

    lines: int  #: complete lines received
    #: records that are missing according to the sender's counters: lines, or whole scenes
    lost: int
    frames: int  #: data frames given to the decoder
    error_frames: int  #: error frames of the bus, not given to the decoder
    remote_frames: int  #: remote frames, not given to the decoder
    overflowed: int  #: lines dropped from the full queue, oldest first
    counts: dict[Reason, int]  #: frames by the decoder's reason
    pending: int  #: frames held for lines that are not complete
    pose_errors: int  #: pose errors of scenes received


class ReceivedLines(ABC):
    """Lines of a bus: those that wait, and the newest of each slot, from any thread.

    A `LineListener` and a `Receiver` have these methods. Args and errors are those of both.
    """

    def __init__(
        self,
        decoder: Decoder,
        on_line: Callable[[MapLine], object] | None,
        queue_size: int,
        changed: ForkSafeCondition,
    ) -> None:
        if not hasattr(decoder, "feed"):
            raise TypeError(f"decoder must be a Decoder, such as codec.decoder(), got {decoder!r}")
        if on_line is not None and (not callable(on_line) or iscoroutinefunction(on_line)):
            raise TypeError(
                "on_line must be a plain function, not a coroutine function, such as the "
                f"put_nowait of an asyncio.Queue, got {on_line!r}"
            )
        if queue_size < 1:
            raise ValueError(f"queue_size must be 1 line or more, got {queue_size!r}")
        self._decoder, self._on_line = decoder, on_line
        self._changed = changed  # guards the state below, and the decoder
        self._queue: deque[MapLine] = deque(maxlen=queue_size)
        self._lines = self._frames = 0
        self._error_frames = self._remote_frames = self._overflowed = 0
        self._stamps = StampClock()
        self._stopped = False  # messages are ignored

    @property
    @abstractmethod
    def _is_over(self) -> bool:
        """Whether no message will come; `_changed` is notified then."""

    @abstractmethod
    def _raise_error(self) -> None:
        """Raise the error that ended the reception, if there is one."""

    def _take(self, messages: Sequence[can.Message]) -> None:
        """Decode messages, and count them."""
        with self._changed:
            if self._stopped:
                return
            frames = [frame for msg in messages if (frame := self._frame(msg)) is not None]
            answers = self._decoder.feed_all(frames)
            lines = [line for own in answers if not isinstance(own, Reason) for line in own]
            self._lines += len(lines)
            if self._on_line is None:
                for line in lines:
                    self._overflowed += len(self._queue) == self._queue.maxlen
                    self._queue.append(line)
                self._changed.notify_all()
                return
        for line in lines:
            self._on_line(line)

    def _frame(self, msg: can.Message) -> ReceivedFrame | None:
        """Count a message; return its frame if it is for the decoder."""
        if msg.is_error_frame:
            self._error_frames += 1
            return None
        if msg.is_remote_frame:
            self._remote_frames += 1
            return None
        self._frames += 1
        t_ns = round(msg.timestamp * 1e9) or time.time_ns()
        self._stamps.add(t_ns, time.monotonic_ns())
        return ReceivedFrame(msg.arbitration_id, bytes(msg.data), t_ns, msg.is_extended_id)

    def get(self, timeout: float | None = None) -> MapLine | None:
        """Return the oldest line that waits.

        Args:
            timeout: how long to wait for a line [s]; None for no limit.

        Returns:
            The line; None after the timeout, or if no line waits and none will come: the listener
            is stopped, or the thread of the receiver does not run.

        Raises:
            TypeError: the lines go to a callback.
            Exception: the error that ended the notifier, or the thread of the receiver, after the
                lines received before it.
        """
        if self._on_line is not None:
            raise TypeError("the lines go to on_line; leave that out to get them")
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._is_over, timeout)
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
                stopped falling for 0.2 s, which shows that the backlog is drained.  With the
                messages of a log, give the time.
            stale_cycles: after how many cycle times without a newer line a line is stale;
                see ``Codec.decoder`` for the cycle time.

        Raises:
            ValueError: the DBC has no such slot.
        """
        with self._changed:
            view = self._decoder.latest(slot, self._now(now_ns), stale_cycles=stale_cycles)
            known = now_ns is not None or self._stamps.is_settled
        return view if known else view._replace(age=float("inf"), stale=True)

    def latest_scene(
        self, now_ns: int | None = None, *, stale_cycles: float = STALE_CYCLES
    ) -> SceneView:
        """Return the newest scene: lines of one pose, with their joint covariance.

        Args:
            now_ns: as in `latest`.
            stale_cycles: number of cycle times since its pose error after which a scene is stale.

        Raises:
            ValueError: the DBC has no message of the pose error.
        """
        with self._changed:
            view = self._decoder.latest_scene(self._now(now_ns), stale_cycles=stale_cycles)
            known = now_ns is not None or self._stamps.is_settled
        return view if known else view._replace(age=float("inf"), stale=True)

    def now_ns(self) -> int:
        """Return the time now on the clock of the frames' time stamps [ns], as for `latest`.

        Before the first frame, that is the time of this machine.
        """
        with self._changed:
            return self._now(None) if self._frames else time.time_ns()

    def slots(self, now_ns: int | None = None) -> dict[Slot, SlotStats]:
        """Return the statistics of each slot that received anything; ``now_ns`` as in `latest`."""
        with self._changed:
            return self._decoder.slots(self._now(now_ns))

    def pose_error(self, now_ns: int | None = None) -> SlotStats | None:
        """Return the statistics of the pose error; None if none came; ``now_ns`` as in `latest`."""
        with self._changed:
            return self._decoder.pose_error(self._now(now_ns))

    def messages(self, now_ns: int | None = None) -> dict[Owner, SlotStats]:
        """Return the statistics of each owner of records that came; ``now_ns`` as in `latest`.

        Owners are slots and the pose error; or the messages of whole scenes, each with one counter
        and one state for all of its lines.
        """
        with self._changed:
            return self._decoder.messages(self._now(now_ns))

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
                pose_errors=self._decoder.pose_errors,
            )

    def _now(self, now_ns: int | None) -> int:
        return self._stamps.now(time.monotonic_ns()) if now_ns is None else now_ns


class Receiver(BackgroundThread, ReceivedLines):
    """Thread that turns the frames of a link into lines.

    Lines go to the callback ``on_line``, or wait for `get` or for iteration, and `latest` returns
    the newest line of a slot at any time, all as in a `LineListener`. The iteration ends after
    `stop`.

    Frames sent by this host are received like any others. SocketCAN cannot distinguish this link's
    frames from those of other local programs. A link receives its own frames only if it is opened
    with ``receive_own_messages=True``.

    Nothing that arrives from the bus raises. An exception of the callback ends the thread and
    is raised again by `get`, by the iteration, by `wait` and by `stop`.

    Args:
        link: where to listen: a `Link` or an open python-can bus. It stays open when the receiver
            stops, and a bus gets its own filters back. Use one receiver for each: two would take
            each other's frames. A bus is not reopened after an outage, see `Link`.
        decoder: turns frames into lines; used by the receiver's thread only.
        on_line: called by the thread with each line. While it runs, frames that arrive
            wait in the receive queue of the interface.
        queue_size: how many lines may wait.
        can_ids: let the interface drop all frames but those of these CAN IDs; by default, those
            of the decoder's DBC. With None the filters of the link stay as they are, which
            without filters of your own means that all frames pass and are counted.

    Raises:
        TypeError: ``link`` is neither a link nor a bus, ``decoder`` is no decoder, or
            ``on_line`` is no plain function.
        ValueError: ``queue_size`` is less than 1, or ``can_ids`` is empty.
    """

    def __init__(
        self,
        link: Link | can.BusABC,
        decoder: Decoder,
        *,
        on_line: Callable[[MapLine], object] | None = None,
        queue_size: int = 256,
        can_ids: Collection[int] | Literal["decoder"] | None = "decoder",
    ) -> None:
        BackgroundThread.__init__(self, "maplines receive")
        ReceivedLines.__init__(self, decoder, on_line, queue_size, self._changed)
        self._link = link_of(link)
        self._bus = None if isinstance(link, Link) else link  # the caller's
        self._bus_filters: CanFilters | None = None  # of the caller
        self._can_ids = decoder.can_ids if can_ids == "decoder" else can_ids
        if self._can_ids is not None and (isinstance(self._can_ids, str) or not self._can_ids):
            raise ValueError(
                "can_ids must be 1 CAN ID or more, 'decoder' for those of its DBC, or None for "
                f"all frames, got {can_ids!r}"
            )

    @property
    def _is_over(self) -> bool:
        return not self._alive

    def start(self) -> Self:
        """Set the filter of the interface and start the thread; ``with`` calls this."""
        if self._can_ids is not None:
            self._bus_filters = None if self._bus is None else self._bus.filters
            self._link.accept_only(self._can_ids)
        return self._start_thread()

    def _run(self) -> None:
        try:
            while not self._stopping:
                self._receive_burst()
        finally:
            if self._bus is not None and self._can_ids is not None:
                with contextlib.suppress(can_error(), OSError, ValueError):  # if it is shut down
                    self._bus.set_filters(self._bus_filters)

    def _receive_burst(self) -> None:
        """Wait for a message, and decode it with those that have arrived meanwhile."""
        messages: list[can.Message] = []
        most = BURST if self._on_line is None else 1
        try:
            message = self._link.recv(POLL)
            while message is not None:
                messages.append(message)
                message = self._link.recv(0.0) if len(messages) < most else None
        finally:  # also if the link is closed meanwhile
            if messages:
                self._take(messages)
