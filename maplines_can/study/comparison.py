"""Codec of the covariance codes for comparison: on arrays, and as frames for the commands."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..values.errors import LayoutError
from ..values.gaussian import Gaussian
from ..values.linalg import nearest_covariance
from ..values.line import VAGUE_SIGMA, Kind, MapLine, Status
from ..wire import CODES as CORE_CODES
from ..wire import Batch, Codec, Decoder, E2EConfig, Encoder, Layout, Owner, Reason
from ..wire.layout.pose_layout import slot_of
from ..wire.layout.signals import PARAMETER_SIGNALS, SignalRow
from ..wire.layout.validation import CheckedGaussians, checked_gaussians
from ..wire.reception.python_decoder import PythonDecoder
from ..wire.reception.settings import decoder_settings
from ..wire.records.counters import packed, unpacked
from ..wire.records.frames import FrameWriter, Records
from ..wire.records.packer import RecordPacker
from ..wire.records.record import CompleteRecord, RecordReader
from ..wire.scene_writer import SceneWriter
from .codes import CODES, COMPARED
from .components import deficit, quantized_weights, slope_error

Array = NDArray[np.float64]

#: Least eigenvalue of a correlation matrix that is not repaired, and of one that is.
DEFINITE, REPAIRED = 1e-12, 1e-9
_VAGUE = np.diag(np.square(VAGUE_SIGMA))


class Transmitted(NamedTuple):
    """N lines as they are decoded: the members of a ``Batch`` that the study needs."""

    mean: Array  #: (N, 4)
    cov: Array  #: (N, 4, 4), positive definite only if the code guarantees it
    status: NDArray[np.int64]  #: (N,) as ``Status``
    accepted: NDArray[np.bool_]  #: (N,) whether a receiver takes the covariance, or repairs it


AnyCodec: TypeAlias = "Codec | ComparisonCodec"


def codec_for(layout: Layout) -> AnyCodec:
    """Return the codec of any covariance code.

    Raises:
        LayoutError: there is no such code, or the signals do not suit it.
    """
    return Codec(layout) if layout.covariance_code in CORE_CODES else ComparisonCodec(layout)


def transmit(codec: AnyCodec, means: ArrayLike, covs: ArrayLike) -> Batch | Transmitted:
    """Return (N, 4) means and (N, 4, 4) covariances as they are decoded; see ``BatchCodec``."""
    if isinstance(codec, ComparisonCodec):
        return codec.transmit(means, covs)
    return codec.batch.decode(codec.batch.encode(means, covs))


class ComparisonCodec:
    """Codec of a DBC whose covariance code is not that of the core.

    The study transmits arrays. Encoder and decoder are for the commands, and slow.

    Args:
        layout: of the lines; a message of the pose error is left out.

    Raises:
        LayoutError: there is no such code, or the signals do not suit it.
    """

    authenticator = None

    def __init__(self, layout: Layout) -> None:
        if layout.covariance_code not in COMPARED:
            raise LayoutError(
                f"{layout.source}: the covariance code {layout.covariance_code!r} is not known; "
                f"there are {', '.join(CODES)}"
            )
        self.layout = replace(layout, pose=None)
        self.covariance = COMPARED[layout.covariance_code](layout)
        #: Signals of the mean.
        self.mean = SignalRow(layout[name] for name in PARAMETER_SIGNALS)

    @property
    def resolution(self) -> Array:
        """(4,) variances of the mean's rounding error, as those of a ``Codec``."""
        return self.layout.resolution

    @property
    def can_ids(self) -> frozenset[int]:
        """CAN IDs of all lines, for filters."""
        return self.layout.can_ids

    def of_layout(self, layout: Layout) -> ComparisonCodec:
        """Return the codec of another layout."""
        return ComparisonCodec(layout)

    def transmit(self, means: ArrayLike, covs: ArrayLike) -> Transmitted:
        """Return (N, 4) means and (N, 4, 4) covariances as they are decoded.

        Raises:
            ValueError: as ``BatchCodec.encode``.
        """
        gaussians = checked_gaussians(means, covs)
        return self.decode(self.encode(gaussians, np.full(len(gaussians.mean), Status.FULL)))

    @np.errstate(over="ignore", invalid="ignore")  # the status reports what does not fit
    def encode(
        self, gaussians: CheckedGaussians, requested: NDArray[np.int64]
    ) -> dict[str, NDArray[np.int64]]:
        """Return the (N,) raw values of mean, covariance and status, by signal.

        The status is the requested one if the code supports it and everything fits.
        """
        mean, cov, indefinite = gaussians
        if self.covariance.status != Status.FULL:
            requested = np.where(_without_covariance(requested), requested, self.covariance.status)
        raw_mean, decoded, beyond = self.mean.nearest(mean)
        clipped, d = beyond.any(axis=1), mean - decoded
        error = cov + d[:, :, None] * d[:, None, :]
        if indefinite.any():
            error[indefinite] += nearest_covariance(cov[indefinite]) - cov[indefinite]
        diagonal = requested == Status.DIAGONAL
        error[diagonal] += cov[diagonal] * np.eye(4) - cov[diagonal]
        # The slope of a clipped beta is off by more than its angle.
        d_beta = slope_error(mean[clipped], decoded[clipped])[:, 1]
        error[clipped, 1, 1] += (d_beta**2 - d[clipped, 1] ** 2).clip(0)
        coded = self.covariance.encode(error, self.resolution)
        without = _without_covariance(requested)
        for name, value in self.covariance.widest().items():
            coded.raw[name][without] = value
        status = np.where(
            (clipped | coded.saturated) & (requested == Status.FULL), Status.SATURATED, requested
        )
        status[indefinite & ~diagonal & ~without] = Status.REPAIRED
        far = (np.abs(d) > 0.51 * np.abs(self.mean.factor)).any(axis=1)
        status[np.where(without, far, ~coded.covered)] = Status.OUT_OF_RANGE
        means = dict(zip(PARAMETER_SIGNALS, raw_mean.astype(np.int64).T, strict=True))
        return {**means, **coded.raw, "Status": status}

    def decode(self, raw: Mapping[str, NDArray[np.int64]]) -> Transmitted:
        """Return the lines of (N,) raw values by signal, those of ``encode`` or any others."""
        cov = self.covariance.decode(raw)
        cov[_without_covariance(raw["Status"])] = _VAGUE
        accepted = np.isfinite(cov).all(axis=(1, 2)) & (np.einsum("nii->ni", cov) >= 0).all(axis=1)
        return Transmitted(self.mean.physical_of(raw), cov, raw["Status"], accepted)

    def encoder(self) -> Encoder:
        """Return a new encoder, which holds the counters of a sender."""
        return ComparisonEncoder(self)

    def decoder(
        self,
        *,
        timeout_ms: float | None = None,
        cycle_ms: float | None = None,
        e2e: E2EConfig | None = None,
    ) -> Decoder:
        """Return a new decoder, as ``Codec.decoder``; it repairs indefinite covariances."""
        settings = decoder_settings(self.layout, timeout_ms, cycle_ms, e2e)
        return PythonDecoder(self.layout, RecordReader(_Records(self)), {}, settings, None)


class ComparisonEncoder(Encoder):
    """Encoder of lines with a covariance code for comparison."""

    def __init__(self, codec: ComparisonCodec) -> None:
        no_tables: Any = None
        layout = codec.layout
        frames, scenes = FrameWriter(layout, None), SceneWriter(layout, no_tables)
        super().__init__(codec.encoder, layout, no_tables, frames, scenes)
        self._writer = _Records(codec)

    def _write_lines(self, lines: Sequence[MapLine], counters: bytes) -> tuple[Records, bytes]:
        of_lines, following = self._writer.write_lines(lines, unpacked(counters))
        pairs = zip(lines, of_lines, strict=True)
        return Records.of((line.slot, one) for line, own in pairs for one in own), packed(following)


class _Records:
    """Writer and format of the records of lines, one by one."""

    def __init__(self, codec: ComparisonCodec) -> None:
        self._codec, self._signals = codec, codec.layout.signals
        self.packer = RecordPacker(codec.layout)
        self.data_ids: dict[Owner, int]
        self.data_ids = {slot: own.data_id for slot, own in codec.layout.messages.items()}

    def write_lines(
        self, lines: Sequence[MapLine], counters: Mapping[Owner, int]
    ) -> tuple[list[list[bytes]], Counter[Owner]]:
        """Return the records of each line, and the counters that follow them."""
        following: Counter[Owner] = Counter(counters)
        modulus = 2 ** self._signals["Counter"].length
        written = []
        for line in lines:
            (data_id,) = self._codec.layout.data_ids(line.slot, 1).tolist()
            records = []
            for raw in self._components(line):
                raw["Counter"] = following[line.slot] % modulus
                following[line.slot] = (raw["Counter"] + 1) % modulus
                records.append(self.packer.pack_one(raw, data_id))
            written.append(records)
        return written, following

    def _components(self, line: MapLine) -> Iterator[dict[str, int]]:
        """Yield the raw values of each component of a line, all but the counter."""
        weights, means = np.ones(1), line.gaussian.mean[None]
        covs = line.gaussian.cov[None]
        if (mixture := line.mixture) is not None:
            given = mixture.weights[None], mixture.means[None], mixture.covs[None]
            steps = round(1 / self._signals["ComponentWeight"].factor)
            weights, means = quantized_weights(given[0], steps)[0] / steps, mixture.means
            sent = self._codec.mean.nearest(given[1]).physical
            covs = mixture.covs + deficit(*given, weights[None], sent)
        n = len(weights)
        gaussians = CheckedGaussians(means, covs, np.zeros(n, dtype=bool))
        raw = self._codec.encode(gaussians, np.full(n, line.status))
        first, last = self._signals["XMin"], self._signals["XMax"]
        raw_range = first.above_one(float(line.x_min))[0], last.below_one(float(line.x_max))[0]
        start, end = first.physical_one(raw_range[0]), last.physical_one(raw_range[1])
        if not line.x_min <= start <= end <= line.x_max:
            raw["Status"][:] = Status.OUT_OF_RANGE
        of_line = {
            "XMin": raw_range[0],
            "XMax": raw_range[1],
            "Kind": int(line.kind),
            "Age": self._signals["Age"].above_one(1000 * float(line.age))[0],
            "ComponentCount": self._signals["ComponentCount"].nearest_one(n).raw,
        }
        weight = self._signals["ComponentWeight"]
        for i in range(n):
            of_component = {name: int(values[i]) for name, values in raw.items()}
            place = {"ComponentIndex": i, "ComponentWeight": weight.nearest_one(weights[i]).raw}
            yield of_line | of_component | place

    def content(
        self, raw: Mapping[str, int], owner: Owner, t_ns: int | None
    ) -> CompleteRecord | Reason:
        """Return the content of an intact record, or CONTENT if no sender may send its values."""
        names = ("XMin", "XMax", "Age", "ComponentCount", "ComponentWeight")
        x_min, x_max, age_ms, count, weight = (
            self._signals[name].physical_one(raw[name]) for name in names
        )
        if raw["Status"] > max(Status) or raw["Kind"] > max(Kind):
            return Reason.CONTENT
        if raw["ComponentIndex"] >= count or not 0 < weight <= 1:
            return Reason.CONTENT
        status = Status(raw["Status"])
        one = self._codec.decode({name: np.array([value]) for name, value in raw.items()})
        if not one.accepted[0] or (x_min > x_max and status != Status.OUT_OF_RANGE):
            return Reason.CONTENT
        cov = one.cov[0]
        if not (self._codec.covariance.positive_definite or _is_definite(cov)):
            cov = nearest_covariance(cov)
            cov += np.diag(np.maximum(self._codec.resolution, REPAIRED * cov.diagonal()))
            status = Status.REPAIRED
        line = MapLine(
            slot=slot_of(owner),
            gaussian=Gaussian.trusted(one.mean[0], cov),
            kind=Kind(raw["Kind"]),
            x_min=min(x_min, x_max),
            x_max=x_max,
            age=age_ms / 1000 if raw["Age"] < self._signals["Age"].raw_max else math.inf,
            status=status,
            t_ns=t_ns,
        )
        return CompleteRecord(line, raw["ComponentIndex"], int(count), weight, raw["Counter"])


def _is_definite(cov: Array) -> bool:
    """Return whether a (4, 4) matrix is numerically positive definite."""
    sigma = np.sqrt(cov.diagonal())
    return bool(sigma.all() and np.linalg.eigvalsh(cov / (sigma[:, None] * sigma))[0] > DEFINITE)


def _without_covariance(status: NDArray[np.int64]) -> NDArray[np.bool_]:
    return (status == Status.UNKNOWN) | (status == Status.OUT_OF_RANGE)
