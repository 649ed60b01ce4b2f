"""Stanford diagram: the protection level over the error it should bound."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import NamedTuple

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ...simulation.camera_view import PLACES

Array = NDArray[np.float64]


class Shares(NamedTuple):
    """Shares of the epochs in the regions of a Stanford diagram."""

    available: float  #: the level is at most the alert limit
    misleading: float  #: the error exceeds the level
    hazardous: float  #: it exceeds the alert limit, too, which the level does not

    @classmethod
    def of(cls, error: Array, level: Array, alert_limit: float) -> Shares:
        """Return the shares of (n,) absolute errors with their protection levels [m].

        >>> Shares.of(np.array([0.1, 0.3, 0.6]), np.array([0.2, 0.2, 0.4]), 0.5).misleading
        0.6666666666666666
        """
        available = level <= alert_limit
        wrong = error > level
        hazardous = wrong & available & (error > alert_limit)
        return cls(*(float(np.mean(of)) for of in (available, wrong, hazardous)))


def draw(
    errors: Sequence[Array],
    levels: Sequence[Array],
    alert_limit: float,
    path: str | PathLike[str],
) -> None:
    """Draw a diagram for each of ``PLACES``, of (n,) absolute errors and protection levels [m]."""
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    most = 1.05 * max(float(level.max()) for level in levels)
    edges = np.linspace(0, most, 90)
    for axes, x, error, level in zip(
        figure.subplots(1, len(PLACES), sharey=True), PLACES, errors, levels, strict=True
    ):
        *_, image = axes.hist2d(error, level, bins=[edges, edges], norm=LogNorm(), cmap="viridis")
        axes.plot([0, most], [0, most], color="black", lw=1)
        axes.axhline(alert_limit, color="tab:red", lw=1)
        axes.axvline(alert_limit, color="tab:red", lw=1, ls=":")
        shares = Shares.of(error, level, alert_limit)
        axes.set_title(
            f"{x:g} m ahead: available {100 * shares.available:.1f} %, "
            f"misleading {100 * shares.misleading:.1f} %",
            loc="left",
            fontsize=9,
        )
        axes.text(0.97 * most, 0.03 * most, "misleading", ha="right", fontsize=8)
        axes.text(0.97 * most, 0.92 * most, "unavailable", ha="right", fontsize=8)
        axes.set_xlabel("error of the lane centre [m]")
        figure.colorbar(image, ax=axes, label="epochs" if x == PLACES[-1] else None)
    figure.axes[0].set_ylabel("protection level [m]; red: alert limit")
    figure.savefig(path, dpi=110)
