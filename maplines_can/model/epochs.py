"""Which lines belong to which pose error.

A line belongs to a pose error if the low bits of its counter are those that the pose error states
for its slot, and if its first frame was received within a window about that of the pose error::

    stated for the slot    5             6             7      (three bits)
    pose errors            P             P             P
    lines                   5             6       7     |     a line may come before its pose
    ---------------------------------------------------------------------------> time
                           |<---- window of line 5 and its pose ---->|

If it fits two, or the pose error has a line of the slot already, it joins none.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field
from statistics import median

from ..values.line import Slot
from ..wire.layout.pose_layout import PoseLayout
from .scenes import Member, Pose

#: By how much a line may come before and after its pose error [cycles]; if slots may have mixtures,
#: whose counters come again sooner, the second pair.
WINDOW, MIXTURE_WINDOW = (1.0, 3.0), (0.5, 1.5)
#: Time for which a line waits for its pose error, and an epoch for lines [cycles].
HOLD_CYCLES, KEEP_CYCLES = 3.0, 5.0
#: Intervals between pose errors whose median is the cycle.
INTERVALS = 5


@dataclass(eq=False)
class Epoch:
    """A pose error, and the lines that have joined it."""

    pose: Pose
    lines: dict[Slot, Member] = field(default_factory=dict)


class Epochs:
    """Epochs of a receiver; all times in ns."""

    def __init__(
        self, cycle_ns: int, counts: Counter[str], most: int, *, has_mixtures: bool
    ) -> None:
        self._cycle_ns, self._counts = cycle_ns, counts  # between pose errors; dropped frames
        self._early, self._late = MIXTURE_WINDOW if has_mixtures else WINDOW
        self._open: deque[Epoch] = deque(maxlen=most)
        self._waiting: dict[Slot, Member] = {}  # lines whose pose error has not come
        self._since_ns: dict[Slot, int] = {}  # break of a slot: no older epoch has its lines
        self._pose_ns: int | None = None  # time of the last pose error
        self._intervals_ns: deque[float] = deque(maxlen=INTERVALS)
        #: The newest epoch with lines that waits for no more.
        self.latest: Epoch | None = None

    @property
    def pending(self) -> int:
        """Frames of lines that wait for their pose error."""
        return sum(member.frames for member in self._waiting.values())

    def add_pose(self, pose: Pose, ahead: int | None) -> list[Member]:
        """Add a pose error; return the lines that waited for it.

        Its counter is ``ahead`` of the last one; after a break (None) all before it is forgotten.
        """
        self.expire(pose.t_ns)
        if ahead is None:
            self._open.clear()
            self._intervals_ns.clear()
            for slot in [*self._waiting]:
                self._drop(slot)
        elif self._pose_ns is not None:
            self._intervals_ns.append(float(abs(pose.t_ns - self._pose_ns)) / ahead)
        self._pose_ns = pose.t_ns
        epoch = Epoch(pose)
        self._open.append(epoch)
        joined = [one for one in self._waiting.values() if self._epoch_of(one) is epoch]
        for member in joined:
            epoch.lines[member.slot] = self._waiting.pop(member.slot)
        self._choose_latest()
        return joined

    def add_line(self, member: Member, *, is_break: bool) -> Pose | None:
        """Add a line; return its pose error, or None if it waits, in place of an older one."""
        self.expire(member.t_ns)
        if is_break:
            self._since_ns[member.slot] = member.t_ns
        self._drop(member.slot)
        epoch = self._epoch_of(member)
        if epoch is None:
            self._waiting[member.slot] = member
            return None
        epoch.lines[member.slot] = member
        self._choose_latest()
        return epoch.pose

    def expire(self, t_ns: int) -> None:
        """Drop the lines and close the epochs that are too old, or far ahead of a time."""
        for slot, member in [*self._waiting.items()]:
            if abs(t_ns - member.t_ns) > HOLD_CYCLES * self._cycle_ns:
                self._drop(slot)
        while self._open and abs(t_ns - self._open[0].pose.t_ns) > KEEP_CYCLES * self._cycle_ns:
            old = self._open.popleft()
            if old.lines and old is not self.latest and self.latest not in self._open:
                self.latest = old  # it has waited for long enough

    def _epoch_of(self, member: Member) -> Epoch | None:
        """Return the only epoch that a line fits."""
        fitting = [epoch for epoch in self._open if self._fits(member, epoch.pose)]
        is_free = len(fitting) == 1 and member.slot not in fitting[0].lines
        return fitting[0] if is_free else None

    def _fits(self, member: Member, pose: Pose) -> bool:
        """Return whether a line may belong to a pose error, by its counter and its time."""
        assert isinstance(pose.layout, PoseLayout)  # noqa: S101 - whole scenes have no epochs
        stated = pose.layout.counters.get(member.slot)
        if stated is None or member.counter % 2**stated.length != pose.raw[stated.name]:
            return False
        cycle_ns: float = self._cycle_ns
        if self._intervals_ns:
            cycle_ns = min(cycle_ns, median(self._intervals_ns))  # the sender may be faster
        late_ns = member.t_ns - pose.t_ns
        is_near = -self._early * cycle_ns <= late_ns <= self._late * cycle_ns
        return is_near and pose.t_ns >= self._since_ns.get(member.slot, pose.t_ns)

    def _choose_latest(self) -> None:
        """Take the newest epoch that waits for no line.

        An epoch waits until it has the slots of both epochs before, or the next pose error comes.
        """
        epochs = [*self._open]
        start = epochs.index(self.latest) + 1 if self.latest in epochs else 0
        for i in range(start, len(epochs)):
            is_over = i + 1 < len(epochs)
            expected = {slot for before in epochs[max(i - 2, 0) : i] for slot in before.lines}
            if epochs[i].lines and (is_over or epochs[i].lines.keys() >= expected):
                self.latest = epochs[i]

    def _drop(self, slot: Slot) -> None:
        if slot in self._waiting:
            self._counts["POSE"] += self._waiting.pop(slot).frames
