"""False alarms and detection times of the plausibility check of map and camera lines.

The car sees both boundaries of a straight lane in 20 images a second. Residuals at 2 m and 20 m are
drawn from their definition: Gauss-Markov errors of the pose, of each line for itself and
of the camera, and the noise of the images. 2000 cars drive at once.

Three ways to state the camera noise and the pose time are compared; the fourth and the fifth are
for the rows of the errors that they are for:

    as modelled   white Gaussian noise, the pose error lasts for the stated time
    white camera  white Gaussian noise, the pose error lasts for any time up to 30 s
    default       noise that lasts for up to 1 s, with heavy tails; pose errors as before
    lasting       as modelled, but the noise lasts for up to 1 s
    tails         as modelled, but the noise has heavy tails

False alarms: an alarm is one event until it ends; the hours are those without one. The standard
error is that of a Poisson process, or from the variance of the cars if it is larger; z is the
number less the designed one in these. Where the errors are those of the model ("exact"), it is
bounded on both sides; where they are in the stated range ("covered"), from above. Rows of errors
that are outside of the stated range are there for comparison.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
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
#: Degrees of freedom of the heavy tails.
TAILS = 4.0


def model_of_lane(bend: float = 0.0) -> tuple[ResidualModel, Array]:
    """Return the model of the residuals of a lane, and their distances ahead [m].

    Args:
        bend: curvature of the lane [1/m].
    """
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
    model = cast(Any, residuals(scene, seen))[2]
    bias = model.H @ CameraBias().cov @ model.H.T
    return model._replace(slow_cov=model.slow_cov + bias), -model.H[:, 2]


class Noise(NamedTuple):
    """True noise of a camera."""

    time: float = 0.0  #: correlation time of what lasts [s]
    share: float = 0.0  #: of the variance that lasts
    heavy: bool = False  #: what is new in each image has Student's t-distribution

    def drawn(self, cars: int, roots: Array, rng: np.random.Generator) -> Iterator[Array]:
        """Yield the (cars, n) noise of one image after another, for an (n, n) root."""
        rho, n = math.exp(-DT / self.time) if self.time else 0.0, len(roots)
        lasting = rng.standard_normal((cars, n))
        while True:
            white = rng.standard_normal((cars, n))
            if self.heavy:  # the near and the far residual of a line have their outliers together
                scale = np.sqrt((TAILS - 2) / rng.chisquare(TAILS, (cars, n // 2)))
                white *= np.repeat(scale, 2, axis=1)
            if self.share == 1:  # an outlier lasts, too
                lasting = rho * lasting + math.sqrt(1 - rho**2) * white
                yield lasting @ roots.T
                continue
            if self.share:
                new = rng.standard_normal((cars, n))
                lasting = rho * lasting + math.sqrt(1 - rho**2) * new
            mixed = math.sqrt(self.share) * lasting + math.sqrt(1 - self.share) * white
            yield mixed @ roots.T


WHITE = Noise()


class Errors:
    """Random residuals of many cars without a fault, image by image.

    Args:
        model: of the residuals.
        time: correlation time of the pose error [s].
        cars: number of cars.
        rng: source of the random numbers.
        noise: of the camera.
        own: time for which what map lines have of their own lasts, if it is not that of the model;
            the bias of the camera lasts for this, or 30 s if that is longer [s].
    """

    def __init__(
        self,
        model: ResidualModel,
        time: float,
        cars: int,
        rng: np.random.Generator,
        noise: Noise = WHITE,
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
        self._noise = noise.drawn(cars, np.asarray(np.linalg.cholesky(model.noise_cov)), rng)
        self._rho = [math.exp(-DT / time) for time in times]
        self._states = [rng.standard_normal((cars, len(m))) for m in self._maps]

    def next(self) -> Array:
        """Return the (cars, n) residuals of the next image [m]."""
        z = next(self._noise).copy()
        for i, (rho, m) in enumerate(zip(self._rho, self._maps, strict=True)):
            state = self._states[i]
            state *= rho
            state += math.sqrt(1 - rho**2) * self._rng.standard_normal(state.shape)
            z += state @ m.T
        return z


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


# ---- false alarms and detection ----------------------------------------------------------------

TIMES = (1.0, 5.0, 30.0)  #: correlation times [s]
RATES = (1.0, 0.1)  #: designed false alarms [1/h]
DETECTION_RATE = 0.01  #: designed false alarms when faults are detected [1/h]
#: Time before alarms are counted, of drives that begin with errors at random [s].
WARM = 15.0
#: Correlation times for the robustness: of the pose error, and of map lines [s].
OWN_POSE_TIMES, OWN_TIMES = (1.0, 5.0), (1.0, 5.0, 30.0, 300.0)
#: Correlation times within which a fault begins.
APART = 3.0


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
    "white camera": Setting(WHITE_NOISE, SLOW),
    "default": Setting(CameraNoise(), SLOW),
    "lasting": Setting(CameraNoise(heavy_tails=False), 0.0),
    "tails": Setting(CameraNoise(0.0), 0.0),
}


class Row(NamedTuple):
    """Errors for which false alarms are counted."""

    noise: Noise = WHITE
    stated: float = 5.0  #: correlation time of the pose error [s]; infinite: unknown
    true: float = 5.0
    settings: tuple[str, ...] = (MODELLED, "default")
    covered: tuple[str, ...] = ("default",)  #: settings whose range contains these errors


LASTING, HEAVY = (MODELLED, "default", "lasting"), (MODELLED, "default", "tails")
ROWS = {
    "white Gaussian noise": Row(covered=("default", MODELLED)),
    "noise lasts 0.1 s": Row(Noise(0.1, 1.0), 5.0, 5.0, LASTING, LASTING[1:]),
    "noise lasts 0.3 s": Row(Noise(0.3, 1.0), 5.0, 5.0, LASTING, LASTING[1:]),
    "noise lasts 1 s": Row(Noise(1.0, 1.0), 5.0, 5.0, LASTING, LASTING[1:]),
    "noise of Student's t": Row(Noise(heavy=True), 5.0, 5.0, HEAVY, HEAVY[1:]),
    "half lasts 0.3 s, half Student's t": Row(Noise(0.3, 0.5, heavy=True)),
    "pose 2 s stated, 30 s true": Row(
        WHITE, 2.0, 30.0, (MODELLED, "default", "white camera"), ("default", "white camera")
    ),
    "pose unknown, 5 s true": Row(WHITE, math.inf, 5.0),
    "pose unknown, 300 s true": Row(WHITE, math.inf, 300.0),
    "pose 5 s stated, 3.5 s true": Row(WHITE, 5.0, 3.5, covered=()),
    "pose 30 s stated, 5 s true": Row(WHITE, 30.0, 5.0, covered=()),
    "noise lasts 3 s": Row(Noise(3.0, 1.0), covered=()),
    "outliers last 0.3 s": Row(Noise(0.3, 1.0, heavy=True), covered=()),
    "outliers last 1 s": Row(Noise(1.0, 1.0, heavy=True), covered=()),
}


class FalseAlarms(NamedTuple):
    """Number of false alarms in some hours."""

    hours: float  #: without an alarm
    number: int
    deviation: float  #: standard deviation of the number

    def result(self, rate: float) -> dict[str, Any]:
        """Return the figures for the designed rate [1/h]."""
        designed = rate * self.hours
        return {
            "hours without an alarm": self.hours,
            "alarms": self.number,
            "alarms per hour": self.number / self.hours,
            "standard error": self.deviation / self.hours,
            "z": (self.number - designed) / max(self.deviation, math.sqrt(designed)),
        }


@evidence
def model(
    hours: float = 300.0, times: tuple[float, ...] = TIMES, cars: int = 2000, seed: int = 0
) -> dict[str, Any]:
    """Count false alarms if the errors are those of the model, by correlation time [s]."""
    rng, (lane, _) = np.random.default_rng([seed, 0]), model_of_lane()
    result = {}
    for time in progress(times, "model"):
        tests = [(MODELLED, rate) for rate in RATES]
        errors = Errors(lane, time, cars, rng)
        counted = false_alarms(lane, errors, time, tests, hours, cars)
        for rate, one in zip(RATES, counted, strict=True):
            result[f"{time:g} s, {rate:g} per hour, exact"] = one.result(rate)
    return result


@evidence
def camera(
    hours: float = 300.0, rows: tuple[str, ...] = tuple(ROWS), cars: int = 2000, seed: int = 0
) -> dict[str, Any]:
    """Count false alarms for camera noise and pose errors, by setting and designed rate."""
    rng, (lane, _) = np.random.default_rng([seed, 1]), model_of_lane()
    result = {}
    for name in progress(rows, "camera"):
        row = ROWS[name]
        tests = [(of, rate) for of in row.settings for rate in RATES[: 1 + (of != MODELLED)]]
        errors = Errors(lane, row.true, cars, rng, row.noise)
        counted = false_alarms(lane, errors, row.stated, tests, hours, cars)
        for (of, rate), one in zip(tests, counted, strict=True):
            kind = "covered" if of in row.covered else "beyond"
            result[f"{name}; {of}, {rate:g} per hour, {kind}"] = one.result(rate)
    return result


@evidence
def own(
    hours: float = 300.0,
    times: tuple[float, ...] = OWN_POSE_TIMES,
    own_times: tuple[float, ...] = OWN_TIMES,
    cars: int = 2000,
    seed: int = 0,
) -> dict[str, Any]:
    """Count false alarms if what map lines have of their own lasts for one time."""
    rng, (lane, _) = np.random.default_rng([seed, 2]), model_of_lane()
    tests = [(name, 1.0) for name in (MODELLED, "default")]
    result = {}
    for time, of_line in progress([*product(times, own_times)], "own errors"):
        errors = Errors(lane, time, cars, rng, own=of_line)
        counted = false_alarms(lane, errors, time, tests, hours, cars)
        for (name, rate), one in zip(tests, counted, strict=True):
            result[f"pose {time:g} s, own {of_line:g} s, {name}"] = one.result(rate)
    return result


@evidence
def detection(
    cars: int = 500,
    times: tuple[float, ...] = TIMES,
    longest: float = 150.0,
    seed: int = 0,
) -> dict[str, Any]:
    """Measure times from a fault to its detection, by what is stated of the errors.

    A fault begins at a random time of a drive. Times are those to the first alarm, and infinite if
    there is none in so long, with 0.01 false alarms per hour as designed.

        shift      the map is shifted by 0.5 m to the side
        camera     the camera is turned by 1 deg at once
        drift      the camera turns by 1 deg in a minute
        lost       localisation is lost: dead reckoning with a yaw rate bias of 0.1 deg/s, at
                   15 m/s, while the stated covariance stays
        lane       the left line is that of the next lane, 3.5 m away
        start      as shift, before the first image
    """
    rng, (lane, x) = np.random.default_rng([seed, 3]), model_of_lane()
    names, result = (MODELLED, "white camera", "tails", "default"), dict[str, Any]()
    for time, (name, fault) in progress([*product(times, faults(x).items())], "detection"):
        errors = Errors(lane, time, cars, rng)
        start = 3 * time + rng.uniform(0, max(APART * time, 10.0), cars)
        start *= name != "start"
        images = int((start.max() + longest) / DT) + 1
        found = first_alarms(lane, errors, time, fault, start, names, images)
        result[f"{name}, correlation time {time:g} s"] = {
            way: {
                "median [s]": float(np.median(after)),
                "95 % [s]": float(np.quantile(after, 0.95, method="higher")),
            }
            for way, after in found.items()
        }
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
    names, result = (MODELLED, "default"), dict[str, Any]()
    for radius in progress(radii, "shifts"):
        rng = np.random.default_rng([seed, 4, round(min(radius, 1e6))])
        (lane, _), turn, row = model_of_lane(1 / radius), SPEED / radius * DT, dict[str, Any]()
        for size, begin in product(sizes, (0.0, 60.0)):

            def shifted(since: Array, size: float = size) -> Array:
                return np.asarray(size * (since >= 0.0)[:, None], dtype=float)

            errors, start = Errors(lane, 5.0, cars, rng), np.full(cars, begin)
            images = round((begin + longest) / DT)
            found = first_alarms(lane, errors, 5.0, shifted, start, names, images, turn)
            for name, after in found.items():
                of = f"{size:g} m, {'later' if begin else 'start'}, {name} [s]"
                row[of] = float(np.median(after))
        tests, errors = [(name, 1.0) for name in names], Errors(lane, 5.0, fleet, rng)
        counted = false_alarms(lane, errors, 5.0, tests, hours, fleet, turn)
        for (name, rate), one in zip(tests, counted, strict=True):
            row[f"false alarms, {name} [1/h]"] = one.result(rate)["alarms per hour"]
        result["straight" if math.isinf(radius) else f"bend of {radius:g} m"] = row
    return result


def false_alarms(
    model: ResidualModel,
    errors: Errors,
    stated: float,
    tests: Sequence[tuple[str, float]],
    hours: float,
    cars: int,
    turn: float = 0.0,
) -> list[FalseAlarms]:
    """Return the false alarms of cars that drive for some hours in all.

    Args:
        model: of the residuals.
        errors: of the cars.
        stated: correlation time of the pose error [s].
        tests: their settings, by name, and designed false alarms [1/h].
        hours: of all cars together.
        cars: that drive at once.
        turn: of the cars from image to image [rad].
    """
    ran = [(SETTINGS[name], SETTINGS[name].test(rate, cars)) for name, rate in tests]
    counts, calm = np.zeros((len(ran), cars)), np.zeros(len(ran))
    first = round(WARM / DT)
    for k in range(first + round(3600 * hours / cars / DT)):
        z = errors.next()
        for i, (setting, test) in enumerate(ran):
            verdict = test.step(z, model, DT, setting.times(stated), turn)
            if k >= first:
                counts[i] += verdict.raised
                calm[i] += int((~verdict.alarm | verdict.raised).sum())
    found = []
    for count, images in zip(counts, calm * DT / 3600, strict=True):
        variance = max(1.0, count.sum(), cars * count.var())
        found.append(FalseAlarms(float(images), int(count.sum()), math.sqrt(variance)))
    return found


def first_alarms(
    model: ResidualModel,
    errors: Errors,
    stated: float,
    fault: Callable[[Array], Array],
    start: Array,
    names: Sequence[str],
    images: int,
    turn: float = 0.0,
) -> Mapping[str, Array]:
    """Return the times of each car from the start of a fault to the first alarm, by setting [s].

    The image in which it begins counts.
    """
    tests = {
        name: (SETTINGS[name], SETTINGS[name].test(DETECTION_RATE, len(start))) for name in names
    }
    found = {name: np.full(len(start), np.inf) for name in names}
    for k in range(images):
        if all(np.isfinite(after).all() for after in found.values()):
            break
        since = k * DT - start
        z = errors.next() + fault(since)
        for name, (setting, test) in tests.items():
            alarm = test.step(z, model, DT, setting.times(stated), turn).alarm
            new = alarm & np.isinf(found[name]) & (since >= 0)
            found[name][new] = since[new] + DT
    return found
