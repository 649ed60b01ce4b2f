"""Writer of scenes: the record of the pose error, and the records of the lines seen from there."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ...values.arrays import floats
from ...values.errors import EncodeError
from ...values.line import MAX_AGE, LeftOut, Slot, age_error
from ...values.scene import Scene
from ..covariance.scene_encoder import EncodedScene, SceneEncoder
from ..layout.message_layout import Layout
from ..layout.pose_layout import POSE, Owner, PoseLayout
from ..layout.signals import SLOT_SIGNALS, slot_title
from .complete_writer import CompleteWriter
from .raw_format import RawFormat, absent_counter
from .record import RawRecord


@dataclass(frozen=True, eq=False)
class PreparedScene:
    """A scene as raw values, without counters and age, so that it may be sent many times."""

    scene: Scene
    encoded: EncodedScene
    #: Slots of the lines that are sent, whether they belong to the pose error or not.
    sent_slots: tuple[Slot, ...]
    layout: Layout  #: of the DBC whose raw values they are

    @property
    def members(self) -> dict[Slot, dict[str, int]]:
        """Raw values of the lines that are sent and belong to the pose error, by slot."""
        by_slot = {self.scene.lines[i].slot: raw for i, raw in self.encoded.lines.items()}
        return {slot: raw for slot, raw in by_slot.items() if slot in self.sent_slots}

    @property
    def unfit(self) -> dict[Slot, LeftOut]:
        """Reasons of the lines of the scene that are not sent, since they do not fit, by slot."""
        by_slot = {self.scene.lines[i].slot: why for i, why in self.encoded.left_out.items()}
        return {slot: why for slot, why in by_slot.items() if slot not in self.sent_slots}

    @property
    def left_out(self) -> dict[Slot, LeftOut]:
        """Reasons of all lines that are not sent, by slot: also of those not in the scene."""
        return dict(self.scene.left_out) | self.unfit

    def without(self, slot: Slot) -> PreparedScene:
        """Return the scene without the line of a slot; there may be none."""
        return replace(self, sent_slots=tuple(s for s in self.sent_slots if s != slot))


class SceneWriter:
    """Writer of scenes of a layout with a message of the pose error.

    If the records of lines are conditional on the pose, a line that does not fit is not sent.
    Other records have a covariance of their own: the line is sent, but does not belong to the pose
    error.

    Args:
        layout: of the records of lines.
        pose: of the record of the pose error.
        encoder: of both.
        complete: writer of the records of lines; None if these are conditional.
    """

    def __init__(
        self,
        layout: Layout,
        pose: PoseLayout,
        encoder: SceneEncoder,
        complete: CompleteWriter | None,
    ) -> None:
        self._layout, self._pose, self._encoder = layout, pose, encoder
        self._complete = complete
        self._pose_format = RawFormat.of_pose(pose)
        self._line_format = RawFormat.of_lines(layout) if layout.is_conditional else None
        #: Names of the levels of each slot in the record of the pose error, by those in a line's.
        self._levels = {
            slot: {name: f"{slot_title(slot)}{name}" for name in SLOT_SIGNALS}
            for slot in (() if layout.is_conditional else pose.counters)
        }
        self._modulus = 2 ** layout["Counter"].length
        self._pose_modulus = 2 ** pose["Counter"].length

    def prepare(self, scene: Scene, *, full: bool = False) -> PreparedScene:
        """Encode a scene; this takes most of the time.

        Args:
            scene: the scene.
            full: send all entries of line-specific covariances, as CAN FD records do.

        Raises:
            EncodeError: the pose error does not fit, or the DBC has no message for a slot.
        """
        for line in scene.lines:
            if line.slot not in self._layout.messages:
                raise EncodeError(f"{self._layout.source} has no message for slot {line.slot!r}")
        if self._complete is None:
            encoded = self._encoder.encode(scene, full=full)
            sent = tuple(scene.lines[place].slot for place in encoded.lines)
            return PreparedScene(scene, encoded, sent, self._layout)
        raw = [self._complete.raw_mean_and_range(line) for line in scene.lines]
        encoded = self._encoder.encode_levels(scene, raw)
        sent = tuple(line.slot for line in scene.lines)
        return PreparedScene(scene, encoded, sent, self._layout)

    def write(
        self,
        prepared: PreparedScene,
        counters: Mapping[Owner, int],
        age: float | Mapping[Owner, float],
    ) -> tuple[dict[Owner, bytes], Counter[Owner]]:
        """Return the record of the pose error, then of each line, and the counters that follow.

        Args:
            prepared: the scene.
            counters: next counter of each slot and of the pose error; 0 if there is none.
            age: time from the pose to the sending of each record, or one for all [s]; infinite if
                it is too old.

        Raises:
            ValueError: an age is less than 0 or NaN, or that of a record is missing.
        """
        ages = age if isinstance(age, Mapping) else dict.fromkeys((POSE, *Slot), age)
        aged = (POSE,) if self._complete is None else (POSE, *prepared.sent_slots)
        if missing := [owner for owner in aged if owner not in ages]:
            raise ValueError(
                f"age must be one for all [s], or have that of each record, but {missing[0]!r} "
                "has none"
            )
        records, following = self._line_records(prepared, counters, ages)
        raw = self._raw_pose(prepared, counters, following) | {"Age": self._raw_age(ages[POSE])}
        number = following[POSE] % self._pose_modulus
        pose = self._pose_format.write(RawRecord(POSE, number, raw))
        following[POSE] = (number + 1) % self._pose_modulus
        return {POSE: pose} | records, following

    def _line_records(
        self, prepared: PreparedScene, counters: Mapping[Owner, int], ages: Mapping[Owner, float]
    ) -> tuple[dict[Owner, bytes], Counter[Owner]]:
        """Return the record of each line that is sent, and the counters that follow."""
        sent = [line for line in prepared.scene.lines if line.slot in prepared.sent_slots]
        following: Counter[Owner] = Counter(counters)
        if self._line_format is not None:
            records, members = dict[Owner, bytes](), prepared.members
            for line in sent:
                counter = following[line.slot] % self._modulus
                raw = members[line.slot] | {"Kind": int(line.kind)}
                records[line.slot] = self._line_format.write(RawRecord(line.slot, counter, raw))
                following[line.slot] = (counter + 1) % self._modulus
            return records, following
        if self._complete is None or not sent:
            return {}, following
        aged = [replace(line, age=ages[line.slot]) for line in sent]
        of_lines, following = self._complete.write_lines(aged, counters)
        return {
            line.slot: record for line, (record,) in zip(aged, of_lines, strict=True)
        }, following

    def _raw_pose(
        self,
        prepared: PreparedScene,
        counters: Mapping[Owner, int],
        following: Mapping[Owner, int],
    ) -> dict[str, int]:
        """Return the raw values of the pose error, with counters and levels of the slots."""
        raw, members = dict(prepared.encoded.pose), prepared.members
        for slot, signal in self._pose.counters.items():
            bits, then = signal.length, following.get(slot, 0)
            first = counters.get(slot, 0) % 2**bits
            # A line that is sent but is no member has a counter before ``then``, as earlier ones.
            stated = first if slot in members else absent_counter(then - 1, then, bits)
            raw[signal.name] = stated
        for slot, names in self._levels.items():
            levels = members.get(slot, {})
            raw |= {of_pose: levels.get(name, 0) for name, of_pose in names.items()}
        return raw

    def _raw_age(self, age: float) -> int:
        given = float(floats(age, "age"))
        if not (0 <= given <= MAX_AGE or given == math.inf):
            raise age_error(age)
        signal = self._pose.signals["Age"]
        return int(signal.limited(signal.raw_above(np.asarray(1000 * given))))
