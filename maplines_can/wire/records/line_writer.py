"""Writer of one line as a complete record, in plain numbers."""

from __future__ import annotations

from typing import NamedTuple

from ...values.line import MapLine, Status
from ..layout.message_layout import Layout
from ..layout.signals import PARAMETER_SIGNALS
from .complete_format import CompleteFormat

#: Signals of the place in a mixture, and what those of a single line mean.
SINGLE = {"ComponentIndex": 0.0, "ComponentCount": 1.0, "ComponentWeight": 1.0}
#: Largest distance of a mean from the one that is sent without a covariance [steps].
FAR = 0.51


class StatedRange(NamedTuple):
    """Valid range of a line as it is sent: rounded inwards."""

    raw: dict[str, int]
    cut: bool  #: it exceeds the signals
    outside: bool  #: no part of it can be stated
    empty: bool  #: it has no length


class LineWriter:
    """Writer of lines that fit their message: as ``CompleteWriter`` to the last bit.

    For one line, arrays take several times as long as its arithmetic.

    Args:
        layout: of the records.
        form: their format.
    """

    def __init__(self, layout: Layout, form: CompleteFormat) -> None:
        self._messages, self._resolution = layout.messages, layout.resolution.tolist()
        self._packer, self._covariance = form.packer, form.covariance
        self._mean = [layout[name] for name in PARAMETER_SIGNALS]
        self._first, self._last, self._age = layout["XMin"], layout["XMax"], layout["Age"]
        self._single = {name: layout[name].nearest_one(x).raw for name, x in SINGLE.items()}
        self._widest = form.covariance.widest()

    def write(self, line: MapLine, counter: int) -> bytes | None:
        """Return the record of a line.

        None if it takes arrays: the line is a mixture, its mean is out of range, or the layout has
        no message for it.
        """
        mean = self.raw_mean(line)
        if mean is None or line.mixture is not None or line.slot not in self._messages:
            return None
        stated = self.raw_range(line)
        covariance, status = self._covariance_and_status(line, mean)
        raw = {
            **mean,
            **stated.raw,
            **covariance,
            **self._single,
            "Counter": counter,
            "Status": int(Status.OUT_OF_RANGE if stated.outside else status),
            "Kind": int(line.kind),
            "Age": self._age.above_one(1000 * float(line.age))[0],
        }
        return self._packer.pack_one(raw, self._messages[line.slot].data_id)

    def raw_mean(self, line: MapLine) -> dict[str, int] | None:
        """Return the raw mean of a line; None if it is out of range."""
        nearest = [
            signal.nearest_one(value)
            for signal, value in zip(self._mean, line.gaussian.mean.tolist(), strict=True)
        ]
        if any(one.clipped for one in nearest):
            return None
        return {signal.name: one.raw for signal, one in zip(self._mean, nearest, strict=True)}

    def raw_range(self, line: MapLine) -> StatedRange:
        """Return the raw valid range of a line."""
        x_min, x_max = float(line.x_min), float(line.x_max)
        raw_min, min_cut = self._first.above_one(x_min)
        raw_max, max_cut = self._last.below_one(x_max)
        start, end = self._first.physical_one(raw_min), self._last.physical_one(raw_max)
        return StatedRange(
            {self._first.name: raw_min, self._last.name: raw_max},
            min_cut or max_cut,
            start < x_min or start > end or end > x_max,
            start >= end,
        )

    def _covariance_and_status(
        self, line: MapLine, raw_mean: dict[str, int]
    ) -> tuple[dict[str, int], Status]:
        """Return the raw covariance and the status of a line whose mean is in range."""
        requested = line.status
        d = [
            value - signal.physical_one(raw_mean[signal.name])
            for signal, value in zip(self._mean, line.gaussian.mean.tolist(), strict=True)
        ]
        if requested in (Status.UNKNOWN, Status.OUT_OF_RANGE):
            is_far = any(
                abs(x) > FAR * abs(signal.factor) for signal, x in zip(self._mean, d, strict=True)
            )
            return self._widest, Status.OUT_OF_RANGE if is_far else requested
        cov = line.gaussian.cov.tolist()
        error = [
            [value + x * y for value, y in zip(row, d, strict=True)]
            for row, x in zip(cov, d, strict=True)
        ]
        if requested == Status.DIAGONAL:  # the variances only, as in ``CompleteWriter``
            for i, row in enumerate(cov):
                for j, value in enumerate(row):
                    error[i][j] += (value if i == j else 0.0) - value
        coded = self._covariance.encode_one(error, self._resolution)
        if not coded.covered:
            return coded.raw, Status.OUT_OF_RANGE
        if requested == Status.FULL and coded.saturated:
            return coded.raw, Status.SATURATED
        return coded.raw, requested
