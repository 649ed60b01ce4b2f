"""How well the localisation finds out by itself how large the error of GNSS is.

Each car drives for 240 s on a way of its own, through city blocks with a stop or along an open
road, with GNSS and odometry only. In a canyon, the error of GNSS is a Gauss-Markov process whose
standard deviation (1 to 30 m) and correlation time (5 to 60 s) are drawn for each car, uniform in
their logarithms; on an open road they are 1.5 m and 60 s. In a transition, the car is on an open
road for 80 s, in a canyon for 80 s, and on an open road again, where its error is another one at
once. Beside that, an outlier is 200 m off, a gap is without fixes for 30 s, a jump is 100 m for
10 s, and a ramp grows by 1 m/s for 30 s, all in random directions.

With reflections, a fix is the least squares of ten pseudoranges, some of which are reflected or
blocked, so that its error jumps. It states the covariance of their white noise only, as receivers
do, and its error is told as one of 20 m for 20 s.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from maplines_can.localisation import GnssFix, Localisation, Odometry, SensorErrors

from .figures import Share, longest
from .harness import evidence, progress

Array = NDArray[np.float64]

#: Duration of a course [s], rates of odometry and of the evaluation [Hz].
SECONDS, RATE, EVALUATED = 240.0, 10.0, 2.0
#: Times of a canyon in a transition, of a jump, of a ramp and of a gap [s].
CANYON, JUMP, RAMP, GAP = (80.0, 160.0), (100.0, 110.0), (100.0, 130.0), (120.0, 150.0)
#: Error of GNSS on an open road: standard deviation [m], correlation time [s].
OPEN = 1.5, 60.0
#: Standard deviations of the white noise of a fix on an open road, and in the city [m].
WHITE_OPEN, WHITE_CITY = 0.4, 1.0
#: Sizes of the outliers and of the jump [m], share of outliers, and growth of the ramp [m/s].
OUTLIER, SHARE, JUMPED, GROWTH = 200.0, 0.1, 100.0, 1.0
#: Satellites, lowest and highest one [rad], standard deviation of the white noise of a pseudorange
#: and mean of what a reflection adds [m], mean time between two changes of a satellite [s].
SATELLITES, LOW, HIGH, PSEUDORANGE, REFLECTED, CHANGE = 10, 0.26, 1.40, 2.0, 17.0, 10.0
#: Shares of satellites that are seen directly, reflected, and blocked; least number for a fix.
SIGHTS, FEWEST = (0.5, 0.3, 0.2), 5
#: Error of such fixes that is told: standard deviation [m], correlation time [s].
TOLD = 20.0, 20.0
#: Standard deviations of the pose at the start: x, y [m], heading [rad].
START = np.array([2.0, 2.0, 0.02])


#: Squared error of a position that 95 % have at most (chi-square with 2 degrees of freedom).
REGION = 5.991


class Kind(NamedTuple):
    """Kind of a course."""

    place: str  #: "open", "canyon" or "transition"
    event: str = ""  #: "outliers", "gap", "jump", "ramp" or "reflections"
    rate: float = 5.0  #: of GNSS [Hz]
    stated: float = (
        0.0  #: standard deviation that a fix states for its white noise [m]; 0: true one
    )


COURSES = {
    "open road": Kind("open"),
    "open road, 1 Hz": Kind("open", rate=1.0),
    "open road, jump": Kind("open", "jump"),
    "open road, ramp": Kind("open", "ramp"),
    "canyon": Kind("canyon"),
    "canyon, 1 Hz": Kind("canyon", rate=1.0),
    "canyon, 10 m stated as white": Kind("canyon", stated=10.0),
    "canyon, outliers": Kind("canyon", "outliers"),
    "canyon, gap": Kind("canyon", "gap"),
    "canyon, jump": Kind("canyon", "jump"),
    "canyon, ramp": Kind("canyon", "ramp"),
    "canyon, reflections": Kind("canyon", "reflections"),
    "transition": Kind("transition"),
    "transition, 1 Hz": Kind("transition", rate=1.0),
    "transition, outliers": Kind("transition", "outliers"),
    "transition, gap": Kind("transition", "gap"),
    "transition, jump": Kind("transition", "jump"),
}


class Course(NamedTuple):
    """True motion and measurements of n cars: k odometries, m fixes."""

    t: Array  #: (k,) [s]
    pose: Array  #: (k, n, 3)
    wheel_speed: Array  #: (k, n) [m/s]
    yaw_rate: Array  #: (k, n) [rad/s]
    fix_t: Array  #: (m,) [s]
    fixes: Array  #: (m, n, 2) [m]; NaN for none
    error: Array  #: (m, n, 2) true standard deviation [m] and correlation time [s]
    cov: Array  #: (m, n, 2, 2) that the fixes state for their white noise [m^2]


@evidence
def canyon(
    cars: int = 50, courses: tuple[str, ...] = tuple(COURSES), seed: int = 0
) -> dict[str, Any]:
    """Localise cars on each course, and by filters that are told the truth.

    These get with each fix the standard deviation and the correlation time of its error (100 m and
    60 s in a jump, 17 m and 30 s at least in a ramp).

        inside     share of times at which the position is within its 95 % region
        beyond     longest time for which a car is beyond 5 sigmas: a squared error of more than 25
        cars       share of the cars for which that is longer than 5 s
        RMS        of the position, and how many times that of the filter that is told
        NEES       normalised error squared of the position, 2 if the covariance is right
        known      share of times at which a pose is stated; the others are not in the figures
    """
    result: dict[str, Any] = {}
    for name in progress(courses, "courses"):
        rng = np.random.default_rng([seed, sum(name.encode())])
        course = made(COURSES[name], cars, rng)
        start = course.pose[0] + START * rng.standard_normal((cars, 3))
        told, own = (figures(*driven(course, start, is_told=is_told)) for is_told in (True, False))
        result[name] = own | {f"told: {what}": value for what, value in told.items()}
        result[name]["RMS, ratio"] = own["RMS [m]"] / told["RMS [m]"]
    return result


def made(kind: Kind, n: int, rng: np.random.Generator) -> Course:
    """Return the course of n cars."""
    t = np.arange(round(SECONDS * RATE)) / RATE
    speed, rate = (open_road if kind.place == "open" else city)(t, n, rng)
    pose = integrated(speed, rate)
    ones = np.ones((len(t), n))
    errors = SensorErrors()
    slip, bias = (
        gauss_markov(one.sigma * ones, one.time * ones, RATE, rng, 1)[..., 0]
        for one in (errors.speed, errors.yaw_rate)
    )
    scale = errors.wheel_scale.sigma * rng.standard_normal(n)
    white = errors.yaw_rate_noise * np.sqrt(RATE) * rng.standard_normal((len(t), n))
    # Fixes.
    step = round(RATE / kind.rate)
    rows = np.arange(step, len(t), step)
    at = t[rows]
    low, high = np.log([1.0, 5.0]), np.log([30.0, 60.0])
    canyon = np.exp(rng.uniform(low, high, (n, 2)))
    in_canyon = (at >= CANYON[0]) & (at < CANYON[1])
    if kind.place != "transition":
        in_canyon[:] = kind.place == "canyon"
    error = np.where(in_canyon[:, None, None], canyon, OPEN)
    off = np.zeros((len(at), n, 2))
    for inside in (in_canyon, ~in_canyon):
        sigma, time = np.moveaxis(error, -1, 0)
        own = gauss_markov(sigma, time, kind.rate, rng, 2)
        off[inside] = own[inside]
    for name, (begin, end), size in (("jump", JUMP, JUMPED), ("ramp", RAMP, GROWTH)):
        if kind.event == name:
            while_on = (at >= begin) & (at < end)
            grown = size * (at[while_on] - begin if name == "ramp" else np.ones(while_on.sum()))
            off[while_on] += grown[:, None, None] * directions(rng, (n,))
            told = (JUMPED, 60.0) if name == "jump" else (GROWTH * (end - begin) / 3**0.5, 30.0)
            error[while_on] = np.maximum(error[while_on], told)
    sigma = WHITE_OPEN if kind.place == "open" else WHITE_CITY
    fixes = pose[rows, :, :2] + off + sigma * rng.standard_normal(off.shape)
    if kind.event == "outliers":
        is_far = rng.random((len(at), n)) < SHARE
        fixes += np.where(is_far[..., None], OUTLIER * directions(rng, is_far.shape), 0.0)
    if kind.event == "gap":
        fixes[(at >= GAP[0]) & (at < GAP[1])] = np.nan
    cov = np.tile((kind.stated or sigma) ** 2 * np.eye(2), (len(at), n, 1, 1))
    if kind.event == "reflections":
        off, cov = least_squares(len(at), n, kind.rate, rng)
        fixes, error = pose[rows, :, :2] + off, np.tile(TOLD, (len(at), n, 1))
    measured = (speed + slip) / (1 + scale), rate + bias + white
    return Course(t, pose, *measured, at, fixes, error, cov)


def least_squares(m: int, n: int, rate: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return (m, n, 2) errors and (m, n, 2, 2) covariances of fixes among reflecting houses [Hz].

    A satellite is seen directly, reflected, which adds an exponential length, or blocked, for an
    exponential time each. The fix is x = P H' y with P = (H' H)^-1 and the pseudoranges y; its
    covariance is that of their white noise.
    """
    off, cov = np.zeros((m, n, 2)), np.zeros((m, n, 2, 2))
    for car in range(n):
        azimuth = rng.uniform(0, 2 * np.pi, SATELLITES)
        elevation = rng.uniform(LOW, HIGH, SATELLITES)
        c, s = np.cos(elevation), np.sin(elevation)
        H = np.column_stack([-c * np.sin(azimuth), -c * np.cos(azimuth), -s, np.ones(SATELLITES)])
        changes = rng.random((m, SATELLITES)) < -np.expm1(-1 / (rate * CHANGE))
        changes[0] = True
        sight, added = np.zeros((2, SATELLITES))
        for k in range(m):
            if changes[k].any():
                new = rng.choice(3, SATELLITES, p=SIGHTS), rng.exponential(REFLECTED, SATELLITES)
                sight, added = np.where(changes[k], new, (sight, added))
                # Those that are seen directly come first.
                seen = np.argsort(sight, kind="stable")[: max(FEWEST, (sight < 2).sum())]
                P = np.linalg.inv(H[seen].T @ H[seen])
                gain, bias = (P @ H[seen].T)[:2], np.where(sight == 1, added, 0.0)[seen]
            off[k, car] = gain @ (bias + PSEUDORANGE * rng.standard_normal(len(seen)))
            cov[k, car] = PSEUDORANGE**2 * P[:2, :2]
    return off, cov


def city(t: Array, n: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return (k, n) speeds and yaw rates through city blocks, with a stop of 15 s."""
    phase, mean = rng.uniform(0, 2 * np.pi, n), rng.uniform(6, 14, n)
    speed = mean * (1 + 0.3 * np.sin(2 * np.pi * t[:, None] / 25 + phase))
    rate = np.zeros((len(t), n))
    for car in range(n):
        stop, at = rng.uniform(20, SECONDS - 40), rng.uniform(5, 20)
        most = 2.5 * np.maximum(np.abs(t - stop) - 7.5, 0)  # acceleration of 2.5 m/s^2
        speed[:, car] = np.minimum(speed[:, car], most)
        while at < SECONDS - 5:
            turn = (t >= at) & (t < at + 4) & (speed[:, car] > 3)
            rate[turn, car] = rng.choice([-1, 1]) * np.pi / 8
            at += 9 + rng.exponential(20)
    return speed, rate


def open_road(t: Array, n: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return (k, n) speeds and yaw rates along a road with wide bends."""
    phase, size = rng.uniform(0, 2 * np.pi, n), rng.uniform(0, 0.01, n)
    rate = size * np.sin(2 * np.pi * t[:, None] / 60 + phase)
    return np.tile(rng.uniform(10, 25, n), (len(t), 1)), rate


def integrated(speed: Array, rate: Array) -> Array:
    """Return (k, n, 3) poses that begin at 0, from (k, n) speeds and yaw rates."""
    v, w = ((one[1:] + one[:-1]) / 2 / RATE for one in (speed, rate))
    heading = np.vstack([np.zeros(speed.shape[1]), np.cumsum(w, axis=0)])
    middle = heading[:-1] + w / 2
    steps = np.stack([v * np.cos(middle), v * np.sin(middle)], axis=-1)
    place = np.concatenate([np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)])
    return np.concatenate([place, heading[..., None]], axis=-1)


def gauss_markov(
    sigma: Array, time: Array, rate: float, rng: np.random.Generator, values: int
) -> Array:
    """Return (k, n, values) errors from (k, n) standard deviations and correlation times [s]."""
    phi = np.exp(-1 / (rate * time))[..., None]
    found = rng.standard_normal((*sigma.shape, values))
    for k in range(1, len(found)):
        found[k] = phi[k] * found[k - 1] + np.sqrt(1 - phi[k] ** 2) * found[k]
    return np.asarray(sigma[..., None] * found)


def directions(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Return (*shape, 2) random unit vectors."""
    angle = rng.uniform(0, 2 * np.pi, shape)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def driven(course: Course, start: Array, *, is_told: bool) -> tuple[Array, Array]:
    """Return (k, n, 2) errors of a filter and their normalised squares, NaN without a pose.

    It is told the errors of the fixes or not.
    """
    # One that is told needs no hypotheses; what it holds for known is overridden by each fix.
    errors = SensorErrors(gnss=SensorErrors.UNKNOWN_GNSS) if is_told else None
    localisation = Localisation(start, course.t[0], errors, cov=np.diag(START**2))
    due, every, rows = 0, round(RATE / EVALUATED), []
    for k, t in enumerate(course.t):
        while due < len(course.fix_t) and course.fix_t[due] <= t:
            error = course.error[due] if is_told else None
            localisation.add(GnssFix(course.fix_t[due], course.fixes[due], course.cov[due], error))
            due += 1
        localisation.add(Odometry(t, course.wheel_speed[k], course.yaw_rate[k]))
        if k % every == 0:
            mean, cov, known = localisation.poses()
            off = mean[:, :2] - course.pose[k, :, :2]
            solved = np.linalg.solve(cov[:, :2, :2], off[..., None])[..., 0]
            rows.append((off, np.where(known, (off * solved).sum(axis=-1), np.nan)))
    found, squared = (np.array(column) for column in zip(*rows, strict=True))
    return found, squared


def figures(errors: Array, squared: Array) -> dict[str, Any]:
    """Return the figures of a filter."""
    known, beyond = np.isfinite(squared), longest(squared > 25.0) / EVALUATED
    return {
        "inside": Share(float((squared[known] <= REGION).mean()), len(beyond)),
        "beyond [s]": float(beyond.max()),
        "cars": Share(float((beyond > 5.0).mean()), len(beyond)),
        "RMS [m]": float(np.sqrt((errors**2).sum(axis=-1)[known].mean())),
        "known": float(known.mean()),
        "NEES": float(squared[known].mean()),
        "NEES, median": float(np.median(squared[known])),
    }
