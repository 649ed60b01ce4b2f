"""Pieces of the report's page: controls, keys and tables; all text is escaped here."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape

__all__ = ["marks_key", "select", "sides_key", "swatch", "table"]

#: Okabe and Ito's, as in ``html_parts``, which cannot be imported without bokeh.
VERMILLION, BLUE = "#D55E00", "#0072B2"
#: Markers of the codes, as bokeh draws them, in a box of 16 by 16.
SHAPES = {
    "circle": '<circle cx="8" cy="8" r="5"/>',
    "square": '<rect x="3.5" y="3.5" width="9" height="9"/>',
    "diamond": '<path d="M8 2l4 6-4 6-4-6z"/>',
    "triangle": '<path d="M8 3l5.5 10h-11z"/>',
    "inverted_triangle": '<path d="M8 13l5.5-10h-11z"/>',
    "hex": '<path d="M8 2.5l5 2.8v5.4l-5 2.8-5-2.8V5.3z"/>',
    "star": '<path d="M8 2l1.5 4.3H14l-3.6 2.7 1.3 4.4L8 10.8l-3.7 2.6 1.3-4.4L2 6.3h4.5z"/>',
}


def swatch(marker: str, colour: str) -> str:
    """A marker as it is in the plots."""
    return (
        f'<svg width="16" height="16" viewBox="0 0 16 16" aria-hidden="true" fill="{colour}">'
        f"{SHAPES[marker]}</svg>"
    )


def select(control: str, words: str, groups: Mapping[str, Iterable[tuple[str, str]]]) -> str:
    """A list to choose one of: values and texts, in groups, of which "" has no heading."""
    inside = ""
    for name, options in groups.items():
        texts = "".join(f'<option value="{escape(v)}">{escape(t)}</option>' for v, t in options)
        inside += f'<optgroup label="{escape(name)}">{texts}</optgroup>' if name else texts
    return (
        f'<p><label>{escape(words)} <select data-controls="{control}" autocomplete="off">{inside}'
        "</select></label></p>"
    )


def marks_key(one: str, other: str, marker: str = "square") -> str:
    """What the marks of a plot of two quantities stand for."""
    pairs = ((swatch(marker, VERMILLION), one), (swatch("circle", BLUE), other))
    return _key(pairs)


def sides_key() -> str:
    """How the true and the decoded line are drawn."""
    svg = (
        '<svg width="30" height="12" aria-hidden="true"><path d="M0 6h30" stroke="{}" '
        'stroke-width="2.5" stroke-dasharray="{}"/></svg>'
    )
    pairs = ((svg.format(BLUE, ""), "true"), (svg.format(VERMILLION, "6 3"), "decoded"))
    return _key(pairs)


def _key(pairs: Iterable[tuple[str, str]]) -> str:
    inside = "".join(f"<span>{mark} {escape(words)}</span>" for mark, words in pairs)
    return f'<p class="key">{inside}</p>'


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], about: str = "The numbers") -> str:
    """A table behind a line that opens it."""
    head = "".join(f'<th scope="col">{escape(text)}</th>' for text in heads)
    lines = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>\n" for row in rows
    )
    none = f'<tr><td colspan="{len(heads)}">none for this set</td></tr>'
    return (
        f'<details><summary>{escape(about)}</summary><div class="scroll"><table><thead>'
        f"<tr>{head}</tr></thead><tbody>{lines or none}</tbody></table></div></details>"
    )
