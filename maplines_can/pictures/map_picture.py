"""The picture of a map: lanes by type, boundaries by kind, and driving directions."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..maps import Lane, LaneType, Map
from ..values.arrays import count_text
from ..values.line import Kind
from ..values.polyline import Polyline
from .figure import new_figure, save_figure

#: Colours of the surfaces, and the types of lanes that have them. Later ones are drawn above.
SURFACES: dict[str, tuple[str, frozenset[LaneType]]] = {
    "median, border": (
        "#c9d8b6",
        frozenset({LaneType.MEDIAN, LaneType.NONE, LaneType.BORDER, LaneType.CURB}),
    ),
    "sidewalk": ("#e3d9c6", frozenset({LaneType.SIDEWALK, LaneType.CROSSWALK, LaneType.SHARED})),
    "cycle lane": ("#d9a79c", frozenset({LaneType.BIKING})),
    "shoulder": ("#c3c6ca", frozenset({LaneType.SHOULDER, LaneType.STOP})),
    "parking": ("#a9bbd6", frozenset({LaneType.PARKING})),
    "bus, taxi, tram": (
        "#b79ac0",
        frozenset({LaneType.BUS, LaneType.TAXI, LaneType.HOV, LaneType.TRAM, LaneType.RAIL}),
    ),
    "other": ("#d8d8d8", frozenset()),
    "ramp, entry, exit": (
        "#6f8fae",
        frozenset(
            {
                *(LaneType.ENTRY, LaneType.EXIT, LaneType.ON_RAMP, LaneType.OFF_RAMP),
                *(LaneType.CONNECTING_RAMP, LaneType.SLIP_LANE),
            }
        ),
    ),
    "driving": ("#868c94", frozenset({LaneType.DRIVING, LaneType.BIDIRECTIONAL})),
}
#: Surface of drivable lanes in a junction, where they overlap.
JUNCTION = ("junction", "#9aa0a8")


class Stroke(NamedTuple):
    """Look of a kind of boundary: colour, width [m], and dashes [m]."""

    colour: str
    width: float
    dashes: tuple[float, float] | None = None


STROKES = {
    Kind.SOLID: Stroke("#ffffff", 0.20),
    Kind.DASHED: Stroke("#ffffff", 0.20, (3.0, 4.5)),
    Kind.DOUBLE: Stroke("#f2c230", 0.35),
    Kind.ROAD_EDGE: Stroke("#4c5a44", 0.20),
    Kind.KERB: Stroke("#7a4b2a", 0.25),
    Kind.BARRIER: Stroke("#c0392b", 0.30),
    Kind.UNKNOWN: Stroke("#3f6fb5", 0.15),
}
BACKGROUND = "#f6f4ee"
#: Size of the larger side of the overview, and of both sides of the detail [inch].
OVERVIEW, DETAIL = 9.0, 7.0
#: Least width of a picture without a detail [inch].
MIN_WIDTH = 7.0
DPI = 200
#: Side of the detail [m]. A smaller map has none.
WINDOW = 260.0
#: Distance of arrows along a lane, least distance of any two, and their size [inch].
ARROW_SPACING, ARROW_GAP, ARROW_SIZE = 0.6, 0.07, 0.045
#: Their outline, for a size of 1.
ARROW = np.array([[1.0, 0.0], [-0.8, 0.7], [-0.4, 0.0], [-0.8, -0.7]])
#: Least and largest width of a boundary in the picture [pt].
MIN_STROKE, MAX_STROKE = 0.12, 1.6


def draw_map(road_map: Map, path: str | Path) -> None:
    """Draw a map, and beside a large one the detail where it has most lanes.

    Args:
        road_map: the map.
        path: of the picture; its suffix is the format.

    Raises:
        MissingExtraError: matplotlib is not installed.
        OSError: the file cannot be written.
        ValueError: the format is not supported.
    """
    lines = [line for lane in road_map.lanes.values() for line in (lane.left, lane.right)]
    lines += road_map.polylines.values()
    low = np.min([line.points.min(axis=0) for line in lines], axis=0)
    high = np.max([line.points.max(axis=0) for line in lines], axis=0)
    margin = 0.03 * (high - low).max() + 2.0
    low, high = low - margin, high + margin
    size = high - low
    width, height = OVERVIEW * (size / size.max()).clip(min=0.35)
    drivable = [lane for lane in road_map.lanes.values() if lane.type.is_drivable]
    has_detail = size.max() > 3 * WINDOW and bool(drivable)
    if has_detail:
        inches = width + DETAIL, max(height, DETAIL)
    else:
        inches = max(width, MIN_WIDTH), height
    figure = new_figure(inches[0] + 1.0, inches[1] + 1.6)
    if has_detail:
        overview, detail = figure.subplots(1, 2, width_ratios=[width, DETAIL])
        corner = _busiest(drivable) - WINDOW / 2
        _draw(detail, road_map, corner, corner + WINDOW, DETAIL)
        detail.set_title("detail: where most lanes are", loc="left", fontsize=10)
        _frame(overview, corner)
    else:
        overview = figure.subplots()
    _draw(overview, road_map, low, high, OVERVIEW)
    side = "left" if road_map.left_hand_traffic else "right"
    overview.set_title(
        f"{road_map.name}: {count_text(len(road_map.roads), 'road')}, "
        f"{count_text(len(drivable), 'drivable lane')} of "
        f"{sum(lane.length for lane in drivable) / 1000:.1f} km, {side}-hand traffic",
        loc="left",
        fontsize=10,
    )
    handles = _legend(road_map)
    columns = max(1, int(inches[0] / 1.4))
    figure.legend(
        handles=handles, loc="outside lower center", ncols=columns, frameon=False, fontsize=8.5
    )
    save_figure(figure, path, DPI)


def _draw(
    ax: Any, road_map: Map, low: NDArray[np.float64], high: NDArray[np.float64], inches: float
) -> None:
    """Draw what is between two corners."""
    from matplotlib.collections import LineCollection, PolyCollection

    point = (high - low).max() / (72 * inches)  # [m]
    lanes = [lane for lane in road_map.lanes.values() if _is_near(lane, low, high)]
    ax.set_facecolor(BACKGROUND)
    for layer, (name, colour) in enumerate(_surfaces()):
        areas = [_area(lane) for lane in lanes if _surface(lane) == name]
        order = 1 + 0.01 * layer
        ax.add_collection(
            PolyCollection(areas, facecolor=colour, edgecolor=colour, lw=0.1, zorder=order)
        )
    bounds = {id(line): line for lane in lanes for line in (lane.left, lane.right)}
    every = _parts([*bounds.values(), *road_map.polylines.values()])
    for kind, stroke in STROKES.items():
        width = float(np.clip(stroke.width / point, MIN_STROKE, MAX_STROKE))
        is_dashed = stroke.dashes is not None and stroke.dashes[0] / point > 1.0
        dashes = (0, tuple(d / point / width for d in stroke.dashes or ())) if is_dashed else "-"
        points = [line.points for line in every if line.kind is kind]
        ax.add_collection(
            LineCollection(
                points, colors=stroke.colour, lw=width, linestyles=[dashes], capstyle="butt",
                zorder=2, alpha=1.0 if is_dashed or not stroke.dashes else 0.6,
            )
        )  # fmt: skip
    _draw_arrows(ax, lanes, low, high, 72 * point)
    _draw_scale(ax, low, high)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    ax.ticklabel_format(useOffset=False, style="plain")
    ax.tick_params(labelsize=8, color="0.6")
    ax.set_xlabel("x [m]", fontsize=9)
    ax.set_ylabel("y [m]", fontsize=9)
    for spine in ax.spines.values():
        spine.set_color("0.7")


def _parts(lines: Iterable[Polyline]) -> list[Polyline]:
    """Return the parts of lines that have one kind each."""
    return [part for line in lines for part in line.parts()]


def _is_near(lane: Lane, low: NDArray[np.float64], high: NDArray[np.float64]) -> bool:
    points = np.concatenate([lane.left.points, lane.right.points])
    return bool((points.max(axis=0) >= low).all() and (points.min(axis=0) <= high).all())


def _surfaces() -> list[tuple[str, str]]:
    """Return the names and colours of the surfaces in the order of drawing."""
    *below, driving = [(name, colour) for name, (colour, _) in SURFACES.items()]
    return [*below, JUNCTION, driving]


def _surface(lane: Lane) -> str:
    if lane.junction is not None and lane.type.is_drivable:
        return JUNCTION[0]
    return next((name for name, (_, types) in SURFACES.items() if lane.type in types), "other")


def _area(lane: Lane) -> NDArray[np.float64]:
    return np.concatenate([lane.left.points, lane.right.points[::-1]])


def _draw_arrows(
    ax: Any,
    lanes: Sequence[Lane],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    inch: float,
) -> None:
    """Draw the driving directions, on long lanes first; ``inch`` is in metres."""
    from matplotlib.collections import PolyCollection

    taken: set[tuple[int, int]] = set()
    places, heads = [], []
    for lane in sorted(lanes, key=lambda lane: -lane.length):
        if not lane.type.is_drivable or lane.width < 1.0:
            continue
        line = lane.centre
        count = max(1, int(line.length / (ARROW_SPACING * inch)))
        s = (np.arange(count) + 0.35) * line.length / count  # not beside those of oncoming lanes
        at = np.column_stack([np.interp(s, line.distance, values) for values in line.points.T])
        segment = line.distance.searchsorted(s).clip(1, len(line.points) - 1) - 1
        for point, (dx, dy) in zip(at, np.diff(line.points, axis=0)[segment], strict=True):
            i, j = (math.floor(value / (ARROW_GAP * inch)) for value in point)
            near = {(i + a, j + b) for a in (-1, 0, 1) for b in (-1, 0, 1)}
            if near & taken or not ((low < point) & (point < high)).all():
                continue
            taken.add((i, j))
            turn = np.array([[dx, dy], [-dy, dx]]) / math.hypot(dx, dy)
            places.append(point)
            heads.append(ARROW_SIZE * ARROW @ turn)
    if places:
        arrows = PolyCollection(
            heads, offsets=places, offset_transform=ax.transData, facecolor="#14243a", zorder=3
        )
        arrows.set_transform(ax.figure.dpi_scale_trans)
        ax.add_collection(arrows)


def _draw_scale(ax: Any, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
    """Draw a bar of a round length below the picture on the right, where nothing is hidden."""
    from matplotlib.transforms import ScaledTranslation

    rough = (high - low)[0] / 5
    power = 10.0 ** math.floor(math.log10(rough))
    length = max(step * power for step in (1, 2, 5) if step * power <= rough)
    below = ScaledTranslation(0, -0.4, ax.figure.dpi_scale_trans)  # [inch]
    ends = [high[0] - length, high[0]]
    ax.plot(ends, [0, 0], color="black", lw=3, solid_capstyle="butt", clip_on=False,
            transform=ax.get_xaxis_transform() + below)  # fmt: skip
    text = f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
    ax.annotate(text, (ends[0], 0), (-4, 0), textcoords="offset points", ha="right", va="center",
                fontsize=9, xycoords=ax.get_xaxis_transform() + below)  # fmt: skip


def _busiest(lanes: Sequence[Lane]) -> NDArray[np.float64]:
    """Return the middle of the cell with the most lanes."""
    middles = np.array([lane.centre.points[[0, -1]].mean(axis=0) for lane in lanes])
    cells = np.floor(middles / (WINDOW / 2))
    _, which, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    found: NDArray[np.float64] = middles[which.ravel() == counts.argmax()].mean(axis=0)
    return found


def _frame(ax: Any, corner: NDArray[np.float64]) -> None:
    """Mark the detail in the overview."""
    from matplotlib.patches import Rectangle

    ax.add_patch(
        Rectangle(tuple(corner), WINDOW, WINDOW, fill=False, color="#c0392b", lw=1.2, zorder=5)
    )


def _legend(road_map: Map) -> list[Any]:
    """Return the handles of what the map contains."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    lanes = road_map.lanes.values()
    surfaces = {_surface(lane) for lane in lanes}
    handles: list[Any] = [
        Patch(color=colour, label=name)
        for name, colour in reversed(_surfaces())
        if name in surfaces
    ]
    lines = [line for lane in lanes for line in (lane.left, lane.right)]
    kinds = {line.kind for line in _parts([*lines, *road_map.polylines.values()])}
    for kind, stroke in STROKES.items():
        if kind in kinds:
            is_white = stroke.colour == "#ffffff"
            handles.append(
                Line2D([], [], color="0.25" if is_white else stroke.colour, lw=1.8,
                       ls="--" if stroke.dashes else "-",
                       label=f"{kind.name.lower().replace('_', ' ')}{' (white)' * is_white}")
            )  # fmt: skip
    return handles
