"""Writer of scenes: the records of the pose error and of the lines seen from there, or of both."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import numpy as np

from ..core import ffi, lib
from ..core.memory import shaped
from ..values.arrays import floats
from ..values.errors import EncodeError, IllPosedError
from ..values.line import LEFT_OUT, MAX_AGE, LeftOut, Slot, age_error
from ..values.scene import PoseError, Scene
from .core_tables import tables_of
from .frames import Records
from .layout.message_layout import Layout
from .layout.pose_layout import OWNERS, POSE, SCENE, SCENES, Owner
from .sender_values import given_lines

_MAX_RECORD = ffi.sizeof("maplines_template_t") - ffi.offsetof("maplines_template_t", "bytes")
_LINES, _DOUBLES, _COUNTERS, _BYTES = map(
    ffi.typeof, ("maplines_given_line_t[]", "double[]", "int64_t[]", "uint8_t[]")
)
_PLACES = ffi.typeof("maplines_chosen_places_t *")
_AGES = struct.Struct(f"{len(OWNERS)}d")
#: Errors of values that cannot be given to the core.
_WRONG = (TypeError, ValueError, AttributeError, OverflowError, struct.error)


class SenderState(NamedTuple):
    """What a sender knows of its last cycle."""

    counters: bytes  #: next counters of all owners; see ``packed``
    #: Places of lines in messages of whole scenes: ``maplines_chosen_places_t``.
    places: bytes = bytes(ffi.sizeof("maplines_chosen_places_t"))


@dataclass(frozen=True, eq=False)
class PreparedScene:
    """A scene as records but for counters and age, so that it may be sent many times.

    ``Encoder.prepare_scene`` makes one. It does not change, so that a copy is the same one. A
    pickle has the scene only, which is prepared again.
    """

    scene: Scene
    layout: Layout  #: of the DBC that it is prepared for
    full: bool  #: all entries of line-specific covariances are sent, as in CAN FD records
    #: Slots of the lines that are sent, whether they belong to the pose error or not. In messages
    #: of whole scenes, those of them for which there is a place.
    sent_slots: tuple[Slot, ...]
    core: Any = field(repr=False)  #: ``maplines_prepared_t``
    retracted: frozenset[Slot] = frozenset()  #: by ``without``

    @property
    def members(self) -> tuple[Slot, ...]:
        """Slots of the lines that are sent and belong to the pose error."""
        sent = self.sent_slots
        return tuple(slot for slot, why in self._reasons() if why is None and slot in sent)

    @property
    def unfit(self) -> dict[Slot, LeftOut]:
        """Reasons of the lines of the scene that are not sent, since they do not fit, by slot."""
        sent = self.sent_slots
        return {slot: why for slot, why in self._reasons() if why is not None and slot not in sent}

    @property
    def left_out(self) -> dict[Slot, LeftOut]:
        """Reasons of all lines that are not sent, by slot: also of those not in the scene.

        ``Encoder.left_out`` also has those for which messages of whole scenes have no place.
        """
        return dict(self.scene.left_out) | self.unfit

    @property
    def owners(self) -> tuple[Owner, ...]:
        """Owners of the records with times of their own: Scene2 goes with Scene."""
        return (POSE, *self.sent_slots) if self.layout.scene is None else (SCENE,)

    @property
    def stated(self) -> int:
        """Slots of which a whole scene has the line, or says why not: one bit each."""
        reasons = dict(self._reasons())
        slots = {
            slot for slot, why in reasons.items() if why is not None or slot in self.sent_slots
        }
        return sum(1 << slot for slot in slots - self.retracted)

    def without(self, slot: Slot) -> PreparedScene:
        """Return the scene without the line of a slot; there may be none."""
        slots = tuple(s for s in self.sent_slots if s != slot)
        return replace(self, sent_slots=slots, retracted=self.retracted | {slot})

    def _reasons(self) -> Iterator[tuple[Slot, LeftOut | None]]:
        """Yield the slot of each line, and why it does not belong to the pose error."""
        for line, member in zip(self.scene.lines, self.core.space.members, strict=False):
            yield line.slot, LEFT_OUT[member.left_out]

    def __copy__(self) -> PreparedScene:
        return self

    def __deepcopy__(self, memo: dict[int, Any]) -> PreparedScene:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        own = self.scene, self.layout, self.full, self.sent_slots, self.retracted
        return _prepared_again, own


def _prepared_again(
    scene: Scene,
    layout: Layout,
    full: bool,
    slots: tuple[Slot, ...],
    retracted: frozenset[Slot],
) -> PreparedScene:
    prepared = prepare_scene(layout, tables_of(layout), scene, full=full)
    slots = tuple(slot for slot in prepared.sent_slots if slot in slots)
    return replace(prepared, sent_slots=slots, retracted=retracted)


def prepare_scene(
    layout: Layout, tables: Any, scene: Scene, *, full: bool = False
) -> PreparedScene:
    """Encode a scene; this takes most of the time.

    If the records of lines are conditional on the pose, a line that does not fit is not sent.
    Other records have a covariance of their own: the line is sent, but does not belong to the pose
    error.

    Args:
        layout: of the DBC.
        tables: of the same; see ``tables_of``.
        scene: the scene.
        full: send all entries of line-specific covariances, as CAN FD records do.

    Raises:
        EncodeError: the DBC has no message of the pose error or for a slot, or the pose error
            does not fit.
        IllPosedError: a line is not a function of x, seen from the mean pose.
        ValueError: a value is none that a scene has, which its constructor does not take.
    """
    if layout.pose is None:
        raise EncodeError(
            f"{layout.source} has no message of the pose error (MapLinePose), so lines cannot be "
            "sent as a scene; take maplines.dbc, maplines-pose.dbc or maplines-scene.dbc"
        )
    core = ffi.new("maplines_prepared_t *")
    try:
        given, kept = _given_scene(scene)
    except _WRONG as error:
        raise _fault(layout, scene, lib.MAPLINES_SENT) from error
    refusal = lib.maplines_prepare_scene(tables, given, full, core)
    del kept
    if refusal != lib.MAPLINES_SENT:
        raise _fault(layout, scene, refusal)
    records = zip(scene.lines, core.records, strict=False)
    sent = tuple(line.slot for line, record in records if record.is_there)
    return PreparedScene(scene, layout, full, sent, core)


def write_scene(
    prepared: PreparedScene,
    tables: Any,
    state: SenderState,
    age: float | Mapping[Owner, float],
    *,
    secured: bool = False,
) -> tuple[Records, SenderState]:
    """Return the records of the pose error and of each line, or whole scenes, and the next state.

    Args:
        prepared: the scene.
        tables: of its DBC.
        state: of the sender.
        age: time from the pose to the sending of each record, or one for all [s]; infinite if it is
            too old.
        secured: the records are for authenticated messages.

    Raises:
        ValueError: an age is less than 0 or NaN, or that of a record is missing.
    """
    if prepared.layout.scene is not None:
        return _write_whole(prepared, tables, state, age, secured=secured)
    slots = [line.slot for line in prepared.scene.lines if line.slot in prepared.sent_slots]
    ages = _ages(age, (POSE,) if prepared.layout.is_conditional else (POSE, *slots))
    following, lengths = bytearray(state.counters), bytearray(len(OWNERS))
    records = bytearray(len(OWNERS) * _MAX_RECORD)
    if not lib.maplines_write_scene(
        tables,
        prepared.core,
        len(slots),
        bytes(slots),
        ffi.from_buffer(_DOUBLES, ages),
        ffi.from_buffer(_COUNTERS, following),
        ffi.from_buffer(_BYTES, lengths),
        ffi.from_buffer(_BYTES, records),
    ):
        raise EncodeError("the core refuses sent_slots of the scene: one of them has no record")
    own = tuple(lengths[: len(slots) + 1])
    written = Records(bytes(records[: sum(own)]), (POSE, *slots), own)
    return written, state._replace(counters=bytes(following))


def _write_whole(
    prepared: PreparedScene,
    tables: Any,
    state: SenderState,
    age: float | Mapping[Owner, float],
    *,
    secured: bool,
) -> tuple[Records, SenderState]:
    """Return the records of a whole scene, Scene last, and the state that follows."""
    following, lengths = bytearray(state.counters), bytearray(len(SCENES))
    places, records = bytearray(state.places), bytearray(len(SCENES) * _MAX_RECORD)
    count = lib.maplines_write_whole_scene(
        tables,
        prepared.core,
        prepared.stated,
        secured,
        ffi.from_buffer(_DOUBLES, _ages(age, prepared.layout.messages_of)),
        ffi.from_buffer(_COUNTERS, following),
        ffi.from_buffer(_PLACES, places),
        ffi.from_buffer(_BYTES, lengths),
        ffi.from_buffer(_BYTES, records),
    )
    own = tuple(lengths[:count])
    owners = SCENES[count - 1 :: -1]
    written = Records(bytes(records[: sum(own)]), owners, own)
    return written, SenderState(bytes(following), bytes(places))


def placed_slots(
    prepared: PreparedScene, tables: Any, state: SenderState, *, secured: bool = False
) -> frozenset[Slot]:
    """Return the slots that have a place in messages of whole scenes in the next cycle."""
    places = ffi.new(_PLACES)
    ffi.memmove(places, state.places, len(state.places))
    lib.maplines_place_lines(tables, prepared.core, prepared.stated, secured, places)
    return frozenset(Slot(one - 1) for message in places.slots for one in message if one)


def _ages(age: float | Mapping[Owner, float], aged: Iterable[Owner]) -> bytes:
    """Return the ages of all owners, of which these need one; or 0."""
    if not isinstance(age, Mapping):
        return _AGES.pack(*[_checked_age(age)] * len(OWNERS))
    if missing := [owner for owner in aged if owner not in age]:
        raise ValueError(
            f"age must be one for all [s], or have that of each record, but {missing[0]!r} has none"
        )
    checked = {owner: _checked_age(one) for owner, one in age.items()}
    return _AGES.pack(*[checked.get(owner, 0.0) for owner in OWNERS])


def _fault(layout: Layout, scene: Scene, refusal: int) -> Exception:
    """Return the error of a scene that the core refuses, or that cannot be given to it."""
    for line in scene.lines:
        if line.slot not in layout.slots:
            return EncodeError(f"{layout.source} has no message for slot {line.slot!r}")
    try:
        for line in scene.lines:
            replace(line)  # its constructor checks all values
        PoseError(scene.pose_error.cov, scene.pose_error.correlation_time)
        Scene(**{one.name: getattr(scene, one.name) for one in fields(Scene)})
    except ValueError as error:
        return error
    if refusal == lib.MAPLINES_BAD_POSE:
        sigma = np.sqrt(scene.pose_error.cov.diagonal())
        return EncodeError(
            "the pose error does not fit the message: its standard deviations are "
            f"{sigma[0]:g} m along, {sigma[1]:g} m across and {sigma[2]:g} rad"
        )
    if refusal == lib.MAPLINES_UNSEEN:
        return IllPosedError("what the pose error does to a line overflows")
    return EncodeError(f"the core refuses the scene ({refusal}): it has a value of no scene")


def _checked_age(age: float) -> float:
    given = age if type(age) is float else float(floats(age, "age"))
    if not (0 <= given <= MAX_AGE or given == math.inf):
        raise age_error(age)
    return given


def _given_scene(scene: Scene) -> tuple[Any, Any]:
    """Return a scene as C has it, and what it points to.

    Raises:
        ValueError: it has other shapes than a scene.
    """
    n = len(scene.lines)
    slots, lines, gaussians, components, _ = given_lines(scene.lines)
    if len(slots) > len(Slot) or components:
        raise ValueError("each line of a scene has one Gaussian, and a slot of its own")
    map_error, pose_error, specific = scene.map_error, scene.pose_error, scene.specific_covs
    arrays = [
        _array(scene.fit_ranges, (n, 2)),
        _array(scene.quartics, (n,)),
        _array(scene.cov, (4 * n, 4 * n)),
        ffi.NULL if specific is None else _array(specific, (n, 4, 4)),
        _array(pose_error.cov, (3, 3)),
    ]
    given = ffi.new("maplines_given_scene_t *")
    kept = ffi.from_buffer(_LINES, lines), ffi.from_buffer(_DOUBLES, gaussians), *arrays
    given[0] = (
        n,
        *kept,
        pose_error.correlation_time,
        0.0 if map_error is None else map_error.offset_sigma,
        0.0 if map_error is None else map_error.heading_sigma,
    )
    return given, kept


def _array(values: Any, shape: tuple[int, ...]) -> Any:
    return shaped(np.asarray(values, dtype=np.float64), shape)
