"""False alarms and detection times of the plausibility check of map and camera lines.

The car sees both boundaries of a straight lane in 20 images a second. Residuals at 2 m and 20 m are
drawn from their definition: Gauss-Markov errors of the pose, of each line for itself and
of the camera, and the noise of the images. 2000 cars drive at once.

Two ways to state the camera noise and the pose time are compared:

    as modelled   white Gaussian noise, the pose error lasts for the stated time
    default       noise that lasts for up to 1 s, with heavy tails; pose errors of up to 30 s

False alarms: an alarm is one event until it ends; the hours are those without one. The standard
error is that of a Poisson process, or from the variance of the cars if it is larger; z is the
number less the designed one in these. That they are as designed for errors of the model and in the
stated range, tests/consumers/test_consistency.py shows.
"""

from __future__ import annotations

import math
from itertools import product
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from maplines_can import Gaussian, MapError, Polyline, Slot, map_scene
from maplines_can.consumers.plausibility import CameraBias, pose_times, residuals
from maplines_can.consumers.residual_filter import (
    FAST,
    SLOW,
    WHITE_NOISE,
    CameraNoise,
    ResidualModel,
)
from maplines_can.consumers.residual_test import ConsistencyTest

from .harness import evidence, progress

Array = NDArray[np.float64]

DT = 0.05  #: of the images [s]
POSE_SIGMA = (0.3, 0.1, math.radians(0.2))
CAMERA_SIGMA = (0.05, 0.003, 2e-4, 2e-6)
SPEED = 15.0


def model_of_lane(bend: float = 0.0) -> ResidualModel:
    """Return the model of the residuals of a lane with a curvature [1/m]."""
    s = np.linspace(-50.0, 120.0, 341) if bend else np.array([-50.0, 150.0])
    # sin(bend s) / bend and (1 - cos(bend s)) / bend
    x, y = s * np.sinc(bend * s / np.pi), bend * s**2 / 2 * np.sinc(bend * s / 2 / np.pi) ** 2
    lane = {
        slot: Polyline(np.column_stack([x - left * np.sin(bend * s), y + left * np.cos(bend * s)]))
        for slot, left in ((Slot.EGO_LEFT, 1.75), (Slot.EGO_RIGHT, -1.75))
    }
    scene = map_scene(
        lane,
        Gaussian(np.zeros(3), np.diag(np.square(POSE_SIGMA))),
        map_error=MapError(point_sigma=0.05, offset_sigma=0.03, heading_sigma=0.0005),
    )
    noise = np.diag(np.square(CAMERA_SIGMA))
    seen = {line.slot: Gaussian(line.gaussian.mean, noise) for line in scene.lines}
    model: ResidualModel = cast(Any, residuals(scene, seen))[2]
    bias = model.H @ CameraBias().cov @ model.H.T
    return model._replace(slow_cov=model.slow_cov + bias)


class Errors:
    """Random residuals of many cars without a fault, image by image.

    Args:
        model: of the residuals.
        time: correlation time of the pose error [s].
        cars: number of cars.
        rng: source of the random numbers.
        own: time for which what map lines have of their own lasts, if it is not that of the model;
            the bias of the camera lasts for this, or 30 s if that is longer [s].
    """

    def __init__(
        self,
        model: ResidualModel,
        time: float,
        cars: int,
        rng: np.random.Generator,
        own: float | None = None,
    ) -> None:
        pose = model.H @ model.pose_cov @ model.H.T
        if own is None:
            covs, times = [pose, model.fast_cov, model.slow_cov], [time, FAST, SLOW]
        else:
            camera = model.slow_cov - model.fast_cov
            covs, times = [pose, model.fast_cov, camera], [time, own, max(own, SLOW)]
        self._rng = rng
        self._maps = [np.linalg.cholesky(cov + 1e-12 * np.eye(len(cov))) for cov in covs]
        self._root, self._cars = np.linalg.cholesky(model.noise_cov), cars
        self._rho = [math.exp(-DT / time) for time in times]
        self._states = [rng.standard_normal((cars, len(m))) for m in self._maps]
        rng.standard_normal((cars, len(self._root)))  # so that the figures stay those of before

    def next(self) -> Array:
        """Return the (cars, n) residuals of the next image [m]."""
        z = self._rng.standard_normal((self._cars, len(self._root))) @ self._root.T
        for i, (rho, m) in enumerate(zip(self._rho, self._maps, strict=True)):
            state = self._states[i]
            state *= rho
            state += math.sqrt(1 - rho**2) * self._rng.standard_normal(state.shape)
            z += state @ m.T
        return z


# ---- false alarms and detection ----------------------------------------------------------------

RATES = (1.0, 0.1)  #: designed false alarms [1/h]
DETECTION_RATE = 0.01  #: designed false alarms when faults are detected [1/h]
#: Time before alarms are counted, of drives that begin with errors at random [s].
WARM = 15.0
#: Correlation times for the robustness: of the pose error, and of map lines [s].
OWN_POSE_TIMES, OWN_TIMES = (1.0, 5.0), (1.0, 5.0, 30.0, 300.0)


class Setting(NamedTuple):
    """What a consumer states of the errors."""

    noise: CameraNoise
    longest_pose_time: float  #: [s]

    def test(self, rate: float, cars: int) -> ConsistencyTest:
        """Return the test of some cars, with designed false alarms [1/h]."""
        return ConsistencyTest(rate, (cars,), self.noise)

    def times(self, stated: float) -> tuple[float, float]:
        """Return the shortest and the longest time of the pose error [s]."""
        return pose_times(stated, self.longest_pose_time)


MODELLED = "as modelled"
SETTINGS = {
    MODELLED: Setting(WHITE_NOISE, 0.0),
    "default": Setting(CameraNoise(), SLOW),
}


@evidence
def own(
    hours: float = 300.0,
    times: tuple[float, ...] = OWN_POSE_TIMES,
    own_times: tuple[float, ...] = OWN_TIMES,
    cars: int = 2000,
    seed: int = 0,
) -> dict[str, Any]:
    """Count false alarms if what map lines have of their own lasts for one time."""
    rng, lane, result = np.random.default_rng([seed, 2]), model_of_lane(), {}
    for time, of_line in progress([*product(times, own_times)], "own errors"):
        errors = Errors(lane, time, cars, rng, own=of_line)
        for name, one in false_alarms(lane, errors, time, hours, cars).items():
            result[f"pose {time:g} s, own {of_line:g} s, {name}"] = one
    return result


@evidence
def shifts(
    cars: int = 200,
    longest: float = 150.0,
    hours: float = 100.0,
    radii: tuple[float, ...] = (math.inf, 500.0, 150.0, 50.0),
    sizes: tuple[float, ...] = (0.3, 0.5, 1.0),
    fleet: int = 2000,
    seed: int = 0,
) -> dict[str, Any]:
    """Measure times until a shift of the map to the side is found, on straight roads and in bends.

    As modelled and by default, with a pose error of 5 s: the shift is there from the first image on
    (start), or begins after 60 s (later). Times are medians, infinite for more than half of the
    cars. False alarms are those without a shift, at 1 per hour as designed.

    Args:
        cars: number of cars.
        longest: time from the fault to the end of a drive [s].
        hours: for the false alarms.
        radii: of the bends [m].
        sizes: of the shifts [m].
        fleet: cars that drive at once for the false alarms.
        seed: of the random numbers.
    """
    result: dict[str, Any] = {}
    for radius in progress(radii, "shifts"):
        rng = np.random.default_rng([seed, 4, round(min(radius, 1e6))])
        lane, turn, row = model_of_lane(1 / radius), SPEED / radius * DT, dict[str, Any]()
        for size, begin in product(sizes, (0.0, 60.0)):
            errors = Errors(lane, 5.0, cars, rng)
            found = first_alarms(lane, errors, size, begin, begin + longest, cars, turn)
            for name, after in found.items():
                of = f"{size:g} m, {'later' if begin else 'start'}, {name} [s]"
                row[of] = float(np.median(after))
        errors = Errors(lane, 5.0, fleet, rng)
        for name, one in false_alarms(lane, errors, 5.0, hours, fleet, turn).items():
            row[f"false alarms, {name} [1/h]"] = one["alarms per hour"]
        result["straight" if math.isinf(radius) else f"bend of {radius:g} m"] = row
    return result


def first_alarms(
    model: ResidualModel,
    errors: Errors,
    size: float,
    begin: float,
    end: float,
    cars: int,
    turn: float,
) -> dict[str, Array]:
    """Return the times from a shift of a size [m] to the first alarm of each car, by setting [s].

    It begins at a time; the image in which it does counts.
    """
    tests = {name: (one, one.test(DETECTION_RATE, cars)) for name, one in SETTINGS.items()}
    found = {name: np.full(cars, np.inf) for name in tests}
    for k in range(round(end / DT)):
        if all(np.isfinite(after).all() for after in found.values()):
            break
        since = k * DT - begin
        z = errors.next() + size * (since >= 0)
        for name, (setting, test) in tests.items():
            alarm = test.step(z, model, DT, setting.times(5.0), turn).alarm
            if since >= 0:
                found[name][alarm & np.isinf(found[name])] = since + DT
    return found


def false_alarms(
    model: ResidualModel,
    errors: Errors,
    stated: float,
    hours: float,
    cars: int,
    turn: float = 0.0,
) -> dict[str, dict[str, float]]:
    """Return the false alarms of cars that drive for some hours in all, by setting.

    Args:
        model: of the residuals.
        errors: of the cars.
        stated: correlation time of the pose error [s].
        hours: of all cars together.
        cars: that drive at once.
        turn: of the cars from image to image [rad].
    """
    tests = {name: (one, one.test(1.0, cars)) for name, one in SETTINGS.items()}
    counts, calm = {name: np.zeros(cars) for name in tests}, dict.fromkeys(tests, 0)
    first = round(WARM / DT)
    for k in range(first + round(3600 * hours / cars / DT)):
        z = errors.next()
        for name, (setting, test) in tests.items():
            verdict = test.step(z, model, DT, setting.times(stated), turn)
            if k >= first:
                counts[name] += verdict.raised
                calm[name] += int((~verdict.alarm | verdict.raised).sum())
    return {
        name: alarms_of(counts[name].sum(), cars * counts[name].var(), calm[name] * DT / 3600)
        for name in tests
    }


def alarms_of(number: float, variance: float, hours: float) -> dict[str, float]:
    """Return the figures of a number of alarms in some hours without one, at 1 per hour."""
    deviation = math.sqrt(max(1.0, number, variance))
    return {
        "hours without an alarm": hours,
        "alarms": int(number),
        "alarms per hour": number / hours,
        "standard error": deviation / hours,
        "z": (number - hours) / max(deviation, math.sqrt(hours)),
    }
