"""Plausibility check: received map lines against the lines of a camera."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Chebyshev
from numpy.typing import NDArray

from ..propagation.motion import Motion
from ..values.gaussian import Gaussian
from ..values.linalg import block_diagonal, positive_part
from ..values.line import (
    PARAMETERS,
    MapLine,
    Slot,
    lateral,
    lateral_jacobian,
    transform_line_or_nan,
)
from ..values.scene import Scene
from ..wire import SceneView
from .consumer import StepTimes, age_of
from .residual_filter import SLOW, CameraNoise, ResidualModel, threshold
from .residual_test import ConsistencyTest

#: Distances ahead at which lines are compared, less where a line is shorter [m].
STATIONS = (2.0, 20.0)
#: Shortest distance between both [m].
MIN_LENGTH = 4.0
#: Lines are compared beside the car and ahead, not behind [m].
BEHIND = -2.0
#: Least standard deviation of the line-specific error of a map line [m].
OWN_SIGMA = 0.01
#: Shortest and longest correlation time of the pose error if its sender does not know it [s].
UNKNOWN_TIMES = (1.0, 600.0)
#: A map line that moves by more than this from one image to the next, beside the car, is another
#: one, such as after a lane change: half of the least width of a lane [m].
OTHER_LINE = 1.0
#: Probability that the remaining lines are less plausible than the limit for ``Check.suspect``.
REMAINING = 1e-3


class Outcome(StrEnum):
    """Result of a check."""

    CONSISTENT = "map lines and camera lines agree"
    INCONSISTENT = "map lines and camera lines contradict each other"
    UNCHECKED = "there is no map line that the camera sees, too"


class Check(NamedTuple):
    """Result of the check in one cycle."""

    outcome: Outcome
    raised: bool  #: the contradiction begins in this cycle
    statistic: float  #: the largest one of this cycle, in units of its threshold
    slots: tuple[Slot, ...]  #: lines that were compared
    #: in an alarm, the only line without which this cycle is plausible, if there is one
    suspect: Slot | None


@dataclass(frozen=True)
class CameraBias:
    """Standard deviations of the lasting errors of a camera, common to its lines.

    They are not in the covariances of its lines, which are those of one image.

    Args:
        offset: [m].
        heading: [rad].
    """

    offset: float = 0.03
    heading: float = 0.002

    def __post_init__(self) -> None:
        for name, unit in (("offset", "m"), ("heading", "rad")):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(
                    f"{name} must be finite and 0 {unit} or more, got {getattr(self, name)!r}"
                )

    @property
    def cov(self) -> NDArray[np.float64]:
        """(3, 3) covariance of the equivalent pose error: along, across, heading."""
        return np.diag([0.0, self.offset**2, self.heading**2])


@dataclass
class PlausibilityCheck:
    """Check of received map lines against the lines of a camera, once per image.

    Compared are the lateral positions 2 m and 20 m ahead, or less if a line is shorter. Their
    differences are due to the pose error of the scene, which all lines share for its correlation
    time, to the line-specific error of each map line, to a bias of the camera, and to the noise of
    the image. See ``ConsistencyTest`` for the test and ``ResidualFilter`` for the model.

    The line-specific error of a map line is taken to last for any time from 1 s to 30 s, and the
    bias of the camera for 30 s. The pose error may last for longer than its sender states, and the
    noise of the camera for more than an image, with outliers. All of this delays a detection: who
    knows more states less.

    Args:
        false_alarms: expected number [1/h].
        camera_bias: lasting errors of the camera.
        camera_noise: what is known of the noise of an image.
        longest_pose_time: the pose error lasts for any time from the stated one to this [s]; 0: for
            the stated time.

    Raises:
        ValueError: the number is not more than 0 and at most 10, or the time is out of range.

    >>> from maplines_can.consumers import scene_view
    >>> from maplines_can.consumers.residual_filter import WHITE_NOISE
    >>> from maplines_can.values.scene import PoseError
    >>> pose = PoseError(np.diag([0.1, 0.1, 0.002]) ** 2, correlation_time=5.0)
    >>> line = MapLine(0, Gaussian([1.75, 0, 0, 0], np.diag([0.011, 4e-6, 0, 0])))
    >>> scene = Scene([line], line.gaussian.cov, pose, [[-20, 80]])
    >>> check = PlausibilityCheck(0.01, camera_noise=WHITE_NOISE, longest_pose_time=0.0)
    >>> seen = np.diag([0.05, 0.003, 1e-4, 1e-6]) ** 2
    >>> for k, y_off in enumerate((1.70, 1.15)):
    ...     image = [MapLine(0, Gaussian([y_off, 0, 0, 0], seen))]
    ...     check.step(50_000_000 * k, scene_view(scene), Motion(0.0, 0.0), image).outcome.name
    'CONSISTENT'
    'INCONSISTENT'
    """

    false_alarms: float = 0.01
    camera_bias: CameraBias = field(default_factory=CameraBias)
    camera_noise: CameraNoise = field(default_factory=CameraNoise)
    longest_pose_time: float = SLOW

    def __post_init__(self) -> None:
        if not 0 <= self.longest_pose_time < math.inf:
            raise ValueError(
                f"longest_pose_time must be finite and 0 s or more, got {self.longest_pose_time!r}"
            )
        self._test = ConsistencyTest(self.false_alarms, noise=self.camera_noise)
        self._times = StepTimes()
        self._t = self._compared = -math.inf
        self._turn = 0.0  # of the car since the last comparison [rad]
        self._travel = 0.0  # since then [m]
        self._fits: dict[Slot, Fit] = {}  # of the last comparison

    def step(
        self,
        now_ns: int,
        view: SceneView | None,
        motion: Motion,
        camera: Iterable[MapLine] = (),
    ) -> Check:
        """Compare the lines of an image with those of a scene; see ``Consumer.step``.

        Args:
            now_ns: time, later than that of the last step [ns].
            view: received map lines, of a pose before the image or after it.
            motion: of the car since the last step.
            camera: lines of one image, with the covariances of their noise. Their time is that of
                the newest one. Without lines, only the motion counts.

        Raises:
            ValueError: the time is not later than that of the last step.
        """
        t = self._times.next(now_ns)
        if self._t > -math.inf:
            self._turn += motion.yaw_rate * (t - self._t)
            self._travel += motion.speed * (t - self._t)
        self._t = t
        scene = None if view is None or not view.usable else view.scene
        compared = None
        if view is not None and scene is not None:
            seen = {line.slot: line for line in camera if line.is_usable}
            age = min((age_of(line, now_ns) for line in seen.values()), default=view.age)
            compared = residuals(scene, seen, motion.over(view.age - age))
        if scene is None or compared is None:
            return Check(Outcome.UNCHECKED, False, 0.0, (), None)
        slots, z, model = compared
        bias = model.H @ self.camera_bias.cov @ model.H.T
        model = model._replace(slow_cov=model.slow_cov + bias)
        keys = tuple((slot, i) for slot in slots for i in range(2))
        fits = fits_of(scene, slots)
        kept = [
            # The errors of a slot that is new are unknown anyway.
            fit_correlation(self._fits[slot], fit, self._travel, self._turn)
            if slot in self._fits
            else 1.0
            for slot, fit in fits.items()
        ]
        verdict = self._test.step(
            z,
            model,
            t - self._compared,
            pose_times(scene.pose_error.correlation_time, self.longest_pose_time),
            self._turn,
            keys,
            np.repeat(kept, 2),
        )
        self._compared, self._turn, self._travel = t, 0.0, 0.0
        self._fits = fits
        alarm = bool(verdict.alarm)
        return Check(
            Outcome.INCONSISTENT if alarm else Outcome.CONSISTENT,
            bool(verdict.raised),
            float(verdict.statistic),
            slots,
            suspect_of(z, model, slots) if alarm else None,
        )


def pose_times(stated: float, longest: float) -> tuple[float, float]:
    """Return the shortest and the longest correlation time that a pose error may have [s].

    Args:
        stated: by the sender; infinite if it is unknown [s].
        longest: what a consumer takes to be possible [s].

    >>> pose_times(5.0, 30.0), pose_times(45.0, 30.0)
    ((5.0, 30.0), (45.0, 45.0))
    """
    return UNKNOWN_TIMES if math.isinf(stated) else (stated, max(stated, longest))


class Fit(NamedTuple):
    """Cubic of a map line, and where it was fitted."""

    mean: NDArray[np.float64]  #: (4,)
    fit_range: NDArray[np.float64]  #: (2,) [m]


def fits_of(scene: Scene, slots: Iterable[Slot]) -> dict[Slot, Fit]:
    """Return the fits of some lines of a scene."""
    return {
        slot: Fit(scene.line(slot).gaussian.mean, scene.fit_ranges[scene.index[slot]])
        for slot in slots
    }


def fit_correlation(before: Fit, now: Fit, travel: float, turn: float = 0.0) -> float:
    """Return the largest correlation of the errors of two fits of the line of a slot.

    The fits have a stretch of the line in common. Each parameter of a cubic is due to another part
    of the stretch, so for four of them the correlation is taken to be the share of what both fits
    cover, to the power of four. It is 0 without such a stretch; and for another line, which is
    more than ``OTHER_LINE`` beside the first one, 2 m ahead of the car or as near as both reach.

    Args:
        before: the first fit.
        now: the second one.
        travel: distance that the car has driven between both [m].
        turn: of the car between both [rad].

    >>> line = np.zeros(4)
    >>> first, second = Fit(line, np.array([0.0, 16.0])), Fit(line, np.array([-4.0, 12.0]))
    >>> fit_correlation(first, second, travel=4.0)
    1.0
    >>> first = Fit(line, np.array([-4.0, 80.0]))
    >>> round(fit_correlation(first, first, travel=1.0), 3)
    0.909
    >>> fit_correlation(first, Fit(line + [3.5, 0, 0, 0], first.fit_range), travel=1.0)
    0.0
    """
    low, high = before.fit_range - travel
    first, last = max(low, now.fit_range[0]), min(high, now.fit_range[1])
    if last <= first:
        return 0.0
    moved = np.array([travel * math.cos(turn / 2), travel * math.sin(turn / 2), turn])
    mean = transform_line_or_nan(before.mean, moved, tuple(before.fit_range))
    at = np.array([min(max(STATIONS[0], first), last)])
    if abs(float((lateral(now.mean, at) - lateral(mean, at))[0])) > OTHER_LINE:
        return 0.0
    share = (last - first) / (max(high, now.fit_range[1]) - min(low, now.fit_range[0]))
    return float(share ** len(PARAMETERS))


def stations(low: float, high: float) -> NDArray[np.float64]:
    """Return the (2,) distances ahead at which lines are compared that are valid in a range [m].

    >>> stations(-20.0, 80.0), stations(-20.0, 9.0), stations(3.0, 5.0)
    (array([ 2., 20.]), array([2., 9.]), array([3., 5.]))
    """
    return np.array([max(low, min(STATIONS[0], high - MIN_LENGTH)), min(high, STATIONS[1])])


def residuals(
    scene: Scene,
    camera: Mapping[Slot, Gaussian | MapLine],
    displacement: Gaussian | None = None,
) -> tuple[tuple[Slot, ...], NDArray[np.float64], ResidualModel] | None:
    """Return what map lines differ from camera lines, with the model of the differences.

    Returns:
        The L slots of both, (2 L,) lateral differences [m], near and far by slot, and their model;
        None if there is no such slot.
    """
    P = scene.pose_error.cov
    slots, z, H, own, noise = [], [], [], [], []
    move = np.zeros(3) if displacement is None else displacement.mean
    moved = np.zeros((3, 3)) if displacement is None else displacement.cov
    for line in scene.lines:
        seen = camera.get(line.slot)
        if seen is None or not line.is_usable:
            continue
        gaussian = seen.gaussian if isinstance(seen, MapLine) else seen
        window = (line.x_min, line.x_max)
        i = scene.index[line.slot]
        mean = transform_line_or_nan(line.gaussian.mean, move, window)
        low, high = window[0] - move[0], window[1] - move[0]
        if isinstance(seen, MapLine):
            low, high = max(low, seen.x_min), min(high, seen.x_max)
        x = stations(low, high)
        if np.isnan(mean).any() or x[0] < BEHIND or x[1] - x[0] < MIN_LENGTH:
            continue
        rest = Chebyshev([0, 0, 0, 0, scene.quartics[i]], domain=scene.fit_ranges[i])
        y, J = lateral(mean, x) + rest(x + move[0]), lateral_jacobian(mean, x)
        slope = (lateral(mean, x + 0.1) - lateral(mean, x - 0.1)) / 0.2
        # A pose that is wrong by (along, across, heading) shifts the line by this at x.
        J_y_pose = np.column_stack([slope, -np.ones(2), -(x + y * slope)])
        J_cam = lateral_jacobian(gaussian.mean, x)
        slots.append(line.slot)
        z.append(y - lateral(gaussian.mean, x))
        H.append(J_y_pose)
        own.append(
            positive_part(J @ line.gaussian.cov @ J.T - J_y_pose @ P @ J_y_pose.T)
            + OWN_SIGMA**2 * np.eye(2)
        )
        noise.append(J_cam @ gaussian.cov @ J_cam.T + J_y_pose @ moved @ J_y_pose.T)
    if not slots:
        return None
    specific_cov = block_diagonal(own)
    model = ResidualModel(np.vstack(H), P, specific_cov, specific_cov, block_diagonal(noise))
    return tuple(slots), np.concatenate(z), model


def suspect_of(
    z: NDArray[np.float64], model: ResidualModel, slots: tuple[Slot, ...]
) -> Slot | None:
    """Return the only line without which the residuals are plausible; None if there is not one."""
    cov = model.marginal

    def is_plausible(kept: list[int]) -> bool:
        square = z[kept] @ np.linalg.solve(cov[np.ix_(kept, kept)], z[kept])
        return bool(square < threshold(REMAINING, len(kept)))

    every = range(len(z))
    if len(slots) < 2 or is_plausible([*every]):
        return None
    found = [
        slot for i, slot in enumerate(slots) if is_plausible([k for k in every if k // 2 != i])
    ]
    return found[0] if len(found) == 1 else None
