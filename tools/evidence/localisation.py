"""What the localisation knows of its own error.

NEES: normalised error squared of (x, y, heading), 3 if the covariance is right. Scans are drawn:
720 rays, noise of 3 cm, 5 % of the rays hit something that the map does not have. With an error of
the map, each house and each pole stands up to some centimetres from where the map has it; the scans
are those of the true places, and the matchings know how large the error is, but not what it is.
They need the extra scan.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from maplines_can import Gaussian, Polyline, Slot
from maplines_can.localisation import (
    GnssFix,
    Localisation,
    LocalisationLayer,
    Odometry,
    PoseFix,
)
from maplines_can.maps import Lane, Map, Road, load, random_tour, town_path, town_tour
from maplines_can.simulation.sensors import SensorSetup, simulated_measurements
from maplines_can.simulation.simulated_localisation import SimulatedLocalisation
from maplines_can.simulation.trajectory import SimulatedDrive, drive_along
from maplines_can.values.line import Kind

from .figures import Share
from .harness import evidence, progress
from .roads import maps_of, random_scene

Array = NDArray[np.float64]

#: Time between two evaluations [s].
STEP = 0.5
#: Squared error that 95 % of the poses have at most.
INSIDE = float(chi2.ppf(0.95, 3))


class Run(NamedTuple):
    """Errors of n cars at k times."""

    errors: Array  #: (k, n, 3) in the map frame
    covs: Array  #: (k, n, 3, 3)
    heading: Array  #: (k,) true [rad]

    @classmethod
    def of(cls, rows: Iterable[tuple[Array, Gaussian | Any]]) -> Run:
        """Return the run of true poses and of what the cars state."""
        given = [(true, poses.mean - true, poses.cov) for true, poses in rows]
        true, errors, covs = (np.array(column) for column in zip(*given, strict=True))
        errors[..., 2] = (errors[..., 2] + math.pi) % (2 * math.pi) - math.pi
        return cls(errors, covs, true[:, 2])

    @property
    def nees(self) -> Array:
        """(k, n) normalised errors squared."""
        solved = np.linalg.solve(self.covs, self.errors[..., None])[..., 0]
        return np.asarray((self.errors * solved).sum(axis=-1))

    @property
    def rms(self) -> dict[str, float]:
        """RMS along, across and of the heading."""
        c, s = np.cos(self.heading)[:, None], np.sin(self.heading)[:, None]
        x, y, h = np.moveaxis(self.errors, -1, 0)
        along, across, turn = (
            float(np.sqrt((values**2).mean())) for values in (c * x + s * y, -s * x + c * y, h)
        )
        return {
            "RMS along [m]": along,
            "RMS across [m]": across,
            "RMS heading [deg]": math.degrees(turn),
        }


def share_inside(squared: Array, values: int) -> float:
    """Return the share of (k,) times at which the mean of (k, n) is within its 95 % bounds.

    Values that are NaN do not count.
    """
    count = np.isfinite(squared).sum(axis=1)
    total = np.nansum(squared, axis=1)[count > 0]
    low, high = chi2.ppf([[0.025], [0.975]], values * count[count > 0])
    return float(((low <= total) & (total <= high)).mean())


@cache
def town() -> tuple[Map, SimulatedDrive]:
    """Return the town of the package, and the drive on the tour through it."""
    found = load(town_path())
    return found, drive_along(found, town_tour(found))


# ---- drives on maps ----------------------------------------------------------------------------

#: Length of the route on a map, as that of ``maplines drive`` [m], and rate of the poses [Hz].
TOUR, RATE = 10_000.0, 10.0
#: Shapes of the random roads, and the share of their outer boundaries that have no marking.
ROADS = ("motorway", "exit", "rural", "s-bend", "city", "roundabout-12m", "hairpin")
UNMARKED = 0.3


@evidence
def drives(
    maps: tuple[str, ...] = (),
    n: int = 20,
    seconds: float = 60.0,
    shapes: tuple[str, ...] = ROADS,
    seed: int = 0,
) -> dict[str, Any]:
    """Drive on maps as maplines drive MAP --localise does, and on random roads.

    Random roads have three lanes, whose outer lines may have no marking; the car is in the middle
    one. "inside" is the share of poses within their own 95 % region, "lines used" that of the lines
    of the camera.

    Args:
        maps: folders and files of maps.
        n: drives on each map and kind of road; their seeds draw routes and errors.
        seconds: of each drive.
        shapes: of random roads.
        seed: of the first drive.
    """
    sources: dict[str, Callable[[int], tuple[LocalisationLayer, SimulatedDrive]]] = {
        name: partial(on_map, found, LocalisationLayer(found))
        for name, found in maps_of(maps).items()
    }
    sources |= {shape: partial(on_road, shape) for shape in shapes}
    result: dict[str, Any] = {}
    for name, drawn in progress(sources.items(), "drives", len(sources)):
        poses, known, lines = list[tuple[Array, Any]](), list[bool](), Counter[str]()
        for number in range(seed, seed + n):
            layer, way = drawn(number)
            source = SimulatedLocalisation(way, layer, seed=number)
            for t in (t for t in way.times(RATE) if t < seconds):
                true, stated = way.at(t).pose, source.pose(float(t))
                known.append(stated is not None)
                if stated is not None:
                    poses.append((true, Gaussian(stated.mean, stated.cov)))
            lines.update(source.counts().get("line", {}))
        run = Run.of((true, Stated(one.mean[None], one.cov[None])) for true, one in poses)
        mean = float(run.nees.mean())
        result[name] = {
            "NEES": mean,
            # Errors of a drive last for a minute, so the drives are hardly more than so many draws.
            "quantile of NEES": float(chi2.cdf(n * mean, 3 * n)),
            "inside": Share(float((run.nees <= INSIDE).mean()), n),
            **run.rms,
            "known": float(np.mean(known)),
            "lines used": lines["USED"] / max(lines.total(), 1),
        }
    return result


class Stated(NamedTuple):
    """Poses that n cars state."""

    mean: Array  #: (n, 3)
    cov: Array  #: (n, 3, 3)


def on_map(
    found: Map, layer: LocalisationLayer, seed: int
) -> tuple[LocalisationLayer, SimulatedDrive]:
    """Return the drive of ``maplines drive MAP --localise --seed SEED``."""
    return layer, drive_along(found, random_tour(found, TOUR, seed))


def on_road(shape: str, seed: int) -> tuple[LocalisationLayer, SimulatedDrive]:
    """Return a drive in the middle one of three lanes of a random road.

    Its inner lines are dashed, its outer ones solid, or not marked.
    """
    rng = np.random.default_rng([seed, sum(shape.encode())])
    scene = random_scene(shape, rng, 5)
    slots = (Slot.NEXT_LEFT, Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.NEXT_RIGHT)
    outer = [Kind.UNKNOWN if rng.random() < UNMARKED else Kind.SOLID for _ in range(2)]
    kinds = (outer[0], Kind.DASHED, Kind.DASHED, outer[1])
    lines = [Polyline(scene.lines[slot], kind) for slot, kind in zip(slots, kinds, strict=True)]
    middle = Polyline(scene.lines[Slot.CENTRE])
    lanes = {
        name: Lane(name, left, right, middle if name == "1" else left, road=shape)
        for name, left, right in zip("012", lines, lines[1:], strict=False)
    }
    road = Road(shape, shape, middle.length, tuple(lanes))
    return LocalisationLayer(Map(lanes, {shape: road})), SimulatedDrive(middle)


# ---- scan matching -----------------------------------------------------------------------------

#: Part of the tour of the town, with 7 s without houses [s].
FED_SPAN = (40.0, 100.0)
#: Standard deviations of the pose with which a matching starts: x, y [m], heading [rad].
START = np.array([0.3, 0.3, math.radians(0.5)])
#: Error of the map for the localisation [m].
MAP_ERROR = 0.05
METHODS = ("NDT", "ICP")


def displaced(found: Map, sigma: float, rng: np.random.Generator) -> Map:
    """Return a map whose houses and poles are displaced at random [m]."""

    def moved(outline: Polyline) -> Polyline:
        return Polyline(outline.points + sigma * rng.standard_normal(2))

    poles = [
        replace(
            one, x=one.x + sigma * rng.standard_normal(), y=one.y + sigma * rng.standard_normal()
        )
        for one in found.landmarks
    ]
    return replace(found, buildings=tuple(map(moved, found.buildings)), landmarks=tuple(poles))


@evidence
def by_scans(
    seeds: int = 50,
    methods: tuple[str, ...] = METHODS,
    span: float = FED_SPAN[1] - FED_SPAN[0],
    seed: int = 0,
) -> dict[str, Any]:
    """Localise by odometry and the poses of a scan matching twice a second, with GNSS and without.

    Each car has a map error of 5 cm of its own, and drives through the streets for 60 s without a
    camera. The error of the map is the same from scan to scan, as long as the houses are. The
    filter has it as a state; "taken as white", it takes the whole covariance as white noise, which
    must be found wrong. "NEES over bound" is the mean over its upper 97.5 % bound at one time. A
    match begins at the estimate without GNSS, and goes to all localisations.

    Args:
        seeds: number of cars.
        methods: of scan matching.
        span: of the drive [s].
        seed: of the random numbers.
    """
    from maplines_can.localisation import scan_matching

    found, way = town()
    result: dict[str, Any] = {}
    for method in methods:
        match = getattr(scan_matching, f"match_{method.lower()}")
        rng, setup, begin = np.random.default_rng([seed, 1]), SensorSetup(), FED_SPAN[0]
        reference = scan_matching.ScanReference(found)
        real = [scan_matching.ScanReference(displaced(found, MAP_ERROR, rng)) for _ in range(seeds)]
        part = begin, begin + span
        arrivals = simulated_measurements(way, LocalisationLayer(found), setup, rng, seeds, part)
        start = way.at(begin).pose + START * rng.standard_normal((seeds, 3))
        filters = {
            name: Localisation(start, begin, setup.errors, cov=np.diag(START**2))
            for name in (method, f"{method} and GNSS", f"{method} and GNSS, taken as white")
        }
        rows: dict[str, list[Any]] = {name: [] for name in filters}
        due = begin + STEP
        for _, one in progress(arrivals, f"localisation by {method}"):
            for name, filtered in filters.items():
                if isinstance(one, Odometry) or (isinstance(one, GnssFix) and name != method):
                    filtered.add(one)
            if not isinstance(one, Odometry) or one.t < due:
                continue
            due += STEP
            true, guess = way.at(one.t).pose, filters[method].poses().mean
            matches = []
            for seen, at in zip(real, guess, strict=True):
                scan = scan_matching.simulated_scan(seen, true, rng)
                matches.append(match(reference, scan, at, map_error=MAP_ERROR))
            for name, filtered in filters.items():
                filtered.add(pose_fix(one.t, matches, is_white=name.endswith("white")))
                rows[name].append((true, filtered.poses()))
        for name, own in rows.items():
            run = Run.of(own)
            mean = float(run.nees.mean())
            result[name] = {
                "NEES": mean,
                "NEES over bound": mean * seeds / float(chi2.ppf(0.975, 3 * seeds)),
                "times inside": share_inside(run.nees, 3),
                "inside": float((run.nees < INSIDE).mean()),
                **run.rms,
            }
    return result


def pose_fix(t: float, matches: list[Any], *, is_white: bool) -> PoseFix:
    """Return the measurement of n cars; that of a match that is not valid is missing."""
    valid = np.array([one.is_valid for one in matches])[:, None]
    of_map = np.array([one.shared for one in matches]) * (not is_white)
    white = np.array([one.cov for one in matches]) - of_map
    cov, shared = (np.where(valid[..., None], some, np.eye(3)) for some in (white, of_map))
    return PoseFix(t, np.where(valid, [one.pose for one in matches], np.nan), cov, shared)
