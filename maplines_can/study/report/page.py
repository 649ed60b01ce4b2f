"""The report on covariance codes: one HTML file that needs no network."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ...errors import MissingExtraError
from . import numbers
from .tables import SUMMARY, Row, Tables, number, percent, read_tables

__all__ = ["TITLE", "write_report"]

TITLE = "Covariance codes on the wire"
#: Pairs of shares: column, words, and the column of the guarantee that it is 0.
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
            ``worst.parquet`` and ``limit.parquet``.
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
        from bokeh.embed import components
        from bokeh.resources import Resources
        from jinja2 import Environment, PackageLoader

        from .cases import BAND, worst_groups
        from .drawing import looks
    except ImportError as error:
        raise MissingExtraError(
            'the report needs bokeh, jinja2 and pyarrow: pip install "maplines_can[study]"'
        ) from error
    tables = read_tables(folder)
    first = [row for set_ in tables.sets if (row := tables.shipped(set_, tables.codes[0]))]
    content = _content(tables)
    models = {
        f"{section}-{i}-{k}": plot
        for section, figures in content.items()
        for i, (plots, _) in enumerate(figures)
        for k, plot in enumerate(plots)
    }
    script, plots = components(models)
    environment = Environment(
        loader=PackageLoader(__package__, "."), autoescape=True, trim_blocks=True
    )
    environment.globals |= {"number": number, "percent": percent}
    html = environment.get_template("report.html.j2").render(
        title=title,
        tables=tables,
        content=content,
        plots=plots,
        script=script,
        library=Resources(mode="inline", components=["bokeh"]).render_js(),
        looks=looks(tables.codes),
        first=first,
        counts={"n": sum(row["n"] for row in first)}
        | {name: sum(round(row[name] * row["n"]) for row in first) for name, *_ in NOT_DEFINITE},
        broken=list(_broken_guarantees(tables)),
        sound=_sound(tables),
        nearest=[row for set_ in tables.sets if (row := _nearest(tables, set_))],
        caveats={
            row["caveat"]: row["set"]
            for row in tables.limit
            if row["part"] == "covariance" and isinstance(row.get("caveat"), str)
        },
        kl_names=SUMMARY,
        field_codes={code: code for code in _field_codes(tables)},
        worst_groups=worst_groups(tables),
        band=BAND,
    )
    out_path = Path(out_path)
    out_path.parent.mkdir(parents=True, exist_ok=True)
    out_path.write_text(html, encoding="utf-8")
    return out_path


def _content(tables: Tables) -> dict[str, list[tuple[list[Any], list[numbers.NumberTable]]]]:
    """Return plots and tables by section and set; no sets if the sweep did not compute them."""
    from .cases import fields_plot, worst_groups, worst_plots
    from .drawing import looks
    from .plots import kl_plot, lateral_error_plot, share_plot, sigma_ratio_plot

    look = looks(tables.codes)
    codes = _field_codes(tables)
    keys = [key for group in worst_groups(tables).values() for key in group]

    def along(set_: str) -> list[Any]:
        return [lateral_error_plot(tables, set_, look), sigma_ratio_plot(tables, set_, look)]

    def shares(set_: str, quantities: Any) -> tuple[list[Any], list[numbers.NumberTable]]:
        plot = share_plot(tables, set_, look, quantities)
        return [plot], [numbers.share_table(tables, set_, quantities)]

    content: dict[str, list[Any]] = {
        name: [] for name in ("kl", "along", "definite", "fields", "saturation", "worst")
    }
    for set_ in tables.sets:
        kl_tables = [numbers.kl_table(tables, set_), numbers.limit_table(tables, set_)]
        content["kl"].append(([kl_plot(tables, set_, look)], kl_tables))
        content["along"].append((along(set_), [numbers.along_table(tables, set_)]))
        content["definite"].append(shares(set_, NOT_DEFINITE))
        content["saturation"].append(shares(set_, SATURATION))
        if codes:
            plots = [fields_plot(tables, set_, codes)]
            content["fields"].append((plots, [numbers.fields_table(tables, set_)]))
        if keys:
            plots = list(worst_plots(tables, set_, keys))
            content["worst"].append((plots, [numbers.worst_table(tables, set_)]))
    return content


def _field_codes(tables: Tables) -> list[str]:
    return [code for code in tables.codes if any(row["code"] == code for row in tables.fields)]


def _broken_guarantees(tables: Tables) -> Iterator[tuple[Row, str, float]]:
    for row in tables.summary:
        for column, words, guarantee in NOT_DEFINITE:
            if row[guarantee] and row[column] > 0:
                yield row, words, row[column]


def _sound(tables: Tables) -> list[str]:
    """Return the codes that are always definite and never overconfident with their DBCs."""
    shipped = [row for set_ in tables.sets for row in tables.shipped_of(set_)]
    failed = {r["code"] for r in shipped if r["not_positive_definite"] + r["overconfident"] > 0}
    return [code for code in tables.codes if code not in failed]


def _nearest(tables: Tables, set_: str) -> Row | None:
    """Return the row with the fewest bits above the limit among those never overconfident."""
    rows = [
        (over, i, row)
        for i, row in enumerate(tables.summary)
        if row["set"] == set_ and row["overconfident"] == 0
        if (over := tables.over_limit(row)) is not None
    ]
    return min(rows)[2] if rows else None
