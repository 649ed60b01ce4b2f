"""Reception of scenes: pose errors, and the lines that belong to them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from ...values.errors import IllPosedError
from ...values.line import MapLine
from ...values.scene import Scene
from ..layout.message_layout import Layout
from ..layout.pose_layout import slot_of
from ..reasons import Reason
from ..records.record import RawRecord
from ..records.scene_reader import Member, SceneReader
from .epochs import Epoch, EpochAssembler, Joined
from .poses import PoseReceiver, ReceivedPose
from .sequence import SequenceCheck


class ReceivedLine(NamedTuple):
    """A line whose record is conditional on a pose error, with that."""

    line: MapLine
    frames: int  #: that carried the line


class ReceivedScene(NamedTuple):
    """A scene as received."""

    scene: Scene
    counter: int  #: of the pose error, which with ``t_ns`` tells a scene from the one before
    t_ns: int  #: time of the first frame of the pose error [ns]
    age: float  #: from the pose to the sending of the pose error [s]; infinite if it is too old


class SceneReceiver:
    """Receiver of pose errors and of the lines that belong to them.

    Args:
        poses: receiver of the pose error.
        epochs: joins pose errors and lines.
        reader: rebuilds lines and scenes.
    """

    def __init__(
        self,
        poses: PoseReceiver,
        epochs: EpochAssembler[ReceivedPose, Member],
        reader: SceneReader,
    ) -> None:
        self._poses, self._epochs, self._reader = poses, epochs, reader
        self._counts: Counter[Reason] = Counter()
        #: Whether the newest pose error is too old: the sender vouches for no scene any more.
        self.is_too_old = False
        self._built: tuple[Epoch[ReceivedPose, Member], int, ReceivedScene] | None = None

    @classmethod
    def of(cls, poses: PoseReceiver, reader: SceneReader, layout: Layout) -> SceneReceiver:
        """Return the receiver of scenes whose lines have this layout."""
        cycle_ns, mixed = poses.check.cycle_ns, not layout.is_conditional
        return cls(poses, EpochAssembler(poses.slot_bits, cycle_ns, has_mixtures=mixed), reader)

    @property
    def check(self) -> SequenceCheck:
        """Check of the pose errors."""
        return self._poses.check

    @property
    def counts(self) -> Counter[Reason]:
        """Dropped frames by reason."""
        return self._poses.counts + self._epochs.counts + self._counts

    @property
    def pending(self) -> int:
        """Frames of pose errors that are not complete, and of lines that wait for theirs."""
        return self._poses.pending + self._epochs.pending

    @property
    def pose_errors(self) -> int:
        """Pose errors received."""
        return self._poses.records

    @property
    def pose_frames(self) -> int:
        """Frames of the pose errors received."""
        return self._poses.record_frames

    def knows(self, can_id: int, is_extended: bool) -> bool:
        """Return whether frames with this CAN ID carry the pose error."""
        return self._poses.knows(can_id, is_extended)

    def feed_pose(
        self, can_id: int, data: bytes, t_ns: int, is_extended: bool
    ) -> list[ReceivedLine] | Reason:
        """Decode a frame of the pose error; return the lines that waited for it.

        Returns:
            One line or more; or the reason why there is none.
        """
        pose = self._poses.feed(can_id, data, t_ns, is_extended=is_extended)
        if isinstance(pose, Reason):
            return pose
        self.is_too_old = math.isinf(self._reader.age(pose.record))
        joined = self._epochs.add_pose(pose, pose.slot_counters, pose.t_ns, ahead=pose.ahead)
        conditional = [one for one in joined if isinstance(one.line.content, RawRecord)]
        lines = [self._rebuilt(one) for one in conditional]
        return [line for line in lines if isinstance(line, ReceivedLine)] or Reason.PENDING

    def add_record(
        self, record: RawRecord, t_ns: int, frames: int, is_break: bool
    ) -> ReceivedLine | Reason:
        """Add a record that is conditional on a pose error; return its line, if that is there.

        Args:
            record: of the line.
            t_ns: time of its first frame [ns].
            frames: frames that carried it.
            is_break: it comes after a sequence break of its slot.
        """
        joined = self._epochs.add_line(
            Member(record, t_ns),
            slot_of(record.owner),
            record.counter,
            t_ns,
            frames=frames,
            is_break=is_break,
        )
        return Reason.PENDING if joined is None else self._rebuilt(joined)

    def add_line(self, line: MapLine, counter: int, t_ns: int, is_break: bool) -> None:
        """Add a line with a covariance of its own, which has been delivered."""
        if line.x_min < line.x_max:
            member = Member(line, t_ns)
            self._epochs.add_line(member, line.slot, counter, t_ns, is_break=is_break)

    def latest(self) -> ReceivedScene | None:
        """Return the newest scene that waits for no line; None before the first."""
        epoch = self._epochs.latest
        if epoch is None:
            return None
        if self._built is None or self._built[:2] != (epoch, len(epoch.lines)):
            self._built = epoch, len(epoch.lines), self._scene(epoch)
        return self._built[2]

    def expire(self, t_ns: int) -> None:
        """Drop what has timed out at ``t_ns`` [ns]."""
        self._poses.expire(t_ns)
        self._epochs.expire(t_ns)

    def _scene(self, epoch: Epoch[ReceivedPose, Member]) -> ReceivedScene:
        """Return the scene of an epoch, without lines that are no function of x in their range."""
        pose = epoch.pose
        members = [epoch.lines[slot] for slot in sorted(epoch.lines)]
        scene = self._joint(pose, members)
        if scene is None:
            members = [one for one in members if self._joint(pose, [one]) is not None]
            scene = self._joint(pose, members) or self._reader.scene(pose.record, pose.t_ns, [])
        return ReceivedScene(scene, pose.record.counter, pose.t_ns, self._reader.age(pose.record))

    def _joint(self, pose: ReceivedPose, members: Sequence[Member]) -> Scene | None:
        """Return the scene of a pose error and lines; None if a line is no function of x."""
        try:
            return self._reader.scene(pose.record, pose.t_ns, members)
        except IllPosedError:
            return None

    def _rebuilt(self, joined: Joined[ReceivedPose, Member]) -> ReceivedLine | Reason:
        """Return the line of a conditional record that has joined its pose error."""
        scene = self._joint(joined.epoch.pose, [joined.line])
        if scene is None:
            self._counts[Reason.CONTENT] += joined.frames
            return Reason.CONTENT
        return ReceivedLine(scene.lines[0], joined.frames)
