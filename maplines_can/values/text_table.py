"""Rows of text cells as a table, for a terminal, for Markdown and as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence


def aligned(rows: Sequence[Sequence[str]], left: int | None = None) -> str:
    """Return the rows with columns of one width.

    Args:
        rows: cells, the headings first.
        left: number of columns aligned to the left, the others to the right; all by default.

    >>> print(aligned([["code", "bits"], ["Float16", "160"]], left=1))
    code     bits
    Float16   160
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    left = len(widths) if left is None else left
    return "\n".join(
        "  ".join(
            cell.ljust(width) if i < left else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )


def markdown(rows: Sequence[Sequence[str]], left: int | None = None) -> str:
    """Return the rows as a Markdown table that ends with a line break; arguments as above.

    >>> print(markdown([["code", "bits"], ["Float16", "160"]], left=1), end="")
    | code | bits |
    | --- | ---: |
    | Float16 | 160 |
    """
    left = len(rows[0]) if left is None else left
    rule = ["---" if i < left else "---:" for i in range(len(rows[0]))]
    return "".join("| " + " | ".join(row) + " |\n" for row in (rows[0], rule, *rows[1:]))


def percent(share: float) -> str:
    """Return a share in percent, to two digits.

    >>> percent(0.0123), percent(0.0)
    ('1.2 %', '0 %')
    """
    return f"{100 * share:.2g} %"


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """Return the rows as CSV, floats to six digits.

    >>> print(csv_text([["code", "share"], ["Float16", 1 / 3]]), end="")
    code,share
    Float16,0.333333
    """
    out = io.StringIO()
    cells = ([f"{cell:.6g}" if isinstance(cell, float) else cell for cell in row] for row in rows)
    csv.writer(out, lineterminator="\n").writerows(cells)
    return out.getvalue()
