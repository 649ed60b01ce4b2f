"""What time it is on the clock of the frames' time stamps."""

from __future__ import annotations

__all__ = ["StampClock"]

#: A clock that is behind for so long was set back; a queue is empty sooner [ns].
SETTLED_NS = 1_000_000_000
#: A frame that waited for less is not behind [ns].
IN_TIME_NS = 20_000_000


class StampClock:
    """Now, on the clock of the time stamps, by a clock of ours that goes on.

    Frames wait in the kernel's queue, up to seconds where this process was stopped. A
    stamp is of its frame's arrival there, so the frame that waited least tells the time best, and
    the last one may be long past. Only where all frames are behind for a second
    has their clock been set back; until then lines look older than they are.

    >>> clock = StampClock()
    >>> clock.heard(5_000_000_000, 0)
    >>> clock.heard(5_100_000_000, 3_000_000_000)  # it has waited for 2.9 s
    >>> clock.now(3_000_000_000)
    8000000000
    """

    def __init__(self) -> None:
        self._ahead_ns: int | None = None  # of our clock, by the frame that waited least
        self._behind_ns = 0  # the same of the frames that are all behind it
        self._behind_since_ns: int | None = None

    def heard(self, stamp_ns: int, at_ns: int) -> None:
        """A frame was taken at ``at_ns`` on our clock."""
        ahead_ns = stamp_ns - at_ns
        if self._ahead_ns is None or ahead_ns > self._ahead_ns - IN_TIME_NS:
            self._ahead_ns = max(ahead_ns, self._ahead_ns or ahead_ns)
            self._behind_since_ns = None
        elif self._behind_since_ns is None:
            self._behind_since_ns, self._behind_ns = at_ns, ahead_ns
        else:
            self._behind_ns = max(self._behind_ns, ahead_ns)
            if at_ns - self._behind_since_ns > SETTLED_NS:
                self._ahead_ns, self._behind_since_ns = self._behind_ns, None

    def now(self, at_ns: int) -> int:
        """The time of the stamps' clock at ``at_ns`` on ours [ns]; before the first frame, ours."""
        return at_ns + (self._ahead_ns or 0)
