"""Localisation: extended Kalman filter over the pose and the errors of the sensors."""

from __future__ import annotations

import bisect
import math
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...arrays import floats
from ...gaussian import Gaussian
from ...scene import PoseError
from .association import Verdict
from .correlation import ErrorCorrelation
from .localisation_layer import LocalisationLayer
from .measurements import Measurement, Observation, Odometry
from .motion_model import CAMERA, GNSS, HEADING, POSE, N, initial, predict, speed_of, update
from .observation_models import innovation
from .sensor_errors import SensorErrors

Array = NDArray[np.float64]

#: Longest time by which an observation may be late, or ahead of the odometry [s].
HISTORY = 0.5


class Outcome(NamedTuple):
    """What became of the B blocks of an observation of n cars, when it can no longer change."""

    t: float  #: [s]
    source: str  #: "gnss", "line", "landmark" or "pose"
    verdict: NDArray[np.intp]  #: (n, B) values of ``Verdict``
    squared: Array  #: (n, B) normalised innovations squared (NIS), of 2 values; of 3 for a pose


class Poses(NamedTuple):
    """Poses of n cars with their covariances."""

    mean: Array  #: (n, 3) x [m], y [m], heading [rad] in the map frame
    cov: Array  #: (n, 3, 3)


class _Point(NamedTuple):
    """State of the filter after an odometry or an observation."""

    t: float
    mean: Array
    cov: Array
    transition: Array  #: (n, N, N) of the error since the point before
    outcome: Outcome | None = None


class Localisation:
    """Localisation of n cars, n = 1 in a car; more in a study, with the same measurement times.

    An error-state Kalman filter: odometry drives the prediction, and the state has the errors of
    the sensors (see ``motion_model``). Its own, as filterpy is no longer maintained, and no library
    has what is needed here: biases as states, association with a map, late measurements, and the
    correlation time of the error, for which the gains of each step are needed.

    Observations may come late and in any order: the filter goes back to their time, and repeats
    what came after. An observation takes effect when there is an odometry at or after its time. ::

        odometry      o----o----o----o----o----o   now
        observation          x    arrives here ^   and takes effect between the 2nd and the 3rd

    Args:
        start: Gaussian over the pose x [m], y [m], heading [rad] in the map frame; for several
            cars, the (n, 3) means.
        t: time of it [s].
        errors: of the sensors.
        layer: of the map, for lines and landmarks; None if there are none.
        cov: (3, 3) or (n, 3, 3) covariance of the start of several cars.
        history: longest time by which an observation may be late [s].
        on_outcome: takes each ``Outcome``, in order of time.

    Raises:
        ValueError: a value is not finite, or a shape is wrong.
    """

    def __init__(
        self,
        start: Gaussian | ArrayLike,
        t: float = 0.0,
        errors: SensorErrors | None = None,
        layer: LocalisationLayer | None = None,
        *,
        cov: ArrayLike | None = None,
        history: float = HISTORY,
        on_outcome: Callable[[Outcome], None] | None = None,
    ) -> None:
        if isinstance(start, Gaussian):
            poses, P = start.mean[None], start.cov
        else:
            poses, P = floats(start, "start"), floats(0.0 if cov is None else cov, "cov")
        if poses.ndim != 2 or poses.shape[1] != 3 or P.shape[-2:] != (3, 3):
            raise ValueError(
                "start must be a Gaussian over (x, y, heading), or (n, 3) with cov (3, 3) or "
                f"(n, 3, 3), got shapes {poses.shape} and {P.shape}"
            )
        if not (np.isfinite(poses).all() and np.isfinite(P).all() and math.isfinite(t)):
            raise ValueError("start, cov and t must be finite")
        if not 0 <= history < math.inf:
            raise ValueError(f"history must be finite and 0 s or more, got {history!r}")
        self.errors, self._layer, self._history = errors or SensorErrors(), layer, history
        self._on_outcome = on_outcome
        mean, full = initial(poses, P, self.errors)
        self._points = [_Point(t, mean, full, np.eye(N) + np.zeros_like(full))]
        self._correlation = ErrorCorrelation(t, full)
        self._odometry: list[Odometry] = []
        self._observations: list[Observation] = []
        self._counts = Counter[tuple[str, Verdict]]()

    @property
    def cars(self) -> int:
        """Number n of cars."""
        return len(self._points[-1].mean)

    @property
    def t(self) -> float:
        """Time of the last odometry, up to which measurements have taken effect [s]."""
        return self._points[-1].t

    def add(self, measurement: Measurement) -> None:
        """Take a measurement.

        One that is too late, or is too far ahead of the odometry, is counted and has no effect;
        so is odometry that is not finite, or not later than the one before.
        """
        if isinstance(measurement, Odometry):
            self._add_odometry(measurement)
        elif measurement.t < max(self._points[0].t, self.t - self._history):
            self._count_dropped(measurement, Verdict.TOO_LATE)
        elif measurement.t > self.t + self._history:
            self._count_dropped(measurement, Verdict.NO_ODOMETRY)
        else:
            bisect.insort(self._observations, measurement, key=lambda one: one.t)
            if measurement.t <= self.t:
                self._repeat_from(measurement.t)

    def counts(self) -> dict[str, Counter[str]]:
        """Return what became of the measurements by their source, by the name of the verdict.

        Those of which the history is still kept are not in it.
        """
        found: dict[str, Counter[str]] = {}
        for (source, verdict), count in sorted(self._counts.items()):
            if verdict != Verdict.MISSING:
                found.setdefault(source, Counter())[verdict.name] = count
        return found

    def poses(self, t: float | None = None) -> Poses:
        """Return the poses at a time at or after the last odometry [s], None for its time.

        Beyond it, the cars keep their speed and yaw rate.

        Raises:
            ValueError: the time is before it.
        """
        point = self._points[-1]
        mean, cov = point.mean, point.cov
        if t is not None and t != point.t:
            if not point.t < t < math.inf:
                raise ValueError(f"t must be finite and {point.t:g} s or later, got {t!r}")
            if self._odometry:
                _, speed, rate = self._odometry[-1]
                mean, cov, _ = predict(mean, cov, speed, rate, t - point.t, self.errors)
        return Poses(mean[:, POSE], cov[:, POSE, POSE])

    def ego(self, t: float | None = None) -> Gaussian:
        """Return the Gaussian over the pose of the one car: see ``poses``.

        Raises:
            ValueError: there are several cars, or the time is before the last odometry.
        """
        if self.cars != 1:
            raise ValueError(f"there are {self.cars} cars; use poses()")
        mean, cov = self.poses(t)
        return Gaussian(mean[0], (cov[0] + cov[0].T) / 2)

    def speed(self) -> Array:
        """Return the (n,) speeds at the last odometry [m/s]; NaN before the first one."""
        if not self._odometry:
            return np.full(self.cars, math.nan)
        return speed_of(self._points[-1].mean, self._odometry[-1].wheel_speed)

    def gnss_bias(self) -> Array:
        """Return the (n, 2) errors of the GNSS position, as estimated [m]."""
        return self._points[-1].mean[:, GNSS]

    def camera_error(self) -> Array:
        """Return the (n, 2) errors of the camera, as estimated: lateral [m], direction [rad]."""
        return self._points[-1].mean[:, CAMERA]

    def correlation_times(self) -> Array:
        """Return the (n, 3) correlation times of the errors along, across and of the heading [s].

        They are those of the end of the history: see ``ErrorCorrelation``. Infinite means unknown.
        """
        return self._correlation.times(self._points[-1].mean[:, HEADING])

    def pose_error(self, t: float | None = None) -> PoseError:
        """Return the error of the pose of the one car, as a ``Scene`` states it.

        Its correlation time is that of the error across, the one which the lines beside the car
        show.

        Raises:
            ValueError: there are several cars, or the time is before the last odometry.
        """
        ego = self.ego(t)
        c, s = math.cos(ego.mean[2]), math.sin(ego.mean[2])
        T_ego_map = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        P = T_ego_map @ ego.cov @ T_ego_map.T
        return PoseError((P + P.T) / 2, float(self.correlation_times()[0, 1]))

    def _add_odometry(self, odometry: Odometry) -> None:
        speed, rate = (np.broadcast_to(one, (self.cars,)) for one in odometry[1:])
        is_new = odometry.t > self.t or (odometry.t == self.t and not self._odometry)
        verdict = Verdict.USED if is_new else Verdict.TOO_LATE
        if not (np.isfinite(speed).all() and np.isfinite(rate).all() and odometry.t < math.inf):
            verdict = Verdict.INVALID
        self._counts["odometry", verdict] += self.cars
        if verdict != Verdict.USED:
            return
        self._odometry.append(Odometry(odometry.t, speed, rate))
        self._extend(self.t, odometry.t)
        self._forget()

    def _repeat_from(self, t: float) -> None:
        """Repeat the filter from a time on, with all observations."""
        end = self.t
        while len(self._points) > 1 and self._points[-1].t >= t:
            self._points.pop()
        self._extend(self.t, end)

    def _extend(self, begin: float, end: float) -> None:
        """Filter from one time to another, with the observations after the first one."""
        first = bisect.bisect_right(self._observations, begin, key=lambda one: one.t)
        if begin == self._points[0].t and len(self._points) == 1:
            first = bisect.bisect_left(self._observations, begin, key=lambda one: one.t)
        waiting = self._observations[first:]
        events: list[tuple[float, Observation | None]] = [
            (one.t, one) for one in waiting if one.t <= end
        ]
        events += [(one.t, None) for one in self._odometry if begin < one.t <= end]
        for t, observation in sorted(events, key=lambda event: event[0]):
            point = self._predicted(t)
            self._points.append(point if observation is None else self._updated(point, observation))

    def _predicted(self, t: float) -> _Point:
        last = self._points[-1]
        dt = t - last.t
        if dt <= 0:
            return _Point(t, last.mean, last.cov, np.eye(N) + np.zeros_like(last.cov))
        speed, rate = self._input((last.t + t) / 2)
        mean, cov, F = predict(last.mean, last.cov, speed, rate, dt, self.errors)
        return _Point(t, mean, cov, F)

    def _input(self, t: float) -> tuple[Array, Array]:
        """Return wheel speed and yaw rate at a time, between two odometries."""
        after = bisect.bisect_left(self._odometry, t, key=lambda one: one.t)
        one, other = self._odometry[max(after - 1, 0)], self._odometry[after]
        share = (t - one.t) / (other.t - one.t) if other.t > one.t else 0.0
        speed, rate = (a + share * (b - a) for a, b in zip(one[1:], other[1:], strict=True))
        return speed, rate

    def _updated(self, point: _Point, observation: Observation) -> _Point:
        t, mean, cov, transition, _ = point
        found = innovation(observation, mean, cov, self._layer)
        used = found.verdict == Verdict.USED
        outcome = Outcome(t, found.source, found.verdict, found.squared)
        if used.any():
            mean, cov, reduction = update(mean, cov, found.residual, found.H, found.R, used)
            transition = reduction @ transition
        return _Point(t, mean, cov, transition, outcome)

    def _forget(self) -> None:
        """Drop what is older than the history, and count its outcomes."""
        horizon = self.t - self._history
        keep = bisect.bisect_left(self._points, horizon, key=lambda point: point.t) - 1
        for point in self._points[1 : keep + 1]:
            self._correlation.advance(point.t, point.cov, point.transition)
            if point.outcome is not None:
                self._count(point.outcome)
        if keep > 0:
            del self._points[:keep]
            first = self._points[0].t
            del self._observations[: bisect.bisect_right(self._observations, first, key=_time)]
            del self._odometry[: max(bisect.bisect_right(self._odometry, first, key=_time) - 1, 0)]

    def _count(self, outcome: Outcome) -> None:
        for value, count in zip(*np.unique(outcome.verdict, return_counts=True), strict=True):
            self._counts[outcome.source, Verdict(value)] += int(count)
        if self._on_outcome is not None:
            self._on_outcome(outcome)

    def _count_dropped(self, observation: Observation, verdict: Verdict) -> None:
        self._counts[type(observation).__name__, verdict] += self.cars


def _time(one: Measurement) -> float:
    return one.t
