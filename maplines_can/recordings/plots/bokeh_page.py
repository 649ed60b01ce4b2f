"""Panels as a page that opens offline, with bokeh: to zoom, to hide lines, to read values."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...values.errors import missing_extra
from ...values.output_files import whole_file
from .log_panels import Band, Panel


def write_page(panels: Sequence[Panel], title: str, path: str | Path) -> None:
    """Write panels below each other to one HTML file.

    Args:
        panels: one or more; those over time are zoomed together.
        title: of the page.
        path: of the file.

    Raises:
        MissingExtraError: bokeh is not installed.
        OSError: the file cannot be written.
    """
    try:
        from bokeh.embed import file_html
        from bokeh.layouts import column
        from bokeh.plotting import figure
        from bokeh.resources import INLINE
    except ImportError as error:
        raise missing_extra("a page needs bokeh", "study") from error
    shared: dict[str, Any] = {}
    figures = []
    for panel in panels:
        height = 22 * len(panel.rows) + 90 if panel.rows else 260
        ranges = {"x_range": shared[panel.x_label]} if panel.x_label in shared else {}
        if panel.rows:
            ranges["y_range"] = [*panel.rows]
        elif panel.limits is not None:
            ranges["y_range"] = panel.limits
        plot = figure(
            title=panel.title + (f" ({panel.note})" if panel.note else ""),
            height=height,
            sizing_mode="stretch_width",
            x_axis_label=panel.x_label,
            y_axis_label=panel.y_label or None,
            tools="pan,wheel_zoom,box_zoom,reset,save",
            **ranges,
        )
        shared.setdefault(panel.x_label, plot.x_range)
        _draw(plot, panel)
        figures.append(plot)
    html = file_html(column(figures, sizing_mode="stretch_width"), INLINE, title)
    with whole_file(path) as part:
        part.write_text(html, encoding="utf-8")


def _draw(plot: Any, panel: Panel) -> None:
    from bokeh.models import HoverTool

    for band in panel.bands:
        _draw_band(plot, band)
    for dots in panel.dots:
        y: Any = [panel.rows[int(row)] for row in dots.y] if panel.rows else dots.y
        label = {} if panel.rows else {"legend_label": dots.label}
        plot.scatter(dots.x, y, size=3, color=dots.colour, **label)
    if panel.strips:
        bars = plot.hbar(
            y=[panel.rows[strip.row] for strip in panel.strips],
            left=[strip.begin for strip in panel.strips],
            right=[strip.end for strip in panel.strips],
            height=0.7,
            color=[strip.colour for strip in panel.strips],
            line_width=0,
        )
        bars.data_source.data["state"] = [strip.label for strip in panel.strips]
        about = [("state", "@state"), ("from", "@left{0.00} s"), ("to", "@right{0.00} s")]
        plot.add_tools(HoverTool(renderers=[bars], tooltips=about))
    if not panel.rows and (panel.bands or panel.dots):
        plot.legend.click_policy = "hide"
        plot.legend.location = "top_left"
        plot.legend.background_fill_alpha = 0.7
        plot.add_layout(plot.legend[0], "right")


def _draw_band(plot: Any, band: Band) -> None:
    from bokeh.models import HoverTool

    for low, high in zip(band.low, band.high, strict=True):
        # All stretches at once, since a renderer for each would take most of the time.
        parts = [slice(begin, end) for begin, end in _stretches(low)]
        plot.patches(
            [np.concatenate([band.x[here], band.x[here][::-1]]) for here in parts],
            [np.concatenate([low[here], high[here][::-1]]) for here in parts],
            fill_color=band.colour, fill_alpha=0.16, line_width=0, legend_label=band.label,
        )  # fmt: skip
    line = plot.line(
        band.x,
        band.y,
        color=band.colour,
        line_dash="dashed" if band.dash else "solid",
        legend_label=band.label,
    )
    line.data_source.data["sigma"] = (band.high[0] - band.low[0]) / 2
    about = [("", band.label), ("x", "@x{0.00}"), ("y", "@y{0.000}"), ("sigma", "@sigma{0.000}")]
    plot.add_tools(HoverTool(renderers=[line], tooltips=about, mode="vline", visible=False))


def _stretches(low: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return the stretches of a band without nan, since an area has none."""
    known = np.concatenate([[False], np.isfinite(low), [False]])
    edges = np.flatnonzero(np.diff(known.astype(int)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
