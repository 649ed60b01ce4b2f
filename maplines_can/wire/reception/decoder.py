"""Decoder of received frames: frames in, map lines and scenes out, everything else counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from ...values.line import MapLine, Slot
from ..layout.message_layout import Layout
from ..layout.pose_layout import POSE, Owner
from ..protection.secoc import Verifier
from ..reasons import Reason
from ..records.record import CompleteRecord, RawRecord, RecordReader
from ..records.scene_reader import SceneReader
from .check import Check
from .mixtures import MixtureAssembler, ReceivedLine
from .reassembly import Reassembler, Record
from .scenes import Joined, JoinedLine, ReceivedScene, SceneAssembler
from .sequence import SequenceCheck, SlotStats
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

#: Message of the error of a question about scenes if there are none.
NO_POSE = (
    "the DBC has no message of the pose error (MapLinePose), so there are no scenes; "
    "take maplines.dbc or maplines-pose.dbc"
)


class ReceivedFrame(NamedTuple):
    """A frame of the bus, as arguments of ``Decoder.feed``."""

    can_id: int
    data: bytes
    t_ns: int  #: time of reception [ns]
    is_extended: bool = False  #: the ID has 29 bits


class Decoder:
    """Decoder of the frames of a bus: the state of a receiver, and views of it.

    Every record passes the same stations, those of a slot and those of the pose error. Each may
    drop it, with a counted reason::

        frame          protection/secoc.py    with a key: MAC and freshness, before all others
          |            reassembly.py          all pages of one transfer, or none; time-outs
        record         records/packer.py      length, page numbers, transfer IDs, CRC
          |            records/*_format.py    values that no sender sends
          |            sequence.py            counter: duplicate, late or new; E2E status and state
        new record     mixtures.py            a line of all its components, or none
          |            scenes.py              lines of one pose error; records that wait for theirs
        lines, scene   views.py               may they be used: E2E state, age, second sender

    ``Codec.decoder`` makes one. At any time
    ``frames == line_frames + pose_frames + sum(counts.values()) + pending``.

    Each record is checked by its counter according to AUTOSAR E2E, and ``checks`` gives the state
    of each owner. Of good records, only duplicates and late ones are dropped. What to do with a
    line whose slot is not VALID is the consumer's decision; `latest` tells it. A step
    of more than ``max_delta_counter`` is a sequence break, but the record is new: how far a new one
    may be ahead follows from the time that has passed, see the table of ``SequenceCheck``.

    With a verifier the MAC is checked first, and a frame that is not authentic changes nothing:
    no line, no transfer, no check.

    Time is an argument. `latest` and `latest_scene` return the newest line of a slot and the newest
    scene at any time; a ``Receiver`` does the same on a bus. A decoder is not thread-safe: use it
    in one thread, or with a lock. A call during ``feed_arrays`` of another thread raises
    RuntimeError.

    Args:
        layout: of the records and their messages.
        reader: reads the records.
        verifiers: of the owners whose frames are authenticated.
        settings: of each owner.
        scenes: rebuilds lines and scenes; None if the DBC has no message of the pose error.

    >>> from maplines_can import Codec, Slot, MapLine
    >>> codec = Codec.from_dbc()
    >>> decoder = codec.decoder()
    >>> line = MapLine.mean_only(Slot.ROUTE, [1.75, 0, 0, 0], age=0.02)
    >>> for frame in codec.encoder().encode(line):
    ...     _ = decoder.feed(frame.can_id, frame.data, t_ns=0)
    >>> view = decoder.latest(Slot.ROUTE, now_ns=60_000_000)
    >>> view.state.name, round(view.age, 3), view.stale
    ('INIT', 0.084, False)
    >>> decoder.latest(Slot.ROUTE, now_ns=160_000_000).stale
    True
    """

    def __init__(
        self,
        layout: Layout,
        reader: RecordReader[Content],
        verifiers: Mapping[Owner, Verifier],
        settings: Mapping[Owner, RecordSettings],
        scenes: SceneReader | None,
    ) -> None:
        #: CAN IDs of all messages, for filters.
        self.can_ids = layout.can_ids
        #: Check whether frames are authentic, by owner; empty without authentication.
        self.verifiers = verifiers
        #: Whether lines are conditional on the pose error.
        self.is_conditional = layout.is_conditional
        self._slots = [owner for owner in settings if owner != POSE]
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
        self.frames = 0  #: frames received
        self.lines = 0  #: lines delivered
        self.line_frames = 0  #: frames of the lines delivered
        self.pose_errors = 0  #: pose errors received
        self.pose_frames = 0  #: frames of the pose errors received

    def __reduce__(self) -> str:
        raise TypeError(
            "a Decoder cannot be pickled or copied, since it holds the state of a receiver; pickle "
            "the Codec, and make another with its decoder()"
        )

    @property
    def checks(self) -> Mapping[Owner, Check]:
        """Checks of the records of each slot of the DBC, and of the pose error if it has that."""
        return self._checks

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
        """Decode a frame; return the lines that it completes, or the reason why none.

        Args:
            can_id: its CAN ID.
            data: its payload.
            t_ns: time of reception, on any clock that runs steadily [ns]. Times are limited to
                +-4e18 ns.
            is_extended: the ID has 29 bits.

        Returns:
            One line, or several if a pose error completes those that waited for it; or the reason
            why there is none (PENDING: not yet). No frame raises.

        Raises:
            ValueError: ``t_ns`` is not a whole number.
        """
        record = self._reassembled(can_id, data, t_ns, is_extended)
        answer = record if isinstance(record, Reason) else self._checked(record)
        return self._decoded([answer])[0] if isinstance(answer, Joined) else answer

    def feed_all(self, frames: Iterable[ReceivedFrame]) -> list[Sequence[MapLine] | Reason]:
        """Decode frames that have arrived, the first one first; return what ``feed`` does of each.

        Lines that are conditional on the same pose error are decoded together, which takes a
        fraction of the time. So a receiver that is late catches up.
        """
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
        self.frames += 1
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
        """Drop the transfers, mixtures and waiting lines that have timed out at ``t_ns`` [ns]."""
        t_ns = limited_ns(t_ns, "t_ns")
        self._reassembler.expire(t_ns)
        self._mixtures.expire(t_ns)
        if self._scenes is not None:
            self._scenes.expire(t_ns)

    def latest(self, slot: Slot, now_ns: int, *, stale_cycles: float = STALE_CYCLES) -> SlotView:
        """Return the newest line of a slot with its state.

        A line that is late by 240 to 255 records looks newer and is returned as such (see
        ``SequenceCheck``). These are 12 s of single lines, or 1.5 s of lines of 8 components.

        Args:
            slot: which line.
            now_ns: current time on the clock of the frames' time stamps [ns]. If it is before the
                reception of the line by more than ``CLOCK_JITTER_NS``, this clock was set back: the
                line is stale, and its age is infinite.
            stale_cycles: number of cycle times without a newer line after which a line is
                stale; see ``Codec.decoder`` for the cycle time.

        Raises:
            ValueError: the DBC has no such slot, ``now_ns`` is not a whole number, or
                ``stale_cycles`` is less than 0 or NaN.
        """
        self._check_slot(slot)
        check_stale_cycles(stale_cycles)
        now_ns = limited_ns(now_ns, "now_ns")
        owners: tuple[Owner, ...] = (slot, POSE) if self.is_conditional else (slot,)
        checks = [self._checks[owner] for owner in owners]
        return slot_view(Slot(slot), self._newest.get(slot), checks, now_ns, stale_cycles)

    def latest_scene(self, now_ns: int, *, stale_cycles: float = STALE_CYCLES) -> SceneView:
        """Return the newest scene: lines of one pose, with their joint covariance.

        The lines of a cycle arrive one after the other, in all of the cycle. The scene before
        remains the newest one until lines of all slots of the last two scenes have come, or the
        next pose error. A line that was lost is not in the scene. If the newest pose error is too
        old, the age is infinite.

        Args:
            now_ns: as in ``latest``.
            stale_cycles: number of cycle times since its pose error after which a scene is stale.

        Raises:
            ValueError: the DBC has no message of the pose error; or as ``latest``.
        """
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
        """Return the newest scene, see `latest_scene`; None before the first."""
        return None if self._scenes is None else self._scenes.latest()

    def slots(self, now_ns: int) -> dict[Slot, SlotStats]:
        """Return the E2E statistics of each slot on which anything was received."""
        stats = {slot: self._stats(slot, now_ns) for slot in self._slots}
        return {slot: known for slot, known in stats.items() if known is not None}

    def pose_error(self, now_ns: int) -> SlotStats | None:
        """Return the E2E statistics of the pose error; None if none was received."""
        return self._stats(POSE, now_ns) if POSE in self.checks else None

    def _check_slot(self, slot: Slot) -> None:
        if slot not in self._slots:
            names = ", ".join(known.name for known in self._slots)
            raise ValueError(f"slot must be one of the DBC's, {names}, got {slot!r}")

    def _check_of(self, owner: Owner) -> Check:
        return self._checks[owner]

    def _stats(self, owner: Owner, now_ns: int) -> SlotStats | None:
        check = self._check_of(owner)
        check.elapse(limited_ns(now_ns, "now_ns"))
        return None if check.status is None else check.stats()

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
        self.pose_errors += 1
        self.pose_frames += record.frames
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
            self.lines += 1
            self.line_frames += frames
            self._newest[line.slot] = line
            lines.append(line)
        return lines

    def _dropped(self, reason: Reason, record: Record[Content]) -> Reason:
        self._counts[reason] += record.frames
        return reason
