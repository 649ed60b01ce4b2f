"""Estimate the present time on the clock of the frames' time stamps."""

from __future__ import annotations

#: If all frames are late for longer than this, their clock was set back [ns].
SET_BACK_NS = 1_000_000_000
#: A frame that waited less than this is not late [ns].
LATE_NS = 20_000_000
#: Time on our clock over which the decrease of the waiting time is measured [ns].
SETTLE_NS = 200_000_000
#: A decrease of the waiting time by this or more within SETTLE_NS indicates a backlog [ns].
GAIN_NS = 50_000_000


class StampClock:
    """Estimator of the present time on the clock of the time stamps.

    A frame is stamped when it arrives at the kernel.  It then waits in the receive queue, for
    seconds if this process was suspended::

        arrival (stamp)     1  2  3  4  5  6  7  8  9
        read (our clock)                123456  7  8  9     frames 1 to 6 are a backlog

    The offset between the clocks is therefore taken from the frame that waited least, and not
    from the last one.  If all frames are late for a second, the clock of the stamps
    was set back, and the offset is set again; until then lines look older than they are.

    At the start, all frames may be from a backlog, and nothing shows how long the first one has
    waited.  But a backlog is read faster than it arrived: the frames wait less and less.
    The clock has settled (``is_settled``) once the waiting time has fallen by less than 50 ms over
    0.2 s.  This works on a busy bus, where
    the queue may never be empty, and needs no common origin of the two clocks.  A clock that
    is set forward looks like a backlog for 0.2 s.  A queue of constant length is not noticed.

    >>> clock = StampClock()
    >>> clock.add(5_000_000_000, 0)
    >>> clock.add(5_100_000_000, 3_000_000_000)  # it has waited for 2.9 s
    >>> clock.now(3_000_000_000), clock.is_settled
    (8000000000, True)
    """

    def __init__(self) -> None:
        self._offset_ns: int | None = None  # stamp minus our clock, of the frame that waited least
        self._late_offset_ns = 0  # the same, of the frames that are late
        self._late_since_ns: int | None = None
        #: True once the queueing delay has stopped falling (less than 50 ms in 0.2 s).
        self.is_settled = False
        self._base_offset_ns = self._base_at_ns = 0  # offset at the start of the 0.2 s

    def add(self, stamp_ns: int, at_ns: int) -> None:
        """Update the clock offset from a frame's time stamp, read at ``at_ns`` on our clock."""
        offset_ns = stamp_ns - at_ns
        if self._offset_ns is None:
            self._offset_ns = self._base_offset_ns = offset_ns
            self._base_at_ns = at_ns
        elif offset_ns > self._offset_ns - LATE_NS:
            self._offset_ns = max(offset_ns, self._offset_ns)
            self._late_since_ns = None
        elif self._late_since_ns is None:
            self._late_since_ns, self._late_offset_ns = at_ns, offset_ns
        else:
            self._late_offset_ns = max(self._late_offset_ns, offset_ns)
            if at_ns - self._late_since_ns > SET_BACK_NS:
                self._offset_ns, self._late_since_ns = self._late_offset_ns, None
                self._base_offset_ns = self._offset_ns
        gained = self._offset_ns - self._base_offset_ns >= GAIN_NS
        if gained or at_ns - self._base_at_ns >= SETTLE_NS:
            self.is_settled = not gained
            self._base_offset_ns, self._base_at_ns = self._offset_ns, at_ns

    def now(self, at_ns: int) -> int:
        """Return the time of the stamps' clock at ``at_ns`` on ours [ns].

        Before the first frame, that is ``at_ns``.
        """
        return at_ns + (self._offset_ns or 0)
