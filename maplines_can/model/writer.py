"""A line as a complete record, with a covariance of its own, or as those of its mixture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ..values.line import MIN_RANGE, Slot, Status
from ..wire.layout.message_layout import Layout
from ..wire.layout.signals import PARAMETER_SIGNALS, Signal
from .covariance import code_of, encode, is_indefinite, nearest_covariance, reachable, widest
from .matrices import Matrix, Row, added, diagonal, outer, subtracted
from .nearest_line import nearest_line, slope_error
from .records import WITHOUT, written
from .signals import above, below, limited, nearest, nearest_limited, value
from .weights import deficit, quantized_weights

#: Largest distance of a mean from the one that is sent without a covariance [steps].
FAR = 0.51


@dataclass(frozen=True)
class Draft:
    """A line to be sent, or one component of its mixture."""

    slot: Slot
    mean: Row
    cov: Matrix
    kind: int = 0
    status: int = Status.FULL  #: as requested
    x_min: float = 0.0  #: [m]
    x_max: float = 0.0
    age: float = 0.0  #: [s]
    index: int = 0
    count: int = 1
    weight: float = 1.0


def write(layout: Layout, line: Draft, counter: int, cover: Matrix | None = None) -> bytes:
    """Return the record of a line.

    No value is clipped silently: the status says what became of the line.

    Args:
        layout: of the record.
        line: to be sent.
        counter: of the record.
        cover: what the decoded covariance must cover besides its own target.
    """
    signals = _mean_signals(layout)
    raw_mean, is_clipped = clipped_mean(signals, line.mean)
    ends, is_outside = stated_range(layout, line.x_min, line.x_max)
    if is_clipped and line.status == Status.FULL and line.count == 1 and line.x_min < line.x_max:
        raw_mean, ends, is_outside = replaced(layout, line, (raw_mean, ends, is_outside))
    decoded = [value(signal, raw) for signal, raw in zip(signals, raw_mean, strict=True)]
    raw, status = _covariance_and_status(layout, line, decoded, is_clipped, cover)
    raw |= dict(zip(PARAMETER_SIGNALS, raw_mean, strict=True))
    raw |= {"XMin": ends[0], "XMax": ends[1], "Kind": line.kind, "Counter": counter}
    raw["Status"] = int(Status.OUT_OF_RANGE if is_outside else status)
    raw["Age"] = limited(layout["Age"], above(layout["Age"], 1000 * line.age))
    component = {"Index": line.index, "Count": line.count, "Weight": line.weight}
    for name, x in component.items():
        raw[f"Component{name}"] = nearest_limited(layout[f"Component{name}"], x)
    return written(layout, raw, layout.messages[line.slot].data_id)


def _mean_signals(layout: Layout) -> list[Signal]:
    return [layout[name] for name in PARAMETER_SIGNALS]


def clipped_mean(signals: Sequence[Signal], mean: Sequence[float]) -> tuple[list[int], bool]:
    """Return the nearest raw mean within the ranges, and whether a parameter exceeds its range."""
    exact = [nearest(signal, x) for signal, x in zip(signals, mean, strict=True)]
    raw = [limited(signal, x) for signal, x in zip(signals, exact, strict=True)]
    return raw, raw != exact


def stated_range(layout: Layout, x_min: float, x_max: float) -> tuple[tuple[int, int], bool]:
    """Return the raw ends of a valid range, rounded inwards, and whether no part can be stated."""
    first, last = layout["XMin"], layout["XMax"]
    raw = limited(first, above(first, x_min)), limited(last, below(last, x_max))
    start, end = value(first, raw[0]), value(last, raw[1])
    return raw, start < x_min or start > end or end > x_max


_Stated = tuple[list[int], tuple[int, int], bool]


def replaced(layout: Layout, line: Draft, stated: _Stated) -> _Stated:
    """Return what is sent for a line that exceeds the message: raw mean, raw ends, ``is_outside``.

    It is the nearest line within the message, in the part of the range where it is near, if enough
    of that can be stated; otherwise what was stated so far.
    """
    reach = [math.sqrt(variance) for variance in reachable(code_of(layout))]
    signals = _mean_signals(layout)
    near = nearest_line(signals, line.mean, (line.x_min, line.x_max), MIN_RANGE, reach)
    if near is None:
        return stated
    ends, is_outside = stated_range(layout, *near[1])
    length = value(layout["XMax"], ends[1]) - value(layout["XMin"], ends[0])
    if is_outside or length < MIN_RANGE:  # rounding inwards may leave nothing of a short range
        return stated
    return clipped_mean(signals, near[0])[0], ends, False


def _covariance_and_status(
    layout: Layout, line: Draft, decoded: Row, is_clipped: bool, cover: Matrix | None
) -> tuple[dict[str, int], int]:
    """Return the raw values of the covariance, and what became of the line."""
    code = code_of(layout)
    steps = [signal.factor for signal in _mean_signals(layout)]
    if line.status in WITHOUT:  # nothing makes up for a mean that is clipped
        errors = [x - y for x, y in zip(line.mean, decoded, strict=True)]
        is_far = any(abs(d) > FAR * step for d, step in zip(errors, steps, strict=True))
        return widest(code), Status.OUT_OF_RANGE if is_far else line.status
    target = target_of(line, decoded, is_clipped, cover)
    coded = encode(code, target, [step * step / 12 for step in steps])
    if not coded.is_covered:
        return coded.raw, Status.OUT_OF_RANGE
    is_repaired = line.status != Status.DIAGONAL and is_indefinite(line.cov)
    if is_repaired or line.status == Status.REPAIRED:
        return coded.raw, Status.REPAIRED
    if line.status == Status.FULL and (is_clipped or coded.is_lifted):
        return coded.raw, Status.SATURATED
    return coded.raw, line.status


def target_of(line: Draft, decoded: Row, is_clipped: bool, cover: Matrix | None) -> Matrix:
    """Return what the decoded covariance must cover: the mean square error of the decoded mean."""
    cov = line.cov
    d = [x - y for x, y in zip(line.mean, decoded, strict=True)]
    target = added(cov, outer(d))
    if is_indefinite(cov):
        target = added(target, subtracted(nearest_covariance(cov), cov))
    if line.status == Status.DIAGONAL:  # the variances only
        target = added(target, subtracted(diagonal([row[i] for i, row in enumerate(cov)]), cov))
    if is_clipped:
        # The first-order sigma of the lateral position has to cover the difference of the tangents,
        # which grows faster than that of the angles.
        d_beta = slope_error(line.mean[1], decoded[1])
        target[1][1] += max(d_beta * d_beta - d[1] * d[1], 0.0)
    return target if cover is None else added(target, cover)


def write_mixture(
    layout: Layout,
    line: Draft,
    weights: Sequence[float],
    means: Sequence[Row],
    covs: Sequence[Matrix],
    counter: int,
) -> list[bytes]:
    """Return the records of a mixture, one for each component, with consecutive counters.

    Args:
        layout: of the records.
        line: what all components have alike; its mean and covariance are not read.
        weights: of the components.
        means: likewise.
        covs: likewise.
        counter: of the first record.
    """
    steps = round(1 / layout["ComponentWeight"].factor)
    decoded_weights = [multiple / steps for multiple in quantized_weights(weights, steps)]
    signals = _mean_signals(layout)
    decoded_means = []
    for mean in means:
        raw, _ = clipped_mean(signals, mean)
        decoded_means.append([value(s, one) for s, one in zip(signals, raw, strict=True)])
    cover = deficit(weights, means, covs, decoded_weights, decoded_means)
    modulus, records = 2 ** layout["Counter"].length, []
    for i, (weight, mean, cov) in enumerate(zip(decoded_weights, means, covs, strict=True)):
        component = replace(line, mean=mean, cov=cov, index=i, count=len(means), weight=weight)
        records.append(write(layout, component, (counter + i) % modulus, cover))
    return records
