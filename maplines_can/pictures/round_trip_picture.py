"""The picture of a run: lines on the map with their bands, true and as received."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..simulation.round_trip import RoundTrip
from ..simulation.scenarios import Scenario
from ..values.arrays import count_text
from ..values.gaussian import Gaussian
from ..values.line import MapLine
from .figure import COLOURS, Z99, ellipse, new_figure, save_figure


def draw_round_trip(trip: RoundTrip, scenario: Scenario, path: str | Path) -> None:
    """Draw the sent and the received lines; the suffix of the path is the format.

    Raises:
        MissingExtraError: matplotlib is not installed.
        OSError: the file cannot be written.
        ValueError: the format is not supported.
    """
    figure = new_figure(10, 6.2)
    from matplotlib.lines import Line2D  # after new_figure, which says what is missing

    axes = figure.subplots(2, 1, height_ratios=[3, 1.25], sharex=True)
    for colour, line in zip(COLOURS, trip.true_lines, strict=False):
        _draw_line(axes, line, colour, trip.received_lines.get(line.slot.name))
    _draw_ego(axes[0], scenario)
    shown = {
        "sent: 99 % band": Line2D([], [], color="0.6", lw=7, alpha=0.5),
        "received: mean": Line2D([], [], color="0.2", lw=1.4, ls="--"),
        "received: 99 % band": Line2D([], [], color="0.2", lw=0.9, ls=":"),
    }
    axes[0].legend(shown.values(), shown.keys(), loc="upper left", frameon=False, fontsize=9)
    axes[0].set_ylabel("y, to the left [m]")
    axes[0].set_title(
        f"{scenario.name}: {count_text(len(trip.true_lines), 'line')} over {trip.frame_format}, "
        f"bus load {100 * trip.bus_load:.1f} % at {trip.bus.bitrate / 1000:g} kbit/s, "
        f"{count_text(trip.lines_lost, 'line')} lost",
        loc="left",
        fontsize=11,
    )
    axes[1].axhline(0, color="0.8", lw=0.8, zorder=0)
    axes[1].set_ylabel("sigma(y), received\nover sent, less 1 [%]")
    axes[1].set_xlabel("x, ahead of the car [m]")
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
    save_figure(figure, path, 150)


def _draw_line(axes: Any, line: MapLine, colour: str, received: MapLine | None) -> None:
    ax = axes[0]
    x = np.linspace(line.x_min, line.x_max, 200)
    y, sigma = line.y(x), line.y_sigma(x)
    ax.fill_between(x, y - Z99 * sigma, y + Z99 * sigma, color=colour, alpha=0.16, lw=0)
    ax.plot(x, y, color=colour, lw=2.6, alpha=0.6)
    name = line.slot.name.replace("_", " ").lower()
    ax.annotate(name, (x[-1], y[-1]), (4, 0), textcoords="offset points", color=colour, va="center")
    if received is None:
        return
    if not received.is_usable:
        return
    known = (x >= received.x_min) & (x <= received.x_max)
    x, sigma = x[known], sigma[known]
    y, half = received.y(x), Z99 * received.y_sigma(x)
    ax.plot(x, y, color="0.15", lw=1.1, ls="--")
    for edge in (y - half, y + half):
        ax.plot(x, edge, color=colour, lw=0.9, ls=":")
    known = sigma > 0
    ratio = received.y_sigma(x[known]) / sigma[known]
    axes[1].plot(x[known], 100 * (ratio - 1), color=colour, lw=1.6)


def _draw_ego(ax: Any, scenario: Scenario) -> None:
    """Draw the uncertainty of the pose: 99 % ellipse of the position, 99 % fan of the heading."""
    ax.plot(*ellipse(Gaussian(np.zeros(2), scenario.ego.cov[:2, :2])), color="black", lw=1.2)
    for heading in Z99 * scenario.ego.sigma[2] * np.array([-1.0, 1.0]):
        ax.plot([0, 8 * np.cos(heading)], [0, 8 * np.sin(heading)], color="black", lw=0.9)
    ax.annotate("", (8, 0), (0, 0), arrowprops={"arrowstyle": "-|>", "color": "black", "lw": 1.4})
