"""Pictures of the docs; they need the extra plot."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from maplines_can import Gaussian, MapError, Polyline, Scene, Slot, map_lines, map_scene
from maplines_can.pictures.figure import COLOURS, Z99
from maplines_can.simulation.scenarios import scenario
from maplines_can.simulation.street_shapes import Street, StreetPiece
from maplines_can.study.scenes.map_scenes import drivable, random_pose

from .harness import DOCS, evidence
from .lines import excess_covs, given_of
from .roads import maps_of
from .sums import Given, Sums
from .transfer import codec_of, transferred
from .witness import WINDOW, Array, crossings, place_of, seen_from

TITLE: dict[str, Any] = {"loc": "left", "fontsize": 10}


def without_frame(axes: Any) -> None:
    """Leave out the upper and the right line of a panel."""
    axes.spines[["top", "right"]].set_visible(False)


# ---- lane centre and width ---------------------------------------------------------------------

LEFT, RIGHT = Slot.EGO_LEFT, Slot.EGO_RIGHT
X = np.linspace(0, 60, 121)


@evidence
def joint() -> dict[str, Any]:
    """Draw lane centre and width of a received scene, with the joint and without it."""
    shipped = scenario("production")
    lines = {slot: shipped.lines[slot] for slot in (LEFT, RIGHT)}
    error = MapError(0.05, 0.05, 0.001)
    sent = map_scene(lines, shipped.ego, window=shipped.window, map_error=error)
    scene = transferred(codec_of("maplines-pose.dbc"), sent)
    if scene is None:
        raise RuntimeError("the scene was not received")
    draw_joint(scene, DOCS / "joint.png")
    return {"lines": len(scene.lines)}


def sigma_if_independent(scene: Scene, weights: dict[Slot, float]) -> Any:
    """Return the standard deviation of a weighted sum of lines that are taken as independent."""
    parts = [weight * scene.lateral({slot: 1.0}, X).sigma for slot, weight in weights.items()]
    return np.hypot(*parts)


def draw_joint(scene: Scene, path: Path) -> None:
    """Draw the bands of the lines and of the centre, and the standard deviation of the width."""
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    bands, sigmas = figure.subplots(1, 2, width_ratios=[1.25, 1])
    for slot, colour in ((LEFT, COLOURS[0]), (RIGHT, COLOURS[1])):
        line = scene.lateral({slot: 1.0}, X)
        bands.plot(X, line.value, color=colour, lw=1.6)
        name = slot.name.replace("_", " ").lower()
        band(bands, line.value, line.sigma, color=colour, label=f"{name}, 99 %")
    centre = scene.centre(X)
    band(bands, centre.value, centre.sigma, color="0.45", label="lane centre, joint")
    apart = Z99 * sigma_if_independent(scene, {LEFT: 0.5, RIGHT: 0.5})
    for side in (-apart, apart):
        bands.plot(X, centre.value + side, color="black", ls=":", lw=1.3)
    bands.plot(
        [], [], color="black", ls=":", lw=1.3, label="lane centre, if independent: too narrow"
    )
    bands.set(xlabel="x, ahead of the car [m]", ylabel="y, to the left [m]")
    bands.set_title("The lines share one error: the centre is as uncertain as they are", **TITLE)
    bands.set_ylim(-3.5, 7.5)
    bands.legend(frameon=False, fontsize=8, loc="upper left", ncols=2)
    for name, weights, of, colour in (
        ("width", {LEFT: 1.0, RIGHT: -1.0}, scene.width(X), COLOURS[2]),
        ("centre", {LEFT: 0.5, RIGHT: 0.5}, centre, "0.45"),
    ):
        sigmas.plot(X, of.sigma, color=colour, lw=2, label=f"{name}, joint")
        alone = sigma_if_independent(scene, weights)
        sigmas.plot(X, alone, color=colour, ls=":", lw=1.6, label=f"{name}, if independent")
    sigmas.set(xlabel="x, ahead of the car [m]", ylabel="standard deviation [m]", ylim=(0, None))
    sigmas.set_title("Width and centre of the lane", **TITLE)
    sigmas.legend(frameon=False, fontsize=8)
    for axes in (bands, sigmas):
        without_frame(axes)
    figure.savefig(path, dpi=110)


def band(axes: Any, value: Any, sigma: Any, **style: Any) -> None:
    """Draw the 99 % band of a quantity over x."""
    axes.fill_between(X, value - Z99 * sigma, value + Z99 * sigma, alpha=0.3, lw=0, **style)


# ---- shape of a line ---------------------------------------------------------------------------

#: Of the pose: along [m], across [m], heading [rad]; nearly exact.
POSE_SIGMA = (1e-3, 1e-3, 1e-5)
MAP_ERROR = MapError(point_sigma=0.05)
#: Half of the distance over which slopes and curvatures are means [m].
H = 5.0
#: Lines of a map of which the hardest one is drawn, and the least length of its range [m].
LINES, LENGTH = 200, 70.0


@evidence
def shape(maps: tuple[str, ...] = ()) -> dict[str, Any]:
    """Draw a line, its slope and its curvature with their bands against the road.

    The slope is that over 10 m, and the curvature the mean over 10 m, about each x where both ends
    are in the valid range. The pose is exact, and a map error of 5 cm is stated, so the bands have
    what the cubic misses and the map error only. Beside a straight road before a bend, there is the
    hardest of 200 lines of each map.
    """
    examples = [bend(), *(hardest(name, found) for name, found in maps_of(maps).items())]
    draw_shape(examples, DOCS / "shape.png")
    return {one.title: {"range [m]": float(np.ptp(one.given.ranges))} for one in examples}


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
    excess: Array  #: (4, 4) beyond a misfit in the variance of y_off alone

    def of(self, row: Row) -> tuple[Array, Array, Array, Array, Array]:
        """Return x, and there the road, the mean and the standard deviations now and before."""
        low, high = self.given.ranges[0]
        x = np.arange(low - min(row.places), high - max(row.places), 0.25)
        sums = Sums.of([("", at + np.array(row.places), row.weights) for at in x])
        _, s = place_of(self.points)
        road = np.zeros(len(x))
        for place, weight in zip(row.places, row.weights, strict=True):
            road += weight * np.array([crossings(self.points[None], s, at + place)[0] for at in x])
        mean, variances = self.given.moments(sums, [0])
        rest = self.given._replace(cov=self.given.cov - self.excess)
        _, before = rest.moments(sums, [0])
        return x, road, mean, np.sqrt(variances), np.sqrt(before.clip(0))


def example(title: str, points: Array, pose: Array) -> Example | None:
    """Return a line of the map, seen from a pose; None if it is not given."""
    ego = Gaussian(pose, np.diag(np.square(POSE_SIGMA)))
    slots = {Slot.EGO_LEFT: Polyline(points)}
    lines = map_lines(slots, ego, window=WINDOW, map_error=MAP_ERROR)
    if not lines:
        return None
    excess = excess_covs(slots, ego, MAP_ERROR)[Slot.EGO_LEFT]
    return Example(title, seen_from(points, pose[None])[0], given_of(lines[0]), excess)


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


def hardest(name: str, road_map: Any) -> Example:
    """Return the line of a map of which the cubic has the largest error of the slope."""
    lanes, rng = drivable(road_map), np.random.default_rng(1)
    found: list[tuple[float, Example]] = []
    for _ in range(LINES):
        pose = random_pose(lanes, rng)
        line = road_map.lines(pose).get(Slot.EGO_LEFT)
        one = None if line is None else example(f"{name}, ego left", line.points, pose)
        if one is not None and np.ptp(one.given.ranges) >= LENGTH:
            _, road, mean, *_ = one.of(ROWS[1])
            found.append((float(np.abs(road - mean).max()), one))
    if not found:
        raise RuntimeError(f"{name} has no line of {LENGTH:g} m or more")
    return max(found, key=lambda pair: pair[0])[1]


def draw_shape(examples: list[Example], path: Path) -> None:
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
            without_frame(axes)
            axes.set_ylabel(row.label)
        column[-1].set_xlabel("x, ahead of the car [m]")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4, frameon=False, fontsize=9)
    figure.savefig(path, dpi=110)
