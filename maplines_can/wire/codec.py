"""The one-call face of the wire: map lines to frames, frames to map lines, and both in bulk."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import floats, number_text
from ..errors import EncodeError, LayoutError
from ..gaussian import MOST_COV, Gaussian, asymmetric, indefinite, rounding_of
from ..line import Kind, MapLine, Slot, Status
from .covariance import CholeskyCode, CovarianceCode
from .message.channel import Channel
from .message.components import deficit, quantized_weights
from .message.layout import LONGEST_MS, PAGE_BYTES, STATE_SIGNALS, Layout, default_dbc_path
from .message.packing import Packing
from .message.reader import Batch, DecodedRecord, RecordReader
from .message.writer import RecordWriter
from .protection.e2e_state import E2EConfig
from .protection.secoc import Authenticator, Verifier
from .reasons import Reason
from .reception.decoder import Decoder

__all__ = ["CODES", "Codec", "Frame"]

#: How long a transfer may take where the DBC states no cycle time [ms].
DEFAULT_TIMEOUT_MS = 50.0
#: Covariance codes of the product, by the name that a DBC's attribute CovarianceCode gives.
CODES: Mapping[str, type[CovarianceCode]] = {CholeskyCode.name: CholeskyCode}
#: What a record says of its line besides the Gaussian, by the names of MapLine.
OF_THE_LINE = ("slot", "kind", "x_min", "x_max", "age", "status")


class Frame(NamedTuple):
    """A CAN frame, as any bus can send it."""

    can_id: int
    data: bytes
    is_fd: bool = False
    is_extended: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class _Record:
    """What goes into one record of a line."""

    line: MapLine
    gaussian: Gaussian
    index: int
    count: int
    weight: float
    cover: NDArray[np.float64]  #: (4, 4) what else the decoded covariance must cover


class Codec:
    """Map lines to CAN frames and back, after a DBC.

    Every factor, range and place is the DBC's. The guarantee, for every input
    that is not answered with Status.OUT_OF_RANGE: with S the covariance given,
    d the error of the decoded mean and S' the decoded covariance, S' is positive
    definite and S' - (S + d d^T) positive semidefinite. Who asks for Status.DIAGONAL
    gives S without its correlations, and the guarantee is for that: it does not
    cover the correlations, which is what sending sigmas alone loses.

    Args:
        layout: from ``Layout.from_dbc``; most callers use ``Codec.from_dbc``.
        authenticator: has the keys; with it the codec sends authenticated frames only, and
            its decoders accept no others. None for a bus without authentication.
        codes: covariance codes that the DBC may name, by name.

    Raises:
        LayoutError: there is an authenticator, and the DBC has no authenticated message.

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
        self.authenticator = authenticator
        if authenticator is not None and layout.secured is None:
            raise LayoutError(
                f"{layout.source} has no authenticated message (SecOCDataId), and classic CAN and "
                "plain CAN FD are not authenticated; take maplines-secoc.dbc, or no key"
            )
        packing = Packing(list(layout.signals.values()), layout.record_bytes)
        #: The code of the covariance that the DBC names, with what it guarantees.
        self.covariance = _covariance_code(layout, codes)
        self._writer = RecordWriter(layout, packing, self.covariance)
        self._reader = RecordReader(layout, packing, self.covariance)
        self._counters: Counter[Slot] = Counter()

    @classmethod
    def from_dbc(
        cls,
        path: str | Path | None = None,
        authenticator: Authenticator | None = None,
        codes: Mapping[str, type[CovarianceCode]] = CODES,
    ) -> Codec:
        """The codec of a DBC; without a path, of the project's own.

        That is ``maplines.dbc``, and with an authenticator ``maplines-secoc.dbc``.

        Raises:
            LayoutError: the DBC is missing or does not describe a map line.
        """
        if path is None and authenticator is not None:
            path = default_dbc_path("maplines-secoc.dbc")
        return cls(Layout.from_dbc(path), authenticator, codes)

    @property
    def can_ids(self) -> frozenset[int]:
        """CAN IDs of all lines, for filters."""
        return frozenset(can_id for can_id, _ in self.layout.page_of_id)

    @property
    def resolution(self) -> NDArray[np.float64]:
        """(4,) variances of the mean's own rounding, factor^2 / 12, in SI units squared."""
        return self.layout.resolution

    # -- many lines at once ---------------------------------------------------

    def encode_batch(
        self,
        means: ArrayLike,
        covs: ArrayLike | None = None,
        *,
        slot: ArrayLike = Slot.EGO_LEFT,
        counter: ArrayLike | None = None,
        kind: ArrayLike = Kind.UNKNOWN,
        x_min: ArrayLike = 0.0,
        x_max: ArrayLike = 80.0,
        age: ArrayLike = 0.0,
        status: ArrayLike | None = None,
        component_index: ArrayLike = 0,
        component_count: ArrayLike = 1,
        component_weight: ArrayLike = 1.0,
    ) -> NDArray[np.uint8]:
        """Records of many lines.

        What does not fit is covered and flagged in the record's status, never
        cut in silence: an indefinite covariance by the least definite one that
        covers it (REPAIRED), a value at the end of its range by a wider covariance
        (SATURATED); where even the widest would not do, OUT_OF_RANGE.

        Args:
            means: (N, 4) lines [m, rad, 1/m, 1/m^2].
            covs: (N, 4, 4), singular ones too; None to send means only.
            slot: (N,) or one for all, as all that follow.
            counter: counters; by default 0, 1, ...
            kind: what the lines are.
            x_min: where the cubics begin to hold [m].
            x_max: where they end to hold [m].
            age: time from the pose to the sending [s].
            status: FULL by default, UNKNOWN without covs; DIAGONAL sends the
                variances only.
            component_index: which part of a mixture.
            component_count: parts of the mixture.
            component_weight: weight of the part.

        Returns:
            (N, record bytes) uint8.

        Raises:
            ValueError: a shape is wrong, or a value is not finite, asymmetric, or a
                negative variance; the row is named.
            EncodeError: a value has no place on the wire, such as a slot that
                the DBC does not have.
        """
        mean, cov, broken = _checked(means, covs)
        n = len(mean)
        if status is None:
            status = Status.UNKNOWN if covs is None else Status.FULL
        elif covs is None and not np.isin(status, [Status.UNKNOWN, Status.OUT_OF_RANGE]).all():
            raise ValueError("covs must be given where status claims a covariance")
        rest: dict[str, ArrayLike] = {
            "slot": slot,
            "counter": np.arange(n) if counter is None else counter,
            "kind": kind,
            "x_min": x_min,
            "x_max": x_max,
            "age": age,
            "status": status,
            "component_index": component_index,
            "component_count": component_count,
            "component_weight": component_weight,
        }
        rest = {name: _numbers(name, values) for name, values in rest.items()}
        return self._writer.write(mean, cov, broken, rest)

    def decode_batch(self, payloads: ArrayLike, slot: ArrayLike = Slot.EGO_LEFT) -> Batch:
        """Read many records. Nothing in the bytes makes it raise.

        Args:
            payloads: (N, record bytes) uint8.
            slot: (N,) or one for all: whose data ID the checksums are salted with.

        Returns:
            The lines; rows that are not accepted hold what the bytes say.

        Raises:
            ValueError: the array has another shape or type.
        """
        payloads = np.asarray(payloads)
        if payloads.ndim != 2 or payloads.shape[1] != self.layout.record_bytes:
            raise ValueError(
                f"payloads must have shape (N, {self.layout.record_bytes}), got {payloads.shape}"
            )
        if payloads.dtype != np.uint8:
            raise ValueError(f"payloads must be uint8, got {payloads.dtype}")
        data_ids = self._writer.data_ids(_numbers("slot", slot), len(payloads))
        return self._reader.read(payloads, data_ids)

    # -- one line at a time ---------------------------------------------------

    def decode_one(self, payload: bytes, slot: Slot, t_ns: int | None = None) -> MapLine | Reason:
        """Read one record: as ``decode_batch`` to the last bit, without the cost of arrays.

        Args:
            payload: record bytes.
            slot: whose line it is.
            t_ns: when it was received [ns].

        Returns:
            The line, or why the record is not accepted. Of a part of a mixture this is the
            part's own Gaussian; see ``read_record``.
        """
        part = self.read_record(payload, slot, t_ns)
        return part if isinstance(part, Reason) else part.line

    def read_record(self, payload: bytes, slot: Slot, t_ns: int | None = None) -> DecodedRecord | Reason:
        """As ``decode_one``, with what the record says of the mixture that it is a part of."""
        channel = self.layout.channels.get(slot)
        if channel is None:
            raise EncodeError(f"{self.layout.source} has no message for slot {slot!r}")
        return self._reader.read_one(payload, slot, channel.data_id, t_ns)

    def encode(self, line: MapLine, *, fd: bool = False) -> list[Frame]:
        """The frames of one line, to be sent back to back; advances the slot's counter.

        Args:
            line: what to send.
            fd: one CAN FD frame instead of the pages of the classic message; with an
                authenticator an authenticated one.

        Raises:
            EncodeError: the DBC has no such message, or it is not authenticated.
        """
        return self.encode_lines([line], fd=fd)[0]

    def encode_lines(
        self,
        lines: Sequence[MapLine],
        *,
        fd: bool = False,
        counters: Mapping[Slot, int] | None = None,
    ) -> list[list[Frame]]:
        """The frames of each line; many at once cost hardly more than one.

        Args:
            lines: what to send.
            fd: see ``encode``.
            counters: of the first record of each slot, for a sender that may discard what it has
                encoded; None: the codec's own, which advance.
        """
        if not lines:
            return []
        split = [self._records(line) for line in lines]
        records = [record for line_records in split for record in line_records]
        given: list[int] = []
        taken: Counter[Slot] = Counter(self._counters if counters is None else counters)
        modulus = 2 ** self.layout["Counter"].length
        for record in records:
            given.append(taken[record.line.slot] % modulus)
            taken[record.line.slot] = (taken[record.line.slot] + 1) % modulus
        rest: dict[str, ArrayLike] = {
            name: [getattr(record.line, name) for record in records] for name in OF_THE_LINE
        }
        payloads = self._writer.write(
            np.array([record.gaussian.mean for record in records]),
            np.array([record.gaussian.cov for record in records]),
            np.zeros(len(records), dtype=bool),  # a Gaussian is definite from birth
            rest
            | {
                "counter": given,
                "component_index": [record.index for record in records],
                "component_count": [record.count for record in records],
                "component_weight": [record.weight for record in records],
            },
            np.array([record.cover for record in records]),
        )
        left = iter(payloads)
        frames = [
            [frame for _ in line_records for frame in self.frames(next(left), line.slot, fd=fd)]
            for line, line_records in zip(lines, split, strict=True)
        ]
        if counters is None:
            self._counters = taken
        return frames

    def encode_mixtures(
        self, weights: ArrayLike, means: ArrayLike, covs: ArrayLike, **rest: ArrayLike
    ) -> NDArray[np.uint8]:
        """Records of many mixtures; each part is covered, and so is the whole.

        The weights that are decoded are whole steps and add up to 1. The decoded
        mixture's covariance covers the true one's about the decoded mean: where
        quantized weights narrow it, the parts are widened.

        Args:
            weights: (N, k), each row of sum 1.
            means: (N, k, 4).
            covs: (N, k, 4, 4).
            rest: as for ``encode_batch``, (N,) or one for all; ``counter`` is that of the
                first part, by default 0, k, 2 k, ...

        Returns:
            (N, k, record bytes) uint8; ``decode_batch`` reads them part by part.
        """
        known = ("slot", "counter", "kind", "x_min", "x_max", "age", "status")
        if unknown := rest.keys() - set(known):
            raise TypeError(f"rest must be of {', '.join(known)}, got {', '.join(sorted(unknown))}")
        weights, means = floats(weights, "weights"), floats(means, "means")
        covs = floats(covs, "covs")
        if weights.ndim != 2:
            raise ValueError(f"weights must have shape (N, k), got {weights.shape}")
        n, k = weights.shape
        if means.shape != (n, k, 4) or covs.shape != (n, k, 4, 4):
            raise ValueError(
                f"means and covs must have shapes {(n, k, 4)} and {(n, k, 4, 4)}, as the weights, "
                f"got {means.shape} and {covs.shape}"
            )
        lawful = ((weights > 0) & (weights < 2)).all()
        if not lawful or not np.allclose(weights.sum(axis=1), 1, atol=1e-9):
            raise ValueError("weights must be positive and each row of sum 1")
        mean, cov, broken = _checked(means.reshape(-1, 4), covs.reshape(-1, 4, 4))
        rest = {name: _numbers(name, values) for name, values in rest.items()}
        decoded_weights, cover = self._cover(weights, means, covs)
        first = rest.pop("counter", np.arange(n) * k)
        flat = {name: np.repeat(np.broadcast_to(value, n), k) for name, value in rest.items()}
        defaults = {"slot": Slot.EGO_LEFT, "kind": Kind.UNKNOWN, "x_min": 0.0, "x_max": 80.0}
        defaults |= {"age": 0.0, "status": Status.FULL}
        payloads = self._writer.write(
            mean,
            cov,
            broken,
            defaults
            | flat
            | {
                "counter": (np.broadcast_to(first, n)[:, None] + np.arange(k)).ravel(),
                "component_index": np.tile(np.arange(k), n),
                "component_count": k,
                "component_weight": decoded_weights.ravel(),
            },
            np.repeat(cover, k, axis=0),
        )
        return payloads.reshape(n, k, -1)

    def _cover(
        self, weights: NDArray[np.float64], means: NDArray[np.float64], covs: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(N, k) weights as they will be decoded, and (N, 4, 4) what they leave uncovered."""
        steps = round(1 / self.layout["ComponentWeight"].factor)
        decoded = quantized_weights(weights, steps) / steps
        return decoded, deficit(weights, means, covs, decoded, self._writer.rounded(means))

    def _records(self, line: MapLine) -> list[_Record]:
        if line.mixture is None:
            return [_Record(line, line.gaussian, 0, 1, 1.0, np.zeros((4, 4)))]
        mixture, k = line.mixture, len(line.mixture.weights)
        weights, cover = self._cover(mixture.weights[None], mixture.means[None], mixture.covs[None])
        return [
            _Record(line, gaussian, i, k, float(weights[0, i]), cover[0])
            for i, gaussian in enumerate(mixture.components)
        ]

    def frames(self, payload: NDArray[np.uint8], slot: Slot, *, fd: bool = False) -> list[Frame]:
        """The frames that carry one record; authenticated ones have a freshness value each."""
        channel = self.layout.channels.get(slot)
        if self.authenticator is not None:
            return [self._secured_frame(payload.tobytes(), slot, channel, fd)]
        can_id = None if channel is None else channel.fd_can_id if fd else channel.can_id
        if channel is None or can_id is None:
            carrier = "CAN FD" if fd else "classic"
            raise EncodeError(f"{self.layout.source} has no {carrier} message for slot {slot!r}")
        data = payload.tobytes()
        if fd:
            padded = data.ljust(channel.fd_length, b"\0")
            return [Frame(can_id, padded, True, channel.fd_is_extended)]
        return [
            Frame(can_id, data[start : start + PAGE_BYTES], False, channel.is_extended)
            for start in range(0, len(data), PAGE_BYTES)
        ]

    def _secured_frame(self, record: bytes, slot: Slot, channel: Channel | None, fd: bool) -> Frame:
        form, authenticator = self.layout.secured, self.authenticator
        if not fd:
            raise EncodeError(
                "classic CAN is not authenticated; send CAN FD (fd=True), or without a key"
            )
        if not (channel and form and authenticator) or channel.secured_can_id is None:
            raise EncodeError(
                f"{self.layout.source} has no authenticated message for slot {slot!r}"
            )
        data = authenticator.secure(record, channel.secured_data_id, form)
        return Frame(channel.secured_can_id, data, True, channel.secured_is_extended)

    def verifier(self) -> Verifier | None:
        """What a receiver knows of freshness; None without an authenticator."""
        if self.authenticator is None or self.layout.secured is None:
            return None
        return Verifier(self.authenticator, self.layout.secured)

    def decoder(
        self,
        *,
        timeout_ms: float | None = None,
        cycle_ms: float | None = None,
        e2e: E2EConfig | None = None,
    ) -> Decoder:
        """A receiver's state.

        Args:
            timeout_ms: how long a transfer may take, and how long a sender that starts
                anew may be taken for an old one [ms]; by default half the DBC's longest
                cycle time, or 50 ms where it states none.
            cycle_ms: how often the lines of a slot come [ms], for the E2E state and for what
                is stale; by default the cycle time that the DBC states for it, or 100 ms.
            e2e: windows and bounds of the E2E state machines.

        Raises:
            ValueError: a time is 0 or less, or more than an hour; or ``e2e`` does not fit the
                DBC's counter.
        """
        channels = self.layout.channels
        if timeout_ms is None:
            cycles = [channel.cycle_ms for channel in channels.values()]
            timeout_ms = max(cycles) / 2 or DEFAULT_TIMEOUT_MS
        for name, value in (("timeout_ms", timeout_ms), ("cycle_ms", cycle_ms)):
            if value is not None and not 0 < value <= LONGEST_MS:
                raise ValueError(
                    f"{name} must be more than 0 ms and at most an hour ({LONGEST_MS} ms), "
                    f"got {number_text(value)}"
                )
        cycles_ns = {
            slot: int(1e6 * (cycle_ms or channel.cycle_ms or 2 * DEFAULT_TIMEOUT_MS))
            for slot, channel in channels.items()
        }
        counters = 2 ** self.layout["Counter"].length
        if e2e is None:
            e2e = E2EConfig(max_delta_counter=min(E2EConfig().max_delta_counter, counters // 4))
        elif e2e.max_delta_counter >= counters // 2:
            raise ValueError(
                f"max_delta_counter must be less than {counters // 2}, half of the counters of "
                f"{self.layout.source}, got {e2e.max_delta_counter}"
            )
        timeout_ns = int(timeout_ms * 1e6)
        return Decoder(self.layout, self._reader, self.verifier(), timeout_ns, cycles_ns, e2e)


def _covariance_code(layout: Layout, codes: Mapping[str, type[CovarianceCode]]) -> CovarianceCode:
    code = codes.get(layout.covariance_code)
    if code is None:
        raise LayoutError(
            f"{layout.source}: the covariance code {layout.covariance_code!r} is not known; there "
            f"are {', '.join(codes)}; for those of the study, pass "
            "codes=maplines_can.study.codes.CODES"
        )
    return code(layout)


def _checked(
    means: ArrayLike, covs: ArrayLike | None
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Means, covariances, and which of these are indefinite."""
    rounding = rounding_of(covs)
    mean = floats(means, "means")
    if mean.ndim != 2 or mean.shape[1] != len(STATE_SIGNALS):
        raise ValueError(f"means must have shape (N, 4), got {mean.shape}")
    n = len(mean)
    cov = np.zeros((n, 4, 4)) if covs is None else floats(covs, "covs")
    if cov.shape != (n, 4, 4):
        raise ValueError(f"covs must have shape ({n}, 4, 4), as the means, got {cov.shape}")
    _refuse("means must be finite", np.asarray(~np.isfinite(mean).all(axis=1)), mean)
    too_large = np.asarray(~(np.abs(cov) <= MOST_COV).all(axis=(1, 2)))  # or NaN
    _refuse("covs must be finite", too_large, cov)
    negative = (np.einsum("nii->ni", cov) < 0).any(axis=1)
    _refuse("covs must have variances of 0 or more", negative, cov)
    _refuse("covs must be symmetric", asymmetric(cov, rounding), cov)
    return mean, (cov + cov.transpose(0, 2, 1)) / 2, indefinite(cov, rounding)


def _numbers(name: str, values: ArrayLike) -> NDArray[Any]:
    """What goes with the lines, as an array; integers stay integers."""
    given = np.asarray(values)
    if given.dtype.kind in "Oc":  # such as integers beyond 64 bits
        given = floats(values, name)
    if name == "slot" and given.dtype.kind == "f":
        bad = ~((given >= 0) & (given <= max(Slot)))
        if bad.any():
            raise EncodeError(f"slot must be from 0 to {max(Slot)}, got {given[bad].flat[0]:g}")
    return given


def _refuse(what: str, bad: NDArray[np.bool_], rows: NDArray[np.float64]) -> None:
    if bad.any():
        i = int(bad.argmax())
        raise ValueError(f"{what}, but row {i} is {rows[i].tolist()}")
