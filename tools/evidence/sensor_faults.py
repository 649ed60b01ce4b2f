"""How long the localisation is wrong unnoticed if a sensor has a fault.

A car for each seed, with errors of its own, drives through the town. After 30 s a sensor has a
fault for one sample, 1, 5 or 30 s; then it is right again. Cars with a map have GNSS, odometry,
lines and landmarks; cars without one have GNSS and odometry; cars with a lidar have odometry, GNSS,
and a pose twice a second (``PoseFix``); on the straight road, which is not in the town, they have
GNSS and odometry. Pose and covariance are evaluated ten times a second.

A pose is wrong unnoticed if the filter states it, and its error along, across or of the heading is
more than 5 times the stated standard deviation.
"""

from __future__ import annotations

import copy
import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from maplines_can import Polyline
from maplines_can.localisation import (
    CameraLines,
    Localisation,
    LocalisationLayer,
    PoseFix,
    SeenLandmarks,
)
from maplines_can.maps import Map
from maplines_can.simulation.sensors import Arrival, SensorSetup, simulated_measurements
from maplines_can.simulation.simulated_localisation import START_SIGMA
from maplines_can.simulation.trajectory import SimulatedDrive
from maplines_can.testing.sensor_faults import FAULTS, SensorFault, injected

from .figures import longest
from .harness import evidence, progress
from .localisation import town

Array = NDArray[np.float64]

#: Part of the tour [s], and the begin of the fault after its start [s].
START, WARM_UP = 20.0, 30.0
#: Durations of the faults [s]; 0 is a single measurement.
DURATIONS = (0.0, 1.0, 5.0, 30.0)
#: Time after a fault within which the pose must be known again [s].
AFTER = 80.0
#: Time after a fault for which all poses must have been known to end a course sooner [s].
SETTLED = 10.0
#: Time between two evaluations [s].
STEP = 0.1
#: Stated standard deviations beyond which an error counts as wrong.
BEYOND = 5.0
#: What a car has for the faults of each sensor.
CARS = {
    "odometry": ("map", "no map"),
    "gnss": ("map", "no map", "straight road"),
    "lines": ("map",),
    "landmarks": ("map",),
    "pose": ("lidar",),
}
#: Sensors at less than their usual rates, as 200 courses would take long.
SETUP = SensorSetup(odometry_rate=20.0, camera_rate=5.0)
#: White noise of the poses of a lidar [m, m, rad], and their rate [Hz].
LIDAR, LIDAR_RATE = (0.05, 0.05, math.radians(0.2)), 2.0


class Course(NamedTuple):
    """What happened to n cars from the begin of a fault on, at k times."""

    t: Array  #: (k,) since its begin [s]
    known: NDArray[np.bool_]  #: (k, n)
    errors: Array  #: (k, n, 3) along [m], across [m], heading [rad]
    sigmas: Array  #: (k, n, 3) stated

    @property
    def wrong(self) -> NDArray[np.bool_]:
        """(k, n, 3) whether a pose is stated, but is wrong along, across, or in the heading."""
        return self.known[..., None] & (np.abs(self.errors) > BEYOND * self.sigmas)


class Drive:
    """Cars that drive through the town up to a fault."""

    def __init__(
        self,
        way: SimulatedDrive,
        layer: LocalisationLayer,
        cars: str,
        seeds: int,
    ) -> None:
        self.way, self._layer = way, layer
        self.begin, rng = START + WARM_UP, np.random.default_rng([seeds, len(cars)])
        span = START, self.begin + max(DURATIONS) + AFTER
        arrivals = simulated_measurements(way, layer, SETUP, rng, seeds, span)
        if cars != "map":
            camera = CameraLines | SeenLandmarks
            arrivals = [one for one in arrivals if not isinstance(one.measurement, camera)]
        if cars == "lidar":
            arrivals = sorted([*arrivals, *poses_of(way, rng, seeds, span)], key=lambda one: one.t)
        self._arrivals = arrivals
        sigma = np.array(START_SIGMA)
        start = way.at(START).pose + sigma * rng.standard_normal((seeds, 3))
        known, cov = layer if cars == "map" else None, np.diag(sigma**2)
        self._ready = Localisation(start, START, SETUP.errors, known, cov=cov)
        self._first = 0
        while arrivals[self._first].measurement.t < self.begin - 2.0:
            self._ready.add(arrivals[self._first].measurement)
            self._first += 1

    def run(self, fault: SensorFault, duration: float) -> Course:
        """Return the course of a fault of a duration [s]."""
        localisation = copy.deepcopy(self._ready, {id(self._layer): self._layer})
        end = self.begin + duration
        arrivals = injected(self._arrivals[self._first :], fault, self.begin, end)
        rows, due, since = [], self.begin, end
        for t, measurement in arrivals:
            while t > due:
                rows.append(self._row(localisation, due))
                if not rows[-1][0].all():
                    since = max(end, due)
                due += STEP
            if t > min(end + AFTER, since + SETTLED):
                break
            localisation.add(measurement)
        known, errors, sigmas = (np.array(column) for column in zip(*rows, strict=True))
        return Course(STEP * np.arange(len(rows), dtype=float), known, errors, sigmas)

    def _row(self, localisation: Localisation, t: float) -> tuple[Any, Array, Array]:
        true = self.way.at(t).pose
        # Beyond the time of a caller only if the stamps of the odometry are.
        mean, cov, known = localisation.poses(max(t, localisation.t))
        c, s = math.cos(true[2]), math.sin(true[2])
        T = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        errors = (mean - true) @ T.T
        errors[:, 2] = (errors[:, 2] + math.pi) % (2 * math.pi) - math.pi
        return known, errors, np.sqrt(np.diagonal(T @ cov @ T.T, axis1=-2, axis2=-1))


def poses_of(
    way: SimulatedDrive, rng: np.random.Generator, n: int, span: tuple[float, float]
) -> list[Arrival]:
    """Return the poses of a lidar."""
    times = np.arange(*span, 1 / LIDAR_RATE)
    noise = np.array(LIDAR) * rng.standard_normal((len(times), n, 3))
    cov = np.diag(np.square(LIDAR))
    return [
        Arrival(float(t) + 0.1, PoseFix(float(t), way.at(t).pose + e, cov))
        for t, e in zip(times, noise, strict=True)
    ]


def drive_of(cars: str, seeds: int) -> Drive:
    """Return the drive of cars with what ``CARS`` says, through the town or on a straight road."""
    if cars == "straight road":
        way = SimulatedDrive(Polyline([[0.0, 0.0], [4000.0, 0.0]]))
        return Drive(way, LocalisationLayer(Map({}, {})), "no map", seeds)
    found, way = town()
    return Drive(way, LocalisationLayer(found), cars, seeds)


@evidence
def faults(
    seeds: int = 8,
    sensors: tuple[str, ...] = tuple(CARS),
    faults: tuple[str, ...] = ("",),
    cars: tuple[str, ...] = ("map", "no map", "lidar", "straight road"),
    seconds: tuple[float, ...] = DURATIONS,
) -> dict[str, Any]:
    """Inject faults into each sensor, and measure how long the pose is wrong unnoticed.

        beyond     longest time for which a pose is wrong unnoticed [s], of all seeds; its position
        error      largest error of the position while a pose is stated [m]
        said       median time from the begin of the fault until no pose is stated [s]
        without    median time without a pose [s]

    Args:
        seeds: number of cars.
        sensors: with a fault.
        faults: parts of their names.
        cars: what they have.
        seconds: durations of the faults [s]; 0 is a single measurement.
    """
    drive, result = cache(drive_of), dict[str, Any]()
    chosen = [
        (fault, has, duration)
        for fault in FAULTS
        for has in CARS[fault.sensor]
        for duration in seconds
        if fault.sensor in sensors and has in cars and any(name in fault.name for name in faults)
    ]
    for fault, has, duration in progress(chosen, "faults"):
        name = f"{fault.sensor}, {fault.name}; {has}; {duration:g} s"
        result[name] = figures(drive(has, seeds).run(fault, duration))
    return result


def figures(course: Course) -> dict[str, Any]:
    """Return the figures of a course."""
    lost, wrong = ~course.known, course.wrong
    first = np.where(lost.any(axis=0), lost.argmax(axis=0) * STEP, math.nan)
    beyond = STEP * longest(wrong.any(axis=-1))
    size = np.hypot(course.errors[..., 0], course.errors[..., 1])
    return {
        "beyond [s]": round(float(beyond.max()), 3),
        "position beyond [s]": round(STEP * float(longest(wrong[..., :2].any(axis=-1)).max()), 3),
        "error [m]": float(np.where(course.known, size, 0.0).max()),
        "said after [s]": float(np.nanmedian(first)) if lost.any() else None,
        "cars beyond for 10 s": int((beyond > 10.0).sum()),
        "cars without a pose": int(lost.any(axis=0).sum()),
        "without a pose [s]": float(np.median(STEP * lost.sum(axis=0))),
        "known at the end": float(course.known[-1].mean()),
        "right at the end": float((~wrong[-1].any(axis=-1) & course.known[-1]).mean()),
    }
