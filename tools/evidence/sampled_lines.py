"""True lines with any spacing and noise of their points: roads with closed forms, and maps.

A car stands at the origin of the frame, along x. A map has points of the true line, some metres
apart, with errors; the truth is the line itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.signal import lfilter

from maplines_can import MapError, Polyline, Slot, maps
from maplines_can.simulation.street_shapes import Street, StreetPiece
from maplines_can.study.scenes.map_scenes import drivable, random_pose

from .roads import maps_of
from .witness import Array, near_points, place_of, seen_from

#: Lines of a case: those of the lane of the car.
LANE = (Slot.EGO_LEFT, Slot.EGO_RIGHT)
#: Half of the width of the lane of a road with a closed form [m].
HALF_WIDTH = 1.75
#: Along a road with a closed form, of the car [m].
BEHIND, AHEAD = 80.0, 120.0
#: Distance of places at which the truth is computed [m]; it is cubic in between.
STEP = 0.5
#: A true line goes on for this at each end, for the errors of its last points [m].
MARGIN = 1.0
#: A case has at least this range of x [m].
LEAST = (-5.0, 25.0)
#: What the map error of a line can be stated as.
STATED = ("nothing", "points", "drift")


class TrueLine(NamedTuple):
    """A line without errors, in the frame of the car."""

    begin: float  #: arc lengths of its ends, 0 at the car [m]
    end: float
    places: Callable[[Array], Array]  #: (n,) arc lengths to (n, 2) points
    y: Callable[[Array], Array]  #: (...) x to lateral positions; NaN beyond the ends


Case = Mapping[Slot, TrueLine]


# ---- roads with closed forms -------------------------------------------------------------------


def arc(radius: float) -> list[StreetPiece]:
    """Return an arc."""
    return [StreetPiece(BEHIND + AHEAD, 1 / radius, 1 / radius)]


#: Roads by name: pieces, and between which arc lengths the car is [m].
ROADS: dict[str, tuple[list[StreetPiece], tuple[float, float]]] = {
    "arc of 200 m": (arc(200.0), (BEHIND, BEHIND)),
    "arc of 1000 m": (arc(1000.0), (BEHIND, BEHIND)),
    "straight": ([StreetPiece(BEHIND + AHEAD)], (BEHIND, BEHIND)),
    "clothoid": ([StreetPiece(300, 0, 1 / 100)], (BEHIND, 300 - AHEAD)),
    "S of clothoids": (
        [
            StreetPiece(120, 1 / 150, 1 / 150),
            StreetPiece(60, 1 / 150, 0),
            StreetPiece(60, 0, -1 / 150),
            StreetPiece(140, -1 / 150, -1 / 150),
        ],
        (100.0, 240.0),
    ),
    "straight of 40 m, arc of 150 m": (
        [StreetPiece(BEHIND + 40), StreetPiece(AHEAD, 1 / 150, 1 / 150)],
        (BEHIND, BEHIND),
    ),
}


def on_road(name: str, rng: np.random.Generator) -> Case:
    """Return the lane of a car in the middle of a road of ``ROADS``."""
    pieces, places = ROADS[name]
    street = Street(pieces, rng.uniform(*places))
    return {
        slot: beside(street, y) for slot, y in zip(LANE, (HALF_WIDTH, -HALF_WIDTH), strict=True)
    }


def beside(street: Street, offset: float) -> TrueLine:
    """Return the line at a distance to the left of the middle of a street [m]."""
    begin, end = max(street.begin, -BEHIND), min(street.end, AHEAD)
    s = np.linspace(begin, end, round((end - begin) / STEP) + 1)
    x, y = street.line(s, offset).T
    curve = CubicHermiteSpline(x, y, np.tan(street.heading(s)), extrapolate=False)
    return TrueLine(begin, end, lambda s: street.line(s, offset), curve)


# ---- maps --------------------------------------------------------------------------------------


def on_map(road_map: maps.Map, rng: np.random.Generator) -> Case:
    """Return the lane of a car at a random place of a map, if it has ``LEAST`` of x."""
    lanes = drivable(road_map)
    while True:
        pose = random_pose(lanes, rng)
        found = {slot: line for slot, line in road_map.lines(pose).items() if slot in LANE}
        case = {slot: of_map(line.points, pose) for slot, line in found.items()}
        if (
            len(case) == len(LANE)
            and not np.isnan([one.y(np.array(LEAST)) for one in case.values()]).any()
        ):
            return case


def of_map(points: Array, pose: Array) -> TrueLine:
    """Return the line of a map as it is seen from a pose, as far as it goes ahead along x."""
    near, _ = near_points(points, pose)
    local = seen_from(near, pose[None])[0]
    i, s = place_of(local)
    back = np.diff(local[:, 0]) <= 0
    first = i - back[: i + 1][::-1].argmax() + 1 if back[: i + 1].any() else 0
    last = i + back[i:].argmax() if back[i:].any() else len(local) - 1
    x, y = local[first : last + 1].T
    return TrueLine(
        float(s[0]),
        float(s[-1]),
        lambda at: np.column_stack([np.interp(at, s, values) for values in local.T]),
        lambda at: np.interp(at, x, y, left=np.nan, right=np.nan),
    )


# ---- points with errors ------------------------------------------------------------------------


class Row(NamedTuple):
    """Points of lines, their errors, and what is stated of these."""

    spacing: float  #: [m]; 0 for those that a tolerance leaves
    noise: float = 0.0  #: standard deviation in each coordinate [m]
    length: float = 0.0  #: for which the noise lasts [m]; 0 for white noise
    tolerance: float = 0.0  #: of Douglas and Peucker [m]
    stated: str = "nothing"  #: of ``STATED``

    def __str__(self) -> str:
        lasting = f" over {self.length:g} m" if self.length else ""
        errors = f"{100 * self.noise:g} cm{lasting}" if self.noise else "exact"
        points = f"{self.spacing:g} m, {errors}"
        if not self.spacing:
            points = f"tolerance {100 * self.tolerance:g} cm"
        return points if self.stated == "nothing" else f"{points}, {self.stated} stated"

    @property
    def error(self) -> MapError | None:
        """The map error that is stated."""
        sigma = self.noise or self.tolerance
        if self.stated == "nothing":
            return None
        if self.stated == "points":
            return MapError(point_sigma=sigma)
        # The slope between the car and a place 20 m ahead has this standard deviation.
        slope = np.sqrt(2 * (1 - np.exp(-20 / self.length))) / 20
        return MapError(offset_sigma=sigma, heading_sigma=float(sigma * slope))

    def points(self, line: TrueLine, rng: np.random.Generator) -> Polyline:
        """Return points of a line with random phase and errors."""
        begin, end = line.begin + MARGIN, line.end - MARGIN
        step = self.spacing or STEP
        s = np.arange(begin + rng.uniform(0, step), end, step)
        if not self.spacing:
            return Polyline(thinned(line.places(s), self.tolerance))
        errors = rng.standard_normal((len(s), 2))
        if self.length:
            rho = np.exp(-self.spacing / self.length)
            errors[1:] *= np.sqrt(1 - rho**2)
            errors = lfilter([1.0], [1.0, -rho], errors, axis=0)
        return Polyline(line.places(s) + self.noise * errors)


def rows_of(
    spacings: Sequence[float],
    noises: Sequence[float],
    lengths: Sequence[float],
    stated: Sequence[str],
) -> Iterator[Row]:
    """Yield rows of points with noise that lasts for some lengths; exact ones state nothing."""
    for spacing, noise, length, one in product(spacings, noises, lengths, stated):
        if noise or one == "nothing":
            yield Row(spacing, noise, length, stated=one)


def thinned(points: Array, tolerance: float) -> Array:
    """Return the points that Douglas and Peucker's algorithm leaves of (n, 2) points [m]."""
    kept, parts = {0, len(points) - 1}, [(0, len(points) - 1)]
    while parts:
        first, last = parts.pop()
        a, b = points[first], points[last]
        along = (b - a) / max(float(np.hypot(*(b - a))), 1e-12)
        own = points[first : last + 1] - a
        across = np.abs(own[:, 1] * along[0] - own[:, 0] * along[1])
        if across.max() > tolerance:
            middle = first + int(across.argmax())
            kept.add(middle)
            parts += [(first, middle), (middle, last)]
    return points[sorted(kept)]


def cases_of(
    paths: Sequence[str], roads: Sequence[str], n: int, seed: int
) -> dict[str, list[Case]]:
    """Return n cases each of roads with closed forms and of maps, by name."""
    draws: dict[str, Callable[[np.random.Generator], Case]] = {
        name: partial(on_road, name) for name in roads if name
    }
    draws |= {name: partial(on_map, found) for name, found in maps_of(paths).items()}
    return {
        name: [draw(np.random.default_rng([seed, place, number])) for number in range(n)]
        for place, (name, draw) in enumerate(draws.items())
    }


def kind_of(name: str) -> str:
    """Return the kind of a source: closed forms, or the format of a map."""
    return "closed forms" if name in ROADS else "Lanelet2" if ".osm" in name else "OpenDRIVE"
