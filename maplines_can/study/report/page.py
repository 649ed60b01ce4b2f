"""The report on covariance codes: one HTML file that needs no network."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ...values.errors import missing_extra
from ...values.output_files import whole_file
from ..codes import CODES
from ..metrics import LATERAL_X
from ..scenes.table import HEAD, cells_of
from .tables import (
    MAX_KL,
    SUMMARY,
    Row,
    Tables,
    number,
    percent,
    read_tables,
    share,
    with_error,
)

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

        from .cases import worst_groups
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

    from .cases import fields_plot, worst_plots
    from .drawing import plot_styles
    from .plots import (
        kl_plot,
        lateral_error_plot,
        scenes_plot,
        share_plot,
        sigma_ratio_plot,
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
    from .choice import choices

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

    from .cases import BAND
    from .choice import bits_more

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
        "scene_heads": HEAD,
        "scene_cells": cells_of,
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
