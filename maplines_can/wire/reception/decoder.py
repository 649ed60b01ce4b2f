"""Decoder of received frames: frames in, map lines out, everything else counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from ...line import MapLine, Slot
from ..message.layout import Layout
from ..message.reader import DecodedRecord, RecordReader
from ..protection.e2e_state import E2EConfig
from ..protection.secoc import Verifier
from ..reasons import NOT_AUTHENTIC, Reason
from .mixtures import MixtureAssembler
from .reassembly import Reassembler
from .sequence import SequenceCheck

PENDING = Reason.PENDING  # looked up only once, since feed is called for every frame


class Decoder:
    """Decoder of the frames of a bus, with the state of a receiver.

    Data flows one way::

        frame -> Reassembler -> record -> SequenceCheck -> new record -> MixtureAssembler -> line

    ``Codec.decoder`` makes one. At any time
    ``frames == line_frames + sum(counts.values()) + pending``.

    Each record is checked by its counter according to AUTOSAR E2E, and ``checks`` gives the state
    of each slot. Of good records, only duplicates and late ones are dropped. What to do with a line
    whose slot is not VALID is the consumer's decision.

    With a verifier the MAC is checked first, and a frame that is not authentic changes nothing:
    no line, no transfer, no check.

    Args:
        verifier: checks authenticated frames; None for a bus without authentication.
        timeouts_ns: longest time between the frames of a transfer, and between the components of a
            mixture, for each slot [ns].
        cycles_ns: time between records of each slot [ns].
        e2e: windows and bounds of the E2E state machines.
    """

    def __init__(
        self,
        layout: Layout,
        reader: RecordReader,
        verifier: Verifier | None,
        timeouts_ns: Mapping[Slot, int],
        cycles_ns: Mapping[Slot, int],
        e2e: E2EConfig,
    ) -> None:
        #: CAN IDs of all lines, for filters.
        self.can_ids = layout.can_ids
        #: Checks whether a frame is authentic; None without authentication.
        self.verifier = verifier
        data_ids = {slot: messages.data_id for slot, messages in layout.messages.items()}
        modulus = 2 ** layout["Counter"].length
        self._slot_of_id = {key: slot for key, (slot, _) in layout.message_of_id.items()}
        self._reassembler: Reassembler[Slot, DecodedRecord] = Reassembler(
            layout,
            lambda payload, slot, t_ns: reader.read_one(payload, slot, data_ids[slot], t_ns),
            timeouts_ns,
            verifier,
        )
        self._mixtures = MixtureAssembler(modulus, timeouts_ns)
        self._counts: Counter[Reason] = Counter()  # dropped between reassembly and mixture assembly
        self.frames = 0  #: frames received
        self.lines = 0  #: lines delivered
        self.line_frames = 0  #: frames of the lines delivered
        #: Checks of each slot of the DBC.
        self.checks: Mapping[Slot, SequenceCheck] = {
            slot: SequenceCheck(
                e2e, modulus, layout.pages, cycle_ns, is_authentic=verifier is not None
            )
            for slot, cycle_ns in cycles_ns.items()
        }

    @property
    def lost(self) -> int:
        """Records missing between those received, by their counters."""
        return sum(check.lost for check in self.checks.values())

    @property
    def counts(self) -> Counter[Reason]:
        """Dropped frames by reason."""
        return self._reassembler.counts + self._counts + self._mixtures.counts

    @property
    def pending(self) -> int:
        """Frames of transfers and mixtures that are not complete yet."""
        return self._reassembler.pending + self._mixtures.pending

    def feed(
        self, can_id: int, data: bytes, t_ns: int, *, is_extended: bool = False
    ) -> MapLine | Reason:
        """Decode a frame; return the line that it completes, or the reason why none.

        Args:
            can_id: its CAN ID.
            data: its payload.
            t_ns: time of reception, on any clock that runs steadily [ns].
            is_extended: the ID has 29 bits.

        Returns:
            The line, or the reason why there is none (PENDING: not yet). No frame raises.
        """
        self.frames += 1
        record = self._reassembler.feed(can_id, data, t_ns, is_extended)
        if isinstance(record, Reason):
            if record is not PENDING:
                self._check_dropped(record, (can_id, is_extended), t_ns)
            return record
        check, content = self.checks[record.slot], record.content
        if isinstance(content, Reason):
            check.failed(record.t_ns)
            return self._dropped(content, record.frames)
        reason = check.received(content.counter, hash(record.payload), record.t_ns, content.count)
        if reason is not None:
            if reason is Reason.STALE:
                self._mixtures.drop_if_within(record.slot, content.counter)
            return self._dropped(reason, record.frames)
        if content.count > 1 and check.counter_was_reused(record.t_ns):
            self._mixtures.drop(record.slot)  # its components may come from two senders
            return self._dropped(Reason.INCOMPLETE, record.frames)
        complete = self._mixtures.add(content, record.frames, record.t_ns)
        if isinstance(complete, Reason):
            return complete
        check.delivered(complete.records)
        self.lines += 1
        self.line_frames += complete.frames
        return complete.line

    def expire(self, t_ns: int) -> None:
        """Drop the transfers and mixtures that have timed out at ``t_ns`` [ns]."""
        self._reassembler.expire(t_ns)
        self._mixtures.expire(t_ns)

    def _dropped(self, reason: Reason, frames: int) -> Reason:
        self._counts[reason] += frames
        return reason

    def _check_dropped(self, reason: Reason, key: tuple[int, bool], t_ns: int) -> None:
        """Pass a dropped frame to the check of its slot, unless its sender is not authentic."""
        slot = self._slot_of_id.get(key)
        if slot is None or reason in NOT_AUTHENTIC:
            return  # as in AUTOSAR: what is not authentic does not reach the E2E check
        if reason is Reason.DUPLICATE:
            self.checks[slot].frame_duplicated(t_ns)
        elif reason is Reason.PAGE or (reason is Reason.LENGTH and self.verifier is None):
            self.checks[slot].failed(t_ns)
