#!/usr/bin/env python3
"""Draw the picture of a line, its slope and its curvature with their bands against the road.

    shape_picture.py docs/shape.png             a straight road before a bend
    shape_picture.py docs/shape.png MAP.xodr    and beside it, the hardest of 200 lines of a map

Run it in the environment of the project: python3 tools/run.py python tools/shape_picture.py

The slope is that over 10 m, and the curvature the mean over 10 m, about each x where both ends are
in the valid range. The pose is exact, and a map error of 5 cm is stated, so the bands have what the
cubic misses and the map error only.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from evidence_maps import random_pose
from line_witness import WINDOW, Array, crossings, place_of, seen_from
from matplotlib.figure import Figure
from reporting import parser_of
from shape_figures import Given, Sums
from shape_ways import Case, excess_covs, given_of, with_less

from maplines_can import Gaussian, MapError, Polyline, Slot, map_lines, maps
from maplines_can.simulation.street_shapes import Street, StreetPiece
from maplines_can.study.figures.panels import Z99
from maplines_can.study.figures.picture import COLOURS

#: Of the pose: along [m], across [m], heading [rad]; nearly exact.
POSE_SIGMA = (1e-3, 1e-3, 1e-5)
MAP_ERROR = MapError(point_sigma=0.05)
#: Half of the distance over which slopes and curvatures are means [m].
H = 5.0
#: Lines of a map of which the hardest one is drawn.
LINES = 200
#: Least length of its valid range [m].
LENGTH = 70.0
TITLE: dict[str, Any] = {"loc": "left", "fontsize": 10}


class Row(NamedTuple):
    """A quantity that is drawn over x: a weighted sum of lateral positions."""

    label: str
    places: tuple[float, ...]  #: relative to x [m]
    weights: tuple[float, ...]
    unit: float  #: factor from SI units


ROWS = (
    Row("y, less that of\nthe road [m]", (0.0,), (1.0,), 1.0),
    Row(
        "slope over 10 m, less\nthat of the road [mrad]", (-H, H), (-1 / (2 * H), 1 / (2 * H)), 1e3
    ),
    Row("curvature over\n10 m [1/km]", (-H, 0.0, H), (1 / H**2, -2 / H**2, 1 / H**2), 1e3),
)


class Example(NamedTuple):
    """A line of the map as a car sees it."""

    title: str
    points: Array  #: (n, 2) of the true line, in the frame of the car
    given: Given

    def of(self, row: Row) -> tuple[Array, Array, Array, Array, Array]:
        """Return x, and there the road, the mean and the standard deviations now and before."""
        low, high = self.given.ranges[0]
        x = np.arange(low - min(row.places), high - max(row.places), 0.25)
        sums = Sums.of([("", at + np.array(row.places), row.weights) for at in x])
        _, s = place_of(self.points)
        road = np.zeros(len(x))
        for place, weight in zip(row.places, row.weights, strict=True):
            road += weight * np.array([crossings(self.points[None], s, at + place)[0] for at in x])
        mean, variances = self.given.moments(sums, [0], self.given.covs)
        _, before = self.given.moments(sums, [0], self.given.references)
        return x, road, mean[0], np.sqrt(variances[0]), np.sqrt(before[0])


def example(title: str, points: Array, pose: Array) -> Example | None:
    """Return a line of the map, seen from a pose; None if it is not given."""
    ego = Gaussian(pose, np.diag(np.square(POSE_SIGMA)))
    case = Case(
        {Slot.EGO_LEFT: Polyline(points)}, ego, pose[None], MAP_ERROR, np.random.default_rng(0)
    )
    lines = map_lines(case.lines, ego, window=WINDOW, map_error=MAP_ERROR)
    if not lines:
        return None
    reference = with_less(lines[0], excess_covs(case, 0.0)[Slot.EGO_LEFT])
    return Example(title, seen_from(points, pose[None])[0], given_of(lines[0], reference))


def bend() -> Example:
    """Return the line of a straight road 40 m before a spiral of 30 m to a radius of 150 m."""
    street = Street(
        [StreetPiece(200), StreetPiece(30, 0, 1 / 150), StreetPiece(200, 1 / 150, 1 / 150)],
        behind=160,
    )
    points = street.line(np.arange(street.begin, street.end, 1.0), 1.75)
    found = example("Straight for 40 m, spiral of 30 m, radius 150 m", points, np.zeros(3))
    if found is None:
        raise RuntimeError("the line of the bend is not given")
    return found


def hardest(path: Path) -> Example:
    """Return the line of a map of which the cubic has the largest error of the slope."""
    road_map, rng = maps.load(path), np.random.default_rng(1)
    lanes = [lane for lane in road_map.lanes.values() if lane.type.is_drivable and lane.length > 0]
    lengths = np.array([lane.length for lane in lanes])
    found: list[tuple[float, Example]] = []
    for _ in range(LINES):
        pose = random_pose(lanes[rng.choice(len(lanes), p=lengths / lengths.sum())], rng)
        line = road_map.lines(pose).get(Slot.EGO_LEFT)
        one = None if line is None else example(f"{path.name}, ego left", line.points, pose)
        if one is not None and np.ptp(one.given.ranges) >= LENGTH:
            _, road, mean, *_ = one.of(ROWS[1])
            found.append((float(np.abs(road - mean).max()), one))
    if not found:
        raise RuntimeError(f"{path} has no line of {LENGTH:g} m or more")
    return max(found, key=lambda pair: pair[0])[1]


def draw(examples: list[Example], path: Path) -> None:
    """Draw the quantities of each example in a column."""
    figure = Figure(figsize=(5.2 * len(examples), 8.0), layout="constrained")
    grid = figure.subplots(len(ROWS), len(examples), sharex="col", squeeze=False)
    for column, one in zip(grid.T, examples, strict=True):
        column[0].set_title(one.title, **TITLE)
        for i, (axes, row) in enumerate(zip(column, ROWS, strict=True)):
            x, road, mean, sigma, before = one.of(row)
            zero = road if i < 2 else 0.0  # the curvature itself is drawn, the others as deviations
            centre, true = row.unit * (mean - zero), row.unit * (road - zero)
            half, old = row.unit * Z99 * sigma, row.unit * Z99 * before
            axes.fill_between(x, centre - half, centre + half, color=COLOURS[0], alpha=0.25, lw=0,
                              label="99 % band")  # fmt: skip
            for side in (-old, old):
                axes.plot(x, centre + side, color=COLOURS[1], lw=1.1, ls=":")
            axes.plot([], [], color=COLOURS[1], lw=1.1, ls=":",
                      label="99 % band, misfit in y_off alone")  # fmt: skip
            axes.plot(x, centre, color=COLOURS[0], lw=1.6, label="cubic")
            axes.plot(x, true, color="black", lw=1.3, ls="--", label="road")
            axes.axvline(0.0, color="0.8", lw=0.8, zorder=0)
            axes.spines[["top", "right"]].set_visible(False)
            axes.set_ylabel(row.label)
        column[-1].set_xlabel("x, ahead of the car [m]")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4, frameon=False, fontsize=9)
    figure.savefig(path, dpi=110)


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit status."""
    parser = parser_of(__doc__)
    parser.add_argument("path", type=Path, help="file of the picture; its suffix is the format")
    parser.add_argument("map", type=Path, nargs="?", help="a map")
    arguments = parser.parse_args(argv)
    draw([bend(), *([hardest(arguments.map)] if arguments.map else [])], arguments.path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
