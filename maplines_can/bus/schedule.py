"""Periodic deadlines, and statistics of how late they were met; time is an argument."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Hashable
from typing import Generic, NamedTuple, TypeVar

Key = TypeVar("Key", bound=Hashable)


class Due(NamedTuple, Generic[Key]):
    """A deadline that has passed."""

    key: Key
    deadline: float  #: [s]
    skipped: int  #: older deadlines of this key that were missed


class _Entry(NamedTuple):
    phase: float  # in [0, 1) of the period
    cycle: int  # of the next deadline
    end: float  # the cycle after the last one


class Schedule(Generic[Key]):
    """Absolute deadlines ``t0 + (k + phase) period`` for any number of keys.

    No deadline is computed from the previous one or from "now", so deadlines do not drift.
    If a caller is late by a period or more, `take` returns the newest deadline only, and
    the earlier ones are counted as skipped.

    Args:
        period: [s], positive.
        count: number of deadlines of each key; None for no limit.

    >>> schedule = Schedule(period=0.1)
    >>> schedule.add("left", phase=0.0, now=5.0)
    >>> schedule.take(now=5.001)
    Due(key='left', deadline=5.0, skipped=0)
    >>> schedule.take(now=5.002) is None, round(schedule.wait(now=5.002), 9)
    (True, 0.098)
    >>> due = schedule.take(now=5.45)
    >>> round(due.deadline, 9), due.skipped
    (5.4, 3)
    """

    def __init__(self, period: float, count: int | None = None) -> None:
        self._period, self._count = period, count
        self._t0 = math.nan  # set by the first key
        self._entries: dict[Key, _Entry] = {}
        self._deadlines: dict[Key, float] = {}  # next one of each key; infinite if it has none
        self._first: Key | None = None  # key of the first of them

    def add(self, key: Key, phase: float, now: float) -> None:
        """Add a key, or start it again; its first deadline is the next one after ``now`` [s].

        The phase is the offset of its deadlines, in [0, 1) of the period.
        """
        if math.isnan(self._t0):
            self._t0 = now - phase * self._period
        # The tolerance of a millionth of a period covers rounding after months of uptime.
        cycle = math.ceil((now - self._t0) / self._period - phase - 1e-6)
        end = math.inf if self._count is None else cycle + self._count
        self._set(key, _Entry(phase, cycle, end))

    def deadline(self, key: Key) -> float:
        """Return the next deadline of a key [s]; infinite if it has none."""
        return self._deadlines.get(key, math.inf)

    @property
    def first(self) -> float:
        """The next deadline of all keys [s]; infinite if there is none."""
        return math.inf if self._first is None else self._deadlines[self._first]

    def remove(self, key: Key) -> None:
        """Remove a key; it may be unknown."""
        self._entries.pop(key, None)
        self._deadlines.pop(key, None)
        self._find_first()

    @property
    def over(self) -> bool:
        """Whether every key has had its ``count`` deadlines."""
        return bool(self._entries) and self.first == math.inf

    def wait(self, now: float) -> float | None:
        """Return the time until the next deadline [s], at least 0; None if there is none."""
        first = self.first
        return None if first == math.inf else max(0.0, first - now)

    def take(self, now: float) -> Due[Key] | None:
        """Return the oldest deadline that has passed, each one once; None if none has."""
        key = self._first
        if key is None or self._deadlines[key] > now:
            return None
        entry = self._entries[key]
        elapsed = (now - self._t0) / self._period - entry.phase
        newest = int(min(max(elapsed, entry.cycle), entry.end - 1))
        self._set(key, _Entry(entry.phase, newest + 1, entry.end))
        return Due(key, self._at(newest, entry.phase), newest - entry.cycle)

    def _set(self, key: Key, entry: _Entry) -> None:
        self._entries[key] = entry
        is_over = entry.cycle >= entry.end
        self._deadlines[key] = math.inf if is_over else self._at(entry.cycle, entry.phase)
        self._find_first()

    def _find_first(self) -> None:
        """Find the first deadline: of equal ones, that of the key that was added first."""
        deadlines = self._deadlines
        self._first = min(deadlines, key=deadlines.__getitem__, default=None)

    def _at(self, cycle: int, phase: float) -> float:
        return self._t0 + (cycle + phase) * self._period


class Lateness(NamedTuple):
    """Statistics of the time after a deadline at which it was met [s]."""

    median: float
    p99: float
    max: float


class LatenessHistogram:
    """Histogram of lateness in constant memory: bins 9 % wide, quantiles within 5 %.

    >>> histogram = LatenessHistogram()
    >>> for microseconds in range(1, 1001):
    ...     histogram.add(microseconds * 1e-6)
    >>> [f"{x * 1e6:.0f}" for x in histogram.summary()]
    ['488', '977', '1000']
    """

    _PER_OCTAVE = 8

    def __init__(self) -> None:
        self._counts: Counter[int] = Counter()
        self._max = 0.0

    def add(self, lateness: float) -> None:
        """Add one lateness [s]; less than 0.1 us counts as 0.1 us."""
        self._max = max(self._max, lateness)
        self._counts[round(math.log2(max(lateness, 1e-7)) * self._PER_OCTAVE)] += 1

    def summary(self) -> Lateness:
        """Return the median, the 99th percentile and the maximum so far."""
        return Lateness(self._quantile(0.5), self._quantile(0.99), self._max)

    def _quantile(self, share: float) -> float:
        left = share * self._counts.total()
        for number in sorted(self._counts):
            left -= self._counts[number]
            if left <= 0:
                return min(float(2.0 ** (number / self._PER_OCTAVE)), self._max)
        return 0.0
