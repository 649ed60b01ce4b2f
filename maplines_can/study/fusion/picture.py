"""Picture of the ways to fuse lines."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ...simulation.camera_view import PLACES
from ..figures.picture import COLOURS
from .variants import RIGHT

#: Place of which the figures are drawn [m].
PLACE = 20.0


def draw(times: Mapping[str, Mapping[str, Any]], bound: float, path: str | PathLike[str]) -> None:
    """Draw RMS and NEES of each way at ``PLACE``, a bar for each correlation time.

    Args:
        times: by correlation time, "rms" and "nees" at ``PLACES`` by way.
        bound: upper bound of NEES.
        path: of the picture; the suffix is the format.
    """
    ways = list(next(iter(times.values())))
    at, height = PLACES.index(PLACE), 0.8 / len(times)
    figure = Figure(figsize=(10, 5), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for axes, what, unit in zip(
        panels, ("rms", "nees"), ("RMS of the error [m]", "NEES"), strict=True
    ):
        for i, (T, figures) in enumerate(times.items()):
            rows = np.arange(len(ways)) + (i - (len(times) - 1) / 2) * height
            values = [figures[way][what][at] for way in ways]
            axes.barh(rows, values, height, color=COLOURS[i], label=f"correlation time {T}")
        axes.set_xlabel(f"{unit} of the lane centre at {PLACE:g} m")
        axes.spines[["top", "right"]].set_visible(False)
        axes.axhline(len(RIGHT) - 0.5, color="0.6", lw=0.8)
    panels[1].set_xscale("log")
    panels[1].axvline(1.0, color="black", lw=1)
    panels[1].axvline(bound, color="black", lw=1, ls=":", label="upper 95 % bound of the runs")
    panels[0].set_yticks(np.arange(len(ways)), ways)
    panels[0].invert_yaxis()
    handles = panels[1].get_legend_handles_labels()
    figure.legend(*handles, frameon=False, fontsize=8, loc="outside upper center", ncols=4)
    figure.savefig(path, dpi=110)
