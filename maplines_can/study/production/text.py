"""The table of production messages as text, as Markdown, and flat for CSV and JSON."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...values.line import PARAMETERS
from ...wire.layout.signals import Signal
from ..text_table import aligned, csv_text, markdown
from .messages import Message
from .rounding import DISTANCES, KL_QUANTILES, RoundingRow

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

    >>> from .messages import PRODUCTION
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
