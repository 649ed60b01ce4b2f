"""What the check of a slot remembers: its deadline, its records, and signs of a second sender.

Time is an argument everywhere.
"""

from __future__ import annotations

import math
from typing import NamedTuple

#: The first cycle without a record is declared missed this many cycles after the last record,
#: since the time of a record may jitter by half a cycle.
GRACE_CYCLES = 1.5
#: Conflicts that confirm two senders, and the longest interval between consecutive conflicts
#: [cycles]. A gateway that delays a transfer, or a sender that restarts, causes one or two.
CONFLICTS, NEAR_CYCLES = 8, 32
#: Two senders are also confirmed if DUPLICATES of NEW_RECORDS consecutive records came twice.
NEW_RECORDS, DUPLICATES = 32, 29
#: A second sender is suspected for this many cycles after a counter was reused, or was ahead of
#: what the first sender can have sent.
SUSPECT_CYCLES = 10
#: A second sender is forgotten after this many cycles without evidence.
FORGET_CYCLES = 256
#: Number of counters whose records are remembered: all of a counter of 8 bits.
HISTORY = 256
#: Time of what has not happened.
NEVER_NS = math.inf


class ReceptionDeadline:
    """Count of the cycles without a record; time is an argument.

    ::

        record                  missed        missed       record
          |<----- 1.5 cycles ---->|<- 1 cycle ->|            |<----- 1.5 cycles ----> ...

    The result does not depend on how often ``elapse`` is called. Records that are read late do not
    cause cycles already counted as missed to be counted again.

    Args:
        cycle_ns: time between records [ns].

    >>> deadline = ReceptionDeadline(cycle_ns=100)
    >>> deadline.record_arrived(0), deadline.elapse(149), deadline.elapse(350)
    (0, 0, 3)
    """

    def __init__(self, cycle_ns: int) -> None:
        self._cycle_ns = cycle_ns
        self.grace_ns = int(GRACE_CYCLES * cycle_ns)
        self._due_ns: int | None = None  # when the next cycle is missed
        self._is_counted = False  # whether cycles up to _due_ns were counted by elapse

    def record_arrived(self, t_ns: int) -> int:
        """Restart the deadline; return the number of cycles missed before the record."""
        missed, due_ns = 0, t_ns + self.grace_ns
        if self._due_ns is not None:
            if t_ns >= self._due_ns:
                missed = self.elapse(t_ns)
            elif self._is_counted and due_ns <= self._due_ns:
                return 0
        self._due_ns, self._is_counted = due_ns, False
        return missed

    def elapse(self, t_ns: int) -> int:
        """Return the number of cycles missed up to ``t_ns`` [ns] and not returned before."""
        if self._due_ns is None:
            return 0
        missed = (t_ns - self._due_ns) // self._cycle_ns + 1
        if missed > 0:
            self._due_ns += missed * self._cycle_ns
            self._is_counted = True
            return missed
        if self._due_ns - t_ns > self.grace_ns + self._cycle_ns:  # the clock was set back
            self._due_ns, self._is_counted = t_ns + self.grace_ns, False
        return 0


class _Entry(NamedTuple):
    """A received record."""

    content: int
    is_new: bool  #: accepted when it came
    is_in_sequence: bool  #: new, or late and directly after one that is in sequence
    is_duplicated: bool = False  #: received again since


class Run(NamedTuple):
    """Consecutive records behind the last new one: late ones, or those of a restarted sender."""

    first: int  #: counter of the first
    since_ns: int  #: time of the first
    last: int  #: counter of the last
    records: int
    is_other: bool  #: one has a counter that was received before with different content


class RecordHistory:
    """Records of the last counters, to recognise duplicates and late records that fill a gap.

    Each of the last ``HISTORY`` counters has an entry; fewer if the counter wraps around earlier.
    What a new record has skipped is forgotten, so that no entry is mistaken for one of an earlier
    round of the counter.
    """

    def __init__(self, modulus: int) -> None:
        self._modulus, self._length = modulus, min(modulus, HISTORY)
        self._entries: dict[int, _Entry] = {}  # by the low bits of the counter
        self._run: Run | None = None  # records behind the last new one since then

    def add_new(self, counter: int, content: int, ahead: int) -> None:
        """Add a new record, whose counter is ``ahead`` of that of the last new one."""
        for behind in range(1, min(ahead, self._length)):
            self._entries.pop((counter - behind) % self._length, None)
        self._run = None
        self._entries[counter % self._length] = _Entry(content, is_new=True, is_in_sequence=True)

    def add_late(self, counter: int, content: int, behind: int) -> None:
        """Add a record that was not accepted, unless there is one with its counter."""
        if behind < self._length and self._at(counter, behind) is None:
            self._entries[counter % self._length] = _Entry(
                content, is_new=False, is_in_sequence=self.fills_gap(counter, behind)
            )

    def run_with(self, counter: int, t_ns: int, *, is_other: bool) -> Run:
        """Add a record behind the last new one to the run of its counters; return that."""
        run = self._run
        if run is None or (counter - run.last) % self._modulus != 1:
            run = Run(counter, t_ns, counter, 0, is_other=False)
        self._run = run._replace(
            last=counter, records=run.records + 1, is_other=run.is_other or is_other
        )
        return self._run

    def has_other(self, counter: int, content: int, behind: int) -> bool:
        """Return whether another record came with this counter, ``behind`` the last new one."""
        entry = self._at(counter, behind)
        return entry is not None and entry.content != content

    def is_duplicate(self, counter: int, content: int, behind: int) -> bool:
        """Return whether the same record came before with this counter."""
        entry = self._at(counter, behind)
        return entry is not None and entry.content == content

    def mark_duplicated(self, counter: int, behind: int) -> bool:
        """Mark a record as duplicated; return True the first time a new record is duplicated."""
        entry = self._at(counter, behind)
        if entry is None or not entry.is_new or entry.is_duplicated:
            return False
        self._entries[counter % self._length] = entry._replace(is_duplicated=True)
        return True

    def fills_gap(self, counter: int, behind: int) -> bool:
        """Return whether a late record directly follows one in sequence, as in a reordered run."""
        before = self._at(counter - 1, behind + 1)
        return before is not None and before.is_in_sequence

    def _at(self, counter: int, behind: int) -> _Entry | None:
        return self._entries.get(counter % self._length) if behind < self._length else None


class SenderConflict:
    """Detector of a second sender on a slot, tolerant of bus faults.

    A conflict is a record that the first sender cannot have sent: one that reuses a counter with
    other content, or belongs to another counter sequence. At most one counts in half a cycle, and
    at most one between two new records. Two senders of the same content cause duplicates only; so
    does a path that duplicates every frame. Time is an argument.

    Until two senders are confirmed, a second one is suspected:

    - for ``SUSPECT_CYCLES`` after a counter was reused with other content. No mixture is put
      together then, since its components may come from both.
    - after a record that is ahead of what the first sender can have sent since its last one: until
      the next one in sequence, if no other record comes in between, which would be the first
      sender's; else for ``SUSPECT_CYCLES``. To the E2E check, such a record looks like lost ones::

        first       41       42           43           44           45
        second                  50                        51
        -----------|--------|--|---------|------------|--|---------|-----> time
                                suspected STALE        STALE        STALE

        one sender  41, held back by a gateway; 42, 43 and 44 are lost
        --------------------------------41--45-------46----------------> time
                                            suspected|not any more

    Otherwise the delivery of lines does not depend on this diagnostic. ``SlotView.usable`` and
    ``SceneView.usable`` do, on confirmed and on suspected senders.

    Args:
        cycle_ns: time between records [ns].
    """

    def __init__(self, cycle_ns: int) -> None:
        self._cycle_ns = cycle_ns
        self._conflicts = self._new_records = self._duplicates = 0
        self._conflict_ns = self._confirmed_ns = NEVER_NS
        self._reused_ns = self._ahead_ns = NEVER_NS
        self._is_followed = False  # whether other records came since that ahead
        self._is_blocked = True  # no new record since the last conflict
        #: Whether two senders are confirmed.
        self.is_confirmed = False

    def new(self) -> None:
        """Count a new record."""
        self._is_blocked = False
        self._new_records += 1
        if self._new_records > NEW_RECORDS:
            self._new_records, self._duplicates = 1, 0

    def duplicate(self, t_ns: int) -> None:
        """Count a duplicated record, once: a stuck sender must not be mistaken for two."""
        self._duplicates += 1
        if self._new_records >= NEW_RECORDS and self._duplicates >= DUPLICATES:
            self.is_confirmed, self._confirmed_ns = True, t_ns

    def conflict(self, t_ns: int) -> None:
        """Count a record that another sender must have sent."""
        since_ns = abs(t_ns - self._conflict_ns)
        if 2 * since_ns < self._cycle_ns or self._is_blocked:
            return
        is_near = since_ns <= NEAR_CYCLES * self._cycle_ns
        self._conflicts = self._conflicts + 1 if is_near else 1
        self._conflict_ns, self._is_blocked = t_ns, True
        if self._conflicts >= CONFLICTS:
            self.is_confirmed, self._confirmed_ns = True, t_ns

    def counter_reused(self, t_ns: int) -> None:
        """Count a conflict by a reused counter, and suspect a second sender."""
        self._reused_ns = t_ns
        self.conflict(t_ns)

    def ahead(self, t_ns: int) -> None:
        """Suspect a second sender: a new record is ahead of what the first can have sent."""
        self._ahead_ns, self._is_followed = t_ns, False

    def next(self) -> None:
        """Note the next record in sequence: the sender of a record that was ahead goes on."""
        if not self._is_followed:
            self._ahead_ns = NEVER_NS

    def late(self, t_ns: int) -> None:
        """Note a late record: after one that was ahead, it is that of the first sender."""
        if self._is_recent(self._ahead_ns, t_ns):
            self._ahead_ns, self._is_followed = t_ns, True

    def retract(self) -> None:
        """Discount the last conflict: its sequence was that of a sender that restarted."""
        self._conflicts = max(0, self._conflicts - 1)
        self._reused_ns = self._ahead_ns = NEVER_NS

    def was_reused(self, t_ns: int) -> bool:
        """Return whether a counter was reused in the last ``SUSPECT_CYCLES``."""
        return self._is_recent(self._reused_ns, t_ns)

    def is_suspected(self, t_ns: int) -> bool:
        """Return whether a second sender is suspected at ``t_ns`` [ns]."""
        return self.was_reused(t_ns) or self._is_recent(self._ahead_ns, t_ns)

    def elapse(self, t_ns: int) -> None:
        """Forget evidence that is too old at ``t_ns`` [ns]."""
        if self.is_confirmed and abs(t_ns - self._confirmed_ns) > FORGET_CYCLES * self._cycle_ns:
            self.is_confirmed, self._conflicts = False, 0

    def _is_recent(self, then_ns: float, t_ns: int) -> bool:
        return abs(t_ns - then_ns) <= SUSPECT_CYCLES * self._cycle_ns
