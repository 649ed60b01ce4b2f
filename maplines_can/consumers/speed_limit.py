"""Largest speed from which a car can slow down to what the path ahead permits."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from ..propagation.refit import MAX_MISFIT
from .path import Path

#: Deviation from the path at the largest curvature of the car from which a curve is too tight [m]:
#: received lines may be ``MAX_MISFIT`` to either side of the true ones. The curvature of their
#: cubics may be far off at the ends of their ranges, such as beside a car that leaves a corner.
CUT = 2 * MAX_MISFIT


class SteeringReason(StrEnum):
    """Reason for which the car does not drive at the set speed."""

    NONE = "none"
    CURVE = "the lateral acceleration in a curve"
    RANGE = "the lines are valid for less than the stopping distance"
    BAND = "the lateral position ahead is too uncertain"
    NO_LINES = "there is no usable line of the ego lane"
    OFF_LANE = "the car is too far from the middle of the lane"
    TIGHT = "the curve is tighter than the car can steer"


@dataclass(frozen=True)
class SteeringLimits:
    """Car and limits of the lane keeping.

    Args:
        acceleration: [m/s^2].
        deceleration: by which it slows down for what is ahead [m/s^2].
        lateral_acceleration: for which the car slows down before curves [m/s^2].
        max_lateral_acceleration: of the curvature demand at the speed of the car, whatever the
            lines are [m/s^2]. The default is that of ISO 11270:2014, 5.4.
        max_lateral_jerk: its largest change [m/s^3]. The default is that of ISO 11270:2014, 5.4,
            which takes the mean over half a second; here it is for each update.
        curvature: the largest one that the car can steer [1/m].
        curvature_rate: the largest change of the demand [1/m/s].
        delay: of the actuator [s].
        lag: time constant of the actuator [s].
        reaction: time until the car brakes, for the stopping distance [s].
        preview: time ahead for which the lateral position must be known [s].
        sigma: largest standard deviation of the lateral position [m]. The default is a third of
            what a car of 1.8 m has beside it in a lane of 3.5 m.
        offset: largest offset from the path [m].
        least_speed: the car hands over rather than drive slower [m/s].

    Raises:
        ValueError: a value is not positive and finite, where delay, lag and reaction may be 0; or
            the lateral acceleration in curves is more than the largest one.
    """

    acceleration: float = 1.5
    deceleration: float = 2.5
    lateral_acceleration: float = 2.0
    max_lateral_acceleration: float = 3.0
    max_lateral_jerk: float = 5.0
    curvature: float = 0.2
    curvature_rate: float = 0.2
    delay: float = 0.1
    lag: float = 0.1
    reaction: float = 0.3
    preview: float = 1.0
    sigma: float = 0.28
    offset: float = 1.2
    least_speed: float = 1.5

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            may_be_zero = name in {"delay", "lag", "reaction"}
            if not (0 < value < math.inf or (value == 0 and may_be_zero)):
                least = "0 or more" if may_be_zero else "more than 0"
                raise ValueError(f"{name} must be finite and {least}, got {value!r}")
        if self.lateral_acceleration > self.max_lateral_acceleration:
            raise ValueError(
                f"lateral_acceleration must be max_lateral_acceleration at most, "
                f"{self.max_lateral_acceleration:g} m/s^2, got {self.lateral_acceleration:g}"
            )


def fastest(
    path: Path | None, speed: float, set_speed: float, limits: SteeringLimits
) -> tuple[SteeringReason, float]:
    """Return the largest speed now, and what limits it; 0 m/s for a handover."""
    if path is None:
        return SteeringReason.NO_LINES, 0.0
    if abs(path.offset) > limits.offset:
        return SteeringReason.OFF_LANE, 0.0
    known = path.sigma <= limits.sigma
    if not known[0]:
        return SteeringReason.BAND, 0.0
    sure = path.reach if known.all() else float(path.s[known.argmin() - 1])
    speeds = {
        SteeringReason.NONE: set_speed,
        SteeringReason.RANGE: stopping_speed(path.reach, limits),
        SteeringReason.BAND: math.inf if known.all() else sure_speed(sure, limits),
    }
    stopping = speed * limits.reaction + speed**2 / (2 * limits.deceleration)
    if tight_from(path, limits.curvature) <= stopping:
        return SteeringReason.TIGHT, 0.0
    bend = np.abs(path.curvature).clip(max=limits.curvature)
    with np.errstate(divide="ignore", over="ignore"):
        squared = limits.lateral_acceleration / bend
    squared += 2 * limits.deceleration * np.maximum(path.s - speed * limits.reaction, 0.0)
    speeds[SteeringReason.CURVE] = math.sqrt(float(squared.min()))
    reason = min(speeds, key=lambda key: speeds[key])
    fastest = speeds[reason]
    return (
        reason,
        fastest if fastest >= limits.least_speed or reason is SteeringReason.NONE else 0.0,
    )


def tight_from(path: Path, largest: float) -> float:
    """Return the distance along a path at which a curve begins that is too tight to steer [m].

    From where the path bends more than the car can, the car turns at the largest curvature, until
    it has the direction of the path again. The curve is too tight if the car is off the path by
    more than ``CUT`` then.

    Args:
        path: to follow.
        largest: curvature that the car can steer [1/m].

    Returns:
        The distance of the first such curve; infinite if there is none.

    >>> s = np.linspace(0.0, 20.0, 81)
    >>> path = Path(0.0, 0.0, s, np.where(s > 10.0, 0.25, 0.0), 0 * s)
    >>> tight_from(path, 0.2), tight_from(path, 0.25)
    (10.25, inf)
    """
    s, step = path.s, np.diff(path.s)
    begins = [math.inf]
    for side in (1, -1):
        excess = side * path.curvature - largest
        turned = np.append(0.0, np.cumsum((excess[1:] + excess[:-1]) / 2 * step))
        lacking = turned - np.minimum.accumulate(turned)  # direction, less than that of the path
        off = np.append(0.0, np.cumsum((lacking[1:] + lacking[:-1]) / 2 * step))
        begin = np.maximum.accumulate(np.where(lacking == 0, np.arange(len(s)), 0))
        begins += s[begin][off - off[begin] > CUT][:1].tolist()
    return min(begins)


def stopping_speed(distance: float, limits: SteeringLimits) -> float:
    """Return the speed whose stopping distance this is: v t + v^2 / 2 a = s [m/s].

    >>> round(stopping_speed(12.0, SteeringLimits(reaction=0.2, deceleration=5.0)), 6)
    10.0
    """
    a, t = limits.deceleration, limits.reaction
    return math.sqrt((a * t) ** 2 + 2 * a * distance) - a * t


def sure_speed(distance: float, limits: SteeringLimits) -> float:
    """Return the speed at which the lateral position is known up to a distance [m/s].

    It is known for ``preview``, and up to where the car would stop.
    """
    return min(distance / limits.preview, stopping_speed(distance, limits))
