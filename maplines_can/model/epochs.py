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
from collections.abc import Mapping
from dataclasses import dataclass, field
from statistics import median
from typing import Generic, NamedTuple, TypeVar

from ..values.line import Slot

Pose = TypeVar("Pose")
Member = TypeVar("Member")

#: By how much a line may come before and after its pose error [cycles]; if slots may have mixtures,
#: whose counters come again sooner, the second pair.
WINDOW, MIXTURE_WINDOW = (1.0, 3.0), (0.5, 1.5)
#: Time for which a line waits for its pose error, and an epoch for lines [cycles].
HOLD_CYCLES, KEEP_CYCLES = 3.0, 5.0
#: Most epochs that are open, and intervals between pose errors whose median is the cycle.
MAX_EPOCHS, INTERVALS = 8, 5


@dataclass(eq=False)
class Epoch(Generic[Pose, Member]):
    """A pose error, and the lines that have joined it."""

    pose: Pose
    counters: Mapping[Slot, int]  #: low bits of the counters of its lines
    t_ns: int  #: time of its first frame
    lines: dict[Slot, Member] = field(default_factory=dict)


class Waiting(NamedTuple, Generic[Member]):
    """A line whose pose error has not come."""

    member: Member
    counter: int
    t_ns: int
    frames: int


class Epochs(Generic[Pose, Member]):
    """Epochs of a receiver; all times in ns."""

    def __init__(
        self,
        moduli: Mapping[Slot, int],
        cycle_ns: int,
        counts: Counter[str],
        *,
        has_mixtures: bool,
    ) -> None:
        self._moduli = moduli  # by slot, of the counters that a pose error states
        self._cycle_ns, self._counts = cycle_ns, counts  # between pose errors; dropped frames
        self._early, self._late = MIXTURE_WINDOW if has_mixtures else WINDOW
        self._open: deque[Epoch[Pose, Member]] = deque(maxlen=MAX_EPOCHS)
        self._waiting: dict[Slot, Waiting[Member]] = {}
        self._since_ns: dict[Slot, int] = {}  # break of a slot: no older epoch has its lines
        self._pose_ns: int | None = None  # time of the last pose error
        self._intervals_ns: deque[float] = deque(maxlen=INTERVALS)
        #: The newest epoch with lines that waits for no more.
        self.latest: Epoch[Pose, Member] | None = None

    @property
    def pending(self) -> int:
        """Frames of lines that wait for their pose error."""
        return sum(waiting.frames for waiting in self._waiting.values())

    def add_pose(
        self, pose: Pose, counters: Mapping[Slot, int], t_ns: int, ahead: int | None
    ) -> list[tuple[Epoch[Pose, Member], Slot, int]]:
        """Add a pose error; return its epoch, slot and frames of each line that waited for it.

        Its counter is ``ahead`` of the last one; after a break (None) all before it is forgotten.
        """
        self.expire(t_ns)
        if ahead is None:
            self._open.clear()
            self._intervals_ns.clear()
            for slot in [*self._waiting]:
                self._drop(slot)
        elif self._pose_ns is not None:
            self._intervals_ns.append(float(abs(t_ns - self._pose_ns)) / ahead)
        self._pose_ns = t_ns
        epoch = Epoch[Pose, Member](pose, counters, t_ns)
        self._open.append(epoch)
        joined = []
        for slot, waiting in [*self._waiting.items()]:
            if self._epoch_of(slot, waiting.counter, waiting.t_ns) is epoch:
                del self._waiting[slot]
                epoch.lines[slot] = waiting.member
                joined.append((epoch, slot, waiting.frames))
        self._choose_latest()
        return joined

    def add_line(
        self, member: Member, slot: Slot, counter: int, t_ns: int, frames: int, *, is_break: bool
    ) -> Epoch[Pose, Member] | None:
        """Add a line; return its epoch, or None if it waits, in place of an older one (POSE)."""
        self.expire(t_ns)
        if is_break:
            self._since_ns[slot] = t_ns
        self._drop(slot)
        epoch = self._epoch_of(slot, counter, t_ns)
        if epoch is None:
            self._waiting[slot] = Waiting(member, counter, t_ns, frames)
            return None
        epoch.lines[slot] = member
        self._choose_latest()
        return epoch

    def expire(self, t_ns: int) -> None:
        """Drop the lines and close the epochs that are too old, or far ahead of a time."""
        for slot, waiting in [*self._waiting.items()]:
            if abs(t_ns - waiting.t_ns) > HOLD_CYCLES * self._cycle_ns:
                self._drop(slot)
        while self._open and abs(t_ns - self._open[0].t_ns) > KEEP_CYCLES * self._cycle_ns:
            old = self._open.popleft()
            if old.lines and old is not self.latest and self.latest not in self._open:
                self.latest = old  # it has waited for long enough

    def _epoch_of(self, slot: Slot, counter: int, t_ns: int) -> Epoch[Pose, Member] | None:
        """Return the only epoch that a line fits."""
        if slot not in self._moduli:
            return None
        low, since_ns = counter % self._moduli[slot], self._since_ns.get(slot)
        fitting = [
            epoch
            for epoch in self._open
            if epoch.counters.get(slot) == low
            and self._fits_window(t_ns - epoch.t_ns)
            and (since_ns is None or epoch.t_ns >= since_ns)
        ]
        return fitting[0] if len(fitting) == 1 and slot not in fitting[0].lines else None

    def _fits_window(self, late_ns: int) -> bool:
        """Return whether a line may be so much later than its pose error."""
        cycle_ns: float = self._cycle_ns
        if self._intervals_ns:
            cycle_ns = min(cycle_ns, median(self._intervals_ns))  # the sender may be faster
        return -self._early * cycle_ns <= late_ns <= self._late * cycle_ns

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
