"""Facts that were, packed in parts, and the newest one for those who wait for it."""

from __future__ import annotations

import json
import threading
import zlib
from collections import deque
from typing import NamedTuple

from .facts import Facts, changes

#: Facts of a part.
PART = 100
#: Level of zlib: a third less time than by default, for a quarter more bytes.
LEVEL = 2
#: Most bytes of packed facts: of a log of some days.
MAX_BYTES = 1 << 30
#: Most changes that are kept; a log with more has faults everywhere.
MAX_CHANGES = 20_000
#: What there is before the first facts.
NOTHING: Facts = {"slots": {}, "messages": {}, "counts": {}}


class Newest(NamedTuple):
    """The newest facts: their number, counted from 0, and their JSON."""

    number: int
    text: bytes


class _Part(NamedTuple):
    start: float  # time of its first facts [s]
    packed: bytes


class FactHistory:
    """Facts in the order of their time, each with its ``changes`` since the one before.

    The facts of a part are a JSON array, compressed by zlib as HTTP's ``deflate`` is. One thread
    adds facts, any thread reads.

    Args:
        max_facts: the oldest parts are forgotten if those after them are that many; None to keep
            all.
        max_bytes: nothing is added when this many packed bytes are kept.

    >>> history = FactHistory()
    >>> for k in range(150):
    ...     _ = history.add({"t": k / 20, "slots": {}, "messages": {}, "counts": {"CRC": k // 120}})
    >>> history.changes(0), len(json.loads(zlib.decompress(history.part(1))))
    ((1, [(120, 6.0, ['1 frame dropped: CRC'])]), 50)
    """

    def __init__(self, max_facts: int | None = None, max_bytes: int = MAX_BYTES) -> None:
        self._max_parts = None if max_facts is None else -(-max_facts // PART)
        self._max_bytes = max_bytes
        self._added = threading.Condition()  # guards what follows
        self._parts: deque[_Part] = deque()  # those that are whole
        self._first = 0  # number of the first of them
        self._open: list[bytes] = []  # facts after them
        self._open_start = self._end = 0.0
        self._zero: float | None = None  # time of the first facts that there were
        self._bytes = 0
        self._last = NOTHING
        self._changes: deque[tuple[int, float, list[str]]] = deque(maxlen=MAX_CHANGES)
        self._change_count = 0
        self._is_over = False

    def add(self, facts: Facts) -> bool:
        """Add facts; return whether there was room for them.

        Of the traffic, ``others`` counts the CAN IDs and the frames that are of no message of the
        lines' DBC; there may be hundreds.
        """
        facts = _without_others(facts)
        found = changes(self._last, facts)
        text = json.dumps(facts | {"changes": found}, separators=(",", ":")).encode()
        self._last = facts
        is_whole = len(self._open) == PART - 1
        packed = zlib.compress(_array([*self._open, text]), LEVEL) if is_whole else None
        with self._added:
            if self._bytes >= self._max_bytes:
                return False
            self._end = facts["t"]
            if self._zero is None:
                self._zero = self._end
            if not self._open:
                self._open_start = self._end
            self._open.append(text)
            if found:
                self._changes.append((self._count - 1, self._end, found))
                self._change_count += 1
            if packed is not None:
                self._close_part(packed)
            self._newest = Newest(self._count - 1, text)
            self._added.notify_all()
        return True

    def end(self) -> None:
        """Say that nothing is added any more."""
        with self._added:
            self._is_over = True
            self._added.notify_all()

    @property
    def is_over(self) -> bool:
        """Whether nothing is added any more."""
        return self._is_over

    def _close_part(self, packed: bytes) -> None:
        self._parts.append(_Part(self._open_start, packed))
        self._bytes += len(packed)
        self._open = []
        if self._max_parts is not None and len(self._parts) > self._max_parts:
            self._bytes -= len(self._parts.popleft().packed)
            self._first += 1

    @property
    def _count(self) -> int:
        return (self._first + len(self._parts)) * PART + len(self._open)

    def after(self, number: int, timeout: float) -> Newest | None:
        """Wait for facts after those of a number, and return the newest; None after the timeout."""
        with self._added:
            self._added.wait_for(lambda: self._count > number + 1 or self._is_over, timeout)
            return self._newest if self._count > number + 1 else None

    def part(self, number: int) -> bytes | None:
        """Return the packed facts of a part, which may be the one that grows; None if not kept."""
        with self._added:
            place = number - self._first
            if 0 <= place < len(self._parts):
                return self._parts[place].packed
            grows = list(self._open) if place == len(self._parts) else []
        return zlib.compress(_array(grows), LEVEL) if grows else None

    def changes(self, since: int) -> tuple[int, list[tuple[int, float, list[str]]]]:
        """Return how many changes there have been, and those from the one of a number on.

        A change is the number of its facts, their time [s], and texts. The oldest may be forgotten,
        and those before the first facts that are kept are.
        """
        with self._added:
            skipped = max(0, since - self._change_count + len(self._changes))
            kept = [one for one in list(self._changes)[skipped:] if one[0] >= self._first * PART]
            return self._change_count, kept

    def contents(self) -> Facts:
        """Return what is kept.

        ``first`` is the number of the first part, ``starts`` the times of the first facts of the
        parts [s], ``count`` the number of facts that there have been, ``end`` the time of the last
        one [s], ``zero`` that of the first one that there was, ``packed`` the bytes of the whole
        parts, and ``is_over`` whether nothing is added any more.
        """
        with self._added:
            open_start = [self._open_start] if self._open else []
            return {
                "first": self._first,
                "starts": [part.start for part in self._parts] + open_start,
                "count": self._count,
                "end": self._end,
                "zero": self._zero or 0.0,
                "packed": self._bytes,
                "is_over": self._is_over,
            }


def _array(texts: list[bytes]) -> bytes:
    return b"[" + b",".join(texts) + b"]"


def _without_others(facts: Facts) -> Facts:
    if "traffic" not in facts:
        return facts
    messages = facts["traffic"]["messages"]
    own = {key: one for key, one in messages.items() if one["owner"] is not None}
    foreign = [one["frames"] for one in messages.values() if one["owner"] is None]
    others = {"ids": len(foreign), "frames": sum(foreign) + facts["traffic"]["beyond"]}
    return facts | {"traffic": facts["traffic"] | {"messages": own, "others": others}}
