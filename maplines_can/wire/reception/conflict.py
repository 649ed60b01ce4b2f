"""Detector of a second sender on a slot."""

from __future__ import annotations

import math

#: Conflicts that confirm two senders, and the longest interval between consecutive conflicts
#: [cycles]. A gateway that delays a transfer, or a sender that restarts, causes one or two.
CONFLICTS, NEAR_CYCLES = 8, 32
#: Two senders are also confirmed if DUPLICATES of NEW_RECORDS consecutive records came twice.
NEW_RECORDS, DUPLICATES = 32, 29
#: A second sender is suspected for this many cycles after a counter was reused.
SUSPECT_CYCLES = 10
#: A second sender is forgotten after this many cycles without evidence.
FORGET_CYCLES = 256
#: Time of what has not happened.
NEVER_NS = math.inf


class SenderConflict:
    """Detector of a second sender on a slot, tolerant of bus faults.

    A conflict is a record that the first sender cannot have sent: one that reuses a counter with
    other content, or belongs to another counter sequence. At most one counts in half a cycle, and
    at most one between two new records. Two senders of the same content cause duplicates only; so
    does a path that duplicates every frame. Time is an argument.

    For ``SUSPECT_CYCLES`` after a counter was reused with other content, a second sender is
    suspected and no mixture is put together, since its components may come from both. Otherwise the
    delivery of lines does not depend on this diagnostic. ``SlotView.usable`` does: a second sender
    whose counters are ahead by up to ``max_delta_counter`` passes the E2E check as lost records do,
    and its lines are delivered while the state is VALID.

    Args:
        cycle_ns: time between records [ns].
    """

    def __init__(self, cycle_ns: int) -> None:
        self._cycle_ns = cycle_ns
        self._conflicts = self._new_records = self._duplicates = 0
        self._conflict_ns = self._confirmed_ns = self._suspected_ns = NEVER_NS
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
        cycles = abs(t_ns - self._conflict_ns) / self._cycle_ns
        if cycles < 0.5 or self._is_blocked:
            return
        self._conflicts = self._conflicts + 1 if cycles <= NEAR_CYCLES else 1
        self._conflict_ns, self._is_blocked = t_ns, True
        if self._conflicts >= CONFLICTS:
            self.is_confirmed, self._confirmed_ns = True, t_ns

    def counter_reused(self, t_ns: int) -> None:
        """Count a conflict by a reused counter, and suspect a second sender."""
        self._suspected_ns = t_ns
        self.conflict(t_ns)

    def retract(self) -> None:
        """Discount the last conflict: its sequence was that of a sender that restarted."""
        self._conflicts = max(0, self._conflicts - 1)
        self._suspected_ns = NEVER_NS

    def is_suspected(self, t_ns: int) -> bool:
        """Return whether a counter was reused in the last ``SUSPECT_CYCLES``."""
        return abs(t_ns - self._suspected_ns) <= SUSPECT_CYCLES * self._cycle_ns

    def elapse(self, t_ns: int) -> None:
        """Forget evidence that is too old at ``t_ns`` [ns]."""
        if self.is_confirmed and abs(t_ns - self._confirmed_ns) > FORGET_CYCLES * self._cycle_ns:
            self.is_confirmed, self._conflicts = False, 0
