"""Drives on maps and on random roads whose pose comes from the localisation, and their errors."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from maplines_can import Slot
from maplines_can.localisation import LocalisationLayer
from maplines_can.maps import Lane, LaneTracker, Map, Road, Route, random_tour
from maplines_can.simulation.simulated_localisation import SimulatedLocalisation
from maplines_can.simulation.trajectory import SimulatedDrive, drive_along
from maplines_can.values.line import Kind
from maplines_can.values.polyline import Polyline

from .figures import Share
from .roads import random_scene

Array = NDArray[np.float64]

#: Length of the route on a map, as that of ``maplines drive`` [m].
TOUR = 10_000.0
#: Rate at which the pose is taken and compared [Hz].
RATE = 10.0
#: Farthest across that a car is beside the lane on which it believes to be, if that is another one
#: by the ids of the map, for it to be on this lane all the same [m].
BESIDE = 1.0
#: Squared error that 95 % of the poses have at most.
INSIDE = float(chi2.ppf(0.95, 3))
#: Shapes of the random roads, and the share of their outer boundaries that have no marking.
ROADS = ("motorway", "exit", "rural", "s-bend", "city", "roundabout-12m", "hairpin")
UNMARKED = 0.3


class Localised(NamedTuple):
    """A drive at k times, of which the pose is known at some."""

    error: Array  #: (k, 3) along, across [m], heading [rad]; NaN if the pose is not known
    sigma: Array  #: (k, 3) stated
    nees: Array  #: (k,) normalised error squared, 3 if the covariance is right
    other_lane: NDArray[np.bool_]  #: (k,) whether the lane is another one than the car believes
    lines: Counter[str]  #: what became of the lines of the camera

    @property
    def known(self) -> NDArray[np.bool_]:
        """(k,) whether the pose is known."""
        return np.isfinite(self.nees)


def on_map(road_map: Map, layer: LocalisationLayer, seed: int, seconds: float) -> Localised:
    """Return the drive of ``maplines drive MAP --localise --seed SEED``."""
    route = random_tour(road_map, TOUR, seed)
    return localised(road_map, layer, drive_along(road_map, route), route, seed, seconds)


def on_road(shape: str, seed: int, seconds: float) -> Localised:
    """Return a drive on a random road: see ``random_road``."""
    found, way = random_road(shape, np.random.default_rng([seed, sum(shape.encode())]))
    return localised(found, LocalisationLayer(found), way, None, seed, seconds)


def random_road(shape: str, rng: Any) -> tuple[Map, SimulatedDrive]:
    """Return a road of three lanes as a map, and a drive in its middle lane.

    Its inner lines are dashed, its outer ones solid, or not marked.
    """
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
    return Map(lanes, {shape: road}), SimulatedDrive(middle)


def localised(
    road_map: Map,
    layer: LocalisationLayer,
    way: SimulatedDrive,
    route: Route | None,
    seed: int,
    seconds: float,
) -> Localised:
    """Return a drive with simulated sensors, up to a time [s]."""
    source = SimulatedLocalisation(way, layer, seed=seed)
    true_lane, own_lane = (LaneTracker(road_map, route) for _ in range(2))
    rows: list[list[Any]] = []
    for t in way.times(RATE):
        if t >= seconds:
            break
        true = way.at(t).pose
        stated, lane = source.pose(float(t)), true_lane.lines(true).lane
        if stated is None:
            own_lane.lose()
            rows.append([np.nan] * 8)
            continue
        c, s = math.cos(true[2]), math.sin(true[2])
        T_ego_map = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        error = T_ego_map @ (stated.mean - true)
        error[2] = (error[2] + math.pi) % (2 * math.pi) - math.pi
        P = T_ego_map @ stated.cov @ T_ego_map.T
        nees = error @ np.linalg.solve(P, error)
        other = own_lane.lines(stated.mean).lane != lane
        rows.append([*error, *np.sqrt(np.diag(P)), nees, other])
    table = np.array(rows)
    lines = Counter(source.counts().get("line", {}))
    return Localised(table[:, :3], table[:, 3:6], table[:, 6], table[:, 7] == 1, lines)


def figures(drives: Sequence[Localised]) -> dict[str, Any]:
    """Return the figures of drives with independent errors."""
    error, sigma, nees, other = (
        np.concatenate([np.asarray(one[i]) for one in drives]) for i in range(4)
    )
    known, n = np.isfinite(nees), len(drives)
    lines = sum((one.lines for one in drives), Counter[str]())
    rms, stated = (np.sqrt((one[known] ** 2).mean(axis=0)) for one in (error, sigma))
    beside = other & (np.abs(error[:, 1]) > BESIDE)
    mean = float(nees[known].mean())
    return {
        "NEES": mean,
        # Errors of a drive last for a minute, so the drives are hardly more than so many draws.
        "quantile of NEES": float(chi2.cdf(n * mean, 3 * n)),
        "inside": Share(float((nees[known] <= INSIDE).mean()), n),
        "RMS along [m]": rms[0],
        "RMS across [m]": rms[1],
        "stated along [m]": stated[0],
        "stated across [m]": stated[1],
        "RMS heading [deg]": math.degrees(rms[2]),
        "stated heading [deg]": math.degrees(stated[2]),
        "median across [m]": float(np.median(np.abs(error[known, 1]))),
        "known": float(known.mean()),
        "lines used": lines["USED"] / max(lines.total(), 1),
        "other lane": float(other[known].mean()),
        "more than 1 m beside": float(beside[known].mean()),
    }
