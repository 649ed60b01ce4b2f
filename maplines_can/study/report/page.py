"""The report on covariance codes: one HTML file that needs no network."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ...values.coding_loss import LATERAL_X
from ...values.errors import missing_extra
from ...values.output_files import whole_file
from ..codes import CODES
from ..scenes.carriers import SCENE_HEAD, scene_cells
from ..sweep.summary import Row
from .results import MAX_KL, SUMMARY, Tables, number, percent, read_tables, share, with_error

#: A code with the same widths on every set of the sweep: its rows of the summary.
Variant = list[Row]


class Choice(NamedTuple):
    """Recommendation for a number of classic CAN frames, and its reason."""

    advice: str
    reason: str


def choices(tables: Tables) -> list[Choice]:
    """Return a recommendation for each number of frames at which it changes.

    A code is valid if every decoded covariance was positive definite and covered its target, on
    all sets. Of the valid ones that fit, the one with the least KL at 99 % of the Gaussians is
    best, on the set where that is largest.
    """
    variants = _variants(tables)
    found: list[Choice] = []
    last: Variant | None = None
    for frames in sorted({_frames(variant) for variant in variants}):
        fitting = [variant for variant in variants if _frames(variant) <= frames]
        valid = [variant for variant in fitting if not _fault(variant)]
        best = min(valid, key=_kl_99, default=None)
        if best is None:
            advice = f"For {_words(frames)} choose none."
            found.append(Choice(advice, f"No code that fits is valid: {_faults(fitting)}."))
        elif best is not last:
            found.append(_choice(frames, best, valid, fitting, is_first=last is None))
        last = best
    return found


def _choice(
    frames: int,
    best: Variant,
    valid: Sequence[Variant],
    fitting: Sequence[Variant],
    *,
    is_first: bool,
) -> Choice:
    row = best[0]
    finer = f" with {bits_more(row['finer_bits'])} in each field" if row["finer_bits"] else ""
    advice = (
        f"For {_words(frames)} choose {row['code']}{finer}: {row['covariance_bits']} bits for the "
        "covariance."
    )
    kl = _kl_99(best)
    reason = (
        f"On each set, 99 % of its Gaussians have a KL up to {number(kl)} nat, as if all four "
        f"standard deviations were {_wider(kl)} too large."
    )
    if not is_first:
        return Choice(advice, reason)
    by_construction = row["definite_guarantee"] and row["covering_guarantee"]
    others = {variant[0]["code"]: variant for variant in sorted(valid, key=_kl_99, reverse=True)}
    others.pop(row["code"])
    reason = (
        f"It is always positive definite and never overconfident"
        f"{', by construction' if by_construction else ' on these sets'}. {reason}"
    )
    if others:
        rest = ", ".join(f"{number(_kl_99(v))} nat with {code}" for code, v in others.items())
        reason += f" That is the least of the valid codes: {rest}."
    if faults := _faults([variant for variant in fitting if variant not in valid]):
        reason += f" The other codes that fit are not valid: {faults}."
    return Choice(advice, reason)


def _variants(tables: Tables) -> list[Variant]:
    """Return the codes with each of their widths for which all sets have results."""
    found: dict[tuple[str, int], Variant] = {}
    for row in tables.summary:
        found.setdefault((row["code"], row["finer_bits"]), []).append(row)
    return [rows for rows in found.values() if len(rows) == len(tables.sets)]


def _frames(variant: Variant) -> int:
    return int(variant[0]["classic_frames"])


def _kl_99(variant: Variant) -> float:
    """Return the KL at 99 % on the worst set; infinite if it is not defined."""
    return max(math.inf if math.isnan(row["kl_p99"]) else row["kl_p99"] for row in variant)


def _fault(variant: Variant) -> str:
    """Return why a variant is not valid; empty if it is."""
    if not variant[0]["covariance_bits"]:
        return "sends no covariance"
    for column, words in (
        ("not_positive_definite", "is not positive definite"),
        ("overconfident", "is overconfident"),
    ):
        if (most := max(row[column] for row in variant)) > 0:
            return f"{words} for up to {percent(most)} of the Gaussians"
    return ""


def _faults(variants: Sequence[Variant]) -> str:
    """Return why each code is not valid, for the widths nearest to those of its DBC."""
    nearest = {v[0]["code"]: v for v in sorted(variants, key=lambda v: -abs(v[0]["finer_bits"]))}
    return "; ".join(f"{code} {fault}" for code, v in nearest.items() if (fault := _fault(v)))


def _wider(kl: float) -> str:
    """Return by how much all four standard deviations exceed the true ones at this KL.

    With the variances r times the true ones, the KL is 2 (1/r - 1 + ln r) nat.

    >>> _wider(0.01), _wider(1e-4), _wider(15.0)
    ('5.2 %', '0.5 %', 'more than ten times')
    """
    low, high = 1.0, 10.0
    if kl > 2 * (1 / high**2 - 1 + 2 * math.log(high)):
        return "more than ten times"
    for _ in range(60):
        middle = (low + high) / 2
        below = 2 * (1 / middle**2 - 1 + 2 * math.log(middle)) < kl
        low, high = (middle, high) if below else (low, middle)
    return percent(float(f"{low - 1:.2g}"))


def bits_more(bits: int) -> str:
    """Return a change of a width in words.

    >>> bits_more(2), bits_more(-1)
    ('2 bits more', '1 bit less')
    """
    return f"{abs(bits)} bit{'s' * (abs(bits) != 1)} {'more' if bits > 0 else 'less'}"


def _words(frames: int) -> str:
    return f"{frames} classic CAN frame" + "s" * (frames != 1)


# ---- the page -----------------------------------------------------------------------------------

TITLE = "Covariance codes on the wire"
#: (share column, label, column that is True if the share is guaranteed to be 0).
NOT_DEFINITE = (
    ("not_positive_definite", "not positive definite", "definite_guarantee"),
    ("overconfident", "overconfident", "covering_guarantee"),
)
SATURATION = (("saturated", "saturated", ""), ("out_of_range", "out of range", ""))


def write_report(folder: str | Path, out_path: str | Path, *, title: str = TITLE) -> Path:
    """Write the report on the tables of a sweep.

    The file includes its scripts and plots, and loads nothing.

    Args:
        folder: with the sweep's tables, ``summary.parquet``, ``fields.parquet``,
            ``worst.parquet``, ``limit.parquet`` and ``scenes.parquet``.
        out_path: the HTML file; its folder is created if it does not exist.
        title: of the page.

    Returns:
        The path of the file.

    Raises:
        MissingExtraError: bokeh, jinja2 or pyarrow is not installed.
        StudyError: the folder or a table does not exist, is not readable, lacks columns, or the
            summary has no rows.
        OSError: the file cannot be written.
    """
    try:
        import bokeh.embed  # noqa: F401
        import jinja2  # noqa: F401 - whether it is installed
        import pyarrow as pa  # noqa: F401

        from .plots import worst_groups
    except ImportError as error:
        raise missing_extra("the report needs bokeh, jinja2 and pyarrow", "study") from error
    tables = read_tables(folder)
    groups = worst_groups(tables)
    html = _template(tables).render(
        title=title, worst_groups=groups, **_plots(tables, groups), **_texts(tables)
    )
    out_path = Path(out_path)
    out_path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(out_path) as part:
        part.write_text(html, encoding="utf-8")
    return out_path


def _plots(tables: Tables, groups: Mapping[str, Mapping[str, str]]) -> dict[str, Any]:
    """Return the plots by section and set, none if the sweep did not compute them, and scripts."""
    from bokeh.embed import components
    from bokeh.resources import Resources

    from .drawing import plot_styles
    from .plots import (
        fields_plot,
        kl_plot,
        lateral_error_plot,
        scenes_plot,
        share_plot,
        sigma_ratio_plot,
        worst_plots,
    )

    sets, look = tables.sets, plot_styles(tables.codes)
    field_codes = [c for c in tables.codes if any(row["code"] == c for row in tables.fields)]
    keys = [key for group in groups.values() for key in group]
    content: dict[str, list[Any]] = {
        "kl": [[kl_plot(tables, s, look)] for s in sets],
        "along": [
            [lateral_error_plot(tables, s, look), sigma_ratio_plot(tables, s, look)] for s in sets
        ],
        "definite": [[share_plot(tables, s, look, NOT_DEFINITE)] for s in sets],
        "fields": [[fields_plot(tables, s, field_codes)] for s in sets if field_codes],
        "saturation": [[share_plot(tables, s, look, SATURATION)] for s in sets],
        "worst": [worst_plots(tables, s, keys) for s in sets if keys],
        "scenes": [
            [scenes_plot(tables, lines)]
            for lines in dict.fromkeys(row["lines"] for row in tables.scenes)
        ],
    }
    script, plots = components(
        {
            f"{section}-{i}-{k}": plot
            for section, of_sets in content.items()
            for i, of_set in enumerate(of_sets)
            for k, plot in enumerate(of_set)
        }
    )
    return {
        "content": content,
        "plots": plots,
        "script": script,
        "library": Resources(mode="inline", components=["bokeh"]).render_js(),
        "plot_styles": look,
        "field_codes": {code: code for code in field_codes},
    }


def _texts(tables: Tables) -> dict[str, Any]:
    """Return what the page says of the tables."""
    first = [row for s in tables.sets if (row := tables.shipped(s, tables.codes[0]))]
    return {
        "first": first,
        "choices": choices(tables),
        "about": {code: CODES[code].about if code in CODES else "" for code in tables.codes},
        "counts": {"n": sum(row["n"] for row in first)}
        | {name: sum(round(row[name] * row["n"]) for row in first) for name, *_ in NOT_DEFINITE},
        "broken": [
            (row, label, row[column])
            for row in tables.summary
            for column, label, guarantee in NOT_DEFINITE
            if row[guarantee] and row[column] > 0
        ],
        "always_valid": _always_valid(tables),
        "nearest": [row for s in tables.sets if (row := _nearest(tables, s))],
        "caveats": {
            row["caveat"]: row["set"]
            for row in tables.limit
            if row["part"] == "covariance" and isinstance(row.get("caveat"), str)
        },
    }


def _template(tables: Tables) -> Any:
    """Return the template of the page, with what its macros use."""
    from jinja2 import Environment, PackageLoader

    from .plots import BAND

    loader = PackageLoader(__package__, ".")
    environment = Environment(loader=loader, autoescape=True, trim_blocks=True)
    environment.globals |= {
        "bits_more": bits_more,
        "number": number,
        "percent": percent,
        "share": share,
        "with_error": with_error,
        "nan": math.nan,
        "tables": tables,
        "kl_names": SUMMARY,
        "lateral_x": [f"{x:g}" for x in LATERAL_X],
        "not_definite": NOT_DEFINITE,
        "saturation": SATURATION,
        "largest_kl": MAX_KL,
        "scene_heads": SCENE_HEAD,
        "scene_cells": scene_cells,
        "band": BAND,
    }
    return environment.get_template("report.html.j2")


def _always_valid(tables: Tables) -> list[str]:
    """Return the codes that are always valid and never overconfident, at their DBCs' bit widths."""
    shipped = [row for set_ in tables.sets for row in tables.shipped_of(set_)]
    failed = {r["code"] for r in shipped if r["not_positive_definite"] + r["overconfident"] > 0}
    return [code for code in tables.codes if code not in failed]


def _nearest(tables: Tables, set_: str) -> Row | None:
    """Return the row nearest to the rate-distortion bound among those never overconfident."""
    rows = [
        (over, i, row)
        for i, row in enumerate(tables.summary)
        if row["set"] == set_ and row["overconfident"] == 0
        if (over := tables.over_limit(row)) is not None
    ]
    return min(rows)[2] if rows else None
