"""Reception of the pose error: from frames to new records."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Literal, NamedTuple

from ...values.line import Slot
from ..layout.pose_layout import POSE, PoseLayout
from ..protection.e2e_state import E2EConfig, ProfileStatus
from ..protection.secoc import Verifier
from ..reasons import Reason
from ..records.raw_format import RawFormat
from ..records.record import RawRecord, RecordReader
from .reassembly import Reassembler
from .sequence import SequenceCheck


class ReceivedPose(NamedTuple):
    """A new record of the pose error."""

    record: RawRecord
    slot_counters: dict[Slot, int]  #: low bits of the counters of the lines that belong to it
    t_ns: int  #: time of its first frame [ns]
    frames: int  #: frames that carried it
    ahead: int | None  #: by how much its counter is ahead of the last one; None after a break


class PoseReceiver:
    """Receiver of the pose error: as ``Decoder``, for one message without mixtures.

    ::

        frame -> Reassembler -> record -> SequenceCheck -> new record

    At any time ``frames == record_frames + sum(counts.values()) + pending``.

    Args:
        layout: of the pose error.
        verifier: checks authenticated frames; None for a bus without authentication.
        timeout_ns: longest time between the frames of a transfer [ns].
        cycle_ns: time between records [ns].
        e2e: windows and bounds of the E2E state machine.
    """

    def __init__(
        self,
        layout: PoseLayout,
        verifier: Verifier | None,
        timeout_ns: int,
        cycle_ns: int,
        e2e: E2EConfig,
    ) -> None:
        #: Number of bits that a pose error states for each slot.
        self.slot_bits = {slot: signal.length for slot, signal in layout.counters.items()}
        self._ids = layout.message_of_id
        self._layout = layout
        reader = RecordReader(RawFormat.of_pose(layout))
        self._reassembler: Reassembler[Literal["pose"], RawRecord] = Reassembler(
            layout, reader, {POSE: timeout_ns}, verifier
        )
        self._modulus = 2 ** layout["Counter"].length
        most = min(e2e.max_delta_counter, self._modulus // 4)
        #: Check of the records, as that of a slot.
        self.check = SequenceCheck(
            replace(e2e, max_delta_counter=most),
            self._modulus,
            layout.pages,
            cycle_ns,
            is_authentic=verifier is not None,
        )
        self._last: int | None = None
        self._counts: Counter[Reason] = Counter()
        self.frames = 0  #: frames received
        self.records = 0  #: new records
        self.record_frames = 0  #: frames of the new records

    @property
    def counts(self) -> Counter[Reason]:
        """Dropped frames by reason."""
        return self._reassembler.counts + self._counts

    @property
    def pending(self) -> int:
        """Frames of transfers that are not complete yet."""
        return self._reassembler.pending

    def knows(self, can_id: int, is_extended: bool = False) -> bool:
        """Return whether frames with this CAN ID carry the pose error."""
        return (can_id, is_extended) in self._ids

    def feed(
        self, can_id: int, data: bytes, t_ns: int, *, is_extended: bool = False
    ) -> ReceivedPose | Reason:
        """Decode a frame; return the new record that it completes, or the reason why none.

        Args:
            can_id: its CAN ID.
            data: its payload.
            t_ns: time of reception [ns].
            is_extended: the ID has 29 bits.
        """
        self.frames += 1
        record = self._reassembler.feed(can_id, data, t_ns, is_extended)
        if isinstance(record, Reason):
            self.check.frame_dropped(record, t_ns)
            return record
        content = record.content
        if isinstance(content, Reason):
            self.check.failed(record.t_ns)
            return self._dropped(content, record.frames)
        reason = self.check.received(content.counter, hash(record.payload), record.t_ns)
        if reason is not None:
            return self._dropped(reason, record.frames)
        self.check.delivered(1)
        self.records += 1
        self.record_frames += record.frames
        ahead: int | None = 1
        if self._last is not None:
            ahead = (content.counter - self._last) % self._modulus
        self._last = content.counter
        if self.check.status is ProfileStatus.WRONGSEQUENCE:
            ahead = None
        counters = self._layout.slot_counters(content.raw)
        return ReceivedPose(content, counters, record.t_ns, record.frames, ahead)

    def expire(self, t_ns: int) -> None:
        """Drop the transfers that have timed out at ``t_ns`` [ns]."""
        self._reassembler.expire(t_ns)

    def _dropped(self, reason: Reason, frames: int) -> Reason:
        self._counts[reason] += frames
        return reason
