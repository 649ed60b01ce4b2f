"""Decoder of received frames in Python."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from ...values.line import MapLine, Slot
from ..layout.message_layout import Layout
from ..layout.pose_layout import POSE, Owner
from ..protection.secoc import Verifier
from ..reasons import Reason
from ..records.record import CompleteRecord, RawRecord, RecordReader
from ..records.scene_reader import SceneReader
from .check import Check
from .decoder import NO_POSE, Decoder, ReceivedFrame
from .mixtures import MixtureAssembler, ReceivedLine
from .reassembly import Reassembler, Record
from .scenes import Joined, JoinedLine, ReceivedScene, SceneAssembler
from .sequence import SequenceCheck
from .settings import RecordSettings
from .times import limited_ns
from .views import (
    STALE_CYCLES,
    SceneView,
    SlotView,
    check_stale_cycles,
    scene_view,
    slot_view,
)

# Looked up only once, since feed is called for every frame.
PENDING, FOREIGN = Reason.PENDING, Reason.FOREIGN

Content = CompleteRecord | RawRecord


class PythonDecoder(Decoder):
    """Decoder whose stations are in Python: one thread at a time may use it.

    Args:
        layout: of the records and their messages.
        reader: reads the records.
        verifiers: of the owners whose frames are authenticated.
        settings: of each owner.
        scenes: rebuilds lines and scenes; None if the DBC has no message of the pose error.
    """

    def __init__(
        self,
        layout: Layout,
        reader: RecordReader[Content],
        verifiers: Mapping[Owner, Verifier],
        settings: Mapping[Owner, RecordSettings],
        scenes: SceneReader | None,
    ) -> None:
        super().__init__(layout, verifiers, settings)
        timeouts_ns = {owner: own.timeout_ns for owner, own in settings.items()}
        self._reassembler = Reassembler(layout, reader, timeouts_ns, verifiers)
        self._mixtures = MixtureAssembler(2 ** layout["Counter"].length, timeouts_ns)
        self._scenes: SceneAssembler | None = None
        if (pose := layout.pose) is not None and scenes is not None:
            cycle_ns, mixed = settings[POSE].cycle_ns, not layout.is_conditional
            self._scenes = SceneAssembler(pose, scenes, cycle_ns, has_mixtures=mixed)
        self._checks: Mapping[Owner, SequenceCheck] = {
            owner: SequenceCheck(
                own.e2e,
                2 ** of_owner["Counter"].length,
                of_owner.pages,
                own.cycle_ns,
                is_authentic=owner in verifiers,
            )
            for owner, own in settings.items()
            if (of_owner := layout.pose if owner == POSE else layout) is not None
        }
        self._newest: dict[Slot, MapLine] = {}
        self._counts: Counter[Reason] = Counter()  # of records that are damaged or not new
        self._frames = self._lines = self._line_frames = 0
        self._pose_errors = self._pose_frames = 0

    @property
    def checks(self) -> Mapping[Owner, Check]:
        """Checks of the records of each slot of the DBC, and of the pose error if it has that."""
        return self._checks

    @property
    def frames(self) -> int:
        """Frames received."""
        return self._frames

    @property
    def lines(self) -> int:
        """Lines delivered."""
        return self._lines

    @property
    def line_frames(self) -> int:
        """Frames of the lines delivered."""
        return self._line_frames

    @property
    def pose_errors(self) -> int:
        """Pose errors received."""
        return self._pose_errors

    @property
    def pose_frames(self) -> int:
        """Frames of the pose errors received."""
        return self._pose_frames

    @property
    def lost(self) -> int:
        """Records of lines missing between those received, by their counters."""
        return sum(check.lost for owner, check in self._checks.items() if owner != POSE)

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

    def feed(
        self, can_id: int, data: bytes, t_ns: int, *, is_extended: bool = False
    ) -> Sequence[MapLine] | Reason:
        """Decode a frame; see ``Decoder.feed``."""
        record = self._reassembled(can_id, data, t_ns, is_extended)
        answer = record if isinstance(record, Reason) else self._checked(record)
        return self._decoded([answer])[0] if isinstance(answer, Joined) else answer

    def feed_all(self, frames: Iterable[ReceivedFrame]) -> list[Sequence[MapLine] | Reason]:
        """Decode frames that have arrived; see ``Decoder.feed_all``."""
        answers: list[Sequence[MapLine] | Reason] = []
        joined: dict[int, JoinedLine] = {}  # lines that are not decoded yet, by their places

        def decode() -> None:
            for place, answer in zip(joined, self._decoded([*joined.values()]), strict=True):
                answers[place] = answer
            joined.clear()

        for frame in frames:
            record = self._reassembled(*frame)
            if isinstance(record, Reason):
                answers.append(record)
                continue
            if record.owner == POSE or any(one.slot == record.owner for one in joined.values()):
                decode()  # the check of a slot knows which of its lines were delivered
            answer = self._checked(record)
            if isinstance(answer, Joined):
                joined[len(answers)], answer = answer, PENDING
            answers.append(answer)
        decode()
        return answers

    def _reassembled(
        self, can_id: int, data: bytes, t_ns: int, is_extended: bool
    ) -> Record[Content] | Reason:
        """Return the record that a frame completes, or the reason why none."""
        record = self._reassembler.feed(can_id, data, t_ns, is_extended)
        self._frames += 1
        if isinstance(record, Reason) and record is not PENDING and record is not FOREIGN:
            owner = self._reassembler.owner_of(can_id, is_extended)
            self._checks[owner].frame_dropped(record, limited_ns(t_ns, "t_ns"))
        return record

    def _checked(self, record: Record[Content]) -> list[MapLine] | JoinedLine | Reason:
        """Return the lines of a record, a line that is to be decoded, or the reason why none."""
        check, content = self._checks[record.owner], record.content
        if isinstance(content, Reason):
            check.failed(record.t_ns)
            return self._dropped(content, record)
        payload = hash(record.payload)
        reason = check.received(content.counter, payload, record.t_ns, content.count)
        if reason is not None:
            if reason is Reason.STALE:
                self._mixtures.drop_if_within(record.owner, content.counter)
            return self._dropped(reason, record)
        if isinstance(content, CompleteRecord):
            return self._add_component(content, record, check)
        return self._add_to_scene(content, record, check)

    def expire(self, t_ns: int) -> None:
        """Drop what has timed out; see ``Decoder.expire``."""
        t_ns = limited_ns(t_ns, "t_ns")
        self._reassembler.expire(t_ns)
        self._mixtures.expire(t_ns)
        if self._scenes is not None:
            self._scenes.expire(t_ns)

    def latest(self, slot: Slot, now_ns: int, *, stale_cycles: float = STALE_CYCLES) -> SlotView:
        """Return the newest line of a slot with its state; see ``Decoder.latest``."""
        self._check_slot(slot)
        check_stale_cycles(stale_cycles)
        now_ns = limited_ns(now_ns, "now_ns")
        owners: tuple[Owner, ...] = (slot, POSE) if self.is_conditional else (slot,)
        checks = [self._checks[owner] for owner in owners]
        return slot_view(Slot(slot), self._newest.get(slot), checks, now_ns, stale_cycles)

    def latest_scene(self, now_ns: int, *, stale_cycles: float = STALE_CYCLES) -> SceneView:
        """Return the newest scene with its state; see ``Decoder.latest_scene``."""
        if self._scenes is None:
            raise ValueError(NO_POSE)
        check_stale_cycles(stale_cycles)
        now_ns = limited_ns(now_ns, "now_ns")
        received = self._scenes.latest()
        lines = () if received is None else received.scene.lines
        slots = {line.slot: self._checks[line.slot] for line in lines}
        pose_check, is_too_old = self._checks[POSE], self._scenes.is_too_old
        return scene_view(received, is_too_old, pose_check, slots, now_ns, stale_cycles)

    def scene(self) -> ReceivedScene | None:
        """Return the newest scene; see ``Decoder.scene``."""
        return None if self._scenes is None else self._scenes.latest()

    def _check_of(self, owner: Owner) -> Check:
        return self._checks[owner]

    def _add_component(
        self, content: CompleteRecord, record: Record[Content], check: SequenceCheck
    ) -> list[MapLine] | Reason:
        """Add a new record with a covariance of its own to its mixture, and its line to a scene."""
        slot = content.line.slot
        if content.count > 1 and check.counter_was_reused(record.t_ns):
            self._mixtures.drop(slot)  # its components may come from two senders
            return self._dropped(Reason.INCOMPLETE, record)
        complete = self._mixtures.add(content, record.frames, record.t_ns)
        if isinstance(complete, Reason):
            return complete
        if self._scenes is not None and complete.records == 1:
            is_break = check.ahead is None
            self._scenes.add_line(complete.line, content.counter, record.t_ns, is_break)
        return self._delivered([complete])

    def _add_to_scene(
        self,
        content: RawRecord,
        record: Record[Content],
        check: SequenceCheck,
    ) -> list[MapLine] | JoinedLine | Reason:
        """Add a new pose error, or a new record that is conditional on one, to its scene."""
        if self._scenes is None:  # the layout requires a pose error
            return self._dropped(Reason.POSE, record)
        if content.owner != POSE:
            is_break = check.ahead is None
            return self._scenes.add_record(content, record.t_ns, record.frames, is_break)
        check.delivered(1)
        self._pose_errors += 1
        self._pose_frames += record.frames
        lines = self._scenes.add_pose(content, record.t_ns, check.ahead)
        return self._delivered(lines) if lines else PENDING

    def _decoded(self, joined: Sequence[JoinedLine]) -> list[list[MapLine] | Reason]:
        """Decode lines that have joined their pose errors; return what is delivered of each."""
        lines = [] if self._scenes is None else self._scenes.lines(joined)
        return [line if isinstance(line, Reason) else self._delivered([line]) for line in lines]

    def _delivered(self, received: Iterable[ReceivedLine]) -> list[MapLine]:
        """Count the lines that a frame has completed, and keep each as the newest of its slot."""
        lines = []
        for line, frames, records in received:
            self._checks[line.slot].delivered(records)
            self._lines += 1
            self._line_frames += frames
            self._newest[line.slot] = line
            lines.append(line)
        return lines

    def _dropped(self, reason: Reason, record: Record[Content]) -> Reason:
        self._counts[reason] += record.frames
        return reason
