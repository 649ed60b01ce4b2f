"""Decoder of received frames: frames in, map lines out, everything else counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from ...values.line import MapLine, Slot
from ..layout.message_layout import Layout
from ..protection.e2e_state import E2EConfig, ProfileStatus
from ..protection.secoc import Verifier
from ..reasons import Reason
from ..records.record import CompleteRecord, RawRecord, RecordReader
from .mixtures import MixtureAssembler
from .reassembly import Reassembler
from .scenes import ReceivedLine, ReceivedScene, SceneReceiver
from .sequence import SequenceCheck

# Looked up only once, since feed is called for every frame.
PENDING, FOREIGN = Reason.PENDING, Reason.FOREIGN


class Decoder:
    """Decoder of the frames of a bus, with the state of a receiver.

    Data flows one way::

        frame -> Reassembler -> record -> SequenceCheck -> new record -> MixtureAssembler -> line

    Frames of the pose error take a way of their own. ``scene`` returns the lines of one pose error
    together. If the records of lines are conditional on it, a line comes when both are there::

        frame -> PoseReceiver -> new record -> EpochAssembler -> lines, scene

    ``Codec.decoder`` makes one. At any time
    ``frames == line_frames + pose_frames + sum(counts.values()) + pending``.

    Each record is checked by its counter according to AUTOSAR E2E, and ``checks`` gives the state
    of each slot. Of good records, only duplicates and late ones are dropped. What to do with a line
    whose slot is not VALID is the consumer's decision.

    With a verifier the MAC is checked first, and a frame that is not authentic changes nothing:
    no line, no transfer, no check.

    Args:
        reader: reader of the records of slots.
        verifier: checks authenticated frames; None for a bus without authentication.
        timeouts_ns: longest time between the frames of a transfer, and between the components of a
            mixture, for each slot [ns].
        cycles_ns: time between records of each slot [ns].
        e2e: windows and bounds of the E2E state machines.
        scenes: receiver of pose errors and scenes; None if the DBC has no such message.
    """

    def __init__(
        self,
        layout: Layout,
        reader: RecordReader[CompleteRecord | RawRecord],
        verifier: Verifier | None,
        timeouts_ns: Mapping[Slot, int],
        cycles_ns: Mapping[Slot, int],
        e2e: E2EConfig,
        scenes: SceneReceiver | None = None,
    ) -> None:
        #: CAN IDs of all lines, for filters.
        self.can_ids = layout.can_ids
        #: Checks whether a frame is authentic; None without authentication.
        self.verifier = verifier
        modulus = 2 ** layout["Counter"].length
        self._message_of_id = layout.message_of_id
        self._reassembler: Reassembler[Slot, CompleteRecord | RawRecord]
        self._reassembler = Reassembler(layout, reader, timeouts_ns, verifier)
        self._mixtures = MixtureAssembler(modulus, timeouts_ns)
        self._scenes = scenes
        self._is_conditional = layout.is_conditional
        #: Lines that the last frame completed in addition to the one that ``feed`` returned.
        self.further: list[MapLine] = []
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
        counts = self._reassembler.counts + self._counts + self._mixtures.counts
        return counts if self._scenes is None else counts + self._scenes.counts

    @property
    def pending(self) -> int:
        """Frames of transfers, mixtures and scenes that are not complete yet."""
        pending = self._reassembler.pending + self._mixtures.pending
        return pending if self._scenes is None else pending + self._scenes.pending

    @property
    def pose_errors(self) -> int:
        """Pose errors received."""
        return 0 if self._scenes is None else self._scenes.pose_errors

    @property
    def pose_frames(self) -> int:
        """Frames of the pose errors received."""
        return 0 if self._scenes is None else self._scenes.pose_frames

    @property
    def pose_check(self) -> SequenceCheck | None:
        """Check of the pose errors, as that of a slot; None if the DBC has no such message."""
        return None if self._scenes is None else self._scenes.check

    def checks_of(self, slot: Slot) -> tuple[SequenceCheck, ...]:
        """Return the checks of all that a line of a slot is made of.

        These are that of the slot and, if its record is conditional on the pose error, that of the
        pose error.
        """
        check, pose_check = self.checks[slot], self.pose_check
        if pose_check is None or not self._is_conditional:
            return (check,)
        return check, pose_check

    def scene(self) -> ReceivedScene | None:
        """Return the newest scene, see ``Monitor.latest_scene``; None before the first."""
        return None if self._scenes is None else self._scenes.latest()

    @property
    def pose_is_too_old(self) -> bool:
        """Whether the newest pose error is too old, so that the sender vouches for no scene."""
        return self._scenes is not None and self._scenes.is_too_old

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
            The line, or the reason why there is none (PENDING: not yet). No frame raises. A pose
            error may complete several lines that waited for it; the others are in ``further``.
        """
        self.frames += 1
        self.further = []
        if self._scenes is not None and self._scenes.knows(can_id, is_extended):
            lines = self._scenes.feed_pose(can_id, data, t_ns, is_extended)
            if isinstance(lines, Reason):
                return lines
            first, *self.further = map(self._delivered, lines)
            return first
        record = self._reassembler.feed(can_id, data, t_ns, is_extended)
        if isinstance(record, Reason):
            if record is not PENDING and record is not FOREIGN:
                slot, _ = self._message_of_id[can_id, is_extended]
                self.checks[slot].frame_dropped(record, t_ns)
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
        is_break = check.status is ProfileStatus.WRONGSEQUENCE
        if isinstance(content, RawRecord):
            if self._scenes is None:
                return self._dropped(Reason.POSE, record.frames)
            line = self._scenes.add_record(content, record.t_ns, record.frames, is_break)
            return line if isinstance(line, Reason) else self._delivered(line)
        if content.count > 1 and check.counter_was_reused(record.t_ns):
            self._mixtures.drop(record.slot)  # its components may come from two senders
            return self._dropped(Reason.INCOMPLETE, record.frames)
        complete = self._mixtures.add(content, record.frames, record.t_ns)
        if isinstance(complete, Reason):
            return complete
        check.delivered(complete.records)
        self.lines += 1
        self.line_frames += complete.frames
        if self._scenes is not None and complete.records == 1:
            self._scenes.add_line(complete.line, content.counter, record.t_ns, is_break)
        return complete.line

    def expire(self, t_ns: int) -> None:
        """Drop the transfers and mixtures that have timed out at ``t_ns`` [ns]."""
        self._reassembler.expire(t_ns)
        self._mixtures.expire(t_ns)
        if self._scenes is not None:
            self._scenes.expire(t_ns)

    def _delivered(self, received: ReceivedLine) -> MapLine:
        self.checks[received.line.slot].delivered(1)
        self.lines += 1
        self.line_frames += received.frames
        return received.line

    def _dropped(self, reason: Reason, frames: int) -> Reason:
        self._counts[reason] += frames
        return reason
