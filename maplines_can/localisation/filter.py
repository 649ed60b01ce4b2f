"""Localisation: extended Kalman filter over the pose and the errors of the sensors."""

from __future__ import annotations

import bisect
import math
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..values.arrays import floats
from ..values.gaussian import Gaussian
from ..values.scene import PoseError
from .admission import admitted, is_covariance
from .association import Verdict
from .correlation import ErrorCorrelation
from .divergence import unsuspicious, widening
from .drift import growth, possible
from .gnss_hypotheses import bank
from .localisation_layer import LocalisationLayer
from .measurements import Measurement, Observation, Odometry
from .motion_model import CAMERA, GNSS, HEADING, POSE, initial, predict, speed_of
from .odometry_stream import CarLimits, OdometryStream, Sample
from .sensor_errors import SensorErrors
from .step import BlockOutcome, first, missed, predicted, updated, widen

Array = NDArray[np.float64]

#: Longest time by which an observation may be late, or ahead of the odometry [s].
HISTORY = 0.5


class Poses(NamedTuple):
    """Poses of n cars with their covariances."""

    mean: Array  #: (n, 3) x [m], y [m], heading [rad] in the map frame
    cov: Array  #: (n, 3, 3)
    known: NDArray[np.bool_]  #: (n,) whether the pose is known; the others must not be used


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

    A sensor may be wrong. Odometry that no car can have is refused (``CarLimits``), and so is what
    is no measurement. The error of GNSS is found out, unless it is known: see ``gnss_hypotheses``.
    If the sensors contradict each other, the filter widens what it states, and
    then says that it does not know the pose, until it is found again: see ``consistency``.

    Args:
        start: Gaussian over the pose x [m], y [m], heading [rad] in the map frame; for several
            cars, the (n, 3) means.
        t: time of it [s].
        errors: of the sensors.
        layer: of the map, for lines and landmarks; None if there are none.
        cov: (3, 3) or (n, 3, 3) covariance of the start of several cars.
        history: longest time by which an observation may be late [s].
        on_outcome: takes each ``BlockOutcome``, in order of time.
        limits: what the car can do.

    Raises:
        ValueError: a value is not finite, a shape is wrong, or ``cov`` is no covariance.
    """

    # Settings of a constructor, most of them by keyword alone.
    def __init__(
        self,
        start: Gaussian | ArrayLike,
        t: float = 0.0,
        errors: SensorErrors | None = None,
        layer: LocalisationLayer | None = None,
        *,
        cov: ArrayLike | None = None,
        history: float = HISTORY,
        on_outcome: Callable[[BlockOutcome], None] | None = None,
        limits: CarLimits | None = None,
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
        if not is_covariance(P).all():
            raise ValueError(f"cov must be symmetric and positive semidefinite, got {P!r}")
        if not 0 <= history < math.inf:
            raise ValueError(f"history must be finite and 0 s or more, got {history!r}")
        self.errors, self._layer, self._history = errors or SensorErrors(), layer, history
        self._on_outcome = on_outcome
        held = bank(len(poses), t, self.errors)
        n, K = held.weight.shape
        poses = np.repeat(poses, K, axis=0)
        P = np.repeat(np.broadcast_to(P, (n, 3, 3)), K, axis=0)
        mean, full = initial(poses, P, self.errors, held.rows)
        self._points = [first(t, mean, full, held, unsuspicious(n))]
        #: Autocorrelation of the error, up to the begin of the history.
        self.correlation = ErrorCorrelation(t, self._points[0].mixture[1])
        self._odometry = OdometryStream(n, t, limits or CarLimits())
        self._observations: list[Observation] = []
        self._counts = Counter[tuple[str, Verdict]]()

    @property
    def cars(self) -> int:
        """Number n of cars."""
        return len(self._points[-1].trust.known)

    @property
    def t(self) -> float:
        """Time of the last odometry, up to which measurements have taken effect [s]."""
        return self._points[-1].t

    @property
    def known(self) -> NDArray[np.bool_]:
        """(n,) whether the poses at the last odometry are known."""
        return self._points[-1].trust.known

    def add(self, measurement: Measurement) -> None:
        """Take a measurement, of any content.

        One that is no measurement, that no car could give, or that is too late or too far ahead of
        the odometry, is counted with its reason (``Verdict``) and has no effect.

        Raises:
            TypeError: it is of another type than ``Measurement``.
        """
        if isinstance(measurement, Odometry):
            self._add_odometry(measurement)
            return
        found, refused = admitted(measurement, self.cars)
        for verdict, cars in refused.items():
            self._counts[type(measurement).__name__, verdict] += cars
        if found is None:
            return
        t = found.t
        if t < max(self._points[0].t, self.t - self._history):
            self._count_dropped(found, Verdict.TOO_LATE)
        elif t > self.t + self._history:
            self._count_dropped(found, Verdict.NO_ODOMETRY)
        else:
            bisect.insort(self._observations, found, key=_time)
            if t <= self.t:
                self._repeat_from(t)

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

        Beyond it, the cars keep their speed and yaw rate; the longer, the less certain they are.
        They are not known if odometry is missing for longer than ``CarLimits.gap``.

        Raises:
            ValueError: the time is before it, and a pose is known.
        """
        point, last = self._points[-1], self._odometry.last
        (mean, cov), known = point.mixture, point.trust.known
        if t is not None and t != point.t and known.any():
            if not point.t < t < math.inf:
                raise ValueError(f"t must be finite and {point.t:g} s or later, got {t!r}")
            if last is not None:
                dt = t - point.t
                mean, cov, _ = predict(mean, cov, *last[1:3], dt, self.errors)
                noise = self._odometry.gap_noise(point.t, t, last.latest, last.wheel_speed)
                widen(cov, *noise)
                known = known & (t - last.latest <= self._odometry.limits.gap)
        nis, position, heading = widening(point.trust)
        cov = cov[:, POSE, POSE] * nis[:, None, None]
        cov += growth(point.ramps.best(point.t))
        if self.errors.gnss_drift:
            cov += possible(point.ramps, self.errors.gnss_drift)
        widen(cov, position, heading)
        return Poses(mean[:, POSE], cov, known)

    def ego(self, t: float | None = None) -> Gaussian | None:
        """Return the Gaussian over the pose of the one car, None if it is not known: see ``poses``.

        Raises:
            ValueError: there are several cars, or the time is before the last odometry.
        """
        if self.cars != 1:
            raise ValueError(f"there are {self.cars} cars; use poses()")
        mean, cov, known = self.poses(t)
        return Gaussian(mean[0], (cov[0] + cov[0].T) / 2) if known[0] else None

    def speed(self) -> Array:
        """Return the (n,) speeds at the last odometry [m/s]; NaN before the first one."""
        last = self._odometry.last
        if last is None:
            return np.full(self.cars, math.nan)
        return speed_of(self._points[-1].mixture[0], last.wheel_speed)

    def gnss_bias(self) -> Array:
        """Return the (n, 2) errors of the GNSS position, as estimated [m]."""
        return self._points[-1].mixture[0][:, GNSS]

    def gnss_sigma(self) -> Array:
        """Return the (n,) standard deviations of the GNSS error, as told or as is likeliest [m]."""
        held = self._points[-1].bank
        return held.gnss_sigma[held.likeliest]

    def camera_error(self) -> Array:
        """Return the (n, 2) errors of the camera, as estimated: lateral [m], direction [rad]."""
        return self._points[-1].mixture[0][:, CAMERA]

    def correlation_times(self) -> Array:
        """Return the (n, 3) correlation times of the errors along, across and of the heading [s].

        They are those of the end of the history: see ``ErrorCorrelation``. Infinite means unknown.
        """
        return self.correlation.times(self._points[-1].mixture[0][:, HEADING])

    def pose_error(self, t: float | None = None) -> PoseError | None:
        """Return the error of the pose of the one car, as a ``Scene`` states it; None without one.

        Its correlation time is that of the error across, the one which the lines beside the car
        show.

        Raises:
            ValueError: there are several cars, or the time is before the last odometry.
        """
        ego = self.ego(t)
        if ego is None:
            return None
        c, s = math.cos(ego.mean[2]), math.sin(ego.mean[2])
        T_ego_map = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        P = T_ego_map @ ego.cov @ T_ego_map.T
        return PoseError((P + P.T) / 2, float(self.correlation_times()[0, 1]))

    def _add_odometry(self, odometry: Odometry) -> None:
        samples, counts, is_set_back = self._odometry.take(odometry)
        for verdict, cars in counts.items():
            self._counts["odometry", verdict] += cars
        if is_set_back and samples:
            self._start_again(samples[0].t)
        for sample in samples:
            self._extend(self.t, sample.t)
            self._forget()

    def _start_again(self, t: float) -> None:
        """Go on from an earlier time, as the clock of the odometry has been set back."""
        for one in self._observations:
            self._count_dropped(one, Verdict.NO_ODOMETRY)
        self._observations.clear()
        last = self._points[-1]
        held = last.bank._replace(at=np.full(self.cars, t), drift_at=t)
        point = first(t, last.mean, last.cov, held, last.trust)
        self._points = [missed(point, np.full(self.cars, True))]
        self.correlation = ErrorCorrelation(t, last.mixture[1])

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
        events: list[Observation | Sample] = [one for one in waiting if one.t <= end]
        events += self._odometry.between(begin, end)
        for event in sorted(events, key=_time):
            point = predicted(self._points[-1], event.t, self._odometry, self.errors)
            if not isinstance(event, Sample):
                point = updated(point, event, self._layer, self.errors, self._odometry)
            elif event.broken.any():
                point = missed(point, event.broken)
            self._points.append(point)

    def _forget(self) -> None:
        """Drop what is older than the history, and count its outcomes."""
        horizon = self.t - self._history
        keep = bisect.bisect_left(self._points, horizon, key=lambda point: point.t) - 1
        for point in self._points[1 : keep + 1]:
            cov, transition = point.mixture[1], point.mean_transition
            self.correlation.advance(point.t, cov, transition, point.is_new)
            if point.outcome is not None:
                self._count(point.outcome)
        if keep > 0:
            del self._points[:keep]
            first = self._points[0].t
            del self._observations[: bisect.bisect_right(self._observations, first, key=_time)]
            self._odometry.forget(first)

    def _count(self, outcome: BlockOutcome) -> None:
        for value, count in zip(*np.unique(outcome.verdict, return_counts=True), strict=True):
            self._counts[outcome.source, Verdict(value)] += int(count)
        if self._on_outcome is not None:
            self._on_outcome(outcome)

    def _count_dropped(self, observation: Observation, verdict: Verdict) -> None:
        self._counts[type(observation).__name__, verdict] += self.cars


def _time(one: Observation | Sample) -> float:
    return one.t
