"""Panels as a picture, with matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...values.errors import missing_extra
from ...values.output_files import whole_file
from .log_panels import Panel

#: Opacity of each of the three bands, which lie over each other.
_ALPHA = 0.16


def write_picture(panels: Sequence[Panel], title: str, path: str | Path) -> None:
    """Write panels below each other to a picture, such as PNG or SVG.

    Args:
        panels: one or more; those over time share their axis.
        title: above all.
        path: of the file, whose suffix is the format.

    Raises:
        MissingExtraError: matplotlib is not installed.
        ValueError: the format is unknown.
        OSError: the file cannot be written.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise missing_extra("a picture needs matplotlib", "plot") from error
    heights = [0.28 * len(panel.rows) + 0.9 if panel.rows else 2.6 for panel in panels]
    figure = Figure(figsize=(11, sum(heights) + 0.6), layout="constrained")
    grid = figure.add_gridspec(len(panels), 1, height_ratios=heights)
    axes: list[Any] = []
    for place, panel in enumerate(panels):
        sharing = next(
            (a for a, p in zip(axes, panels, strict=False) if p.x_label == panel.x_label), None
        )
        ax = figure.add_subplot(grid[place], sharex=sharing)
        axes.append(ax)
        _draw(ax, panel)
    figure.suptitle(title)
    with whole_file(path) as part:
        figure.savefig(part, dpi=110, format=Path(path).suffix[1:])


def _draw(ax: Any, panel: Panel) -> None:
    for band in panel.bands:
        for low, high in zip(band.low, band.high, strict=True):
            ax.fill_between(band.x, low, high, color=band.colour, alpha=_ALPHA, linewidth=0)
        style = "--" if band.dash else "-"
        ax.plot(band.x, band.y, style, color=band.colour, linewidth=1.1, label=band.label)
    for dots in panel.dots:
        label = None if panel.rows else dots.label
        ax.plot(dots.x, dots.y, ".", color=dots.colour, markersize=1.5, label=label)
    for strip in panel.strips:
        ax.broken_barh(
            [(strip.begin, max(strip.end - strip.begin, 1e-3))],
            (strip.row - 0.35, 0.7),
            color=strip.colour,
            linewidth=0,
        )
    if panel.rows:
        ax.set_yticks(range(len(panel.rows)), panel.rows)
        ax.set_ylim(-0.6, len(panel.rows) - 0.4)
    elif panel.bands or panel.dots:
        ax.legend(loc="upper left", bbox_to_anchor=(1, 1), fontsize="small", frameon=False)
    if panel.limits is not None:
        ax.set_ylim(*panel.limits)  # the truth may go on far beyond
    ax.set_title(panel.title + (f" ({panel.note})" if panel.note else ""), fontsize="medium")
    ax.set_xlabel(panel.x_label)
    ax.set_ylabel(panel.y_label)
    ax.grid(alpha=0.3)
