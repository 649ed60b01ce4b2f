"""Stream of odometry: bounds on what a car can do, and what is not known between two samples.

A single wrong sample of a yaw rate turns the pose for good, and a single wrong stamp makes all that
comes after it too late. So a sample is refused if no car moves like that, and a stamp that is far
ahead of, or behind, the one before is believed only when others continue from it. What is missing
then is a gap: the car may have braked and turned in it, see ``gap_noise``.
"""

from __future__ import annotations

import bisect
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .admission import finite_time
from .association import Verdict
from .measurements import Odometry

Array = NDArray[np.float64]

#: Stamps in a row, each at most ``CarLimits.step`` after the one before, that show that the clock
#: of the odometry has been set, or that odometry has been missing.
CONFIRM = 10
#: Time after which nothing more is to be lost [s].
LONGEST = 60.0


@dataclass(frozen=True)
class CarLimits:
    """What a car can do, and how long it may do it unobserved.

    The changes have a margin for noise, rounding and the jitter of stamps: the wheel speed of a
    production car changes by 0.5 m/s between two stamps that are 2 ms apart.

    Args:
        speed: greatest speed, in either direction [m/s].
        yaw_rate: greatest yaw rate [rad/s].
        lateral_acceleration: greatest product of the two [m/s^2].
        acceleration: greatest change of the speed in time, beyond ``speed_margin`` [m/s^2].
        yaw_acceleration: greatest change of the yaw rate in time, beyond ``yaw_margin`` [rad/s^2].
        speed_margin, yaw_margin: of a change [m/s, rad/s].
        step: longest time to the next stamp, beyond which others must confirm it [s].
        gap: time without odometry after which the pose is not known [s].
        refused: the same, if odometry has come but was refused; then it is not known whether it
            was right before or is right after [s].
        unnoticed: time between two samples in which nothing happens [s].
        sigma_acceleration, sigma_yaw_acceleration: standard deviations of what a car does when it
            is not observed [m/s^2, rad/s^2].

    Raises:
        ValueError: a value is not more than 0.
    """

    speed: float = 100.0
    yaw_rate: float = 3.0
    lateral_acceleration: float = 15.0
    acceleration: float = 15.0
    yaw_acceleration: float = 15.0
    speed_margin: float = 1.5
    yaw_margin: float = 0.2
    step: float = 1.0
    gap: float = 2.0
    refused: float = 0.5
    unnoticed: float = 0.1
    sigma_acceleration: float = 3.0
    sigma_yaw_acceleration: float = 0.5

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            if not value > 0:
                raise ValueError(f"{one.name} must be more than 0, got {value!r}")


class Sample(NamedTuple):
    """Odometry of n cars; where that of a car was refused, it keeps that before."""

    t: float  #: [s]
    wheel_speed: Array  #: (n,) [m/s]
    yaw_rate: Array  #: (n,) [rad/s]
    since: Array  #: (n,) time of the sample before that was accepted [s]
    latest: Array  #: (n,) time of the latest one that was accepted, this one or an earlier one [s]
    broken: NDArray[np.bool_]  #: (n,) whether too much is missing


class OdometryStream:
    """Stream of odometry of n cars.

    Args:
        cars: number n of cars.
        t: time of the start [s].
        limits: what a car can do.
    """

    def __init__(self, cars: int, t: float, limits: CarLimits) -> None:
        self._cars, self.limits = cars, limits
        self._samples: list[Sample] = []
        self._waiting: list[Odometry] = []  # of another clock, not confirmed yet
        self._refused = np.full(cars, False)  # since the last one that was accepted
        self._t = t

    @property
    def last(self) -> Sample | None:
        """The last sample; None before the first one."""
        return self._samples[-1] if self._samples else None

    def take(self, odometry: Odometry) -> tuple[list[Sample], dict[Verdict, int], bool]:
        """Take odometry.

        Returns:
            The samples that are new; the cars by the verdict on what has been decided; and whether
            the clock has been set back, so that the samples are earlier than those before.
        """
        t = finite_time(odometry.t)
        try:
            speed, rate = (
                np.broadcast_to(np.asarray(one, dtype=float), (self._cars,)) for one in odometry[1:]
            )
        except (TypeError, ValueError, OverflowError):
            t = None
        if t is None:
            return [], {Verdict.INVALID: self._cars}, False
        new = Odometry(t, speed, rate)
        is_next = t > self._t or (t == self._t and not self._samples)
        if is_next and t - self._t <= self.limits.step:
            counts = self._dropped()
            samples = self._judged(new, counts)
            return samples, counts, False
        counts = {}
        if self._waiting and not 0 < t - self._waiting[-1].t <= self.limits.step:
            counts = self._dropped()
        if not is_next and self._t - t <= self.limits.step and not self._waiting:
            counts[Verdict.TOO_LATE] = counts.get(Verdict.TOO_LATE, 0) + self._cars
            return [], counts, False
        self._waiting.append(new)
        if len(self._waiting) < CONFIRM:
            return [], counts, False
        waiting, self._waiting, is_set_back = self._waiting, [], not is_next
        if is_set_back:
            self._samples.clear()
            self._t = waiting[0].t
        samples = [sample for one in waiting for sample in self._judged(one, counts)]
        return samples, counts, is_set_back

    def _dropped(self) -> dict[Verdict, int]:
        """Drop what nothing has confirmed, and return the counts."""
        counts: dict[Verdict, int] = {}
        for one in self._waiting:
            verdict = Verdict.AHEAD if one.t > self._t else Verdict.TOO_LATE
            counts[verdict] = counts.get(verdict, 0) + self._cars
        self._waiting.clear()
        return counts

    def _judged(self, new: Odometry, counts: dict[Verdict, int]) -> list[Sample]:
        """Add odometry of the next time if that of any car is accepted; count the verdicts."""
        last = self.last
        verdict = self._verdicts(new, last)
        for value, count in enumerate(np.bincount(verdict)):
            if count:
                counts[Verdict(value)] = counts.get(Verdict(value), 0) + int(count)
        if (verdict == Verdict.INVALID).all():
            return []
        fine = verdict == Verdict.USED
        since = np.full(self._cars, self._t) if last is None else last.latest
        limits, gap = self.limits, new.t - since
        broken = gap > np.where(self._refused | ~fine, limits.refused, limits.gap)
        held = np.zeros((2, self._cars)) if last is None else last[1:3]
        speed, rate = (
            np.where(fine, one, other) for one, other in zip(new[1:3], held, strict=True)
        )
        latest = np.where(fine, new.t, since)
        self._samples.append(Sample(new.t, speed, rate, since, latest, broken))
        self._refused = ~fine
        self._t = new.t
        return self._samples[-1:]

    def _verdicts(self, new: Odometry, last: Sample | None) -> NDArray[np.intp]:
        """Return (n,) verdicts on odometry that follows the last sample."""
        limits, (t, speed, rate) = self.limits, new
        finite = np.isfinite(speed) & np.isfinite(rate)
        speed, rate = np.where(finite, speed, 0.0), np.where(finite, rate, 0.0)
        with np.errstate(over="ignore"):  # infinite is beyond the limit, too
            lateral = np.abs(speed).clip(max=limits.speed) * np.abs(rate)
        turns = (np.abs(rate) > limits.yaw_rate) | (lateral > limits.lateral_acceleration)
        verdict = np.full(self._cars, Verdict.USED, dtype=np.intp)
        if last is not None:
            dt = t - last.latest
            sudden = np.abs(speed - last.wheel_speed) > (
                limits.speed_margin + limits.acceleration * dt
            )
            sudden |= np.abs(rate - last.yaw_rate) > (
                limits.yaw_margin + limits.yaw_acceleration * dt
            )
            verdict[sudden] = Verdict.ACCELERATION
        verdict[turns] = Verdict.YAW_RATE
        verdict[np.abs(speed) > limits.speed] = Verdict.SPEED
        verdict[~finite] = Verdict.INVALID
        return verdict

    def at(self, t: float) -> tuple[Array, Array, Array]:
        """Return wheel speed, yaw rate and ``since`` of n cars at a time between two samples."""
        after = bisect.bisect_left(self._samples, t, key=_time)
        one, other = self._samples[max(after - 1, 0)], self._samples[after]
        share = (t - one.t) / (other.t - one.t) if other.t > one.t else 0.0
        speed, rate = (a + share * (b - a) for a, b in zip(one[1:3], other[1:3], strict=True))
        return speed, rate, other.since

    def between(self, begin: float, end: float) -> list[Sample]:
        """Return the samples after one time and up to another [s]."""
        first, last = (bisect.bisect_right(self._samples, t, key=_time) for t in (begin, end))
        return self._samples[first:last]

    def forget(self, t: float) -> None:
        """Drop the samples that are not needed from a time on [s]."""
        del self._samples[: max(bisect.bisect_right(self._samples, t, key=_time) - 1, 0)]

    def gap_noise(
        self, begin: float, end: float, since: Array, speed: Array
    ) -> tuple[Array, Array]:
        """Return (n,) variances that positions [m^2] and heading [rad^2] gain from time to time.

        A car that is not observed for a time T brakes or accelerates by a, and turns in by w' with
        the standard deviations of ``CarLimits``, so that it ends up by a T^2 / 2 along, by
        v w' T^3 / 6 across, and by w' T^2 / 2 in the heading from where it is predicted. The
        variances of successive steps add up to these squares. Up to ``unnoticed``, there are none.

        Args:
            begin: of a step [s].
            end: of it [s].
            since: (n,) time of the last sample before it [s].
            speed: (n,) [m/s].
        """
        free = since + self.limits.unnoticed
        if (end <= free).all():
            return np.zeros(len(since)), np.zeros(len(since))
        one, other = ((t - free).clip(0.0, LONGEST) for t in (begin, end))
        a, turn = self.limits.sigma_acceleration, self.limits.sigma_yaw_acceleration
        fourth = other**4 - one**4
        across = (turn * speed / 6) ** 2 * (other**6 - one**6)
        return a**2 / 4 * fourth + across, turn**2 / 4 * fourth


def _time(one: Sample) -> float:
    return one.t
