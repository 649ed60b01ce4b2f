"""Lines to records: everything is put where the DBC says, and nothing is cut in silence."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...errors import EncodeError
from ...gaussian import nearest_covariance
from ...line import Kind, Slot, Status
from ..covariance import CovarianceCode
from ..protection.e2e import CRC_BYTES, record_crc, record_crc_one
from .layout import PAGE, STATE_SIGNALS, TRANSFER_ID, Layout
from .packing import Packing

__all__ = ["RecordWriter"]

#: Up to so many records are packed one by one: below, arrays cost more than they save.
FEW = 8


class RecordWriter:
    """Writes records of a layout."""

    def __init__(self, layout: Layout, packing: Packing, covariance: CovarianceCode) -> None:
        self.layout = layout
        self._mean = [layout[name] for name in STATE_SIGNALS]
        self._factor = np.array([signal.factor for signal in self._mean])
        self._covariance = covariance
        self._packing = packing
        self._crc_offset = layout.crc_offset

    def write(
        self,
        mean: NDArray[np.float64],
        cov: NDArray[np.float64],
        broken: NDArray[np.bool_],
        rest: Mapping[str, ArrayLike],
        cover: NDArray[np.float64] | None = None,
    ) -> NDArray[np.uint8]:
        """(n, record bytes) records of checked Gaussians.

        Args:
            mean: (n, 4).
            cov: (n, 4, 4).
            broken: (n,) covariances that are indefinite.
            rest: what else a record says, (n,) or one for all: slot, counter, kind, x_min,
                x_max, age, status, component_index, component_count, component_weight.
            cover: (n, 4, 4) what the decoded covariance must cover besides its own.
        """
        n = len(mean)
        data_ids = self.data_ids(rest["slot"], n)
        wish = self._whole("Status", rest["status"], n, max(Status))
        raw = {
            "Counter": self._whole("Counter", rest["counter"], n),
            "Kind": self._whole("Kind", rest["kind"], n, max(Kind)),
            "ComponentIndex": self._whole("ComponentIndex", rest["component_index"], n),
            "ComponentCount": self._whole("ComponentCount", rest["component_count"], n),
        }
        index, count = (np.broadcast_to(rest[f"component_{key}"], n) for key in ("index", "count"))
        if (index >= count).any():
            i = int((index >= count).argmax())
            raise EncodeError(
                f"component_index must be below component_count, got {index[i]} of {count[i]}"
            )
        clipped = self._put_extent(raw, rest, n)
        wish = self._sayable(wish)
        self._put_gaussian(raw, mean, cov, wish, clipped, broken, cover)
        return self._sealed(raw, data_ids, n)

    def _sayable(self, wish: NDArray[np.int64]) -> NDArray[np.int64]:
        """(n,) the most that the covariance code can say of what is wished."""
        most = self._covariance.status
        if most == Status.FULL:
            return wish
        bare = (wish == Status.UNKNOWN) | (wish == Status.OUT_OF_RANGE)
        return np.where(bare, wish, most)

    def rounded(self, mean: NDArray[np.float64]) -> NDArray[np.float64]:
        """(..., 4) means as they will be decoded."""
        columns = zip(self._mean, np.moveaxis(mean, -1, 0), strict=True)
        return np.stack([f.physical(f.limited(f.raw(x))) for f, x in columns], axis=-1)

    def _put_gaussian(
        self,
        raw: dict[str, NDArray[np.int64]],
        mean: NDArray[np.float64],
        cov: NDArray[np.float64],
        wish: NDArray[np.int64],
        clipped: NDArray[np.bool_],
        broken: NDArray[np.bool_],
        cover: NDArray[np.float64] | None,
    ) -> None:
        """Raw mean, covariance and status.

        Args:
            raw: is added to.
            mean: (n, 4).
            cov: (n, 4, 4).
            wish: (n,) status that the caller asks for.
            clipped: (n,) rows that are saturated already; is added to.
            broken: (n,) covariances that are indefinite.
            cover: (n, 4, 4) what else is to be covered.
        """
        decoded = np.empty_like(mean)
        for i, signal in enumerate(self._mean):
            nearest = signal.raw(mean[:, i])
            limited = signal.limited(nearest)
            clipped |= nearest != limited
            raw[signal.name] = limited.astype(np.int64)
            decoded[:, i] = signal.physical(limited)
        with np.errstate(over="ignore"):
            d = mean - decoded
            error = cov + d[:, :, None] * d[:, None, :]
        if broken.any():
            error[broken] += nearest_covariance(cov[broken]) - cov[broken]
        alone = wish == Status.DIAGONAL
        if alone.any():
            variances = np.einsum("nii->ni", cov[alone])
            error[alone] += np.einsum("ni,ij->nij", variances, np.eye(4)) - cov[alone]
            broken = broken & ~alone
        if cover is not None:
            error += cover
        coded = self._covariance.encode(error, self.layout.resolution)
        raw |= coded.raw

        bare = (wish == Status.UNKNOWN) | (wish == Status.OUT_OF_RANGE)
        if bare.any():
            for name, value in self._covariance.widest().items():
                raw[name][bare] = value
        met_an_end = (clipped | coded.saturated) & (wish == Status.FULL)
        status = np.where(met_an_end, Status.SATURATED, wish)
        # A repaired matrix is singular, so it is saturated as a rule; the repair says more.
        status[(broken | (wish == Status.REPAIRED)) & ~bare] = Status.REPAIRED
        # A mean that is cut by more than its rounding, with nothing to cover it.
        far = (np.abs(d) > 0.51 * np.abs(self._factor)).any(axis=1)
        status[np.where(bare, far, ~coded.covered)] = Status.OUT_OF_RANGE
        raw["Status"] = np.where(wish == Status.OUT_OF_RANGE, wish, status)

    def _put_extent(
        self,
        raw: dict[str, NDArray[np.int64]],
        rest: Mapping[str, ArrayLike],
        n: int,
    ) -> NDArray[np.bool_]:
        """Raw extents, rounded inwards, age and weight; which extents claim too much."""
        clipped = np.zeros(n, dtype=bool)
        slack = 1e-9
        ends = (("XMin", "x_min", np.ceil, 1), ("XMax", "x_max", np.floor, -1))
        for name, key, inwards, sign in ends:
            signal = self.layout[name]
            steps = (_finite(rest, key, n) - signal.offset) / signal.factor
            wanted = inwards(steps - sign * slack)
            limited = signal.limited(wanted)
            clipped |= sign * (wanted - limited) > 0
            raw[name] = limited.astype(np.int64)
        if (_finite(rest, "x_min", n) > _finite(rest, "x_max", n)).any():
            raise EncodeError("x_min must be x_max or less")
        signal, age = self.layout["Age"], 1000 * _finite(rest, "age", n)
        if (age < 0).any():
            raise EncodeError(f"age must be 0 s or more, got {age.min() / 1000:g}")
        steps = np.ceil((age - signal.offset) / signal.factor - slack)  # never younger than it is
        raw["Age"] = signal.limited(steps).astype(np.int64)
        signal = self.layout["ComponentWeight"]
        weight = _finite(rest, "component_weight", n)
        if ((weight <= 0) | (weight > 1)).any():
            raise EncodeError(f"component_weight must be in (0, 1], got {weight.min():g}")
        raw["ComponentWeight"] = signal.limited(signal.raw(weight)).astype(np.int64)
        return clipped

    def _whole(
        self, name: str, value: ArrayLike, n: int, most: int | None = None
    ) -> NDArray[np.int64]:
        """(n,) raw values of a signal that counts or names; most is the greatest lawful value."""
        signal = self.layout[name]
        values = np.broadcast_to(np.asarray(value), n)
        if name == "Counter":
            values = values % 2**signal.length
        raw = signal.raw(values)
        low, high = signal.physical_range
        high = high if most is None else min(high, most)
        bad = (raw != signal.limited(raw)) | (signal.physical(raw) > high)
        bad |= signal.physical(raw) != values
        if bad.any():
            raise EncodeError(
                f"signal {name}: {values[bad][0]!r} is not a whole number from {low:g} to {high:g}"
            )
        return raw.astype(np.int64)

    def data_ids(self, slot: ArrayLike, n: int) -> NDArray[np.uint16]:
        """(n,) data IDs of slots."""
        given = np.broadcast_to(np.asarray(slot), n)
        slots = given.astype(np.int64)
        table = np.full(max(Slot) + 1, -1)
        for known, channel in self.layout.channels.items():
            table[known] = channel.data_id
        bad = (slots < 0) | (slots > max(Slot)) | (slots != given)
        bad |= table[slots.clip(0, max(Slot))] < 0
        if bad.any():
            raise EncodeError(f"{self.layout.source} has no message for slot {given[bad][0]}")
        return table[slots].astype(np.uint16)

    def _sealed(
        self, raw: dict[str, NDArray[np.int64]], data_ids: NDArray[np.uint16], n: int
    ) -> NDArray[np.uint8]:
        for page in range(self.layout.pages):
            raw[f"{PAGE}{page}"] = np.full(n, page, dtype=np.int64)
            raw[f"{TRANSFER_ID}{page}"] = raw["Counter"]
        if n <= FEW:  # not worth the arrays
            rows = zip(*(values.tolist() for values in raw.values()), strict=True)
            records = [
                self._sealed_one(dict(zip(raw, row, strict=True)), data_id)
                for row, data_id in zip(rows, data_ids.tolist(), strict=True)
            ]
            joined = np.frombuffer(b"".join(records), dtype=np.uint8)
            return joined.reshape(n, self.layout.record_bytes).copy()
        payloads = self._packing.pack(raw, n)
        crc = record_crc(payloads, data_ids, self._crc_offset)
        payloads[:, self._crc_offset] = crc & 0xFF
        payloads[:, self._crc_offset + 1] = crc >> 8
        return payloads

    def _sealed_one(self, raw: dict[str, int], data_id: int) -> bytes:
        payload = self._packing.pack_one(raw)
        crc = record_crc_one(payload, data_id, self._crc_offset).to_bytes(CRC_BYTES, "little")
        return payload[: self._crc_offset] + crc + payload[self._crc_offset + CRC_BYTES :]


def _finite(rest: Mapping[str, ArrayLike], key: str, n: int) -> NDArray[np.float64]:
    values = np.broadcast_to(np.asarray(rest[key], dtype=float), n)
    if not np.isfinite(values).all():
        raise EncodeError(f"{key} must be finite, got {values[~np.isfinite(values)][0]}")
    return values
