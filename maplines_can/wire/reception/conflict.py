"""Detector of a second sender on a slot."""

from __future__ import annotations

import math

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
#: Time of what has not happened.
NEVER_NS = math.inf


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
        cycles = abs(t_ns - self._conflict_ns) / self._cycle_ns
        if cycles < 0.5 or self._is_blocked:
            return
        self._conflicts = self._conflicts + 1 if cycles <= NEAR_CYCLES else 1
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
