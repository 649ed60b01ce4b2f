"""Rounding a line to a message of a production car, or of this project: lateral error and KL.

For a message with the factors f_i and the derivatives J_i of y(x) with respect to its values:

- worst: sum of |J_i| f_i / 2, each value off by half a step in the same sense;
- rms: square root of the sum of (J_i f_i)^2 / 12, errors uniform over a step;
- measured: lines of the set *road*, rounded to the message's values and read back. Lines that do
  not fit are clipped to the range, counted, and left out of the errors. At x, only lines that
  stay within 45 deg of the car's axis up to x count;
- rounding KL: KL(N(m, S) || N(m', S)) of the rounded mean m' with the unchanged covariance S, as
  if S were sent exactly: the cost of rounding in all four parameters. On lines of the sets *road*
  and *paper*; the covariance of *paper* has only the error of the pose and is nearly singular;
- truncated: the error with the missing parameter set to 0. A sender that fits the line without
  that parameter does better.

Both formulas are linear, and hold for a line along the car's axis: a heading sent as an angle
weighs 1 + tan(beta)^2 times more. Where a source does not say whether it sends coefficients of a
polynomial or curvatures,

    y = c_0 + c_1 x + c_2 x^2 + c_3 x^3    or    y = c_0 + c_1 x + c_2 x^2/2 + c_3 x^3/6,

the first is assumed. Its steps have the greater effect.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..values.coding_loss import evaluate
from ..values.line import PARAMETERS, lateral, lateral_jacobian
from ..values.text_table import aligned, csv_text, markdown
from ..wire import Layout
from ..wire.layout.record_signals import PARAMETER_SIGNALS, Signal
from .code_dbcs import covariance_signals
from .sets import Gaussians, paper, road

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Message:
    """Parameters of one line as a message sends them."""

    maker: str  #: of the car or camera
    name: str  #: with its CAN ID
    signals: tuple[Signal | None, ...]  #: of y_off, beta, c0, c1 or values for them; None: not sent
    polynomial: bool  #: sends tan(beta), c0/2 and c1/6, not beta, c0 and c1
    documented: bool  #: the source says which of the two
    uncertainty: str  #: what the message says about it
    source: str  #: of these figures
    certainty: str  #: how reliable they are
    distance: bool = False  #: sends |y_off|; the side follows from which line it is

    @property
    def bits(self) -> int:
        """Number of bits of the line's parameters."""
        return sum(signal.length for signal in self.signals if signal)

    def sent(self, lines: ArrayLike) -> Array:
        """Return the (..., 4) values of (..., 4) lines before rounding."""
        values = np.array(lines, dtype=float)
        if self.distance:
            values[..., 0] = np.abs(values[..., 0])
        if self.polynomial:
            values[..., 1] = np.tan(values[..., 1])
        return values / self._scale

    def read(self, values: ArrayLike, lines: ArrayLike) -> Array:
        """Return the (..., 4) lines of (..., 4) values; only the side is taken from ``lines``."""
        read = np.asarray(values, dtype=float) * self._scale
        if self.polynomial:
            read[..., 1] = np.arctan(read[..., 1])
        if self.distance:
            read[..., 0] = np.copysign(read[..., 0], np.asarray(lines, dtype=float)[..., 0])
        return read

    def rounded(self, lines: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Round lines to the values of the message.

        Returns:
            (..., 4) lines as they are read; a parameter that is not sent is 0.
            (..., 4) which parameters were out of range and were clipped.
        """
        values = self.sent(lines)
        clipped = np.zeros(values.shape, dtype=bool)
        for i, signal in enumerate(self.signals):
            if signal is None:
                values[..., i] = 0.0
                continue
            raw = signal.raw(values[..., i])
            limited = signal.limited(raw)
            clipped[..., i] = raw != limited
            values[..., i] = signal.physical(limited)
        return self.read(values, lines), clipped

    @property
    def _scale(self) -> Array:
        return np.array([1.0, 1.0, 2.0, 6.0] if self.polynomial else [1.0, 1.0, 1.0, 1.0])


def default_message(layout: Layout | None = None) -> Message:
    """Return the mean of this project's message, as its DBC describes it.

    Args:
        layout: by default that of ``dbc/maplines.dbc``.
    """
    layout = layout or Layout.from_dbc()
    covariance = sum(
        layout[spec.name].length for spec in covariance_signals(layout.covariance_code)
    )
    return Message(
        "this project",
        "MapLine",
        tuple(layout[name] for name in PARAMETER_SIGNALS),
        polynomial=False,
        documented=True,
        uncertainty=f"covariance, {covariance} b" if covariance else "none",
        source="the DBC",
        certainty="it is the contract",
    )


# The keys of a signal in production_messages.toml.
def _signal(
    name: str,
    *,
    bits: int,
    factor: float,
    offset: float = 0.0,
    unit: str = "",
    signed: bool = False,
    limits: tuple[float, float] = (-math.inf, math.inf),
) -> Signal:
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
    # A limit printed in decimals still admits the raw value that it stands for.
    first, last = (limits[0] - offset) / factor - 1e-6, (limits[1] - offset) / factor + 1e-6
    return Signal(
        name=name,
        start=0,  # the place in the frame does not matter here
        length=bits,
        big_endian=False,
        signed=signed,
        factor=factor,
        offset=offset,
        unit=unit,
        raw_min=low if low > first else math.ceil(first),
        raw_max=high if high < last else math.floor(last),
    )


def _message(table: dict[str, Any]) -> Message:
    signals = [table.pop(state, None) for state in PARAMETERS]
    given = zip(PARAMETERS, signals, strict=True)
    return Message(signals=tuple(spec and _signal(name, **spec) for name, spec in given), **table)


#: Messages of production cars, from public sources; ``production_messages.toml`` says which.
PRODUCTION = tuple(
    map(
        _message,
        tomllib.loads(files(__package__).joinpath("production_messages.toml").read_text("utf-8"))[
            "messages"
        ],
    )
)


# ---- rounding -----------------------------------------------------------------------------------

#: Places of the lateral error [m].
DISTANCES = (20.0, 50.0, 80.0)
#: Quantiles of the rounding KL.
KL_QUANTILES = (0.5, 0.9)


def worst(message: Message, x: ArrayLike, *, polynomial: bool | None = None) -> Array:
    """Return the (...,) worst lateral error of rounding at x [m], to first order.

    Args:
        message: whose values are rounded.
        x: [m].
        polynomial: how to read the values; by default as the message says.

    >>> worst(PRODUCTION[1], [0, 50])  # half a step of 0.035 m; then all four
    array([0.0175, 0.0975])
    """
    return np.asarray(_steps(message, x, polynomial).sum(axis=-1) / 2)


def rms(message: Message, x: ArrayLike) -> Array:
    """Return the (...,) rms lateral error of uniform rounding at x [m], to first order."""
    return np.asarray(np.sqrt((_steps(message, x) ** 2).sum(axis=-1) / 12))


def _steps(message: Message, x: ArrayLike, polynomial: bool | None = None) -> Array:
    """Return the (..., 4) change of y(x) with a step of each value [m]."""
    factors = [abs(signal.factor) if signal else 0.0 for signal in message.signals]
    along = np.abs(lateral_jacobian(np.zeros(len(PARAMETERS)), x)) * factors
    if message.polynomial if polynomial is None else polynomial:
        along *= [1.0, 1.0, 2.0, 6.0]
    return np.asarray(along, dtype=float)


@dataclass(frozen=True)
class RoundingRow:
    """Figures of one message on a set of lines; triples are at ``DISTANCES`` [m]."""

    message: Message
    lines: int  #: of the set
    clipped: tuple[int, ...]  #: lines out of range, for each parameter
    fit: int  #: lines with all that is sent in range
    evaluated: tuple[int, ...]  #: lines that fit and reach that far
    worst: tuple[float, ...]  #: by the formula
    worst_other: tuple[float, ...] | None  #: with the other reading, unless it is documented
    rms: tuple[float, ...]  #: by the formula
    measured_rms: tuple[float, ...]  #: of rounding alone; NaN without lines
    measured_worst: tuple[float, ...]
    truncated_rms: tuple[float, ...] | None  #: with the missing parameter 0; None: all are sent
    truncated_median: tuple[float, ...] | None
    rounding_kl: tuple[float, ...]  #: at KL_QUANTILES of the lines that fit [nat]
    rounding_kl_pose: tuple[float, ...]  #: the same for lines with the pose's error alone
    sigma_best: tuple[float, ...]  #: of the set's lines that reach that far: 10 % quantile
    sigma_median: tuple[float, ...]


def production_table(n: int = 2000, seed: int = 0) -> list[RoundingRow]:
    """Return the row of each production message, and of this project's own, on the same lines.

    Args:
        n: lines of the set *road*.
        seed: of the roads and their errors.

    Raises:
        ValueError: fewer than 100 lines.
    """
    if n < 100:
        raise ValueError(f"n must be 100 lines or more, got {n!r}")
    lines, pose_only = road(n, seed), paper(n, seed)
    return [measured(message, lines, pose_only) for message in (*PRODUCTION, default_message())]


def measured(message: Message, lines: Gaussians, pose_only: Gaussians) -> RoundingRow:
    """Return the figures of one message.

    Args:
        message: to which the lines are rounded.
        lines: any set.
        pose_only: nearly singular ones, for ``rounding_kl_pose`` alone.
    """
    mean, cov = lines
    x = np.array(DISTANCES)
    reaches = _reaches(mean, x)
    J = lateral_jacobian(mean[:, None, :], x)
    sigma = np.sqrt(np.einsum("nxi,nij,nxj->nx", J, cov, J).clip(0))
    read, clipped = message.rounded(mean)
    fits = np.asarray(~clipped.any(axis=1))
    line = lateral(mean[:, None, :], x)
    error, truncated = (
        np.abs(lateral(other[:, None, :], x) - line)
        for other in (_rounded_alone(message, mean, read), read)
    )
    chosen = fits[:, None] & reaches

    def each(figure: str, values: Array, chosen: NDArray[np.bool_]) -> tuple[float, ...]:
        columns = (values[chosen[:, i], i] for i in range(len(x)))
        return tuple(_FIGURES[figure](column) if column.size else np.nan for column in columns)

    lacks = None in message.signals
    other = None if message.documented else worst(message, x, polynomial=not message.polynomial)
    return RoundingRow(
        message=message,
        lines=len(mean),
        clipped=tuple(clipped.sum(axis=0).tolist()),
        fit=int(fits.sum()),
        evaluated=tuple(chosen.sum(axis=0).tolist()),
        worst=tuple(worst(message, x).tolist()),
        worst_other=None if other is None else tuple(other.tolist()),
        rms=tuple(rms(message, x).tolist()),
        measured_rms=each("rms", error, chosen),
        measured_worst=each("worst", error, chosen),
        truncated_rms=each("rms", truncated, chosen) if lacks else None,
        truncated_median=each("median", truncated, chosen) if lacks else None,
        rounding_kl=_rounding_kl(message, lines),
        rounding_kl_pose=_rounding_kl(message, pose_only),
        sigma_best=each("best", sigma, reaches),
        sigma_median=each("median", sigma, reaches),
    )


_FIGURES = {
    "rms": lambda values: float(np.sqrt(np.mean(values**2))),
    "worst": lambda values: float(values.max()),
    "best": lambda values: float(np.quantile(values, 0.1)),
    "median": lambda values: float(np.median(values)),
}


def _rounded_alone(message: Message, mean: Array, read: Array) -> Array:
    """Return the lines as they are read, with the true values of parameters that are not sent."""
    return np.where([signal is None for signal in message.signals], mean, read)


def _rounding_kl(message: Message, lines: Gaussians) -> tuple[float, ...]:
    mean, cov = lines
    read, clipped = message.rounded(mean)
    fits = ~clipped.any(axis=1)
    if not fits.any():
        return (np.nan,) * len(KL_QUANTILES)
    m, S, decoded = mean[fits], cov[fits], _rounded_alone(message, mean, read)[fits]
    kl = evaluate(m, S, decoded, S, np.zeros(len(PARAMETERS))).kl
    # inverted_cdf allows infinite values.
    return tuple(np.quantile(kl, KL_QUANTILES, method="inverted_cdf").tolist())


def _reaches(mean: Array, x: Array) -> NDArray[np.bool_]:
    """Return (N, X) which lines stay within 45 deg of the car's axis from 0 m to x."""
    way = np.linspace(0, 1, 81) * x[:, None]  # (X, 81)
    beta, c0, c1 = (mean[:, i, None, None] for i in (1, 2, 3))
    slope = np.tan(beta) + way * (c0 + way * c1 / 2)
    return np.asarray((np.abs(slope) < 1).all(axis=2))


# ---- tables -------------------------------------------------------------------------------------

Record = dict[str, str | int | float | None]


def as_records(rows: Sequence[RoundingRow]) -> list[Record]:
    """Return a flat dictionary per row, in SI units; None is not sent or not known."""
    return [_record(row) for row in rows]


def _record(row: RoundingRow) -> Record:
    message = row.message
    record: Record = {"maker": message.maker, "message": message.name, "bits": message.bits}
    for state, signal in zip(PARAMETERS, message.signals, strict=True):
        values: Sequence[str | int | float | None] = (None,) * 7
        if signal:
            values = (signal.length, signal.factor, signal.offset, int(signal.signed), signal.unit)
            values = (*values, *signal.physical_range)
        names = ("bits", "factor", "offset", "signed", "unit", "low", "high")
        record |= {f"{state}_{name}": v for name, v in zip(names, values, strict=True)}
    record |= {"reading": _reading(message), "documented": int(message.documented)}
    record |= {name: getattr(message, name) for name in ("uncertainty", "source", "certainty")}
    record |= {"lines": row.lines, "fit": row.fit}
    record |= {f"{s}_clipped": count for s, count in zip(PARAMETERS, row.clipped, strict=True)}
    for name in (
        *("evaluated", "worst", "worst_other", "rms", "measured_rms", "measured_worst"),
        *("truncated_rms", "truncated_median", "sigma_best", "sigma_median"),
    ):
        figures = getattr(row, name) or (np.nan,) * len(DISTANCES)
        suffix = "" if name == "evaluated" else "_m"
        places = (f"{name}_at_{x:g}m{suffix}" for x in DISTANCES)
        record |= dict(zip(places, map(_known, figures), strict=True))
    for name in ("rounding_kl", "rounding_kl_pose"):
        quantiles = (f"{name}_{100 * share:g}" for share in KL_QUANTILES)
        record |= dict(zip(quantiles, map(_known, getattr(row, name)), strict=True))
    return record


def _known(value: float) -> float | None:
    return None if np.isnan(value) else value


def as_csv(rows: Sequence[RoundingRow]) -> str:
    """Return one line per row with all figures, in SI units and to six digits."""
    records = as_records(rows)
    return csv_text([records[0], *(record.values() for record in records)]) if records else "\n"


def as_markdown(rows: Sequence[RoundingRow]) -> str:
    """Return tables for a page: signals, sources, errors of steps, errors measured on lines."""
    sent, known, steps, seen = _tables(rows)
    return "\n".join([markdown(sent), markdown(known), markdown(steps, 1), markdown(seen, 1)])


def as_text(rows: Sequence[RoundingRow]) -> str:
    """Return the same tables for a terminal."""
    return "\n\n".join(map(aligned, _tables(rows))) + "\n"


def _tables(rows: Sequence[RoundingRow]) -> tuple[list[list[str]], ...]:
    """Return the cells of the tables, headings first."""
    at = " / ".join(f"{x:g}" for x in DISTANCES) + " m"
    sent = [["message", *PARAMETERS, "bits"]]
    known = [["message", "reading", "says of its uncertainty", "source", "certainty"]]
    steps = [["message", f"worst at {at} [cm]", "worst, other reading", "rms"]]
    seen = [
        [
            "message",
            "lines that fit",
            f"out of range: {', '.join(PARAMETERS)}",
            f"measured rms at {at} [cm]",
            "measured worst",
            "rounding KL, median: pose and map error / pose error only [nat]",
        ]
    ]
    for row in rows:
        message = row.message
        title = f"{message.maker} {message.name}"
        sent.append([title, *map(_signal_text, message.signals), str(message.bits)])
        known.append(
            [title, _reading(message), message.uncertainty, message.source, message.certainty]
        )
        steps.append([title, _cm(row.worst), _cm(row.worst_other), _cm(row.rms)])
        clipped = (
            _share(count, row.lines) if signal else "-"
            for count, signal in zip(row.clipped, message.signals, strict=True)
        )
        fit, kl = _share(row.fit, row.lines), (row.rounding_kl[0], row.rounding_kl_pose[0])
        measured = [_cm(row.measured_rms), _cm(row.measured_worst)]
        seen.append([title, fit, ", ".join(clipped), *measured, "{:.1g} / {:.1g}".format(*kl)])
        if row.truncated_rms is not None:
            median = f"median {_cm(row.truncated_median)}"
            seen.append(
                [f"{title}, its missing part as 0", "", "", _cm(row.truncated_rms), median, ""]
            )
    for name, values in (
        ("10 % of the lines are below", rows[-1].sigma_best),
        ("half of the lines are below", rows[-1].sigma_median),
    ):
        seen.append([f"sigma: {name}", "", "", _cm(values), "", ""])
    return sent, known, steps, seen


def _reading(message: Message) -> str:
    return ("polynomial" if message.polynomial else "curvature") + (
        "" if message.documented else "?"
    )


def _signal_text(signal: Signal | None) -> str:
    """Return width, factor, offset and range.

    >>> _signal_text(PRODUCTION[3].signals[0]), _signal_text(PRODUCTION[0].signals[0])
    ('10 b, 0.01 m - 5.12, -5.12 .. 5.11', '16 b signed, 0.00390625 m, -128 .. 128')
    """
    if signal is None:
        return "-"
    sign = " signed" if signal.signed else ""
    unit = f" {signal.unit}" if signal.unit else ""
    offset = signal.offset and f" {'-' if signal.offset < 0 else '+'} {abs(signal.offset):.6g}"
    low, high = signal.physical_range
    step = f"{signal.factor:.6g}{unit}{offset or ''}"
    return f"{signal.length} b{sign}, {step}, {low:.3g} .. {high:.3g}"


def _cm(values: Sequence[float] | None) -> str:
    """Return metres at the distances, in cm and to two digits.

    >>> _cm((0.0012, 0.0975, 7.658)), _cm(None)
    ('0.12 / 9.8 / 770', '-')
    """
    if values is None:
        return "-"
    return " / ".join("-" if np.isnan(v) else f"{float(f'{100 * v:.2g}'):g}" for v in values)


def _share(count: int, total: int) -> str:
    return f"{100 * count / total:.0f} %"
