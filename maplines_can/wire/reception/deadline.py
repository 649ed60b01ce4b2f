"""Reception deadline of a slot: cycles that pass without a record."""

from __future__ import annotations

#: The first cycle without a record is declared missed this many cycles after the last record,
#: since the time of a record may jitter by half a cycle.
GRACE_CYCLES = 1.5


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
