"""The table of production messages as text, as Markdown, and flat for CSV and JSON."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

import numpy as np

from ...line import STATES
from ...wire.message.signals import Signal
from .messages import DISTANCES, KL_QUANTILES, Message, Row

__all__ = ["as_csv", "as_markdown", "as_records", "as_text"]


def as_records(rows: Sequence[Row]) -> list[dict[str, str | int | float | None]]:
    """One flat dictionary a row, in SI units; what is not sent or not known is None."""
    return [_record(row) for row in rows]


def _record(row: Row) -> dict[str, str | int | float | None]:
    message = row.message
    record: dict[str, str | int | float | None] = {
        "maker": message.maker,
        "message": message.name,
        "bits": message.bits,
    }
    for state, field in zip(STATES, message.fields, strict=True):
        low, high = field.physical_range if field else (None, None)
        record |= {
            f"{state}_bits": field.length if field else None,
            f"{state}_factor": field.factor if field else None,
            f"{state}_offset": field.offset if field else None,
            f"{state}_signed": int(field.signed) if field else None,
            f"{state}_unit": field.unit if field else None,
            f"{state}_low": low,
            f"{state}_high": high,
        }
    record |= {
        "reading": _reading(message),
        "documented": int(message.documented),
        "uncertainty": message.uncertainty,
        "source": message.source,
        "certainty": message.certainty,
        "lines": row.lines,
        "fit": row.fit,
    }
    record |= {f"{s}_clipped": count for s, count in zip(STATES, row.clipped, strict=True)}
    for name in (
        *("judged", "worst", "worst_other", "rms", "measured_rms", "measured_worst"),
        *("truncated_rms", "truncated_median", "sigma_best", "sigma_median"),
    ):
        values = getattr(row, name) or (None,) * len(DISTANCES)
        suffix = "" if name == "judged" else "_m"
        record |= {
            f"{name}_at_{x:g}m{suffix}": None if value is None or np.isnan(value) else value
            for x, value in zip(DISTANCES, values, strict=True)
        }
    for name in ("rounding_kl", "rounding_kl_pose"):
        record |= {
            f"{name}_{100 * share:g}": None if np.isnan(value) else value
            for share, value in zip(KL_QUANTILES, getattr(row, name), strict=True)
        }
    return record


def as_csv(rows: Sequence[Row]) -> str:
    """One line a row, all of it, in SI units and to six digits."""
    out = io.StringIO()
    records = as_records(rows)
    writer = csv.DictWriter(out, list(records[0]) if records else [], lineterminator="\n")
    writer.writeheader()
    for record in records:
        writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in record.items()})
    return out.getvalue()


def as_markdown(rows: Sequence[Row]) -> str:
    """Tables for a page: what is sent, how sure that is, what steps lose, what lines show."""
    return "\n".join(
        "".join(
            "| " + " | ".join(line) + " |\n"
            for line in (header, ["---"] + [mark] * (len(header) - 1), *body)
        )
        for mark, (header, *body) in zip(("---", "---", "---:", "---:"), _tables(rows), strict=True)
    )


def as_text(rows: Sequence[Row]) -> str:
    """The same tables for a terminal."""
    blocks = []
    for table in _tables(rows):
        widths = [max(map(len, column)) for column in zip(*table, strict=True)]
        blocks.append("\n".join("  ".join(map(str.ljust, line, widths)).rstrip() for line in table))
    return "\n\n".join(blocks) + "\n"


def _tables(rows: Sequence[Row]) -> tuple[list[list[str]], ...]:
    """Cells of the tables, their headings first."""
    at = " / ".join(f"{x:g}" for x in DISTANCES) + " m"
    sent = [["message", *STATES, "bits"]]
    known = [["message", "reading", "says of its uncertainty", "source", "certainty"]]
    steps = [["message", f"worst at {at} [cm]", "worst, other reading", "rms"]]
    seen = [
        [
            "message",
            "lines that fit",
            f"out of range: {', '.join(STATES)}",
            f"measured rms at {at} [cm]",
            "measured worst",
            "rounding KL, median: pose and map error / pose error only [nat]",
        ]
    ]
    for row in rows:
        message = row.message
        title = f"{message.maker} {message.name}"
        sent.append([title, *map(_field_text, message.fields), str(message.bits)])
        known.append(
            [title, _reading(message), message.uncertainty, message.source, message.certainty]
        )
        steps.append([title, _cm(row.worst), _cm(row.worst_other), _cm(row.rms)])
        clipped = (
            _share(count, row.lines) if field else "-"
            for count, field in zip(row.clipped, message.fields, strict=True)
        )
        seen.append(
            [
                title,
                _share(row.fit, row.lines),
                ", ".join(clipped),
                _cm(row.measured_rms),
                _cm(row.measured_worst),
                f"{row.rounding_kl[0]:.1g} / {row.rounding_kl_pose[0]:.1g}",
            ]
        )
        if row.truncated_rms is not None:
            median = f"median {_cm(row.truncated_median)}"
            seen.append(
                [f"{title}, its missing part as 0", "", "", _cm(row.truncated_rms), median, ""]
            )
    if rows:
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


def _field_text(field: Signal | None) -> str:
    """Width, factor, offset and range.

    >>> from .messages import PRODUCTION
    >>> _field_text(PRODUCTION[3].fields[0]), _field_text(PRODUCTION[0].fields[0])
    ('10 b, 0.01 m - 5.12, -5.12 .. 5.11', '16 b signed, 0.00390625 m, -128 .. 128')
    """
    if field is None:
        return "-"
    sign = " signed" if field.signed else ""
    unit = f" {field.unit}" if field.unit else ""
    offset = f" {'-' if field.offset < 0 else '+'} {abs(field.offset):.6g}" if field.offset else ""
    low, high = field.physical_range
    return f"{field.length} b{sign}, {field.factor:.6g}{unit}{offset}, {low:.3g} .. {high:.3g}"


def _cm(values: Sequence[float] | None) -> str:
    """Metres at the distances, in cm and to two digits.

    >>> _cm((0.0012, 0.0975, 7.658)), _cm(None)
    ('0.12 / 9.8 / 770', '-')
    """
    if values is None:
        return "-"
    return " / ".join(_two_digits(100 * value) for value in values)


def _two_digits(value: float) -> str:
    return "-" if np.isnan(value) else f"{float(f'{value:.2g}'):g}"


def _share(count: int, total: int) -> str:
    return f"{100 * count / total:.0f} %"
