"""A receiver's state: frames in, map lines out, everything else counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from ...line import MapLine, Slot, Status
from ...mixture import GaussianMixture
from ..message.reader import DecodedRecord as Part
from ..protection.e2e_state import E2EConfig
from ..reasons import NOT_AUTHENTIC, Reason
from .reassembly import Reassembler, Record
from .sequence import SequenceCheck

if TYPE_CHECKING:
    from ..codec import Codec

__all__ = ["Decoder"]


PENDING = Reason.PENDING  # looked up here, once

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

    Each record is checked by its counter after AUTOSAR E2E, and ``checks`` says what the
    lines of each slot are worth. The check keeps back the record that was delivered last and
    those that came late, and nothing else: what to do with a line of a slot that is not VALID
    is the consumer's decision.

    With an authenticator the MAC is checked before anything else, and what is not
    authentic moves nothing: neither a line, nor a transfer, nor a check.
    """

    def __init__(
        self, codec: Codec, timeout_ns: int, cycles_ns: Mapping[Slot, int], e2e: E2EConfig
    ) -> None:
        self._codec = codec
        #: What tells whether a frame is authentic, where the codec asks for it.
        self.verifier = codec.verifier()
        self._reassembler = Reassembler(codec.layout, timeout_ns, self.verifier)
        self._timeout_ns = timeout_ns
        self._groups: dict[Slot, _Group] = {}
        self._modulus = 2 ** codec.layout["Counter"].length
        self.frames = 0  #: frames fed
        self.lines = 0  #: lines delivered
        self.line_frames = 0  #: frames of the lines delivered
        #: What the records of each slot are worth, for all slots of the DBC.
        self.checks: Mapping[Slot, SequenceCheck] = {
            slot: SequenceCheck(
                e2e,
                self._modulus,
                codec.layout.pages,
                cycle_ns,
                is_proven=self.verifier is not None,
            )
            for slot, cycle_ns in cycles_ns.items()
        }

    @property
    def lost(self) -> int:
        """Records missing between those read, by their counters."""
        return sum(check.lost for check in self.checks.values())

    @property
    def counts(self) -> Counter[Reason]:
        """Dropped frames by reason."""
        return self._reassembler.counts

    @property
    def pending(self) -> int:
        """Frames held for transfers and mixtures that are not complete yet."""
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
            if record is not PENDING:
                self._check_dropped(record, can_id, t_ns, is_extended)
            return record
        return self._read(record)

    def expire(self, t_ns: int) -> None:
        """Give up what is not complete by ``t_ns`` [ns] less the time-out."""
        self._reassembler.expire(t_ns)
        for slot in [s for s, group in self._groups.items() if self._is_old(group, t_ns)]:
            self._give_up(slot, Reason.TIMEOUT)

    def _check_dropped(self, reason: Reason, can_id: int, t_ns: int, is_extended: bool) -> None:
        known = self._codec.layout.page_of_id.get((can_id, is_extended))
        if known is None or reason in NOT_AUTHENTIC:
            return  # as in AUTOSAR: what is not authentic does not reach the E2E check
        if self.verifier is not None and reason is Reason.LENGTH:
            return
        slot, _ = known
        if reason in (Reason.LENGTH, Reason.PAGE):
            self.checks[slot].failed(t_ns)
        else:  # DUPLICATE
            self.checks[slot].doubled(t_ns)

    def _read(self, record: Record) -> MapLine | Reason:
        part = self._codec.read_record(record.payload, record.slot, record.t_ns)
        check = self.checks[record.slot]
        if isinstance(part, Reason):
            self.counts[part] += record.frames
            check.failed(record.t_ns)
            return part
        self._reassembler.remember(record)
        held = self._groups.get(record.slot)
        if late := check.received(part.counter, hash(record.payload), record.t_ns):
            self.counts[late] += record.frames
            if late is Reason.STALE and held and self._is_within(held, part.counter):
                self._give_up(record.slot, Reason.INCOMPLETE)  # two senders, or out of order
            return late
        first = (part.counter - part.index) % self._modulus
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
        group.t_ns = (
            record.t_ns
        )  # each part has the time of a transfer: slow buses carry many parts
        if len(group.parts) < group.count:
            return Reason.PENDING
        parts = [group.parts[i] for i in range(group.count)]
        weights = [part.weight for part in parts]
        if abs(sum(weights) - 1) > 1e-9:
            self._give_up(record.slot, Reason.CONTENT)
            return Reason.CONTENT
        del self._groups[record.slot]
        self.checks[record.slot].delivered(group.count)
        self.lines += 1
        self.line_frames += group.frames
        mixture = GaussianMixture(np.array(weights), tuple(part.line.gaussian for part in parts))
        oldest = min((part.line for part in parts), key=lambda line: line.t_ns or 0)
        return replace(  # whose age counts from when it came
            oldest,
            gaussian=mixture.overall,
            mixture=mixture,
            status=max((part.line.status for part in parts), key=SEVERITY.index),
        )

    def _is_within(self, group: _Group, counter: int) -> bool:
        return (counter - group.first) % self._modulus < group.count

    def _is_old(self, group: _Group, t_ns: int) -> bool:
        return abs(t_ns - group.t_ns) > self._timeout_ns

    def _give_up(self, slot: Slot, reason: Reason) -> None:
        self.counts[reason] += self._groups.pop(slot).frames
