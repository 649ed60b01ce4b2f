"""What is to be sent next, and as which frames: pure, time is an argument."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

from ..line import MapLine, Slot
from .schedule import Schedule

__all__ = ["AHEAD", "Encoder", "FrameLike", "Transfer", "TxQueue"]

#: How long before its deadline a line is encoded at most, and so stamped and signed [s]: a small
#: part of the second in which a receiver must get an authenticated frame.
AHEAD = 0.1


class FrameLike(Protocol):
    """A frame as the wire makes it (``wire.Frame``)."""

    @property
    def can_id(self) -> int:
        """11 or 29 bits."""

    @property
    def data(self) -> bytes:
        """The payload."""

    @property
    def is_fd(self) -> bool:
        """CAN FD frame."""

    @property
    def is_extended(self) -> bool:
        """29-bit CAN ID."""


class Encoder(Protocol):
    """What the transmitter needs of ``wire.Codec``."""

    def encode_lines(
        self, lines: Sequence[MapLine], *, fd: bool = False, counters: Mapping[Slot, int]
    ) -> Sequence[Sequence[FrameLike]]:
        """The frames of each line, which begin with the counter of their slot."""


class Transfer(NamedTuple):
    """The line of a slot that is due."""

    deadline: float  #: [s]
    frames: Sequence[FrameLike]  #: of all its parts, if it is a mixture
    records: int  #: that they carry
    skipped: int = 0  #: deadlines of the slot that were missed before this one


@dataclass(frozen=True)
class _Published:
    line: MapLine
    age: float  # of the pose when it was published [s]
    at: float  # when that was [s]

    def line_at(self, now: float) -> MapLine:
        return replace(self.line, age=max(0.0, self.age + now - self.at))


class TxQueue:
    """The latest value of each line, its deadlines, and frames that are encoded ahead.

    One line costs as much to encode as eight, so a line that is due takes along
    others, unless they may well be published anew before they are due themselves:
    a new value that is due within a period of being published, a repetition that
    is due within half a period.  A producer that publishes once a period is so
    never behind, and its lines are encoded once a period.  A line encoded ahead
    has the age of its own deadline.

    A line that is encoded ahead and then not sent, because its deadline was skipped or its slot
    was dropped, leaves no gap in the counters: they advance when it is taken.

    None is encoded more than `AHEAD` before its deadline.  So a slow sender makes a few
    lines at a time, ten times a second at most, from values that are as new.

    Args:
        codec: makes the frames.
        period: [s].
        fd: make CAN FD frames.
        count: deadlines of each slot; None for ever.
    """

    def __init__(self, codec: Encoder, period: float, *, fd: bool, count: int | None) -> None:
        self._codec, self._period, self._fd = codec, period, fd
        self._schedule: Schedule[Slot] = Schedule(period, count)
        self._published: dict[Slot, _Published] = {}
        self._new: set[Slot] = set()  # published since they were last encoded
        self._ahead: dict[Slot, Transfer] = {}  # encoded, not due yet
        self._counters: Counter[Slot] = Counter()  # of the next record to be sent

    def put(self, lines: Iterable[MapLine], now: float, age: float | None = None) -> None:
        """Take over lines, each instead of the last one of its slot.

        Args:
            lines: the new values.
            now: [s].
            age: of all of them [s]; None for each line's own.
        """
        for line in lines:
            if line.slot not in self._published:
                self._schedule.add(line.slot, line.slot / len(Slot), now)
            own = line.age if age is None else age
            self._published[line.slot] = _Published(line, own, now)
            self._new.add(line.slot)

    def drop(self, slot: Slot) -> None:
        """Forget the line of a slot; there may be none."""
        self._schedule.remove(slot)
        self._published.pop(slot, None)
        self._ahead.pop(slot, None)
        self._new.discard(slot)

    @property
    def over(self) -> bool:
        """Whether every slot has had its ``count`` deadlines."""
        return self._schedule.over

    def wait(self, now: float) -> float | None:
        """Time until the next deadline [s]; None if there is none."""
        return self._schedule.wait(now)

    def take(self, now: float) -> Transfer | None:
        """The lines whose deadline has come, each deadline once; None if there are none.

        Raises:
            EncodeError: a line has no place on the wire.
        """
        due = self._schedule.take(now)
        if due is None:
            return None
        transfer = self._ahead.pop(due.key, None)
        if transfer is None or transfer.deadline != due.deadline:  # its own was skipped
            self._encode(due.key, due.deadline)
            transfer = self._ahead.pop(due.key)
        self._counters[due.key] += transfer.records
        return transfer._replace(skipped=due.skipped)

    def _encode(self, slot: Slot, deadline: float) -> None:
        deadlines = {slot: deadline}
        for other in self._published.keys() - self._ahead.keys() - {slot}:
            then = self._schedule.deadline(other)
            if self._may_go_along(other, then, deadline):
                deadlines[other] = then
        order = sorted(deadlines, key=deadlines.__getitem__)
        batch = [self._published[each].line_at(deadlines[each]) for each in order]
        encoded = self._codec.encode_lines(batch, fd=self._fd, counters=self._counters)
        for line, frames in zip(batch, encoded, strict=True):
            records = 1 if line.mixture is None else len(line.mixture.weights)
            self._ahead[line.slot] = Transfer(deadlines[line.slot], frames, records)
        self._new -= deadlines.keys()

    def _may_go_along(self, slot: Slot, deadline: float, now: float) -> bool:
        until = now + self._period / 2
        if slot in self._new:
            until = self._published[slot].at + self._period
        return deadline < min(until, now + AHEAD)
