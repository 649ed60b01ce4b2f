"""Limits of the curvature demand: lateral acceleration and lateral jerk at the speed of the car."""

from __future__ import annotations

import math
from dataclasses import dataclass

#: Largest deceleration of a car [m/s^2]. A measured speed that falls faster is not believed.
MAX_DECELERATION = 10.0
#: Speed up to which the lateral acceleration limits nothing [m/s].
STANDSTILL = 1e-3


@dataclass
class CurvatureLimiter:
    """Limiter of a curvature demand k by the lateral acceleration a = v^2 k at the speed v.

    ::

        |k| <= curvature,     |change of k| <= rate dt
        |a| <= acceleration,  |change of a| <= jerk dt

    The limits of ISO 11270:2014, 5.4, are 3 m/s^2 and 5 m/s^3; it takes the mean of the jerk over
    half a second, here it is limited in each step.

    **The speed changes, too.** If the car gets faster, the demand is lowered as far as the limits
    of a need, even beyond ``rate``. If it gets slower, a falls by itself. No demand is
    increased to hold it up, so it may fall faster than by the jerk if the car brakes harder than
    ``deceleration``; up to that, the demand is kept so small that it does not. A measured speed
    that falls by more than ``MAX_DECELERATION`` is that of a sensor that fails: the limits then
    take the least speed that the car can have.

    Args:
        curvature: the largest one that the car can steer [1/m].
        rate: largest change of the demand [1/m/s].
        acceleration: largest lateral acceleration [m/s^2].
        jerk: largest change of the lateral acceleration [m/s^3].
        deceleration: up to which the lateral acceleration falls by the jerk at most [m/s^2].

    >>> limiter = CurvatureLimiter(0.2, 0.2, 3.0, 5.0, 4.0)
    >>> demands = [limiter.advance(0.1, speed=20.0, dt=0.05) for _ in range(20)]
    >>> demands[0] * 20**2, round(demands[-1] * 20**2, 9)
    (0.25, 3.0)
    """

    curvature: float
    rate: float
    acceleration: float
    jerk: float
    deceleration: float

    def __post_init__(self) -> None:
        self.begin(0.0, 0.0)

    def begin(self, curvature: float, speed: float) -> None:
        """Begin with a curvature [1/m] as the last demand, as far as its speed [m/s] permits it."""
        bound = self.bound(abs(speed))
        self.demand, self._speed = _clip(curvature, -bound, bound), abs(speed)

    def bound(self, speed: float) -> float:
        """Return the largest curvature at a speed [m/s]."""
        speed = max(speed, STANDSTILL)
        braking = self.jerk / (2 * self.deceleration * speed)
        return min(self.curvature, self.acceleration / speed**2, braking)

    def max_change(self, speed: float, dt: float) -> float:
        """Return the largest change of the demand within a time at a speed [1/m]."""
        return dt * min(self.rate, self.jerk / max(speed, STANDSTILL) ** 2)

    def advance(self, wanted: float, speed: float, dt: float, step: float = math.inf) -> float:
        """Return the demand that is nearest to the wanted one.

        Args:
            wanted: curvature [1/m]. If it is not a number, the demand remains as it is.
            speed: as measured [m/s].
            dt: time since the last demand [s].
            step: longest time for which the demand may change [s]. A demand that comes late jumps
                no farther than one that is in time.
        """
        last, before, dt_step = self.demand, self._speed, min(dt, step)
        speed = max(abs(speed), before - MAX_DECELERATION * dt)
        if not math.isfinite(wanted):
            wanted = last
        change = self.max_change(speed, dt_step)
        demand = _clip(wanted, last - change, last + change)
        a, most, square = last * before**2, self.jerk * dt_step, max(speed, STANDSTILL) ** 2
        low, high = (a - most) / square, (a + most) / square
        if speed < before:
            low, high = min(low, last), max(high, last)
        bound = self.bound(speed)
        self.demand = _clip(_clip(demand, low, high), -bound, bound)
        self._speed = speed
        return self.demand


def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
