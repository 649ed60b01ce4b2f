"""Writer of complete records; no value is clipped silently."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...values.arrays import row_values
from ...values.errors import EncodeError
from ...values.gaussian import Gaussian
from ...values.linalg import nearest_covariance
from ...values.line import MIN_RANGE, Kind, MapLine, Status
from ..covariance.nearest_line import nearest_line, slope_error
from ..layout.attributes import RecordAttributes
from ..layout.message_layout import Layout
from ..layout.pose_layout import Owner
from ..layout.signals import PARAMETER_SIGNALS, SignalRow
from ..layout.validation import CheckedGaussians
from .complete_format import CompleteFormat
from .components import deficit, quantized_weights
from .line_writer import LineWriter

Array = NDArray[np.float64]

#: Up to this number, lines are written one by one if they fit their message.
FEW = 8


class _Sent(NamedTuple):
    """Means and valid ranges of n lines, as they are sent."""

    raw: dict[str, NDArray[np.int64]]  #: (n,) by signal
    clipped: NDArray[np.bool_]  #: (n,) lines whose means exceed the signals
    outside: NDArray[np.bool_]  #: (n,) lines of whose ranges no part can be stated


@dataclass(frozen=True, slots=True, eq=False)
class _Component:
    """Content of one record of a line: all of it, or a component of its mixture."""

    line: MapLine
    gaussian: Gaussian
    index: int
    count: int
    weight: float
    cover: NDArray[np.float64]  #: (4, 4) that the decoded covariance must cover besides its own


class CompleteWriter:
    """Writer of complete records: of arrays, of mixtures, and of lines.

    Args:
        layout: of the records.
        form: their format.
    """

    def __init__(self, layout: Layout, form: CompleteFormat) -> None:
        self.layout, self.format = layout, form
        self._packer, self._covariance = form.packer, form.covariance
        self._signals = layout.signals
        self._mean = SignalRow(layout[name] for name in PARAMETER_SIGNALS)
        self._weight_steps = round(1 / layout["ComponentWeight"].factor)
        self._modulus = 2 ** layout["Counter"].length
        self._of_one = LineWriter(layout, form)

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
        raw = self._raw_numbers(attributes, n)
        x_min = _finite("x_min", attributes.x_min, n)
        x_max = _finite("x_max", attributes.x_max, n)
        if (x_min > x_max).any():
            raise EncodeError("x_min must be x_max or less")
        age, weight = _age_and_weight(attributes, n)
        count = row_values(attributes.component_count, n)
        requested = np.broadcast_to(raw["Status"], n)
        x_range = np.column_stack([np.broadcast_to(end, n) for end in (x_min, x_max)])
        sent = self._sent(gaussians.mean, x_range, (requested == Status.FULL) & (count == 1))
        raw |= sent.raw
        raw["Age"] = self._raw_age(age)
        raw["ComponentWeight"] = self._signals["ComponentWeight"].nearest(weight).raw.astype(int)
        self._put_covariance(raw, gaussians, sent, requested, cover)
        raw["Status"] = np.where(sent.outside, Status.OUT_OF_RANGE, raw["Status"])
        raw = {name: np.broadcast_to(values, n) for name, values in raw.items()}
        return self._packer.pack(raw, data_ids)

    def write_lines(
        self, lines: Sequence[MapLine], counters: Mapping[Owner, int]
    ) -> tuple[list[list[bytes]], Counter[Owner]]:
        """Return the records of each line, and the counters that follow them.

        The counters are of the next record of each slot; 0 if there is none. That of the pose error
        does not change.
        """
        following: Counter[Owner] = Counter(counters)
        numbered = []
        for line in lines:
            counter = following[line.slot] % self._modulus
            numbered.append((line, counter))
            count = 1 if line.mixture is None else len(line.mixture.weights)
            following[line.slot] = (counter + count) % self._modulus
        alone: list[bytes | None] = [None] * len(lines)
        if len(lines) <= FEW:
            alone = [self._of_one.write(line, counter) for line, counter in numbered]
        rest = [pair for pair, record in zip(numbered, alone, strict=True) if record is None]
        written = iter(self._write_together(rest) if rest else ())
        return [next(written) if record is None else [record] for record in alone], following

    def _write_together(self, lines: Sequence[tuple[MapLine, int]]) -> list[list[bytes]]:
        """Return the records of lines, given with their first counters, by arrays."""
        records_of_lines = [self._components(line) for line, _ in lines]
        records = [record for records in records_of_lines for record in records]
        first = np.repeat([counter for _, counter in lines], [*map(len, records_of_lines)])
        index = np.array([record.index for record in records])
        payloads = self.write(
            CheckedGaussians(
                np.array([record.gaussian.mean for record in records]),
                np.array([record.gaussian.cov for record in records]),
                np.zeros(len(records), dtype=bool),  # a Gaussian is never indefinite
            ),
            RecordAttributes(
                slot=[record.line.slot for record in records],
                counter=first + index,
                kind=[record.line.kind for record in records],
                x_min=[record.line.x_min for record in records],
                x_max=[record.line.x_max for record in records],
                age=[record.line.age for record in records],
                status=[record.line.status for record in records],
                component_index=index,
                component_count=[record.count for record in records],
                component_weight=[record.weight for record in records],
            ),
            np.array([record.cover for record in records]),
        )
        left = iter(payloads)
        return [[next(left).tobytes() for _ in records] for records in records_of_lines]

    def raw_mean_and_range(self, line: MapLine) -> dict[str, int] | None:
        """Return the raw values of the mean and the valid range of a line, as ``write`` sends them.

        None if a value is clipped, or the range cannot be stated: nothing covers such a line.
        """
        mean, stated = self._of_one.raw_mean(line), self._of_one.raw_range(line)
        return None if mean is None or stated.cut or stated.empty else mean | stated.raw

    def _components(self, line: MapLine) -> list[_Component]:
        if line.mixture is None:
            return [_Component(line, line.gaussian, 0, 1, 1.0, np.zeros((4, 4)))]
        mixture, k = line.mixture, len(line.mixture.weights)
        weights, cover = self._cover(mixture.weights[None], mixture.means[None], mixture.covs[None])
        return [
            _Component(line, gaussian, i, k, float(weights[0, i]), cover[0])
            for i, gaussian in enumerate(mixture.components)
        ]

    @np.errstate(over="ignore", invalid="ignore")
    def _cover(self, weights: Array, means: Array, covs: Array) -> tuple[Array, Array]:
        """Return the (N, k) decoded weights, and the (N, 4, 4) ``deficit`` that they leave."""
        steps = self._weight_steps
        decoded = quantized_weights(weights, steps) / steps
        return decoded, deficit(weights, means, covs, decoded, self._mean.nearest(means).physical)

    def _raw_numbers(self, attributes: RecordAttributes, n: int) -> dict[str, NDArray[np.int64]]:
        """Return raw values of numbers and enumerations, (n,) or one for all, as ``row_values``."""
        signals = self._signals
        status = Status.FULL if attributes.status is None else attributes.status
        counter = np.arange(n) if attributes.counter is None else attributes.counter
        index = row_values(attributes.component_index, n)
        count = row_values(attributes.component_count, n)
        raw = {
            "Status": signals["Status"].whole(row_values(status, n), max(Status)),
            "Counter": signals["Counter"].whole(row_values(counter, n) % self._modulus),
            "Kind": signals["Kind"].whole(row_values(attributes.kind, n), max(Kind)),
            "ComponentIndex": signals["ComponentIndex"].whole(index),
            "ComponentCount": signals["ComponentCount"].whole(count),
        }
        bad = index >= count
        if bad.any():
            i, k = (np.broadcast_to(values, bad.shape)[bad][0] for values in (index, count))
            raise EncodeError(f"component_index must be below component_count, got {i} of {k}")
        return raw

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
        nearest = self._mean.nearest(mean)
        raw, clipped = nearest.raw, np.asarray(nearest.clipped.any(axis=-1))
        ends, outside = self._raw_range(x_range)
        for i in np.flatnonzero(rows & clipped & (x_range[:, 0] < x_range[:, 1])):
            near = nearest_line(
                self._mean.signals, mean[i], x_range[i], MIN_RANGE, self._covariance.reach
            )
            if near is None:
                continue
            (short,), (is_outside,) = self._raw_range(near.x_range[None])
            first, last = self._signals["XMin"], self._signals["XMax"]
            # Rounding inwards may leave nothing of a short range.
            length = last.physical(short[1]) - first.physical(short[0])
            if not is_outside and length >= MIN_RANGE:
                raw[i] = self._mean.nearest(near.mean).raw
                ends[i], outside[i] = short, is_outside
        columns = np.column_stack([raw, ends]).astype(np.int64).T
        return _Sent(
            dict(zip((*PARAMETER_SIGNALS, "XMin", "XMax"), columns, strict=True)),
            clipped,
            outside,
        )

    def _raw_range(
        self, x_range: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return the (n, 2) raw ends of (n, 2) valid ranges, rounded inwards.

        Also the (n,) rows for which no range within the given one can be stated.
        """
        x_min, x_max = x_range.T
        first, last = self._signals["XMin"], self._signals["XMax"]
        raw_min = first.limited(first.raw_above(x_min))
        raw_max = last.limited(last.raw_below(x_max))
        start, end = first.physical(raw_min), last.physical(raw_max)
        outside = (start < x_min) | (start > end) | (end > x_max)
        return np.column_stack([raw_min, raw_max]), np.asarray(outside)

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
        decoded = self._mean.physical_of(sent.raw)
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
        if clipped.any():
            d_beta = slope_error(mean[clipped], decoded[clipped])[:, 1]
            error[clipped, 1, 1] += (d_beta**2 - d[clipped, 1] ** 2).clip(0)
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
        far = (np.abs(d) > 0.51 * np.abs(self._mean.factor)).any(axis=1)
        status[np.where(without, far, ~coded.covered)] = Status.OUT_OF_RANGE
        raw["Status"] = np.where(requested == Status.OUT_OF_RANGE, requested, status)

    def _raw_age(self, age: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the raw ages, rounded up.

        Longer ages are limited to the greatest raw value, which means "too old".
        """
        signal = self._signals["Age"]
        return signal.limited(signal.raw_above(1000 * age)).astype(np.int64)


def _age_and_weight(attributes: RecordAttributes, n: int) -> tuple[Array, Array]:
    """Return the ages [s] and weights of the components, as ``row_values``."""
    age = row_values(np.asarray(attributes.age, dtype=float), n)
    if not (age >= 0).all():
        raise EncodeError(f"age must be 0 s or more, got {age[~(age >= 0)][0]:g}")
    weight = _finite("component_weight", attributes.component_weight, n)
    if ((weight <= 0) | (weight > 1)).any():
        raise EncodeError(f"component_weight must be in (0, 1], got {weight.min():g}")
    return age, weight


def _without_covariance(status: NDArray[np.int64]) -> NDArray[np.bool_]:
    return (status == Status.UNKNOWN) | (status == Status.OUT_OF_RANGE)


def _finite(name: str, value: ArrayLike, n: int) -> NDArray[np.float64]:
    values = row_values(np.asarray(value, dtype=float), n)
    if not np.isfinite(values).all():
        raise EncodeError(f"{name} must be finite, got {values[~np.isfinite(values)][0]}")
    return values
