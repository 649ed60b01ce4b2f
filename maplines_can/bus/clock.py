"""Clocks that run calls at given times: a virtual one, and that of the system."""

from __future__ import annotations

import heapq
import math
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from itertools import count
from types import TracebackType
from typing import Self

#: Nanoseconds of a second.
SECOND_NS = 1_000_000_000
#: Longest wait at a stretch [s]; a longer one overflows on some systems.
_MAX_WAIT = 3600.0


def to_ns(seconds: float) -> int:
    """Return seconds as whole nanoseconds."""
    return round(seconds * SECOND_NS)


class TimerHandle:
    """A call that a clock will make once.

    Attributes:
        when_ns: time of the call [ns].
        is_cancelled: whether it was cancelled, and is not made.
    """

    __slots__ = ("function", "is_cancelled", "when_ns")

    def __init__(self, when_ns: int, function: Callable[[], object]) -> None:
        self.when_ns, self.function, self.is_cancelled = when_ns, function, False

    def cancel(self) -> None:
        """Do not make the call; nothing happens if it was made already."""
        self.is_cancelled = True


class Clock(ABC):
    """Clock that makes calls at given times, in one thread and in order of time.

    Times are whole nanoseconds, so deadlines that are computed from each other do not drift.
    Calls at the same time are made in the order of ``call_at``. A call at a time that is over is
    made as soon as possible. An exception of a call leaves `run_until`, which may be called again.

    ``call_at`` and ``TimerHandle.cancel`` may be used by any thread, and inside calls.
    """

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, TimerHandle]] = []
        self._order = count()

    @property
    @abstractmethod
    def now_ns(self) -> int:
        """The time [ns]."""

    @property
    def now(self) -> float:
        """The time [s]."""
        return self.now_ns / SECOND_NS

    @property
    def next_ns(self) -> int | None:
        """Time of the next call [ns]; None if there is none."""
        heap = self._heap
        while heap and heap[0][2].is_cancelled:
            heapq.heappop(heap)
        return heap[0][0] if heap else None

    def call_at(self, t_ns: int, function: Callable[[], object]) -> TimerHandle:
        """Call a function at a time [ns]; return the handle that can cancel this."""
        handle = TimerHandle(t_ns, function)
        heapq.heappush(self._heap, (t_ns, next(self._order), handle))
        return handle

    @abstractmethod
    def run_until(self, t_ns: int) -> None:
        """Make the calls that are due up to and including a time [ns]; it is that time then."""

    def run_for(self, seconds: float) -> None:
        """Make the calls of the next seconds."""
        if not 0 <= seconds < math.inf:
            raise ValueError(f"seconds must be 0 s or more, and finite, got {seconds!r} s")
        self.run_until(self.now_ns + to_ns(seconds))

    def _pop_due(self, t_ns: int) -> TimerHandle | None:
        """Remove and return the next call if it is due at a time; else None."""
        first = self.next_ns
        return None if first is None or first > t_ns else heapq.heappop(self._heap)[2]


class VirtualClock(Clock):
    """Clock whose time passes only while it runs: from one call to the next, without waiting.

    It is run by one thread, the first one as long as that lives, and not inside its own calls: two
    threads would let the time pass as far as their turns happen to be.

    Args:
        start_ns: time at the start [ns].

    >>> clock = VirtualClock()
    >>> seen = []
    >>> _ = clock.call_at(2_000_000, lambda: seen.append(("later", clock.now_ns)))
    >>> _ = clock.call_at(1_000_000, lambda: seen.append(("first", clock.now_ns)))
    >>> clock.run_for(0.01)
    >>> seen, clock.now
    ([('first', 1000000), ('later', 2000000)], 0.01)
    """

    def __init__(self, start_ns: int = 0) -> None:
        super().__init__()
        self._now_ns = start_ns
        self._running = threading.Lock()
        self._thread: threading.Thread | None = None

    @property
    def now_ns(self) -> int:
        """The time [ns]."""
        return self._now_ns

    @property
    def is_running(self) -> bool:
        """Whether a call is being made."""
        return self._running.locked()

    def step(self, until_ns: int | None = None) -> bool:
        """Advance to the next call and make it; return False if none is due by a time [ns].

        The time stays as it is if there is none. Without a time, any call is made.

        Raises:
            RuntimeError: the clock is running, in a call of its own or in another thread.
        """
        self._check_thread()
        if not self._running.acquire(blocking=False):
            raise RuntimeError(
                "a virtual clock cannot be run inside its own calls or by a second thread; in a "
                "call, or a listener, use call_at or recv(timeout=0) instead"
            )
        try:
            first = self.next_ns
            if first is None or (until_ns is not None and first > until_ns):
                return False
            handle = heapq.heappop(self._heap)[2]
            self._now_ns = max(self._now_ns, first)
            handle.function()
            return True
        finally:
            self._running.release()

    def run_until(self, t_ns: int) -> None:
        """Make the calls that are due up to and including a time [ns]; it is that time then.

        Raises:
            RuntimeError: the clock is running, in a call of its own or in another thread.
        """
        while self.step(t_ns):
            pass
        self._now_ns = max(self._now_ns, t_ns)

    def _check_thread(self) -> None:
        own, here = self._thread, threading.current_thread()
        if own is not here and own is not None and own.is_alive():
            raise RuntimeError(
                f"a virtual clock is run by one thread, {own.name!r} here, so {here.name!r} cannot "
                "let the time pass, nor wait in recv; use call_at, or bus.add_listener(listener)"
            )
        self._thread = here


class RealClock(Clock):
    """Clock of the system: makes each call when its time has come, or soon after.

    The time is that of ``time.time_ns()`` at the start, and from then on that of the monotonic
    clock: it is not set back. `run_until` makes the calls in the thread of its caller; in a
    ``with`` block, a thread of this clock makes them, and its error is raised at the end.

    >>> clock, seen = RealClock(), []
    >>> _ = clock.call_at(clock.now_ns + 1_000_000, lambda: seen.append("now"))
    >>> clock.run_for(0.01)
    >>> seen
    ['now']
    """

    def __init__(self) -> None:
        super().__init__()
        self._offset_ns = time.time_ns() - time.monotonic_ns()
        self._changed = threading.Condition()
        self._is_stopped = False
        self._thread: threading.Thread | None = None
        self._error: BaseException | None = None

    @property
    def now_ns(self) -> int:
        """The time [ns]."""
        return time.monotonic_ns() + self._offset_ns

    def call_at(self, t_ns: int, function: Callable[[], object]) -> TimerHandle:
        """Call a function at a time [ns]; return the handle that can cancel this."""
        with self._changed:
            handle = super().call_at(t_ns, function)
            if self._heap[0][2] is handle:  # else the thread wakes up in time
                self._changed.notify_all()
        return handle

    def run_until(self, t_ns: int) -> None:
        """Make the calls that are due up to and including a time [ns], or until `stop`."""
        self._is_stopped = False
        self._run(t_ns)

    def stop(self) -> None:
        """End `run_until`; the call that is being made is finished; from any thread."""
        with self._changed:
            self._is_stopped = True
            self._changed.notify_all()

    def __enter__(self) -> Self:
        self._thread = threading.Thread(target=self._run_in_thread, name="real clock", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()
        if self._thread is not None:
            self._thread.join()
        failed, self._thread, self._error = self._error, None, None
        if failed is not None and kind is None:
            raise failed

    def _run_in_thread(self) -> None:
        try:
            self._run(None)
        except BaseException as error:  # noqa: BLE001 - kept, and raised where the caller sees it
            self._error = error

    def _run(self, end_ns: int | None) -> None:
        while (handle := self._next(end_ns)) is not None:
            handle.function()

    def _next(self, end_ns: int | None) -> TimerHandle | None:
        """Wait for the next call and return it; None at the end."""
        with self._changed:
            while not self._is_stopped:
                now_ns = self.now_ns
                # After the end, too, calls are made that were due before it.
                handle = self._pop_due(now_ns if end_ns is None else min(now_ns, end_ns))
                if handle is not None:
                    return handle
                times = [t for t in (self.next_ns, end_ns) if t is not None]
                if end_ns is not None and now_ns >= end_ns:
                    return None
                wait = (min(times) - now_ns) / SECOND_NS if times else _MAX_WAIT
                self._changed.wait(min(max(wait, 0.0), _MAX_WAIT))
        return None
