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
#: Traces of a second sender, without a round of good counters between two, that make it certain. A
#: burst that a gateway holds up leaves one or two; two senders leave one or two in each cycle.
CERTAIN = 8


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


class SlotCheck:
    """The checks of one slot and its state machine; time is an argument.

    Each record that comes is one check. So is each cycle without one: NONEWDATA falls
    due 1.5 cycles after the last record and every cycle after that, whoever asks and
    however often; ``elapse`` brings it up to now.

    Two decisions go beyond AUTOSAR, both to the safe side:

    - A counter that jumps is a sender that has started anew, or another one. Its record is
      good and is delivered, but what the window holds is of another sequence: it is
      cleared, so VALID is left at once and comes back after ``min_ok_state_invalid`` OKs.
    - REPEATED is, for a mixture, any record of the last one delivered; and it stays
      REPEATED however long the slot was silent. A burst that a gateway held back and a sender
      that has started anew at that very counter look the same; to refuse the
      first line of the latter costs a cycle, to take the former for news a wrong line.

    Two senders show by sequences that both go on, in turns: a record that does not follow
    the one before it, but the one at which the sequence was last left. Where they are so
    near in time that reassembly drops one of them as late, its bursts between good
    records are the trace. A path on which all comes twice looks like that too.

    Args:
        config: windows and bounds.
        modulus: how many counters there are.
        pages: frames of a classic record.
        cycle_ns: how often records come [ns]; those of a mixture count together.
    """

    def __init__(self, config: E2EConfig, modulus: int, pages: int, cycle_ns: int) -> None:
        self.cycle_ns = cycle_ns
        self.statuses: Counter[ProfileStatus] = Counter()  #: checks by outcome
        self.status: ProfileStatus | None = None  #: of the last check
        self.lost = 0  #: records missing between those that came, by their counters
        self.two_senders = False  #: certain since some time
        self._machine = StateMachine(config)
        self._max_delta, self._modulus, self._pages = config.max_delta_counter, modulus, pages
        self._grace_ns = int(GRACE * cycle_ns)
        self._due_ns: int | None = None  # when the next cycle is missed
        self._counter: int | None = None  # of the last record
        self._left: int | None = None  # the counter at which the sequence was left last
        self._good_at_left = 0
        self._span = 1  # records of the line that was delivered last, if with the last record
        self._late_frames = 0  # since the last record
        self._traces = self._good_at_trace = 0

    @property
    def state(self) -> E2EState:
        """What the slot is worth now, as far as time has elapsed."""
        return self._machine.state

    def received(self, counter: int, t_ns: int) -> ProfileStatus:
        """Check a record whose checksum holds; deliver it unless it is REPEATED."""
        self._arrive(t_ns)
        last = self._counter
        status = check(counter, last, self._max_delta, self._modulus)
        if status is not OK and last is not None:
            if (last - counter) % self._modulus < self._span:
                self._late(self._pages)
                return self._step(REPEATED)
            self._break(counter, last, status)
        self._counter = counter
        self._span = 1
        self._late_frames = 0
        return self._step(status)

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
        elif self._due_ns - t_ns > self._grace_ns + self.cycle_ns:  # the clock was set back
            self._due_ns = t_ns + self._grace_ns
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
        if self._due_ns is not None and t_ns >= self._due_ns:
            self.elapse(t_ns)
        self._due_ns = t_ns + self._grace_ns

    def _step(self, status: ProfileStatus) -> ProfileStatus:
        self.status = status
        self.statuses[status] += 1
        self._machine.step(status)
        return status

    def _break(self, counter: int, last: int, status: ProfileStatus) -> None:
        """A record does not follow the last one."""
        good = self.statuses[OK]
        recent = self._left is not None and good - self._good_at_left < self._modulus // 2
        if recent and check(counter, self._left, 1, self._modulus) is OK:
            self._trace()
        else:
            delta = (counter - last) % self._modulus
            self.lost += delta - 1 if delta <= self._modulus // 2 else 0
        self._left, self._good_at_left = last, good
        if status is WRONGSEQUENCE:
            self._machine.clear()

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
        if good - self._good_at_trace > self._modulus:
            self._traces = 0
        self._traces, self._good_at_trace = self._traces + 1, good
        self.two_senders |= self._traces >= CERTAIN
