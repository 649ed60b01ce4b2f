"""Join of pose errors and lines: epochs, and the lines and scenes that are rebuilt from them."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, TypeVar

from ...values.errors import IllPosedError
from ...values.line import MapLine, Slot
from ...values.scene import Scene
from ..layout.pose_layout import PoseLayout, slot_of
from ..reasons import Reason
from ..records.record import RawRecord
from ..records.scene_reader import Member, SceneLine, ScenePose, SceneReader
from .mixtures import ReceivedLine

Pose = TypeVar("Pose")
Line = TypeVar("Line")

#: Longest time by which the first frame of a line comes before that of its pose error, and after
#: it [cycles].
WINDOW = (1.0, 3.0)
#: The same on a bus with mixtures, whose components make the counters of a slot wrap around faster.
MIXTURE_WINDOW = (0.5, 1.5)
#: Time for which a line waits for its pose error, and an epoch for lines [cycles]: the window, and
#: the time in which the rest of a record may arrive.
HOLD_CYCLES, KEEP_CYCLES = 3.0, 5.0
#: Most epochs that are kept.
MAX_EPOCHS = 8
#: Intervals between pose errors whose median is the cycle of a sender that is fast.
INTERVALS = 5


@dataclass(eq=False)
class Epoch(Generic[Pose, Line]):
    """One pose error, and the lines that belong to it received so far."""

    pose: Pose
    slot_counters: Mapping[Slot, int]  #: low bits of the counters of the lines that belong to it
    t_ns: int  #: time of the first frame of the pose error [ns]
    lines: dict[Slot, Line] = field(default_factory=dict)


class Joined(NamedTuple, Generic[Pose, Line]):
    """A line, and the epoch that it now belongs to."""

    epoch: Epoch[Pose, Line]
    slot: Slot
    line: Line
    frames: int  #: that carried the line


class _Waiting(NamedTuple, Generic[Line]):
    """A line without its pose error."""

    line: Line
    counter: int
    t_ns: int
    frames: int


class EpochAssembler(Generic[Pose, Line]):
    """Assembler of epochs; time is an argument.

    The sender sends the pose error first in each cycle, then the lines. A line belongs to a pose
    error if the low bits of its counter are those that the pose error states for its slot, and if
    its first frame was received within a window about that of the pose error::

        stated for the slot    5             6             7      (three bits)
        pose errors            P             P             P
        lines                   5             6       7     |     a line may come before its pose
        ---------------------------------------------------------------------------> time
                               |<---- window of line 5 and its pose ---->|

    All lines of a cycle come from one record each, so that eight cycles pass before the bits come
    again; half as many if the slot had no line in between, see ``absent_counter``. No line joins
    a wrong pose error if, of a cycle, neither a line nor the pose error is delayed by two cycles
    or more relative to the other. (Records that come after a newer one of their slot are STALE and
    do not reach this class.) With mixtures, a slot may send eight records in a cycle. Then the
    window is narrower, and the delay must be less than half a cycle. Pose errors and lines must
    take the same path: a constant delay of one of them by eight cycles cannot be detected.

    If a line fits two pose errors, or a pose error has a line of the slot already, it joins none.
    After a sequence break of the pose errors, the epochs and lines before it are forgotten; after
    one of a slot, its lines join later pose errors only.

    The lines of a cycle arrive one after the other, in all of the cycle. An epoch waits for lines
    until it has the slots of both epochs before, or the next pose error has come. So one line that
    is lost does not shorten the wait of the next epoch.

    If the sender is faster than ``cycle_ns``, the window shrinks with the median time between pose
    errors. Memory is bounded: one waiting line for each slot, the newest, and ``MAX_EPOCHS``.

    Args:
        slot_bits: number of bits that a pose error states for each slot.
        cycle_ns: time between pose errors [ns].
        has_mixtures: whether lines may be mixtures.
    """

    def __init__(self, slot_bits: Mapping[Slot, int], cycle_ns: int, *, has_mixtures: bool) -> None:
        self._moduli = {slot: 2**bits for slot, bits in slot_bits.items()}
        self._longest_cycle_ns = cycle_ns
        self._early, self._late = MIXTURE_WINDOW if has_mixtures else WINDOW
        self._epochs: deque[Epoch[Pose, Line]] = deque(maxlen=MAX_EPOCHS)
        self._waiting: dict[Slot, _Waiting[Line]] = {}
        self._since_ns: dict[Slot, int] = {}  # sequence break of a slot
        self._pose_ns: int | None = None  # time of the last pose error
        self._intervals_ns: deque[float] = deque(maxlen=INTERVALS)
        #: The newest epoch with lines that waits for none; None before the first one, which does
        #: not wait, nor does the first one after a sequence break.
        self.latest: Epoch[Pose, Line] | None = None
        #: Frames of lines dropped here, by reason.
        self.counts: Counter[Reason] = Counter()

    @property
    def pending(self) -> int:
        """Frames of lines that wait for their pose error."""
        return sum(waiting.frames for waiting in self._waiting.values())

    @property
    def epochs(self) -> tuple[Epoch[Pose, Line], ...]:
        """The epochs that lines may still join, the oldest first."""
        return tuple(self._epochs)

    def add_pose(
        self,
        pose: Pose,
        slot_counters: Mapping[Slot, int],
        t_ns: int,
        *,
        ahead: int | None = 1,
    ) -> list[Joined[Pose, Line]]:
        """Add a new pose error; return the waiting lines that belong to it.

        Args:
            pose: the pose error.
            slot_counters: low bits of the counters of the lines that belong to it.
            t_ns: time of its first frame [ns].
            ahead: by how much its counter is ahead of that of the last one; None after a sequence
                break.
        """
        self.expire(t_ns)
        if ahead is None:
            self._restart()
        elif self._pose_ns is not None:
            self._intervals_ns.append(float(abs(t_ns - self._pose_ns)) / ahead)
        self._pose_ns = t_ns
        epoch = Epoch[Pose, Line](pose, dict(slot_counters), t_ns)
        self._epochs.append(epoch)
        joined = []
        for slot, waiting in list(self._waiting.items()):
            if self._epoch_of(slot, waiting.counter, waiting.t_ns) is epoch:
                del self._waiting[slot]
                joined.append(self._joined(epoch, slot, waiting.line, waiting.frames))
        self._set_latest()
        return joined

    def add_line(
        self,
        line: Line,
        slot: Slot,
        counter: int,
        t_ns: int,
        *,
        frames: int = 0,
        is_break: bool = False,
    ) -> Joined[Pose, Line] | None:
        """Add a new line that is no mixture; return its epoch if the pose error is there.

        Otherwise the line waits, in place of an older one of the slot, which is dropped (POSE).

        Args:
            line: the line.
            slot: its slot.
            counter: of its record.
            t_ns: time of its first frame [ns].
            frames: frames that carried it, for ``counts``.
            is_break: the record comes after a sequence break of the slot.
        """
        self.expire(t_ns)
        if is_break:
            self._since_ns[slot] = t_ns
        self._drop(slot)
        epoch = self._epoch_of(slot, counter, t_ns)
        if epoch is not None:
            joined = self._joined(epoch, slot, line, frames)
            self._set_latest()
            return joined
        self._waiting[slot] = _Waiting(line, counter, t_ns, frames)
        return None

    def expire(self, t_ns: int) -> None:
        """Drop the epochs and lines that are too old at ``t_ns`` [ns], or far ahead of it."""
        hold_ns = HOLD_CYCLES * self._longest_cycle_ns
        for slot in [s for s, w in self._waiting.items() if abs(t_ns - w.t_ns) > hold_ns]:
            self._drop(slot)
        keep_ns = KEEP_CYCLES * self._longest_cycle_ns
        while self._epochs and abs(t_ns - self._epochs[0].t_ns) > keep_ns:
            old = self._epochs.popleft()
            if old.lines and old is not self.latest and self.latest not in self._epochs:
                self.latest = old  # it has waited for long enough

    def _fits_window(self, late_ns: int) -> bool:
        """Return whether a line may be this much later than its pose error."""
        cycle_ns: float = self._longest_cycle_ns
        if self._intervals_ns:
            from statistics import median  # loads decimal and more, which C does not need

            cycle_ns = min(cycle_ns, median(self._intervals_ns))
        return -self._early * cycle_ns <= late_ns <= self._late * cycle_ns

    def _epoch_of(self, slot: Slot, counter: int, t_ns: int) -> Epoch[Pose, Line] | None:
        """Return the only epoch that a line fits; None if there is none or more than one."""
        modulus = self._moduli.get(slot)
        if modulus is None:
            return None
        low, since_ns = counter % modulus, self._since_ns.get(slot)
        fitting = [
            epoch
            for epoch in self._epochs
            if epoch.slot_counters.get(slot) == low
            and self._fits_window(t_ns - epoch.t_ns)
            and (since_ns is None or epoch.t_ns >= since_ns)
        ]
        if len(fitting) != 1 or slot in fitting[0].lines:
            return None
        return fitting[0]

    def _joined(
        self, epoch: Epoch[Pose, Line], slot: Slot, line: Line, frames: int
    ) -> Joined[Pose, Line]:
        epoch.lines[slot] = line
        return Joined(epoch, slot, line, frames)

    def _set_latest(self) -> None:
        """Take the newest epoch that waits for no line as the latest one."""
        epochs = [*self._epochs]
        start = epochs.index(self.latest) + 1 if self.latest in epochs else 0
        for i, epoch in enumerate(epochs[start:], start):
            is_over = epoch is not epochs[-1]
            expected = {slot for before in epochs[max(i - 2, 0) : i] for slot in before.lines}
            if epoch.lines and (is_over or epoch.lines.keys() >= expected):
                self.latest = epoch

    def _restart(self) -> None:
        self._epochs.clear()
        self._intervals_ns.clear()
        for slot in list(self._waiting):
            self._drop(slot)

    def _drop(self, slot: Slot) -> None:
        if slot in self._waiting:
            self.counts[Reason.POSE] += self._waiting.pop(slot).frames


class ReceivedScene(NamedTuple):
    """A scene as received."""

    scene: Scene
    counter: int  #: of the pose error, which with ``t_ns`` tells a scene from the one before
    t_ns: int  #: time of the first frame of the pose error [ns]
    age: float  #: from the pose to the sending of the pose error [s]; infinite if it is too old


#: Lines are members until they are decoded.
JoinedLine = Joined[ScenePose, Member | SceneLine]
_Epoch = Epoch[ScenePose, Member | SceneLine]


class SceneAssembler:
    """Assembler of lines and scenes from pose errors and the records that belong to them.

    Args:
        layout: of the pose error.
        reader: rebuilds lines and scenes.
        cycle_ns, has_mixtures: see ``EpochAssembler``.
    """

    def __init__(
        self, layout: PoseLayout, reader: SceneReader, cycle_ns: int, *, has_mixtures: bool
    ) -> None:
        self._layout, self._reader = layout, reader
        bits = {slot: signal.length for slot, signal in layout.counters.items()}
        self._epochs = EpochAssembler[ScenePose, Member | SceneLine](
            bits, cycle_ns, has_mixtures=has_mixtures
        )
        self._counts: Counter[Reason] = Counter()
        #: Whether the newest pose error is too old: the sender vouches for no scene any more.
        self.is_too_old = False
        self._built: tuple[_Epoch, int, ReceivedScene] | None = None

    @property
    def counts(self) -> Counter[Reason]:
        """Dropped frames by reason."""
        return self._epochs.counts + self._counts

    @property
    def pending(self) -> int:
        """Frames of lines that wait for their pose error."""
        return self._epochs.pending

    def add_pose(self, pose: RawRecord, t_ns: int, ahead: int | None) -> list[ReceivedLine]:
        """Add a new pose error; return the lines of the conditional records that waited for it.

        The arguments are those of ``EpochAssembler.add_pose``.
        """
        decoded = self._reader.pose(pose, t_ns)
        self.is_too_old = math.isinf(decoded.age)
        counters = self._layout.slot_counters(pose.raw)
        joined = self._epochs.add_pose(decoded, counters, t_ns, ahead=ahead)
        lines = self.lines([one for one in joined if _is_conditional(one.line)])
        return [line for line in lines if isinstance(line, ReceivedLine)]

    def add_record(
        self, record: RawRecord, t_ns: int, frames: int, is_break: bool
    ) -> JoinedLine | Reason:
        """Add a record that is conditional on a pose error; PENDING if that is not there.

        Otherwise ``lines`` decodes the line: now, or with others of its epoch.

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
        return Reason.PENDING if joined is None else joined

    def lines(self, joined: Sequence[JoinedLine]) -> list[ReceivedLine | Reason]:
        """Return the lines of conditional records that have joined their pose errors.

        CONTENT for a line that is no function of x in its range.
        """
        for epoch in dict.fromkeys(one.epoch for one in joined):
            self._decode(epoch, [one.slot for one in joined if one.epoch is epoch])
        return [self._received(one) for one in joined]

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
        self._epochs.expire(t_ns)

    def _scene(self, epoch: _Epoch) -> ReceivedScene:
        """Return the scene of an epoch, without lines that are no function of x in their range."""
        slots = sorted(epoch.lines)
        self._decode(epoch, [slot for slot in slots if isinstance(epoch.lines[slot], Member)])
        lines, pose = [epoch.lines[slot] for slot in slots], epoch.pose
        scene = self._reader.scene(pose, [line for line in lines if isinstance(line, SceneLine)])
        return ReceivedScene(scene, pose.record.counter, epoch.t_ns, pose.age)

    def _decode(self, epoch: _Epoch, slots: Sequence[Slot]) -> None:
        """Decode the lines of some slots of an epoch; one that is no function of x stays as it is.

        All at once, which is faster; if one of them is no function of x, one by one.
        """
        members = [line for slot in slots if isinstance(line := epoch.lines[slot], Member)]
        if not members:
            return
        try:
            epoch.lines.update(zip(slots, self._reader.lines(epoch.pose, members), strict=True))
        except IllPosedError:
            for slot in slots if len(slots) > 1 else ():
                self._decode(epoch, [slot])

    def _received(self, joined: JoinedLine) -> ReceivedLine | Reason:
        """Return the line of a conditional record that has been decoded, or CONTENT."""
        line = joined.epoch.lines[joined.slot]
        if isinstance(line, SceneLine):
            return ReceivedLine(line.line, joined.frames)
        self._counts[Reason.CONTENT] += joined.frames
        return Reason.CONTENT


def _is_conditional(line: Member | SceneLine) -> bool:
    return isinstance(line, Member) and isinstance(line.content, RawRecord)
