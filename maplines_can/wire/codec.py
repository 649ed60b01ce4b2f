"""The one-call face of the wire: map lines to frames, frames to map lines, and both in bulk."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import EncodeError, LayoutError
from ..gaussian import Gaussian, asymmetric, indefinite, nearest_covariance
from ..line import VAGUE_SIGMA, Component, Kind, MapLine, Slot, Status
from .cholesky import STATE_SIGNALS, CholeskyCode
from .contract import fd_length
from .e2e import CRC_BYTES, record_crc, record_crc_one
from .layout import BURST, PAGE, PAGE_BYTES, Layout
from .packing import Packing
from .reassembly import Reason, Reassembler, Record

__all__ = ["Batch", "Codec", "Decoder", "Frame"]

#: Verdicts on a record, in the order of their numbers in ``Batch.verdict``.
VERDICTS = (None, Reason.MIXED, Reason.CRC, Reason.CONTENT)
#: How long a burst may take where the DBC states no cycle time [ms].
DEFAULT_TIMEOUT_MS = 100.0


_VAGUE = np.diag(np.square(VAGUE_SIGMA))


class Frame(NamedTuple):
    """A CAN frame, as any bus can send it."""

    can_id: int
    data: bytes
    is_fd: bool = False
    is_extended: bool = False


@dataclass(frozen=True, eq=False)
class Batch:
    """Many decoded records. Believe a row only where ``accepted`` is true."""

    mean: NDArray[np.float64]  #: (N, 4) in [m, rad, 1/m, 1/m^2]
    cov: NDArray[np.float64]  #: (N, 4, 4), positive definite in every row
    verdict: NDArray[np.int8]  #: (N,) 0 where accepted, else an index into VERDICTS
    status: NDArray[np.int64]  #: (N,) as ``Status``
    kind: NDArray[np.int64]  #: (N,) as ``Kind``
    x_min: NDArray[np.float64]  #: (N,) [m]
    x_max: NDArray[np.float64]  #: (N,) [m]
    age: NDArray[np.float64]  #: (N,) time from the pose to the sending [s]
    component_index: NDArray[np.int64]  #: (N,)
    component_count: NDArray[np.int64]  #: (N,)
    component_weight: NDArray[np.float64]  #: (N,)
    counter: NDArray[np.int64]  #: (N,)

    @property
    def accepted(self) -> NDArray[np.bool_]:
        """(N,) records whose pages belong together, with a good checksum and lawful content."""
        return self.verdict == 0

    @property
    def rejects(self) -> Counter[Reason]:
        """Records that are not accepted, by reason."""
        numbers = np.bincount(self.verdict, minlength=len(VERDICTS))
        pairs = zip(VERDICTS, numbers.tolist(), strict=True)
        return Counter({reason: n for reason, n in pairs if reason and n})


class Codec:
    """Map lines to CAN frames and back, after a DBC.

    Every factor, range and place is the DBC's. The guarantee, for every input
    that is not answered with Status.OUT_OF_RANGE: with S the covariance given,
    d the error of the decoded mean and S' the decoded covariance, S' is positive
    definite and S' - (S + d d^T) positive semidefinite.

    Args:
        layout: from ``Layout.from_dbc``; most callers use ``Codec.from_dbc``.

    >>> codec = Codec.from_dbc()
    >>> payload = codec.encode_batch([[1.75, 0, 0, 0]], [np.diag([0.01, 1e-4, 1e-8, 1e-12])])
    >>> payload.shape, payload.dtype
    ((1, 32), dtype('uint8'))
    >>> batch = codec.decode_batch(payload)
    >>> batch.accepted, batch.mean[0, 0], np.sqrt(batch.cov[0, 0, 0]).round(3)
    (array([ True]), np.float64(1.75), np.float64(0.1))
    """

    def __init__(self, layout: Layout) -> None:
        if layout.covariance_code != "Cholesky":
            raise LayoutError(
                f"{layout.source}: the covariance code {layout.covariance_code!r} is not known; "
                "there is 'Cholesky'"
            )
        self.layout = layout
        self._mean = [layout[name] for name in STATE_SIGNALS]
        self._factor = np.array([field.factor for field in self._mean])
        self._resolution = self._factor**2 / 12
        self._covariance = CholeskyCode(layout)
        self._packing = Packing(list(layout.fields.values()), layout.record_bytes)
        self._crc_offset = layout["Crc"].start // 8
        crc = layout["Crc"]
        if crc.length != 8 * CRC_BYTES or crc.start % 8 or crc.big_endian:
            raise LayoutError(f"{layout.source}: Crc must be 16 bits, Intel, on a byte boundary")
        for name in ("Counter", "Status", "Kind", "XMin", "XMax", "Age"):
            layout[name]
        for name in ("ComponentIndex", "ComponentCount", "ComponentWeight"):
            layout[name]
        if layout["Counter"].length < layout[f"{BURST}0"].length:
            raise LayoutError(f"{layout.source}: Counter must be as wide as Burst or wider")
        self._burst_mask = 2 ** layout[f"{BURST}0"].length - 1
        self._counters: Counter[Slot] = Counter()

    @classmethod
    def from_dbc(cls, path: str | Path | None = None) -> Codec:
        """The codec of a DBC; without a path, of the project's own.

        Raises:
            LayoutError: the DBC is missing or does not describe a map line.
        """
        return cls(Layout.from_dbc(path))

    @property
    def can_ids(self) -> frozenset[int]:
        """CAN IDs of all lines, for filters."""
        return frozenset(can_id for can_id, _ in self.layout.page_of_id)

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
        mean, cov = _checked(means, covs)
        n = len(mean)
        wish = np.full(n, Status.UNKNOWN if covs is None else Status.FULL, dtype=np.int64)
        if status is not None:
            wish[:] = self._whole("Status", status, n, max(Status))
        raw = {
            "Counter": self._whole("Counter", np.arange(n) if counter is None else counter, n),
            "Kind": self._whole("Kind", kind, n, max(Kind)),
            "ComponentIndex": self._whole("ComponentIndex", component_index, n),
            "ComponentCount": self._whole("ComponentCount", component_count, n),
        }
        clipped = self._put_extent(raw, x_min, x_max, age, component_weight, n)

        decoded = np.empty_like(mean)
        for i, field in enumerate(self._mean):
            nearest = field.raw(mean[:, i])
            limited = field.limited(nearest)
            clipped |= nearest != limited
            raw[field.name] = limited.astype(np.int64)
            decoded[:, i] = field.physical(limited)
        with np.errstate(over="ignore"):
            d = mean - decoded
            error = cov + d[:, :, None] * d[:, None, :]

        broken = indefinite(cov)
        if broken.any():
            error[broken] += nearest_covariance(cov[broken]) - cov[broken]
        alone = wish == Status.DIAGONAL
        if alone.any():
            variances = np.einsum("nii->ni", cov[alone])
            error[alone] += np.einsum("ni,ij->nij", variances, np.eye(4)) - cov[alone]
            broken &= ~alone
        coded = self._covariance.encode(error, self._resolution)
        raw |= coded.raw

        bare = (wish == Status.UNKNOWN) | (wish == Status.OUT_OF_RANGE)
        if bare.any():
            for name, value in self._covariance.widest().items():
                raw[name][bare] = value
        verdict = np.where(broken & (wish == Status.FULL), Status.REPAIRED, wish)
        verdict[(clipped | coded.saturated) & ~bare] = Status.SATURATED
        verdict[np.where(bare, self._is_far(d), ~coded.covered)] = Status.OUT_OF_RANGE
        raw["Status"] = np.where(wish == Status.OUT_OF_RANGE, wish, verdict)
        return self._sealed(raw, self._data_ids(slot, n), n)

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
        n = len(payloads)
        raw = self._packing.unpack(payloads)
        mean = np.empty((n, len(self._mean)))
        for i, field in enumerate(self._mean):
            mean[:, i] = field.physical(raw[field.name])
        cov = self._covariance.decode(raw)
        status = raw["Status"]
        vague = (status == Status.UNKNOWN) | (status == Status.OUT_OF_RANGE)
        if vague.any():
            cov[vague] = _VAGUE

        physical = {
            name: self.layout[name].physical(raw[name])
            for name in ("XMin", "XMax", "Age", "ComponentCount", "ComponentWeight")
        }
        index, count = raw["ComponentIndex"], physical["ComponentCount"].astype(np.int64)
        burst = raw["Counter"] & self._burst_mask
        verdict = np.zeros(n, dtype=np.int8)
        unlawful = (status > max(Status)) | (raw["Kind"] > max(Kind)) | (index >= count)
        unlawful |= (physical["ComponentWeight"] <= 0) | (physical["ComponentWeight"] > 1)
        verdict[unlawful] = VERDICTS.index(Reason.CONTENT)
        crc = record_crc(payloads, self._data_ids(slot, n), self._crc_offset)
        verdict[raw["Crc"] != crc] = VERDICTS.index(Reason.CRC)
        for page in range(self.layout.pages):
            apart = (raw[f"{PAGE}{page}"] != page) | (raw[f"{BURST}{page}"] != burst)
            verdict[apart] = VERDICTS.index(Reason.MIXED)
        return Batch(
            mean=mean,
            cov=cov,
            verdict=verdict,
            status=status,
            kind=raw["Kind"],
            x_min=physical["XMin"],
            x_max=physical["XMax"],
            age=physical["Age"] / 1000,
            component_index=index,
            component_count=count,
            component_weight=physical["ComponentWeight"],
            counter=raw["Counter"],
        )

    # -- one line at a time ---------------------------------------------------

    def decode_one(self, payload: bytes, slot: Slot, t_ns: int | None = None) -> MapLine | Reason:
        """Read one record: as ``decode_batch`` to the last bit, without the cost of arrays.

        Args:
            payload: record bytes.
            slot: whose line it is.
            t_ns: when it was received [ns].

        Returns:
            The line, or why the record is not accepted.
        """
        raw, fields = self._packing.unpack_one(payload), self.layout.fields
        burst = raw["Counter"] & self._burst_mask
        for page in range(self.layout.pages):
            if raw[f"{PAGE}{page}"] != page or raw[f"{BURST}{page}"] != burst:
                return Reason.MIXED
        data_id = self.layout.channels[slot].data_id
        if raw["Crc"] != record_crc_one(payload, data_id, self._crc_offset):
            return Reason.CRC
        weight = fields["ComponentWeight"].physical_one(raw["ComponentWeight"])
        index = raw["ComponentIndex"]
        count = int(fields["ComponentCount"].physical_one(raw["ComponentCount"]))
        if raw["Status"] > max(Status) or raw["Kind"] > max(Kind):
            return Reason.CONTENT
        if index >= count or not 0 < weight <= 1:
            return Reason.CONTENT
        mean = np.array([field.physical_one(raw[field.name]) for field in self._mean])
        bare = raw["Status"] in (Status.UNKNOWN, Status.OUT_OF_RANGE)
        cov = _VAGUE.copy() if bare else self._covariance.decode_one(raw)
        x_min, x_max = (fields[name].physical_one(raw[name]) for name in ("XMin", "XMax"))
        return MapLine(
            slot=slot,
            gaussian=Gaussian.trusted(mean, cov),
            kind=Kind(raw["Kind"]),
            x_min=min(x_min, x_max),
            x_max=x_max,
            age=fields["Age"].physical_one(raw["Age"]) / 1000,
            status=Status(raw["Status"]),
            component=Component(index, count, weight),
            t_ns=t_ns,
        )

    def counter_of(self, payload: bytes) -> int:
        """The counter of a record."""
        return self._packing.unpack_one(payload)["Counter"]

    def encode(self, line: MapLine, *, fd: bool = False) -> list[Frame]:
        """The frames of one line, to be sent back to back; advances the slot's counter.

        Args:
            line: what to send.
            fd: one CAN FD frame instead of the pages of the classic message.

        Raises:
            EncodeError: the DBC has no such message.
        """
        return self.encode_lines([line], fd=fd)[0]

    def encode_lines(self, lines: Sequence[MapLine], *, fd: bool = False) -> list[list[Frame]]:
        """The frames of each line; many at once cost hardly more than one."""
        if not lines:
            return []
        counters = []
        taken = self._counters.copy()
        for line in lines:
            counters.append(taken[line.slot])
            taken[line.slot] = (taken[line.slot] + 1) % 2 ** self.layout["Counter"].length
        payloads = self.encode_batch(
            np.array([line.gaussian.mean for line in lines]),
            np.array([line.gaussian.cov for line in lines]),
            slot=[line.slot for line in lines],
            counter=counters,
            kind=[line.kind for line in lines],
            x_min=[line.x_min for line in lines],
            x_max=[line.x_max for line in lines],
            age=[line.age for line in lines],
            status=[line.status for line in lines],
            component_index=[line.component.index for line in lines],
            component_count=[line.component.count for line in lines],
            component_weight=[line.component.weight for line in lines],
        )
        frames = [
            self.frames(payload, line.slot, fd=fd)
            for payload, line in zip(payloads, lines, strict=True)
        ]
        self._counters = taken
        return frames

    def frames(self, payload: NDArray[np.uint8], slot: Slot, *, fd: bool = False) -> list[Frame]:
        """The frames that carry one record."""
        channel = self.layout.channels.get(slot)
        can_id = None if channel is None else channel.fd_can_id if fd else channel.can_id
        if channel is None or can_id is None:
            carrier = "CAN FD" if fd else "classic"
            raise EncodeError(f"{self.layout.source} has no {carrier} message for slot {slot!r}")
        data = payload.tobytes()
        if fd:
            return [
                Frame(can_id, data.ljust(fd_length(len(data)), b"\0"), True, channel.is_extended)
            ]
        return [
            Frame(can_id, data[start : start + PAGE_BYTES], False, channel.is_extended)
            for start in range(0, len(data), PAGE_BYTES)
        ]

    def decoder(self, *, timeout_ms: float | None = None) -> Decoder:
        """A receiver's state.

        Args:
            timeout_ms: how long a burst may take [ms]; by default the DBC's
                longest cycle time, or 100 ms where it states none.
        """
        if timeout_ms is None:
            cycles = [channel.cycle_ms for channel in self.layout.channels.values()]
            timeout_ms = max(cycles) or DEFAULT_TIMEOUT_MS
        if not timeout_ms > 0:
            raise ValueError(f"timeout_ms must be more than 0 ms, got {timeout_ms!r}")
        return Decoder(self, int(timeout_ms * 1e6))

    # -- parts ----------------------------------------------------------------

    def _put_extent(
        self,
        raw: dict[str, NDArray[np.int64]],
        x_min: ArrayLike,
        x_max: ArrayLike,
        age: ArrayLike,
        weight: ArrayLike,
        n: int,
    ) -> NDArray[np.bool_]:
        """Raw extents, rounded towards the car, age and weight; which extents claim too much."""
        clipped = np.zeros(n, dtype=bool)
        slack = 1e-9
        for name, value, inwards, sign in (
            ("XMin", x_min, np.ceil, 1),
            ("XMax", x_max, np.floor, -1),
        ):
            field = self.layout[name]
            steps = (_finite(name, value, n) - field.offset) / field.factor
            wanted = inwards(steps - sign * slack)
            limited = field.limited(wanted)
            clipped |= sign * (wanted - limited) > 0
            raw[name] = limited.astype(np.int64)
        field = self.layout["Age"]
        raw["Age"] = field.limited(field.raw(1000 * _finite("age", age, n))).astype(np.int64)
        field = self.layout["ComponentWeight"]
        weight = _finite("component_weight", weight, n)
        if ((weight <= 0) | (weight > 1)).any():
            raise EncodeError(f"component_weight must be in (0, 1], got {weight.min():g}")
        raw["ComponentWeight"] = field.limited(field.raw(weight)).astype(np.int64)
        return clipped

    def _is_far(self, d: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(N,) means that are cut by more than their rounding."""
        return (np.abs(d) > 0.51 * np.abs(self._factor)).any(axis=1)

    def _whole(
        self, name: str, value: ArrayLike, n: int, most: int | None = None
    ) -> NDArray[np.int64]:
        """(n,) raw values of a signal that counts or names; most is the greatest lawful value."""
        field = self.layout[name]
        values = np.broadcast_to(np.asarray(value), n)
        raw = field.raw(values)
        if name == "Counter":
            raw = raw % 2**field.length
        low, high = field.physical_range
        high = high if most is None else min(high, most)
        bad = (raw != field.limited(raw)) | (field.physical(raw) > high)
        bad |= field.physical(raw) != values if name != "Counter" else False
        if bad.any():
            raise EncodeError(
                f"signal {name}: {values[bad][0]!r} is not a whole number from {low:g} to {high:g}"
            )
        return raw.astype(np.int64)

    def _data_ids(self, slot: ArrayLike, n: int) -> NDArray[np.uint16]:
        slots = np.broadcast_to(np.asarray(slot, dtype=np.int64), n)
        table = np.full(max(Slot) + 1, -1)
        for known, channel in self.layout.channels.items():
            table[known] = channel.data_id
        bad = (slots < 0) | (slots > max(Slot))
        bad |= table[slots.clip(0, max(Slot))] < 0
        if bad.any():
            raise EncodeError(f"{self.layout.source} has no message for slot {slots[bad][0]}")
        return table[slots].astype(np.uint16)

    def _sealed(
        self, raw: dict[str, NDArray[np.int64]], data_ids: NDArray[np.uint16], n: int
    ) -> NDArray[np.uint8]:
        for page in range(self.layout.pages):
            raw[f"{PAGE}{page}"] = np.full(n, page, dtype=np.int64)
            raw[f"{BURST}{page}"] = raw["Counter"]
        payloads = self._packing.pack(raw, n)
        crc = record_crc(payloads, data_ids, self._crc_offset)
        payloads[:, self._crc_offset] = crc & 0xFF
        payloads[:, self._crc_offset + 1] = crc >> 8
        return payloads


class Decoder:
    """A receiver's state: frames in, map lines out, everything else counted.

    Made by ``Codec.decoder``. At any time
    ``frames == line_frames + sum(counts.values()) + pending``.
    """

    def __init__(self, codec: Codec, timeout_ns: int) -> None:
        self._codec = codec
        self._reassembler = Reassembler(codec.layout, timeout_ns)
        self._counters: dict[Slot, int] = {}
        self.frames = 0  #: frames fed
        self.lines = 0  #: lines delivered
        self.line_frames = 0  #: frames of the lines delivered
        self.lost = 0  #: lines missing between those delivered, by their counters

    @property
    def counts(self) -> Counter[Reason]:
        """Dropped frames by reason."""
        return self._reassembler.counts

    @property
    def pending(self) -> int:
        """Frames held for bursts that are not complete yet."""
        return self._reassembler.pending

    def feed(
        self, can_id: int, data: bytes, t_ns: int, *, is_extended: bool = False
    ) -> MapLine | Reason:
        """Take a frame. Whatever it is, this does not raise.

        Args:
            can_id: its ID.
            data: its payload.
            t_ns: when it was received, on any clock that goes on [ns].
            is_extended: it has a 29-bit ID.

        Returns:
            The line that it completes, or why there is none (PENDING: not yet).
        """
        self.frames += 1
        record = self._reassembler.feed(can_id, data, t_ns, is_extended)
        if isinstance(record, Reason):
            return record
        return self._read(record)

    def expire(self, t_ns: int) -> None:
        """Give up bursts that are not complete by ``t_ns`` [ns] less the time-out."""
        self._reassembler.expire(t_ns)

    def _read(self, record: Record) -> MapLine | Reason:
        line = self._codec.decode_one(record.payload, record.slot, record.t_ns)
        if isinstance(line, Reason):
            self.counts[line] += record.frames
            return line
        counter = self._codec.counter_of(record.payload)
        modulus = 2 ** self._codec.layout["Counter"].length
        gap = (counter - self._counters.get(record.slot, counter - 1)) % modulus
        if 0 < gap <= modulus // 2:  # else the sender has started anew
            self.lost += gap - 1
        self._counters[record.slot] = counter
        self.lines += 1
        self.line_frames += record.frames
        return line


def _checked(
    means: ArrayLike, covs: ArrayLike | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    mean = np.asarray(means, dtype=float)
    if mean.ndim != 2 or mean.shape[1] != len(STATE_SIGNALS):
        raise ValueError(f"means must have shape (N, 4), got {mean.shape}")
    n = len(mean)
    cov = np.zeros((n, 4, 4)) if covs is None else np.asarray(covs, dtype=float)
    if cov.shape != (n, 4, 4):
        raise ValueError(f"covs must have shape ({n}, 4, 4), as the means, got {cov.shape}")
    diagonal = np.einsum("nii->ni", cov)
    for what, bad in (
        ("means must be finite", ~np.isfinite(mean).all(axis=1)),
        ("covs must be finite", ~np.isfinite(cov).all(axis=(1, 2))),
        ("covs must have variances of 0 or more", (diagonal < 0).any(axis=1)),
        ("covs must be symmetric", asymmetric(cov)),
    ):
        if bad.any():
            i = int(bad.argmax())
            value = mean[i] if "means" in what else cov[i].tolist()
            raise ValueError(f"{what}, but row {i} is {value}")
    return mean, cov


def _finite(name: str, value: ArrayLike, n: int) -> NDArray[np.float64]:
    values = np.broadcast_to(np.asarray(value, dtype=float), n)
    if not np.isfinite(values).all():
        raise EncodeError(f"{name} must be finite, got {values[~np.isfinite(values)][0]}")
    return values
