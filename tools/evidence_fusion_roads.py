#!/usr/bin/env python3
"""Measure whether the fused lane knows its own error, on the roads of maps and on random roads.

    evidence_fusion_roads.py DIR           every map in a folder, and random roads
    evidence_fusion_roads.py --cars 20     random roads only, with more cars

Run it in the environment of the project:
python3 tools/run.py python tools/evidence_fusion_roads.py DIR

Cars follow a random route on each map as a driver does, each on a part of it of its own, with its
own errors of the pose (Gauss-Markov), of the map, of the camera and of the odometry. Their scenes
are encoded with maplines-pose.dbc and decoded, ten in a second. Two fusions run on them: one of
scenes only, and one that has a camera, too, which fails for a third of the time.

The errors of the map are those of MapError: 5 cm of each point and 5 cm of each line; or none.

NEES is the squared error in units of its variance, 1 where the covariance is right, of the centre
of the lane at 0, 20 and 40 m, of its shape, which is y(0) - 2 y(10 m) + y(20 m) of the centre, and
of its width at the car: the mean over all cars and times, the share within 95 % of a Gaussian, and
the largest error in sigmas. That of the newest scene as sent is for comparison. The covariance also
covers what cubics miss of a road, and the rounding on the bus, so there are bounds on one side
only, over all roads: a mean NEES of at most 1.43, which is that of 50 independent cars (97.5 %),
and a share of at least 90 %. The exit status is 1 if the fusion of scenes misses one.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from evidence_fusion import upper_bound
from line_witness import Array
from random_roads import spiral_map
from reporting import bar, parser_of, report
from road_sources import route_of, sources_of

from maplines_can import Codec, MapError, PoseSource, Scene, map_scene, maps
from maplines_can.consumers import LaneFusion
from maplines_can.maps import LaneTracker
from maplines_can.maps.line_source import WINDOW
from maplines_can.propagation import Motion
from maplines_can.simulation.along_route import drive_along
from maplines_can.simulation.camera import Errors, UnitGaussMarkov
from maplines_can.simulation.camera_view import AGE, FRAME, LANE
from maplines_can.simulation.car_stream import camera_view
from maplines_can.simulation.trajectory import SimulatedDrive
from maplines_can.simulation.truth import Y_PLACES, true_lines
from maplines_can.values.line import MapLine, Slot, lateral_jacobian
from maplines_can.values.polyline import Polyline
from maplines_can.wire import Monitor, default_dbc_path

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
#: Least share of errors within the 95 % interval.
MIN_INSIDE = 0.9
#: Largest mean NEES.
BOUND = upper_bound(50)
INTERVAL = 1.96
#: Length of a route [m].
LENGTH = 3000.0


class Moment(NamedTuple):
    """One cycle of a car, after its scene has arrived."""

    t_ns: int  #: now [ns]
    motion: Motion  #: as measured
    camera: list[MapLine]
    true: Array  #: (2, 9) lateral positions of both lines at ``Y_PLACES`` now [m]
    sent: Scene  #: of a pose ``AGE`` ago
    true_then: Array  #: (2, 9) as ``true``, from the pose of that scene


class MapOfCar:
    """The lines as the map of a car has them: off the true ones by errors of their own.

    A point keeps its error, also in a line that begins or ends elsewhere.
    """

    def __init__(self, error: MapError | None, rng: np.random.Generator) -> None:
        self._error, self._rng = error, rng
        self._of_point: dict[tuple[float, float], tuple[Array, Array]] = {}
        self._moved: dict[Slot, tuple[Polyline, Polyline]] = {}

    def __call__(self, slot: Slot, line: Polyline) -> Polyline:
        """Return the line of the map for a true line."""
        if self._error is None:
            return line
        if slot not in self._moved or self._moved[slot][0] is not line:
            self._moved[slot] = line, self._with_errors(self._error, line)
        return self._moved[slot][1]

    def _with_errors(self, error: MapError, line: Polyline) -> Polyline:
        keys = [(round(x, 3), round(y, 3)) for x, y in line.points.tolist()]
        known = (self._of_point[key][0] for key in keys if key in self._of_point)
        offset = next(known, error.offset_sigma * self._rng.standard_normal(2))
        local = error.point_sigma * self._rng.standard_normal(line.points.shape)
        for key, own in zip(keys, local, strict=True):
            self._of_point.setdefault(key, (offset, own))
        return Polyline(
            line.points + offset + np.array([self._of_point[key][1] for key in keys]), line.kind
        )


def moments(
    road_map: maps.Map,
    route: maps.Route,
    drive: SimulatedDrive,
    times: Array,
    error: MapError | None,
    codec: Codec,
    monitor: Monitor,
    seed: int,
) -> Iterator[Moment]:
    """Yield the moments of a car at times of a drive [s]."""
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
        for frames in codec.encode_scene(scene, age=AGE).values():
            for frame in frames:
                monitor.feed(frame.can_id, frame.data, now_ns)
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
    road_map: maps.Map,
    route: maps.Route,
    error: MapError | None,
    options: Any,
    seed: int,
    tick: Callable[[float], object],
) -> dict[str, Array]:
    """Return the (n, quantities) normalised errors of a car on a part of a route."""
    drive = drive_along(road_map, route)
    latest = max(drive.end - options.seconds - 0.5, 0.5)
    start = float(np.random.default_rng([seed, 2]).uniform(0.5, latest))
    times = np.arange(start, min(start + options.seconds, drive.end - 0.2), DT)
    codec = Codec.from_dbc(default_dbc_path("maplines-pose.dbc"))
    monitor = Monitor(codec.decoder(cycle_ms=round(1000 * DT)))
    alone, with_camera = LaneFusion(monitor), LaneFusion(monitor)
    z: dict[str, list[Array]] = {way: [] for way in WAYS}
    for now in moments(road_map, route, drive, times, error, codec, monitor, seed):
        tick(DT)
        lane = alone.step(now.t_ns, now.motion)
        z["scenes"].append(normalised(lane.scene, now.true))
        lane = with_camera.step(now.t_ns, now.motion, now.camera)
        z["scenes and camera"].append(normalised(lane.scene, now.true))
        z["newest scene"].append(normalised(now.sent, now.true_then))
    return {way: np.array(rows).reshape(-1, len(QUANTITIES)) for way, rows in z.items()}


def figures(cars: list[dict[str, Array]], bound: float) -> dict[str, Any]:
    """Return the NEES of all quantities of cars, the shares inside and the largest errors."""
    result: dict[str, Any] = {"values": sum(len(car[WAYS[0]]) for car in cars)}
    for way in WAYS:
        z = np.concatenate([car[way] for car in cars])
        known = np.isfinite(z).sum(axis=0)
        nees = np.nansum(z**2, axis=0) / np.maximum(known, 1)
        inside = (np.abs(z) <= INTERVAL).sum(axis=0) / np.maximum(known, 1)
        worst = np.nanmax(np.abs(z), axis=0, initial=0.0)
        result[way] = {
            name: f"{nees[i]:.2f}, {inside[i]:.1%}, {worst[i]:.1f}" if known[i] else "-"
            for i, name in enumerate(QUANTITIES)
        }
        if way != WAYS[-1]:
            is_met = (nees <= bound) & (inside >= MIN_INSIDE) | (known == 0)
            result[way]["met"] = bool(is_met.all())
    return result


def main(argv: list[str] | None = None) -> int:
    """Print the figures; return 0 if the bounds are met, else 1."""
    parser = parser_of(__doc__)
    parser.add_argument("paths", nargs="*", metavar="DIR", help="folders or files of maps")
    parser.add_argument("--cars", type=int, default=4, help="on each map and road")
    parser.add_argument("--seconds", type=float, default=8.0, help="of each car")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(argv)
    found = sources_of(options.paths, ("straight, spiral, bend of 150 m", spiral_map()))
    result: dict[str, Any] = {}
    every: dict[str, list[dict[str, Array]]] = {name: [] for name in MAP_ERRORS}
    total = round(options.seconds) * options.cars * len(found) * len(MAP_ERRORS)
    with bar(total, unit=" s") as shown:
        for place, (name, map_of) in enumerate(found):
            for error_name, error in MAP_ERRORS.items():
                cars = []
                for seed in range(options.seed, options.seed + options.cars):
                    road_map = map_of(seed)
                    route = route_of(road_map, LENGTH, seed)
                    own = 1000 * place + seed  # each car on each road has errors of its own
                    cars.append(of_car(road_map, route, error, options, own, shown.update))
                result[f"{name}, {error_name}"] = figures(cars, BOUND)
                every[error_name] += cars
    for error_name, cars in every.items():
        result[f"all, {error_name}"] = figures(cars, BOUND)
    result["met"] = all(result[f"all, {name}"][WAYS[0]]["met"] for name in MAP_ERRORS)
    return report(result, options.json, 34)


if __name__ == "__main__":
    sys.exit(main())
