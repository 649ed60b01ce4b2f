"""Closed loop: a car on a map that steers by the lines which it has received."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from maplines_can.consumers.speed_limit import SteeringReason
from maplines_can.consumers.steering import LaneSteering, SteeringState
from maplines_can.maps import Map, Route
from maplines_can.maps.line_source import WINDOW, LineSource
from maplines_can.propagation import Motion, map_scene
from maplines_can.simulation.pose_source import PoseSource
from maplines_can.values.gaussian import Gaussian
from maplines_can.values.line import Slot
from maplines_can.values.polyline import Polyline
from maplines_can.values.scene import Scene

from .transfer import codec_of, feed

#: Period of the lines and of the control [s].
PERIOD = 0.05
#: Step of the simulation of the car [s].
STEP = 0.01
#: Time from the pose to the sending of the lines, and until the frames have arrived [s].
AGE, TRANSMISSION = 0.020, 0.008
#: Time within which the receiver must have found the lines plausible [s].
START = 2.0
#: Speed limit of lanes that state none [m/s].
DEFAULT_SPEED = 50 / 3.6
#: Distance from the end of the way at which the drive ends [m].
MARGIN = 10.0
#: Largest deviation of a cubic from its line [m]. At the end of a corner, that is what the car is
#: off the lane although it knows its pose.
MISFIT = 0.05
#: Slots that are sent on a map.
SLOTS = (Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.ROUTE)
#: Distance before and after a lane change in which the car follows the line of the route [m].
BESIDE_CHANGE = 15.0
#: Standard deviations of the measured speed [m/s] and yaw rate [rad/s].
ODOMETRY = (0.05, 0.003)
#: Correlation time of the error of the reported pose [s].
POSE_TIME = 10.0
#: Standard deviations of dead reckoning in an outage: scale of the speed, yaw rate bias [rad/s].
DRIFT = (0.01, math.radians(0.05))


class Car:
    """Kinematic bicycle at its rear axle, with an actuator of the steering and one of the speed.

    The demanded curvature passes a delay, a first-order lag and the limits of the road wheel angle
    and of its rate.

    Args:
        pose: (3,) x [m], y [m], heading [rad].
        speed: [m/s].
    """

    wheelbase = 2.7
    most_angle, most_rate = math.radians(35.0), math.radians(35.0)
    delay, lag, speed_lag = 0.1, 0.1, 0.4
    most_acceleration, most_deceleration = 2.5, 6.0

    def __init__(self, pose: NDArray[np.float64], speed: float) -> None:
        self.pose, self.speed, self.angle = pose.astype(float), speed, 0.0
        self._waiting = deque([0.0] * round(self.delay / STEP))

    @property
    def curvature(self) -> float:
        """Curvature of the path of the rear axle [1/m]."""
        return math.tan(self.angle) / self.wheelbase

    def drive(self, curvature: float, speed: float, time: float) -> None:
        """Drive for a time [s] with these demands [1/m, m/s]."""
        for _ in range(round(time / STEP)):
            self._waiting.append(math.atan(curvature * self.wheelbase))
            rate = (self._waiting.popleft() - self.angle) / self.lag
            self.angle += STEP * min(max(rate, -self.most_rate), self.most_rate)
            self.angle = min(max(self.angle, -self.most_angle), self.most_angle)
            gain = (speed - self.speed) / self.speed_lag
            gain = min(max(gain, -self.most_deceleration), self.most_acceleration)
            before, self.speed = self.speed, max(0.0, self.speed + STEP * gain)
            way = STEP * (before + self.speed) / 2
            turn = way * self.curvature
            middle = self.pose[2] + turn / 2
            step = np.array([way * math.cos(middle), way * math.sin(middle), turn])
            self.pose = self.pose + step


class ReportedPoses:
    """Reported poses: Gauss-Markov errors, and dead reckoning in an outage.

    In an outage, the error grows by a yaw rate bias and a scale of the speed, both constant, drawn
    at its begin. The stated covariance is that of these errors.

    Args:
        sigma: (3,) along [m], across [m], heading [rad].
        outages: begins and ends [s].
        seed: of the random numbers.
    """

    def __init__(
        self,
        sigma: Sequence[float],
        outages: Sequence[tuple[float, float]] = (),
        seed: int = 0,
    ) -> None:
        self._source = PoseSource(sigma, POSE_TIME, seed)
        self._sigma, self._outages = np.array(sigma), outages
        self._random = np.random.default_rng([seed, 1])
        self._last: tuple[float, NDArray[np.float64]] | None = None
        self._error: NDArray[np.float64] | None = None  # with scale and bias, in an outage
        self._cov = np.zeros((5, 5))

    def pose(self, t: float, true_pose: NDArray[np.float64]) -> Gaussian:
        """Return the reported pose, see ``PoseSource.pose``."""
        stated = self._source.pose(t, true_pose)
        out = any(begin <= t < end for begin, end in self._outages)
        c, s = math.cos(true_pose[2]), math.sin(true_pose[2])
        T = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        if not out:
            self._error = None
        elif self._error is None or self._last is None:
            drift = self._random.standard_normal(2) * DRIFT
            self._error = np.concatenate([T.T @ (stated.mean - true_pose), drift])
            self._cov = np.diag(np.square([*self._sigma, *DRIFT]))
        else:
            before, pose = self._last
            dt, turn = t - before, true_pose[2] - pose[2]
            way = float(np.hypot(*(true_pose - pose)[:2]))
            cos, sin = math.cos(turn), math.sin(turn)
            F = np.eye(5)
            F[0, 3], F[1, 2], F[2, 4] = way, way, dt
            F[:2] = np.array([[cos, sin], [-sin, cos]]) @ F[:2]
            self._error = F @ self._error
            self._cov = F @ self._cov @ F.T
        self._last = t, true_pose.copy()
        if self._error is None:
            return stated
        cov = T @ self._cov[:3, :3] @ T.T
        return Gaussian.trusted(true_pose + T @ self._error[:3], (cov + cov.T) / 2)


class LoopCycle(NamedTuple):
    """One period of a closed loop."""

    t: float  #: [s]
    along: float  #: distance along the route [m]
    error: float  #: lateral, of the rear axle, positive to the left of the route [m]
    stated_error: float  #: of the reported pose, across the road [m]
    speed: float  #: [m/s]
    curvature: float  #: [1/m]
    state: SteeringState
    reason: SteeringReason


class Seen(NamedTuple):
    """Lines at one time, and the pose from which the sender sees them."""

    stated: Gaussian | None
    scene: Scene | None
    speed_limit: float  #: [m/s]


#: Lines at a time [s] and a true pose.
LineSender = Callable[[float, NDArray[np.float64]], Seen]
#: Reported pose at a time [s] and a true pose.
Stated = Callable[[float, NDArray[np.float64]], Gaussian | None]


def on_map(road_map: Map, route: Route, stated: Stated) -> ClosedLoop:
    """Return the closed loop along a route of a map.

    In lane changes, the car follows the line of the route, which is sent only there.
    """
    changes = [(c.start - BESIDE_CHANGE, c.end + BESIDE_CHANGE) for c in route.changes]
    source = LineSource(
        road_map, stated, SLOTS, route, correlation_time=POSE_TIME, max_misfit=MISFIT
    )

    def seen(t: float, pose: NDArray[np.float64]) -> Seen:
        cycle = source.cycle(t, pose)
        lane = cycle.tracked.lane
        limit = None if lane is None else road_map.lanes[lane].speed_limit
        return Seen(cycle.reported, cycle.scene, limit or DEFAULT_SPEED)

    return ClosedLoop(route.line, seen, (route.start, route.goal), changes)


def on_street(lines: Mapping[Slot, Polyline], stated: Stated) -> ClosedLoop:
    """Return the closed loop in the ego lane of a street, such as one of ``STREETS``."""
    sent = {slot: lines[slot] for slot in SLOTS[:2]}

    def seen(t: float, pose: NDArray[np.float64]) -> Seen:
        known = stated(t, pose)
        scene = None
        if known is not None:
            scene = map_scene(
                sent, known, correlation_time=POSE_TIME, window=WINDOW, max_misfit=MISFIT
            )
        return Seen(known, scene, DEFAULT_SPEED)

    centre = lines[Slot.CENTRE]
    return ClosedLoop(centre, seen, (2.0, centre.length))


@dataclass
class ClosedLoop:
    """A car that steers by the lines that it receives.

    Args:
        line: that it is to follow.
        seen: lines as the sender sees them.
        way: begin and end along the line [m].
        changes: begins and ends along the line between which the car follows the route [m].
        steering: the lane keeping.
        line_outages: begins and ends of times in which no frame arrives [s].
        seed: of the odometry.
    """

    line: Polyline
    seen: LineSender
    way: tuple[float, float]
    changes: Sequence[tuple[float, float]] = ()
    steering: LaneSteering = field(default_factory=LaneSteering)
    line_outages: Sequence[tuple[float, float]] = ()
    seed: int = 0

    def run(
        self,
        seconds: float = math.inf,
        tick: Callable[[float], object] = lambda _: None,
    ) -> list[LoopCycle]:
        """Drive until the way ends, or until the car has handed over and stopped.

        Args:
            seconds: longest time [s].
            tick: called with each time step [s].
        """
        codec = codec_of("maplines-pose.dbc")
        encoder, decoder = codec.encoder(), codec.decoder()
        random = np.random.default_rng(self.seed)
        place = RouteProgress(self.line.points, self.line.distance)
        car = Car(place.pose(self.way[0]), 0.0)
        moments: list[LoopCycle] = []
        demands = (0.0, 0.0)
        # The car drives on by the last demands, until the lines have arrived and are used.
        latency = STEP * round((AGE + 2 * TRANSMISSION) / STEP)
        for k in range(int(min(seconds, 1e6) / PERIOD)):
            t = k * PERIOD
            along, error = place.of(car.pose)
            if along > self.way[1] - MARGIN:
                break
            stated, scene, speed_limit = self.seen(t, car.pose)
            dx, dy, _ = np.full(3, math.nan) if stated is None else stated.mean - car.pose
            across = place.direction @ [dy, -dx]
            route = Slot.ROUTE if any(a <= along <= b for a, b in self.changes) else None
            lost = any(begin <= t < end for begin, end in self.line_outages)
            if scene is not None and scene.lines and not lost:
                sent = scene if route is not None else without(scene, Slot.ROUTE)
                feed(encoder, decoder, sent, t + AGE + TRANSMISSION / 10, AGE, TRANSMISSION / 10)
            car.drive(*demands, latency)
            now = t + latency
            noise = random.standard_normal(2) * ODOMETRY * (car.speed > 0)
            speed, yaw_rate = np.array([car.speed, car.speed * car.curvature]) + noise
            now_ns = round(now * 1e9)
            self.steering.set_speed, self.steering.route = speed_limit, route
            motion = Motion.with_sigma(speed, yaw_rate, ODOMETRY)
            command = self.steering.step(now_ns, decoder.latest_scene(now_ns), motion)
            demands = command.curvature, command.speed
            car.drive(*demands, PERIOD - latency)
            driven = car.speed, car.curvature
            moments.append(
                LoopCycle(t, along, error, float(across), *driven, command.state, command.reason)
            )
            tick(PERIOD)
            if command.state is SteeringState.HANDOVER and car.speed < 0.05 and t > START:
                break
        return moments


def without(scene: Scene, slot: Slot) -> Scene:
    """Return a scene without the line of a slot."""
    return scene.subset(line.slot for line in scene.lines if line.slot != slot)


class RouteProgress:
    """Distance along a line of a pose that follows it.

    Args:
        points: (n, 2) of the line.
        distance: (n,) along it.
    """

    def __init__(self, points: NDArray[np.float64], distance: NDArray[np.float64]) -> None:
        keep = np.append(True, np.diff(distance) > 1e-6)
        self._points, self._distance = points[keep], distance[keep]
        self._last: float | None = None
        self.direction = np.array([1.0, 0.0])

    def pose(self, along: float) -> NDArray[np.float64]:
        """Return the pose on the line at a distance along it."""
        at = np.array([along, along + 0.5])
        x, y = (np.interp(at, self._distance, values) for values in self._points.T)
        self._last = along
        return np.array([x[0], y[0], math.atan2(y[1] - y[0], x[1] - x[0])])

    def of(self, pose: NDArray[np.float64]) -> tuple[float, float]:
        """Return the distance along the line and the lateral position of a pose [m]."""
        last = self._distance[0] if self._last is None else self._last
        low, high = self._distance.searchsorted([last - 10.0, last + 20.0])
        low = max(low - 1, 0)
        points = self._points[low : high + 1]
        chord = np.diff(points, axis=0)
        length = np.hypot(*chord.T)
        arm = pose[:2] - points[:-1]
        share = ((arm * chord).sum(axis=1) / length**2).clip(0, 1)
        square = ((arm - share[:, None] * chord) ** 2).sum(axis=1)
        i = int(square.argmin())
        self.direction = chord[i] / length[i]
        dx, dy = self.direction
        self._last = float(self._distance[low + i] + share[i] * length[i])
        return self._last, float(dx * arm[i, 1] - dy * arm[i, 0])


def spread(values: Any) -> dict[str, float]:
    """Return RMS, 95 % and the largest of absolute values [m]; NaN without values."""
    size = np.abs(values if len(values) else [math.nan])
    return {
        "rms": float(np.sqrt((size**2).mean())),
        "95 %": float(np.quantile(size, 0.95)),
        "max": float(size.max()),
    }
