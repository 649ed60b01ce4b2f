#!/usr/bin/env python3
"""Measure false alarms of the plausibility check on the roads of maps, and on random roads.

    evidence_plausibility_roads.py DIR           every map in a folder, and random roads
    evidence_plausibility_roads.py --cars 100    random roads only, with fewer cars

Run it in the environment of the project:
python3 tools/run.py python tools/evidence_plausibility_roads.py DIR

A car follows random routes as a driver does. In 20 images a second, the camera sees both boundaries
of its lane where the points of the map are, with noise that is new in each image, and with a bias.
The map lines are the cubics of ``map_scene`` at the pose of the car. Many cars drive the same
route: each has its own error of the pose (Gauss-Markov), of the map, of the camera, and its own
noise. To first order these add to what the cubics miss of the road, which all cars have in common.

Detection: the map is shifted by 0.5 m after half of the route, with 0.01 false alarms per hour; the
times are those of cars without an alarm before.

The errors of the map are those of MapError: 5 cm of each point and 5 cm of each line, for the whole
drive; or none. Two cameras: sigmas of 5 cm and 0.17 deg, and of 2 cm and 0.06 deg.

False alarms count as in evidence_plausibility.py, also in two settings: as modelled, where the
errors are those of the model; and default. By default, there must not be more than twice as many as
designed, beyond 3.3 standard deviations of the number that cars with independent errors have. The
exit status is 1 if there are more.
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from evidence_plausibility import LIMIT, RATES, SETTINGS
from line_witness import POSES, Array, crossings, place_of, seen_from
from random_roads import spiral_map, straight_map
from reporting import bar, parser_of, report
from road_sources import route_of, sources_of

from maplines_can import Gaussian, MapError, MapLine, Scene, Slot, map_scene, maps
from maplines_can.consumers.plausibility import (
    CameraBias,
    Fit,
    fit_correlation,
    fits_of,
    residuals,
    stations,
)
from maplines_can.maps.line_source import WINDOW
from maplines_can.simulation.along_route import drive_along
from maplines_can.simulation.camera_view import turned
from maplines_can.values.seen_lines import NODES

#: Period of the images [s].
DT = 0.05
SLOTS = (Slot.EGO_LEFT, Slot.EGO_RIGHT)
#: Correlation times of the errors of the pose and of the camera [s].
POSE_TIME, BIAS_TIME = 5.0, 30.0
#: Sigmas of the parameters of a camera line in one image, and how far the camera sees [m].
CAMERAS = {"5 cm": (0.05, 0.003, 2e-4, 2e-6), "2 cm": (0.02, 0.001, 1e-4, 1e-6)}
SIGHT = 50.0
MAP_ERRORS = {"exact": None, "5 cm": MapError(0.05, 0.05)}
#: Settings of evidence_plausibility.py, and the most times as many alarms as designed.
TESTED, MOST = ("as modelled", "default"), 2.0
#: Setting for which the number of alarms is a bound.
BOUND = "default"
#: Shift of the map that is to be detected [m], and designed false alarms then [1/h].
SHIFT, DETECTION_RATE = 0.5, 0.01
#: Points of the map farther away along a line are not used [m], and the length of a route.
NEAR, LENGTH = 160.0, 3000.0
#: (4, nodes): coefficients of the cubic that is fitted to values at the nodes.
_TO_CUBIC = np.linalg.pinv(np.vander(NODES, 4))


class Sight(NamedTuple):
    """What the check compares in one image, of a map line that has no errors."""

    slots: tuple[Slot, ...]
    missed: Array  #: (2 L,) what the cubics are beside the road [m]
    model: Any  #: of the residuals
    cubics: dict[Slot, Fit]  #: of the lines
    fits: list[tuple[Slot, Array, Array]]  #: positions of the nodes along the line, (2, K) weights
    travel: float  #: of the car since the last image [m]
    turn: float  #: the same [rad]
    heading: float  #: of the car [rad]


def seen(scene: Scene, lines: Any, pose: Array, sigma: Any) -> tuple[Any, ...] | None:
    """Return the slots, what is missed, the model and the fits of an image; None without lines."""
    noise = np.diag(np.square(sigma))
    camera = {
        x.slot: MapLine(x.slot, Gaussian(x.gaussian.mean, noise), x_min=0.0, x_max=SIGHT)
        for x in scene.lines
    }
    compared = residuals(scene, camera)
    if compared is None:
        return None
    slots, z, model = compared
    missed, fits = [], []
    for i, slot in enumerate(slots):
        line, (low, high) = scene.line(slot), scene.fit_ranges[scene.index[slot]]
        x = stations(max(line.x_min, 0.0), min(line.x_max, SIGHT))
        local = seen_from(lines[slot].points, pose[None])
        _, s = place_of(local[0])
        near = np.abs(s) <= NEAR
        truth = [float(crossings(local[:, near], s[near], at)[0]) for at in x]
        given = z[2 * i : 2 * i + 2] + line.y(x)  # as compared with the camera
        missed += (given - truth).tolist()
        in_range = near & (local[0, :, 0] >= low - 40) & (local[0, :, 0] <= high + 40)
        u = np.maximum.accumulate(local[0, in_range, 0])
        nodes = (low + high) / 2 + (high - low) / 2 * NODES
        along = np.interp(nodes, u, lines[slot].distance[in_range])
        w = (x - (low + high) / 2) / ((high - low) / 2)
        fits.append((slot, along, np.vander(w, 4) @ _TO_CUBIC))
    if not np.isfinite(missed).all():
        return None
    return slots, np.array(missed), model, fits_of(scene, slots), fits


class Cars:
    """Errors of many cars on one route, image by image.

    Args:
        number: of the cars.
        pose_sigma: standard deviations along [m], across [m], heading [rad].
        error: of the map.
        rng: source of the random numbers.
    """

    def __init__(self, number: int, pose_sigma: Any, error: MapError | None, rng: Any) -> None:
        self._number, self._rng, self._error = number, rng, error
        self._root = np.asarray(pose_sigma, dtype=float)
        self._pose = rng.standard_normal((number, 3))
        self._bias = rng.standard_normal((number, 3))
        self._of_line: dict[int, tuple[Any, Array, Array]] = {}
        self._at_point: dict[tuple[float, float], Any] = {}  # (cars,) errors
        self._offset_at: dict[tuple[float, float], Array] = {}  # (cars, 2) of the line there

    def errors(self, sight: Sight, lines: Any) -> Array:
        """Return the (cars, 2 L) residuals of the next image [m]."""
        for state, time in ((self._pose, POSE_TIME), (self._bias, BIAS_TIME)):
            rho = math.exp(-DT / time)
            state *= rho
            state += math.sqrt(1 - rho**2) * self._rng.standard_normal(state.shape)
        H = sight.model.H
        z = sight.missed + (self._pose * self._root) @ H.T
        z += (self._bias * np.sqrt(CameraBias().cov.diagonal())) @ H.T
        root = np.linalg.cholesky(sight.model.noise_cov)
        z += self._rng.standard_normal(z.shape) @ root.T
        if self._error is not None:
            z += np.hstack(
                [
                    self._of_map(lines[slot], along, W, H[2 * i : 2 * i + 2], sight.heading)
                    for i, (slot, along, W) in enumerate(sight.fits)
                ]
            )
        return np.asarray(z)

    def _of_map(self, line: Any, along: Array, W: Array, H: Array, heading: float) -> Array:
        """Return the (cars, 2) errors of a map line: of its points, and of all of it."""
        points, offset = self.line_errors(line)
        at = np.interp(along, line.distance, np.arange(len(line.distance)))
        below = np.minimum(at.astype(int), len(line.distance) - 2)
        share = at - below
        e = points[:, below] * (1 - share) + points[:, below + 1] * share
        c, s = math.cos(heading), math.sin(heading)
        moved = offset @ np.array([[c, -s], [s, c]])
        error = self._error or MapError()
        return error.point_sigma * e @ W.T - error.offset_sigma * moved @ H[:, :2].T

    def line_errors(self, line: Any) -> tuple[Array, Array]:
        """Return (cars, n) errors of the points of a line and its (cars, 2) offset, of sigma 1.

        The lane tracker makes a line anew as the car drives on, mostly of the same points of the
        map, which keep their errors. The line has the offset that most of its points had before.
        """
        if id(line) not in self._of_line:
            at = [(x, y) for x, y in line.points.round(3).tolist()]
            before = {id(x): x for x in map(self._offset_at.get, at) if x is not None}
            if before:
                counted = Counter(id(self._offset_at.get(p)) for p in at)
                offset = before[max(before, key=counted.__getitem__)]
            else:
                offset = self._rng.standard_normal((self._number, 2))
            for p in at:
                if p not in self._at_point:
                    self._at_point[p] = self._rng.standard_normal(self._number, dtype=np.float32)
                    self._offset_at[p] = offset
            points = np.stack([self._at_point[p] for p in at], axis=1)
            # The line itself is kept, so that another one does not get its id.
            self._of_line[id(line)] = line, points, offset
        return self._of_line[id(line)][1:]


def sights(
    road_map: maps.Map, route: maps.Route, seconds: float, pose_cov: Array, tick: Any
) -> Iterator[tuple[dict[tuple[str, str], Sight], Any]]:
    """Yield what is compared in each image, by map error and camera, and the lines of the map."""
    drive = drive_along(road_map, route)
    state = drive.at(np.arange(0.5, min(drive.end - 0.1, seconds), DT))
    tracker = maps.LaneTracker(road_map, route)
    for i, pose in enumerate(state.pose):
        moved = float(state.speed[i]) * DT, float(state.yaw_rate[i]) * DT
        tick(DT)
        tracked = tracker.lines(pose).lines
        lines = {slot: tracked[slot] for slot in SLOTS if slot in tracked}
        ego = Gaussian(pose, turned(pose_cov, pose[2]))
        found = {}
        for error_name, error in MAP_ERRORS.items():
            scene = map_scene(
                lines, ego, window=WINDOW, map_error=error, correlation_time=POSE_TIME
            )
            for camera, sigma in CAMERAS.items():
                parts = seen(scene, lines, pose, sigma) if scene.lines else None
                if parts is not None:
                    found[error_name, camera] = Sight(*(*parts, *moved, float(pose[2])))
        yield found, lines


class Counted:
    """Alarms of one way to test, and the images without one, of each car."""

    def __init__(self, name: str, rate: float, cars: int, fault_at: float = math.inf) -> None:
        self._setting, self.rate = SETTINGS[name], rate
        self._test = self._setting.test(rate, cars)
        self.alarms, self.calm = np.zeros(cars), 0
        self._fault_at, self._t = fault_at, 0.0
        #: Times from the fault to its detection [s], negative for those with an alarm before.
        self.detected = np.full(cars, np.inf)
        self._dt = math.inf
        self._last: Sight | None = None

    def add(self, z: Array | None, sight: Sight | None) -> None:
        """Test the residuals of an image; None if there are none."""
        self._dt += DT
        self._t += DT
        if z is None or sight is None:
            return
        bias = sight.model.H @ CameraBias().cov @ sight.model.H.T
        model = sight.model._replace(slow_cov=sight.model.slow_cov + bias)
        keys = tuple((slot, i) for slot in sight.slots for i in range(2))
        times = self._setting.times(POSE_TIME)
        since = self._t - self._fault_at
        if since >= 0:
            z = z + SHIFT
        last, self._last = self._last, sight
        kept = [
            1.0
            if last is None or slot not in last.cubics
            else fit_correlation(last.cubics[slot], now, sight.travel, sight.turn)
            for slot, now in sight.cubics.items()
        ]
        verdict = self._test.step(z, model, self._dt, times, sight.turn, keys, np.repeat(kept, 2))
        self._dt = 0.0
        # The image in which a fault begins counts.
        self.detected[verdict.alarm & np.isinf(self.detected)] = since + DT if since >= 0 else -1.0
        self.alarms += verdict.raised
        self.calm += int((~verdict.alarm | verdict.raised).sum())


def of_route(
    road_map: maps.Map, route: maps.Route, options: Any, seed: int, tick: Callable[[float], object]
) -> tuple[dict[str, tuple[float, float]], dict[str, Array]]:
    """Return alarms and hours without an alarm of all cars on a route, and times to detections."""
    a, b, c = POSES["production"]
    sigma = np.array([a, b, math.radians(c)])
    variants = [(error, camera) for error in MAP_ERRORS for camera in CAMERAS]
    cars = {
        v: Cars(options.cars, sigma, MAP_ERRORS[v[0]], np.random.default_rng([seed, i]))
        for i, v in enumerate(variants)
    }
    tests = {
        (v, name, rate): Counted(name, rate, options.cars)
        for v in variants
        for name in TESTED
        for rate in RATES
    }
    half = min(drive_along(road_map, route).end, options.seconds) / 2
    faults = {
        (v, name): Counted(name, DETECTION_RATE, options.cars, half)
        for v in variants
        for name in TESTED
    }
    for found, lines in sights(road_map, route, options.seconds, np.diag(sigma**2), tick):
        for v in variants:
            sight = found.get(v)
            z = None if sight is None else cars[v].errors(sight, lines)
            for key, test in [*tests.items(), *faults.items()]:
                if key[0] == v:
                    test.add(z, sight)
    alarms = {
        f"{error} map, {camera} camera, {name}, {rate:g}/h": (
            float(test.alarms.sum()),
            test.calm * DT / 3600,
        )
        for ((error, camera), name, rate), test in tests.items()
    }
    times = {
        f"{error} map, {camera} camera, {name}": test.detected[test.detected >= 0]
        for ((error, camera), name), test in faults.items()
    }
    return alarms, times


def figures(
    routes: list[tuple[dict[str, tuple[float, float]], dict[str, Array]]],
) -> dict[str, Any]:
    """Return the figures of the routes of a map, or of all."""
    result: dict[str, Any] = {}
    for name in routes[0][0]:
        rate = float(name.rsplit(" ", 1)[1].removesuffix("/h"))
        alarms, hours = np.sum([alarms[name] for alarms, _ in routes], axis=0).tolist()
        most = MOST * rate * hours
        result[name] = {
            "hours": round(hours, 1),
            "alarms": round(alarms),
            "per hour": round(alarms / hours, 3) if hours else math.nan,
            "as designed": alarms <= most + LIMIT * math.sqrt(most),
        }
        if BOUND in name:
            result[name]["met"] = result[name]["as designed"]
    for name in routes[0][1]:
        times = np.concatenate([times[name] for _, times in routes])
        shares = (
            np.quantile(times, [0.5, 0.95], method="higher") if len(times) else np.full(2, np.nan)
        )
        result[f"detection, {name}"] = {
            "cars": len(times),
            "median, 95 % [s]": shares.round(2).tolist(),
            "not found": int(np.isinf(times).sum()),
        }
    return result


def main(argv: list[str] | None = None) -> int:
    """Print the figures; return 0 if the bounds are met, else 1."""
    parser = parser_of(__doc__)
    parser.add_argument("paths", nargs="*", metavar="DIR", help="folders or files of maps")
    parser.add_argument("-n", "--routes", type=int, default=3, help="routes on each map and road")
    parser.add_argument("--seconds", type=float, default=60.0, help="of each route")
    parser.add_argument("--cars", type=int, default=400, help="on each route")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(argv)
    found = sources_of(
        options.paths,
        ("straight", straight_map()),
        ("straight, spiral, bend of 150 m", spiral_map()),
    )
    result: dict[str, Any] = {}
    every = []
    with bar(round(options.seconds) * options.routes * len(found), unit=" s") as shown:
        for name, map_of in found:
            rows = []
            for seed in range(options.seed, options.seed + options.routes):
                road_map = map_of(seed)
                route = route_of(road_map, LENGTH, seed)
                rows.append(of_route(road_map, route, options, seed, shown.update))
            result[name] = figures(rows)
            every += rows
    result["all"] = figures(every)
    result["met"] = all(row.get("met", True) for row in result["all"].values())
    return report(result, options.json, 44)


if __name__ == "__main__":
    sys.exit(main())
