"""Queue of the next transfers of each slot, with their deadlines; time is an argument."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from ..line import MapLine, Slot
from ..wire import Codec, Frame
from .schedule import Schedule

#: Max lead time of encoding [s]; well below the 1 s freshness window.
AHEAD = 0.1
#: Lateness of a transfer that its age includes [s]; a thread usually wakes up earlier.
ALLOWANCE = 0.004


@dataclass(frozen=True)
class Published:
    """A line with the time when it was published."""

    line: MapLine
    age: float  #: of the pose at the time of publishing [s]
    at: float  #: time of publishing [s]

    def with_age(self, now: float, max_age: float) -> MapLine:
        """Return the line with its age at ``now``, infinite if it exceeds ``max_age`` [s]."""
        age = max(0.0, self.age + now - self.at)
        return replace(self.line, age=age if age <= max_age else math.inf)


class Transfer(NamedTuple):
    """An encoded line of a slot with its deadline."""

    published: Published
    deadline: float  #: [s]
    latest: float  #: until then, the age that is sent is not too small [s]
    counter: int  #: of the first record
    frames: Sequence[Frame]  #: those of all components, if the line is a mixture
    expired: bool  #: the age is sent as "too old"
    skipped: int = 0  #: deadlines of the slot that were missed before this one

    @property
    def records(self) -> int:
        """How many records the frames carry."""
        mixture = self.published.line.mixture
        return 1 if mixture is None else len(mixture.weights)


class TxQueue:
    """Queue of the next transfers of each slot, with their deadlines.

    Encoding eight lines takes no longer than encoding one.  A line that is due is therefore encoded
    together with others that are due soon and unlikely to be replaced before their deadlines:

    - a new value, if its deadline is less than a period after its publishing;
    - a repeated value, if its deadline is less than half a period away.

    A producer that publishes once a period thus never has an old value sent, and its lines are
    encoded once a period.

    The age of a line refers to `ALLOWANCE` after its deadline.  A transfer that is later than that
    is encoded again (see `renew`), so the age is never too small when its first frame is sent.
    An age of more than ``max_age`` is sent as "too old", the greatest raw value of the DBC's Age.

    If a line that is encoded ahead is not sent, because its deadline was skipped or its slot was
    dropped, the counters have no gap: they advance when a transfer is taken.

    No line is encoded more than `AHEAD` before its deadline.  A transmitter with a long period
    thus encodes a few lines at a time, at most ten times a second.

    Args:
        codec: encodes the lines.
        period: between two transfers of a slot [s].
        fd: make CAN FD frames.
        count: number of deadlines of each slot; None for no limit.
        max_age: greatest age that is stated [s].
    """

    def __init__(
        self, codec: Codec, period: float, *, fd: bool, count: int | None, max_age: float
    ) -> None:
        self._codec, self._period, self._fd, self._max_age = codec, period, fd, max_age
        self._schedule: Schedule[Slot] = Schedule(period, count)
        self._published: dict[Slot, Published] = {}
        self._new: set[Slot] = set()  # published since they were last encoded
        self._ahead: dict[Slot, Transfer] = {}  # encoded, not due yet
        self._counters: Counter[Slot] = Counter()  # of the next record to be sent

    def put(self, lines: Iterable[MapLine], now: float, age: float | None = None) -> None:
        """Publish lines at ``now`` [s], each in place of the previous one of its slot.

        They have the given age [s], or each line its own.
        """
        for line in lines:
            if line.slot not in self._published:
                self._schedule.add(line.slot, line.slot / len(Slot), now)
            own = line.age if age is None else age
            self._published[line.slot] = Published(line, own, now)
            self._new.add(line.slot)

    def drop(self, slot: Slot) -> None:
        """Remove the line of a slot; the slot may have none."""
        self._schedule.remove(slot)
        self._published.pop(slot, None)
        self._ahead.pop(slot, None)
        self._new.discard(slot)

    @property
    def over(self) -> bool:
        """Whether every slot has had its ``count`` deadlines."""
        return self._schedule.over

    def wait(self, now: float) -> float | None:
        """Return the time until the next deadline [s]; None if there is none."""
        return self._schedule.wait(now)

    def take(self, now: float) -> Transfer | None:
        """Return the next transfer that is due, once per deadline; None if none is due.

        Raises:
            EncodeError: a value of a line does not fit into its signal.
        """
        due = self._schedule.take(now)
        if due is None:
            return None
        transfer = self._ahead.pop(due.key, None)
        if transfer is None or transfer.deadline != due.deadline:  # of a skipped deadline
            self._encode(due.key, due.deadline)
            transfer = self._ahead.pop(due.key)
        self._counters[due.key] += transfer.records
        return transfer._replace(skipped=due.skipped)

    def renew(self, transfer: Transfer, now: float) -> Transfer:
        """Encode a late transfer again, with the age when it will be twice as late.

        Few renewals are thus needed if a transfer cannot be sent for a long time, and its age
        exceeds the true one by no more than the lateness.  The counters stay the same, so no frame
        of the transfer may have been sent.
        """
        latest = now + max(ALLOWANCE, now - transfer.deadline)
        line = transfer.published.with_age(latest, self._max_age)
        counters = {line.slot: transfer.counter}
        (frames,) = self._codec.encode_lines([line], fd=self._fd, counters=counters)
        return transfer._replace(latest=latest, frames=frames, expired=line.age == math.inf)

    def _encode(self, slot: Slot, deadline: float) -> None:
        deadlines = {slot: deadline}
        for other in self._published.keys() - self._ahead.keys() - {slot}:
            then = self._schedule.deadline(other)
            if self._may_be_ahead(other, then, deadline):
                deadlines[other] = then
        order = sorted(deadlines, key=deadlines.__getitem__)
        latest = {each: deadlines[each] + ALLOWANCE for each in order}
        batch = [self._published[each].with_age(latest[each], self._max_age) for each in order]
        encoded = self._codec.encode_lines(batch, fd=self._fd, counters=self._counters)
        for each, line, frames in zip(order, batch, encoded, strict=True):
            self._ahead[each] = Transfer(
                self._published[each],
                deadlines[each],
                latest[each],
                self._counters[each],
                frames,
                expired=line.age == math.inf,
            )
        self._new -= deadlines.keys()

    def _may_be_ahead(self, slot: Slot, deadline: float, now: float) -> bool:
        until = now + self._period / 2
        if slot in self._new:
            until = self._published[slot].at + self._period
        return deadline < min(until, now + AHEAD)
