"""Lane keeping on received lines: curvature and speed demand, slowing down and handing over."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..propagation.motion import Motion
from ..values.gaussian import Gaussian
from ..values.line import MapLine, Slot
from ..values.scene import Scene
from ..wire import SceneView
from .consumer import StepTimes
from .curvature_limiter import CurvatureLimiter
from .path import Path, lane_path
from .preview_control import preview_gains
from .speed_limit import SteeringLimits, SteeringReason, fastest

#: The gains are computed for speeds in these steps [m/s], at least the first one.
SPEED_STEP = 0.5
#: The offset counts as far as it demands so many times the largest change of the curvature. From 1
#: to 3 the car does not swing, from wherever it starts; the larger, the faster it corrects.
MAX_CHANGES = 3.0
#: Longest age of a line that is followed, and in a handover, until the car has stopped [s].
OLDEST, OLDEST_IN_HANDOVER = 0.5, 8.0
#: In a handover, the car brakes by so many times the deceleration for what is ahead.
HANDOVER_BRAKING = 1.5


class SteeringState(StrEnum):
    """State of the lane keeping."""

    DRIVING = "driving at the set speed"
    SLOWING = "driving below the set speed"
    HANDOVER = "the driver has to take over; the car brakes"


class Command(NamedTuple):
    """Demands of the lane keeping."""

    curvature: float  #: of the path of the rear axle, positive to the left [1/m]
    speed: float  #: [m/s]
    state: SteeringState
    reason: SteeringReason
    path: Path | None  #: as known when the actuator reacts; None if there is none


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
        period: time between two steps [s].
        set_speed: speed that the car shall have if nothing limits it [m/s]. It may be changed
            between two steps.
        route: slot of a line to follow itself, as in a lane change; None for the ego lane. It may
            be changed between two steps.
    """

    limits: SteeringLimits = field(default_factory=SteeringLimits)
    period: float = 0.05
    set_speed: float = 50 / 3.6
    route: Slot | None = None

    def __post_init__(self) -> None:
        if not 0 < self.period <= 0.2:
            raise ValueError(f"period must be more than 0 and up to 0.2 s, got {self.period!r}")
        self.reset()

    def reset(self) -> None:
        """Drive again after a handover, from the curvature of the car: a driver has steered it."""
        self._accepted: _Lines | None = None  # the last ones
        self._width: float | None = None
        self._times, self._t = StepTimes(), -math.inf
        self._limiter: CurvatureLimiter | None = None  # from the first update on
        self._speed = 0.0  # the last demand [m/s]
        self._handover = SteeringReason.NONE
        self._engaged = False  # whether it has driven yet

    def step(
        self,
        now_ns: int,
        view: SceneView | None,
        motion: Motion,
        camera: Iterable[MapLine] = (),  # noqa: ARG002 - of the interface
    ) -> Command:
        """Return the demands for the next period; see ``Consumer.step``.

        A scene without the lines that are followed is not used, nor one that is older than 0.5 s,
        or whose pose is in the future by more than a period. Camera lines are not used.

        Raises:
            ValueError: the time is not later than that of the last step, or ``set_speed`` is out
                of range.
        """
        if not 0 <= self.set_speed < math.inf:
            raise ValueError(f"set_speed must be finite and 0 m/s or more, got {self.set_speed!r}")
        t = self._times.next(now_ns)
        dt = self.period if self._t == -math.inf else t - self._t
        self._t = t
        speed = max(motion.speed, 0.0)
        actual = motion.yaw_rate / speed if speed > 0.5 else None
        limiter = self._limiter = self._limiter or self._first_demand(actual or 0.0, speed)
        actual = limiter.demand if actual is None else actual
        if self._accepted is not None:
            self._accepted = self._accepted.after(dt, motion)
        # Until the actuator reacts, the curvature tends to the last demand.
        limits = self.limits
        rest = 0.0 if limits.lag == 0 else math.exp(-limits.delay / limits.lag)
        then = limiter.demand + (actual - limiter.demand) * rest
        ahead = Motion(speed, speed * (actual + then) / 2).over(limits.delay).mean
        path, reason, most = self._follow(self._usable(view, motion), motion, ahead)
        state, reason, most = self._decide(reason, most, speed)
        self._set_speed(state, most, dt)
        wanted = limiter.demand
        if not self._engaged:
            wanted = actual
        elif path is not None:
            wanted += self._change(path, speed, then, limiter)
        demand = limiter.advance(wanted, motion.speed, dt, self.period)
        return Command(demand, self._speed, state, reason, path)

    def _follow(
        self, lines: _Lines | None, motion: Motion, ahead: NDArray[np.float64]
    ) -> tuple[Path | None, SteeringReason, float]:
        """Return the path to follow, and what it permits: the reason and the speed [m/s].

        The path is that of the new lines, or that of the last accepted ones; these also count if
        there are no others, or if they do not have the curve that is too tight.
        """
        speed = max(motion.speed, 0.0)
        path, width = self._path(lines, motion, ahead)
        reason, most = fastest(path, speed, self.set_speed, self.limits)
        if path is not None and (most > 0 or reason is SteeringReason.NONE):
            self._accepted, self._width = lines, width
            return path, reason, most
        kept, _ = self._path(self._accepted, motion, ahead)
        knows_better = path is None or (
            reason is SteeringReason.TIGHT and kept is not None and kept.reach >= path.reach
        )
        if knows_better and self._accepted is not None and self._accepted.since <= OLDEST:
            reason, most = fastest(kept, speed, self.set_speed, self.limits)
        return kept if self._engaged else path, reason, most

    def _decide(
        self, reason: SteeringReason, most: float, speed: float
    ) -> tuple[SteeringState, SteeringReason, float]:
        """Return the state, its reason, and the speed to reach [m/s], by what the path permits."""
        if self._handover is not SteeringReason.NONE:
            return SteeringState.HANDOVER, self._handover, 0.0
        if most == 0.0 and reason is not SteeringReason.NONE:
            self._handover = reason if self._engaged else SteeringReason.NONE
            return SteeringState.HANDOVER, reason, most
        if not self._engaged:  # until now, the driver has driven
            self._speed, self._engaged = speed, True
        is_free = reason is SteeringReason.NONE
        return SteeringState.DRIVING if is_free else SteeringState.SLOWING, reason, most

    def _set_speed(self, state: SteeringState, most: float, dt: float) -> None:
        """Let the demanded speed tend to the largest one [m/s]."""
        harder = HANDOVER_BRAKING if state is SteeringState.HANDOVER else 1.0
        brake = self.limits.deceleration * harder
        faster = self._speed + self.limits.acceleration * min(dt, self.period)
        self._speed = min(max(most, self._speed - brake * dt), faster)

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

    def _usable(self, view: SceneView | None, motion: Motion) -> _Lines | None:
        """Return the lines of a view; None if they are not to be used, or not any more."""
        if view is None or not view.usable or view.scene is None:
            return None
        # A line may be lost, and the first scene grows line by line.
        ego = Slot.EGO_LEFT, Slot.EGO_RIGHT
        followed = ego if self.route is None else (self.route,)
        is_seen = any(slot in view.scene.index for slot in followed)
        is_new = -self.period <= view.age <= OLDEST
        if self._handover is not SteeringReason.NONE or not is_new or not is_seen:
            return None
        return _Lines(view.scene, self.route, view.age, motion.over(view.age).mean)

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


def _composed(pose: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a pose (x, y, heading) after a further displacement in its frame."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return pose + np.array([c * step[0] - s * step[1], s * step[0] + c * step[1], step[2]])
