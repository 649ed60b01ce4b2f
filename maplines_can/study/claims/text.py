"""The accuracy table as text, CSV and Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

import numpy as np

from ..metrics import LATERAL_X
from ..text_table import aligned, csv_text, markdown
from .evaluation import ClaimRow

_NAMES = ("scenario", "representation", "wire")
#: Headings of the figures by their names in CSV.
_HEADINGS = {
    "false_negatives": "FN 4-D",
    "false_negatives_pairs": "FN pairs",
    "false_positives": "FP pairs",
    "kl": "KL [nat]",
    "coverage": "coverage",
    **{f"mean_error_at_{x:g}m_m": f"error {x:g} m [m]" for x in LATERAL_X},
    **{f"sigma_ratio_at_{x:g}m": f"sigma ratio {x:g} m" for x in LATERAL_X},
}


def as_csv(rows: Sequence[ClaimRow]) -> str:
    """Return one line per row: each figure to six digits, followed by its standard error."""
    heading = [*_NAMES, *(f"{name}{end}" for name in _HEADINGS for end in ("", "_se"))]
    body = ([*_names(row), *chain.from_iterable(_figures(row))] for row in rows)
    return csv_text([heading, *body])


def as_markdown(rows: Sequence[ClaimRow]) -> str:
    """Return one Markdown table of figures with their standard errors."""
    body = [[*_names(row), *(_with_error(*pair) for pair in _figures(row))] for row in rows]
    return markdown([[*_NAMES, *_HEADINGS.values()], *body], left=len(_NAMES))


def as_text(rows: Sequence[ClaimRow]) -> str:
    """Return three tables per scenario for a terminal: shares and KL, mean error, sigma ratio."""
    blocks, headings = [], list(_HEADINGS.values())
    for scenario in dict.fromkeys(row.scenario for row in rows):
        of_scenario = [row for row in rows if row.scenario == scenario]
        blocks.append(scenario)
        for part in (slice(5), slice(5, 9), slice(9, None)):
            body = [
                [*_names(row)[1:], *(_with_error(*pair) for pair in _figures(row)[part])]
                for row in of_scenario
            ]
            blocks.append(aligned([[*_NAMES[1:], *headings[part]], *body], left=2))
    return "\n\n".join(blocks) + "\n"


def _names(row: ClaimRow) -> list[str]:
    return [str(getattr(row, name)) for name in _NAMES]


def _figures(row: ClaimRow) -> list[tuple[float, float]]:
    """Return each figure and its standard error, in the order of the headings."""
    pairs = [
        (np.atleast_1d(getattr(row, name)), np.atleast_1d(getattr(row, f"{name}_se")))
        for name in (*list(_HEADINGS)[:5], "mean_error", "sigma_ratio")
    ]
    values, errors = (np.concatenate(part).tolist() for part in zip(*pairs, strict=True))
    return list(zip(values, errors, strict=True))


def _with_error(value: float, error: float) -> str:
    """Return a figure and its error, rounded to the second digit of the error.

    >>> _with_error(0.0123456, 0.00012), _with_error(1.0, 0.0), _with_error(12345.6, 210)
    ('0.01235 ± 0.00012', '1', '12350 ± 210')
    """
    if not error:
        return f"{value:g}"
    digits = 1 - int(np.floor(np.log10(error)))
    places = max(digits, 0)
    return f"{round(value, digits):.{places}f} ± {round(error, digits):.{places}f}"
