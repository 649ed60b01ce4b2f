"""Signs of a second sender of the same records, told from the faults of a bus.

A conflict is a record that the first sender cannot have sent: it has the counter of another one, or
belongs to another sequence of counters. Two senders of the same content cause duplicates only; so
does a path that duplicates every frame.
"""

from __future__ import annotations

import math

#: Conflicts that confirm two senders, and the longest time between two of them [cycles].
CONFLICTS, NEAR_CYCLES = 8, 32
#: So many duplicates of so many consecutive new records confirm them, too.
NEW_RECORDS, DUPLICATES = 32, 29
#: Time for which a second sender is suspected, and after which a confirmed one is forgotten.
SUSPECT_CYCLES, FORGET_CYCLES = 10, 256
#: Time of what has not happened.
NEVER = math.inf


class Senders:
    """What is known of the number of senders; all times in ns."""

    def __init__(self, cycle_ns: int) -> None:
        self._cycle_ns = cycle_ns
        self.are_two = False  #: confirmed
        self._conflicts = self._new_records = self._duplicates = 0
        self._conflict_ns = self._confirmed_ns = self._reused_ns = self._ahead_ns = NEVER
        self._is_followed = False  # other records came since the one that was ahead
        self._is_blocked = True  # no new record since the last conflict

    def new(self) -> None:
        """Count a new record."""
        self._is_blocked = False
        self._new_records += 1
        if self._new_records > NEW_RECORDS:
            self._new_records, self._duplicates = 1, 0

    def duplicate(self, t_ns: int) -> None:
        """Count a record that came twice, once: a stuck sender is no second one."""
        self._duplicates += 1
        if self._new_records >= NEW_RECORDS and self._duplicates >= DUPLICATES:
            self.are_two, self._confirmed_ns = True, t_ns

    def conflict(self, t_ns: int) -> None:
        """Count a conflict: at most one in half a cycle, and one between two new records."""
        since_ns = abs(t_ns - self._conflict_ns)
        if 2 * since_ns < self._cycle_ns or self._is_blocked:
            return
        is_near = since_ns <= NEAR_CYCLES * self._cycle_ns
        self._conflicts = self._conflicts + 1 if is_near else 1
        self._conflict_ns, self._is_blocked = t_ns, True
        if self._conflicts >= CONFLICTS:
            self.are_two, self._confirmed_ns = True, t_ns

    def counter_reused(self, t_ns: int) -> None:
        """Count a conflict by a counter with two contents; a second sender is suspected."""
        self._reused_ns = t_ns
        self.conflict(t_ns)

    def ahead(self, t_ns: int) -> None:
        """Suspect a second sender: a record is ahead of what the first can have sent by now."""
        self._ahead_ns, self._is_followed = t_ns, False

    def next(self) -> None:
        """Note that the sender of the record that was ahead goes on, and nobody else."""
        if not self._is_followed:
            self._ahead_ns = NEVER

    def late(self, t_ns: int) -> None:
        """Note a record behind the last one: after one that was ahead, that of another sender."""
        if self._is_recent(self._ahead_ns, t_ns):
            self._ahead_ns, self._is_followed = t_ns, True

    def retract(self) -> None:
        """Discount the last conflict: its sequence was that of a sender that restarted."""
        self._conflicts = max(0, self._conflicts - 1)
        self._reused_ns = self._ahead_ns = NEVER

    def was_reused(self, t_ns: int) -> bool:
        """Return whether a counter had two contents of late."""
        return self._is_recent(self._reused_ns, t_ns)

    def may_be_two(self, t_ns: int) -> bool:
        """Return whether a second sender is confirmed or suspected."""
        return self.are_two or self.was_reused(t_ns) or self._is_recent(self._ahead_ns, t_ns)

    def elapse(self, t_ns: int) -> None:
        """Forget what is too old."""
        if self.are_two and abs(t_ns - self._confirmed_ns) > FORGET_CYCLES * self._cycle_ns:
            self.are_two, self._conflicts = False, 0

    def _is_recent(self, then_ns: float, t_ns: int) -> bool:
        return abs(t_ns - then_ns) <= SUSPECT_CYCLES * self._cycle_ns
