"""Receive lines from a link."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterator
from typing import Literal, Self

import can
from can.typechecking import CanFilters

from ..values.line import MapLine, Slot
from ..wire import Decoder, SceneView, SlotStats, SlotView
from ..wire.reception.views import STALE_CYCLES
from .background import BackgroundThread
from .link import Link, link_of
from .listener import LineListener, ReceiverStats

#: How long the thread waits for a frame before it checks whether it shall stop [s].
POLL = 0.1


class Receiver(BackgroundThread):
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
        self._listener = LineListener(decoder, on_line=on_line, queue_size=queue_size)
        self._link = link_of(link)
        self._bus = link if isinstance(link, can.BusABC) else None  # the caller's
        self._bus_filters: CanFilters | None = None  # of the caller
        self._can_ids = decoder.can_ids if can_ids == "decoder" else can_ids
        if self._can_ids is not None and (isinstance(self._can_ids, str) or not self._can_ids):
            raise ValueError(
                "can_ids must be 1 CAN ID or more, 'decoder' for those of its DBC, or None for "
                f"all frames, got {can_ids!r}"
            )
        super().__init__("maplines receive", on_end=self._listener.stop)

    def get(self, timeout: float | None = None) -> MapLine | None:
        """Return the oldest line that waits.

        Args:
            timeout: how long to wait for a line [s]; None for ever.

        Returns:
            The line; None after the timeout, or if the thread does not run and no line waits.

        Raises:
            TypeError: the lines go to a callback.
            Exception: the error that ended the thread, after the lines received before it.
        """
        line = self._listener.get(timeout if self._alive else 0.0)
        if line is None:
            self._raise_error()
        return line

    def __iter__(self) -> Iterator[MapLine]:
        while (line := self.get()) is not None:
            yield line

    def latest(
        self, slot: Slot, now_ns: int | None = None, *, stale_cycles: float = STALE_CYCLES
    ) -> SlotView:
        """Return the newest line of a slot with its state; see `LineListener.latest`."""
        return self._listener.latest(slot, now_ns, stale_cycles=stale_cycles)

    def latest_scene(
        self, now_ns: int | None = None, *, stale_cycles: float = STALE_CYCLES
    ) -> SceneView:
        """Return the newest scene with its state; see `LineListener.latest_scene`."""
        return self._listener.latest_scene(now_ns, stale_cycles=stale_cycles)

    def now_ns(self) -> int:
        """Return the time on the clock of the time stamps [ns]; see `LineListener.now_ns`."""
        return self._listener.now_ns()

    def slots(self, now_ns: int | None = None) -> dict[Slot, SlotStats]:
        """Return the statistics of each slot that received anything; ``now_ns`` as in `latest`."""
        return self._listener.slots(now_ns)

    def pose_error(self, now_ns: int | None = None) -> SlotStats | None:
        """Return the statistics of the pose error; see `LineListener.pose_error`."""
        return self._listener.pose_error(now_ns)

    def stats(self) -> ReceiverStats:
        """Return a consistent copy of all counters."""
        return self._listener.stats()

    def start(self) -> Self:
        """Set the filter of the interface and start the thread; ``with`` calls this."""
        if self._can_ids is not None:
            self._bus_filters = None if self._bus is None else self._bus.filters
            self._link.accept_only(self._can_ids)
        return self._start_thread()

    def _run(self) -> None:
        try:
            while not self._stopping:
                message = self._link.recv(POLL)
                if message is not None:
                    self._listener(message)
        finally:
            if self._bus is not None and self._can_ids is not None:
                with contextlib.suppress(can.CanError, OSError, ValueError):  # if it is shut down
                    self._bus.set_filters(self._bus_filters)
