"""Queue of the next transfers of each slot, with their deadlines; time is an argument."""

from __future__ import annotations

import copy
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import NamedTuple

from ..values.line import LeftOut, MapLine, Slot, aged
from ..wire import POSE, SCENE, Encoder, Frame, LineCodec, Owner, PreparedScene
from .schedule import Schedule

#: Max lead time of encoding [s]; well below the 1 s freshness window.
AHEAD = 0.1
#: Lateness of a transfer that its age includes [s]; a thread usually wakes up earlier.
ALLOWANCE = 0.004


@dataclass(frozen=True)
class Published:
    """A line with the time when it was published."""

    line: MapLine
    age: float  #: of the pose at the time of publishing [s]
    at: float  #: time of publishing [s]

    def with_age(self, now: float, max_age: float) -> MapLine:
        """Return the line with its age at ``now``, infinite if it exceeds ``max_age`` [s]."""
        age = max(0.0, self.age + now - self.at)
        return aged(self.line, age if age <= max_age else math.inf)


@dataclass(frozen=True)
class PublishedScene:
    """A scene with the time when it was published."""

    prepared: PreparedScene
    age: float  #: of the pose at the time of publishing [s]
    at: float  #: time of publishing [s]

    def age_at(self, now: float, max_age: float) -> float:
        """Return the age at ``now``, infinite if it exceeds ``max_age`` [s]."""
        age = max(0.0, self.age + now - self.at)
        return age if age <= max_age else math.inf


class Transfer(NamedTuple):
    """Encoded frames of a slot, of the pose error or of a whole scene with their deadline."""

    owner: Owner
    deadline: float  #: [s]
    latest: float  #: until then, the age that is sent is not too small [s]
    frames: Sequence[Frame]  #: those of all components, if the line is a mixture
    expired: bool  #: the age is sent as "too old"
    records: int  #: by which the counter advances when the transfer is taken
    again: Callable[[float], tuple[Sequence[Frame], bool]]  #: encode for another ``latest``
    skipped: int = 0  #: deadlines of the owner that were missed before this one
    lines: int = 1
    pose_errors: int = 0


class TxQueue:
    """Queue of the next transfers of each slot, with their deadlines.

    Encoding eight lines takes no longer than encoding one.  A line that is due is therefore encoded
    together with others that are due soon and unlikely to be replaced before their deadlines:

    - a new value, if its deadline is less than a period after its publishing;
    - a repeated value, if its deadline is less than half a period away.

    A producer that publishes once a period thus never has an old value sent, and its lines are
    encoded once a period.

    The age of a line refers to `ALLOWANCE` after its deadline.  A transfer that is later than that
    is encoded again (see `renew`), so the age is never too small when its first frame is sent.
    An age of more than ``max_age`` is sent as "too old", the greatest raw value of the DBC's Age.

    If a line that is encoded ahead is not sent, because its deadline was skipped or its slot was
    dropped, the counters have no gap: they advance when a transfer is taken.

    The lines of a scene belong to one pose error. They are encoded together when that is due, and
    sent at their deadlines after it, or later: a line that missed its deadline is still sent if the
    next pose error is not. A line whose pose error was skipped is not sent. All counters
    advance when the pose error is taken: it states those of its lines, so none of them may be used
    again, even if a line is then skipped or dropped.

    A whole scene is encoded when it is due; its frames are one transfer.

    No line is encoded more than `AHEAD` before its deadline.  A transmitter with a long period
    thus encodes a few lines at a time, at most ten times a second.

    Args:
        codec: encodes the lines.
        period: between two transfers of a slot [s].
        fd: make CAN FD frames.
        count: number of deadlines of each slot; None for no limit.
        max_age: greatest age that is stated [s].
    """

    def __init__(
        self, codec: LineCodec, period: float, *, fd: bool, count: int | None, max_age: float
    ) -> None:
        self._encoder, self._period, self._fd, self._max_age = codec.encoder(), period, fd, max_age
        self._schedule: Schedule[Owner] = Schedule(period, count)
        self._published: dict[Owner, Published] = {}
        self._scene: PublishedScene | None = None  # then nothing else is published
        self._new: set[Owner] = set()  # published since they were last encoded
        self._ahead: dict[Owner, Transfer] = {}  # encoded, not due yet
        self._counters: Counter[Owner] = Counter()  # of the next record to be sent

    def put(self, lines: Iterable[MapLine], now: float, age: float | None = None) -> None:
        """Publish lines at ``now`` [s], each in place of the previous one of its slot.

        They have the given age [s], or each line its own. A scene that was published before them
        is not sent any more.
        """
        if self._scene is not None:
            self._scene = None
            for owner in (SCENE, POSE, *Slot):
                self._remove(owner)
        for line in lines:
            if line.slot not in self._published:
                self._schedule.add(line.slot, line.slot / len(Slot), now)
            own = line.age if age is None else age
            self._published[line.slot] = Published(line, own, now)
            self._new.add(line.slot)

    def put_scene(self, prepared: PreparedScene, now: float, age: float | None = None) -> None:
        """Publish a scene at ``now`` [s] in place of all that was published before.

        It has the given age [s], or that of its oldest line.

        Raises:
            EncodeError: it was prepared for another DBC.
        """
        prepared = self._encoder.prepare_scene(prepared, fd=self._fd)
        if age is None:
            age = max((line.age for line in prepared.scene.lines), default=0.0)
        if self._scene is None:
            for owner in self._published:
                self._remove(owner)
            self._published.clear()
        before = () if self._scene is None else self._scene.prepared.owners
        self._scene = PublishedScene(prepared, age, now)
        for owner in set(before) - set(prepared.owners):
            self._remove(owner)
        # The pose error is before the first slot, which has the same phase: the first of two keys
        # comes first.
        for owner in prepared.owners:
            if owner not in before:
                phase = owner / len(Slot) if isinstance(owner, Slot) else 0.0
                self._schedule.add(owner, phase, now)

    def left_out(self, prepared: PreparedScene) -> dict[Slot, LeftOut]:
        """Return the reasons of the lines of a scene that are not sent if it is the next one."""
        return self._encoder.left_out(prepared, fd=self._fd)

    def drop(self, slot: Slot) -> None:
        """Remove the line of a slot; there may be none."""
        self._remove(slot)
        self._published.pop(slot, None)
        if self._scene is not None:
            self._scene = replace(self._scene, prepared=self._scene.prepared.without(slot))

    def _remove(self, owner: Owner) -> None:
        self._schedule.remove(owner)
        self._ahead.pop(owner, None)

    @property
    def over(self) -> bool:
        """Whether every slot has had its ``count`` deadlines."""
        return self._schedule.over

    @property
    def first(self) -> float:
        """The next deadline [s]; infinite if there is none."""
        return self._schedule.first

    def wait(self, now: float) -> float | None:
        """Return the time until the next deadline [s]; None if there is none."""
        return self._schedule.wait(now)

    def take(self, now: float) -> Transfer | None:
        """Return the next transfer that is due, once per deadline; None if none is due.

        Raises:
            EncodeError: a value of a line does not fit into its signal.
        """
        while (due := self._schedule.take(now)) is not None:
            transfer = self._ahead.pop(due.key, None)
            if self._scene is None:
                if transfer is None or transfer.deadline != due.deadline:  # of a skipped deadline
                    self._encode(due.key, due.deadline)
                    transfer = self._ahead.pop(due.key)
            elif due.key == POSE:
                self._encode_scene(self._scene, due.deadline)
                transfer = self._ahead.pop(POSE)
            elif due.key == SCENE:
                transfer = self._encode_whole(self._scene, due.deadline)
            if transfer is None:
                continue  # of a scene whose pose error was not sent
            self._counters[due.key] += transfer.records
            if not transfer.frames:
                transfer = self.renew(transfer, now)
            return transfer._replace(skipped=due.skipped) if due.skipped else transfer
        return None

    def renew(self, transfer: Transfer, now: float) -> Transfer:
        """Encode a late transfer again, with the age when it will be twice as late.

        Few renewals are thus needed if a transfer cannot be sent for a long time, and its age
        exceeds the true one by no more than the lateness.  The counters stay the same, so no frame
        of the transfer may have been sent.
        """
        latest = now + max(ALLOWANCE, now - transfer.deadline)
        frames, expired = transfer.again(latest)
        return transfer._replace(latest=latest, frames=frames, expired=expired)

    def _encode(self, slot: Owner, deadline: float) -> None:
        deadlines = {slot: deadline}
        for other in self._published.keys() - self._ahead.keys() - {slot}:
            then = self._schedule.deadline(other)
            if self._may_be_ahead(other, then, deadline):
                deadlines[other] = then
        order = sorted(deadlines, key=deadlines.__getitem__)
        latest = {each: deadlines[each] + ALLOWANCE for each in order}
        published = {each: self._published[each] for each in order}
        batch = [own.with_age(latest[each], self._max_age) for each, own in published.items()]
        encoded = self._encode_lines(batch)
        for (each, own), line, frames in zip(published.items(), batch, encoded, strict=True):
            self._ahead[each] = Transfer(
                each,
                deadlines[each],
                latest[each],
                frames,
                line.age == math.inf,
                1 if line.mixture is None else len(line.mixture.weights),
                partial(self._line_again, own, dict(self._counters)),
            )
        self._new -= published.keys()

    def _encode_lines(
        self, lines: Sequence[MapLine], counters: Mapping[Owner, int] | None = None
    ) -> list[list[Frame]]:
        known = self._counters if counters is None else counters
        return self._encoder.encode_lines(lines, fd=self._fd, counters=known)

    def _line_again(
        self, own: Published, counters: Mapping[Owner, int], latest: float
    ) -> tuple[Sequence[Frame], bool]:
        line = own.with_age(latest, self._max_age)
        (frames,) = self._encode_lines([line], counters)
        return frames, line.age == math.inf

    def _encode_scene(self, scene: PublishedScene, deadline: float) -> None:
        """Encode the pose error that is due now, and the lines of the scene for their deadlines.

        Lines that are due later than `AHEAD` get their frames when they are due.
        """
        counters = dict(self._counters)
        deadlines: dict[Owner, float] = {POSE: deadline}
        slots = scene.prepared.sent_slots
        deadlines |= {slot: self._schedule.deadline(slot) for slot in slots}
        ages = {
            owner: scene.age_at(then + ALLOWANCE, self._max_age)
            for owner, then in deadlines.items()
        }
        frames = self._scene_frames(scene, counters, ages)
        for owner, then in deadlines.items():
            again = partial(self._scene_again, scene, counters, owner)
            self._counters[owner] += 1
            self._ahead[owner] = Transfer(
                owner,
                then,
                then + ALLOWANCE,
                frames[owner] if then <= deadline + AHEAD else (),
                ages[owner] == math.inf,
                0,  # the counters have advanced
                again,
                lines=int(owner != POSE),
                pose_errors=int(owner == POSE),
            )

    def _scene_frames(
        self, scene: PublishedScene, counters: Mapping[Owner, int], ages: Mapping[Owner, float]
    ) -> Mapping[Owner, Sequence[Frame]]:
        return self._encoder.encode_scene(scene.prepared, age=ages, fd=self._fd, counters=counters)

    def _scene_again(
        self, scene: PublishedScene, counters: Mapping[Owner, int], owner: Owner, latest: float
    ) -> tuple[Sequence[Frame], bool]:
        age = scene.age_at(latest, self._max_age)
        ages: dict[Owner, float] = {POSE: age}
        ages |= dict.fromkeys(scene.prepared.sent_slots, age)
        return self._scene_frames(scene, counters, ages)[owner], age == math.inf

    def _encode_whole(self, scene: PublishedScene, deadline: float) -> Transfer:
        """Encode a whole scene that is due now."""
        latest = deadline + ALLOWANCE
        before = copy.copy(self._encoder)
        again = partial(self._whole_again, before, scene)
        frames, expired = self._whole_frames(self._encoder, scene, latest)
        without = self._encoder.left_out(scene.prepared, fd=self._fd)
        return Transfer(
            SCENE,
            deadline,
            latest,
            frames,
            expired,
            0,  # the counters are those of the encoder, which have advanced
            again,
            lines=sum(slot not in without for slot in scene.prepared.sent_slots),
            pose_errors=len(frames),
        )

    def _whole_again(
        self, before: Encoder, scene: PublishedScene, latest: float
    ) -> tuple[Sequence[Frame], bool]:
        return self._whole_frames(copy.copy(before), scene, latest)

    def _whole_frames(
        self, encoder: Encoder, scene: PublishedScene, latest: float
    ) -> tuple[Sequence[Frame], bool]:
        """Return the frames of a whole scene, and whether it is too old; the encoder advances."""
        age = scene.age_at(latest, self._max_age)
        frames = encoder.encode_scene(scene.prepared, age=age, fd=self._fd)
        return [*chain(*frames.values())], age == math.inf

    def _may_be_ahead(self, slot: Owner, deadline: float, now: float) -> bool:
        until = now + self._period / 2
        if slot in self._new:
            until = self._published[slot].at + self._period
        return deadline < min(until, now + AHEAD)
