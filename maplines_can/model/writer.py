"""A line as a complete record, with a covariance of its own, or as those of its mixture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from ..values.line import MIN_RANGE, Slot, Status
from ..wire.layout.message_layout import Layout
from ..wire.layout.record_signals import PARAMETER_SIGNALS, Signal
from .covariance import code_of, encode, is_indefinite, nearest_covariance, reachable, widest
from .matrices import Matrix, Vector, diagonal, matrix
from .mixtures import deficit, quantized_weights
from .nearest_line import nearest_line, slope_error
from .records import WITHOUT, written
from .signals import above, below, limited, nearest, nearest_limited, physical, value

#: Largest distance of a mean from the one that is sent without a covariance [steps].
FAR = 0.51


@dataclass(frozen=True)
class Draft:
    """A line to be sent, or one component of its mixture."""

    slot: Slot
    mean: Vector
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

    No value is clipped silently: the status says what became of the line. If it exceeds the
    message, the nearest line within is sent instead, in the part of the range where it is near, if
    enough of that can be stated. ``cover`` is what the decoded covariance must cover besides its
    own target.
    """
    raw_mean, is_clipped = clipped_mean(layout, line.mean)
    ends, is_outside = stated_range(layout, line.x_min, line.x_max)
    if is_clipped and line.status == Status.FULL and line.count == 1 and line.x_min < line.x_max:
        signals, reach = mean_signals(layout), reachable(code_of(layout))
        mean = Vector(line.mean)
        near = nearest_line(signals, mean, (line.x_min, line.x_max), MIN_RANGE, reach)
        if near is not None:
            near_ends, cannot = stated_range(layout, *near[1])
            start, end = physical_range(layout, near_ends)
            if not cannot and end - start >= MIN_RANGE:  # not so if rounding leaves too little
                raw_mean, ends, is_outside = clipped_mean(layout, near[0])[0], near_ends, False
    raw, status = _covariance_and_status(layout, line, raw_mean, is_clipped, cover)
    raw |= dict(zip(PARAMETER_SIGNALS, raw_mean, strict=True))
    raw |= {"XMin": ends[0], "XMax": ends[1], "Kind": line.kind, "Counter": counter}
    raw["Status"] = int(Status.OUT_OF_RANGE if is_outside else status)
    raw["Age"] = limited(layout["Age"], above(layout["Age"], 1000 * line.age))
    component = {"Index": line.index, "Count": line.count, "Weight": line.weight}
    for name, x in component.items():
        raw[f"Component{name}"] = nearest_limited(layout[f"Component{name}"], x)
    return written(layout, raw, layout.messages[line.slot].data_id)


def mean_signals(layout: Layout) -> list[Signal]:
    """Return the signals of a mean."""
    return [layout[name] for name in PARAMETER_SIGNALS]


def clipped_mean(layout: Layout, mean: Sequence[float]) -> tuple[list[int], bool]:
    """Return the nearest raw mean within the ranges, and whether a parameter exceeds its range."""
    signals = mean_signals(layout)
    exact = [nearest(signal, x) for signal, x in zip(signals, mean, strict=True)]
    raw = [limited(signal, x) for signal, x in zip(signals, exact, strict=True)]
    return raw, raw != exact


def decoded_mean(layout: Layout, raw: Sequence[int]) -> Vector:
    """Return the mean of raw values."""
    return physical(layout, dict(zip(PARAMETER_SIGNALS, raw, strict=True)), *PARAMETER_SIGNALS)


def stated_range(layout: Layout, x_min: float, x_max: float) -> tuple[tuple[int, int], bool]:
    """Return the raw ends of a valid range, rounded inwards, and whether no part can be stated."""
    first, last = layout["XMin"], layout["XMax"]
    raw = limited(first, above(first, x_min)), limited(last, below(last, x_max))
    start, end = physical_range(layout, raw)
    return raw, start < x_min or start > end or end > x_max


def physical_range(layout: Layout, raw: tuple[int, int]) -> tuple[float, float]:
    """Return the ends of a valid range [m]."""
    return value(layout["XMin"], raw[0]), value(layout["XMax"], raw[1])


def _covariance_and_status(
    layout: Layout, line: Draft, raw_mean: list[int], is_clipped: bool, cover: Matrix | None
) -> tuple[dict[str, int], int]:
    """Return the raw values of the covariance, and what became of the line."""
    code, steps = code_of(layout), Vector(signal.factor for signal in mean_signals(layout))
    decoded, cov = decoded_mean(layout, raw_mean), matrix(line.cov)
    error = Vector(line.mean) - decoded
    if line.status in WITHOUT:  # nothing makes up for a mean that is clipped
        is_far = any(abs(d) > FAR * step for d, step in zip(error, steps, strict=True))
        return widest(code), Status.OUT_OF_RANGE if is_far else line.status
    # The decoded covariance must cover the mean square error of the decoded mean.
    target, is_repaired = cov + error.outer(), is_indefinite(cov)
    if is_repaired:
        target += nearest_covariance(cov) - cov
    if line.status == Status.DIAGONAL:  # the variances only
        target += diagonal(cov.diagonal()) - cov
    if is_clipped:
        # The first-order sigma of the lateral position has to cover the difference of the tangents,
        # which grows faster than that of the angles.
        d_beta = slope_error(line.mean[1], decoded[1])
        target[1][1] += max(d_beta * d_beta - error[1] * error[1], 0.0)
    coded = encode(code, target if cover is None else target + cover, steps * steps / 12)
    if not coded.is_covered:
        return coded.raw, Status.OUT_OF_RANGE
    if (line.status != Status.DIAGONAL and is_repaired) or line.status == Status.REPAIRED:
        return coded.raw, Status.REPAIRED
    if line.status == Status.FULL and (is_clipped or coded.is_lifted):
        return coded.raw, Status.SATURATED
    return coded.raw, line.status


def write_mixture(
    layout: Layout,
    line: Draft,
    weights: Sequence[float],
    means: Sequence[Vector],
    covs: Sequence[Matrix],
    counter: int,
) -> list[bytes]:
    """Return the records of a mixture, one for each component, with consecutive counters.

    The line has what all components have alike.
    """
    means, covs = [*map(Vector, means)], [*map(matrix, covs)]
    steps = round(1 / layout["ComponentWeight"].factor)
    decoded_weights = [multiple / steps for multiple in quantized_weights(weights, steps)]
    decoded_means = [decoded_mean(layout, clipped_mean(layout, mean)[0]) for mean in means]
    cover = deficit(weights, means, covs, decoded_weights, decoded_means)
    modulus, records = 2 ** layout["Counter"].length, []
    for i, (weight, mean, cov) in enumerate(zip(decoded_weights, means, covs, strict=True)):
        component = replace(line, mean=mean, cov=cov, index=i, count=len(means), weight=weight)
        records.append(write(layout, component, (counter + i) % modulus, cover))
    return records
