"""Simulated sensors of a drive: GNSS, odometry, and a camera that sees lines and landmarks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..localisation import (
    CameraLines,
    GaussMarkov,
    GnssFix,
    LocalisationLayer,
    Odometry,
    SeenLandmarks,
    SensorErrors,
)
from ..localisation.measurements import Measurement
from ..values.line import Kind
from .recorded_drive import RecordedDrive
from .trajectory import CarState, SimulatedDrive, even_times

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SensorSetup:
    """Sensors of a car.

    Rates are in Hz, latencies in s. An observation arrives after its latency.

    Args:
        errors: of the sensors, as far as they are correlated in time, and of the yaw rate; that of
            GNSS must be given.
        odometry_rate: of wheel speed and yaw rate.
        gnss_rate, gnss_latency: of the positions.
        gnss_sigma: of their white noise, in each axis [m].
        gnss_outages, line_outages, landmark_outages: pairs of times (begin, end) without them [s].
        camera_rate, camera_latency: of lines and landmarks; landmarks come at a fifth of the rate.
        line_sigma: of the white noise of the lines: lateral [m], direction [rad].
        line_dropout: mean time between random outages of the lines, and their mean duration [s].
        false_lines: share of lines that are none, anywhere within 3 m of the true one.
        unknown_kinds: share of lines whose kind is not recognised.
        landmark_sigma: of the white noise of the landmarks: range [m], bearing [rad].
        landmark_range, landmark_angle: within which landmarks are seen [m, rad].
        missed_landmarks, false_landmarks: shares of landmarks that are not seen, or are none.
        most_landmarks: that are seen at once.
    """

    errors: SensorErrors = SensorErrors(gnss=SensorErrors.UNKNOWN_GNSS)
    odometry_rate: float = 50.0
    gnss_rate: float = 5.0
    gnss_latency: float = 0.1
    gnss_sigma: float = 0.4
    gnss_outages: Sequence[tuple[float, float]] = ()
    line_outages: Sequence[tuple[float, float]] = ()
    landmark_outages: Sequence[tuple[float, float]] = ()
    camera_rate: float = 10.0
    camera_latency: float = 0.06
    line_sigma: tuple[float, float] = (0.05, math.radians(0.3))
    line_dropout: tuple[float, float] = (60.0, 5.0)
    false_lines: float = 0.02
    unknown_kinds: float = 0.1
    landmark_sigma: tuple[float, float] = (0.3, math.radians(0.5))
    landmark_range: float = 40.0
    landmark_angle: float = math.radians(50.0)
    missed_landmarks: float = 0.2
    false_landmarks: float = 0.02
    most_landmarks: int = 4


class Arrival(NamedTuple):
    """A measurement, and when it arrives."""

    t: float  #: [s]
    measurement: Measurement


class Way(Protocol):
    """True motion of a car: a drive, or what is known so far of a car in a closed loop."""

    def at(self, t: ArrayLike, /) -> CarState:
        """Return pose and motion at (k,) times [s]."""


class SimulatedSensors:
    """Sensors of n cars on the same way, with independent errors that continue from call to call.

    Args:
        layer: of the map on which the cars drive, without errors.
        setup: of the sensors.
        rng: random numbers.
        n: number of cars.
        start: time of the first measurements [s].

    Raises:
        ValueError: the setup does not know the error of GNSS.
    """

    def __init__(
        self,
        layer: LocalisationLayer,
        setup: SensorSetup,
        rng: np.random.Generator,
        n: int = 1,
        start: float = 0.0,
    ) -> None:
        self._layer, self._setup, self._rng, self._n = layer, setup, rng, n
        self._start = start
        self._taken = dict.fromkeys(("odometry", "gnss", "camera"), 0)
        errors = setup.errors
        if errors.gnss is None:
            raise ValueError(
                "setup.errors.gnss must be a GaussMarkov process, got None: what is not known "
                "cannot be simulated"
            )

        def process(one: GaussMarkov, rate: float, *shape: int) -> ErrorProcess:
            return ErrorProcess(one, 1 / rate, (n, *shape), rng)

        self._slip = process(errors.speed, setup.odometry_rate)
        self._scale = process(errors.wheel_scale, setup.odometry_rate)
        self._yaw_bias = process(errors.yaw_rate, setup.odometry_rate)
        self._gnss_bias = process(errors.gnss, setup.gnss_rate, 2)
        self._camera_offset = process(errors.camera_offset, setup.camera_rate, 1)
        self._camera_heading = process(errors.camera_heading, setup.camera_rate, 1)
        self._dropouts = [_Dropouts(start, *setup.line_dropout) for _ in range(n)]

    def measure(self, way: Way, end: float) -> list[Arrival]:
        """Return the measurements since the last call, up to a time [s], as they arrive.

        Args:
            way: true poses, known for that time.
            end: time of the last measurements [s].
        """
        setup = self._setup
        arrivals = [Arrival(one.t, one) for one in self._odometry(way, end)]
        arrivals += [Arrival(one.t + setup.gnss_latency, one) for one in self._gnss(way, end)]
        first, frames = self._times("camera", setup.camera_rate, end)
        seen: list[Measurement] = [*self._lines(way, frames)]
        seldom = frames[-first % 5 :: 5]
        seen += self._landmarks(way, seldom[_outside(seldom, setup.landmark_outages)])
        arrivals += [Arrival(one.t + setup.camera_latency, one) for one in seen]
        return sorted(arrivals, key=itemgetter(0))

    def _times(self, sensor: str, rate: float, end: float) -> tuple[int, Array]:
        """Return the number of the first time since the last call, and the times [s]."""
        first = self._taken[sensor]
        times = even_times(self._start, end, rate)[first:]
        self._taken[sensor] += len(times)
        return first, times

    def _odometry(self, way: Way, end: float) -> list[Odometry]:
        setup = self._setup
        _, t = self._times("odometry", setup.odometry_rate, end)
        if not len(t):
            return []
        state, k = way.at(t), len(t)
        slip, scale, bias = (one.next(k) for one in (self._slip, self._scale, self._yaw_bias))
        density = setup.errors.yaw_rate_noise * math.sqrt(setup.odometry_rate)
        white = density * self._rng.standard_normal(bias.shape)
        speed, rate = (state.speed + slip) / (1 + scale), state.yaw_rate + bias + white
        return [Odometry(float(one), v, w) for one, v, w in zip(t, speed.T, rate.T, strict=True)]

    def _gnss(self, way: Way, end: float) -> list[GnssFix]:
        setup = self._setup
        _, t = self._times("gnss", setup.gnss_rate, end)
        if not len(t):
            return []
        bias = self._gnss_bias.next(len(t))
        white = setup.gnss_sigma * self._rng.standard_normal(bias.shape)
        position = way.at(t).pose[:, :2].T + bias + white
        cov = setup.gnss_sigma**2 * np.eye(2)
        seen = np.flatnonzero(_outside(t, setup.gnss_outages))
        return [GnssFix(float(t[k]), position[:, :, k], cov) for k in seen]

    def _lines(self, way: Way, t: Array) -> list[CameraLines]:
        """Return the nearest line on the left and on the right at each time."""
        if not len(t):
            return []
        setup, rng, n = self._setup, self._rng, self._n
        beside = self._layer.lines_beside(way.at(t).pose)
        true, kind = np.full((2, 2, len(t)), np.nan), np.zeros((2, len(t)), dtype=np.intp)
        for side, sign in enumerate((1, -1)):
            rows = np.flatnonzero(sign * beside.offset > 0)
            rows = rows[np.lexsort((np.abs(beside.offset[rows]), beside.car[rows]))]
            rows = rows[np.append(True, np.diff(beside.car[rows]) > 0)[: len(rows)]]
            true[:, side, beside.car[rows]] = beside.offset[rows], beside.heading[rows]
            kind[side, beside.car[rows]] = beside.kind[rows]
        sigma, shape = setup.line_sigma, (n, 2, len(t))
        offset = true[0] + self._camera_offset.next(len(t))
        heading = true[1] + self._camera_heading.next(len(t))
        offset = offset + sigma[0] * rng.standard_normal(shape)
        heading = heading + sigma[1] * rng.standard_normal(shape)
        is_false = rng.random(shape) < setup.false_lines
        offset = np.where(is_false, offset + rng.uniform(-3, 3, shape), offset)
        out = np.array([one.hides(t, rng) for one in self._dropouts])
        out |= ~_outside(t, setup.line_outages)
        offset[out[:, None].repeat(2, axis=1)] = np.nan
        kinds = np.where(rng.random(shape) < setup.unknown_kinds, int(Kind.UNKNOWN), kind)
        cov = np.diag(np.square(sigma))
        return [
            CameraLines(float(one), offset[..., k], heading[..., k], kinds[..., k], cov)
            for k, one in enumerate(t)
        ]

    def _landmarks(self, way: Way, t: Array) -> list[SeenLandmarks]:
        """Return the landmarks ahead that are nearest, at each time."""
        found = []
        poses = way.at(t).pose if len(t) else np.empty((0, 3))
        setup, rng, n = self._setup, self._rng, self._n
        sigma, most, reach = setup.landmark_sigma, setup.most_landmarks, setup.landmark_range
        for time, pose in zip(t, poses, strict=True):
            _, places = self._layer.landmarks_near(pose[None, :2], reach)
            dx, dy = (places - pose[:2]).T
            distance, bearing = np.hypot(dx, dy), np.arctan2(dy, dx) - pose[2]
            bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
            ahead = np.flatnonzero(np.abs(bearing) <= setup.landmark_angle)
            ahead = ahead[np.argsort(distance[ahead])][:most]
            shape = (n, most)
            true = np.full((2, most), np.nan)
            true[:, : len(ahead)] = distance[ahead], bearing[ahead]
            is_false = rng.random(shape) < setup.false_landmarks
            r = np.where(is_false, rng.uniform(3, reach, shape), true[0])
            angle = np.where(is_false, rng.uniform(-1, 1, shape) * setup.landmark_angle, true[1])
            r[(rng.random(shape) < setup.missed_landmarks) & ~is_false] = np.nan
            noise = rng.standard_normal((2, *shape))
            r, angle = r + sigma[0] * noise[0], angle + sigma[1] * noise[1]
            found.append(seen_landmarks(float(time), r, angle, sigma))
        return found


def simulated_measurements(
    way: SimulatedDrive | RecordedDrive,
    layer: LocalisationLayer,
    setup: SensorSetup,
    rng: np.random.Generator,
    n: int = 1,
    span: tuple[float, float] | None = None,
) -> list[Arrival]:
    """Return the measurements of n cars on the same drive with independent errors, as they arrive.

    Args:
        way: true poses.
        layer: of the map on which the car drives, without errors.
        setup: of the sensors.
        rng: random numbers.
        n: number of cars.
        span: first and last time [s]; None for the whole drive.

    Raises:
        ValueError: a time of ``span`` is not in the drive.
    """
    start, end = span or (way.start, way.end)
    return SimulatedSensors(layer, setup, rng, n, start).measure(way, end)


class ErrorProcess:
    """Gauss-Markov process of errors at even times, stationary from the first one on.

    Args:
        process: the process.
        dt: time between two errors [s].
        shape: of the errors at one time.
        rng: random numbers.
    """

    def __init__(
        self, process: GaussMarkov, dt: float, shape: tuple[int, ...], rng: np.random.Generator
    ) -> None:
        self._process, self._dt, self._shape, self._rng = process, dt, shape, rng
        self._last: Array | None = None  # in units of sigma

    def next(self, k: int) -> Array:
        """Return the (*shape, k) errors at the next k times, 1 or more."""
        share = self._dt / self._process.time
        phi, white = math.exp(-share), math.sqrt(-math.expm1(-2 * share))
        found = self._rng.standard_normal((k, *self._shape))
        first = 1 if self._last is None else 0
        found[first:] *= white
        if self._last is not None:
            found[0] += phi * self._last
        for i in range(1, k):
            found[i] += phi * found[i - 1]
        self._last = found[-1].copy()
        return np.asarray(self._process.sigma * np.moveaxis(found, 0, -1))


class _Dropouts:
    """Outages of a camera at random times; times between and durations are exponential.

    Args:
        start: of the drive [s].
        between, duration: mean times [s].
    """

    def __init__(self, start: float, between: float, duration: float) -> None:
        self._between, self._duration = between, duration
        self._start, self._next = start, math.nan
        self._outages: list[tuple[float, float]] = []

    def hides(self, t: Array, rng: np.random.Generator) -> NDArray[np.bool_]:
        """Return (k,) whether there is an outage at times not earlier than before [s]."""
        if math.isnan(self._next):
            self._next = self._start + rng.exponential(self._between)
        while self._next < t[-1]:
            end = self._next + rng.exponential(self._duration)
            self._outages.append((self._next, end))
            self._next = end + rng.exponential(self._between)
        return ~_outside(t, self._outages)


def _outside(t: Array, outages: Sequence[tuple[float, float]]) -> NDArray[np.bool_]:
    """Return (k,) whether times are in none of the outages."""
    return np.array([not any(begin <= one < end for begin, end in outages) for one in t], bool)


def seen_landmarks(
    t: float, distance: Array, bearing: Array, sigma: tuple[float, float]
) -> SeenLandmarks:
    """Return landmarks from their ranges and bearings.

    Args:
        t: time [s].
        distance: (n, K) [m]; NaN for none.
        bearing: (n, K) positive to the left [rad].
        sigma: of the range [m] and of the bearing [rad].
    """
    c, s = np.cos(bearing), np.sin(bearing)
    along, across = sigma[0] ** 2, (sigma[1] * distance) ** 2
    xy, xx = (along - across) * c * s, along * c * c + across * s * s
    cov = np.stack([np.stack([xx, xy], -1), np.stack([xy, along * s * s + across * c * c], -1)], -2)
    return SeenLandmarks(t, np.stack([distance * c, distance * s], axis=-1), cov)
