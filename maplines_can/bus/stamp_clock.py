"""What time it is on the clock of the frames' time stamps."""

from __future__ import annotations

__all__ = ["StampClock"]

#: A clock that is behind for so long was set back; a queue is empty sooner [ns].
SETTLED_NS = 1_000_000_000
#: A frame that waited for less is not behind [ns].
IN_TIME_NS = 20_000_000
#: Of a backlog the frames of so long a time of ours ... [ns]
STEADY_NS = 200_000_000
#: ... waited less and less, by this in all or more [ns].
GAIN_NS = 50_000_000


class StampClock:
    """Now, on the clock of the time stamps, by a clock of ours that goes on.

    Frames wait in the kernel's queue, up to seconds where this process was stopped. A
    stamp is of its frame's arrival there, so the frame that waited least tells the time best, and
    the last one may be long past. Only where all frames are behind for a second
    has their clock been set back; until then lines look older than they are.

    At the start all frames may be of a backlog, and nothing tells how long even the best of them
    waited. But a backlog is taken faster than it came: from frame to frame they waited less.
    ``steady`` is whether that is over: for 0.2 s of our clock, with a frame at both
    ends, none waited less by 50 ms than those before. It needs no empty queue, which on
    a busy bus there may never be, and no common origin with the stamps. A clock that is set
    forward looks like a backlog for as long; a queue whose length stays looks like none.

    >>> clock = StampClock()
    >>> clock.heard(5_000_000_000, 0)
    >>> clock.heard(5_100_000_000, 3_000_000_000)  # it has waited for 2.9 s
    >>> clock.now(3_000_000_000), clock.steady
    (8000000000, True)
    """

    def __init__(self) -> None:
        self._ahead_ns: int | None = None  # of our clock, by the frame that waited least
        self._behind_ns = 0  # the same of the frames that are all behind it
        self._behind_since_ns: int | None = None
        #: Whether frames come as fast as time goes by, so that ``now`` is now.
        self.steady = False
        self._base_ns = self._base_at_ns = 0  # how far ahead it was when the 0.2 s began

    def heard(self, stamp_ns: int, at_ns: int) -> None:
        """A frame was taken at ``at_ns`` on our clock."""
        ahead_ns = stamp_ns - at_ns
        if self._ahead_ns is None:
            self._ahead_ns = self._base_ns = ahead_ns
            self._base_at_ns = at_ns
        elif ahead_ns > self._ahead_ns - IN_TIME_NS:
            self._ahead_ns = max(ahead_ns, self._ahead_ns)
            self._behind_since_ns = None
        elif self._behind_since_ns is None:
            self._behind_since_ns, self._behind_ns = at_ns, ahead_ns
        else:
            self._behind_ns = max(self._behind_ns, ahead_ns)
            if at_ns - self._behind_since_ns > SETTLED_NS:
                self._ahead_ns, self._behind_since_ns = self._behind_ns, None
                self._base_ns = self._ahead_ns
        gained = self._ahead_ns - self._base_ns >= GAIN_NS
        if gained or at_ns - self._base_at_ns >= STEADY_NS:
            self.steady = not gained
            self._base_ns, self._base_at_ns = self._ahead_ns, at_ns

    def now(self, at_ns: int) -> int:
        """The time of the stamps' clock at ``at_ns`` on ours [ns]; before the first frame, ours."""
        return at_ns + (self._ahead_ns or 0)
