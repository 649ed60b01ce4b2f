"""A receiver's state: frames in, map lines out, everything else counted."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from ..line import MapLine, Slot, Status
from ..mixture import GaussianMixture
from .read import Part
from .reassembly import Reason, Reassembler, Record

if TYPE_CHECKING:
    from .codec import Codec

__all__ = ["Decoder"]


#: The status of a mixture is that of its worst part.
SEVERITY = (
    Status.FULL,
    Status.REPAIRED,
    Status.SATURATED,
    Status.DIAGONAL,
    Status.UNKNOWN,
    Status.OUT_OF_RANGE,
)


@dataclass
class _Group:
    """The parts of one mixture that have come so far."""

    first: int  #: counter of the first part
    count: int
    t_ns: int  #: of the part that came last
    parts: dict[int, Part] = field(default_factory=dict)
    frames: int = 0


class Decoder:
    """A receiver's state: frames in, map lines out, everything else counted.

    Made by ``Codec.decoder``. At any time
    ``frames == line_frames + sum(counts.values()) + pending``.
    """

    def __init__(self, codec: Codec, timeout_ns: int) -> None:
        self._codec = codec
        self._reassembler = Reassembler(codec.layout, timeout_ns)
        self._timeout_ns = timeout_ns
        self._counters: dict[Slot, int] = {}
        self._groups: dict[Slot, _Group] = {}
        self.frames = 0  #: frames fed
        self.lines = 0  #: lines delivered
        self.line_frames = 0  #: frames of the lines delivered
        self.lost = 0  #: records missing between those read, by their counters

    @property
    def counts(self) -> Counter[Reason]:
        """Dropped frames by reason."""
        return self._reassembler.counts

    @property
    def pending(self) -> int:
        """Frames held for bursts and mixtures that are not complete yet."""
        return self._reassembler.pending + sum(group.frames for group in self._groups.values())

    def feed(
        self, can_id: int, data: bytes, t_ns: int, *, is_extended: bool = False
    ) -> MapLine | Reason:
        """Take a frame. Whatever it is, this does not raise.

        Args:
            can_id: its ID.
            data: its payload.
            t_ns: when it was received, on any clock that goes on [ns].
            is_extended: it has a 29-bit ID.

        Returns:
            The line that it completes, or why there is none (PENDING: not yet).
        """
        self.frames += 1
        record = self._reassembler.feed(can_id, data, t_ns, is_extended)
        if isinstance(record, Reason):
            return record
        return self._read(record)

    def expire(self, t_ns: int) -> None:
        """Give up what is not complete by ``t_ns`` [ns] less the time-out."""
        self._reassembler.expire(t_ns)
        for slot in [s for s, group in self._groups.items() if self._is_old(group, t_ns)]:
            self._give_up(slot, Reason.TIMEOUT)

    def _read(self, record: Record) -> MapLine | Reason:
        part = self._codec.read_part(record.payload, record.slot, record.t_ns)
        if isinstance(part, Reason):
            self.counts[part] += record.frames
            return part
        self._reassembler.accept(record)
        counter = part.counter
        modulus = 2 ** self._codec.layout["Counter"].length
        gap = (counter - self._counters.get(record.slot, counter - 1)) % modulus
        if 0 < gap <= modulus // 2:  # else the sender has started anew
            self.lost += gap - 1
        self._counters[record.slot] = counter
        first = (counter - part.index) % modulus
        held = self._groups.get(record.slot)
        if held and self._is_old(held, record.t_ns):
            self._give_up(record.slot, Reason.TIMEOUT)
        elif held and (held.first, held.count) != (first, part.count):
            self._give_up(record.slot, Reason.INCOMPLETE)
        if part.count == 1:
            self.lines += 1
            self.line_frames += record.frames
            return part.line
        return self._join(record, part, first)

    def _join(self, record: Record, part: Part, first: int) -> MapLine | Reason:
        """Take a part of a mixture: all parts of one line, by their counters, or none."""
        group = self._groups.setdefault(record.slot, _Group(first, part.count, record.t_ns))
        if part.index in group.parts:
            self.counts[Reason.DUPLICATE] += record.frames
            return Reason.DUPLICATE
        group.parts[part.index] = part
        group.frames += record.frames
        group.t_ns = record.t_ns  # each part has the time of a burst: slow buses carry many parts
        if len(group.parts) < group.count:
            return Reason.PENDING
        parts = [group.parts[i] for i in range(group.count)]
        weights = [part.weight for part in parts]
        if abs(sum(weights) - 1) > 1e-9:
            self._give_up(record.slot, Reason.CONTENT)
            return Reason.CONTENT
        del self._groups[record.slot]
        self.lines += 1
        self.line_frames += group.frames
        mixture = GaussianMixture(np.array(weights), tuple(part.line.gaussian for part in parts))
        first = min((part.line for part in parts), key=lambda line: line.t_ns or 0)
        return replace(  # whose age counts from when it came
            first,
            gaussian=mixture.overall,
            mixture=mixture,
            status=max((part.line.status for part in parts), key=SEVERITY.index),
        )

    def _is_old(self, group: _Group, t_ns: int) -> bool:
        return abs(t_ns - group.t_ns) > self._timeout_ns

    def _give_up(self, slot: Slot, reason: Reason) -> None:
        self.counts[reason] += self._groups.pop(slot).frames
