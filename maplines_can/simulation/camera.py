"""Simulated camera of a car on a drive: the lines of the ego lane that it sees, with its errors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..propagation import map_scene
from ..values.gaussian import Gaussian
from ..values.line import MapLine, Slot, transform_line_or_nan
from ..values.polyline import Polyline
from ..values.scene import Scene
from .truth import Y_PLACES

Array = NDArray[np.float64]

LANE = (Slot.EGO_LEFT, Slot.EGO_RIGHT)
#: Where the lane centre is evaluated [m], and the columns of ``true_lines`` of these places.
PLACES = (0.0, 20.0, 40.0)
COLUMNS = [Y_PLACES.index(int(x)) for x in PLACES]
#: Window in which a camera fits a cubic [m], with this deviation at most [m], and the range that
#: it has to see [m].
CAMERA_WINDOW, CAMERA_MISFIT, CAMERA_RANGE = (0.0, 50.0), 0.03, 25.0
#: Noise of the lines of ``CameraAtReportedPose`` [m, rad, 1/m, 1/m^2].
CAMERA_SIGMA = (0.05, 0.003, 2e-4, 2e-6)


@dataclass(frozen=True)
class Errors:
    """True errors of the sensors, of the map and of the pose; the filter is told the same ones.

    Args:
        pose_sigma: along [m], across [m], heading [rad].
        map_offset, map_heading: constant error of each line [m, rad].
        map_local: error of each line that changes along the road, over its parameters.
        map_length: length in which its correlation falls to 1/e [m].
        camera_sigma: noise of a camera line, over its parameters.
        camera_bias: offset [m], heading [rad] and curvature [1/m], Gauss-Markov processes.
        bias_time: its correlation time [s].
        false_lines: share of the camera lines that are another line 0.5 m to 2 m away.
        outage: (start, end) of an outage of the camera, as shares of the drive.
        speed_scale: relative error of the speed, constant.
        yaw_rate_bias, yaw_rate_noise: [rad/s].
    """

    pose_sigma: tuple[float, float, float] = (0.3, 0.1, 0.0035)
    map_offset: float = 0.05
    map_heading: float = 0.001
    map_local: tuple[float, ...] = (0.02, 0.001, 1e-5, 2e-6)
    map_length: float = 30.0
    camera_sigma: tuple[float, ...] = (0.05, 0.005, 5e-4, 2e-5)
    camera_bias: tuple[float, ...] = (0.05, 0.003, 3e-5)
    bias_time: float = 100.0
    false_lines: float = 0.03
    outage: tuple[float, float] = (0.35, 0.7)
    speed_scale: float = 0.003
    yaw_rate_bias: float = 0.002
    yaw_rate_noise: float = 0.005


def camera_lines(lines: Mapping[Slot, Polyline], pose: Array) -> Array:
    """Return the (2, 4) cubics that a camera without errors fits; NaN if it sees too little."""
    exact = Gaussian(pose, np.zeros((3, 3)))
    seen = map_scene(lines, exact, window=CAMERA_WINDOW, max_misfit=CAMERA_MISFIT)
    if not all(slot in seen.index for slot in LANE) or seen.x_range(LANE)[1] < CAMERA_RANGE:
        return np.full((2, 4), np.nan)
    return np.array([seen.line(slot).gaussian.mean for slot in LANE])


def camera_view(
    lines: Mapping[Slot, Polyline],
    pose: Array,
    bias: Array,
    errors: Errors,
    rng: np.random.Generator,
) -> list[MapLine]:
    """Return the lines of the ego lane that a camera sees, with its errors.

    Args:
        lines: true ones.
        pose: (3,) true one.
        bias: (3,) of the camera now: offset [m], heading [rad], curvature [1/m].
        errors: their sizes.
        rng: random numbers.
    """
    seen = camera_lines(lines, pose)
    if np.isnan(seen).any():
        return []
    found = []
    for slot, mean in zip(LANE, seen, strict=True):
        y = mean + rng.standard_normal(4) * errors.camera_sigma + np.append(bias, 0.0)
        if rng.random() < errors.false_lines:
            y[0] += rng.choice([-1, 1]) * rng.uniform(0.5, 2.0)
        cov = np.diag(np.square(errors.camera_sigma))
        found.append(MapLine(slot, Gaussian(y, cov), x_max=CAMERA_WINDOW[1] / 2))
    return found


class CameraAtReportedPose:
    """Camera of a car whose true pose differs from the reported one by a Gauss-Markov error.

    It sees the lines of received scenes, from a pose whose error is as the scene states it.

    Args:
        period: time between two images [s].
        seed: of the random numbers.
    """

    def __init__(self, period: float, seed: int = 0) -> None:
        self._period, self._rng = period, np.random.default_rng(seed)
        self._error: Array | None = None  # in units of the stated covariance

    def lines(self, scene: Scene, age: float, shift: float = 0.0) -> list[MapLine]:
        """Return the lines of the next image.

        Args:
            scene: as received.
            age: of the image, which is of the time of the scene's pose [s].
            shift: of all lines to the left [m].
        """
        rng = self._rng
        rho = math.exp(-self._period / scene.pose_error.correlation_time)
        new = rng.standard_normal(3)
        old = self._error
        self._error = new if old is None else rho * old + math.sqrt(1 - rho**2) * new
        # The true pose in the frame of the reported one.
        true = -Gaussian(np.zeros(3), scene.pose_error.cov).root @ self._error
        noise = np.diag(np.square(CAMERA_SIGMA))
        found = []
        for line in scene.lines:
            mean = transform_line_or_nan(line.gaussian.mean, true, (line.x_min, line.x_max))
            if np.isnan(mean).any():
                continue
            mean = mean + rng.standard_normal(4) * CAMERA_SIGMA
            mean[0] += shift
            gaussian, valid = Gaussian(mean, noise), (line.x_min, line.x_max)
            found.append(MapLine(line.slot, gaussian, x_min=valid[0], x_max=valid[1], age=age))
        return found


class UnitGaussMarkov:
    """First-order Gauss-Markov processes with variance 1, stationary from the first step on."""

    def __init__(self, rng: np.random.Generator, shape: tuple[int, ...]) -> None:
        self._rng, self._value = rng, rng.standard_normal(shape)

    def step(self, share: float) -> Array:
        """Return the value after this share of the correlation time."""
        noise = self._rng.standard_normal(self._value.shape)
        keep = np.exp(-share)
        self._value = keep * self._value + np.sqrt(1 - keep**2) * noise
        return self._value
