"""When to send what, and how late it was: pure, time is an argument."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Hashable
from typing import Generic, NamedTuple, TypeVar

__all__ = ["Due", "Lateness", "LatenessHistogram", "Schedule"]

Key = TypeVar("Key", bound=Hashable)


class Due(NamedTuple, Generic[Key]):
    """One deadline that has come."""

    key: Key
    deadline: float  #: [s]
    skipped: int  #: older deadlines of this key that were missed and are given up


class _Entry(NamedTuple):
    phase: float  # place in the period, in [0, 1)
    cycle: int  # of the next deadline
    end: float  # the first cycle that is none of its own


class Schedule(Generic[Key]):
    """Absolute deadlines ``t0 + (k + phase) period`` for any number of keys.

    No deadline is computed from the last one or from "now", so nothing drifts.
    Who comes too late for a whole period serves the newest deadline only, and
    the ones before it are counted as skipped: there is no transfer to catch up.

    Args:
        period: [s], positive.
        count: how many deadlines each key has; None for ever.

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
        self._t0: float | None = None  # the first key starts the clock
        self._entries: dict[Key, _Entry] = {}

    def add(self, key: Key, phase: float, now: float) -> None:
        """Schedule a key from its first deadline that is not over yet.

        Args:
            key: a new key, or one to begin again.
            phase: its place in the period, in [0, 1).
            now: [s].
        """
        if self._t0 is None:
            self._t0 = now - phase * self._period
        # A millionth of a period is for the rounding of clocks that run for months.
        cycle = math.ceil((now - self._t0) / self._period - phase - 1e-6)
        end = math.inf if self._count is None else cycle + self._count
        self._entries[key] = _Entry(phase, cycle, end)

    def deadline(self, key: Key) -> float:
        """The next deadline of a key [s]; infinite if it has none."""
        entry = self._entries.get(key)
        return math.inf if entry is None or entry.cycle >= entry.end else self._at(entry)

    def remove(self, key: Key) -> None:
        """Forget a key; it may be unknown."""
        self._entries.pop(key, None)

    @property
    def over(self) -> bool:
        """Whether every key has had its ``count`` deadlines."""
        return bool(self._entries) and all(e.cycle >= e.end for e in self._entries.values())

    def wait(self, now: float) -> float | None:
        """Time until the next deadline [s], 0 if one has come; None if there is none."""
        first = min(map(self.deadline, self._entries), default=math.inf)
        return None if first == math.inf else max(0.0, first - now)

    def take(self, now: float) -> Due[Key] | None:
        """The oldest deadline that has come, each one once; None if there is none."""
        key = min(self._entries, key=self.deadline, default=None)
        if key is None or self.deadline(key) > now:
            return None
        entry = self._entries[key]
        elapsed = (now - (self._t0 or 0.0)) / self._period - entry.phase
        newest = entry._replace(cycle=int(min(max(elapsed // 1, entry.cycle), entry.end - 1)))
        self._entries[key] = newest._replace(cycle=newest.cycle + 1)
        return Due(key, self._at(newest), newest.cycle - entry.cycle)

    def _at(self, entry: _Entry) -> float:
        return (self._t0 or 0.0) + (entry.cycle + entry.phase) * self._period


class Lateness(NamedTuple):
    """How long after their deadlines things were done [s]."""

    median: float = 0.0
    p99: float = 0.0
    max: float = 0.0


class LatenessHistogram:
    """Quantiles in constant memory: counts in classes 9 % wide, read to within 5 %.

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
        """Count one lateness [s]; less than 0.1 us counts as that."""
        self._max = max(self._max, lateness)
        self._counts[round(math.log2(max(lateness, 1e-7)) * self._PER_OCTAVE)] += 1

    def summary(self) -> Lateness:
        """Median, 99th percentile and maximum so far."""
        return Lateness(self._quantile(0.5), self._quantile(0.99), self._max)

    def _quantile(self, share: float) -> float:
        left = share * self._counts.total()
        for number in sorted(self._counts):
            left -= self._counts[number]
            if left <= 0:
                return min(float(2.0 ** (number / self._PER_OCTAVE)), self._max)
        return 0.0
