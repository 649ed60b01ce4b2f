#!/usr/bin/env python3
"""Measure false alarms and detection times of the plausibility check of map and camera lines.

    evidence_plausibility.py                 1000 h for each correlation time and rate
    evidence_plausibility.py --hours 100     fewer

Run it in the environment of the project: python3 tools/run.py python tools/evidence_plausibility.py

The car sees both boundaries of a straight lane in 20 images a second. Residuals at 2 m and 20 m are
drawn from their definition: Gauss-Markov errors of the pose, of what each line has of its own and
of the camera, and white noise of the images. 1000 cars drive for an hour each, all at once.

False alarms: an alarm is one event until it ends; the hours are those without one. The number must
be within 3.3 standard deviations (1 of 1000) of the designed one. The standard deviation is that of
a Poisson process, or from the variance of the cars if it is larger.

Detection: a fault begins at a random time of a drive. Times are those to the first alarm, and
infinite if there is none in 150 s. Each way of testing has the same number of false alarms:
residuals that are 3 correlation times apart; single innovations; and windows of innovations of all
lengths, as the check has them. In the last case, the fault is there from the beginning.

    shift      the map is shifted by 0.5 m to the side
    camera     the camera is turned by 1 deg at once
    drift      the camera turns by 1 deg in a minute
    lost       localisation is lost: dead reckoning with a yaw rate bias of 0.1 deg/s, at 15 m/s,
               while the stated covariance stays
    lane       the left line is that of the next lane, 3.5 m away
    start      as shift, before the first image

Robustness: with pose errors of 1 s and of 5 s, what the map lines have of their own lasts for one
time; the bias of the camera, for this or 30 s if that is longer. There must not be more false
alarms than designed, in a tenth of the hours.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import product
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from reporting import bar, parser_of, report

from maplines_can import Gaussian, MapError, Polyline, Slot, map_scene
from maplines_can.consumers.consistency import (
    FAST,
    SLOW,
    ConsistencyTest,
    ResidualFilter,
    ResidualModel,
    threshold,
)
from maplines_can.consumers.plausibility import CameraBias, residuals

Array = NDArray[np.float64]

DT = 0.05  #: of the images [s]
TIMES = (1.0, 5.0, 30.0)  #: correlation times [s]
RATES = (1.0, 0.1)  #: designed false alarms [1/h]
DETECTION_RATE = 0.01  #: designed false alarms when faults are detected [1/h]
POSE_SIGMA = (0.3, 0.1, math.radians(0.2))
CAMERA_SIGMA = (0.05, 0.003, 2e-4, 2e-6)
SPEED = 15.0
#: Time that each car drives [s].
HOUR = 3600.0
#: Cars at a time.
CHUNK = 1000
#: Allowed deviation in standard deviations.
LIMIT = 3.3
#: Correlation times for the robustness: of the pose error, and of map lines [s].
OWN_POSE_TIMES, OWN_TIMES = (1.0, 5.0), (1.0, 5.0, 30.0, 300.0)
#: Longest time to a detection [s].
LONGEST = 150.0
#: Correlation times between the residuals that are tested alone.
APART = 3.0


def model_of_lane() -> tuple[ResidualModel, Array]:
    """Return the model of the residuals of a straight lane, and their distances ahead [m]."""
    lane = {
        slot: Polyline([[-50, y], [150, y]])
        for slot, y in ((Slot.EGO_LEFT, 1.75), (Slot.EGO_RIGHT, -1.75))
    }
    scene = map_scene(
        lane,
        Gaussian(np.zeros(3), np.diag(np.square(POSE_SIGMA))),
        map_error=MapError(point_sigma=0.05, offset_sigma=0.03, heading_sigma=0.0005),
    )
    noise = np.diag(np.square(CAMERA_SIGMA))
    seen = {line.slot: Gaussian(line.gaussian.mean, noise) for line in scene.lines}
    model = cast(Any, residuals(scene, seen))[2]
    bias = model.H @ CameraBias().cov @ model.H.T
    return model._replace(slow_cov=model.slow_cov + bias), -model.H[:, 2]


class Errors:
    """Random residuals of many cars without a fault, image by image.

    Args:
        covs: (n, n) covariances of the errors that last, in the residuals.
        times: their correlation times [s].
        noise_cov: (n, n) of the white noise.
        cars: number of cars.
        rng: source of the random numbers.
    """

    def __init__(
        self,
        covs: Sequence[Array],
        times: Sequence[float],
        noise_cov: Array,
        cars: int,
        rng: np.random.Generator,
    ) -> None:
        self._rng = rng
        self._maps = [np.linalg.cholesky(cov + 1e-12 * np.eye(len(cov))) for cov in covs]
        self._noise = np.linalg.cholesky(noise_cov)
        self._rho = [math.exp(-DT / time) for time in times]
        self._states = [rng.standard_normal((cars, len(m))) for m in self._maps]

    @classmethod
    def of_model(
        cls, model: ResidualModel, time: float, cars: int, rng: np.random.Generator
    ) -> Errors:
        """Return the errors of a model, for a correlation time of the pose error [s]."""
        pose = model.H @ model.pose_cov @ model.H.T
        covs = [pose, model.fast_cov, model.slow_cov]
        return cls(covs, [time, FAST, SLOW], model.noise_cov, cars, rng)

    def next(self) -> Array:
        """Return the (cars, n) residuals of the next image [m]."""
        z = self._rng.standard_normal((len(self._states[0]), len(self._noise))) @ self._noise.T
        for i, (rho, m) in enumerate(zip(self._rho, self._maps, strict=True)):
            state = self._states[i]
            state *= rho
            state += math.sqrt(1 - rho**2) * self._rng.standard_normal(state.shape)
            z += state @ m.T
        return z


def own_errors(
    model: ResidualModel, time: float, own: float, cars: int, rng: np.random.Generator
) -> Errors:
    """Return errors that last for a time [s]: of the pose, and those of a map line's own."""
    pose = model.H @ model.pose_cov @ model.H.T
    camera = model.slow_cov - model.fast_cov
    times = [time, own, max(own, SLOW)]
    return Errors([pose, model.fast_cov, camera], times, model.noise_cov, cars, rng)


def faults(x: Array) -> dict[str, Callable[[Array], Array]]:
    """Return the (..., n) shifts of the residuals at (...,) times after a fault begins [s]."""
    left = (np.arange(len(x)) < 2).astype(float)
    bias, degree = math.radians(0.1), math.radians(1.0)

    def begun(t: Array) -> Array:
        return np.asarray(t >= 0, float)[..., None]

    def since(t: Array) -> Array:
        return np.maximum(t, 0.0)[..., None]

    return {
        "shift": lambda t: 0.5 * begun(t) * np.ones(len(x)),
        "camera": lambda t: degree * begun(t) * x,
        "drift": lambda t: degree * (since(t) / 60).clip(max=1.0) * x,
        "lost": lambda t: -bias * (SPEED * since(t) ** 2 / 2 + since(t) * x),
        "lane": lambda t: 3.5 * begun(t) * left,
        "start": lambda t: 0.5 * begun(t) * np.ones(len(x)),
    }


class FalseAlarms(NamedTuple):
    """Number of false alarms in some hours."""

    hours: float  #: without an alarm
    number: int
    deviation: float  #: standard deviation of the number

    def result(self, rate: float) -> dict[str, Any]:
        """Return the figures for the designed rate [1/h]."""
        z = (self.number - rate * self.hours) / max(self.deviation, 1e-9)
        return {
            "designed per hour": rate,
            "hours without an alarm": self.hours,
            "alarms": self.number,
            "alarms per hour": self.number / self.hours,
            "standard error": self.deviation / self.hours,
            "z": z,
            "met": abs(z) <= LIMIT,
        }


def false_alarms(
    model: ResidualModel,
    time: float,
    rate: float,
    hours: int,
    rng: np.random.Generator,
    tick: Callable[[int], object],
    source: Callable[[int, np.random.Generator], Errors],
) -> FalseAlarms:
    """Return the false alarms of cars that drive for an hour each, after 3 correlation times."""
    counts, calm = [], 0
    for first in range(0, hours, CHUNK):
        cars = min(CHUNK, hours - first)
        errors = source(cars, rng)
        test = ConsistencyTest(rate, (cars,))
        count = np.zeros(cars)
        warm = round(3 * time / DT)
        for k in range(warm + round(HOUR / DT)):
            verdict = test.step(errors.next(), model, DT, time)
            if k >= warm:
                count += verdict.raised
                calm += int((~verdict.alarm | verdict.raised).sum())
            tick(cars)
        counts.append(count)
    all_counts = np.concatenate(counts)
    variance = max(rate * hours, hours * all_counts.var())
    return FalseAlarms(calm * DT / 3600, int(all_counts.sum()), math.sqrt(variance))


def detections(
    model: ResidualModel, x: Array, time: float, cars: int, rng: np.random.Generator
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield each fault with the times to its detection, by way of testing."""
    n = len(x)
    rate = DETECTION_RATE / 3600
    sampled = round(APART * time / DT)
    root = np.linalg.inv(np.linalg.cholesky(model.marginal))
    for name, fault in faults(x).items():
        errors = Errors.of_model(model, time, cars, rng)
        test = ConsistencyTest(DETECTION_RATE, (cars,))
        alone = ResidualFilter((cars,))
        start = 3 * time + rng.uniform(0, max(APART * time, 10.0), cars)
        start *= name != "start"
        found = {way: np.full(cars, np.inf) for way in ("samples", "single", "windows")}
        k = 0
        while k * DT <= start.max() + LONGEST and np.isinf(found["windows"]).any():
            since = k * DT - start
            z = errors.next() + fault(since)
            alone.predict(model, DT, time)
            w = alone.update(z, model.noise_cov)
            hits = {
                "single": (w**2).sum(axis=1) > threshold(rate * DT, n),
                "windows": test.step(z, model, DT, time).alarm,
            }
            if k % sampled == 0:
                hits["samples"] = ((z @ root.T) ** 2).sum(axis=1) > threshold(
                    rate * APART * time, n
                )
            for way, hit in hits.items():
                new = hit & np.isinf(found[way]) & (since >= 0)
                found[way][new] = since[new] + DT  # the image in which it begins counts
            k += 1
        yield (
            name,
            {
                way: {
                    "median [s]": round(float(np.median(times)), 2),
                    "95 % [s]": round(float(np.quantile(times, 0.95, method="higher")), 2),
                }
                for way, times in found.items()
            },
        )


def main(argv: list[str] | None = None) -> int:
    """Print the figures; return 0 if the false alarms are as designed, else 1."""
    parser = parser_of(__doc__)
    parser.add_argument("--hours", type=int, default=1000, help="for each rate (default: 1000)")
    parser.add_argument("--cars", type=int, default=500, help="with each fault (default: 500)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args(argv)
    return report(run(arguments), arguments.json, 24)


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the figures."""
    model, x = model_of_lane()
    rng = np.random.default_rng(arguments.seed)
    rows: dict[str, Any] = {}
    steps = sum(round((HOUR + 3 * time) / DT) for time in TIMES) * len(RATES)
    met = True
    with bar(steps * arguments.hours, "images", unit_scale=True) as shown:
        for time in TIMES:
            row: dict[str, Any] = {}
            for rate in RATES:
                source = partial(Errors.of_model, model, time)
                alarms = false_alarms(model, time, rate, arguments.hours, rng, shown.update, source)
                row[f"{rate:g} per hour"] = alarms.result(rate)
                met &= row[f"{rate:g} per hour"]["met"]
            rows[f"correlation time {time:g} s"] = row
        for time in TIMES:
            found = detections(model, x, time, arguments.cars, rng)
            rows[f"correlation time {time:g} s"]["detection"] = dict(found)
        other = {}
        for time, own in product(OWN_POSE_TIMES, OWN_TIMES):
            hours = max(1, arguments.hours // 10)
            drawn = partial(own_errors, model, time, own)
            alarms = false_alarms(model, time, 1.0, hours, rng, lambda _: None, drawn)
            name = f"pose errors of {time:g} s, own errors of {own:g} s"
            other[name] = figures = alarms.result(1.0)
            figures["met"] = figures["z"] <= LIMIT
            met &= figures["met"]
        rows["robustness"] = other
    return rows | {"met": bool(met)}


if __name__ == "__main__":
    sys.exit(main())
