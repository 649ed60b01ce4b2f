"""The report on covariance codes: one HTML file that needs no network."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...errors import MissingExtraError
from .findings import findings, headline
from .tables import Tables, read_tables
from .text import swatch

if TYPE_CHECKING:
    from .parts import Look
    from .sections import Section

__all__ = ["TITLE", "write_report"]

TITLE = "Covariance codes on the wire"
#: The browser itself keeps the page from loading anything from elsewhere.
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data: blob:; font-src data:"
)


def write_report(folder: str | Path, out_path: str | Path, *, title: str = TITLE) -> Path:
    """Write the report on the tables of a sweep.

    The file holds all it needs, scripts included, and loads nothing from elsewhere.

    Args:
        folder: with the sweep's tables, ``summary.parquet``, ``fields.parquet``,
            ``worst.parquet`` and ``limit.parquet``.
        out_path: the HTML file; its folder is made where it is missing.
        title: of the page.

    Returns:
        The path of the file.

    Raises:
        MissingExtraError: bokeh or pyarrow is not installed.
        StudyError: the folder or a table in it is missing, cannot be read, lacks columns, or has
            no rows where there must be some.
        OSError: the file cannot be written.
    """
    try:
        from bokeh.embed import components
        from bokeh.resources import Resources

        from .parts import looks
        from .sections import sections
    except ImportError as error:
        raise MissingExtraError(
            'the report needs bokeh and pyarrow: pip install "maplines_can[study]"'
        ) from error
    tables = read_tables(folder)
    look = looks(tables.codes)
    plots: dict[str, Any] = {}
    body = "\n".join(_section_html(tables, section, plots) for section in sections(tables))
    script, places = components(plots)
    for name, place in places.items():
        body = body.replace(_slot(name), place)
    own = files(__package__)
    html = f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>
{own.joinpath("report.css").read_text("utf-8")}</style>
</head>
<body>
<header>
<h1>{escape(title)}</h1>
{headline(tables)}
{findings(tables, look)}
</header>
{_controls(tables, look)}
<main>
{body}
</main>
<script>
{"".join(Resources(mode="inline", components=["bokeh"]).js_raw)}
</script>
{script}
<script>
{own.joinpath("report.js").read_text("utf-8")}</script>
</body>
</html>
"""
    out_path = Path(out_path)
    out_path.parent.mkdir(parents=True, exist_ok=True)
    out_path.write_text(html, encoding="utf-8")
    return out_path


def _section_html(tables: Tables, section: Section, plots: dict[str, Any]) -> str:
    """A section with a slot for each of its plots, which go into ``plots``."""
    if section.of_set is None:
        body = '<p class="soft">The sweep was told to leave this out.</p>'
    else:
        figures = []
        for i, set_ in enumerate(tables.sets):
            made, numbers = section.of_set(set_)
            names = [f"{section.name}-{i}-{k}" for k in range(len(made))]
            plots |= dict(zip(names, made, strict=True))
            label = escape(f"{section.heading}, set {set_}; the numbers are below it")
            figures.append(
                f'<figure data-set="{i}" aria-label="{label}">'
                f"<figcaption>{escape(set_)}</figcaption>"
                f"{''.join(map(_slot, names))}{numbers}</figure>"
            )
        body = f'{section.controls}<div class="sets">{"".join(figures)}</div>'
    return (
        f'<section id="{section.name}"><h2>{escape(section.heading)}</h2>\n'
        f"<p>{escape(section.reading)}</p>\n{body}</section>"
    )


def _slot(name: str) -> str:
    return f"<!-- plot {name} -->"


def _controls(tables: Tables, look: Mapping[str, Look]) -> str:
    """Which codes and which sets are shown."""
    box = '<input type="checkbox" data-controls="{}" value="{}" autocomplete="off" checked>'
    codes = "".join(
        f"<label>{box.format('code', escape(code))}{swatch(of.marker, of.colour)}"
        f"{escape(code)}</label>"
        for code, of in look.items()
    )
    sets = "".join(
        f'<label class="path">{box.format("set", i)}{escape(set_)}</label>'
        for i, set_ in enumerate(tables.sets)
    )
    return (
        f'<div class="controls"><fieldset><legend>Curves</legend>{codes}</fieldset>\n'
        f"<fieldset><legend>Sets</legend>{sets}</fieldset></div>"
    )
