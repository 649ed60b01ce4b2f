"""The picture of the accuracy of a drive."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..simulation.accuracy import QUANTILE, REQUIREMENTS, Accuracy, slots_of
from ..simulation.truth import PLACES
from .figure import COLOURS, new_figure, save_figure

#: Limits of the requirements that are drawn, by quantity.
_LIMITS = {
    quantity: sorted({one.limit for one in REQUIREMENTS if one.quantity == quantity})
    for quantity in ("lateral", "heading", "curvature", "absolute", "relative")
}
_UNITS = {"lateral": "m", "heading": "deg", "curvature": "%", "absolute": "m", "relative": "m"}
#: Smaller deviations are drawn as this [m].
LEAST = 1e-3
#: Periods of time of which the largest deviation is drawn; most of them, and the shortest [s].
MAX_PERIODS, MIN_PERIOD = 300, 0.5


def draw_accuracy(accuracy: Accuracy, path: str | Path) -> None:
    """Draw the errors over the distance ahead, and the deviations of the lines over time.

    The suffix of the path is the format.

    Raises:
        MissingExtraError: matplotlib is not installed.
        OSError: the file cannot be written.
        ValueError: the format is not supported.
    """
    figure = new_figure(11, 9)
    rows = figure.add_gridspec(3, 3, height_ratios=(1.3, 1, 1))
    for i, quantity in enumerate(("lateral", "heading", "curvature")):
        _draw_quantity(figure.add_subplot(rows[0, i]), accuracy, quantity)
    first = figure.add_subplot(rows[1, :])
    _draw_time(first, accuracy, "absolute")
    second = figure.add_subplot(rows[2, :], sharex=first)
    _draw_time(second, accuracy, "relative")
    first.tick_params(labelbottom=False)
    second.set_xlabel("time [s]")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    save_figure(figure, path, 130)


def _draw_quantity(axes: Any, accuracy: Accuracy, quantity: str) -> None:
    """Draw the 95 % quantile of the errors over the distance, for each slot and for all."""
    errors = np.abs(accuracy.errors[quantity])
    for slot in slots_of(accuracy):
        name = slot.name.replace("_", " ").lower()
        of_slot = _quantiles(errors[accuracy.slot == slot])
        axes.plot(PLACES, of_slot, "o-", color=COLOURS[slot], lw=1.3, ms=4, label=name)
    axes.plot(PLACES, _quantiles(errors), "s-", color="black", lw=2, ms=5, label="all lines")
    axes.set(xlabel="distance ahead [m]", xticks=PLACES, xlim=(-4, 84))
    axes.set_title(f"{quantity} error [{_UNITS[quantity]}], 95 %", fontsize=10, loc="left")
    _finish(axes, quantity)


def _quantiles(errors: Any) -> list[float]:
    """Return the 95 % quantile of each column, NaN without errors."""
    known = [column[np.isfinite(column)] for column in errors.T]
    return [float(np.quantile(column, QUANTILE)) if len(column) else np.nan for column in known]


def _draw_time(axes: Any, accuracy: Accuracy, quantity: str) -> None:
    """Draw the largest deviation of the lines in each period of time."""
    start = accuracy.time.min() if accuracy.lines else 0.0
    time = accuracy.time - start
    period = max(float(time.max(initial=0.0)) / MAX_PERIODS, MIN_PERIOD)
    middles = (np.arange(int(time.max(initial=0.0) / period) + 1) + 0.5) * period
    for slot in slots_of(accuracy):
        error = accuracy.errors[quantity][:, 0]
        own = (accuracy.slot == slot) & np.isfinite(error)
        largest = np.full(len(middles), -np.inf)  # of a period without lines, which is a gap
        np.maximum.at(largest, (time[own] / period).astype(int), error[own].clip(LEAST))
        largest[np.isneginf(largest)] = np.nan
        axes.plot(middles, largest, ".-", color=COLOURS[slot], lw=1, ms=2)
    title = f"{quantity}: largest deviation of a line [m], in periods of {period:.2g} s"
    axes.set_title(title, fontsize=10, loc="left")
    axes.margins(x=0.01)
    _finish(axes, quantity)


def _finish(axes: Any, quantity: str) -> None:
    """Draw the limits of the requirements, with a logarithmic scale in plain numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for limit in _LIMITS[quantity]:
        axes.axhline(limit, color="0.45", ls="--", lw=0.9, zorder=0)
        axes.annotate(
            f"{limit:g} {_UNITS[quantity]}",
            (1, limit),
            xycoords=("axes fraction", "data"),
            xytext=(3, 0),
            textcoords="offset points",
            color="0.35",
            fontsize=7,
            va="center",
        )
    drawn = [np.asarray(line.get_ydata(), dtype=float) for line in axes.get_lines()]
    values = np.concatenate([*drawn, _LIMITS[quantity]])
    values = values[np.isfinite(values) & (values > 0)]
    axes.set_yscale("log")
    axes.set_ylim(values.min() / 1.3, values.max() * 1.3)
    if not any(np.isfinite(line).any() for line in drawn[: -len(_LIMITS[quantity])]):
        text = "no such errors" + ": no curved lines" * (quantity == "curvature")
        axes.text(0.5, 0.5, text, transform=axes.transAxes, color="0.35", ha="center")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(axis="y", color="0.92", lw=0.6)
    axes.spines[["top", "right"]].set_visible(False)
