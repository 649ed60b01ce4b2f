"""What the plots of the HTML report are made of, for bokeh: figures, axes, looks of codes.

Colours are set for a light page. The page's script, ``report.js``, knows models by their tags:
``ink`` is drawn light on a dark page, ``code:NAME`` is hidden with its code, and a model with
options changes its properties with a control of the page.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from bokeh.models import ColumnDataSource, FactorRange, FixedTicker, HoverTool
from bokeh.models.annotations import Span
from bokeh.plotting import figure

__all__ = [
    "BLUE",
    "GRID",
    "INK",
    "VERMILLION",
    "Look",
    "blank",
    "decades",
    "draw_code",
    "draw_rule",
    "log10",
    "looks",
    "set_options",
    "set_ticks",
    "superscript",
    "tell",
]

INK, GRID = "#222222", "#8888884d"
BLUE, VERMILLION = "#0072B2", "#D55E00"
#: Okabe and Ito's colours, one for each family of codes; the marker tells the members apart.
KNOWN = {
    "Cholesky": (VERMILLION, "circle", "solid"),
    "LogCholesky": ("#CC79A7", "square", "solid"),
    "IntegerCholesky": ("#E69F00", "diamond", "solid"),
    "Linear": ("#56B4E9", "triangle", "solid"),
    "LinearNearest": ("#56B4E9", "inverted_triangle", "dashed"),
    "LogCorrelation": ("#009E73", "hex", "solid"),
    "Float16": (BLUE, "star", "dashed"),
    "Float32": (BLUE, "square", "solid"),
    "Sigmas": ("#888888", "triangle", "dashed"),
    "MeanOnly": ("#888888", "circle", "dotted"),
}
#: For codes that are not the project's.
OTHERS = (("#8C6D1F", "star"), ("#7A5195", "diamond"), ("#4D7C8A", "hex"), ("#A05A2C", "square"))
#: From 2 to 9.5 in steps too fine for most axes.
HALVES = (2, 2.5, 3, 3.5, 4, 4.5, 5, 5.5, 6, 6.5, 7, 7.5, 8, 8.5, 9, 9.5)


@dataclass(frozen=True)
class Look:
    """How a code is drawn: marker and dash tell it too, not colour alone."""

    colour: str
    marker: str
    dash: str


def looks(codes: Sequence[str]) -> dict[str, Look]:
    """A look for each code, in the order given."""
    others = [code for code in codes if code not in KNOWN]
    return {
        code: Look(*KNOWN[code])
        if code in KNOWN
        else Look(*OTHERS[others.index(code) % len(OTHERS)], "dashdot")
        for code in codes
    }


def blank(
    x_label: str, y_label: str, height: int = 380, factors: Sequence[str] | None = None
) -> figure:
    """A figure without data that leaves the wheel and the finger to the page.

    Args:
        x_label: of the axis.
        y_label: of the axis.
        height: [px]; the width is the page's.
        factors: what a y axis of names has, from below.
    """
    names: dict[str, Any] = {}
    if factors is not None:
        names["y_range"] = FactorRange(factors=list(factors))
    plot = figure(
        height=height,
        sizing_mode="stretch_width",
        tools="box_zoom,reset,save",
        active_drag=None,
        toolbar_location="above",
        background_fill_color=None,
        border_fill_color=None,
        outline_line_color=None,
        x_axis_label=x_label,
        y_axis_label=y_label,
        **names,
    )
    plot.toolbar.logo = None  # it would be a link out of the page
    plot.toolbar.autohide = True
    for axis in (*plot.xaxis, *plot.yaxis):
        axis.axis_label_text_font_style = "normal"
        axis.axis_label_text_font_size = "13px"
        axis.major_label_text_font_size = "12px"
        axis.minor_tick_line_color = None
    plot.grid.grid_line_color = GRID
    return plot


def set_options(model: Any, control: str, options: Mapping[str, Mapping[str, Any]]) -> None:
    """Properties of a model for each value of a control of the page."""
    model.tags = [*model.tags, {"control": control, "options": dict(options)}]


def set_ticks(axis: Any, ticks: Mapping[float, str]) -> FixedTicker:
    """Ticks where they are wanted, with their texts; returns the ticker."""
    ticker = FixedTicker(ticks=list(ticks))
    axis.ticker, axis.major_label_overrides = ticker, dict(ticks)
    return ticker


def decades(low: float, high: float) -> dict[float, str]:
    """Ticks of an axis of decimal logarithms: powers of ten, and between them where few are seen.

    >>> list(decades(-5, 1).values())
    ['10⁻⁵', '10⁻⁴', '0.001', '0.01', '0.1', '1', '10']
    >>> list(decades(-0.1, 0.6).values())
    ['1', '1.5', '2', '3']
    """
    first, last = math.floor(low), math.ceil(high)
    every = max(1, math.ceil((last - first) / 8))
    ticks: dict[float, str] = {}
    for steps in ((1,), (1, 2, 5), (1, 1.5, 2, 3, 4, 5, 7), (1, 1.2, 1.4, 1.6, 1.8, *HALVES)):
        values = [step * 10.0**e for e in range(first, last + 1, every) for step in steps]
        seen = [value for value in values if low <= math.log10(value) <= high]
        ticks = {math.log10(value): _tick_text(value) for value in seen}
        if len(ticks) >= 4:
            break
    return ticks


def _tick_text(value: float) -> str:
    exponent = math.log10(value)
    if abs(exponent) >= 4 and exponent == round(exponent):
        return f"10{superscript(round(exponent))}"
    return f"{value:.2g}" if value < 100 else f"{value:g}"


def superscript(exponent: int) -> str:
    """A whole number as an exponent.

    >>> superscript(-12)
    '⁻¹²'
    """
    return str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def log10(value: float, least: float) -> float:
    """Decimal logarithm; ``least`` of what has none or a smaller one. NaN stays NaN."""
    return max(least, math.log10(value)) if value > 0 else value if math.isnan(value) else least


def draw_rule(
    plot: figure, location: float, dimension: Literal["width", "height"], dash: str = "solid"
) -> Span:
    """A straight line through the whole plot, in ink."""
    rule = Span(location=location, dimension=dimension, line_color=INK, line_dash=dash)
    rule.tags = ["ink"]
    plot.add_layout(rule)
    return rule


def draw_code(plot: figure, source: ColumnDataSource, code: str, look: Look) -> Any:
    """A code's line, whiskers and dots by the columns x, y, low, high and fill.

    A column path breaks the line where it is NaN. Returns the dots.
    """
    colour = look.colour
    path = "path" if "path" in source.data else "y"
    line = plot.line("x", path, source=source, color=colour, alpha=0.7)
    line.glyph.line_width, line.glyph.line_dash = 2, look.dash
    whiskers = plot.segment("x", "low", "x", "high", source=source, color=colour, line_width=2)
    dots = plot.scatter(
        "x",
        "y",
        source=source,
        marker=look.marker,
        size=9,
        color=colour,
        fill_alpha="fill",
        line_width=2,
    )
    for renderer in (line, whiskers, dots):
        renderer.tags = [f"code:{code}"]
    return dots


def tell(
    plot: figure, renderer: Any, *tips: tuple[str, str], mode: Literal["mouse", "vline"] = "mouse"
) -> None:
    """Show texts where the pointer is on a mark."""
    plot.add_tools(HoverTool(renderers=[renderer], tooltips=list(tips), mode=mode))
