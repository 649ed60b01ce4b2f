"""Panels of the paper's figures: lines on the map, correlations, marginals, the legend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...pictures.figure import RADIUS99, Z99, ellipse
from ...values.gaussian import Gaussian
from ...values.line import lateral

Array = NDArray[np.float64]

LineStyle = str | tuple[float, tuple[float, ...]]

#: Okabe and Ito's vermillion for poses, as the paper's red; their green for the map's points.
POSE, MAP = "#D55E00", "#009E73"
#: The true distribution is grey, unlike the two Gaussians.
TRUE = "0.35"
DOTTED, LONG_DASHES, FINE_DOTS = (0, (1, 1.2)), (0, (6, 2)), (0, (1, 1.6))
#: Symbols of the states, and the units in which their figures are printed.
STATE_NAMES = (r"$y_\mathrm{off}$", r"$\beta$", r"$c_0$", r"$c_1$")
UNIT_NAMES = ("m", "deg", "1/km", "1/km$^2$")
UNITS = np.array([1.0, 180 / np.pi, 1e3, 1e6])


@dataclass(frozen=True, eq=False)
class Layer:
    """One of the two Gaussians as it is drawn; they differ in line style, not in colour alone."""

    name: str
    gaussian: Gaussian
    colour: str
    style: LineStyle
    before: Gaussian | None = None  #: before it was encoded and decoded


@dataclass(frozen=True, eq=False)
class PanelView:
    """Properties that all map panels of a figure share."""

    ego: Gaussian  #: pose, its mean at the origin [m, m, rad]
    line: Array  #: (4,) at the mean pose
    points: Array  #: (n, 2) of the map, in the frame of the mean pose [m]
    x_range: tuple[float, float]  #: of the drawn lines [m]
    band: Array  #: (2, X), between which 99 % of the true lines are, at X places in x_range [m]
    limits: tuple[float, float, float, float]  #: x and y of the panel [m]
    arrow: float  #: length of a pose's arrow [m]
    fan: float  #: length of the arrows of the heading fan [m]


def draw_map(ax: Any, view: PanelView, title: str = "") -> None:
    """Draw the content of every map panel: map points, mean pose's line, true band, car.

    Lines that leave the panel are clipped.
    """
    x = np.linspace(*view.x_range, view.band.shape[1])
    ax.plot(*view.points.T, ls="none", marker="s", ms=2.4, color=MAP, mew=0, zorder=4)
    for edge in view.band:
        ax.plot(x, edge, color="black", lw=0.9, ls=LONG_DASHES, zorder=4)
    ax.plot(x, lateral(view.line, x), color="black", lw=1.8, ls=DOTTED, zorder=6)
    ax.plot(*ellipse(view.ego.marginal([0, 1])), color="black", lw=1.3, zorder=7)
    fan = Z99 * view.ego.sigma[2] * np.array([-1.0, 1.0])
    arrows = {"lw": 0.7, "edgecolor": "black", "headwidth": 4.5, "headlength": 5.5, "zorder": 8}
    _quiver(ax, np.zeros((2, 2)), fan, view.fan, width=0.004, facecolor="black", **arrows)
    _quiver(ax, np.zeros((1, 2)), np.zeros(1), view.fan, width=0.008, facecolor="white", **arrows)
    ax.set_xlim(view.limits[:2])
    ax.set_ylim(view.limits[2:])
    ax.set_aspect("equal")
    ax.set_title(title, loc="left", fontsize=9.5)
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(labelsize=7.5, length=2.5)


def place_inset(ax: Any, view: PanelView) -> Any:
    """Return axes in the upper left corner of a map panel, in the shape of its square close-up."""
    left, right, bottom, top = view.limits
    tall = 0.36
    inset = ax.inset_axes((0.015, 0.985 - tall, tall * (top - bottom) / (right - left), tall))
    inset.set_xticks([])
    inset.set_yticks([])
    return inset


def draw_lines(
    ax: Any, lines: Array, x_range: tuple[float, float], colour: str, width: float, alpha: float
) -> None:
    """Draw (N, 4) lines, each as one Bezier segment: it is exact and keeps an SVG small."""
    from matplotlib.collections import PathCollection
    from matplotlib.path import Path as Curve

    x = np.linspace(*x_range, 4)
    start, stop = lateral(lines[:, None], x[[0, -1]]).T
    _, beta, c0, c1 = lines.T[:, :, None]
    slope_start, slope_stop = (np.tan(beta) + x[[0, -1]] * (c0 + x[[0, -1]] * c1 / 2)).T
    third = x[1] - x[0]
    y = np.column_stack([start, start + third * slope_start, stop - third * slope_stop, stop])
    codes = [Curve.MOVETO, Curve.CURVE4, Curve.CURVE4, Curve.CURVE4]
    ax.add_collection(
        PathCollection(
            [Curve(np.column_stack([x, row]), codes) for row in y],
            facecolors="none",
            edgecolors=colour,
            linewidths=width,
            alpha=alpha,
            zorder=2,
        ),
        autolim=False,
    )


def draw_poses(ax: Any, poses: Array, length: float, alpha: float, width: float) -> None:
    """Draw (N, 3) poses as arrows above the car's fan, in the frame of the mean pose."""
    _quiver(ax, poses[:, :2], poses[:, 2], length, color=POSE, alpha=alpha, width=width, zorder=9)


def _quiver(ax: Any, tails: Array, headings: Array, length: float, **style: Any) -> None:
    tips = length * np.array([np.cos(headings), np.sin(headings)])
    ax.quiver(*tails.T, *tips, angles="xy", scale_units="xy", scale=1, **style)


def draw_mean(ax: Any, layer: Layer, x_range: tuple[float, float]) -> None:
    """Draw the mean of a Gaussian in white, as in the paper, with an edge in its colour."""
    x = np.linspace(*x_range, 100)
    y = lateral(layer.gaussian.mean, x)
    for colour, width in ((layer.colour, 4.2), ("white", 2.4)):
        ax.plot(x, y, color=colour, lw=width, zorder=3, solid_capstyle="butt")


def draw_correlation(ax: Any, layer: Layer, other: tuple[str, Gaussian], title: str) -> None:
    """Draw a correlation matrix as numbers on coloured squares, another one's numbers below.

    The area of a square is proportional to the correlation. The diagonal has the standard
    deviations.

    Args:
        ax: axes to draw on.
        layer: whose matrix.
        other: name and Gaussian to compare with.
        title: of the panel.
    """
    from matplotlib import colormaps
    from matplotlib.patches import Rectangle

    R, R_other = layer.gaussian.correlation, other[1].correlation
    sigma, sigma_other = layer.gaussian.sigma * UNITS, other[1].sigma * UNITS
    centred = {"ha": "center", "va": "center"}
    for i, j in np.ndindex(4, 4):
        r, r_other = float(R[i, j]), float(R_other[i, j])
        side, size = 0.96 * abs(r) ** 0.5, 11.0
        face: Any = colormaps["RdBu_r"](0.5 + 0.4 * r)
        large, small = _signed(r), f"{other[0]} {_signed(r_other)}"
        ink = "white" if abs(r) > 0.7 else "black"
        if i == j:
            face, ink, size = "0.93", "black", 9.5
            large = f"{_number(sigma[i])} {UNIT_NAMES[i]}"
            small = f"{other[0]} {_number(sigma_other[i])}"
            ax.text(j, i - 0.3, "std. dev.", fontsize=6.5, **centred)
        ax.add_patch(Rectangle((j - side / 2, i - side / 2), side, side, fc=face, lw=0))
        ax.add_patch(Rectangle((j - 0.48, i - 0.48), 0.96, 0.96, fc="none", ec="0.85", lw=0.6))
        ax.text(j, i, large, fontsize=size, color=ink, **centred)
        ax.text(j, i + 0.28, small, fontsize=7.5, color=ink, **centred)
    ax.set_xlim(-0.5, 3.5)
    ax.set_ylim(3.5, -0.5)
    ax.set_aspect("equal", anchor="N")
    ax.set_xticks(range(4), STATE_NAMES, fontsize=11)
    ax.set_yticks(range(4), STATE_NAMES, fontsize=11)
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
    ax.set_title(title, loc="left", fontsize=9.5)


def _signed(r: float) -> str:
    return f"{r:+.3f}" if abs(r) >= 0.0005 else "0"


def _number(x: float) -> str:
    return f"{x:.3g}" if x < 1000 else f"{x:.0f}"


def draw_marginals(axes: Any, samples: Array, shown: int, layers: Sequence[Layer]) -> Array:
    """Draw the 4 x 4 grid of marginals: column against row, as in the correlation matrix.

    The diagonal has histograms with the densities of both Gaussians. (The paper plots each
    parameter against itself there, which hides the shape of the marginal.) Panels of the upper
    right half are headed by the share of true samples outside each ellipse; the upper left corner
    by the share outside the region in all four states. A Gaussian that fits has 1 %.

    Args:
        axes: (4, 4).
        samples: (N, 4) true lines; all of them are in the histograms and shares.
        shown: number of samples drawn as dots.
        layers: the Gaussians.

    Returns:
        (4, 2) the limits of the axes, in SI units: they include all of the ellipses, and all
        samples but the outermost 0.6 %.
    """
    from matplotlib.ticker import MaxNLocator

    low, high = np.quantile(samples, [0.003, 0.997], axis=0)
    for layer in layers:
        reach = 1.08 * RADIUS99 * layer.gaussian.sigma
        low = np.minimum(low, layer.gaussian.mean - reach)
        high = np.maximum(high, layer.gaussian.mean + reach)
    limits = np.column_stack([low, high])
    ends = limits * UNITS[:, None]
    dots = samples[:shown] * UNITS
    for i, j in np.ndindex(4, 4):
        ax = axes[i, j]
        ax.tick_params(labelsize=6.5, length=2, pad=1.5, labelbottom=i == 3, labelleft=j == 0 < i)
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_locator(MaxNLocator(3, steps=[1, 2, 5, 10]))
        ax.set_xlim(ends[j])
        if i == j:
            _draw_density(ax, samples[:, i] * UNITS[i], ends[i], i, layers)
        else:
            style = {"ms": 1.1, "mew": 0, "alpha": 0.35, "rasterized": True}
            ax.plot(dots[:, j], dots[:, i], "o", color=TRUE, **style)
            ax.set_ylim(ends[i])
            for layer in layers:
                _draw_ellipse(ax, layer, (j, i))
        if i < j or i == j == 0:
            _write_outside(ax, samples, [i, j] if i < j else [0, 1, 2, 3], layers)
        if i == 3:
            ax.set_xlabel(f"{STATE_NAMES[j]} [{UNIT_NAMES[j]}]", fontsize=8, labelpad=1)
        if j == 0:
            ax.set_ylabel(f"{STATE_NAMES[i]} [{UNIT_NAMES[i]}]", fontsize=8, labelpad=2)
    axes[0, 0].figure.align_ylabels(axes[:, 0])
    return limits


def _write_outside(ax: Any, samples: Array, states: Sequence[int], layers: Sequence[Layer]) -> None:
    style = {"transform": ax.transAxes, "fontsize": 7}
    for x, layer in zip((0.0, 0.52), layers, strict=True):
        outside = 1 - layer.gaussian.marginal(states).coverage(samples[:, states])
        ax.text(x, 1.04, f"{100 * outside:.1f} %", color=layer.colour, **style)
    if len(states) > 2:
        ax.text(-0.05, 1.04, f"{len(states)}-D:", ha="right", **style)


def _draw_density(ax: Any, values: Array, ends: Array, i: int, layers: Sequence[Layer]) -> None:
    low, high = ends.tolist()
    count, edges = np.histogram(values, bins=60, range=(low, high))
    density = count / (len(values) * np.diff(edges))
    ax.stairs(density, edges, fill=True, color="0.75", lw=0)
    x = np.linspace(low, high, 200)
    top = density.max()
    for layer in layers:
        mean, sigma = layer.gaussian.mean[i] * UNITS[i], layer.gaussian.sigma[i] * UNITS[i]
        y = np.exp(-(((x - mean) / sigma) ** 2) / 2) / (sigma * np.sqrt(2 * np.pi))
        ax.plot(x, y, color=layer.colour, ls=layer.style, lw=1.4)
        top = max(top, y.max())
    ax.set_ylim(0, 1.08 * top)
    ax.set_yticks([])


def _draw_ellipse(ax: Any, layer: Layer, pair: tuple[int, int]) -> None:
    units = UNITS[list(pair)][:, None]
    marginal = layer.gaussian.marginal(pair)
    ax.plot(*ellipse(marginal) * units, color=layer.colour, ls=layer.style, lw=1.5)
    ax.plot(*marginal.mean * units[:, 0], "+", color=layer.colour, ms=5)
    if layer.before is not None:
        ax.plot(*ellipse(layer.before.marginal(pair)) * units, color="black", ls=FINE_DOTS, lw=0.8)


def draw_legend(figure: Any, layers: Sequence[Layer], corner: tuple[float, float]) -> None:
    """Draw the legend of a figure.

    Args:
        figure: to draw on.
        layers: its Gaussians; none in a close-up, which has no room for the band either.
        corner: the upper left one.
    """
    from matplotlib.lines import Line2D

    def handle(color: str, **style: Any) -> Line2D:
        return Line2D([], [], color=color, **style)

    handles = {
        "line at the mean pose": handle("black", lw=1.8, ls=DOTTED),
        "points of the map": handle(MAP, lw=0, marker="s", ms=4),
        "true sample": handle(TRUE, lw=1),
        "pose, at the arrow's tail": handle(POSE, lw=0, marker=r"$\rightarrow$", ms=10),
        "car: 99 % of positions and headings": handle(
            "black", lw=0, marker="o", ms=8, mfc="none", mew=1.3
        ),
    }
    if layers:
        handles["band of 99 % of the true lines"] = handle("black", lw=1, ls=LONG_DASHES)
    for layer in layers:
        handles[f"Gaussian of {layer.name}"] = handle(layer.colour, ls=layer.style, lw=1.8)
    if layers and layers[0].before is not None:
        handles["sent, before the wire"] = handle("black", ls=FINE_DOTS, lw=1)
    figure.legend(
        handles.values(),
        handles.keys(),
        loc="upper left",
        bbox_to_anchor=corner,
        ncols=5,
        fontsize=8,
        frameon=False,
        borderpad=0,
        borderaxespad=0,
        columnspacing=1.2,
        handlelength=2.1,
    )
