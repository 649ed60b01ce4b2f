"""Lane keeping on received lines: curvature and speed demand, slowing down and handing over."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..propagation.motion import Motion
from ..propagation.refit import MAX_MISFIT
from ..values.gaussian import Gaussian
from ..values.line import Slot
from ..values.scene import Scene
from .curvature_limiter import CurvatureLimiter
from .path import Path, lane_path

#: Horizon of the preview [s].
HORIZON = 2.0
#: The gains are computed for speeds in these steps [m/s], at least the first one.
SPEED_STEP = 0.5
#: Errors that weigh the same in the cost: of the offset [m], of the heading [rad], and of the
#: lateral jerk by which they are corrected [m/s^3].
COST = (0.05, 0.05, 3.0)
#: Doublings of the steps of which the cost is added up: to a million steps.
DOUBLINGS = 20
#: Speed below which the rate of the curvature limits the corrections, and no more the jerk [m/s].
SLOW = 4.0
#: The offset counts as far as it demands so many times the largest change of the curvature. From 1
#: to 3 the car does not swing, from wherever it starts; the larger, the faster it corrects.
MAX_CHANGES = 3.0
#: Deviation from the path at the largest curvature of the car from which a curve is too tight [m]:
#: received lines may be ``MAX_MISFIT`` to either side of the true ones. The curvature of their
#: cubics may be far off at the ends of their ranges, such as beside a car that leaves a corner.
CUT = 2 * MAX_MISFIT
#: Longest age of a line that is followed, and in a handover, until the car has stopped [s].
OLDEST, OLDEST_IN_HANDOVER = 0.5, 8.0
#: In a handover, the car brakes by so many times the deceleration for what is ahead.
HANDOVER_BRAKING = 1.5


class SteeringState(StrEnum):
    """State of the lane keeping."""

    DRIVING = "driving at the set speed"
    SLOWING = "driving below the set speed"
    HANDOVER = "the driver has to take over; the car brakes"


class SteeringReason(StrEnum):
    """Reason for which the car does not drive at the set speed."""

    NONE = "none"
    CURVE = "the lateral acceleration in a curve"
    RANGE = "the lines are valid for less than the stopping distance"
    BAND = "the lateral position ahead is too uncertain"
    NO_LINES = "there is no usable line of the ego lane"
    OFF_LANE = "the car is too far from the middle of the lane"
    TIGHT = "the curve is tighter than the car can steer"


class Command(NamedTuple):
    """Demands of the lane keeping."""

    curvature: float  #: of the path of the rear axle, positive to the left [1/m]
    speed: float  #: [m/s]
    state: SteeringState
    reason: SteeringReason
    path: Path | None  #: as known when the actuator reacts; None if there is none


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


class _Lines(NamedTuple):
    """Lines that are followed, and what the car has driven since their pose."""

    scene: Scene
    route: Slot | None
    since: float  #: time since their pose [s]
    moved: NDArray[np.float64]  #: displacement of the car since then

    def after(self, dt: float, motion: Motion) -> _Lines:
        """Return them after a further time [s]."""
        moved = _composed(self.moved, motion.over(dt).mean)
        return self._replace(since=self.since + dt, moved=moved)


@dataclass
class LaneSteering:
    """Lane keeping on received lines, with a speed that they permit.

    The path is the middle of the ego lane (``lane_path``), as of the time at which the actuator
    reacts. It is followed by preview control (``preview_gains``). The speed is the largest one from
    which the car can slow down to what the path permits:

    - in curves, the lateral acceleration;
    - it must be able to stop where the valid range of the lines ends;
    - the lateral position must be known within ``limits.sigma`` for ``limits.preview`` ahead, and
      up to where it would stop.

    ::

                    limited by curve, range or band
        DRIVING  <------------------------------->  SLOWING
            |                                          |
            |  no line for 0.5 s, the band too wide at the car, range or band too short even for
            |  the least speed, car off the lane, curve too tight
            v                                          v
        HANDOVER   until ``reset``; follows the last accepted path by odometry, and brakes to a stop

    Lines are accepted if they permit to drive on. Those that make it hand over are not followed. If
    a curve is too tight, but not on the lines that were accepted last, which reach as far, it
    follows these for as long as if no others had come: the ends of cubics change from cycle to
    cycle.
    Lines that are no lane, such as those of swapped slots, count as none.

    In each state the demand stays within the largest lateral acceleration and the largest lateral
    jerk of the limits, and changes within one period at most, however late an update is
    (``CurvatureLimiter``).

    It begins in HANDOVER, with the curvature of the car, and drives as soon as the lines permit.

    Args:
        limits: of the car.
        period: time between two updates [s].
    """

    limits: SteeringLimits = field(default_factory=SteeringLimits)
    period: float = 0.05

    def __post_init__(self) -> None:
        if not 0 < self.period <= 0.2:
            raise ValueError(f"period must be more than 0 and up to 0.2 s, got {self.period!r}")
        self.reset()

    def reset(self) -> None:
        """Drive again after a handover, from the curvature of the car: a driver has steered it."""
        self._accepted: _Lines | None = None  # the last ones
        self._width: float | None = None
        self._t = -math.inf
        self._limiter: CurvatureLimiter | None = None  # from the first update on
        self._speed = 0.0  # the last demand [m/s]
        self._handover = SteeringReason.NONE
        self._engaged = False  # whether it has driven yet

    def update(
        self,
        t: float,
        scene: Scene | None,
        age: float,
        motion: Motion,
        set_speed: float,
        route: Slot | None = None,
    ) -> Command:
        """Return the demands for the next period.

        Args:
            t: time, later than that of the last update [s].
            scene: received lines; None if there are none that are usable. One without the lines
                that are followed is not used.
            age: time from the pose of the scene to ``t`` [s]. A scene is not used if it is older
                than 0.5 s, or if its pose is in the future by more than a period.
            motion: of the car.
            set_speed: speed that the car shall have if nothing limits it [m/s].
            route: slot of a line to follow itself, as in a lane change; None for the ego lane.

        Raises:
            ValueError: the time is not finite or not later, or the set speed is out of range.
        """
        if not self._t < t < math.inf:
            raise ValueError(f"t must be finite and later than {self._t:g} s, got {t!r}")
        if not 0 <= set_speed < math.inf:
            raise ValueError(f"set_speed must be finite and 0 m/s or more, got {set_speed!r}")
        limits = self.limits
        dt = self.period if self._t == -math.inf else t - self._t
        self._t = t
        speed = max(motion.speed, 0.0)
        actual = motion.yaw_rate / speed if speed > 0.5 else None
        limiter = self._limiter = self._limiter or self._first_demand(actual or 0.0, speed)
        actual = limiter.demand if actual is None else actual
        if self._accepted is not None:
            self._accepted = self._accepted.after(dt, motion)
        # Until the actuator reacts, the curvature tends to the last demand.
        rest = 0.0 if limits.lag == 0 else math.exp(-limits.delay / limits.lag)
        then = limiter.demand + (actual - limiter.demand) * rest
        ahead = Motion(speed, speed * (actual + then) / 2).over(limits.delay).mean

        lines = self._usable(scene, age, motion, route)
        path, width = self._path(lines, motion, ahead)
        reason, fastest = self._fastest(path, speed, set_speed)
        if path is not None and (fastest > 0 or reason is SteeringReason.NONE):
            self._accepted, self._width = lines, width
        else:
            kept, _ = self._path(self._accepted, motion, ahead)
            knows_better = path is None or (
                reason is SteeringReason.TIGHT and kept is not None and kept.reach >= path.reach
            )
            if knows_better and self._accepted is not None and self._accepted.since <= OLDEST:
                reason, fastest = self._fastest(kept, speed, set_speed)
            path = kept if self._engaged else path

        if self._handover is not SteeringReason.NONE:
            state, reason, fastest = SteeringState.HANDOVER, self._handover, 0.0
        elif fastest == 0.0 and reason is not SteeringReason.NONE:
            state, self._handover = (
                SteeringState.HANDOVER,
                reason if self._engaged else SteeringReason.NONE,
            )
        else:
            state = (
                SteeringState.DRIVING if reason is SteeringReason.NONE else SteeringState.SLOWING
            )
            if not self._engaged:  # until now, the driver has driven
                self._speed, self._engaged = speed, True
        brake = limits.deceleration * (HANDOVER_BRAKING if state is SteeringState.HANDOVER else 1.0)
        faster = self._speed + limits.acceleration * min(dt, self.period)
        self._speed = min(max(fastest, self._speed - brake * dt), faster)
        wanted = limiter.demand
        if not self._engaged:
            wanted = actual
        elif path is not None:
            wanted += self._change(path, speed, then, limiter)
        demand = limiter.advance(wanted, motion.speed, dt, self.period)
        return Command(demand, self._speed, state, reason, path)

    def _first_demand(self, curvature: float, speed: float) -> CurvatureLimiter:
        """Return the limiter, whose last demand is the curvature that the car has [1/m]."""
        limits = self.limits
        limiter = CurvatureLimiter(
            limits.curvature,
            limits.curvature_rate,
            limits.max_lateral_acceleration,
            limits.max_lateral_jerk,
            HANDOVER_BRAKING * limits.deceleration,
        )
        limiter.begin(curvature, speed)
        self._speed = speed
        return limiter

    def _usable(
        self, scene: Scene | None, age: float, motion: Motion, route: Slot | None
    ) -> _Lines | None:
        """Return the lines of a scene; None if they are not to be used, or not any more."""
        if scene is None or self._handover is not SteeringReason.NONE:
            return None
        # A line may be lost, and the first scene grows line by line.
        followed = (Slot.EGO_LEFT, Slot.EGO_RIGHT) if route is None else (route,)
        if not (-self.period <= age <= OLDEST and any(slot in scene.index for slot in followed)):
            return None
        return _Lines(scene, route, age, motion.over(age).mean)

    def _path(
        self, lines: _Lines | None, motion: Motion, ahead: NDArray[np.float64]
    ) -> tuple[Path | None, float | None]:
        """Return the path of lines when the actuator reacts, None if it has none, and their width.

        Args:
            lines: to follow.
            motion: of the car.
            ahead: (3,) displacement until the actuator reacts.
        """
        if lines is None or lines.since > OLDEST_IN_HANDOVER:
            return None, None
        odometry = motion.over(lines.since + self.limits.delay)
        moved = Gaussian.trusted(_composed(lines.moved, ahead), odometry.cov)
        with np.errstate(all="ignore"):  # what is not finite is no path
            path, width = lane_path(lines.scene, moved, self._width, lines.route)
        if path is None or not all(np.isfinite(values).all() for values in path):
            return None, None
        return path, width

    def _change(
        self, path: Path, speed: float, curvature: float, limiter: CurvatureLimiter
    ) -> float:
        """Return the change of the curvature demand by preview control.

        The offset counts up to that for which it alone demands ``MAX_CHANGES`` times the largest
        change of the curvature. Else the demand runs into its limits, from which it comes back too
        late, and the car swings.
        """
        steps = max(1, round(speed / SPEED_STEP))
        K, F = preview_gains(steps * SPEED_STEP, self.period, self.limits.lag)
        ahead = path.curvature_at(np.linspace(0.0, speed * self.period * (len(F) - 1), len(F)))
        largest = MAX_CHANGES * limiter.max_change(speed, self.period) / K[0]
        offset = min(max(path.offset, -largest), largest)
        return float(-K @ [offset, path.heading, curvature, limiter.demand] + F @ ahead)

    def _fastest(
        self, path: Path | None, speed: float, set_speed: float
    ) -> tuple[SteeringReason, float]:
        """Return the largest speed now, and what limits it; 0 m/s for a handover."""
        limits = self.limits
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
            SteeringReason.RANGE: _stopping_speed(path.reach, limits),
            SteeringReason.BAND: math.inf if known.all() else _sure_speed(sure, limits),
        }
        stopping = speed * limits.reaction + speed**2 / (2 * limits.deceleration)
        if _tight_from(path, limits.curvature) <= stopping:
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


def _tight_from(path: Path, largest: float) -> float:
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
    >>> _tight_from(path, 0.2), _tight_from(path, 0.25)
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


def _stopping_speed(distance: float, limits: SteeringLimits) -> float:
    """Return the speed whose stopping distance this is: v t + v^2 / 2 a = s [m/s].

    >>> round(_stopping_speed(12.0, SteeringLimits(reaction=0.2, deceleration=5.0)), 6)
    10.0
    """
    a, t = limits.deceleration, limits.reaction
    return math.sqrt((a * t) ** 2 + 2 * a * distance) - a * t


def _sure_speed(distance: float, limits: SteeringLimits) -> float:
    """Return the speed at which the lateral position is known up to a distance [m/s].

    It is known for ``preview``, and up to where the car would stop.
    """
    return min(distance / limits.preview, _stopping_speed(distance, limits))


def _composed(pose: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a pose (x, y, heading) after a further displacement in its frame."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return pose + np.array([c * step[0] - s * step[1], s * step[0] + c * step[1], step[2]])


class Gains(NamedTuple):
    """Gains of the change of the curvature demand: ``-feedback x + preview r``."""

    feedback: NDArray[np.float64]  #: (4,) of offset, heading, curvature, and the last demand
    preview: NDArray[np.float64]  #: (n,) of the curvatures of the path at the next n steps


@lru_cache(256)
def preview_gains(speed: float, period: float, lag: float) -> Gains:
    """Return the gains of optimal preview control at a speed.

    The state x is the offset from the path, the heading relative to it, the curvature of the car
    and its demand; u is the change of the demand, r the curvature of the path:

        x' = A x + B u + D r,   minimise  sum  (e / e0)^2 + (psi / psi0)^2 + (u / u0)^2

    With the solution P of the Riccati equation and the closed loop M = A - B K,

        u = -K x - (R + B^T P B)^-1 B^T (P D r_0 + M^T P D r_1 + (M^T)^2 P D r_2 + ...)

    (Tomizuka and Whitney, J. Dyn. Sys. 97, 1975, for known future references). Beyond the horizon,
    r is the last one.

    Args:
        speed: more than 0 [m/s].
        period: [s].
        lag: time constant of the actuator [s].

    >>> K, F = preview_gains(10.0, 0.05, 0.1)
    >>> bool(abs(F.sum() - K[2:].sum()) < 1e-9)  # in a circle the car stays on the path
    True
    """
    A, B, D = model(speed, period, lag)
    jerk = COST[2] * period / max(speed, SLOW) ** 2
    Q, R = np.diag([COST[0] ** -2, COST[1] ** -2, 0.0, 0.0]), np.array([[jerk**-2]])
    P = riccati(A, B @ B.T / R, Q)
    inverse = np.linalg.inv(R + B.T @ P @ B)
    K = inverse @ B.T @ P @ A
    M = A - B @ K
    steps = max(2, round(HORIZON / period))
    v = P @ D
    gains = np.empty(steps)
    for i in range(steps - 1):
        gains[i] = -(inverse @ B.T @ v).item()
        v = M.T @ v
    gains[-1] = -(inverse @ B.T @ np.linalg.solve(np.eye(4) - M.T, v)).item()
    return Gains(K[0], gains)


def riccati(
    A: NDArray[np.float64], G: NDArray[np.float64], Q: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the (n, n) stabilising solution of  P = A^T P (I + G P)^-1 A + Q,  G = B R^-1 B^T.

    P is the cost of all future steps. Doubling adds up 1, 2, 4, 8, ... of them (Chu, Fan, Lin and
    Wang, Int. J. Control 77, 2004). The solver of scipy wakes all threads of BLAS, in the cycle in
    which the car first drives at a speed.

    >>> bool(np.isclose(riccati(*np.ones((3, 1, 1))).item(), (1 + 5**0.5) / 2))
    True
    """
    P, one = Q, np.eye(len(A))
    for _ in range(DOUBLINGS):
        W = np.linalg.inv(one + G @ P)
        A, G, P = A @ W @ A, G + A @ W @ G @ A.T, P + A.T @ P @ W @ A
    return P


def model(
    speed: float, period: float, lag: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return A (4, 4), B (4, 1) and D (4, 1) of ``preview_gains``."""
    step = speed * period
    decay = 0.0 if lag == 0 else math.exp(-period / lag)
    A = np.array(
        [
            [1, step, step**2 / 2, 0],
            [0, 1, step, 0],
            [0, 0, decay, 1 - decay],
            [0, 0, 0, 1],
        ],
        dtype=float,
    )
    B = np.array([[0.0], [0.0], [1 - decay], [1.0]])
    return A, B, np.array([[-(step**2) / 2], [-step], [0.0], [0.0]])
