"""Simulated drive of a car along a path or a route, with its true pose and motion at any time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..maps import Map, Route
from ..values.arrays import floats
from ..values.polyline import Polyline
from .smooth_path import STEP, SmoothPath

#: Speed on lanes without a speed limit [m/s].
DEFAULT_SPEED = 50 / 3.6
#: The drive ends where the rest of the route is shorter than this [m].
MIN_LENGTH = 1.0


class CarState(NamedTuple):
    """Pose and motion of the car at one time, or at (n,) times."""

    t: NDArray[np.float64]  #: (...,) [s]
    pose: NDArray[np.float64]  #: (..., 3) x [m], y [m], heading [rad] in the map frame
    speed: NDArray[np.float64]  #: (...,) along the heading [m/s]
    yaw_rate: NDArray[np.float64]  #: (...,) positive to the left [rad/s]


@dataclass(frozen=True, eq=False)
class SimulatedDrive:
    """A car that drives along a path as fast as its limits permit.

    The origin of the ego frame moves along the path, smoothed so that heading and curvature are
    continuous (``smooth_path``), and its x axis is tangent to it. The squared speed is the greatest
    one that satisfies all limits: one pass forward for the acceleration, one backward for the
    deceleration. Between the points of the profile, at most 0.5 m apart, the acceleration is
    constant. The drive begins at t = 0.

    Args:
        path: points in driving order, such as the centre line of a route.
        speed_limits: [m/s]; one for the whole path, or pairs (s, limit) that apply from the
            distance s along the path [m] to the next pair. The first s is 0.
        stops: pairs (s, dwell): the car stops at the distance s [m] for the time dwell [s].
        acceleration: largest increase of speed [m/s^2].
        deceleration: largest decrease of speed [m/s^2].
        lateral_acceleration: largest curvature times squared speed [m/s^2].
        start_speed: at the beginning of the path [m/s].
        end_speed: largest speed at the end of the path [m/s].

    Raises:
        ValueError: a value is out of range, or the car cannot keep the limits if it begins
            with ``start_speed``.

    >>> drive = SimulatedDrive(Polyline([[0, 0], [200, 0]]), 10.0, acceleration=2, deceleration=2)
    >>> round(drive.duration, 3)  # 5 s for 25 m to 10 m/s, 15 s for 150 m, 5 s for 25 m to 0
    25.0
    >>> state = drive.at(3.0)
    >>> state.pose.round(9), state.speed.round(9)
    (array([9., 0., 0.]), np.float64(6.0))
    """

    path: Polyline
    speed_limits: float | Sequence[tuple[float, float]] = 50 / 3.6
    stops: Sequence[tuple[float, float]] = ()
    acceleration: float = 2.0
    deceleration: float = 2.0
    lateral_acceleration: float = 2.0
    start_speed: float = 0.0
    end_speed: float = 0.0
    _smooth: SmoothPath = field(init=False, repr=False)
    _profile: _Profile = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("acceleration", "deceleration", "lateral_acceleration"):
            _check(getattr(self, name), name, "m/s^2", positive=True)
        for name in ("start_speed", "end_speed"):
            _check(getattr(self, name), name, "m/s", positive=False)
        limits = _pairs(
            [(0.0, self.speed_limits)] if np.ndim(self.speed_limits) == 0 else self.speed_limits,
            "speed_limits",
            self.path.length,
        )
        if not len(limits) or limits[0, 0] != 0 or not (limits[:, 1] > 0).all():
            raise ValueError(
                "speed_limits must be more than 0 m/s, and the first one must apply from s = 0, "
                f"got {self.speed_limits!r}"
            )
        stops = _pairs(self.stops, "stops", self.path.length)
        if (stops[:, 1] < 0).any():
            raise ValueError(f"stops must have dwell times of 0 s or more, got {self.stops!r}")
        smooth = SmoothPath(self.path)
        object.__setattr__(self, "_smooth", smooth)
        object.__setattr__(self, "_profile", self._plan(smooth, limits, stops))

    def _plan(
        self, path: SmoothPath, limits: NDArray[np.float64], stops: NDArray[np.float64]
    ) -> _Profile:
        """Return the profile of the greatest speeds that satisfy all limits."""
        limit_s, stop_s = (_placed(pairs[:, 0], path) for pairs in (limits, stops))
        breaks = np.unique(np.concatenate([[0.0, path.length], limit_s, stop_s]))
        # Two cells at least between two breaks, so that a car gets from one stop to the next.
        counts = np.ceil(np.diff(breaks) / STEP).astype(int).clip(min=2)
        pieces = [
            np.linspace(a, b, n, endpoint=False)
            for a, b, n in zip(breaks[:-1], breaks[1:], counts, strict=True)
        ]
        s = np.append(np.concatenate(pieces), path.length)
        middle = (s[1:] + s[:-1]) / 2
        # The curvature may peak inside a cell: with its ends and middle alone, the lateral
        # acceleration was up to 0.6 % too large.
        inside = s[:-1] + np.diff(s) * np.linspace(0, 1, 9)[:, None]
        bend = np.abs(path.curvature(inside)).max(axis=0)
        limit = limits[limit_s.searchsorted(middle, side="right") - 1, 1]
        with np.errstate(divide="ignore"):
            cell = np.minimum(limit**2, self.lateral_acceleration / bend)  # (n,) squared speeds
        squared = np.minimum(np.append(np.inf, cell), np.append(cell, np.inf))
        squared[s.searchsorted(stop_s)] = 0.0
        squared[0] = min(squared[0], self.start_speed**2)
        squared[-1] = min(squared[-1], self.end_speed**2)
        rise, fall = 2 * self.acceleration * s, 2 * self.deceleration * s
        squared = np.minimum.accumulate(squared - rise) + rise
        squared = np.minimum.accumulate((squared + fall)[::-1])[::-1] - fall
        speed = np.sqrt(squared.clip(min=0.0))
        if speed[0] < self.start_speed * (1 - 1e-9):
            raise ValueError(
                f"start_speed must be at most {speed[0]:.3g} m/s, so that the car keeps the speed "
                f"limits, curves and stops that follow, got {self.start_speed:g} m/s"
            )
        dwell = np.zeros(len(s))
        np.add.at(dwell, s.searchsorted(stop_s), stops[:, 1])
        return _Profile.of(s, speed, dwell)

    @property
    def start(self) -> float:
        """First time [s]: 0."""
        return 0.0

    @property
    def end(self) -> float:
        """Last time [s]."""
        return float(self._profile.leave[-1])

    @property
    def duration(self) -> float:
        """Time from the beginning to the end of the path, with all stops [s]."""
        return self.end - self.start

    def at(self, t: ArrayLike) -> CarState:
        """Return the true pose and motion at one time or at (n,) times [s].

        The heading is continuous along the drive, so it may exceed pi.

        Raises:
            ValueError: a time is not from 0 to ``duration``.
        """
        t = floats(t, "t")
        if not ((t >= 0) & (t <= self.duration)).all():
            raise ValueError(f"t must be from 0 to {self.duration:g} s, got {t!r}")
        s, speed = self._profile.at(t)
        return CarState(t, self._smooth.pose(s), speed, speed * self._smooth.curvature(s))

    def times(self, rate: float) -> NDArray[np.float64]:
        """Return the (n,) times of a rate in Hz, from the beginning to the end of the drive [s].

        Raises:
            ValueError: the rate is not positive.
        """
        return even_times(self.start, self.end, rate)


def drive_along(
    road_map: Map, route: Route, default_speed: float = DEFAULT_SPEED, **limits: Any
) -> SimulatedDrive:
    """Return the drive along a route, from its start to its goal.

    Args:
        road_map: the map of the route.
        route: that the car follows.
        default_speed: limit on lanes of which the map states none [m/s].
        **limits: further arguments of ``SimulatedDrive``.

    Raises:
        ValueError: the route is shorter than 1 m, or a limit is out of range.
    """
    start, goal = route.start, min(route.goal, route.line.length)
    if goal - start < MIN_LENGTH:
        raise ValueError(
            f"the route from lane {route.lanes[0]!r} to lane {route.lanes[-1]!r} has a length of "
            f"{goal - start:.3g} m, but a drive needs {MIN_LENGTH:g} m or more"
        )
    # Of what applies from the same position, or from before the start, the last one counts.
    by_start = {
        max(0.0, at - start): limit or default_speed for at, limit in _speed_limits(road_map, route)
    }
    pairs = [(at, speed) for at, speed in by_start.items() if at < goal - start]
    return SimulatedDrive(Polyline(route.line.between(start, goal)), pairs, **limits)


def _speed_limits(road_map: Map, route: Route) -> Iterator[tuple[float, float | None]]:
    """Yield the speed limits along the line of a route, and the positions where they begin [m]."""
    for i, (begin, end) in enumerate(pairwise([*route.begins, route.line.length])):
        lane = road_map.lanes[route.lanes[i]]
        start, length = route.extent(i)
        scale = length / lane.length if lane.length > 0 else 0.0
        for s, limit in lane.speed_limits or ((0.0, lane.speed_limit),):
            at = start + scale * s
            if at < end:
                yield max(begin, at), limit


def _placed(distance: NDArray[np.float64], path: SmoothPath) -> NDArray[np.float64]:
    """Return arc lengths at distances along the polyline [m], equal if they are within 1 mm."""
    s = path.from_polyline(distance).round(3)
    return np.where(s > path.length - 1e-3, path.length, s)


class _Profile(NamedTuple):
    """Arc lengths and speeds of a drive, with constant acceleration between its points."""

    s: NDArray[np.float64]  #: (n,) arc lengths [m]
    speed: NDArray[np.float64]  #: (n,) [m/s]
    leave: NDArray[np.float64]  #: (n,) time at which the car leaves the point [s]
    arrive: NDArray[np.float64]  #: (n,) time at which it arrives [s]

    @classmethod
    def of(
        cls, s: NDArray[np.float64], speed: NDArray[np.float64], dwell: NDArray[np.float64]
    ) -> _Profile:
        """Return the profile of a car that stays at each point for the (n,) times ``dwell``."""
        cells = np.append(0.0, 2 * np.diff(s) / (speed[1:] + speed[:-1]))
        leave = (cells + dwell).cumsum()
        return cls(s, speed, leave, leave - dwell)

    def at(self, t: NDArray[np.float64]) -> tuple[Any, Any]:
        """Return (...,) arc lengths [m] and speeds [m/s] at (...,) times [s]."""
        i = (self.leave.searchsorted(t, side="right") - 1).clip(0, len(self.s) - 2)
        duration = self.arrive[i + 1] - self.leave[i]
        tau = (t - self.leave[i]).clip(0.0, duration)  # 0 before the car leaves its first point
        acceleration = (self.speed[i + 1] - self.speed[i]) / duration
        s = self.s[i] + (self.speed[i] + acceleration * tau / 2) * tau
        speed = self.speed[i] + acceleration * tau  # rounding may give less than 0
        return s.clip(max=self.s[-1]), speed.clip(min=0.0)


def even_times(start: float, end: float, rate: float) -> NDArray[np.float64]:
    """Return the (n,) times of a rate in Hz from ``start`` to ``end`` [s].

    >>> even_times(1.0, 1.1, 20.0)
    array([1.  , 1.05, 1.1 ])
    """
    _check(rate, "rate", "Hz", positive=True)
    times = start + np.arange(np.floor((end - start) * rate + 1e-6) + 1) / rate
    return times.clip(max=end)


def _check(value: float, name: str, unit: str, *, positive: bool) -> None:
    number = floats(value, name)
    if number.ndim or not (0 < number < np.inf or (number == 0 and not positive)):
        raise ValueError(
            f"{name} must be finite and {'more than 0' if positive else '0 or more'} {unit}, "
            f"got {value!r}"
        )


def _pairs(values: Any, name: str, length: float) -> NDArray[np.float64]:
    """Return (n, 2) pairs with increasing distances along the path in the first column."""
    pairs = floats(values, name) if len(values) else np.empty((0, 2))
    if pairs.ndim != 2 or pairs.shape[1] != 2 or not np.isfinite(pairs).all():
        raise ValueError(f"{name} must be pairs of finite numbers (s, value), got {values!r}")
    s = pairs[:, 0]
    if not ((s >= 0) & (s <= length)).all() or not (np.diff(s) > 0).all():
        raise ValueError(
            f"{name} must have increasing distances from 0 to {length:g} m, the length of the "
            f"path, got {values!r}"
        )
    return pairs
