"""Sender in C: scenes to records, if they are usual; the Python package writes the rest.

Unusual is whatever raises an error, and what is no line or no scene. The functions return None for
it, so that there is one place for each error.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import chain
from typing import Any

import numpy as np

from ..core import ffi, lib
from ..core.memory import shaped
from ..values.line import LeftOut, Slot
from ..values.scene import Scene
from .covariance.cholesky import CholeskyCode
from .covariance.scene_code import DecodedLines, SceneCode
from .covariance.scene_encoder import EncodedScene
from .layout.message_layout import Layout
from .layout.pose_layout import OWNERS, POSE, Owner
from .records.frames import Records
from .records.given import given_lines
from .records.scene_writer import PreparedScene

#: Reasons of lines that are left out by their numbers: ``maplines_left_out_t``.
LEFT_OUT = (None, LeftOut.ACROSS, LeftOut.RANGE, LeftOut.MEAN, LeftOut.COVARIANCE)
_MAX_RECORD = ffi.sizeof("maplines_template_t") - ffi.offsetof("maplines_template_t", "bytes")
_LINES, _DOUBLES, _COUNTERS, _BYTES = map(
    ffi.typeof, ("maplines_given_line_t[]", "double[]", "int64_t[]", "uint8_t[]")
)
_AGES = struct.Struct(f"{len(OWNERS)}d")
#: Errors of values that C does not take.
_WRONG = (TypeError, ValueError, AttributeError, OverflowError, struct.error)


class CSender:
    """Writer of records in C.

    Args:
        layout: of the DBC.
        tables: of the same; see ``tables_of``.
        scene_code: of the DBC; None if it has no message of the pose error.
    """

    def __init__(self, layout: Layout, tables: Any, scene_code: SceneCode | None) -> None:
        self._layout, self._tables, self._code = layout, tables, scene_code

    def prepare(self, scene: Scene, *, full: bool) -> PreparedScene | None:
        """Return a scene but for counters and ages; None if it is unusual."""
        if self._code is None:
            return None
        try:
            given, kept = _given_scene(scene)
        except _WRONG:
            return None
        prepared = ffi.new("maplines_prepared_t *")
        if not lib.maplines_prepare_scene(self._tables, given, full, prepared):
            return None
        del kept
        encoded = SceneInC.of(scene, prepared, self._code)
        sent = tuple(
            line.slot
            for line, record in zip(scene.lines, prepared.records, strict=False)
            if record.is_there
        )
        return PreparedScene(scene, encoded, sent, self._layout)

    def write_scene(
        self,
        prepared: PreparedScene,
        counters: bytes,
        age: float | Mapping[Owner, float],
    ) -> tuple[Records, bytes] | None:
        """Return the records of a scene, and the counters that follow.

        None if the scene was prepared or changed in Python, or if something is unusual.
        """
        encoded = prepared.encoded
        scene = prepared.scene
        in_c = encoded.prepared_of(scene) if isinstance(encoded, SceneInC) else None
        if in_c is None:
            return None
        slots = [line.slot for line in scene.lines if line.slot in prepared.sent_slots]
        try:
            # An age that is missing is none, which C refuses where it needs it.
            ages = _AGES.pack(
                *(
                    [age.get(owner, -1.0) for owner in OWNERS]
                    if isinstance(age, Mapping)
                    else [age] * len(OWNERS)
                )
            )
            sent = bytes(slots)
        except _WRONG:
            return None
        following, lengths = bytearray(counters), bytearray(len(OWNERS))
        records = bytearray(len(OWNERS) * _MAX_RECORD)
        if not lib.maplines_write_scene(
            self._tables,
            in_c,
            len(slots),
            sent,
            ffi.from_buffer(_DOUBLES, ages),
            ffi.from_buffer(_COUNTERS, following),
            ffi.from_buffer(_BYTES, lengths),
            ffi.from_buffer(_BYTES, records),
        ):
            return None
        own = tuple(lengths[: len(slots) + 1])
        return Records(bytes(records[: sum(own)]), (POSE, *slots), own), bytes(following)


def _given_scene(scene: Scene) -> tuple[Any, Any]:
    """Return a scene as C has it, and what it points to.

    Raises:
        ValueError: it has other shapes than a scene.
    """
    n = len(scene.lines)
    slots, lines, gaussians, parts, _ = given_lines(scene.lines)
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
    if len(slots) > len(Slot) or parts:
        raise ValueError("each line of a scene has one Gaussian")
    return given, kept


def _array(values: Any, shape: tuple[int, ...]) -> Any:
    return shaped(np.asarray(values, dtype=np.float64), shape)


class SceneInC(EncodedScene):
    """Scene that was encoded in C. Its fields are made when they are read.

    A caller may change or replace what it has read: `prepared_of` finds out.
    """

    _prepared: Any = None
    _scene: Scene
    _code: SceneCode

    @classmethod
    def of(cls, scene: Scene, prepared: Any, code: SceneCode) -> SceneInC:
        """Return a scene that C has prepared."""
        self = object.__new__(cls)
        vars(self).update(_scene=scene, _prepared=prepared, _code=code)
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the scene as Python encodes it: what is in C stays in this process."""
        return EncodedScene, (self.pose, self.lines, self.decoded, self.left_out)

    def prepared_of(self, scene: Scene) -> Any:
        """Return the scene in C; None if it is of another scene, or fields were changed."""
        fields = vars(self)
        if self._prepared is None or self._scene is not scene:
            return None
        if "pose" in fields and self.pose != self._raw_pose():
            return None
        return None if "lines" in fields and self.lines != self._raw_lines() else self._prepared

    @cached_property
    def pose(self) -> dict[str, int]:
        """See ``EncodedScene``."""
        return self._raw_pose()

    @cached_property
    def lines(self) -> dict[int, dict[str, int]]:
        """See ``EncodedScene``."""
        return self._raw_lines()

    @cached_property
    def decoded(self) -> DecodedLines | None:
        """See ``EncodedScene``."""
        lines = [*self._raw_lines().values()]
        pose = self._code.decode_pose(self._raw_pose())
        return self._code.decode(pose, lines) if lines else None

    @cached_property
    def left_out(self) -> dict[int, LeftOut]:
        """See ``EncodedScene``."""
        reasons = enumerate(member.left_out for member in self._members())
        return {place: why for place, i in reasons if (why := LEFT_OUT[i]) is not None}

    def _members(self) -> Sequence[Any]:
        """Return the lines of the scene as ``maplines_scene_member_t``."""
        return [*self._prepared.space.members[0 : self._prepared.count]]

    def _raw_pose(self) -> dict[str, int]:
        code, space = self._code, self._prepared.space
        raw = space.raw_offset, space.raw_heading, space.raw_time
        signals = (code.offset, code.heading, code.time)
        own = {signal.name: value for signal, value in zip(signals, raw, strict=True)}
        return _of_covariance(code.pose_code, space.raw_pose) | own

    def _raw_lines(self) -> dict[int, dict[str, int]]:
        members = enumerate(self._members())
        return {place: self._raw_line(one) for place, one in members if not one.left_out}

    def _raw_line(self, member: Any) -> dict[str, int]:
        """Return raw values by signal."""
        code, is_full = self._code, member.is_full
        pairs: list[tuple[Any, int]] = [
            *zip(code.mean, member.raw_refined if is_full else member.raw_mean, strict=True),
            *zip(code.range, member.raw_range, strict=True),
            (code.quartic, member.raw_quartic),
            *zip(code.fit, member.raw_fit, strict=False),  # complete records only
            *zip(code.levels.signals, [0] * 3 if is_full else member.raw_levels, strict=True),
            *zip(code.fine if is_full else (), member.raw_fine, strict=False),
        ]
        raw = {signal.name: value for signal, value in pairs}
        if is_full and code.entries_code is not None:
            raw |= _of_covariance(code.entries_code, member.raw_covariance)
        return raw


def _of_covariance(code: CholeskyCode, values: Sequence[int]) -> dict[str, int]:
    """Return the raw values of a covariance by signal, from those of ``maplines_cholesky_t``."""
    raw = [*values]
    ratios = chain(*code.factor.ratios)
    pairs = [*zip(code.factor.pivots, raw[:4], strict=False), *zip(ratios, raw[4:10], strict=False)]
    return {signal.name: value for signal, value in (*pairs, (code.inflation, raw[10]))}
