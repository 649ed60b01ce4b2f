"""Codec of the covariance codes for comparison: on arrays, and as frames for the commands."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import ffi, lib
from ..values.elementary import sin_cos, tan
from ..values.errors import LayoutError
from ..values.gaussian import Gaussian
from ..values.linalg import nearest_covariance
from ..values.line import VAGUE_SIGMA, MapLine, Slot, Status
from ..values.mixture import GaussianMixture, moments
from ..values.scene import Scene
from ..wire import CODES as CORE_CODES
from ..wire import (
    Batch,
    Codec,
    Decoder,
    E2EConfig,
    Encoder,
    Frame,
    Layout,
    Owner,
    PreparedScene,
)
from ..wire.codec import decoder_settings
from ..wire.core_tables import LineTables, tables_of
from ..wire.frames import FrameWriter, Records
from ..wire.layout.packing import Packing
from ..wire.layout.record_signals import PARAMETER_SIGNALS, TRANSFER_ID
from ..wire.layout.validation import CheckedGaussians, checked_gaussians
from ..wire.scene_writer import SenderState
from ..wire.sender_values import packed, unpacked
from .codes import CODES, COMPARED
from .codes.code import SignalRow, nearest_raw, raw_above, raw_below

Array = NDArray[np.float64]


def quantized_weights(weights: Array, steps: int) -> NDArray[np.int64]:
    """Round weights to positive multiples of ``1 / steps`` that add up to 1.

    The largest remainders are rounded up (Hamilton's method). So no weight is off by a step or
    more, unless it had to be raised to one step.

    The weights are (N, k) and positive, each row of sum 1; ``steps`` is k or more.

    Returns:
        (N, k) multiples, each row of sum ``steps``.

    >>> quantized_weights(np.array([[0.005, 0.335, 0.66]]), 32)
    array([[ 1, 10, 21]])
    """
    exact = weights * steps
    multiples = np.maximum(1, np.floor(exact)).astype(np.int64)
    rows = np.arange(len(multiples))
    for _ in range(weights.shape[1]):
        missing = steps - multiples.sum(axis=1)
        multiples[rows, (exact - multiples).argmax(axis=1)] += missing > 0
        excess = np.where(multiples > 1, multiples - exact, -np.inf)
        multiples[rows, excess.argmax(axis=1)] -= missing < 0
    return multiples


@np.errstate(over="ignore", invalid="ignore")
def deficit(
    weights: Array, means: Array, covs: Array, decoded_weights: Array, decoded_means: Array
) -> Array:
    """Return the variance to add to each component so that the whole mixture is covered.

    Each decoded component covers its own covariance, so the covariance of the decoded mixture is
    at least ``B = sum w'_i (S_i + d_i d_i^T + (m'_i - m')(m'_i - m')^T)``. It must cover the true
    covariance about the decoded mean, ``T = S + (m - m')(m - m')^T``. The positive part of
    ``T - B``, added to the covariance of each component, closes the gap.

    Weights are (N, k), means (N, k, 4), and covs (N, k, 4, 4). The result is (N, 4, 4) positive
    semidefinite, and zero where the mixture is covered already.
    """
    mean, T = moments(weights, means, covs)
    d = means - decoded_means
    own = covs + d[..., :, None] * d[..., None, :]
    decoded_mean, B = moments(decoded_weights, decoded_means, own)
    off = mean - decoded_mean
    T = T + off[:, :, None] * off[:, None, :]
    gap = T - B
    scale = np.sqrt(np.einsum("nii->ni", T))
    scale = np.where((scale > 0) & (scale < np.inf), scale, 1.0)
    scale2 = scale[:, :, None] * scale[:, None, :]
    gap /= scale2
    # On overflow some component is so far out of range that its own record is OUT_OF_RANGE.
    gap[~np.isfinite(gap).all(axis=(1, 2))] = 0.0
    values, vectors = np.linalg.eigh(gap)
    # A little more than the gap, so that a check with another algorithm's rounding passes.
    values = np.where(values > 0, values * (1 + 1e-6), 0.0)
    lifted = (vectors * values[:, None, :]) @ vectors.mT
    return (lifted + lifted.mT) / 2 * scale2


def slope_error(mean: Array, near: Array) -> Array:
    """Return the (..., 4) errors of lines whose first-order effect is that of their slopes.

    The lateral position depends on beta by its tangent, so that the error of a line is another one
    than the difference of the parameters if that of beta is large.
    """
    error = mean - near
    sine, cosine = sin_cos(near[..., 1])
    error[..., 1] = (tan(mean[..., 1]) - sine / cosine) * (cosine * cosine)
    return np.asarray(error)


#: Least eigenvalue of a correlation matrix that is not repaired, and of one that is.
DEFINITE, REPAIRED = 1e-12, 1e-9
#: The status of a mixture is that of its worst component; from best to worst.
SEVERITY = (
    Status.FULL,
    Status.REPAIRED,
    Status.SATURATED,
    Status.DIAGONAL,
    Status.UNKNOWN,
    Status.OUT_OF_RANGE,
)
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


class SentScene(NamedTuple):
    """Scene as sent and as received."""

    prepared: PreparedScene
    frames: Mapping[Owner, Sequence[Frame]]
    received: Scene | None


def sent_scene(codec: AnyCodec, scene: Scene, *, fd: bool) -> SentScene:
    """Send a scene, and receive it.

    Raises:
        EncodeError: it does not fit the DBC.
    """
    encoder, decoder = codec.encoder(), codec.decoder()
    prepared = encoder.prepare_scene(scene, fd=fd)
    frames = encoder.encode_scene(prepared, fd=fd)
    for frame in chain.from_iterable(frames.values()):
        decoder.feed(frame.can_id, frame.data, 0)
    view = decoder.scene()
    return SentScene(prepared, frames, None if view is None else view.scene)


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
        return ComparisonDecoder(self, timeout_ms, cycle_ms, e2e)


class ComparisonEncoder(Encoder):
    """Encoder of lines whose covariances have a code for comparison.

    Args:
        codec: of the lines.
    """

    def __init__(self, codec: ComparisonCodec) -> None:
        layout = codec.layout
        tables = LineTables(tables_of(layout), ffi.NULL, ffi.NULL)
        super().__init__(codec.encoder, layout, tables, FrameWriter(layout, None))
        self._codec, self._signals = codec, codec.layout.signals
        self._packing = Packing([*self._signals.values()], layout.record_bytes)
        self._modulus = 2 ** self._signals["Counter"].length

    def _write_lines(
        self, lines: Sequence[MapLine], state: SenderState
    ) -> tuple[Records, SenderState]:
        following: Counter[Owner] = Counter(unpacked(state.counters))
        each = ((line.slot, raw) for line in lines for raw in self._raw(line))
        records = Records.of([(slot, self._record(raw, slot, following)) for slot, raw in each])
        return records, state._replace(counters=packed(following))

    def _record(self, raw: Mapping[str, int], slot: Slot, following: Counter[Owner]) -> bytes:
        """Return a record, and advance the counter of its slot."""
        counter = following[slot] % self._modulus
        following[slot] = (counter + 1) % self._modulus
        self._layout.data_ids(slot, 1)  # there is a message for it
        record = bytearray(self._packing.pack_one(raw))
        given = ffi.from_buffer("uint8_t[]", record)
        lib.maplines_seal_record(self._tables.dbc, slot, len(record), counter, given)
        return bytes(record)

    def _raw(self, line: MapLine) -> Iterator[dict[str, int]]:
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
        raw_range = raw_above(first, float(line.x_min)), raw_below(last, float(line.x_max))
        start, end = first.physical_one(raw_range[0]), last.physical_one(raw_range[1])
        if not line.x_min <= start <= end <= line.x_max:
            raw["Status"][:] = Status.OUT_OF_RANGE
        of_line = {
            "XMin": raw_range[0],
            "XMax": raw_range[1],
            "Kind": int(line.kind),
            "Age": raw_above(self._signals["Age"], 1000 * float(line.age)),
            "ComponentCount": int(nearest_raw(self._signals["ComponentCount"], n)[0]),
        }
        sent_weights, _ = nearest_raw(self._signals["ComponentWeight"], weights)
        for i in range(n):
            of_component = {name: int(values[i]) for name, values in raw.items()}
            place = {"ComponentIndex": i, "ComponentWeight": int(sent_weights[i])}
            yield of_line | of_component | place


class ComparisonDecoder(Decoder):
    """Decoder of lines whose covariances have a code for comparison.

    The core receives their records, without covariances; those are read from the records that it
    holds. One that is indefinite is repaired. A line with one that is no covariance is
    OUT_OF_RANGE, and so not usable.

    Args:
        codec: of the lines.
        *settings: those of ``decoder_settings``.
    """

    def __init__(self, codec: ComparisonCodec, *settings: Any) -> None:
        layout, tables = codec.layout, tables_of(codec.layout)
        super().__init__(layout, tables, {}, decoder_settings(layout, tables, *settings))
        self._codec = codec
        self._packing = Packing([*layout.signals.values()], layout.record_bytes)
        self._transfer_ids = 2 ** layout[f"{TRANSFER_ID}0"].length

    def feed_arrays(
        self,
        can_id: NDArray[np.uint32],
        is_extended: NDArray[np.bool_],
        t_ns: NDArray[np.int64],
        length: NDArray[np.uint8],
        data: NDArray[np.uint8],
        places: NDArray[np.int64],
        reasons: NDArray[np.uint8],
        scenes: int,
    ) -> tuple[NDArray[np.void], NDArray[np.void], NDArray[np.void]]:
        """Decode frames of a block, one by one; see ``Decoder.feed_arrays``."""
        frames = can_id, is_extended, t_ns, length, data
        one_by_one = [places[i : i + 1] for i in range(len(places))] or [places]
        feed = super().feed_arrays
        found = [feed(*frames, place, reasons, scenes) for place in one_by_one]
        lines, components, seen = (np.concatenate(each) for each in zip(*found, strict=True))
        components["line"] = np.repeat(
            np.cumsum([len(own) for own, *_ in found]) - 1, [len(own) for _, own, _ in found]
        )
        return lines, components, seen

    def _completed(self, count: int) -> list[MapLine]:
        return [self._with_covariance(line) for line in super()._completed(count)]

    def _renew(self, rows: Any, lines: NDArray[np.void], components: NDArray[np.void]) -> None:
        super()._renew(rows, lines, components)
        for row in lines:  # at most one
            line = self._with_covariance(self._newest[Slot(row["slot"])])
            row["mean"], row["cov"] = line.gaussian.mean, line.gaussian.cov
            row["status"], row["usable"] = line.status, row["usable"] and line.is_usable
            if line.mixture is not None:
                components["mean"], components["cov"] = line.mixture.means, line.mixture.covs

    def _with_covariance(self, line: MapLine) -> MapLine:
        """Return a line that was just completed with its covariance, the newest of its slot."""
        mixture = line.mixture
        n = 1 if mixture is None else len(mixture.components)
        decoder = self._c.decoder
        last, held = decoder.checks[line.slot].last, decoder.inboxes[line.slot].complete
        size = self._codec.layout.record_bytes
        records = [
            ffi.buffer(held[(last - n + 1 + i) % self._transfer_ids].record, size)[:]
            for i in range(n)
        ]
        payloads = np.frombuffer(b"".join(records), np.uint8).reshape(n, size)
        decoded = self._codec.decode(self._packing.unpack(payloads))
        covs, statuses = zip(*map(self._covariance, *decoded[1:]), strict=True)
        parts = [Gaussian.trusted(*one) for one in zip(decoded.mean, covs, strict=True)]
        status = max(statuses, key=SEVERITY.index)
        if mixture is None:
            line = replace(line, gaussian=parts[0], status=status)
        else:
            mixture = GaussianMixture(mixture.weights, parts)
            line = replace(line, gaussian=mixture.overall, mixture=mixture, status=status)
        self._newest[line.slot] = line
        return line

    def _covariance(self, cov: Array, number: int, is_covariance: bool) -> tuple[Array, Status]:
        """Return a covariance that is positive definite, and the status of its line."""
        status = Status(number)
        if not is_covariance:
            return _VAGUE, Status.OUT_OF_RANGE
        if self._codec.covariance.positive_definite or _is_definite(cov):
            return cov, status
        cov = nearest_covariance(cov)
        cov += np.diag(np.maximum(self._codec.resolution, REPAIRED * cov.diagonal()))
        return cov, Status.REPAIRED


def _is_definite(cov: Array) -> bool:
    """Return whether a (4, 4) matrix is numerically positive definite."""
    sigma = np.sqrt(cov.diagonal())
    return bool(sigma.all() and np.linalg.eigvalsh(cov / (sigma[:, None] * sigma))[0] > DEFINITE)


def _without_covariance(status: NDArray[np.int64]) -> NDArray[np.bool_]:
    return (status == Status.UNKNOWN) | (status == Status.OUT_OF_RANGE)
