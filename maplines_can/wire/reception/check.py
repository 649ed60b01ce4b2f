"""Checks of received frames and records: why one is dropped, and the counters of each slot."""

from __future__ import annotations

from collections import Counter
from enum import Enum
from operator import index
from typing import Any, NamedTuple

from ...core import Lock, lib
from ..protection.e2e_state import E2EState, ProfileStatus

STATES = {int(state): state for state in E2EState}
STATUSES: dict[int, ProfileStatus | None] = {0xFF: None}
STATUSES |= {int(status): status for status in ProfileStatus}
#: Members of ``maplines_check_t`` with the numbers of checks, in the order of `ProfileStatus`.
_NUMBERS = ("ok", "no_new_data", "errors", "repeated", "some_lost", "wrong_sequence")


class Reason(Enum):
    """Reason why a received frame does not complete a line.

    All but PENDING are counted; none is raised.
    """

    PENDING = "held until the other pages of its transfer arrive"
    FOREIGN = "its CAN ID carries no map line"
    LENGTH = "its payload has the wrong length"
    PAGE = "its page number is not in the DBC"
    DUPLICATE = "its page or its line was already received"
    REPLACED = "another frame with its transfer ID was kept in its place"
    STALE = "a line of its slot that is as new or newer was already delivered"
    INCOMPLETE = "a frame of another record or line was received before its own was complete"
    TIMEOUT = "the rest of its transfer or line was not received in time"
    MIXED = "the pages of its record belong to different transfers"
    CRC = "the checksum of its record is wrong"
    CONTENT = "its record holds a value that no sender may send"
    POSE = "the pose error that its record belongs to was not received in time"
    UNAUTHENTICATED = "its message has no MAC, and this receiver requires one"
    KEY = "its MAC is of a key that this receiver does not have"
    MAC = "its MAC is wrong"
    REPLAY = "its MAC is valid, but its freshness value is not newer than the last accepted one"
    AGE = "its MAC is valid, but its freshness value is outside the window about the current time"
    SPACING = "records of its slot follow each other far faster than its cycle"


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


class Check:
    """Checks of the records of one owner of a decoder, to be read; time is an argument.

    Each record is one check of its counter, and so is each cycle without one; ``model/sequence.py``
    has the rules.

    Args:
        receiver: a ``maplines_receiver_t *``.
        number: of the owner in C.
        lock: of the decoder.
    """

    def __init__(self, receiver: Any, number: int, lock: Lock) -> None:
        #: Time between records [ns].
        self.cycle_ns = int(receiver.decoder.settings.cycle_ns[number])
        self._c, self._number, self._lock = receiver, number, lock
        self._check = receiver.decoder.checks[number]

    @property
    def state(self) -> E2EState:
        """State of the owner, as far as time has elapsed."""
        return STATES[self._check.machine.state]

    @property
    def status(self) -> ProfileStatus | None:
        """Status of the last check; None before the first."""
        return STATUSES[self._check.status]

    @property
    def lost(self) -> int:
        """Records missing between those received, according to their counters."""
        return int(self._check.lost)

    @property
    def ahead(self) -> int | None:
        """By how much the last new record is ahead of the one before; None after a break."""
        return self._check.ahead or None

    @property
    def counter(self) -> int | None:
        """Counter of the last new record; None before the first."""
        return int(self._check.last) if self._check.has_last else None

    @property
    def two_senders(self) -> bool:
        """Whether two senders were detected in the last 256 cycles."""
        return bool(self._check.conflict.is_confirmed)

    @property
    def statuses(self) -> Counter[ProfileStatus]:
        """Checks by outcome."""
        with self._lock:
            numbers = [getattr(self._check, name) for name in _NUMBERS]
        each = zip(ProfileStatus, numbers, strict=True)
        return Counter({status: number for status, number in each if number})

    def has_one_sender(self, t_ns: int) -> bool:
        """Return whether no second sender is detected or suspected at ``t_ns`` [ns]."""
        return bool(self._asked(lib.maplines_receiver_has_one_sender, t_ns))

    def elapse(self, t_ns: int) -> E2EState:
        """Step with NONEWDATA for each cycle missed up to ``t_ns`` [ns]; return the state."""
        return STATES[self._asked(lib.maplines_receiver_elapse, t_ns)]

    def stats(self) -> SlotStats:
        """Return a snapshot of all counters."""
        n = self.statuses
        return SlotStats(
            state=self.state,
            status=self.status,
            ok=n[ProfileStatus.OK] + n[ProfileStatus.OKSOMELOST],
            lost=self.lost,
            repeated=n[ProfileStatus.REPEATED],
            wrong_sequence=n[ProfileStatus.WRONGSEQUENCE],
            errors=n[ProfileStatus.ERROR],
            no_new_data=n[ProfileStatus.NONEWDATA],
            two_senders=self.two_senders,
        )

    def _asked(self, ask: Any, t_ns: int) -> Any:
        t_ns = limited_ns(t_ns, "t_ns")
        with self._lock:
            return ask(self._c, self._number, t_ns)


#: A time beyond this is taken as this one [ns]: 127 years from the zero of the clock.
MAX_TIME_NS = 4 * 10**18


def limited_ns(time: float, name: str) -> int:
    """Return a time as an integer of at most ``MAX_TIME_NS`` [ns].

    Args:
        time: an integer of any type, or a float without a fraction [ns].
        name: of the argument, for messages.

    Raises:
        ValueError: it is a float with a fraction, or not finite.
        TypeError: it is no number.

    >>> limited_ns(5.0, "now_ns"), limited_ns(-(10**30), "now_ns")
    (5, -4000000000000000000)
    """
    if isinstance(time, float):
        if not time.is_integer():
            raise ValueError(f"{name} must be whole [ns], got {time!r}")
        time = int(time)
    return max(-MAX_TIME_NS, min(index(time), MAX_TIME_NS))
