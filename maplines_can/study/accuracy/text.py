"""The table of truth as text, CSV and Markdown."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from ..metrics import LATERAL_X
from .evaluation import Row

__all__ = ["as_csv", "as_markdown", "as_text"]


def _columns() -> Iterator[tuple[str, str, Callable[[Row], float], Callable[[Row], float]]]:
    """Name in CSV, heading, figure and error, in the order of the row."""
    for name, heading in (
        ("false_negatives", "FN 4-D"),
        ("false_negatives_pairs", "FN pairs"),
        ("false_positives", "FP pairs"),
        ("kl", "KL [nat]"),
        ("coverage", "coverage"),
    ):
        yield name, heading, _getter(name), _getter(f"{name}_se")
    for name, heading, unit, suffix in (
        ("mean_error", "error", " [m]", "_m"),
        ("sigma_ratio", "sigma ratio", "", ""),
    ):
        for i, x in enumerate(LATERAL_X):
            yield (
                f"{name}_at_{x:g}m{suffix}",
                f"{heading} {x:g} m{unit}",
                _getter(name, i),
                _getter(f"{name}_se", i),
            )


def _getter(name: str, index: int | None = None) -> Callable[[Row], float]:
    def get(row: Row) -> float:
        value = getattr(row, name)
        return float(value if index is None else value[index])

    return get


_NAMES = ("scenario", "representation", "wire")


def as_csv(rows: Sequence[Row]) -> str:
    """One line a row, each figure to six digits and followed by its standard error."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    columns = list(_columns())
    writer.writerow([*_NAMES, *(f"{name}{end}" for name, *_ in columns for end in ("", "_se"))])
    for row in rows:
        figures = (f"{get(row):.6g}" for _, _, *pair in columns for get in pair)
        writer.writerow([*(getattr(row, name) for name in _NAMES), *figures])
    return out.getvalue()


def as_markdown(rows: Sequence[Row]) -> str:
    """A table for a page, figures with their standard errors."""
    header, *body = _cells_of(rows, list(_columns()), _NAMES)
    lines = [header, ["---"] * len(_NAMES) + ["---:"] * (len(header) - len(_NAMES)), *body]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def as_text(rows: Sequence[Row]) -> str:
    """Two tables a scene for a terminal: the shares and KL, and the lateral band."""
    columns, blocks = list(_columns()), []
    for scene in dict.fromkeys(row.scenario for row in rows):
        of_scene = [row for row in rows if row.scenario == scene]
        blocks.append(scene)
        for part in (columns[:5], columns[5:9], columns[9:]):
            table = _cells_of(of_scene, part, _NAMES[1:])
            widths = [max(map(len, column)) for column in zip(*table, strict=True)]
            blocks.append(
                "\n".join(
                    "  ".join(
                        cell.ljust(width) if i < 2 else cell.rjust(width)
                        for i, (cell, width) in enumerate(zip(line, widths, strict=True))
                    )
                    for line in table
                )
            )
    return "\n\n".join(blocks) + "\n"


def _cells_of(
    rows: Sequence[Row],
    columns: Sequence[tuple[str, str, Callable[[Row], float], Callable[[Row], float]]],
    names: Sequence[str],
) -> list[list[str]]:
    header = [*names, *(heading for _, heading, *_ in columns)]
    body = [
        [
            *(str(getattr(row, name)) for name in names),
            *(_with_error(get(row), error(row)) for _, _, get, error in columns),
        ]
        for row in rows
    ]
    return [header, *body]


def _with_error(value: float, error: float) -> str:
    """A figure and its error, to the error's second digit.

    >>> _with_error(0.0123456, 0.00012), _with_error(1.0, 0.0), _with_error(12345.6, 210)
    ('0.01235 ± 0.00012', '1', '12350 ± 210')
    """
    if not error:
        return f"{value:g}"
    digits = 1 - int(np.floor(np.log10(error)))
    places = max(digits, 0)
    return f"{round(value, digits):.{places}f} ± {round(error, digits):.{places}f}"
