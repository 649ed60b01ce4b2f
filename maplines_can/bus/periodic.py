"""Work on a clock at absolute deadlines: periodic calls, and the transfers of a queue."""

from __future__ import annotations

import math
from collections.abc import Callable

from ..wire import Frame
from .clock import SECOND_NS, Clock, TimerHandle
from .schedule import Lateness, LatenessHistogram
from .tx_queue import TxQueue


class PeriodicCall:
    """Call of a function at ``start_ns + k period_ns``, on a clock.

    Deadlines are absolute: they do not drift. If the clock is late by a period or more, the
    earlier deadlines are skipped and counted in ``overruns``, as a ``Transmitter`` does.

    Args:
        clock: the clock.
        period_ns: positive [ns].
        function: called with the deadline [ns].
        start_ns: the first deadline [ns]; None for now.

    Raises:
        ValueError: ``period_ns`` is not positive.

    >>> from maplines_can.bus.clock import VirtualClock
    >>> clock, seen = VirtualClock(), []
    >>> call = PeriodicCall(clock, 20_000_000, seen.append, start_ns=5_000_000)
    >>> clock.run_for(0.05)
    >>> call.stop(), seen
    (None, [5000000, 25000000, 45000000])
    """

    def __init__(
        self,
        clock: Clock,
        period_ns: int,
        function: Callable[[int], object],
        *,
        start_ns: int | None = None,
    ) -> None:
        if period_ns < 1:
            raise ValueError(f"period_ns must be 1 ns or more, got {period_ns!r} ns")
        self.overruns = 0  #: deadlines that were skipped
        self._clock, self._period_ns, self._function = clock, period_ns, function
        self._lateness = LatenessHistogram()
        self._deadline_ns = clock.now_ns if start_ns is None else start_ns
        self._handle: TimerHandle | None = clock.call_at(self._deadline_ns, self._call)

    def stop(self) -> None:
        """Make no further call; any number of times."""
        handle, self._handle = self._handle, None
        if handle is not None:
            handle.cancel()

    def lateness(self) -> Lateness:
        """Return how late the calls were."""
        return self._lateness.summary()

    def _call(self) -> None:
        if self._handle is None:  # stopped while this call was on its way
            return
        late_ns = self._clock.now_ns - self._deadline_ns
        skipped = late_ns // self._period_ns
        deadline_ns = self._deadline_ns + skipped * self._period_ns
        self.overruns += skipped
        self._lateness.add(late_ns / SECOND_NS)
        self._deadline_ns = deadline_ns + self._period_ns
        self._handle = self._clock.call_at(self._deadline_ns, self._call)
        self._function(deadline_ns)


class QueueSending:
    """Sending of the transfers of a ``TxQueue`` at their deadlines, on a clock.

    The queue counts seconds from ``start_ns``: pass `now` to ``TxQueue.put``, and call `update`
    after each call that may change its first deadline.

    Args:
        clock: the clock.
        queue: the queue.
        send: called with each frame, in order, at the deadline of its transfer.
    """

    def __init__(self, clock: Clock, queue: TxQueue, send: Callable[[Frame], object]) -> None:
        self.queue = queue
        self.overruns = 0  #: deadlines that were skipped
        self.transfers = 0  #: transfers that were sent
        self._clock, self._send, self._start_ns = clock, send, clock.now_ns
        self._lateness = LatenessHistogram()
        self._handle: TimerHandle | None = None

    @property
    def now(self) -> float:
        """The present time of the queue [s]."""
        return (self._clock.now_ns - self._start_ns) / SECOND_NS

    def lateness(self) -> Lateness:
        """Return how late the transfers were."""
        return self._lateness.summary()

    def update(self) -> None:
        """Wait for the first deadline of the queue, which may be a new one."""
        self.stop()
        if self.queue.first < math.inf:
            self._handle = self._clock.call_at(self._ns(self.queue.first), self._run)

    def stop(self) -> None:
        """Send nothing more, until the next `update`."""
        if self._handle is not None:
            self._handle.cancel()
            self._handle = None

    def _run(self) -> None:
        # A deadline that was rounded down to nanoseconds is met, too.
        now = max(self.now, self.queue.first)
        transfer = self.queue.take(now)
        if transfer is not None:
            self._lateness.add(max(0.0, now - transfer.deadline))
            self.overruns += transfer.skipped
            if now > transfer.latest:
                transfer = self.queue.renew(transfer, now)
            for frame in transfer.frames:
                self._send(frame)
            self.transfers += 1
        self.update()

    def _ns(self, t: float) -> int:
        return self._start_ns + round(t * SECOND_NS)
