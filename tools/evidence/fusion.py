"""Fusion of received lines with a camera: what the fused lane knows of its own error.

NEES is the squared error in units of its variance, 1 where the covariance is right. The covariance
also covers what cubics miss of a road, and the rounding on the bus, so there are upper bounds only:
that of the mean of as many independent cars (97.5 %).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from maplines_can import MapError, Scene, map_scene
from maplines_can import maps as map_model
from maplines_can.consumers import LaneFusion
from maplines_can.consumers.lane_filter import LaneFilter, move_lines
from maplines_can.maps import LaneTracker
from maplines_can.maps.line_source import WINDOW
from maplines_can.propagation import Motion
from maplines_can.simulation import PoseSource
from maplines_can.simulation.camera import LANE, PLACES, Errors, UnitGaussMarkov, camera_view
from maplines_can.simulation.car_stream import AGE, FRAME
from maplines_can.simulation.trajectory import drive_along
from maplines_can.simulation.truth import Y_PLACES, true_lines
from maplines_can.values.line import (
    MapLine,
    Slot,
    lateral,
    lateral_jacobian,
    transform_line_or_nan,
)
from maplines_can.values.polyline import Polyline
from maplines_can.wire import Decoder

from .drive_view import DriveView, drive_view
from .figures import Mean, Share
from .harness import evidence, progress
from .roads import ROADS, route_of, sources, spiral_map
from .transfer import codec_of, feed
from .witness import Array, MapOfCar

#: Stretches of the tour of the town by name: start and end [s].
STRETCHES = {"streets": (45.0, 105.0), "motorway": (320.0, 380.0)}
#: Correlation times of the pose error [s].
TIMES = (1.0, 5.0, 30.0)


# ---- many cars on one drive --------------------------------------------------------------------


class Fused(LaneFilter):
    """Lane filters of some cars, which estimate the pose error, or consider it (Schmidt).

    A wrong one takes the cycles as independent.
    """

    def __init__(self, cars: int, way: str) -> None:
        handling = "consider" if way == "Schmidt filter" else "state"
        super().__init__(3, handling, shape=(cars,))  # type: ignore[arg-type]
        self._is_white = way in WRONG

    def update_scene(self, lines: Array, loading: Array, own: Array) -> None:
        """Update with (S, 8) lines, the (S, 8, 3) loading and the (S, 8, 8) own covariance."""
        used, none = np.ones(lines.shape, dtype=bool), np.zeros_like(own)
        if self._is_white:
            noise = loading @ loading.mT + own
            self.update_map(lines, np.zeros_like(loading), none, noise, used)
        else:
            self.update_map(lines, loading, own, None, used)


RIGHT, WRONG = ("pose error as state", "Schmidt filter"), ("joint, cycles independent",)


@dataclass
class Simulation:
    """Cars on a drive, with the same random errors for each filter.

    Args:
        view: of the drive.
        correlation_time: of the pose error [s].
        cars: number of them.
        seed: of the errors.
        errors: their sizes.
    """

    view: DriveView
    correlation_time: float
    cars: int
    seed: int = 0
    errors: Errors = field(default_factory=Errors)

    def run(self, lanes: Fused) -> tuple[Array, Array]:
        """Return the (n, S, 3) errors of the fused lane centre at ``PLACES``, and the sigmas [m].

        They are NaN where a place is not valid.
        """
        rng, e, S = np.random.default_rng(self.seed), self.errors, self.cars
        view, state = self.view, self.view.state
        n, dt = len(state.t), float(state.t[1] - state.t[0])
        L = np.diag(e.pose_sigma)
        pose = UnitGaussMarkov(rng, (S, 3))
        local = UnitGaussMarkov(rng, (S, 2, 4))
        bias = UnitGaussMarkov(rng, (S, 3))
        constant = rng.standard_normal((S, 2, 4)) * [e.map_offset, e.map_heading, 0, 0]
        scale = 1 + e.speed_scale * rng.standard_normal(S)
        gyro = e.yaw_rate_bias * rng.standard_normal(S)
        camera_cov = np.broadcast_to(np.diag(np.square(e.camera_sigma)), (S, 2, 4, 4))
        first, last = (np.array(e.outage) * n).astype(int)
        error, sigma = np.full((2, n, S, len(PLACES)), np.nan)
        windows = None
        for k in range(n):
            motion = self._motion(k, scale, gyro, rng) if k else None
            delta = pose.step(dt / self.correlation_time) @ L.T
            own = constant + local.step(state.speed[k] * dt / e.map_length) * e.map_local
            seen_bias = bias.step(dt / e.bias_time) * e.camera_bias
            if motion is not None and windows is not None:
                lanes.predict(*motion, dt, windows, self.correlation_time)
            if np.isnan(view.lines[k]).any():
                continue
            windows = np.broadcast_to(view.fit_ranges[k], (S, 2, 2))
            lines = np.broadcast_to(view.lines[k], (S, 2, 4))
            ends = windows[..., 0], windows[..., 1]
            sent = transform_line_or_nan(lines + own, delta[:, None], ends)
            loading = move_lines(sent, np.zeros((S, 3)), windows)[2].reshape(S, 8, 3) @ L
            lanes.update_scene(sent.reshape(S, 8), loading, np.broadcast_to(view.own[k], (S, 8, 8)))
            if not (first <= k < last or np.isnan(view.seen[k]).any()):
                noise = rng.standard_normal((S, 2, 4)) * e.camera_sigma
                camera = view.seen[k] + noise
                camera[..., :3] += seen_bias[:, None]
                false = rng.random((S, 2)) < e.false_lines
                away = rng.choice([-1, 1], (S, 2)) * rng.uniform(0.5, 2.0, (S, 2))
                camera[..., 0] += false * away
                lanes.update_camera(camera, camera_cov, np.ones((S, 2), dtype=bool))
            error[k], sigma[k] = self._evaluate(lanes, k)
        return error, sigma

    def _motion(self, k: int, scale: Array, gyro: Array, rng: Any) -> tuple[Array, Array]:
        """Return the (S, 3) measured displacements since the last cycle, and their covariance."""
        state, e = self.view.state, self.errors
        dt = float(state.t[k] - state.t[k - 1])
        speed, rate = state.speed[k - 1 : k + 1].mean(), state.yaw_rate[k - 1 : k + 1].mean()
        noise = e.yaw_rate_noise * rng.standard_normal(self.cars)
        exact = Motion.with_sigma(speed, rate, (e.speed_scale * speed + 0.01, e.yaw_rate_noise))
        moved = exact.over(dt)
        displacement = moved.mean * np.column_stack([scale, scale, np.ones(self.cars)])
        displacement[:, 2] += dt * (gyro + noise)
        displacement[:, 1] += displacement[:, 0] * dt * (gyro + noise) / 2
        return displacement, np.broadcast_to(moved.cov, (self.cars, 3, 3))

    def _evaluate(self, lanes: Fused, k: int) -> tuple[Array, Array]:
        """Return the errors of the centre and their standard deviations."""
        x = np.array(PLACES)
        left, right = lanes.mean[:, None, :4], lanes.mean[:, None, 4:8]
        J = np.concatenate([lateral_jacobian(line, x) for line in (left, right)], axis=-1) / 2
        cov = lanes.cov[:, :8, :8]
        true = np.where(self.view.valid[k], self.view.true[k].mean(axis=0), np.nan)
        error = (lateral(left, x) + lateral(right, x)) / 2 - true
        return error, np.sqrt(np.einsum("sxi,sij,sxj->sx", J, cov, J))


def upper_bound(cars: int) -> float:
    """Return the 97.5 % bound of the mean NEES of one variable over independent cars.

    >>> round(upper_bound(50), 2)
    1.43
    """
    return float(chi2.ppf(0.975, cars) / cars)


@evidence
def ways(
    cars: int = 50,
    seconds: float = 60.0,
    rate: float = 10.0,
    times: tuple[float, ...] = TIMES,
    stretches: tuple[str, ...] = tuple(STRETCHES),
    seed: int = 1,
) -> dict[str, Any]:
    """Compare right and wrong ways to fuse received lines with camera lines, in the town.

    Each car has pose errors, a map error, a camera with a bias, false lines and an outage, and
    odometry with a biased yaw rate of its own. The covariance of what a received line has of its
    own is that of lines that were encoded and decoded. "over bound" is the largest NEES of the lane
    centre over the bound of as many cars at one time.

    Args:
        cars: number of cars.
        seconds: of each stretch [s].
        rate: of the scenes [Hz].
        times: correlation times of the pose error [s].
        stretches: of the tour.
        seed: of the simulation.
    """
    views, result = town_views(seconds, rate, stretches), {}
    kinds = [(name, T, way) for name in views for T in times for way in RIGHT + WRONG]
    for name, T, way in progress(kinds, "ways"):
        error, sigma = Simulation(views[name], T, cars, seed).run(Fused(cars, way))
        nees = np.nanmean(np.nanmean((error / sigma) ** 2, axis=0), axis=0)
        kind = "right" if way in RIGHT else "wrong"
        result[f"{name}, {T:g} s, {kind}: {way}"] = {
            "rms": at_places(np.sqrt(np.nanmean(error**2, axis=(0, 1)))),
            "NEES": at_places(nees),
            "over bound": float(nees.max()) / upper_bound(cars),
        }
    return result


def town_views(seconds: float, rate: float, stretches: Sequence[str]) -> dict[str, DriveView]:
    """Return the views of stretches of the tour of the town."""
    town, e = map_model.load(map_model.town_path()), Errors()
    route = map_model.town_tour(town)
    drive, cov = drive_along(town, route), np.diag(e.pose_sigma) ** 2
    stated, result = MapError(e.map_local[0], e.map_offset, e.map_heading), {}
    for name in progress(stretches, "views"):
        start, end = STRETCHES[name]
        times = np.arange(start, min(end, start + seconds), 1 / rate)
        result[name] = drive_view(town, route, drive, times, cov, stated)
    return result


def at_places(values: Array) -> dict[str, float]:
    """Return (3,) values by their places."""
    return {f"{x:g} m": float(value) for x, value in zip(PLACES, values, strict=True)}


# ---- on roads ----------------------------------------------------------------------------------

#: Period of the scenes [s], and the correlation time of the pose error [s].
DT, POSE_TIME = 0.1, 5.0
MAP_ERRORS = {"exact": None, "5 cm": MapError(0.05, 0.05)}
#: What is compared with the truth: weights of the left and the right line, and those at x [m].
QUANTITIES: dict[str, tuple[tuple[float, float], dict[int, float]]] = {
    "centre, 0 m": ((0.5, 0.5), {0: 1.0}),
    "centre, 20 m": ((0.5, 0.5), {20: 1.0}),
    "centre, 40 m": ((0.5, 0.5), {40: 1.0}),
    "shape": ((0.5, 0.5), {0: 1.0, 10: -2.0, 20: 1.0}),
    "width, 0 m": ((1.0, -1.0), {0: 1.0}),
}
#: Sigmas of the interval that has 95 % of the errors.
INTERVAL = 1.96
#: What is compared: the fusion of scenes, and that with a camera.
WAYS = ("scenes", "scenes and camera")


@evidence
def roads(
    maps: tuple[str, ...] = (),
    cars: int = 4,
    seconds: float = 8.0,
    shapes: tuple[str, ...] = ROADS,
    seed: int = 0,
) -> dict[str, Any]:
    """Compare the fused lane with the truth, on the roads of maps and on random roads.

    Cars follow a random route as a driver does, each on a part of it of its own, with its own
    errors of the pose (Gauss-Markov), of the map, of the camera and of the odometry. Their scenes
    are encoded and decoded, ten in a second. Two fusions run on them: one of scenes only, and one
    that has a camera, too, which fails for a third of the time. Compared are the centre of the
    lane, its shape y(0) - 2 y(10 m) + y(20 m), and its width.

    Args:
        maps: folders and files of maps.
        cars: on each map and road.
        seconds: of each car.
        shapes: of random roads.
        seed: of the first car.
    """
    found = sources(maps, shapes, ("straight, spiral, bend of 150 m", spiral_map()))
    result: dict[str, Any] = {}
    every: dict[str, list[Array]] = {name: [] for name in MAP_ERRORS}
    for place, (name, map_of) in enumerate(progress(found.items(), "roads", len(found))):
        for error_name, error in MAP_ERRORS.items():
            driven = []
            for number in range(seed, seed + cars):
                road_map = map_of(number)
                own = 1000 * place + number  # each car on each road has errors of its own
                driven.append(of_car(road_map, route_of(road_map, number), error, seconds, own))
            result[f"{name}, {error_name}"] = figures(driven)
            every[error_name] += driven
    return result | {f"all, {name}": figures(driven) for name, driven in every.items()}


def of_car(
    road_map: map_model.Map,
    route: map_model.Route,
    error: MapError | None,
    seconds: float,
    seed: int,
) -> Array:
    """Return the (ways, n, quantities) normalised errors of a car on a part of a route."""
    drive = drive_along(road_map, route)
    latest = max(drive.end - seconds - 0.5, 0.5)
    start = float(np.random.default_rng([seed, 2]).uniform(0.5, latest))
    times = np.arange(start, min(start + seconds, drive.end - 0.2), DT)
    decoder = codec_of("maplines-pose.dbc").decoder(cycle_ms=round(1000 * DT))
    alone, with_camera, rows = LaneFusion(), LaneFusion(), []
    for now in moments(road_map, route, times, error, decoder, seed):
        view = decoder.latest_scene(now.t_ns)
        lanes = (
            alone.step(now.t_ns, view, now.motion),
            with_camera.step(now.t_ns, view, now.motion, now.camera),
        )
        rows.append([normalised(lane.scene, now.true) for lane in lanes])
    return np.array(rows).reshape(-1, len(WAYS), len(QUANTITIES)).swapaxes(0, 1)


class Moment(NamedTuple):
    """One cycle of a car, after its scene has arrived."""

    t_ns: int  #: now [ns]
    motion: Motion  #: as measured
    camera: list[MapLine]
    true: Array  #: (2, 9) lateral positions of both lines at ``Y_PLACES`` now [m]


def moments(
    road_map: map_model.Map,
    route: map_model.Route,
    times: Array,
    error: MapError | None,
    decoder: Decoder,
    seed: int,
) -> Iterator[Moment]:
    """Yield the moments of a car at times of its drive [s]."""
    encoder, drive = codec_of("maplines-pose.dbc").encoder(), drive_along(road_map, route)
    e, rng = Errors(), np.random.default_rng([seed, 1])
    poses, tracker = PoseSource(e.pose_sigma, POSE_TIME, seed), LaneTracker(road_map, route)
    of_map, bias = MapOfCar(error, rng), UnitGaussMarkov(rng, (3,))
    scale, gyro = 1 + e.speed_scale * rng.normal(), e.yaw_rate_bias * rng.normal()
    outage = times[0] + np.array(e.outage) * (times[-1] - times[0])
    for t in times.tolist():
        state = drive.at(t)
        stated = poses.pose(t, state.pose)
        tracked = tracker.lines(stated.mean).lines
        true = {slot: tracked[slot] for slot in LANE if slot in tracked}
        of_car = {slot: of_map(slot, line) for slot, line in true.items()}
        scene = map_scene(
            of_car, stated, window=WINDOW, map_error=error, correlation_time=POSE_TIME
        )
        now_ns = feed(encoder, decoder, scene, t + AGE, AGE, FRAME)
        speed = float(state.speed) * scale
        rate = float(state.yaw_rate) + gyro + e.yaw_rate_noise * rng.normal()
        motion = Motion.with_sigma(speed, rate, (e.speed_scale * speed + 0.01, e.yaw_rate_noise))
        camera, seen_bias = [], bias.step(DT / e.bias_time) * e.camera_bias
        if len(true) == len(LANE) and not outage[0] <= t < outage[1]:
            seen = camera_view(true, state.pose, seen_bias, e, rng)
            camera = [replace(line, age=(now_ns - 1e9 * t) / 1e9) for line in seen]
        pose = drive.at(min(now_ns / 1e9, drive.end)).pose
        yield Moment(now_ns, motion, camera, positions(true, pose))


def positions(lines: dict[Slot, Polyline], pose: Array) -> Array:
    """Return the (2, 9) lateral positions of the lines of the lane at ``Y_PLACES`` [m]."""
    return true_lines(lines, LANE, pose)[:, : len(Y_PLACES)]


def normalised(scene: Scene | None, true: Array) -> Array:
    """Return the errors of all quantities in units of their sigmas; NaN where not valid."""
    z = np.full(len(QUANTITIES), np.nan)
    if scene is None or not all(slot in scene.index for slot in LANE):
        return z
    low, high = scene.x_range(LANE)
    for i, (lines, weights) in enumerate(QUANTITIES.values()):
        if not low <= min(weights) <= max(weights) <= high:
            continue
        x, of_x = np.array([*weights], dtype=float), np.array([*weights.values()])
        columns = [Y_PLACES.index(place) for place in weights]
        error, J = 0.0, list[Array]()
        for side, (slot, weight) in enumerate(zip(LANE, lines, strict=True)):
            line = scene.line(slot)
            error += weight * float(of_x @ (line.y(x) - true[side, columns]))
            J.append(weight * of_x @ lateral_jacobian(line.gaussian.mean, x))
        derivative = np.concatenate(J)
        z[i] = error / math.sqrt(derivative @ scene.joint(LANE).cov @ derivative)
    return z


def figures(cars: Sequence[Array]) -> dict[str, Any]:
    """Return the NEES of all quantities of cars, the shares inside and the largest errors."""
    result: dict[str, Any] = {}
    for way, z in zip(WAYS, np.concatenate(cars, axis=1), strict=True):
        of_way = result[way] = {}
        for name, values in zip(QUANTITIES, z.T, strict=True):
            known = values[np.isfinite(values)]
            if len(known):
                of_way[name] = {
                    "NEES": Mean(float((known**2).mean()), len(cars)),
                    "inside": Share(float((np.abs(known) <= INTERVAL).mean()), len(cars)),
                    "worst [sigma]": float(np.abs(known).max()),
                }
    return result
