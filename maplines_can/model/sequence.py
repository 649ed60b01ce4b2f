"""Is a record new? By its counter, its content and the time; and the E2E state of its owner.

Counters are modulo ``modulus``; ``last`` is that of the last new record, ``span`` the number of
records of the line that was delivered last, and ``most`` how many the sender can have sent since
the last new one:

======================================= ============================= ========== =============
counter                                 content for this counter      decision   E2E status
======================================= ============================= ========== =============
last + 1                                any                           new        OK
last + 2 .. last + max_delta            any                           new        OKSOMELOST
last + max_delta + 1 .. last + most     any                           new, break WRONGSEQUENCE
last - span + 1 .. last                 same as before                DUPLICATE  REPEATED
last - span + 1 .. last                 different: conflict           STALE      REPEATED
any other                               same as before                DUPLICATE  WRONGSEQUENCE
any other                               different, no restart         STALE      WRONGSEQUENCE
any other                               different, restart            new, break WRONGSEQUENCE
======================================= ============================= ========== =============

If no new record came for a whole window, those of the last three rows are of a sender that has
restarted: new, with a break. A break clears the window, so the state is not VALID then.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

from .e2e import StateMachine, Windows, status_of
from .senders import Senders

#: The first cycle without a record is missed so many cycles after the last record.
GRACE_CYCLES = 1.5
#: A spacing below this part of the cycle is short, and so many in a row are refused.
SHORT_PART, SHORT_ROW = 100, 8
#: Consecutive records behind the last new one that may be a restart.
RESTART_RECORDS = 3
#: A sender may be early by this [cycles], and faster than the cycle time by this factor.
JITTER_CYCLES, FASTEST = 0.5, 10
#: The time between two lines is a mean over about this many.
MEAN_LINES = 8


class SequenceCheck:
    """Checks of the records of one owner; all times in ns."""

    def __init__(
        self,
        windows: Windows,
        modulus: int,
        pages: int,
        cycle_ns: int,
        *,
        is_authentic: bool,
        history: int = 256,
    ) -> None:
        self.cycle_ns = cycle_ns  #: time between records, or lines
        self.statuses: Counter[str] = Counter()  #: checks by outcome
        self.status: str | None = None  #: of the last check
        self.lost = 0  #: records missing between those received
        self.last: int | None = None  #: counter of the last new record
        #: By how much that was ahead of the one before; None after a break.
        self.ahead: int | None = None
        self.short_row = 0  #: short spacings in a row up to the last line
        self.senders = Senders(cycle_ns)
        self._windows, self._modulus = windows, modulus
        self._pages = pages  # frames of a classic record
        self._is_authentic = is_authentic  # each record is known to be newer than those before
        self._machine, self._deadline = StateMachine(windows), Deadline(cycle_ns)
        self._history, self._pace = History(min(modulus, history)), Pace(cycle_ns, modulus)
        self._run: list[_Late] = []  # consecutive records behind the last new one
        self._new_ns = 0  # time of the last new record
        self._spaced_ns: int | None = None  # time of the last line
        self._span = 1  # records of the line delivered last, while no later one has come
        self._left: int | None = None  # last counter before the last gap
        self._duplicated_frames = 0  # since the last new record

    @property
    def state(self) -> str:
        """State as far as time has elapsed."""
        return self._machine.state

    # ---- what happens ---------------------------------------------------------------------

    def is_spaced_short(self, t_ns: int) -> bool:
        """Return whether a line comes far sooner after the last one than the cycle."""
        last_ns, self._spaced_ns = self._spaced_ns, t_ns
        if last_ns is None or t_ns <= last_ns:  # no spacing: the row goes on
            return False
        is_short = t_ns - last_ns < self.cycle_ns // SHORT_PART
        self.short_row = min(self.short_row + 1, SHORT_ROW) if is_short else 0
        return is_short

    def received(self, counter: int, content: bytes, t_ns: int, records: int) -> str | None:
        """Check an intact record of a line of so many; return None if it is new, or why not."""
        self._arrived(t_ns)
        status = status_of(counter, self.last, self._windows.max_delta_counter, self._modulus)
        if status == "OK" or self.last is None:
            self.senders.next()
            self.ahead = 1
            self._accept(counter, content, t_ns, 1)
        else:
            reason = self._out_of_sequence(status, self.last, counter, content, t_ns, records)
            if reason is not None:
                behind = (self.last - counter) % self._modulus
                self._step("REPEATED" if behind < self._span else "WRONGSEQUENCE")
                return reason
        self._step(status)
        return None

    def delivered(self, records: int) -> None:
        """Note that the last new record has completed a line of this many."""
        self._span = records
        if self.last is not None:
            self._pace.delivered(self.last, self._new_ns, records)

    def failed(self, t_ns: int) -> None:
        """Check a damaged record, or a frame with a wrong page or length."""
        self._arrived(t_ns)
        self._step("ERROR")

    def frame_dropped(self, reason: str, t_ns: int) -> None:
        """Check a frame of no record: as many duplicates as pages are one repeated record.

        What is not authentic does not reach the check, and with keys a wrong length is not.
        """
        if reason == "PAGE" or (reason == "LENGTH" and not self._is_authentic):
            self.failed(t_ns)
        elif reason == "DUPLICATE":
            self._duplicated_frames += 1
            if self._duplicated_frames % self._pages == 0:
                self._arrived(t_ns)
                if self._duplicated_frames == self._pages:
                    self.senders.duplicate(t_ns)
                self._step("REPEATED")

    def elapse(self, t_ns: int) -> str:
        """Check the cycles without a record up to a time; return the state."""
        self.senders.elapse(t_ns)
        self._missed(self._deadline.elapse(t_ns))
        return self.state

    def _arrived(self, t_ns: int) -> None:
        self.senders.elapse(t_ns)
        self._missed(self._deadline.record_arrived(t_ns))

    def _missed(self, cycles: int) -> None:
        if cycles:
            self.status = "NONEWDATA"
            self.statuses["NONEWDATA"] += cycles
            for _ in range(min(cycles, self._windows.window_size_valid)):
                self._machine.step("NONEWDATA")

    def _step(self, status: str) -> None:
        self.status = status
        self.statuses[status] += 1
        self._machine.step(status)

    # ---- rules of the table -----------------------------------------------------------------

    def _out_of_sequence(
        self, status: str, last: int, counter: int, content: bytes, t_ns: int, records: int
    ) -> str | None:
        """Decide on a record that is not the next one: None if it is new, or why not."""
        waited_ns = abs(t_ns - self._new_ns)
        ahead = (counter - last) % self._modulus
        is_newer = 0 < ahead <= self._most_ahead(waited_ns, records)
        if not is_newer:
            reason = self._why_not_new(counter, content, (last - counter) % self._modulus, t_ns)
            if reason is not None:
                return reason
            ahead = self._modulus  # of another sequence: nothing of the history is left
        if self._left is not None and (counter - self._left) % self._modulus == 1:
            self.senders.conflict(t_ns)  # back to the sequence before the gap
        self._left = last
        is_gap = status == "OKSOMELOST"
        if is_gap and ahead > self._pace.lines(waited_ns) * self._pace.longest_with(records):
            self.senders.ahead(t_ns)
        if is_gap or (is_newer and counter != 0):  # a sender restarts at 0: nothing is lost then
            self.lost += ahead - 1
        self.ahead = ahead if is_gap else None
        self._accept(counter, content, t_ns, ahead)
        if not is_gap:
            self._machine.clear()  # a break: the window is of the old sequence
        return None

    def _accept(self, counter: int, content: bytes, t_ns: int, ahead: int) -> None:
        self._history.add_new(counter, content, ahead)
        self._run.clear()
        self.senders.new()
        self.last, self._new_ns, self._span, self._duplicated_frames = counter, t_ns, 1, 0

    def _most_ahead(self, waited_ns: int, records: int) -> int:
        """Return ``most``; with keys it is not limited by time."""
        half, lines = self._modulus // 2 - 1, math.ceil(self._pace.lines(waited_ns))
        if self._is_authentic:
            return half
        by_time = lines * self._pace.longest_with(records)
        return min(half, max(self._windows.max_delta_counter, by_time))

    def _why_not_new(self, counter: int, content: bytes, behind: int, t_ns: int) -> str | None:
        """Return why a record behind the last new one is not delivered; None if it is new."""
        before = self._history.at(counter, behind)
        is_duplicate = before is not None and before.content == content
        if before is None or not is_duplicate:
            self.senders.late(t_ns)
        elif behind <= self._windows.max_delta_counter and before.is_new:
            if not before.is_duplicated:
                self.senders.duplicate(t_ns)
            before.is_duplicated = True
        if behind < self._span:
            if not is_duplicate:
                self.senders.counter_reused(t_ns)
            return "DUPLICATE" if is_duplicate else "STALE"
        window_ns = self._windows.window_size_valid * self.cycle_ns
        if self._is_authentic or abs(t_ns - self._new_ns) > window_ns:
            return None  # a restart
        if is_duplicate:
            return "DUPLICATE"
        if before is not None:
            self.senders.counter_reused(t_ns)
        else:
            is_delayed = self._history.add_late(counter, content, behind)
            if behind > self._windows.max_delta_counter * self._pace.longest and not is_delayed:
                self.senders.conflict(t_ns)  # too far behind to be merely delayed
        return None if self._is_restart(counter, t_ns, is_other=before is not None) else "STALE"

    def _is_restart(self, counter: int, t_ns: int, *, is_other: bool) -> bool:
        """Return whether consecutive records behind the last new one are of a restarted sender.

        They are if three or more have come in 1.5 cycles or longer, the first counter is one of
        the first that a sender has, and one of the counters had another content before::

            new      new      restart: the first two records are dropped
            41       42        0        1        2        3
            |--------|--------|--------|--------|--------|-----> time
                               STALE    STALE    new      new
        """
        if self._run and (counter - self._run[-1].counter) % self._modulus != 1:
            self._run.clear()
        self._run.append(_Late(counter, t_ns, is_other))
        first = self._run[0]
        is_restart = (
            len(self._run) >= RESTART_RECORDS
            and abs(t_ns - first.t_ns) >= int(GRACE_CYCLES * self.cycle_ns)
            and any(late.is_other for late in self._run)
            and first.counter < self._windows.max_delta_counter
        )
        if is_restart:
            self.senders.retract()
        return is_restart


class _Late(NamedTuple):
    """A record behind the last new one."""

    counter: int
    t_ns: int
    is_other: bool  #: the counter had another content before


class Deadline:
    """Count of the cycles without a record; reading late or often counts none twice.

    ::

        record                  missed        missed       record
          |<----- 1.5 cycles ---->|<- 1 cycle ->|            |<----- 1.5 cycles ----> ...
    """

    def __init__(self, cycle_ns: int) -> None:
        self._cycle_ns, self._grace_ns = cycle_ns, int(GRACE_CYCLES * cycle_ns)
        self._due_ns: int | None = None  # when the next cycle is missed
        self._is_counted = False  # cycles up to then were counted by ``elapse``

    def record_arrived(self, t_ns: int) -> int:
        """Restart; return the cycles missed before this record."""
        missed, due_ns = 0, t_ns + self._grace_ns
        if self._due_ns is not None:
            if t_ns >= self._due_ns:
                missed = self.elapse(t_ns)
            elif self._is_counted and due_ns <= self._due_ns:
                return 0
        self._due_ns, self._is_counted = due_ns, False
        return missed

    def elapse(self, t_ns: int) -> int:
        """Return the cycles missed up to a time that were not returned before."""
        if self._due_ns is None:
            return 0
        missed = (t_ns - self._due_ns) // self._cycle_ns + 1
        if missed > 0:
            self._due_ns += missed * self._cycle_ns
            self._is_counted = True
            return missed
        if self._due_ns - t_ns > self._grace_ns + self._cycle_ns:  # the clock was set back
            self._due_ns, self._is_counted = t_ns + self._grace_ns, False
        return 0


@dataclass
class Entry:
    """A record that has come."""

    content: bytes
    is_new: bool
    is_in_sequence: bool  #: new, or directly after one that is in sequence
    is_duplicated: bool = False  #: it has come again


class History:
    """Records of the last counters. What a new record has skipped is forgotten."""

    def __init__(self, length: int) -> None:
        self._length = length  # counters whose records are remembered, a power of 2
        self._entries: dict[int, Entry] = {}  # by the low bits of the counter

    def at(self, counter: int, behind: int) -> Entry | None:
        """Return the record with a counter that is so far behind the last new one."""
        return self._entries.get(counter % self._length) if behind < self._length else None

    def add_new(self, counter: int, content: bytes, ahead: int) -> None:
        """Add a new record, which is ahead of the last one by so much."""
        for skipped in range(1, min(ahead, self._length)):
            self._entries.pop((counter - skipped) % self._length, None)
        self._entries[counter % self._length] = Entry(content, is_new=True, is_in_sequence=True)

    def add_late(self, counter: int, content: bytes, behind: int) -> bool:
        """Add a record that is not accepted; return whether it directly follows one in sequence."""
        before = self.at(counter - 1, behind + 1)
        is_in_sequence = before is not None and before.is_in_sequence
        if behind < self._length:
            self._entries[counter % self._length] = Entry(content, False, is_in_sequence)
        return is_in_sequence


class Pace:
    """How fast a sender is, as far as it is known."""

    def __init__(self, cycle_ns: int, modulus: int) -> None:
        self._cycle_ns, self._modulus = float(cycle_ns), modulus
        self.longest = 1  #: records of the longest line so far
        self._line_ns = self._cycle_ns  # mean time between two lines in sequence
        self._line: tuple[int, int] | None = None  # counter and time of the last line

    def delivered(self, counter: int, t_ns: int, records: int) -> None:
        """Add a line by the counter and the time of its last record."""
        self.longest = self.longest_with(records)
        if self._line is not None and (counter - self._line[0]) % self._modulus == records:
            self._line_ns += (abs(t_ns - self._line[1]) - self._line_ns) / MEAN_LINES
        self._line = counter, t_ns

    def longest_with(self, records: int) -> int:
        """Return the records of the longest line, of those so far and one more."""
        return max(self.longest, records)

    def lines(self, waited_ns: int) -> float:
        """Return how many lines the sender can have sent in a time: 1.3 is 1 or 2."""
        line_ns = min(max(self._line_ns, self._cycle_ns / FASTEST), self._cycle_ns)
        return max(1.0, float(waited_ns) / line_ns + JITTER_CYCLES)
