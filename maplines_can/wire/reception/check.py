"""What can be read of the checks of the records of a slot or of the pose error."""

from __future__ import annotations

from collections import Counter
from typing import Protocol

from ..protection.e2e_state import E2EState, ProfileStatus
from .sequence import SlotStats


class Check(Protocol):
    """Checks of the records of one owner, as ``SequenceCheck`` makes them."""

    @property
    def cycle_ns(self) -> int:
        """Time between records [ns]."""

    @property
    def state(self) -> E2EState:
        """State of the owner, as far as time has elapsed."""

    @property
    def status(self) -> ProfileStatus | None:
        """Status of the last check; None before the first."""

    @property
    def statuses(self) -> Counter[ProfileStatus]:
        """Checks by outcome."""

    @property
    def lost(self) -> int:
        """Records missing between those received, according to their counters."""

    @property
    def counter(self) -> int | None:
        """Counter of the last new record; None before the first."""

    @property
    def ahead(self) -> int | None:
        """By how much the last new record is ahead of the one before; None after a break."""

    @property
    def two_senders(self) -> bool:
        """Whether two senders were detected in the last 256 cycles."""

    def has_one_sender(self, t_ns: int) -> bool:
        """Return whether no second sender is detected or suspected at ``t_ns`` [ns]."""

    def counter_was_reused(self, t_ns: int) -> bool:
        """Return whether a counter came with two contents in the last cycles: two senders."""

    def elapse(self, t_ns: int) -> E2EState:
        """Step with NONEWDATA for each cycle missed up to ``t_ns`` [ns]; return the state."""

    def stats(self) -> SlotStats:
        """Return a snapshot of all counters."""
