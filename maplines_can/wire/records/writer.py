"""Writer of records: each value at its bits in the DBC, and no value is clipped silently."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...values.errors import EncodeError
from ...values.linalg import nearest_covariance
from ...values.line import Kind, MapLine, Status
from ..covariance import CovarianceCode
from ..covariance.nearest_line import nearest_line, slope_error
from ..layout.attributes import RecordAttributes
from ..layout.message_layout import Layout
from ..layout.signals import PARAMETER_SIGNALS, Signal
from ..layout.validation import CheckedGaussians
from .packer import RecordPacker

#: Least range of a line that is sent instead of one that exceeds the message [m].
MIN_RANGE = 1.0
#: Tolerance for the floating-point error of the division before directed rounding [steps].
SLACK = 1e-9


class _Sent(NamedTuple):
    """Means and valid ranges of n lines, as they are sent."""

    raw: dict[str, NDArray[np.int64]]  #: (n,) by signal
    clipped: NDArray[np.bool_]  #: (n,) lines whose means exceed the signals
    cut: NDArray[np.bool_]  #: (n,) lines whose ranges exceed the signals
    outside: NDArray[np.bool_]  #: (n,) lines of whose ranges no part can be stated


class RecordWriter:
    """Writer of complete records, with the packer of its signals and its covariance code."""

    def __init__(self, layout: Layout, packer: RecordPacker, covariance: CovarianceCode) -> None:
        self.layout = layout
        self._mean = [layout[name] for name in PARAMETER_SIGNALS]
        self._factor = np.array([signal.factor for signal in self._mean])
        self._covariance = covariance
        self._packer = packer

    @np.errstate(over="ignore", invalid="ignore")  # the status reports what does not fit
    def write(
        self,
        gaussians: CheckedGaussians,
        attributes: RecordAttributes,
        cover: NDArray[np.float64] | None = None,
    ) -> NDArray[np.uint8]:
        """Return the (N, record bytes) records of Gaussians.

        ``cover`` is (N, 4, 4): extra covariance added to the covered target.

        Raises:
            EncodeError: an attribute cannot be encoded, such as a slot that the DBC does not have.
        """
        n = len(gaussians.mean)
        data_ids = self.layout.data_ids(attributes.slot, n)
        status = Status.FULL if attributes.status is None else attributes.status
        requested = self._integers("Status", status, n, max(Status))
        counter = np.arange(n) if attributes.counter is None else attributes.counter
        raw = {
            "Counter": self._integers("Counter", counter, n),
            "Kind": self._integers("Kind", attributes.kind, n, max(Kind)),
            "ComponentIndex": self._integers("ComponentIndex", attributes.component_index, n),
            "ComponentCount": self._integers("ComponentCount", attributes.component_count, n),
        }
        index = np.broadcast_to(np.asarray(attributes.component_index), n)
        count = np.broadcast_to(np.asarray(attributes.component_count), n)
        if (index >= count).any():
            i = int((index >= count).argmax())
            raise EncodeError(
                f"component_index must be below component_count, got {index[i]} of {count[i]}"
            )
        requested = self._supported(requested)
        x_range = np.column_stack(
            [_finite("x_min", attributes.x_min, n), _finite("x_max", attributes.x_max, n)]
        )
        sent = self._sent(gaussians.mean, x_range, (requested == Status.FULL) & (count == 1))
        raw |= sent.raw
        self._put_age_and_weight(raw, attributes, n)
        self._put_covariance(raw, gaussians, sent, requested, cover)
        raw["Status"] = np.where(sent.outside, Status.OUT_OF_RANGE, raw["Status"])
        return self._packer.pack(raw, data_ids)

    @np.errstate(over="ignore", invalid="ignore")
    def decoded_mean(self, mean: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (..., 4) means that a receiver decodes."""
        columns = zip(self._mean, np.moveaxis(mean, -1, 0), strict=True)
        return np.stack([s.physical(s.limited(s.raw(x))) for s, x in columns], axis=-1)

    def raw_mean_and_range(self, line: MapLine) -> dict[str, int] | None:
        """Return the raw values of the mean and the valid range of a line, as ``write`` sends them.

        None if a value is clipped, or the range cannot be stated: nothing covers such a line.
        """
        x_range = np.array([[line.x_min, line.x_max]])
        sent = self._sent(line.gaussian.mean[None], x_range, np.zeros(1, dtype=bool))
        raw = {name: int(values[0]) for name, values in sent.raw.items()}
        first, last = self.layout["XMin"], self.layout["XMax"]
        if first.physical_one(raw[first.name]) >= last.physical_one(raw[last.name]):
            return None
        return None if sent.clipped[0] or sent.cut[0] else raw

    def _supported(self, requested: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the (n,) requested status, as far as the covariance code supports it."""
        best = self._covariance.status
        if best == Status.FULL:
            return requested
        return np.where(_without_covariance(requested), requested, best)

    def _sent(
        self, mean: NDArray[np.float64], x_range: NDArray[np.float64], rows: NDArray[np.bool_]
    ) -> _Sent:
        """Return the raw means and valid ranges that are sent.

        Of a line whose mean would be clipped, the nearest one within the message is sent, in the
        part of its range where it is near, if enough of that can be stated.

        Args:
            mean: (n, 4) lines.
            x_range: (n, 2) valid ranges [m].
            rows: (n,) lines that may be replaced.
        """
        raw, clipped = self._raw_mean(mean)
        ends, cut, outside = self._raw_range(x_range)
        for i in np.flatnonzero(rows & clipped & (x_range[:, 0] < x_range[:, 1])):
            near = nearest_line(self._mean, mean[i], x_range[i], MIN_RANGE, self._covariance.reach)
            if near is None:
                continue
            (short,), (is_cut,), (is_outside,) = self._raw_range(near.x_range[None])
            first, last = self.layout["XMin"], self.layout["XMax"]
            # Rounding inwards may leave nothing of a short range.
            length = last.physical(short[1]) - first.physical(short[0])
            if not is_outside and length >= MIN_RANGE:
                raw[i] = self._raw_mean(near.mean[None])[0]
                ends[i], cut[i], outside[i] = short, is_cut, is_outside
        columns = np.column_stack([raw, ends]).astype(np.int64).T
        return _Sent(
            dict(zip((*PARAMETER_SIGNALS, "XMin", "XMax"), columns, strict=True)),
            clipped,
            cut,
            outside,
        )

    def _raw_mean(self, mean: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return the (n, 4) raw values of means, and the (n,) rows that are clipped."""
        nearest = [s.raw(x) for s, x in zip(self._mean, mean.T, strict=True)]
        limited = [s.limited(raw) for s, raw in zip(self._mean, nearest, strict=True)]
        raw = np.column_stack(limited)
        return raw, (raw != np.column_stack(nearest)).any(axis=1)

    def _raw_range(
        self, x_range: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]:
        """Return the (n, 2) raw ends of (n, 2) valid ranges, rounded inwards.

        Also the (n,) rows that are cut at the ends of the signals, and those for which no range
        within the given one can be stated.
        """
        x_min, x_max = x_range.T
        if (x_min > x_max).any():
            raise EncodeError("x_min must be x_max or less")
        first, last = self.layout["XMin"], self.layout["XMax"]
        low, high = up(first, x_min), down(last, x_max)
        raw_min, raw_max = first.limited(low), last.limited(high)
        start, end = first.physical(raw_min), last.physical(raw_max)
        outside = (start < x_min) | (start > end) | (end > x_max)
        cut = (raw_min != low) | (raw_max != high)
        return np.column_stack([raw_min, raw_max]), cut, np.asarray(outside)

    def _put_covariance(
        self,
        raw: dict[str, NDArray[np.int64]],
        gaussians: CheckedGaussians,
        sent: _Sent,
        requested: NDArray[np.int64],
        cover: NDArray[np.float64] | None,
    ) -> None:
        """Add the raw covariance and status."""
        mean, cov, indefinite = gaussians
        clipped = sent.clipped
        decoded = np.column_stack([signal.physical(sent.raw[signal.name]) for signal in self._mean])
        d = mean - decoded
        error = cov + d[:, :, None] * d[:, None, :]
        if indefinite.any():
            error[indefinite] += nearest_covariance(cov[indefinite]) - cov[indefinite]
        diagonal = requested == Status.DIAGONAL
        if diagonal.any():
            variances = np.einsum("nii->ni", cov[diagonal])
            error[diagonal] += np.einsum("ni,ij->nij", variances, np.eye(4)) - cov[diagonal]
            indefinite = indefinite & ~diagonal
        # For a clipped beta, the first-order sigma of the lateral position has to cover the
        # difference of the tangents, which grows faster than that of the angles.
        d_beta = slope_error(mean, decoded)[:, 1]
        error[:, 1, 1] += np.where(clipped, (d_beta**2 - d[:, 1] ** 2).clip(0), 0.0)
        if cover is not None:
            error += cover
        coded = self._covariance.encode(error, self.layout.resolution)
        raw |= coded.raw

        without = _without_covariance(requested)
        if without.any():
            for name, value in self._covariance.widest().items():
                raw[name][without] = value
        at_limit = (clipped | coded.saturated) & (requested == Status.FULL)
        status = np.where(at_limit, Status.SATURATED, requested)
        # Most repaired matrices also saturate; REPAIRED takes precedence: it is more informative.
        status[(indefinite | (requested == Status.REPAIRED)) & ~without] = Status.REPAIRED
        # Without a covariance, a clipped mean cannot be compensated: OUT_OF_RANGE.
        far = (np.abs(d) > 0.51 * np.abs(self._factor)).any(axis=1)
        status[np.where(without, far, ~coded.covered)] = Status.OUT_OF_RANGE
        raw["Status"] = np.where(requested == Status.OUT_OF_RANGE, requested, status)

    def _put_age_and_weight(
        self, raw: dict[str, NDArray[np.int64]], attributes: RecordAttributes, n: int
    ) -> None:
        """Add the raw age, rounded up, and the raw weight of the component.

        Longer ages are limited to the greatest raw value, which means "too old".
        """
        signal = self.layout["Age"]
        age = np.broadcast_to(np.asarray(attributes.age, dtype=float), n)
        if not (age >= 0).all():
            raise EncodeError(f"age must be 0 s or more, got {age[~(age >= 0)][0]:g}")
        raw["Age"] = signal.limited(up(signal, 1000 * age)).astype(np.int64)
        signal = self.layout["ComponentWeight"]
        weight = _finite("component_weight", attributes.component_weight, n)
        if ((weight <= 0) | (weight > 1)).any():
            raise EncodeError(f"component_weight must be in (0, 1], got {weight.min():g}")
        raw["ComponentWeight"] = signal.limited(signal.raw(weight)).astype(np.int64)

    def _integers(
        self, name: str, value: ArrayLike, n: int, most: int | None = None
    ) -> NDArray[np.int64]:
        """Return the (n,) raw values of a signal that holds a number or an enumeration.

        The greatest valid value is ``most``, or the end of the signal's range.
        """
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


def up(signal: Signal, physical: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (n,) raw values of the physical values, rounded up."""
    raw = np.ceil((physical - signal.offset) / signal.factor - SLACK)
    return raw + (signal.physical(raw) < physical)


def down(signal: Signal, physical: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (n,) raw values of the physical values, rounded down."""
    raw = np.floor((physical - signal.offset) / signal.factor + SLACK)
    return raw - (signal.physical(raw) > physical)


def _without_covariance(status: NDArray[np.int64]) -> NDArray[np.bool_]:
    return (status == Status.UNKNOWN) | (status == Status.OUT_OF_RANGE)


def _finite(name: str, value: ArrayLike, n: int) -> NDArray[np.float64]:
    values = np.broadcast_to(np.asarray(value, dtype=float), n)
    if not np.isfinite(values).all():
        raise EncodeError(f"{name} must be finite, got {values[~np.isfinite(values)][0]}")
    return values
