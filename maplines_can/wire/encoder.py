"""Encoder of lines and scenes into frames, with the counters of a sender."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import chain, islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import Lock, ffi, lib
from ..values.errors import EncodeError
from ..values.line import LeftOut, MapLine, Slot
from ..values.scene import Scene
from .core_tables import LineTables
from .frames import Frame, FrameWriter, Records
from .layout.attributes import RecordAttributes
from .layout.message_layout import Layout
from .layout.pose_layout import Owner
from .layout.record_signals import PAGE_BYTES
from .layout.validation import checked_gaussians
from .scene_writer import PreparedScene, SenderState, placed_slots, prepare_scene, write_scene
from .sender_values import GAUSSIAN_BYTES, given_lines, packed

_LINES, _DOUBLES, _INTS, _COUNTERS, _BYTES = map(
    ffi.typeof, ("maplines_given_line_t[]", "double[]", "int32_t[]", "int64_t[]", "uint8_t[]")
)


class Encoder:
    """Encoder of the lines of a sender; it holds the counter of each record.

    With messages of whole scenes, it also holds the places that lines had in the last cycle, so
    that these change as little as possible.

    ``Codec.encoder`` makes one, whose counters begin with 0. A copy, or one from a pickle, goes on
    from the state of the original: only one of the two may send.

    Args:
        again: makes an encoder of the same codec.
        layout: of the records.
        tables: of the same DBC.
        frame_writer: writes the frames of a record.
    """

    def __init__(
        self,
        again: Callable[[], Encoder],
        layout: Layout,
        tables: LineTables,
        frame_writer: FrameWriter,
    ) -> None:
        self._again, self._layout = again, layout
        self._tables, self._frame_writer = tables, frame_writer
        self._state = SenderState(packed({}))
        self._lock = Lock()  # of the state: threads send different lines

    def __reduce__(self) -> tuple[Any, ...]:
        return self._again, (), {"_state": self._state}

    def encode(self, line: MapLine, *, fd: bool = False) -> list[Frame]:
        """Encode a line into frames to be sent back to back, and advance the slot's counter.

        Args:
            line: line to send.
            fd: one CAN FD frame instead of the pages of the classic message; with an
                authenticator, an authenticated one.

        Raises:
            EncodeError: the DBC has no such message, or it is not authenticated.
        """
        return self.encode_lines([line], fd=fd)[0]

    def encode_lines(
        self,
        lines: Sequence[MapLine],
        *,
        fd: bool = False,
        counters: Mapping[Owner, int] | None = None,
    ) -> list[list[Frame]]:
        """Return the frames of each line; encoding many takes hardly longer than encoding one.

        Args:
            lines: lines to send.
            fd: see ``encode``.
            counters: start counter of each slot; pass it if encoded frames may never be sent.
                None: those of the encoder, which advance.
        """
        if not lines:
            return []
        lines = [*lines]  # reading one of a subclass may change the list
        _, frames = self._written(partial(self._write_lines, lines), fd, counters)
        if len(frames) != len(lines):  # mixtures have a record of each component
            ordered = iter(frames)
            frames = [[*chain(*islice(ordered, _parts(line)))] for line in lines]
        return frames

    def _written(
        self,
        write: Callable[[SenderState], tuple[Records, SenderState]],
        fd: bool,
        counters: Mapping[Owner, int] | None,
    ) -> tuple[tuple[Owner, ...], list[list[Frame]]]:
        """Return the owners and the frames of records; without counters, the state here advances.

        Args:
            write: returns the records from a state on, and the state that follows.
            fd: see ``encode``.
            counters: see ``encode_lines``.
        """
        with self._lock:
            state = self._state
            if counters is not None:
                state = state._replace(counters=packed(counters))
            records, following = write(state)
            frames = self._frame_writer.write_all(records, fd)
            if counters is None:
                self._state = following
        return records.owners, frames

    def prepare_scene(self, scene: Scene | PreparedScene, *, fd: bool = False) -> PreparedScene:
        """Encode a scene but for counters and age, which takes most of the time.

        Args:
            scene: from ``map_scene``; one that is prepared is returned as it is.
            fd: for CAN FD frames. Those of one line have all entries of its line-specific
                covariance; messages of whole scenes are CAN FD only.

        Raises:
            EncodeError: the DBC has no message of the pose error, or none for a slot; or the pose
                error does not fit; or the scene was prepared for another DBC; or the DBC has whole
                scenes, and classic frames are requested.
            TypeError: it is no scene.
        """
        if not (fd or self._layout.has_classic):
            raise classic_error(self._layout)
        if isinstance(scene, PreparedScene):
            if not scene.layout.is_same_as(self._layout):
                raise EncodeError(
                    f"the scene was prepared for another DBC, {scene.layout.source}, and this "
                    f"encoder is of {self._layout.source}; prepare it with an encoder of this DBC, "
                    "or encode or publish the Scene itself"
                )
            return scene
        if not isinstance(scene, Scene):
            raise TypeError(
                "scene must be a Scene, such as from map_scene, or one from prepare_scene, got a "
                f"{type(scene).__name__}"
            )
        full = fd and self._layout.is_conditional and self._layout.scene is None
        return prepare_scene(self._layout, self._tables.dbc, scene, full=full)

    def encode_scene(
        self,
        scene: Scene | PreparedScene,
        *,
        age: float | Mapping[Owner, float] = 0.0,
        fd: bool = False,
        counters: Mapping[Owner, int] | None = None,
    ) -> dict[Owner, list[Frame]]:
        """Encode the pose error and the lines of a scene; send the frames in this order.

        Args:
            scene: from ``map_scene``, or prepared.
            age: time from the pose to the sending of each record, or one for all [s]; infinite if
                it is too old.
            fd: CAN FD frames, or with an authenticator, authenticated ones; needed for whole
                scenes.
            counters: next counter of each record, by owner; None: those of the encoder, which
                advance, and with them the places of lines in whole scenes.

        Returns:
            The frames of the pose error (``POSE``), then of each slot. With a DBC whose records are
            conditional on the pose error, lines that do not fit are not among them. With messages
            of whole scenes, the frame of ``SCENE2``, if it is sent, and then that of ``SCENE``.

        Raises:
            EncodeError: as ``prepare_scene``.
            ValueError: an age is less than 0 or NaN, or is missing.

        >>> from maplines_can import Codec, Gaussian, Polyline, map_scene
        >>> from maplines_can.wire import default_dbc_path
        >>> lines = {Slot.EGO_LEFT: Polyline([[-100, 1.75], [200, 1.75]])}
        >>> scene = map_scene(lines, Gaussian([0, 0, 0], np.diag([0.1, 0.2, 0.01]) ** 2))
        >>> codec = Codec.from_dbc(default_dbc_path("maplines-pose.dbc"))
        >>> {owner: len(frames) for owner, frames in codec.encoder().encode_scene(scene).items()}
        {'pose': 2, <Slot.EGO_LEFT: 0>: 2}
        >>> codec = Codec.from_dbc(default_dbc_path("maplines-scene.dbc"))
        >>> sent = codec.encoder().encode_scene(scene, fd=True)
        >>> {owner: len(frames) for owner, frames in sent.items()}
        {'scene': 1}
        """
        write = partial(
            write_scene,
            self.prepare_scene(scene, fd=fd),
            self._tables.dbc,
            age=age,
            secured=self._frame_writer.is_secured,
        )
        return dict(zip(*self._written(write, fd, counters), strict=True))

    def left_out(self, scene: Scene | PreparedScene, *, fd: bool = False) -> dict[Slot, LeftOut]:
        """Return the reasons of all lines that are not sent if this scene is the next one, by slot.

        Beside those of ``PreparedScene.left_out``, they are those of lines for which messages of
        whole scenes have no place. After the scene was encoded they are the same.

        Args:
            scene: from ``map_scene``, or prepared.
            fd: see ``encode_scene``.

        Raises:
            EncodeError, TypeError: as ``prepare_scene``.
        """
        prepared = self.prepare_scene(scene, fd=fd)
        if self._layout.scene is None:
            return prepared.left_out
        secured = self._frame_writer.is_secured
        placed = placed_slots(prepared, self._tables.dbc, self._state, secured=secured)
        without = dict.fromkeys(set(prepared.members) - placed, LeftOut.PLACE)
        return prepared.left_out | without

    def frames(self, payload: NDArray[np.uint8], owner: Owner, *, fd: bool = False) -> list[Frame]:
        """Return the frames of one record; each authenticated frame has its own freshness value.

        Raises:
            EncodeError: the DBC has no such message, or its records have another length.
        """
        layout = self._layout
        lengths = {layout.record_bytes}
        if layout.scene is None:
            lengths.add(PAGE_BYTES * layout.short_pages)
        if payload.nbytes not in lengths:
            raise EncodeError(
                f"payload must be a record of {layout.source}, of "
                f"{' or '.join(map(str, sorted(lengths)))} bytes, got {payload.nbytes}"
            )
        return self._frame_writer.write(payload.tobytes(), owner, fd)

    def _write_lines(
        self, lines: Sequence[MapLine], state: SenderState
    ) -> tuple[Records, SenderState]:
        """Return the records of lines one after the other, and the state that follows."""
        try:
            slots, given, gaussians, parts, weights = given_lines(lines)
        except struct.error as error:
            raise unfit_lines(self._layout, lines) from error
        length, following = self._layout.record_bytes, bytearray(state.counters)
        records = bytearray(len(gaussians) // GAUSSIAN_BYTES * length)
        if not lib.maplines_write_lines(
            self._tables.dbc,
            self._tables.variance_powers,
            len(slots),
            ffi.from_buffer(_LINES, given),
            ffi.from_buffer(_INTS, parts) if parts else ffi.NULL,
            ffi.from_buffer(_DOUBLES, gaussians),
            ffi.from_buffer(_DOUBLES, weights) if weights else ffi.NULL,
            ffi.from_buffer(_COUNTERS, following),
            ffi.from_buffer(_BYTES, records),
        ):
            raise unfit_lines(self._layout, lines)
        if parts:
            pairs = zip(slots, parts, strict=True)
            slots = [slot for slot, count in pairs for _ in range(count or 1)]
        lengths = (length,) * len(slots)
        written = Records(bytes(records), tuple(slots), lengths)
        return written, state._replace(counters=bytes(following))


def _parts(line: MapLine) -> int:
    """Return the number of records of a line."""
    return 1 if line.mixture is None else len(line.mixture.components)


def unfit_lines(layout: Layout, lines: Sequence[MapLine]) -> EncodeError:
    """Return the error that the core takes no such lines.

    Raises:
        EncodeError, ValueError, TypeError: the fault, if it is one that has a name.
    """
    if layout.is_conditional:
        return conditional_error(layout)
    for line in lines:
        parts = (line.gaussian,) if line.mixture is None else line.mixture.components
        count = len(parts)
        checked_gaussians([one.mean for one in parts], [one.cov for one in parts])
        shared = RecordAttributes(
            slot=line.slot,
            kind=line.kind,
            x_min=line.x_min,
            x_max=line.x_max,
            age=line.age,
            status=line.status,
            component_index=np.arange(count),
            component_count=count,
            component_weight=1.0 if line.mixture is None else line.mixture.weights,
        )
        shared.rows(layout, count)
    return EncodeError(f"{layout.source}: the core takes no lines such as {lines!r}")


def classic_error(layout: Layout) -> EncodeError:
    """Return the error that the messages of a layout are CAN FD only."""
    what = "scenes" if layout.scene is not None else "records"
    return EncodeError(
        f"{layout.source}: its {what} are CAN FD frames of {layout.record_bytes} bytes, and it has "
        "no message for classic CAN; send with fd=True"
    )


def conditional_error(layout: Layout) -> EncodeError:
    """Return the error that lines of a layout can only be sent and received as scenes."""
    return EncodeError(
        f"{layout.source}: its records are conditional on the pose error, so lines are sent and "
        "received as scenes; use map_scene and encode_scene"
    )
