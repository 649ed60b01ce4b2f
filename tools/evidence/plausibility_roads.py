"""False alarms of the plausibility check on the roads of maps, and on random roads.

A car follows random routes as a driver does. In 20 images a second, the camera sees both boundaries
of its lane where the points of the map are, with noise that is new in each image, and with a bias.
The map lines are the cubics of ``map_scene`` at the pose of the car. Many cars drive the same
route: each has its own error of the pose (Gauss-Markov), of the map, of the camera, and its own
noise. To first order these add to what the cubics miss of the road, which all cars have in common.

The errors of the map are those of MapError: 5 cm of each point and 5 cm of each line, for the whole
drive; or none. Two cameras: sigmas of 5 cm and 0.17 deg, and of 2 cm and 0.06 deg.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from maplines_can import Gaussian, MapError, MapLine, Scene, Slot, map_scene
from maplines_can import maps as map_model
from maplines_can.consumers.plausibility import (
    CameraBias,
    Fit,
    fit_correlation,
    fits_of,
    pose_times,
    residuals,
    stations,
)
from maplines_can.consumers.residual_filter import SLOW, WHITE_NOISE, CameraNoise
from maplines_can.consumers.residual_test import ConsistencyTest
from maplines_can.maps.line_source import WINDOW
from maplines_can.simulation.trajectory import drive_along
from maplines_can.study.scenes.random_scenes import NODES

from .harness import evidence, progress
from .roads import ROADS, route_of, sources, spiral_map, straight_map
from .witness import NEAR, POSES, Array, crossings, place_of, seen_from, turned

#: Period of the images [s].
DT = 0.05
SLOTS = (Slot.EGO_LEFT, Slot.EGO_RIGHT)
#: Correlation times of the errors of the pose and of the camera [s].
POSE_TIME, BIAS_TIME = 5.0, 30.0
#: Sigmas of the parameters of a camera line in one image, and how far the camera sees [m].
CAMERAS = {"5 cm": (0.05, 0.003, 2e-4, 2e-6), "2 cm": (0.02, 0.001, 1e-4, 1e-6)}
SIGHT = 50.0
MAP_ERRORS = {"exact": None, "5 cm": MapError(0.05, 0.05)}
#: Designed false alarms [1/h].
RATES = (1.0, 0.1)
#: What a consumer states: the noise of its camera, and the longest time of a pose error [s].
SETTINGS = {"as modelled": (WHITE_NOISE, 0.0), "default": (CameraNoise(), SLOW)}
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
    road_map: map_model.Map, route: map_model.Route, seconds: float, pose_cov: Array
) -> Iterator[tuple[dict[tuple[str, str], Sight], Any]]:
    """Yield what is compared in each image, by map error and camera, and the lines of the map."""
    drive = drive_along(road_map, route)
    state = drive.at(np.arange(0.5, min(drive.end - 0.1, seconds), DT))
    tracker = map_model.LaneTracker(road_map, route)
    for i, pose in enumerate(state.pose):
        moved = float(state.speed[i]) * DT, float(state.yaw_rate[i]) * DT
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
    """Alarms of one way to test, and the images without one, of some cars."""

    def __init__(self, name: str, rate: float, cars: int) -> None:
        noise, self._longest = SETTINGS[name]
        self._test = ConsistencyTest(rate, (cars,), noise)
        self.alarms = self.calm = 0
        self._dt = math.inf
        self._last: Sight | None = None

    def add(self, z: Array | None, sight: Sight | None) -> None:
        """Test the residuals of an image; None if there are none."""
        self._dt += DT
        if z is None or sight is None:
            return
        bias = sight.model.H @ CameraBias().cov @ sight.model.H.T
        model = sight.model._replace(slow_cov=sight.model.slow_cov + bias)
        keys = tuple((slot, i) for slot in sight.slots for i in range(2))
        times = pose_times(POSE_TIME, self._longest)
        last, self._last = self._last, sight
        kept = [
            1.0
            if last is None or slot not in last.cubics
            else fit_correlation(last.cubics[slot], now, sight.travel, sight.turn)
            for slot, now in sight.cubics.items()
        ]
        verdict = self._test.step(z, model, self._dt, times, sight.turn, keys, np.repeat(kept, 2))
        self._dt = 0.0
        self.alarms += int(verdict.raised.sum())
        self.calm += int((~verdict.alarm | verdict.raised).sum())


@evidence
def plausibility_roads(
    maps: tuple[str, ...] = (),
    n: int = 3,
    seconds: float = 60.0,
    cars: int = 400,
    shapes: tuple[str, ...] = ROADS,
    seed: int = 0,
) -> dict[str, Any]:
    """Count false alarms on roads, as modelled and by default.

    "z over twice" is the number of alarms less twice the designed one, in standard deviations of
    the number that cars with independent errors have.

    Args:
        maps: folders and files of maps.
        n: routes on each map and road.
        seconds: of each route.
        cars: on each route.
        shapes: of random roads.
        seed: of the first route.
    """
    given = ("straight", straight_map()), ("straight, spiral, bend of 150 m", spiral_map())
    found = sources(maps, shapes, *given)
    result: dict[str, Any] = {}
    every: list[Counts] = []
    for name, map_of in progress(found.items(), "roads", len(found)):
        rows = [of_route(map_of(number), seconds, cars, number) for number in range(seed, seed + n)]
        result[name] = figures(rows)
        every += rows
    return result | {"all": figures(every)}


#: Alarms, hours without an alarm and designed rate [1/h] of all cars on a route, by name.
Counts = dict[str, tuple[int, float, float]]


def of_route(road_map: map_model.Map, seconds: float, number: int, seed: int) -> Counts:
    """Return what a number of cars on a route count."""
    a, b, c = POSES["production"]
    sigma = np.array([a, b, math.radians(c)])
    variants = [*product(MAP_ERRORS, CAMERAS)]
    cars = {
        v: Cars(number, sigma, MAP_ERRORS[v[0]], np.random.default_rng([seed, i]))
        for i, v in enumerate(variants)
    }
    tests = {key: Counted(*key[1:], number) for key in product(variants, SETTINGS, RATES)}
    route = route_of(road_map, seed)
    for found, lines in sights(road_map, route, seconds, np.diag(sigma**2)):
        residual = {v: cars[v].errors(sight, lines) for v, sight in found.items()}
        for (v, *_), test in tests.items():
            test.add(residual.get(v), found.get(v))
    return {
        f"{name}, {rate:g} per hour: {error} map, {camera} camera": (
            test.alarms,
            test.calm * DT / 3600,
            rate,
        )
        for ((error, camera), name, rate), test in tests.items()
    }


def figures(routes: Sequence[Counts]) -> dict[str, Any]:
    """Return the figures of the routes of a map, or of all."""
    alarms = {}
    for name, (_, _, rate) in routes[0].items():
        number, hours, _ = np.sum([one[name] for one in routes], axis=0).tolist()
        twice = 2 * rate * hours
        alarms[name] = {
            "hours": hours,
            "alarms": round(number),
            "per hour": number / hours if hours else math.nan,
            "z over twice": (number - twice) / math.sqrt(twice) if hours else -math.inf,
        }
    return {"alarms": alarms}
