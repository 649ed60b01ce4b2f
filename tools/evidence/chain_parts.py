"""Parts of the whole chain: the car, the sender of the lines, and their consumer."""

from __future__ import annotations

import bisect
import math
import time
from collections import defaultdict, deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from maplines_can import Gaussian, Motion, Slot, maps
from maplines_can.bus import Receiver
from maplines_can.consumers import FusedLane, LaneFusion, scene_view
from maplines_can.consumers.steering import Command, LaneSteering, SteeringState
from maplines_can.localisation import Localisation, LocalisationLayer
from maplines_can.maps.line_source import Cycle, LineSource
from maplines_can.simulation.camera import LANE, PLACES, Errors, UnitGaussMarkov, camera_view
from maplines_can.simulation.sensors import Arrival, SensorSetup, SimulatedSensors
from maplines_can.simulation.simulated_localisation import START_SIGMA
from maplines_can.simulation.trajectory import CarState
from maplines_can.wire import Decoder

from .closed_loop import (
    BESIDE_CHANGE,
    DEFAULT_SPEED,
    PERIOD,
    SLOTS,
    STEP,
    Car,
    RouteProgress,
)

Array = Any

#: Part of each minute in which the camera of the fusion fails [s].
CAMERA_OUTAGE = (50.0, 60.0)
#: Standard deviations of the measured speed [m/s] and yaw rate [rad/s], and its bias [rad/s].
ODOMETRY, GYRO_BIAS = (0.05, 0.005), 0.002
#: Oldest map lines by which the car steers [s].
OLDEST = 0.5
#: The driver takes the wheel after the car has stood for this time [s].
PAUSE = 2.0
#: Speed of the driver [m/s], the distance ahead at which he aims [m], and the distance from the
#: middle of the lane at which he lets the car drive again [m].
DRIVER_SPEED, DRIVER_AHEAD, DRIVER_DONE = 2.0, 8.0, 0.3


@cache
def town() -> tuple[maps.Map, maps.Route]:
    """Return the shipped town and the tour through it."""
    road_map = maps.load(maps.town_path())
    return road_map, maps.town_tour(road_map)


class CpuTimes(defaultdict[str, float]):
    """CPU times of the parts of a thread [s]."""

    @contextmanager
    def of(self, part: str) -> Iterator[None]:
        """Add the time of a block."""
        before = time.thread_time()
        yield
        self[part] += time.thread_time() - before


class KnownWay:
    """True motion of the car as far as it is known: a row for each step."""

    def __init__(self) -> None:
        self._rows: deque[Array] = deque(maxlen=100)

    def add(self, rows: Array) -> None:
        """Take rows of time [s], pose (x, y, heading), speed [m/s] and yaw rate [rad/s]."""
        self._rows.extend(rows)

    def at(self, t: Any) -> CarState:
        """Return the motion at (k,) times [s]."""
        table = np.array(self._rows)
        columns = [np.interp(t, table[:, 0], column) for column in table[:, 1:].T]
        return CarState(np.asarray(t), np.stack(columns[:3], axis=-1), columns[3], columns[4])


class World:
    """Car on the tour through the town, with odometry and a camera of its own."""

    def __init__(self, seed: int) -> None:
        self.map, self.route = town()
        self.place = RouteProgress(self.route.line.points, self.route.line.distance)
        self.car = Car(self.place.pose(self.route.start), 0.0)
        self.t = 0.0
        self._tracker = maps.LaneTracker(self.map, self.route)
        self._rng, self._errors = np.random.default_rng([seed, 7]), Errors()
        self._camera_bias = UnitGaussMarkov(self._rng, (3,))
        self._gyro_bias = GYRO_BIAS * self._rng.standard_normal()
        self.row = self._row()

    def _row(self) -> Array:
        car = self.car
        return np.array([self.t, *car.pose, car.speed, car.speed * car.curvature])

    def drive(self, curvature: float, speed: float, duration: float) -> Array:
        """Drive with these demands; return a row for each step."""
        rows = []
        for _ in range(round(duration / STEP)):
            self.car.drive(curvature, speed, STEP)
            self.t += STEP
            rows.append(self._row())
        return np.array(rows).reshape(-1, 6)

    def motion(self) -> Motion:
        """Return the motion as measured."""
        speed, rate = self.car.speed, self.car.speed * self.car.curvature + self._gyro_bias
        noise = self._rng.standard_normal(2) * ODOMETRY * (speed > 0)
        return Motion.with_sigma(speed + noise[0], rate + noise[1], ODOMETRY)

    def camera(self) -> tuple[list[Any], float]:
        """Return the lines that the camera sees now, and the speed limit of the lane [m/s]."""
        seen = self._tracker.lines(self.car.pose)
        limit = None if seen.lane is None else self.map.lanes[seen.lane].speed_limit
        bias = self._camera_bias.step(PERIOD / self._errors.bias_time) * self._errors.camera_bias
        lines = {slot: line for slot, line in seen.lines.items() if slot in LANE}
        is_out = CAMERA_OUTAGE[0] <= self.t % 60 < CAMERA_OUTAGE[1]
        found = [] if is_out else camera_view(lines, self.car.pose, bias, self._errors, self._rng)
        return found, limit or DEFAULT_SPEED


class Sender:
    """Localisation with simulated sensors, and the lines around its pose."""

    def __init__(self, seed: int, start: Array) -> None:
        found, route = town()
        layer, setup, rng = LocalisationLayer(found), SensorSetup(), np.random.default_rng(seed)
        sigma = np.array(START_SIGMA)
        stated = Gaussian(start[1:4] + sigma * rng.standard_normal(3), np.diag(sigma**2))
        self._way, self._waiting = KnownWay(), list[Arrival]()
        self._sensors = SimulatedSensors(layer, setup, rng)
        self._localisation = Localisation(stated, 0.0, setup.errors, layer)
        self._source = LineSource(
            found,
            lambda t, _: self._localisation.ego(max(t, self._localisation.t)),
            SLOTS,
            route,
            correlation_time=lambda: float(self._localisation.correlation_times()[0, 1]),
        )
        self.cpu, self.nees, self.across = CpuTimes(float), list[float](), list[float]()

    def move(self, rows: Array) -> None:
        """Measure the motion of the car, and localise it."""
        with self.cpu.of("simulation"):
            self._way.add(rows)
            for arrival in self._sensors.measure(self._way, float(rows[-1, 0])):
                bisect.insort(self._waiting, arrival, key=lambda one: one.t)
        with self.cpu.of("localisation"):
            while self._waiting and self._waiting[0].t <= rows[-1, 0] + 1e-9:
                self._localisation.add(self._waiting.pop(0).measurement)

    def cycle(self, row: Array) -> Cycle:
        """Return the lines, as seen from the reported pose."""
        with self.cpu.of("lines"):
            cycle = self._source.cycle(float(row[0]), row[1:4])
        if cycle.reported is None:
            return cycle
        error = cycle.reported.mean - row[1:4]
        error[2] = math.remainder(error[2], 2 * math.pi)
        self.nees.append(float(error @ np.linalg.solve(cycle.reported.cov, error)) / 3)
        self.across.append(float(np.array([-math.sin(row[3]), math.cos(row[3])]) @ error[:2]))
        return cycle

    def figures(self) -> dict[str, Any]:
        """Return how well it knew the pose."""
        return {
            "NEES of the pose": float(np.mean(self.nees)),
            "RMS of the pose across [m]": float(np.sqrt(np.mean(np.square(self.across)))),
        }


class Moment(NamedTuple):
    """One cycle of the receiver."""

    now: float  #: time of the fused lane [s]
    along: float  #: [m]
    error: float  #: [m]
    state: SteeringState
    reason: str
    map_age: float  #: [s]
    centre: Array  #: (3, 2) lane centre at ``PLACES`` and its sigma [m], NaN if unknown


@dataclass
class Consumer:
    """Fusion and lane keeping of the receiver, and what they did."""

    world: World
    source: Decoder | Receiver
    demands: tuple[float, float] = (0.0, 0.0)
    cpu: CpuTimes = field(default_factory=lambda: CpuTimes(float))
    moments: list[Moment] = field(default_factory=list)
    rows: list[Array] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._fusion, self._steering = LaneFusion(), LaneSteering()
        self._stopped, self._is_driver = 0.0, False
        margin = BESIDE_CHANGE
        self._changes = [(c.start - margin, c.end + margin) for c in self.world.route.changes]
        self.rows.append(self.world.row[None])

    def step(self, start_ns: int, now_ns: int) -> None:
        """Fuse what has arrived, and set the demands, at a time [ns]."""
        world, now = self.world, (now_ns - start_ns) / 1e9
        with self.cpu.of("simulation"):
            along, error = world.place.of(world.car.pose)
            camera, limit = world.camera()
            motion = world.motion()
        camera = [replace(line, age=max(now - world.t, 0.0)) for line in camera]
        route = Slot.ROUTE if any(a <= along <= b for a, b in self._changes) else None
        with self.cpu.of("fusion"):
            view = self.source.latest_scene(now_ns)
            lane = self._fusion.step(now_ns, view, motion, camera)
        with self.cpu.of("steering"):
            if route is None:
                view = lane.view if lane.map_age <= OLDEST else scene_view(None)
            self._steering.set_speed, self._steering.route = limit, route
            command = self._steering.step(now_ns, view, motion)
        self.demands = command.curvature, command.speed
        self._take_over(command, along, error)
        self.moments.append(
            Moment(
                now, along, error, command.state, command.reason.name, lane.map_age, centre_of(lane)
            )
        )

    def _take_over(self, command: Command, along: float, error: float) -> None:
        """Let the driver bring a car back to its lane that has handed over, and drive again."""
        stands = command.state is SteeringState.HANDOVER and self.world.car.speed < 0.05
        self._stopped = self._stopped + PERIOD if stands else 0.0
        self._is_driver |= self._stopped > PAUSE
        self._is_driver &= command.state is SteeringState.HANDOVER
        if self._is_driver and abs(error) < DRIVER_DONE:
            self._steering.reset()
            self._stopped, self._is_driver = 0.0, False
        if self._is_driver:  # pure pursuit
            self.demands = self._aim(along + DRIVER_AHEAD), DRIVER_SPEED

    def _aim(self, along: float) -> float:
        """Return the curvature of the circle to a place of the tour [1/m]."""
        pose, points = self.world.car.pose, self.world.route.line
        target = [np.interp(along, points.distance, column) for column in points.points.T]
        dx, dy = np.array(target) - pose[:2]
        across = math.cos(pose[2]) * dy - math.sin(pose[2]) * dx
        return float(2 * across / (dx**2 + dy**2))

    def drive(self, before: tuple[float, float], latency: float) -> Array:
        """Drive a period: with the demands before for the latency [s]; return the rows."""
        with self.cpu.of("simulation"):
            rows = np.vstack(
                [
                    self.world.drive(*before, latency),
                    self.world.drive(*self.demands, PERIOD - latency),
                ]
            )
        self.rows.append(rows)
        return rows


def centre_of(lane: FusedLane) -> Array:
    """Return the (3, 2) lane centre at ``PLACES`` and its sigma [m], NaN where it is unknown."""
    found = np.full((len(PLACES), 2), np.nan)
    if lane.scene is not None:
        low, high = lane.scene.x_range(LANE)
        inside = (low <= np.array(PLACES)) & (np.array(PLACES) <= high)
        centre = lane.scene.centre(np.array(PLACES)[inside])
        found[inside] = np.column_stack([centre.value, centre.sigma])
    return found
