"""What the records of one slot are worth: E2E checks, lost lines, a second sender."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

from .e2e_state import E2EConfig, E2EState, ProfileStatus, StateMachine, check
from .reassembly import Reason

__all__ = ["SlotCheck", "SlotStats"]

OK, NONEWDATA, ERROR, REPEATED, OKSOMELOST, WRONGSEQUENCE = ProfileStatus

#: After so many cycles without a record the first is missed: its time may jitter by half a cycle.
GRACE = 1.5
#: So many records in a row that are behind are a sender that has started anew.
TAKEN_OVER = 3
#: Traces of a second sender, so near each other, that make it certain. A burst that a gateway holds
#: up leaves one or two; two senders leave one in each cycle of the slower.
CERTAIN = 8
#: Most good records between two traces.
NEAR = 32


class SlotStats(NamedTuple):
    """A copy of what is known of a slot."""

    state: E2EState
    status: ProfileStatus | None  #: of the last check; None before the first
    ok: int  #: records with the next counter, or one that lets some be missing
    lost: int  #: records missing between those, by their counters
    repeated: int
    wrong_sequence: int
    errors: int
    no_new_data: int  #: cycles without a record
    two_senders: bool


class _Behind(NamedTuple):
    """Records that came after a newer one, each following the one before."""

    last: int  #: counter of the last
    since_ns: int  #: time of the first
    records: int = 1


class SlotCheck:
    """The checks of one slot and its state machine; time is an argument.

    Each record that comes is one check. So is each cycle without one: NONEWDATA falls
    due 1.5 cycles after the last record and every cycle after that, whoever asks and
    however often; ``elapse`` brings it up to now.

    Two decisions go beyond AUTOSAR, both to the safe side:

    - A counter that jumps is a sender that has started anew, or another one. What the window
      holds is of another sequence: it is cleared, so VALID is left at once and comes back
      after ``min_ok_state_invalid`` OKs. A jump forward is delivered. A step back may be
      an old line that came late: it is not delivered unless it is the third in a row, 1.5
      cycles after the first, with nothing of the other sequence between, or no news came
      for a whole window. A sender that starts anew so loses two lines, before it is VALID.
    - REPEATED is, for a mixture, any record of the last one delivered; and it stays
      REPEATED however long the slot was silent. A burst that a gateway held back and a sender
      that has started anew at that very counter look the same; to refuse the
      first line of the latter costs a cycle, to take the former for news a wrong line.

    Two senders show by sequences that both go on: between two good records there is, again
    and again, one of another sequence. The lines of one of the two are delivered. A path on
    which all comes twice looks like that too.

    Args:
        config: windows and bounds.
        modulus: how many counters there are.
        pages: frames of a classic record.
        cycle_ns: how often records come [ns]; those of a mixture count together.
        is_proven: records are authentic and each newer than the last, so that none is old.
    """

    def __init__(
        self,
        config: E2EConfig,
        modulus: int,
        pages: int,
        cycle_ns: int,
        *,
        is_proven: bool = False,
    ) -> None:
        self.cycle_ns = cycle_ns
        self.statuses: Counter[ProfileStatus] = Counter()  #: checks by outcome
        self.status: ProfileStatus | None = None  #: of the last check
        self.lost = 0  #: records missing between those that came, by their counters
        self.two_senders = False  #: certain since some time
        self._machine = StateMachine(config)
        self._is_proven = is_proven
        self._max_delta, self._modulus, self._pages = config.max_delta_counter, modulus, pages
        self._grace_ns = int(GRACE * cycle_ns)
        self._silence_ns = config.window_size_valid * cycle_ns
        self._due_ns: int | None = None  # when the next cycle is missed
        self._is_counted = False  # up to then, by who asked: a backlog is not counted again
        self._counter: int | None = None  # of the last record that was news
        self._news_ns = 0  # its time
        self._behind: _Behind | None = None  # since then
        self._left: int | None = None  # the counter at which a sequence was left last
        self._span = 1  # records of the line that was delivered last, if with the last record
        self._late_frames = 0  # since the last record
        self._traces = self._good_at_trace = 0

    @property
    def state(self) -> E2EState:
        """What the slot is worth now, as far as time has elapsed."""
        return self._machine.state

    def received(self, counter: int, t_ns: int) -> Reason | None:
        """Check a record whose checksum holds.

        Returns:
            None where it is news; DUPLICATE or STALE where it is not to be delivered.
        """
        self._arrive(t_ns)
        last = self._counter
        status = check(counter, last, self._max_delta, self._modulus)
        if status is not OK and last is not None:
            behind = (last - counter) % self._modulus
            if late := self._why_late(counter, behind, t_ns):
                self._late(self._pages)
                self._step(REPEATED if late is Reason.DUPLICATE else WRONGSEQUENCE)
                return late
            starts_anew = status is WRONGSEQUENCE and counter == 0
            if behind > self._modulus // 2 and not starts_anew:
                self.lost += self._modulus - behind - 1
            if self._left is not None and check(counter, self._left, 1, self._modulus) is OK:
                self._trace()
            self._left = last
            if status is WRONGSEQUENCE:
                self._machine.clear()
        self._counter, self._news_ns, self._behind = counter, t_ns, None
        self._span = 1
        self._late_frames = 0
        self._step(status)
        return None

    def delivered(self, records: int) -> None:
        """The last record was the last of a line of so many."""
        self._span = records

    def failed(self, t_ns: int) -> None:
        """What came was no record that holds."""
        self._arrive(t_ns)
        self._step(ERROR)

    def dropped(self, reason: Reason, frames: int, t_ns: int) -> None:
        """Reassembly dropped frames as late; so many as make a record are one check."""
        if self._late(frames):
            self._arrive(t_ns)
            again = reason is Reason.DUPLICATE
            self._step(REPEATED if again else WRONGSEQUENCE)

    def elapse(self, t_ns: int) -> E2EState:
        """Count NONEWDATA for the cycles that have gone by without a record until ``t_ns`` [ns]."""
        if self._due_ns is None:
            return self.state
        missed = (t_ns - self._due_ns) // self.cycle_ns + 1
        if missed > 0:
            self._due_ns += missed * self.cycle_ns
            self.statuses[NONEWDATA] += missed
            self.status = NONEWDATA
            for _ in range(min(missed, self._machine.config.window_size_valid)):
                self._machine.step(NONEWDATA)
            self._is_counted = True
        elif self._due_ns - t_ns > self._grace_ns + self.cycle_ns:  # the clock was set back
            self._due_ns, self._is_counted = t_ns + self._grace_ns, False
        return self.state

    def stats(self) -> SlotStats:
        """A copy of all counters."""
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

    def _arrive(self, t_ns: int) -> None:
        due_ns = t_ns + self._grace_ns
        if self._due_ns is not None:
            if t_ns >= self._due_ns:
                self.elapse(t_ns)
            elif self._is_counted and due_ns < self._due_ns:
                return
        self._due_ns, self._is_counted = due_ns, False

    def _step(self, status: ProfileStatus) -> None:
        self.status = status
        self.statuses[status] += 1
        self._machine.step(status)

    def _follows(self, counter: int, last: int) -> bool:
        return check(counter, last, self._max_delta, self._modulus) in (OK, OKSOMELOST)

    def _why_late(self, counter: int, behind: int, t_ns: int) -> Reason | None:
        """Why a record that is not the next is no news; None where it is."""
        if behind < self._span:
            return Reason.DUPLICATE
        if self._is_proven or behind > self._modulus // 2:
            return None
        was_silent = abs(t_ns - self._news_ns) > self._silence_ns
        return None if was_silent or self._goes_on(counter, t_ns) else Reason.STALE

    def _goes_on(self, counter: int, t_ns: int) -> bool:
        """Whether a record that is behind belongs to a sequence that has taken over."""
        behind = self._behind
        if behind is None or not self._follows(counter, behind.last):
            self._behind = _Behind(counter, t_ns)
            return False
        behind = self._behind = behind._replace(last=counter, records=behind.records + 1)
        if behind.records < TAKEN_OVER or abs(t_ns - behind.since_ns) < self._grace_ns:
            return False
        self._traces = max(0, self._traces - 1)  # what it left was none of a second sender
        return True

    def _late(self, frames: int) -> bool:
        """Whether frames that bring no news make up one more record."""
        before = self._late_frames // self._pages
        self._late_frames += frames
        now = self._late_frames // self._pages
        if not before and now:  # once a record: what is stuck repeats itself, and nothing goes on
            self._trace()
        return now > before

    def _trace(self) -> None:
        good = self.statuses[OK]
        if good - self._good_at_trace > NEAR:
            self._traces = 0
        self._traces, self._good_at_trace = self._traces + 1, good
        self.two_senders |= self._traces >= CERTAIN
