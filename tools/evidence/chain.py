"""The whole chain at once: a car drives through the town by lines that it receives.

    car -> GNSS, odometry, camera, landmarks -> Localisation -> map_scene -> Transmitter
     ^                                                                           |
     |                                                                          bus
     |                                                                           v
     +--- LaneSteering <- LaneFusion <- Receiver, odometry and a second camera --+

The sender gets the true motion of the car, which its simulated sensors measure. The camera of the
fusion fails for 10 s in each minute. The map has no error. The car steers by the fused lane, in
lane changes by the received line of the route. After a handover it stops; then a driver brings it
back to the lane, and lets it drive again.

The error is the lateral distance of the rear axle from the middle of the lane. NEES is the squared
error in units of the variance, for each degree of freedom. One drive is one draw of errors that
last, so it scatters about 1. Lost is what was sent, less what was received.
"""

from __future__ import annotations

import bisect
import math
from collections import Counter, deque
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from answers import lines_of

from maplines_can import Gaussian, Motion, Slot, maps
from maplines_can.consumers import FusedLane, LaneFusion, scene_view
from maplines_can.consumers.steering import Command, LaneSteering, SteeringState
from maplines_can.localisation import Localisation, LocalisationLayer
from maplines_can.maps.line_source import Cycle, LineSource
from maplines_can.simulation.camera import (
    COLUMNS,
    LANE,
    PLACES,
    Errors,
    UnitGaussMarkov,
    camera_view,
)
from maplines_can.simulation.car_stream import AGE, FRAME
from maplines_can.simulation.sensors import Arrival, SensorSetup, SimulatedSensors
from maplines_can.simulation.simulated_localisation import START_SIGMA
from maplines_can.simulation.trajectory import CarState
from maplines_can.simulation.truth import true_lines
from maplines_can.wire import POSE, Decoder, Frame

from .closed_loop import (
    BESIDE_CHANGE,
    DEFAULT_SPEED,
    MARGIN,
    PERIOD,
    SLOTS,
    STEP,
    Car,
    RouteProgress,
    spread,
)
from .figures import flat
from .harness import bar, evidence
from .transfer import codec_of

Array = Any

#: Distance from a lane change beyond which the fused lane is compared with the truth [m].
BESIDE = BESIDE_CHANGE + 40.0
#: Each n-th cycle is compared with the truth.
EACH = 4
#: Time from the pose to the demands in a simulated drive [s].
LATENCY = 0.04
#: DBC with a message of the pose error.
DBC = "maplines-pose.dbc"
FUSED = "NEES of the fused lane"
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


@evidence
def chain(seconds: float = 600.0, seeds: int = 1, seed: int = 0) -> dict[str, Any]:
    """Drive without waiting and without a bus, with other errors for each seed."""
    drives = {}
    with bar(round(seconds) * seeds, "drive", unit=" s") as shown:
        for number in range(seed, seed + seeds):
            drives[f"seed {number}"] = drive_of(seconds, number, shown)
    if seeds == 1:
        return drives[f"seed {seed}"]
    tables, every = [dict(flat(one)) for one in drives.values()], {}
    for name, value in tables[0].items():
        if isinstance(value, float):
            values = np.array([table.get(name, math.nan) for table in tables])
            values = values[np.isfinite(values)]
            if len(values) > 1:
                error = values.std(ddof=1) / math.sqrt(len(values))
                every[name] = {"mean": float(values.mean()), "standard error": float(error)}
    return drives | {"all": every}


def drive_of(seconds: float, seed: int, shown: Any) -> dict[str, Any]:
    """Return the figures of a simulated drive."""
    world = World(seed)
    sender, encoder, decoder = Sender(seed, world.row), codec_of(DBC).encoder(), new_decoder()
    consumer = Consumer(world, decoder)
    rows, lines, received = world.row[None], 0, 0
    on_the_way: deque[tuple[int, Frame]] = deque()

    def deliver(now_ns: float) -> int:
        """Deliver the frames until now; return the number of lines."""
        found = 0
        while on_the_way and on_the_way[0][0] <= now_ns:
            ns, frame = on_the_way.popleft()
            found += len(lines_of(decoder.feed(frame.can_id, frame.data, ns)))
        return found

    while world.t < seconds - STEP / 2 and not world.is_at_goal():
        sender.move(rows)
        scene = sender.cycle(rows[-1]).scene
        if scene is not None and scene.lines:
            encoded = encoder.encode_scene(scene, age=AGE)
            lines += len(encoded.keys() - {POSE})
            on_the_way += in_period(encoded.values(), world.t + AGE)
        received += deliver(1e9 * (world.t + LATENCY))
        before = consumer.demands
        consumer.step(round(1e9 * (world.t + LATENCY)))
        rows = consumer.drive(before)
        shown.update(PERIOD)
    received += deliver(math.inf)
    return figures_of(consumer) | sender.figures() | {"lines lost": lines - received}


def new_decoder() -> Decoder:
    """Return a decoder of the DBC."""
    return codec_of(DBC).decoder()


def in_period(transfers: Collection[list[Frame]], start: float) -> Iterator[tuple[int, Frame]]:
    """Yield the frames of a cycle with their times [ns], spread over a period as on the bus."""
    for i, frames in enumerate(transfers):
        for k, frame in enumerate(frames):
            yield round(1e9 * (start + PERIOD * i / len(transfers) + FRAME * k)), frame


# ---- the car, the sender of the lines, and their consumer --------------------------------------


@cache
def town() -> tuple[maps.Map, maps.Route]:
    """Return the shipped town and the tour through it."""
    road_map = maps.load(maps.town_path())
    return road_map, maps.town_tour(road_map)


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

    def is_at_goal(self) -> bool:
        """Return whether the car has arrived."""
        return self.place.of(self.car.pose)[0] > self.route.goal - MARGIN

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
        self._nees, self._across = list[float](), list[float]()

    def move(self, rows: Array) -> None:
        """Measure the motion of the car, and localise it."""
        self._way.add(rows)
        for arrival in self._sensors.measure(self._way, float(rows[-1, 0])):
            bisect.insort(self._waiting, arrival, key=lambda one: one.t)
        while self._waiting and self._waiting[0].t <= rows[-1, 0] + 1e-9:
            self._localisation.add(self._waiting.pop(0).measurement)

    def cycle(self, row: Array) -> Cycle:
        """Return the lines, as seen from the reported pose."""
        cycle = self._source.cycle(float(row[0]), row[1:4])
        if cycle.reported is not None:
            error = cycle.reported.mean - row[1:4]
            error[2] = math.remainder(error[2], 2 * math.pi)
            self._nees.append(float(error @ np.linalg.solve(cycle.reported.cov, error)) / 3)
            self._across.append(float(np.array([-math.sin(row[3]), math.cos(row[3])]) @ error[:2]))
        return cycle

    def figures(self) -> dict[str, Any]:
        """Return how well it knew the pose."""
        return {
            "NEES of the pose": float(np.mean(self._nees)),
            "RMS of the pose across [m]": float(np.sqrt(np.mean(np.square(self._across)))),
        }


class Moment(NamedTuple):
    """One cycle of the receiver."""

    now: float  #: time of the fused lane [s]
    along: float  #: [m]
    error: float  #: [m]
    state: SteeringState
    reason: str
    centre: Array  #: (3, 2) lane centre at ``PLACES`` and its sigma [m], NaN if unknown


@dataclass
class Consumer:
    """Fusion and lane keeping of the receiver, and what they did."""

    world: World
    source: Decoder
    demands: tuple[float, float] = (0.0, 0.0)
    moments: list[Moment] = field(default_factory=list)
    rows: list[Array] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._fusion, self._steering = LaneFusion(), LaneSteering()
        self._stopped, self._is_driver = 0.0, False
        margin = BESIDE_CHANGE
        self._changes = [(c.start - margin, c.end + margin) for c in self.world.route.changes]
        self.rows.append(self.world.row[None])

    def step(self, now_ns: int) -> None:
        """Fuse what has arrived, and set the demands, at a time [ns]."""
        world, now = self.world, now_ns / 1e9
        along, error = world.place.of(world.car.pose)
        camera, limit = world.camera()
        motion = world.motion()
        camera = [replace(line, age=max(now - world.t, 0.0)) for line in camera]
        route = Slot.ROUTE if any(a <= along <= b for a, b in self._changes) else None
        view = self.source.latest_scene(now_ns)
        lane = self._fusion.step(now_ns, view, motion, camera)
        if route is None:
            view = lane.view if lane.map_age <= OLDEST else scene_view(None)
        self._steering.set_speed, self._steering.route = limit, route
        command = self._steering.step(now_ns, view, motion)
        self.demands = command.curvature, command.speed
        self._take_over(command, along, error)
        state = command.state, command.reason.name
        self.moments.append(Moment(now, along, error, *state, centre_of(lane)))

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

    def drive(self, before: tuple[float, float]) -> Array:
        """Drive a period: with the demands before for the latency; return the rows."""
        first = self.world.drive(*before, LATENCY)
        rows = np.vstack([first, self.world.drive(*self.demands, PERIOD - LATENCY)])
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


def figures_of(consumer: Consumer) -> dict[str, Any]:
    """Return the figures of a drive.

    A car that hands over is the driver's until it drives again.
    """
    moments, world = consumer.moments, consumer.world
    automatic = [m.error for m in moments if m.state is not SteeringState.HANDOVER]
    handovers = [
        now.reason
        for before, now in pairwise(moments)
        if now.state is SteeringState.HANDOVER and before.state is not SteeringState.HANDOVER
    ]
    return {
        "seconds": round(world.t, 2),
        "km": (moments[-1].along - moments[0].along) / 1000,
        "cycles": len(moments),
        "error of the car [m]": spread(automatic),
        "share of the time driven by the lines": len(automatic) / len(moments),
        "reasons of the handovers": dict(Counter(handovers)),
        **fused_nees(consumer),
    }


def fused_nees(consumer: Consumer) -> dict[str, dict[str, float]]:
    """Return the mean NEES of the fused lane centre, apart from lane changes.

    That while the camera fails is apart from the one over the whole drive.
    """
    rows, world = np.vstack(consumer.rows), consumer.world
    tracker = maps.LaneTracker(world.map, world.route)
    changes = [(c.start - BESIDE, c.end + BESIDE) for c in world.route.changes]
    squares, is_out = [], []
    for moment in consumer.moments[::EACH]:
        pose = np.array([np.interp(moment.now, rows[:, 0], column) for column in rows[:, 1:4].T])
        lines = tracker.lines(pose).lines
        if any(a <= moment.along <= b for a, b in changes):
            continue
        centre = true_lines(lines, LANE, pose)[:, COLUMNS].mean(axis=0)
        squares.append(((moment.centre[:, 0] - centre) / moment.centre[:, 1]) ** 2)
        is_out.append(CAMERA_OUTAGE[0] <= moment.now % 60 < CAMERA_OUTAGE[1])
    table, out = np.array(squares).reshape(-1, len(PLACES)), np.array(is_out, dtype=bool)
    return {
        name: {
            f"{x:g} m": float(np.mean(known))
            for x, column in zip(PLACES, table[rows].T, strict=True)
            if len(known := column[np.isfinite(column)])
        }
        for name, rows in ((FUSED, slice(None)), (f"{FUSED}, camera failed", out))
    }
