"""Sender in C: lines and scenes to frames, if they are usual; the Python package writes the rest.

Unusual is whatever raises an error, values that are no plain floats, and DBCs without C. The
functions return None for it, so that there is one place for each error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum
from functools import cached_property
from itertools import chain
from typing import Any

from ..native import core
from ..values.line import LeftOut, MapLine
from ..values.scene import Scene
from .c_tables import native_tables
from .covariance.cholesky import CholeskyCode
from .covariance.scene_code import DecodedLines, SceneCode
from .covariance.scene_encoder import EncodedScene
from .layout.message_layout import Layout
from .layout.pose_layout import Owner
from .records.frames import Frame, FrameWriter
from .records.scene_writer import PreparedScene

#: Reasons of lines that are left out by their numbers: ``maplines_left_out_t``.
LEFT_OUT = (None, LeftOut.ACROSS, LeftOut.RANGE, LeftOut.MEAN, LeftOut.COVARIANCE)


class _Form(IntEnum):
    """What is made of a record: ``maplines_form_t``."""

    PAGES = 0
    FD = 1
    RECORD = 2  #: its bytes, for an authenticator


class CSender:
    """Writer of frames in C.

    Args:
        layout: of the DBC.
        tables: of the same; see ``tables_of``.
        scene_code: of the DBC; None if it has no message of the pose error.
        frame_writer: writes authenticated frames.
    """

    def __init__(
        self,
        layout: Layout,
        tables: Any,
        scene_code: SceneCode | None,
        frame_writer: FrameWriter,
    ) -> None:
        self._sender = core.Sender(native_tables(tables), Frame)
        self._layout, self._code, self._frame_writer = layout, scene_code, frame_writer
        self._is_authenticated = frame_writer.is_authenticated

    def lines(
        self, lines: Sequence[MapLine], counters: Mapping[Owner, int], *, fd: bool
    ) -> tuple[list[list[Frame]], dict[Owner, int]] | None:
        """Return the frames of each line, and the counters that follow; None if one is unusual."""
        if not isinstance(counters, dict):
            return None
        following = dict(counters)
        sent = self._sender.lines(lines, following, self._form(fd))
        if sent is None or not self._is_authenticated:
            return None if sent is None else (sent, following)
        write = self._frame_writer.write
        frames = [
            [frame for record in records for frame in write(record, line.slot, fd)]
            for line, records in zip(lines, sent, strict=True)
        ]
        return frames, following

    def prepare(self, scene: Scene, *, full: bool) -> PreparedScene | None:
        """Return a scene but for counters and ages; None if it is unusual."""
        prepared = self._sender.prepare(scene, full)
        if prepared is None or self._code is None:
            return None
        lines = zip(scene.lines, prepared.left_out(), strict=True)
        sent = tuple(line.slot for line, why in lines if not (self._code.is_conditional and why))
        encoded = SceneInC.of(scene, prepared, self._code)
        return PreparedScene(scene, encoded, sent, self._layout)

    def scene(
        self,
        prepared: PreparedScene,
        counters: Mapping[Owner, int],
        age: float | Mapping[Owner, float],
        *,
        fd: bool,
    ) -> tuple[dict[Owner, list[Frame]], dict[Owner, int]] | None:
        """Return the frames of a scene by owner, and the counters that follow.

        None if the scene was prepared or changed in Python, or if something is unusual.
        """
        encoded = prepared.encoded
        records = encoded.records_of(prepared.scene) if isinstance(encoded, SceneInC) else None
        if records is None or not isinstance(counters, dict):
            return None
        following = dict(counters)
        sent = records.encode(prepared.sent_slots, age, following, self._form(fd))
        if sent is None or not self._is_authenticated:
            return None if sent is None else (sent, following)
        write = self._frame_writer.write
        return {owner: write(record, owner, fd) for owner, (record,) in sent.items()}, following

    def _form(self, fd: bool) -> int:
        if self._is_authenticated:
            return _Form.RECORD
        return _Form.FD if fd else _Form.PAGES


class SceneInC(EncodedScene):
    """Scene that was encoded in C. Its fields are made when they are read.

    A caller may change or replace what it has read: `records_of` finds out.
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
        """Return the scene as Python encodes it: the records in C stay in this process."""
        return EncodedScene, (self.pose, self.lines, self.decoded, self.left_out)

    def records_of(self, scene: Scene) -> Any:
        """Return the records in C; None if they are of another scene, or fields were changed."""
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
        reasons = enumerate(self._prepared.left_out())
        return {place: why for place, i in reasons if (why := LEFT_OUT[i]) is not None}

    def _raw_pose(self) -> dict[str, int]:
        code, raw = self._code, self._prepared.raw_pose()
        signals = (code.offset, code.heading, code.time)
        own = {signal.name: value for signal, value in zip(signals, raw[11:], strict=True)}
        return _of_covariance(code.pose_code, raw[:11]) | own

    def _raw_lines(self) -> dict[int, dict[str, int]]:
        places = range(len(self._prepared.left_out()))
        raw = {place: self._prepared.raw_line(place) for place in places}
        return {place: self._raw_line(values) for place, values in raw.items() if values}

    def _raw_line(self, values: Sequence[int]) -> dict[str, int]:
        """Return raw values by signal, from ``PreparedScene.raw_line`` of the module in C."""
        code, is_full = self._code, values[0]
        pairs: list[tuple[Any, int]] = [
            *zip((*code.mean, *code.range, code.quartic), values[1:8], strict=True),
            *zip(code.fit, values[8:10], strict=False),  # complete records only
            *zip(code.levels.signals, values[10:13], strict=True),
            *zip(code.fine if is_full else (), values[13:17], strict=False),
        ]
        raw = {signal.name: value for signal, value in pairs}
        if is_full and code.entries_code is not None:
            raw |= _of_covariance(code.entries_code, values[17:])
        return raw


def _of_covariance(code: CholeskyCode, raw: Sequence[int]) -> dict[str, int]:
    """Return the raw values of a covariance by signal, from those of ``maplines_cholesky_t``."""
    ratios = chain(*code.factor.ratios)
    pairs = [*zip(code.factor.pivots, raw[:4], strict=False), *zip(ratios, raw[4:10], strict=False)]
    return {signal.name: value for signal, value in (*pairs, (code.inflation, raw[10]))}
