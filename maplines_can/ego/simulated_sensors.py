"""Simulated sensors of a drive: GNSS, odometry, and a camera that sees lines and landmarks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..line import Kind
from .drive import SimulatedDrive, even_times
from .localisation import (
    CameraLines,
    GaussMarkov,
    GnssFix,
    LocalisationLayer,
    Odometry,
    SeenLandmarks,
    SensorErrors,
)
from .localisation.measurements import Measurement
from .recorded import RecordedDrive

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SensorSetup:
    """Sensors of a car.

    Rates are in Hz, latencies in s. An observation arrives after its latency.

    Args:
        errors: of the sensors, as far as they are correlated in time, and of the yaw rate.
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

    errors: SensorErrors = SensorErrors()
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

    def times(rate: float) -> Array:
        return even_times(start, end, rate)

    frames = times(setup.camera_rate)
    odometry = _odometry(way, setup, rng, n, times(setup.odometry_rate))
    gnss = _gnss(way, setup, rng, n, times(setup.gnss_rate))
    lines = _lines(way, layer, setup, rng, n, frames)
    seldom = frames[::5][_outside(frames[::5], setup.landmark_outages)]
    landmarks = _landmarks(way, layer, setup, rng, n, seldom)
    arrivals = [Arrival(one.t, one) for one in odometry]
    arrivals += [Arrival(one.t + setup.gnss_latency, one) for one in gnss]
    arrivals += [Arrival(one.t + setup.camera_latency, one) for one in lines]
    arrivals += [Arrival(one.t + setup.camera_latency, one) for one in landmarks]
    return sorted(arrivals, key=itemgetter(0))


def gauss_markov(
    process: GaussMarkov, times: Array, shape: tuple[int, ...], rng: np.random.Generator
) -> Array:
    """Return (*shape, k) errors at (k,) even times [s], stationary from the first one on."""
    found = rng.standard_normal((len(times), *shape))
    dt = times[1] - times[0] if len(times) > 1 else 0.0
    phi = math.exp(-dt / process.time)
    found[1:] *= math.sqrt(-math.expm1(-2 * dt / process.time))
    for i in range(1, len(times)):
        found[i] += phi * found[i - 1]
    return np.asarray(process.sigma * np.moveaxis(found, 0, -1))


def _odometry(
    way: SimulatedDrive | RecordedDrive,
    setup: SensorSetup,
    rng: np.random.Generator,
    n: int,
    t: Array,
) -> list[Odometry]:
    errors, state = setup.errors, way.at(t)
    slip = gauss_markov(errors.speed, t, (n,), rng)
    scale = gauss_markov(errors.wheel_scale, t, (n,), rng)
    bias = gauss_markov(errors.yaw_rate, t, (n,), rng)
    white = errors.yaw_rate_noise * math.sqrt(setup.odometry_rate) * rng.standard_normal(bias.shape)
    speed, rate = (state.speed + slip) / (1 + scale), state.yaw_rate + bias + white
    return [Odometry(float(one), v, w) for one, v, w in zip(t, speed.T, rate.T, strict=True)]


def _gnss(
    way: SimulatedDrive | RecordedDrive,
    setup: SensorSetup,
    rng: np.random.Generator,
    n: int,
    t: Array,
) -> list[GnssFix]:
    bias = gauss_markov(setup.errors.gnss, t, (n, 2), rng)
    white = setup.gnss_sigma * rng.standard_normal((n, 2, len(t)))
    position = way.at(t).pose[:, :2].T + bias + white
    cov = setup.gnss_sigma**2 * np.eye(2)
    seen = np.flatnonzero(_outside(t, setup.gnss_outages))
    return [GnssFix(float(t[k]), position[:, :, k], cov) for k in seen]


def _outside(t: Array, outages: Sequence[tuple[float, float]]) -> NDArray[np.bool_]:
    """Return (k,) whether times are in none of the outages."""
    return np.array([not any(begin <= one < end for begin, end in outages) for one in t], bool)


def _lines(
    way: SimulatedDrive | RecordedDrive,
    layer: LocalisationLayer,
    setup: SensorSetup,
    rng: np.random.Generator,
    n: int,
    t: Array,
) -> list[CameraLines]:
    """Return the nearest line on the left and on the right at each time."""
    beside = layer.lines_beside(way.at(t).pose)
    true, kind = np.full((2, 2, len(t)), np.nan), np.zeros((2, len(t)), dtype=np.intp)
    for side, sign in enumerate((1, -1)):
        rows = np.flatnonzero(sign * beside.offset > 0)
        rows = rows[np.lexsort((np.abs(beside.offset[rows]), beside.car[rows]))]
        rows = rows[np.append(True, np.diff(beside.car[rows]) > 0)[: len(rows)]]
        true[:, side, beside.car[rows]] = beside.offset[rows], beside.heading[rows]
        kind[side, beside.car[rows]] = beside.kind[rows]
    errors, sigma = setup.errors, setup.line_sigma
    shape = (n, 2, len(t))
    offset = true[0] + gauss_markov(errors.camera_offset, t, (n, 1), rng)
    heading = true[1] + gauss_markov(errors.camera_heading, t, (n, 1), rng)
    offset = offset + sigma[0] * rng.standard_normal(shape)
    heading = heading + sigma[1] * rng.standard_normal(shape)
    is_false = rng.random(shape) < setup.false_lines
    offset = np.where(is_false, offset + rng.uniform(-3, 3, shape), offset)
    out = _dropouts(setup.line_dropout, t, n, rng) | ~_outside(t, setup.line_outages)
    offset[out[:, None].repeat(2, axis=1)] = np.nan
    kinds = np.where(rng.random(shape) < setup.unknown_kinds, int(Kind.UNKNOWN), kind)
    cov = np.diag(np.square(sigma))
    return [
        CameraLines(float(one), offset[..., k], heading[..., k], kinds[..., k], cov)
        for k, one in enumerate(t)
    ]


def _dropouts(
    law: tuple[float, float], t: Array, n: int, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Return (n, k) whether there is an outage; times between and durations are exponential."""
    between, duration = law
    out = np.zeros((n, len(t)), dtype=bool)
    for row in out:
        at = t[0] + rng.exponential(between)
        while at < t[-1]:
            end = at + rng.exponential(duration)
            row |= (at <= t) & (t < end)
            at = end + rng.exponential(between)
    return out


def _landmarks(
    way: SimulatedDrive | RecordedDrive,
    layer: LocalisationLayer,
    setup: SensorSetup,
    rng: np.random.Generator,
    n: int,
    t: Array,
) -> list[SeenLandmarks]:
    """Return the landmarks ahead that are nearest, at each time."""
    found = []
    sigma, most, reach = setup.landmark_sigma, setup.most_landmarks, setup.landmark_range
    for time, pose in zip(t, way.at(t).pose, strict=True):
        _, places = layer.landmarks_near(pose[None, :2], reach)
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
