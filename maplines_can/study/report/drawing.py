"""Bokeh figures, axes and marks that the plots of the report share.

Colours are set for a light page. The page's script, ``report.js``, finds models by their tags:
``ink`` is drawn light on a dark page, ``code:NAME`` is hidden with its code, and a model with
options changes its properties with a control of the page.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

from bokeh.models import ColumnDataSource, FixedTicker, HoverTool
from bokeh.models.annotations import Span
from bokeh.plotting import figure

INK, GRID = "#222222", "#8888884d"
BLUE, VERMILLION = "#0072B2", "#D55E00"


class Look(NamedTuple):
    """Style of a code; codes differ in marker or dash too, not in colour alone."""

    colour: str
    marker: str
    dash: str


#: Okabe and Ito's colours, one for each family of codes.
KNOWN = {
    "Cholesky": Look(VERMILLION, "circle", "solid"),
    "LogCholesky": Look("#CC79A7", "square", "solid"),
    "IntegerCholesky": Look("#E69F00", "diamond", "solid"),
    "Linear": Look("#56B4E9", "triangle", "solid"),
    "LinearNearest": Look("#56B4E9", "inverted_triangle", "dashed"),
    "LogCorrelation": Look("#009E73", "hex", "solid"),
    "Float16": Look(BLUE, "star", "dashed"),
    "Float32": Look(BLUE, "square", "solid"),
    "Sigmas": Look("#888888", "triangle", "dashed"),
    "MeanOnly": Look("#888888", "circle", "dotted"),
}
#: For codes that are not the project's.
OTHERS = (("#8C6D1F", "star"), ("#7A5195", "diamond"), ("#4D7C8A", "hex"), ("#A05A2C", "square"))


def plot_styles(codes: Sequence[str]) -> dict[str, Look]:
    """Return a look for each code, in the order given."""
    others = [code for code in codes if code not in KNOWN]
    spare = {code: Look(*OTHERS[i % len(OTHERS)], "dashdot") for i, code in enumerate(others)}
    return {code: (KNOWN | spare)[code] for code in codes}


def new_plot(x_label: str, y_label: str, height: int, **options: Any) -> figure:
    """Return a figure without data, as wide as the page; scrolling does not zoom it."""
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
        **options,
    )
    plot.toolbar.logo = None  # it would be a link to another page
    plot.toolbar.autohide = True
    for axis in (*plot.xaxis, *plot.yaxis):
        axis.axis_label_text_font_style = "normal"
        axis.axis_label_text_font_size = "13px"
        axis.major_label_text_font_size = "12px"
        axis.minor_tick_line_color = None
    plot.grid.grid_line_color = GRID
    return plot


def set_options(model: Any, control: str, options: Mapping[str, Mapping[str, Any]]) -> None:
    """Set properties of a model for each value of a control of the page."""
    model.tags = [*model.tags, {"control": control, "options": dict(options)}]


def set_ticks(axis: Any, texts: Mapping[float, str]) -> None:
    """Set the ticks of an axis and their texts."""
    axis.ticker, axis.major_label_overrides = FixedTicker(ticks=list(texts)), dict(texts)


def ticks(low: int, high: int) -> dict[float, str]:
    """Return ticks of a logarithmic axis from 10^low to 10^high.

    >>> list(ticks(-5, 1).values())
    ['10⁻⁵', '10⁻⁴', '0.001', '0.01', '0.1', '1', '10']
    >>> list(ticks(0, 1).values())
    ['1', '2', '5', '10']
    """
    steps = (1, 2, 5) if high - low < 3 else (1,)
    texts = {float(f"{step}e{e}"): e for e in range(low, high + 1) for step in steps}
    superscript = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
    return {
        tick: "10" + str(e).translate(superscript) if abs(e) > 3 else f"{tick:g}"
        for tick, e in texts.items()
        if tick <= 10.0**high and (abs(e) <= 3 or math.isclose(tick, 10.0**e))
    }


def clip(value: float, low: float, high: float) -> float:
    """Limit a value to a range; NaN stays NaN."""
    return value if math.isnan(value) else min(max(value, low), high)


def columns(points: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Return the columns of a data source from its points."""
    return {key: [point[key] for point in points] for key in points[0]} if points else {}


def draw_rule(
    plot: figure, location: float, dimension: Literal["width", "height"], dash: str = "solid"
) -> Span:
    """Draw a straight line through the whole plot."""
    rule = Span(location=location, dimension=dimension, line_color=INK, line_dash=dash)
    rule.tags = ["ink"]
    plot.add_layout(rule)
    return rule


def draw_code(plot: figure, source: ColumnDataSource, code: str, look: Look) -> Any:
    """Draw a code's line, whiskers and dots from the columns x, y, low, high, fill and path.

    The line has gaps where path is NaN. Returns the dots.
    """
    style: dict[str, Any] = {"source": source, "color": look.colour, "line_width": 2}
    line = plot.line("x", "path", line_dash=look.dash, alpha=0.7, **style)
    whiskers = plot.segment("x", "low", "x", "high", **style)
    dots = plot.scatter("x", "y", marker=look.marker, size=9, fill_alpha="fill", **style)
    for renderer in (line, whiskers, dots):
        renderer.tags = [f"code:{code}"]
    return dots


def add_hover(
    plot: figure, renderer: Any, *tips: tuple[str, str], mode: Literal["mouse", "vline"] = "mouse"
) -> None:
    """Show texts for the mark under the pointer."""
    plot.add_tools(HoverTool(renderers=[renderer], tooltips=list(tips), mode=mode))
