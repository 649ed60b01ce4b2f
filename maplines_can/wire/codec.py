"""Codec of map lines: lines to frames and frames to lines, one at a time or many at once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..values.errors import EncodeError, LayoutError
from ..values.line import MapLine, Slot
from ..values.scene import Scene
from .covariance import CholeskyCode, CovarianceCode, SceneCode, SceneEncoder
from .layout.attributes import LINE_ATTRIBUTES, RecordAttributes, numbers
from .layout.dbc_reader import Database, default_dbc_path
from .layout.message_layout import POSE_CONDITIONAL, Layout
from .layout.pose_layout import Owner, PoseLayout
from .layout.validation import checked_gaussians, checked_mixtures, checked_payloads
from .protection.e2e_state import E2EConfig
from .protection.secoc import Authenticator, Verifier
from .reasons import Reason
from .reception.decoder import Decoder
from .reception.poses import PoseReceiver
from .reception.scenes import SceneReceiver
from .reception.settings import decoder_settings, pose_settings
from .records.complete_format import Batch
from .records.complete_records import CompleteRecords, complete_records
from .records.frames import Frame, FrameWriter
from .records.raw_format import RawFormat
from .records.record import CompleteRecord, RawRecord, RecordFormat, RecordReader
from .records.scene_reader import SceneReader
from .records.scene_writer import PreparedScene, SceneWriter

#: Covariance codes of the package, by the name in the DBC's attribute CovarianceCode.
CODES: Mapping[str, type[CovarianceCode]] = {CholeskyCode.name: CholeskyCode}


class Codec:
    """Codec between map lines and CAN frames; all factors, ranges and bits are from a DBC.

    The covariance is never overconfident. Let S be the covariance that was given, d the error of
    the decoded mean, and S' the decoded covariance. Unless the status is OUT_OF_RANGE, S' is
    positive definite and S' - (S + d d^T) is positive semidefinite. With the requested status
    DIAGONAL, S is the given covariance without its correlations, so those are not covered.

    Args:
        layout: from ``Layout.from_dbc``; most callers use ``Codec.from_dbc``.
        authenticator: keys and clock. With it, the codec sends authenticated frames only, and its
            decoders accept no others. None for a bus without authentication.
        codes: covariance codes that the DBC may name, by name.

    Raises:
        LayoutError: the covariance code is unknown, or there is an authenticator but the DBC has
            no authenticated message, or its freshness value is too short.
        TypeError: ``authenticator`` is something else, such as a key.

    >>> codec = Codec.from_dbc()
    >>> payload = codec.encode_batch([[1.75, 0, 0, 0]], [np.diag([0.01, 1e-4, 1e-8, 1e-12])])
    >>> payload.shape, payload.dtype
    ((1, 32), dtype('uint8'))
    >>> batch = codec.decode_batch(payload)
    >>> batch.accepted, batch.mean[0, 0], np.sqrt(batch.cov[0, 0, 0]).round(3)
    (array([ True]), np.float64(1.75), np.float64(0.102))
    """

    def __init__(
        self,
        layout: Layout,
        authenticator: Authenticator | None = None,
        codes: Mapping[str, type[CovarianceCode]] = CODES,
    ) -> None:
        self.layout = layout
        self.authenticator: Authenticator | None = None
        if not isinstance(authenticator, Authenticator | None):
            strange = type(authenticator).__name__
            del authenticator  # it may be a secret
            raise TypeError(
                f"authenticator must be an Authenticator, or None, got a {strange}; "
                "Authenticator(key, clock=time.time_ns) makes one of a Key"
            )
        self.authenticator = authenticator
        codes = {POSE_CONDITIONAL: CholeskyCode} | dict(codes)
        if layout.covariance_code not in codes:
            raise LayoutError(
                f"{layout.source}: the covariance code {layout.covariance_code!r} is not known; "
                f"there are {', '.join(codes)}; for those of the study, pass "
                "codes=maplines_can.study.codes.CODES"
            )
        #: Code of the covariance that the DBC names.
        self.covariance = codes[layout.covariance_code](layout)
        self._complete = complete_records(layout, self.covariance)
        #: Reader of the records of each slot and of the pose error.
        self.reader: RecordReader[CompleteRecord | RawRecord] = RecordReader(*self._formats())
        self._frame_writer = FrameWriter(layout, authenticator)
        self._scene_code = None if layout.pose is None else SceneCode(layout.pose, layout)
        self._counters: Counter[Owner] = Counter()

    @classmethod
    def from_dbc(
        cls,
        dbc: str | Path | Database | None = None,
        authenticator: Authenticator | None = None,
        codes: Mapping[str, type[CovarianceCode]] = CODES,
    ) -> Codec:
        """Return the codec of a DBC file, or of a database that cantools has loaded from one.

        By default, the DBC is the project's ``maplines.dbc``, or ``maplines-secoc.dbc`` with an
        authenticator.

        Raises:
            LayoutError: the file is missing, or the DBC does not describe a map line; the message
                names the signal or message and what it needs.
            TypeError: ``dbc`` or ``authenticator`` is of another class.

        >>> database = cantools.database.load_file("dbc/maplines.dbc")  # doctest: +SKIP
        >>> Codec.from_dbc(database)  # doctest: +SKIP
        <Codec of the cantools database: Cholesky>
        """
        if dbc is None and authenticator is not None:
            dbc = default_dbc_path("maplines-secoc.dbc")
        try:
            return cls(Layout.from_dbc(dbc), authenticator, codes)
        finally:
            del authenticator  # a traceback may show the locals

    def __repr__(self) -> str:
        secured = "" if self.authenticator is None else ", authenticated"
        return f"<Codec of {self.layout.source}: {self.layout.covariance_code}{secured}>"

    @property
    def can_ids(self) -> frozenset[int]:
        """CAN IDs of all lines, for filters."""
        return self.layout.can_ids

    @property
    def resolution(self) -> NDArray[np.float64]:
        """(4,) variances of the mean's rounding error, factor^2 / 12, in SI units squared."""
        return self.layout.resolution

    def encode_batch(
        self,
        means: ArrayLike,
        covs: ArrayLike | None = None,
        **attributes: ArrayLike | None,
    ) -> NDArray[np.uint8]:
        """Encode many lines into records.

        A value that does not fit is never clipped silently; the status reports it. An indefinite
        covariance is replaced by the nearest one that covers it (REPAIRED). A value beyond the end
        of its range is covered by a wider covariance (SATURATED). The line is OUT_OF_RANGE if the
        widest covariance does not cover the value, or if ``XMin`` and ``XMax`` cannot state a valid
        range within the given one.

        Args:
            means: (N, 4) lines [m, rad, 1/m, 1/m^2].
            covs: (N, 4, 4), which may be singular; None to send means only.
            **attributes: (N,) or one for all; see ``RecordAttributes``. Without ``x_min`` and
                ``x_max`` the lines are valid at x = 0 only; without covs the status is UNKNOWN.

        Returns:
            (N, record bytes) uint8.

        Raises:
            ValueError: a shape is wrong, or a value is not finite, asymmetric, or a negative
                variance; the message names the row.
            EncodeError: a value cannot be encoded in its signal, such as a slot that the DBC lacks.
            TypeError: there is no such attribute.

        >>> codec = Codec.from_dbc()
        >>> codec.encode_batch([[1.75, 0, 0, 0]], x_min=-8.0, x_max=64.0, age=0.04).shape
        (1, 32)
        """
        writer = self._complete_records().writer
        gaussians = checked_gaussians(means, covs)
        values = RecordAttributes.from_keywords(attributes)
        return writer.write(gaussians, values.without_covariance() if covs is None else values)

    def encode_mixtures(
        self, weights: ArrayLike, means: ArrayLike, covs: ArrayLike, **attributes: ArrayLike | None
    ) -> NDArray[np.uint8]:
        """Encode many Gaussian mixtures into records, one for each component.

        The decoded weights are multiples of the signal's step and add up to 1. The decoded mixture
        covers each component and the mixture's overall covariance; components are widened where the
        rounding of the weights would shrink it.

        Args:
            weights: (N, k), each row of sum 1.
            means: (N, k, 4).
            covs: (N, k, 4, 4).
            **attributes: attributes of each line, (N,) or one for all: any of
                ``RecordAttributes`` except component_*. The counter of a line is that of its first
                component, by default 0, k, 2 k, ...

        Returns:
            (N, k, record bytes) uint8; ``decode_batch`` reads the components one by one.

        Raises:
            ValueError, EncodeError, TypeError: as ``encode_batch``; or the weights are not
                positive, or do not add up to 1.
        """
        values = RecordAttributes.from_keywords(attributes, LINE_ATTRIBUTES)
        writer = self._complete_records().mixture_writer
        return writer.write(*checked_mixtures(weights, means, covs), values)

    def decode_batch(self, payloads: ArrayLike, slot: ArrayLike = Slot.EGO_LEFT) -> Batch:
        """Decode many records. Never raises on payload content.

        Args:
            payloads: (N, record bytes) uint8.
            slot: (N,) or one for all; their E2E data IDs are part of the checksums.

        Returns:
            The lines. Rejected rows hold whatever their bytes decode to.

        Raises:
            ValueError: the array has another shape or type.
        """
        records = checked_payloads(payloads, self.layout.record_bytes)
        data_ids = self.layout.data_ids(numbers("slot", slot), len(records))
        return self._complete_records().format.read(records, data_ids)

    def decode_one(self, payload: bytes, slot: Slot, t_ns: int | None = None) -> MapLine | Reason:
        """Decode one record, received at ``t_ns`` [ns]; bit-identical to ``decode_batch``.

        Returns:
            The line, or the reason why the record is rejected. For a component of a mixture it is
            the Gaussian of the component; see ``read_record``.
        """
        record = self.read_record(payload, slot, t_ns)
        return record if isinstance(record, Reason) else record.line

    def read_record(
        self, payload: bytes, slot: Slot, t_ns: int | None = None
    ) -> CompleteRecord | Reason:
        """Decode one record as ``decode_one``, with its index, count and weight in a mixture."""
        complete = self._complete_records()
        if slot not in self.layout.messages:
            raise EncodeError(f"{self.layout.source} has no message for slot {slot!r}")
        return RecordReader(complete.format).read(payload, slot, t_ns)

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
                None: the codec's own counters, which advance.
        """
        if not lines:
            return []
        writer = self._complete_records().line_writer
        first = self._counters if counters is None else counters
        records_of_lines, following = writer.write(lines, first)
        frames = [
            [frame for record in records for frame in self.frames(record, line.slot, fd=fd)]
            for line, records in zip(lines, records_of_lines, strict=True)
        ]
        if counters is None:
            self._counters = following
        return frames

    def prepare_scene(self, scene: Scene, *, fd: bool = False) -> PreparedScene:
        """Encode a scene but for counters and age, which takes most of the time.

        Args:
            scene: from ``map_scene``.
            fd: for CAN FD frames, which always have all entries of what a line has of its own.

        Raises:
            EncodeError: the DBC has no message of the pose error, or none for a slot; or the pose
                error does not fit.
        """
        return self._scene_writer.prepare(scene, full=fd and self.layout.is_conditional)

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
            fd: CAN FD frames, or with an authenticator, authenticated ones.
            counters: next counters of the pose error and of each slot; None: the codec's own ones,
                which advance.

        Returns:
            The frames of the pose error (``POSE``), then of each slot. With a DBC whose records are
            conditional on the pose error, lines that do not fit are not among them.

        Raises:
            EncodeError: as ``prepare_scene``.

        >>> from maplines_can import Gaussian, Polyline, map_scene
        >>> lines = {Slot.EGO_LEFT: Polyline([[-100, 1.75], [200, 1.75]])}
        >>> scene = map_scene(lines, Gaussian([0, 0, 0], np.diag([0.1, 0.2, 0.01]) ** 2))
        >>> codec = Codec.from_dbc(default_dbc_path("maplines-pose.dbc"))
        >>> {owner: len(frames) for owner, frames in codec.encode_scene(scene).items()}
        {'pose': 2, <Slot.EGO_LEFT: 0>: 2}
        """
        prepared = self.prepare_scene(scene, fd=fd) if isinstance(scene, Scene) else scene
        first = self._counters if counters is None else counters
        records, following = self._scene_writer.write(prepared, first, age)
        if counters is None:
            self._counters = following
        write = self._frame_writer.write
        return {owner: write(record, owner, fd) for owner, record in records.items()}

    def frames(self, payload: NDArray[np.uint8], slot: Slot, *, fd: bool = False) -> list[Frame]:
        """Return the frames of one record; each authenticated frame has its own freshness value."""
        return self._frame_writer.write(payload.tobytes(), slot, fd)

    def _complete_records(self) -> CompleteRecords:
        if self._complete is None:
            raise EncodeError(
                f"{self.layout.source}: its records are conditional on the pose error, so lines "
                "are sent and received as scenes; use map_scene and encode_scene"
            )
        return self._complete

    def _formats(self) -> Iterator[RecordFormat[CompleteRecord | RawRecord]]:
        yield RawFormat.of_lines(self.layout) if self._complete is None else self._complete.format
        if self.layout.pose is not None:
            yield RawFormat.of_pose(self.layout.pose)

    @cached_property
    def _scene_writer(self) -> SceneWriter:
        if self._scene_code is None or self.layout.pose is None:
            raise EncodeError(
                f"{self.layout.source} has no message of the pose error (MapLinePose), so lines "
                "cannot be sent as a scene; take maplines.dbc or maplines-pose.dbc"
            )
        encoder = SceneEncoder(self._scene_code)
        return SceneWriter(self.layout, self.layout.pose, encoder, self._complete)

    def verifier(self) -> Verifier | None:
        """Return a verifier of received frames of lines; None without an authenticator."""
        return self._verifier_of(self.layout)

    def _verifier_of(self, layout: Layout | PoseLayout) -> Verifier | None:
        if self.authenticator is None or layout.secured is None:
            return None
        return Verifier(self.authenticator, layout.secured)

    def decoder(
        self,
        *,
        timeout_ms: float | None = None,
        cycle_ms: float | None = None,
        e2e: E2EConfig | None = None,
    ) -> Decoder:
        """Return a new decoder, which holds the state of a receiver.

        Args:
            timeout_ms: longest time between the frames of a transfer, and between the components
                of a mixture [ms]. The default is shorter than the time after which transfer IDs
                repeat: (transfer IDs / greatest ComponentCount - 0.5) cycles, at least 0.5 and at
                most 1.5 cycles; 75 ms with ``maplines.dbc``. ``Reassembler`` describes the effect
                of a longer one.
            cycle_ms: cycle time of the lines of a slot [ms], for the E2E state, stale and late
                lines, and the default of ``timeout_ms``; by default the slot's cycle time in the
                DBC, or 100 ms.
            e2e: windows and bounds of the E2E state machines.

        Raises:
            ValueError: a time is 0 or less, or more than an hour; or ``e2e`` does not fit the
                DBC's counter.
        """
        layout = self.layout
        settings = decoder_settings(layout, timeout_ms, cycle_ms, e2e)
        scenes = None
        if layout.pose is not None and self._scene_code is not None:
            times = pose_settings(layout.pose, timeout_ms, cycle_ms)
            scenes = SceneReceiver.of(
                PoseReceiver(layout.pose, self._verifier_of(layout.pose), *times, settings[2]),
                SceneReader(layout, layout.pose, self._scene_code),
                layout,
            )
        return Decoder(layout, self.reader, self.verifier(), *settings, scenes)
