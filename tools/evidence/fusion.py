"""Fusion of received lines with a camera: what the fused lane knows of its own error.

NEES is the squared error in units of its variance, 1 where the covariance is right. The covariance
also covers what cubics miss of a road, and the rounding on the bus, so there are upper bounds only:
that of the mean of as many independent cars (97.5 %).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from maplines_can import Codec, MapError, Scene, map_scene
from maplines_can import maps as map_model
from maplines_can.consumers import LaneFusion
from maplines_can.maps import LaneTracker
from maplines_can.maps.line_source import WINDOW
from maplines_can.propagation import Motion
from maplines_can.simulation import PoseSource
from maplines_can.simulation.camera import LANE, PLACES, Errors, UnitGaussMarkov, camera_view
from maplines_can.simulation.car_stream import AGE, FRAME
from maplines_can.simulation.trajectory import SimulatedDrive, drive_along
from maplines_can.simulation.truth import Y_PLACES, true_lines
from maplines_can.values.line import MapLine, Slot, lateral_jacobian
from maplines_can.values.polyline import Polyline
from maplines_can.wire import Decoder, default_dbc_path

from .drive_view import DriveView, drive_view
from .figures import Mean, Share
from .fleet import Simulation
from .fusion_ways import RIGHT, WRONG
from .harness import evidence, progress
from .roads import ROADS, route_of, sources, spiral_map
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
#: Stretches of the tour of the town by name: start and end [s].
STRETCHES = {"streets": (45.0, 105.0), "motorway": (320.0, 380.0)}
TIMES = (1.0, 5.0, 30.0)


def upper_bound(cars: int) -> float:
    """Return the 97.5 % bound of the mean NEES of one variable over independent cars.

    >>> round(upper_bound(50), 2)
    1.43
    """
    return float(chi2.ppf(0.975, cars) / cars)


@evidence(cars=20, seconds=12.0, rate=5.0, times=(30.0,), stretches=("motorway",))
def ways(
    cars: int = 50,
    seconds: float = 60.0,
    rate: float = 10.0,
    times: tuple[float, ...] = TIMES,
    stretches: tuple[str, ...] = tuple(STRETCHES),
    plot: Path | None = None,
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
        plot: file of a picture.
        seed: of the simulation.
    """
    views, result = town_views(seconds, rate, stretches), {}
    kinds = [(name, T, way) for name in views for T in times for way in (RIGHT | WRONG)]
    for name, T, way in progress(kinds, "ways"):
        simulation = Simulation(views[name], T, cars, seed, Errors())
        track = simulation.run((RIGHT | WRONG)[way](cars))
        nees = np.nanmean(track.nees, axis=0)
        kind = "right" if way in RIGHT else "wrong"
        result[f"{name}, {T:g} s, {kind}: {way}"] = {
            "rms": at_places(track.rms),
            "NEES": at_places(nees),
            "over bound": float(nees.max()) / upper_bound(cars),
            "false lines used": track.false_used,
            "true lines used": track.true_used,
        }
    if plot:
        from .pictures import draw_ways

        draw_ways({k: v for k, v in result.items() if k.startswith("motorway")}, plot)
    return result


def town_views(seconds: float, rate: float, stretches: Sequence[str]) -> dict[str, DriveView]:
    """Return the views of stretches of the tour of the town."""
    town, e = map_model.load(map_model.town_path()), Errors()
    route = map_model.town_tour(town)
    drive, codec = drive_along(town, route), Codec.from_dbc(default_dbc_path("maplines-pose.dbc"))
    stated, cov = MapError(e.map_local[0], e.map_offset, e.map_heading), np.diag(e.pose_sigma) ** 2
    result = {}
    for name in progress(stretches, "views"):
        start, end = STRETCHES[name]
        times = np.arange(start, min(end, start + seconds), 1 / rate)
        result[name] = drive_view(town, route, drive, times, codec, cov, stated)
    return result


def at_places(values: Array) -> dict[str, float]:
    """Return (3,) values by their places."""
    return {f"{x:g} m": float(value) for x, value in zip(PLACES, values, strict=True)}


@evidence(cars=1, seconds=1.0, shapes=("s-bend",))
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
    lane, its shape y(0) - 2 y(10 m) + y(20 m), and its width; "newest scene" is that as sent.

    Args:
        maps: folders and files of maps.
        cars: on each map and road.
        seconds: of each car.
        shapes: of random roads.
        seed: of the first car.
    """
    found = sources(maps, shapes, ("straight, spiral, bend of 150 m", spiral_map()))
    result: dict[str, Any] = {}
    every: dict[str, list[dict[str, Array]]] = {name: [] for name in MAP_ERRORS}
    for place, (name, map_of) in enumerate(progress(found.items(), "roads", len(found))):
        for error_name, error in MAP_ERRORS.items():
            driven = []
            for number in range(seed, seed + cars):
                road_map = map_of(number)
                own = 1000 * place + number  # each car on each road has errors of its own
                route = route_of(road_map, number)
                driven.append(of_car(road_map, route, error, seconds, own))
            result[f"{name}, {error_name}"] = figures(driven)
            every[error_name] += driven
    return result | {f"all, {name}": figures(driven) for name, driven in every.items()}


class Moment(NamedTuple):
    """One cycle of a car, after its scene has arrived."""

    t_ns: int  #: now [ns]
    motion: Motion  #: as measured
    camera: list[MapLine]
    true: Array  #: (2, 9) lateral positions of both lines at ``Y_PLACES`` now [m]
    sent: Scene  #: of a pose ``AGE`` ago
    true_then: Array  #: (2, 9) as ``true``, from the pose of that scene


def moments(
    road_map: map_model.Map,
    route: map_model.Route,
    drive: SimulatedDrive,
    times: Array,
    error: MapError | None,
    codec: Codec,
    decoder: Decoder,
    seed: int,
) -> Iterator[Moment]:
    """Yield the moments of a car at times of a drive [s]."""
    encoder = codec.encoder()
    e = Errors()
    rng = np.random.default_rng([seed, 1])
    poses, tracker = PoseSource(e.pose_sigma, POSE_TIME, seed), LaneTracker(road_map, route)
    of_map, bias = MapOfCar(error, rng), UnitGaussMarkov(rng, (3,))
    scale, gyro = 1 + e.speed_scale * rng.normal(), e.yaw_rate_bias * rng.normal()
    outage = times[0] + np.array(e.outage) * (times[-1] - times[0])
    for t in times.tolist():
        state = drive.at(t)
        stated = poses.pose(t, state.pose)
        tracked = tracker.lines(stated.mean).lines
        true = {slot: tracked[slot] for slot in LANE if slot in tracked}
        scene = map_scene(
            {slot: of_map(slot, line) for slot, line in true.items()},
            stated,
            window=WINDOW,
            map_error=error,
            correlation_time=POSE_TIME,
        )
        now_ns = round(1e9 * (t + AGE))
        for frames in encoder.encode_scene(scene, age=AGE).values():
            for frame in frames:
                decoder.feed(frame.can_id, frame.data, now_ns)
                now_ns += round(1e9 * FRAME)
        speed = float(state.speed) * scale
        rate = float(state.yaw_rate) + gyro + e.yaw_rate_noise * rng.normal()
        motion = Motion.with_sigma(speed, rate, (e.speed_scale * speed + 0.01, e.yaw_rate_noise))
        camera = []
        seen_bias = bias.step(DT / e.bias_time) * e.camera_bias
        if len(true) == len(LANE) and not outage[0] <= t < outage[1]:
            camera = camera_view(true, state.pose, seen_bias, e, rng)
        yield Moment(
            now_ns,
            motion,
            [replace(line, age=(now_ns - 1e9 * t) / 1e9) for line in camera],
            positions(true, drive.at(min(now_ns / 1e9, drive.end)).pose),
            scene,
            positions(true, state.pose),
        )


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
        error, J = scene_sum(scene, lines, weights)
        for x, weight in weights.items():
            error -= weight * float(np.dot(lines, true[:, Y_PLACES.index(x)]))
        z[i] = error / math.sqrt(J @ scene.joint(LANE).cov @ J)
    return z


def scene_sum(
    scene: Scene, lines: tuple[float, float], weights: dict[int, float]
) -> tuple[float, Array]:
    """Return a sum of lateral positions of both lines, and its (8,) derivative."""
    x, of_x = np.array([*weights], dtype=float), np.array([*weights.values()])
    value, J = 0.0, []
    for slot, weight in zip(LANE, lines, strict=True):
        line = scene.line(slot)
        value += weight * float(of_x @ line.y(x))
        J.append(weight * of_x @ lateral_jacobian(line.gaussian.mean, x))
    return value, np.concatenate(J)


#: What is compared: the fusion of scenes, that with a camera, and the newest scene as sent.
WAYS = ("scenes", "scenes and camera", "newest scene")


def of_car(
    road_map: map_model.Map,
    route: map_model.Route,
    error: MapError | None,
    seconds: float,
    seed: int,
) -> dict[str, Array]:
    """Return the (n, quantities) normalised errors of a car on a part of a route."""
    drive = drive_along(road_map, route)
    latest = max(drive.end - seconds - 0.5, 0.5)
    start = float(np.random.default_rng([seed, 2]).uniform(0.5, latest))
    times = np.arange(start, min(start + seconds, drive.end - 0.2), DT)
    codec = Codec.from_dbc(default_dbc_path("maplines-pose.dbc"))
    decoder = codec.decoder(cycle_ms=round(1000 * DT))
    alone, with_camera = LaneFusion(), LaneFusion()
    z: dict[str, list[Array]] = {way: [] for way in WAYS}
    for now in moments(road_map, route, drive, times, error, codec, decoder, seed):
        view = decoder.latest_scene(now.t_ns)
        lane = alone.step(now.t_ns, view, now.motion)
        z["scenes"].append(normalised(lane.scene, now.true))
        lane = with_camera.step(now.t_ns, view, now.motion, now.camera)
        z["scenes and camera"].append(normalised(lane.scene, now.true))
        z["newest scene"].append(normalised(now.sent, now.true_then))
    return {way: np.array(rows).reshape(-1, len(QUANTITIES)) for way, rows in z.items()}


def figures(cars: list[dict[str, Array]]) -> dict[str, Any]:
    """Return the NEES of all quantities of cars, the shares inside and the largest errors."""
    result: dict[str, Any] = {}
    for way in WAYS:
        z = np.concatenate([car[way] for car in cars])
        of_way = result[way] = {}
        for name, values in zip(QUANTITIES, z.T, strict=True):
            known = values[np.isfinite(values)]
            if len(known):
                inside = float((np.abs(known) <= INTERVAL).mean())
                of_way[name] = {
                    "NEES": Mean(float((known**2).mean()), len(cars)),
                    "inside": Share(inside, len(cars)),
                    "worst [sigma]": float(np.abs(known).max()),
                }
    return result
