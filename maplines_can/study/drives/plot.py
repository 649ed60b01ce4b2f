"""The picture of the accuracy of a drive."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...errors import missing_extra
from ...line import Slot
from ..figures.picture import COLOURS
from .evaluation import QUANTILE, Accuracy, slots_of
from .truth import PLACES

#: Requirements that are drawn, by quantity.
_BANDS = {"lateral": (0.10, 0.20), "heading": (0.05,), "curvature": (1.0, 2.0)}
#: Smaller deviations are not drawn [m].
LEAST = 1e-3
_LABELS = {
    "lateral": "lateral error [m]",
    "heading": "heading error [deg]",
    "curvature": "curvature error [%]",
}


def draw_accuracy(accuracy: Accuracy, path: str | Path) -> None:
    """Draw the errors over the distance ahead, those over time, and the deviations of the lines.

    The suffix of the path is the format.

    Raises:
        MissingExtraError: matplotlib is not installed.
        OSError: the file cannot be written.
        ValueError: the format is not supported.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise missing_extra("a picture needs matplotlib", "plot") from error
    figure = Figure(figsize=(11, 7), layout="constrained")
    rows = figure.add_gridspec(2, 3)
    for i, (quantity, label) in enumerate(_LABELS.items()):
        _draw_quantity(figure.add_subplot(rows[0, i]), accuracy, quantity, label)
    _draw_time(figure.add_subplot(rows[1, :]), accuracy)
    figure.savefig(path, dpi=130)


def _draw_quantity(axes: Any, accuracy: Accuracy, quantity: str, label: str) -> None:
    """Draw the 95 % quantile of the errors over the distance, for each slot and for all."""
    errors = np.abs(accuracy.errors[quantity])
    for slot in slots_of(accuracy):
        of_slot = errors[accuracy.slot == slot]
        axes.plot(PLACES, _quantiles(of_slot), "o-", color=COLOURS[slot], lw=1, ms=3)
    axes.plot(PLACES, _quantiles(errors), "s-", color="black", lw=2, ms=5, label="all lines")
    for limit in _BANDS[quantity]:
        axes.axhline(limit, color="0.5", ls="--", lw=0.9)
        axes.annotate(f"{limit:g}", (PLACES[-1], limit), color="0.35", fontsize=8, va="bottom")
    axes.set(xlabel="distance ahead [m]", ylabel=f"{label}, 95 %", xticks=PLACES)
    axes.set_yscale("log")
    axes.legend(fontsize=8, frameon=False)
    axes.spines[["top", "right"]].set_visible(False)


def _quantiles(errors: Any) -> list[float]:
    """Return the 95 % quantile of each column, NaN without errors."""
    known = [column[np.isfinite(column)] for column in errors.T]
    return [float(np.quantile(column, QUANTILE)) if len(column) else np.nan for column in known]


def _draw_time(axes: Any, accuracy: Accuracy) -> None:
    """Draw the absolute and the relative accuracy of each line over time."""
    time = accuracy.time - accuracy.time.min(initial=np.inf) if accuracy.lines else accuracy.time
    for slot in slots_of(accuracy):
        own = accuracy.slot == slot
        name = Slot(slot).name.replace("_", " ").lower()
        for quantity, style in (("absolute", "-"), ("relative", ":")):
            error = accuracy.errors[quantity][own, 0]
            axes.plot(
                time[own], error, style, color=COLOURS[slot], lw=0.8, label=f"{name}, {quantity}"
            )
    axes.axhline(0.2, color="0.5", ls="--", lw=0.9)
    axes.annotate("0.2", (0, 0.2), color="0.35", fontsize=8, va="bottom")
    axes.set(xlabel="time [s]", ylabel="largest deviation of a line [m]", yscale="log")
    axes.set_ylim(bottom=LEAST)
    if accuracy.lines:
        axes.legend(
            fontsize=8, frameon=False, ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.16)
        )
    axes.spines[["top", "right"]].set_visible(False)
