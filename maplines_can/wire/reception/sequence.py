"""Checks of the records of one slot: E2E state, lost records, late records and duplicates."""

from __future__ import annotations

import math
from collections import Counter
from typing import NamedTuple

from ..protection.e2e_state import E2EConfig, E2EState, ProfileStatus, StateMachine, check
from ..reasons import Reason
from .history import GRACE_CYCLES, ReceptionDeadline, RecordHistory, SenderConflict

OK, NONEWDATA, ERROR, REPEATED, OKSOMELOST, WRONGSEQUENCE = ProfileStatus

#: Number of consecutive records behind the last new one that indicate a restart.
RESTART_RECORDS = 3
#: A sender may be early by this much [cycles].
JITTER_CYCLES = 0.5
#: The time between two lines is a mean over about this many.
MEAN_LINES = 8
#: A sender may be faster than the cycle time by this factor.
FASTEST = 10


class SlotStats(NamedTuple):
    """Snapshot of the checks of a slot."""

    state: E2EState
    status: ProfileStatus | None  #: of the last check; None before the first
    ok: int  #: records accepted in sequence (OK or OKSOMELOST)
    lost: int  #: records missing between those, according to their counters
    repeated: int
    wrong_sequence: int
    errors: int
    no_new_data: int  #: cycles without a record
    two_senders: bool  #: detected in the last 256 cycles


class SequenceCheck:
    """Checks of the records of one slot, and its E2E state machine; time is an argument.

    Each record is one check. Each cycle without a record is a check too, with the status NONEWDATA
    (see ``ReceptionDeadline``). ``elapse`` brings the state up to a given time.

    The counter decides whether a record with a correct checksum is new. In the table, counters are
    modulo ``modulus``, and

    - ``last`` is the counter of the last new record;
    - ``span`` is the number of records (mixture components) of the line that was delivered last;
    - ``most`` is the number of records that the sender can have sent since the last new one, but
      at least ``max_delta`` and less than half of ``modulus``. In t cycles a sender can send
      ceil(t + 0.5) lines, each with the greatest number of components received so far. A cycle is
      ``cycle_ns``, or the mean time between two lines of a faster sender.

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

    If no new record came for a whole window of the state machine, a record of the last three rows
    is a restart. Within the window, a record of the last two rows is late or its sender has
    restarted. It is a restart once three or more of them have come with consecutive counters, with
    no new record in between, and late records are ruled out:

    - the last came at least 1.5 cycles after the first;
    - the first counter is less than ``max_delta``, since a sender that restarts begins at 0;
    - one of the counters was received before with different content.

    ::

        new      new      restart: the first two records are dropped; the slot is not VALID then
        41       42        0        1        2        3
        |--------|--------|--------|--------|--------|-----> time
                           STALE    STALE    new      new

        new      new      late, held back by a gateway; the sender goes on
        41       42        30 31 32  43
        |--------|--------|||-------|-----> time
                           STALE    new

    Within a window after the last new record, a record that is late by L records is therefore not
    delivered if L is less than ``modulus - most``. The counter cannot detect these late records:

    - A record that is late by ``modulus - max_delta`` or more looks like one of the next records.
      It is delivered, and the state stays VALID. By default these are 240 to 255 records: 12 s of
      single lines at 20 Hz, but 1.5 s of lines of 8 components. A smaller ``max_delta`` narrows the
      range.
    - A record that is late by ``modulus - most`` or more is delivered with a break, so the slot is
      not VALID.
    - After a window without a new record, late records are delivered with a break, like those of a
      restarted sender. If eight follow in sequence, the slot becomes VALID.
    - A record that is late by ``modulus`` records more looks the same.

    If more than ``most`` records of a sender are lost in a row, because it is more than ten times
    faster than ``cycle_ns`` or has just become faster, the next ones are dropped until the window
    is over, or if the clock stands still, until the counter has wrapped around. With
    authentication, each record is known to be newer than the last one: ``most`` is half of
    ``modulus`` less 1, and any record beyond it is a restart.

    Two decisions go beyond AUTOSAR; both err on the safe side:

    - After a sequence break (``break``), the window holds results of the old sequence. It is
      cleared, so VALID is left at once and regained after ``min_ok_state_invalid`` OKs.
    - A record of the last line stays REPEATED however long the slot was silent. A transfer that a
      gateway held back and a sender that restarted at exactly that counter look the same. Dropping
      a restarted sender's record costs one cycle; accepting a held-back one delivers an old line.

    Args:
        config: windows and bounds.
        modulus: counter modulus.
        pages: frames of a classic record.
        cycle_ns: time between records [ns]; one period per mixture, not per component.
        is_authentic: records are authenticated, and each is newer than the last one.
    """

    def __init__(
        self,
        config: E2EConfig,
        modulus: int,
        pages: int,
        cycle_ns: int,
        *,
        is_authentic: bool = False,
    ) -> None:
        self.cycle_ns = cycle_ns
        self.statuses: Counter[ProfileStatus] = Counter()  #: checks by outcome
        self.status: ProfileStatus | None = None  #: of the last check
        self.lost = 0  #: records missing between those received, according to their counters
        #: By how much the counter of the last new record is ahead of the one before; 1 for the
        #: first record, None after a sequence break.
        self.ahead: int | None = None
        self._pages, self._is_authentic = pages, is_authentic
        self._duplicated_frames = 0  # since the last new record
        self._machine = StateMachine(config)
        self._deadline = ReceptionDeadline(cycle_ns)
        self._counters = _CounterCheck(config, modulus, cycle_ns, is_authentic)
        self._conflict = self._counters.conflict

    @property
    def state(self) -> E2EState:
        """State of the slot, as far as time has elapsed."""
        return self._machine.state

    @property
    def counter(self) -> int | None:
        """Counter of the last new record; None before the first."""
        return self._counters.last

    @property
    def two_senders(self) -> bool:
        """Whether two senders were detected in the last 256 cycles."""
        return self._conflict.is_confirmed

    def has_one_sender(self, t_ns: int) -> bool:
        """Return whether no second sender is detected or suspected at ``t_ns`` [ns]."""
        return not (self.two_senders or self._conflict.is_suspected(t_ns))

    def counter_was_reused(self, t_ns: int) -> bool:
        """Return whether a counter came with two contents in the last cycles: two senders."""
        return self._conflict.was_reused(t_ns)

    def received(self, counter: int, content: int, t_ns: int, records: int = 1) -> Reason | None:
        """Check a record whose checksum is correct.

        Args:
            counter: of the record.
            content: hash of the record, to recognise duplicates.
            t_ns: time of reception [ns].
            records: number of records of its line (mixture components).

        Returns:
            None if the record is new; DUPLICATE or STALE if it must not be delivered.
        """
        self._record_arrived(t_ns)
        found = self._counters.check(counter, content, t_ns, records)
        if found.reason is None:
            self._duplicated_frames = 0
            self.lost += found.lost
            self.ahead = found.ahead
            if found.ahead is None:
                self._machine.clear()
        self._step(found.status)
        return found.reason

    def delivered(self, records: int) -> None:
        """Note that the last new record completed a line of this many records."""
        self._counters.delivered(records)

    def failed(self, t_ns: int) -> None:
        """Count a damaged record or frame as an ERROR check."""
        self._record_arrived(t_ns)
        self._step(ERROR)

    def frame_dropped(self, reason: Reason, t_ns: int) -> None:
        """Check a frame that is in no record, by the reason why it was dropped.

        A frame with a wrong page or length is an ERROR check, and ``pages`` duplicated frames are
        one REPEATED check. All others are none: as in AUTOSAR, what is not authentic does not reach
        the E2E check. With authentication, a frame with a wrong length is not authentic.
        """
        if reason is Reason.PAGE or (reason is Reason.LENGTH and not self._is_authentic):
            self.failed(t_ns)
        elif reason is Reason.DUPLICATE:
            self._duplicated_frames += 1
            if self._duplicated_frames % self._pages == 0:
                self._record_arrived(t_ns)
                if self._duplicated_frames == self._pages:
                    self._conflict.duplicate(t_ns)
                self._step(REPEATED)

    def elapse(self, t_ns: int) -> E2EState:
        """Step with NONEWDATA for each cycle missed up to ``t_ns`` [ns]; return the state."""
        self._conflict.elapse(t_ns)
        self._step_without_data(self._deadline.elapse(t_ns))
        return self.state

    def stats(self) -> SlotStats:
        """Return a snapshot of all counters."""
        n = self.statuses
        return SlotStats(
            state=self.state,
            status=self.status,
            ok=n[OK] + n[OKSOMELOST],
            lost=self.lost,
            repeated=n[REPEATED],
            wrong_sequence=n[WRONGSEQUENCE],
            errors=n[ERROR],
            no_new_data=n[NONEWDATA],
            two_senders=self.two_senders,
        )

    def _record_arrived(self, t_ns: int) -> None:
        self._conflict.elapse(t_ns)
        self._step_without_data(self._deadline.record_arrived(t_ns))

    def _step(self, status: ProfileStatus) -> None:
        self.status = status
        self.statuses[status] += 1
        self._machine.step(status)

    def _step_without_data(self, cycles: int) -> None:
        if not cycles:
            return
        self.status = NONEWDATA
        self.statuses[NONEWDATA] += cycles
        for _ in range(min(cycles, self._machine.config.window_size_valid)):
            self._machine.step(NONEWDATA)


class _Found(NamedTuple):
    """Result of the check of a counter."""

    status: ProfileStatus
    reason: Reason | None = None  #: why the record is not delivered; None if it is new
    ahead: int | None = 1  #: by how much it is ahead of the last one; None after a sequence break
    lost: int = 0  #: records missing before this one


class _CounterCheck:
    """Check of the counters of a slot, by the table of ``SequenceCheck``."""

    def __init__(self, config: E2EConfig, modulus: int, cycle_ns: int, is_authentic: bool) -> None:
        self.conflict = SenderConflict(cycle_ns)
        self._history, self._pace = RecordHistory(modulus), _Pace(cycle_ns, modulus)
        self._max_delta, self._modulus = config.max_delta_counter, modulus
        self._window_ns = config.window_size_valid * cycle_ns
        self._grace_ns = int(GRACE_CYCLES * cycle_ns)
        self._is_authentic = is_authentic
        self.last: int | None = None  #: counter of the last new record
        self._new_ns = 0  # its time
        self._left: int | None = None  # last counter before that, if there was a gap
        # Records of the line delivered last; 1 while a later line is incomplete.
        self._span = 1

    def check(self, counter: int, content: int, t_ns: int, records: int) -> _Found:
        """Check the counter of a record; remember a new one."""
        status, last = check(counter, self.last, self._max_delta, self._modulus), self.last
        if status is OK or last is None:
            self.conflict.next()
            self._accept(counter, content, t_ns, 1)
            return _Found(OK)
        ahead, waited_ns = (counter - last) % self._modulus, abs(t_ns - self._new_ns)
        is_newer = 0 < ahead <= self._most_ahead(waited_ns, records)
        if not is_newer:
            behind = (last - counter) % self._modulus
            reason = self._why_not_new(counter, content, behind, t_ns)
            if reason is not None:
                return _Found(REPEATED if behind < self._span else WRONGSEQUENCE, reason)
            ahead = self._modulus  # the history is that of another sequence
        if self._left is not None and (counter - self._left) % self._modulus == 1:
            self.conflict.conflict(t_ns)  # back to the sequence before the break
        self._left = last
        is_gap = status is OKSOMELOST
        if is_gap and self._pace.is_ahead(ahead, waited_ns, records):
            self.conflict.ahead(t_ns)
        self._accept(counter, content, t_ns, ahead)
        # A sender restarts at 0: nothing is lost then.
        lost = ahead - 1 if is_gap or (is_newer and counter != 0) else 0
        return _Found(status, None, ahead if is_gap else None, lost)

    def delivered(self, records: int) -> None:
        """Note that the last new record completed a line of this many records."""
        self._span = records
        if self.last is not None:
            self._pace.delivered(self.last, self._new_ns, records)

    def _accept(self, counter: int, content: int, t_ns: int, ahead: int) -> None:
        self._history.add_new(counter, content, ahead)
        self.conflict.new()
        self.last, self._new_ns, self._span = counter, t_ns, 1

    def _most_ahead(self, waited_ns: int, records: int) -> int:
        """Return the greatest difference of the counter of a newer record from the last new one.

        With authentication it is not limited by time: the freshness value excludes older records.
        """
        half = self._modulus // 2 - 1
        if self._is_authentic:
            return half
        return min(half, max(self._max_delta, self._pace.most(waited_ns, records)))

    def _why_not_new(self, counter: int, content: int, behind: int, t_ns: int) -> Reason | None:
        """Return why a record ``behind`` the last new one is not delivered; None if it is new."""
        is_duplicate = self._history.is_duplicate(counter, content, behind)
        if not is_duplicate:
            self.conflict.late(t_ns)
        # Farther back, it may be of a sender that restarted in a car that stands.
        is_near = behind <= self._max_delta
        if is_duplicate and is_near and self._history.mark_duplicated(counter, behind):
            self.conflict.duplicate(t_ns)
        if behind < self._span:
            if not is_duplicate:
                self.conflict.counter_reused(t_ns)
            return Reason.DUPLICATE if is_duplicate else Reason.STALE
        if self._is_authentic or abs(t_ns - self._new_ns) > self._window_ns:
            return None
        if is_duplicate:
            return Reason.DUPLICATE
        has_other = self._history.has_other(counter, content, behind)
        self._history.add_late(counter, content, behind)
        if has_other:
            self.conflict.counter_reused(t_ns)
        elif self._is_of_another_sequence(counter, behind):
            self.conflict.conflict(t_ns)
        return None if self._is_restart(counter, t_ns, is_other=has_other) else Reason.STALE

    def _is_of_another_sequence(self, counter: int, behind: int) -> bool:
        """Return whether a record is too far behind to be merely delayed, and fills no gap."""
        is_far = behind > self._max_delta * self._pace.longest_line
        return is_far and not self._history.fills_gap(counter, behind)

    def _is_restart(self, counter: int, t_ns: int, *, is_other: bool) -> bool:
        """Return whether the records behind the last new one are those of a restarted sender."""
        run = self._history.run_with(counter, t_ns, is_other=is_other)
        is_long = abs(t_ns - run.since_ns) >= self._grace_ns
        if run.records < RESTART_RECORDS or not is_long:
            return False
        if not (run.is_other and run.first < self._max_delta):
            return False
        self.conflict.retract()
        return True


class _Pace:
    """Rate of the records of a sender, as far as it is known."""

    def __init__(self, cycle_ns: int, modulus: int) -> None:
        self._cycle_ns, self._modulus = float(cycle_ns), modulus
        self.longest_line = 1  #: greatest number of records of a line so far
        self._line_ns = self._cycle_ns  # mean time between two lines in sequence
        self._line: tuple[int, int] | None = None  # counter and time of the last line

    def delivered(self, counter: int, t_ns: int, records: int) -> None:
        """Add a line of this many records, by the counter and the time of the last one."""
        self.longest_line = max(self.longest_line, records)
        if self._line is not None and (counter - self._line[0]) % self._modulus == records:
            self._line_ns += (abs(t_ns - self._line[1]) - self._line_ns) / MEAN_LINES
        self._line = counter, t_ns

    def most(self, waited_ns: int, records: int) -> int:
        """Return how many records a sender can have sent in a time [ns]."""
        return math.ceil(self._lines(waited_ns)) * max(self.longest_line, records)

    def is_ahead(self, ahead: int, waited_ns: int, records: int) -> bool:
        """Return whether a newer record is ahead of what its sender should have sent by now."""
        return ahead > max(1.0, self._lines(waited_ns)) * max(self.longest_line, records)

    def _lines(self, waited_ns: int) -> float:
        """Return how many lines a sender can have sent in a time: 1.3 is 1 or 2."""
        line_ns = min(max(self._line_ns, self._cycle_ns / FASTEST), self._cycle_ns)
        return float(waited_ns) / line_ns + JITTER_CYCLES
