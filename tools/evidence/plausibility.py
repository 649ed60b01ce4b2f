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
from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from maplines_can.consumers.consistency import ConsistencyTest
from maplines_can.consumers.plausibility import pose_times
from maplines_can.consumers.residual_filter import (
    SLOW,
    WHITE_NOISE,
    CameraNoise,
    ResidualFilter,
    ResidualModel,
    threshold,
)

from .harness import evidence, progress
from .plausibility_errors import (
    DT,
    SPEED,
    WHITE,
    Array,
    Errors,
    Noise,
    faults,
    model_of_lane,
    own_errors,
)

TIMES = (1.0, 5.0, 30.0)  #: correlation times [s]
RATES = (1.0, 0.1)  #: designed false alarms [1/h]
DETECTION_RATE = 0.01  #: designed false alarms when faults are detected [1/h]
#: Cars that drive at once.
CARS = 2000
#: Time before alarms are counted, of drives that begin with errors at random [s].
WARM = 15.0
#: Correlation times for the robustness: of the pose error, and of map lines [s].
OWN_POSE_TIMES, OWN_TIMES = (1.0, 5.0), (1.0, 5.0, 30.0, 300.0)
#: Correlation times between the residuals that are tested alone.
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


@evidence(hours=10.0, times=(5.0,))
def model(hours: float = 300.0, times: tuple[float, ...] = TIMES, seed: int = 0) -> dict[str, Any]:
    """Count false alarms if the errors are those of the model, by correlation time [s]."""
    rng, (lane, _) = np.random.default_rng([seed, 0]), model_of_lane()
    result = {}
    for time in progress(times, "model"):
        tests = [(MODELLED, rate) for rate in RATES]
        errors = Errors.of_model(lane, time, CARS, rng)
        counted = false_alarms(lane, errors, time, tests, hours)
        for rate, one in zip(RATES, counted, strict=True):
            result[f"{time:g} s, {rate:g} per hour, exact"] = one.result(rate)
    return result


@evidence(hours=5.0, rows=("white Gaussian noise", "noise of Student's t"))
def camera(
    hours: float = 300.0, rows: tuple[str, ...] = tuple(ROWS), seed: int = 0
) -> dict[str, Any]:
    """Count false alarms for camera noise and pose errors, by setting and designed rate."""
    rng, (lane, _) = np.random.default_rng([seed, 1]), model_of_lane()
    result = {}
    for name in progress(rows, "camera"):
        row = ROWS[name]
        tests = [(of, rate) for of in row.settings for rate in RATES[: 1 + (of != MODELLED)]]
        errors = Errors.of_model(lane, row.true, CARS, rng, row.noise)
        counted = false_alarms(lane, errors, row.stated, tests, hours)
        for (of, rate), one in zip(tests, counted, strict=True):
            kind = "covered" if of in row.covered else "beyond"
            result[f"{name}; {of}, {rate:g} per hour, {kind}"] = one.result(rate)
    return result


@evidence(hours=3.0, times=(1.0,), own_times=(30.0,))
def own(
    hours: float = 300.0,
    times: tuple[float, ...] = OWN_POSE_TIMES,
    own_times: tuple[float, ...] = OWN_TIMES,
    seed: int = 0,
) -> dict[str, Any]:
    """Count false alarms if what map lines have of their own lasts for one time.

    The bias of the camera lasts for this, or 30 s if that is longer.
    """
    rng, (lane, _) = np.random.default_rng([seed, 2]), model_of_lane()
    tests = [(name, 1.0) for name in (MODELLED, "default")]
    result = {}
    for time, of_line in progress([*product(times, own_times)], "own errors"):
        errors = own_errors(lane, time, of_line, CARS, rng)
        counted = false_alarms(lane, errors, time, tests, hours)
        for (name, rate), one in zip(tests, counted, strict=True):
            result[f"pose {time:g} s, own {of_line:g} s, {name}"] = one.result(rate)
    return result


@evidence(cars=20, times=(1.0,), longest=2.0)
def detection(
    cars: int = 500,
    times: tuple[float, ...] = TIMES,
    longest: float = 150.0,
    seed: int = 0,
) -> dict[str, Any]:
    """Measure times from a fault to its detection, by way of testing.

    A fault begins at a random time of a drive. Times are those to the first alarm, and infinite if
    there is none in so long. Each way of testing has the same number of false alarms: residuals
    that are 3 correlation times apart (samples); single innovations; and windows of innovations of
    all lengths, as the check has them, as modelled, with the white camera, with heavy tails, by
    default. In the last case, the fault is there from the beginning.

        shift      the map is shifted by 0.5 m to the side
        camera     the camera is turned by 1 deg at once
        drift      the camera turns by 1 deg in a minute
        lost       localisation is lost: dead reckoning with a yaw rate bias of 0.1 deg/s, at
                   15 m/s, while the stated covariance stays
        lane       the left line is that of the next lane, 3.5 m away
        start      as shift, before the first image
    """
    rng, (lane, x) = np.random.default_rng([seed, 3]), model_of_lane()
    return {
        f"{name}, correlation time {time:g} s": found
        for time in progress(times, "detection")
        for name, found in detections(lane, x, time, cars, longest, rng)
    }


@evidence(cars=20, longest=2.0, hours=1.0, radii=(150.0,), sizes=(1.0,))
def shifts(
    cars: int = 200,
    longest: float = 150.0,
    hours: float = 100.0,
    radii: tuple[float, ...] = (math.inf, 500.0, 150.0, 50.0),
    sizes: tuple[float, ...] = (0.3, 0.5, 1.0),
    seed: int = 0,
) -> dict[str, Any]:
    """Measure times until a shift of the map to the side is found, on straight roads and in bends.

    As modelled and by default, with a pose error of 5 s: the shift is there from the first image on
    (start), or begins after 60 s (later). Times are medians, infinite for more than half of the
    cars; those of cars with an alarm before do not count. False alarms are those without a shift,
    at 1 per hour as designed.

    Args:
        cars: number of cars.
        longest: time from the fault to the end of a drive [s].
        hours: for the false alarms.
        radii: of the bends [m].
        sizes: of the shifts [m].
        seed: of the random numbers.
    """
    result: dict[str, Any] = {}
    for radius in progress(radii, "shifts"):
        rng = np.random.default_rng([seed, 4, round(min(radius, 1e6))])
        lane, _ = model_of_lane(1 / radius)
        turn = SPEED / radius * DT
        row: dict[str, Any] = {}
        for size, begin in product(sizes, (0.0, 60.0)):
            errors = Errors.of_model(lane, 5.0, cars, rng)
            tests = {
                name: SETTINGS[name].test(DETECTION_RATE, cars) for name in (MODELLED, "default")
            }
            found = {name: np.full(cars, np.inf) for name in tests}
            for k in range(round((begin + longest) / DT)):
                since = k * DT - begin
                z = errors.next() + size * (since >= 0)
                for name, test in tests.items():
                    alarm = test.step(z, lane, DT, SETTINGS[name].times(5.0), turn).alarm
                    found[name][alarm & np.isinf(found[name])] = since + DT
                if all(np.isfinite(times).all() for times in found.values()):
                    break
            for name, times in found.items():
                of = f"{size:g} m, {'later' if begin else 'start'}, {name} [s]"
                row[of] = float(np.median(times[times > 0]))
        errors = Errors.of_model(lane, 5.0, CARS, rng)
        tested = [(name, 1.0) for name in (MODELLED, "default")]
        counted = false_alarms(lane, errors, 5.0, tested, hours, turn)
        for (name, rate), one in zip(tested, counted, strict=True):
            row[f"false alarms, {name} [1/h]"] = one.result(rate)["alarms per hour"]
        result["straight" if math.isinf(radius) else f"bend of {radius:g} m"] = row
    return result


def false_alarms(
    model: ResidualModel,
    errors: Errors,
    stated: float,
    tests: Sequence[tuple[str, float]],
    hours: float,
    turn: float = 0.0,
) -> list[FalseAlarms]:
    """Return the false alarms of cars that drive for some hours in all.

    Args:
        model: of the residuals.
        errors: of ``CARS`` cars.
        stated: correlation time of the pose error [s].
        tests: their settings, by name, and designed false alarms [1/h].
        hours: of all cars together.
        turn: of the cars from image to image [rad].
    """
    ran = [(SETTINGS[name], SETTINGS[name].test(rate, CARS)) for name, rate in tests]
    counts, calm = np.zeros((len(ran), CARS)), np.zeros(len(ran))
    first = round(WARM / DT)
    for k in range(first + round(3600 * hours / CARS / DT)):
        z = errors.next()
        for i, (setting, test) in enumerate(ran):
            verdict = test.step(z, model, DT, setting.times(stated), turn)
            if k >= first:
                counts[i] += verdict.raised
                calm[i] += int((~verdict.alarm | verdict.raised).sum())
    found = []
    for count, images in zip(counts, calm * DT / 3600, strict=True):
        variance = max(1.0, count.sum(), CARS * count.var())
        found.append(FalseAlarms(float(images), int(count.sum()), math.sqrt(variance)))
    return found


def detections(
    model: ResidualModel,
    x: Array,
    time: float,
    cars: int,
    longest: float,
    rng: np.random.Generator,
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield each fault with the times to its detection, by way of testing."""
    n = len(x)
    rate = DETECTION_RATE / 3600
    sampled = round(APART * time / DT)
    root = np.linalg.inv(np.linalg.cholesky(model.marginal))
    for name, fault in faults(x).items():
        errors = Errors.of_model(model, time, cars, rng)
        ways = {"windows": MODELLED} | {name: name for name in ("white camera", "tails", "default")}
        tests = {
            way: (SETTINGS[setting], SETTINGS[setting].test(DETECTION_RATE, cars))
            for way, setting in ways.items()
        }
        alone = ResidualFilter((cars,))
        start = 3 * time + rng.uniform(0, max(APART * time, 10.0), cars)
        start *= name != "start"
        found = {way: np.full(cars, np.inf) for way in ("samples", "single", *ways)}
        k = 0
        while k * DT <= start.max() + longest and any(np.isinf(found[way]).any() for way in ways):
            since = k * DT - start
            z = errors.next() + fault(since)
            alone.predict(model, DT, time)
            w, _ = alone.update(z, model)
            hits = {"single": (w**2).sum(axis=1) > threshold(rate * DT, n)}
            for way, (setting, test) in tests.items():
                hits[way] = test.step(z, model, DT, setting.times(time)).alarm
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
                    "median [s]": float(np.median(times)),
                    "95 % [s]": float(np.quantile(times, 0.95, method="higher")),
                }
                for way, times in found.items()
            },
        )
