"""Fusion of received lines with a camera: what the fused lane knows of its own error.

NEES is the squared error in units of its variance, 1 where the covariance is right. The covariance
also covers what cubics miss of a road, and the rounding on the bus, so there are upper bounds only:
that of the mean of as many independent cars (97.5 %).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from maplines_can import MapError, Scene, map_scene
from maplines_can import maps as map_model
from maplines_can.consumers import LaneFusion
from maplines_can.maps import LaneTracker
from maplines_can.maps.line_source import WINDOW
from maplines_can.propagation import Motion
from maplines_can.simulation import PoseSource
from maplines_can.simulation.camera import LANE, Errors, UnitGaussMarkov, camera_view
from maplines_can.simulation.car_stream import AGE, FRAME
from maplines_can.simulation.trajectory import drive_along
from maplines_can.simulation.truth import Y_PLACES, true_lines
from maplines_can.values.line import (
    MapLine,
    Slot,
    lateral_jacobian,
)
from maplines_can.values.polyline import Polyline
from maplines_can.wire import Decoder

from .figures import Mean, Share
from .harness import evidence, progress
from .roads import ROADS, route_of, sources, spiral_map
from .transfer import codec_of, feed
from .witness import Array, MapOfCar

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
def fusion(
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
