"""What the records of one slot are worth: E2E checks, lost lines, a second sender."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

from ..protection.e2e_state import E2EConfig, E2EState, ProfileStatus, StateMachine, check
from ..reasons import Reason
from .conflict import SenderConflict

__all__ = ["SequenceCheck", "SlotStats"]

OK, NONEWDATA, ERROR, REPEATED, OKSOMELOST, WRONGSEQUENCE = ProfileStatus

#: After so many cycles without a record the first is missed: its time may jitter by half a cycle.
GRACE = 1.5
#: So many records in a row that are behind are a sender that has started anew.
TAKEN_OVER = 3


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
    two_senders: bool  #: seen in the last 256 cycles


class _Behind(NamedTuple):
    """Records that came after a newer one, each following the one before."""

    last: int  #: counter of the last
    since_ns: int  #: time of the first
    records: int = 1


class _Heard(NamedTuple):
    """A record that came."""

    place: int  #: in the sequence, counted on where the counter comes round
    content: int
    is_news: bool
    is_first: bool  #: news of which no copy came so far


class SequenceCheck:
    """The checks of one slot and its state machine; time is an argument.

    Each record that comes is one check. So is each cycle without one: NONEWDATA falls
    due 1.5 cycles after the last record and every cycle after that, whoever asks and
    however often; ``elapse`` brings it up to now.

    Two decisions go beyond AUTOSAR, both to the safe side:

    - A counter that jumps is a sender that has started anew, or another one. What the window
      holds is of another sequence: it is cleared, so VALID is left at once and comes back
      after ``min_ok_state_invalid`` OKs. A jump forward is delivered. A step back may be
      an old line that came late: it is not delivered unless it is the third of a sequence,
      1.5 cycles after the first, with nothing else between, or no news came for a
      whole window. A sender that starts anew so loses two lines, before it is VALID.
    - REPEATED is, for a mixture, any record of the last one delivered; and it stays
      REPEATED however long the slot was silent. A transfer that a gateway held back and a sender
      that has started anew at that very counter look the same; to refuse the
      first line of the latter costs a cycle, to take the former for news a wrong line.

    For the last half round of counters it is known what came, so that a copy of a record,
    a record that fills a gap and one that another sender must have sent can be told.

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
        self._place = 0  # of the last news in the sequence
        self._heard: dict[int, _Heard] = {}  # by counter
        self._span = 1  # records of the line that was delivered last, if with the last record
        self._largest = 1  # records of a line so far
        self._doubled_frames = 0  # since the last record
        self._second = SenderConflict(cycle_ns)

    @property
    def state(self) -> E2EState:
        """What the slot is worth now, as far as time has elapsed."""
        return self._machine.state

    @property
    def two_senders(self) -> bool:
        """Whether two senders were heard in the last 256 cycles."""
        return self._second.is_certain

    def received(self, counter: int, content: int, t_ns: int) -> Reason | None:
        """Check a record whose checksum holds.

        Args:
            counter: its own.
            content: equal where the whole record is, such as a hash.
            t_ns: when it came [ns].

        Returns:
            None where it is news; DUPLICATE or STALE where it is not to be delivered.
        """
        self._arrive(t_ns)
        last = self._counter
        status = check(counter, last, self._max_delta, self._modulus)
        ahead = 1 if last is None else (counter - last) % self._modulus
        if status is not OK and last is not None:
            behind = (last - counter) % self._modulus
            if late := self._why_late(counter, content, behind, t_ns):
                self._step(REPEATED if behind < self._span else WRONGSEQUENCE)
                return late
            if self._left is not None and check(counter, self._left, 1, self._modulus) is OK:
                self._second.proof(t_ns)  # back to where it was left
            self._left = last
            if ahead >= self._modulus // 2:
                ahead = 2 * self._modulus  # what was heard before is of another sequence
            elif status is OKSOMELOST or counter != 0:  # a sender starts anew at 0
                self.lost += ahead - 1
            if status is WRONGSEQUENCE:
                self._machine.clear()
        self._place += ahead
        self._heard[counter] = _Heard(self._place, content, is_news=True, is_first=True)
        self._counter, self._news_ns, self._behind = counter, t_ns, None
        self._second.news()
        self._span = 1
        self._doubled_frames = 0
        self._step(status)
        return None

    def delivered(self, records: int) -> None:
        """The last record was the last of a line of so many."""
        self._span = records
        self._largest = max(self._largest, records)

    def failed(self, t_ns: int) -> None:
        """What came was no record that holds."""
        self._arrive(t_ns)
        self._step(ERROR)

    def doubled(self, t_ns: int) -> None:
        """A frame came again; so many as make a record are one check."""
        self._doubled_frames += 1
        if self._doubled_frames % self._pages == 0:
            self._arrive(t_ns)
            if self._doubled_frames == self._pages:
                self._second.copy(t_ns)
            self._step(REPEATED)

    def elapse(self, t_ns: int) -> E2EState:
        """Count NONEWDATA for the cycles that have gone by without a record until ``t_ns`` [ns]."""
        self._second.elapse(t_ns)
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
        self._second.elapse(t_ns)
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

    def _why_late(self, counter: int, content: int, behind: int, t_ns: int) -> Reason | None:
        """Why a record that is not the next is no news; None where it is."""
        place = self._place - behind
        heard = self._came(counter, place)
        is_copy = heard is not None and heard.content == content
        if heard is not None and is_copy and heard.is_first:
            self._heard[counter] = heard._replace(is_first=False)
            self._second.copy(t_ns)
        if behind < self._span:
            if not is_copy:
                self._second.proof(t_ns)
            return Reason.DUPLICATE if is_copy else Reason.STALE
        if self._is_proven or behind > self._modulus // 2:
            return None
        if abs(t_ns - self._news_ns) > self._silence_ns:
            return None
        if is_copy:
            return Reason.DUPLICATE
        if heard is None:
            self._heard[counter] = _Heard(place, content, is_news=False, is_first=False)
        if heard is not None or self._is_of_its_own(counter, behind):
            self._second.proof(t_ns)
        return None if self._goes_on(counter, t_ns) else Reason.STALE

    def _came(self, counter: int, place: int) -> _Heard | None:
        """What came with a counter, if it was at that place of the sequence."""
        heard = self._heard.get(counter % self._modulus)
        return heard if heard and heard.place == place else None

    def _is_of_its_own(self, counter: int, behind: int) -> bool:
        """Whether a record that came far behind does not fill a gap between news."""
        before = self._came(counter - 1, self._place - behind - 1)
        fills = before is not None and before.is_news
        return behind > self._max_delta * self._largest and not fills

    def _goes_on(self, counter: int, t_ns: int) -> bool:
        """Whether a record that is behind belongs to a sequence that has taken over."""
        behind = self._behind
        if behind is None or check(counter, behind.last, 1, self._modulus) is not OK:
            self._behind = _Behind(counter, t_ns)
            return False
        behind = self._behind = behind._replace(last=counter, records=behind.records + 1)
        if behind.records < TAKEN_OVER or abs(t_ns - behind.since_ns) < self._grace_ns:
            return False
        self._second.withdraw()
        return True
