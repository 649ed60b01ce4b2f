"""Lines of a map as one joint Gaussian in the frame of a car whose pose is uncertain."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import count

import numpy as np
from numpy.typing import NDArray

from ..values.arrays import floats
from ..values.gaussian import Gaussian
from ..values.linalg import block_diagonal, diagonal_blocks
from ..values.line import PARAMETERS, LeftOut, MapLine, Slot
from ..values.map_error import MapError
from ..values.polyline import Polyline
from ..values.scene import PoseError, Scene
from ..values.seen_lines import valid_ranges
from .certain_range import MAX_SIGMA, certain_ranges, check_max_sigma
from .map_lines import MIN_RANGE, ExtendedRefit, check_lines, ego_cov, view_of
from .refit import MAX_MISFIT, Refit
from .sigma_points import SigmaPoints
from .stretches import stretches
from .transform import Transform

#: Parameters of a line.
N = len(PARAMETERS)
#: The ends of the ranges in which the cubics are fitted are multiples of this, so that a message
#: can state them exactly [m].
STEP = 1.0
#: Most times that a line is fitted again in a shorter range, since it is uncertain at its end.
TRIALS = 8


def map_scene(
    lines: Mapping[Slot, Polyline],
    ego: Gaussian,
    *,
    correlation_time: float = math.inf,
    window: tuple[float, float] = (-20.0, 80.0),
    transform: Transform | None = None,
    map_error: MapError | None = None,
    max_misfit: float = MAX_MISFIT,
    max_sigma: float = MAX_SIGMA,
) -> Scene:
    """Return lines of the map as seen from an uncertain pose, with their joint Gaussian.

    The lines are those of ``map_lines``, but for three details. The ranges in which the cubics are
    fitted end at whole metres. A line that is uncertain far ahead is fitted again in a shorter
    range. The valid ranges leave a little more room at their ends, since they
    are computed from what a receiver knows, too, and may exceed the window by that room. All lines
    are propagated through the same points, so their joint covariance is a covariance.

    The error of the map is independent from line to line.

    Args:
        lines: the line of the map for each slot.
        ego: Gaussian over the pose (e_x [m], e_y [m], e_h [rad]) in the map frame.
        correlation_time: of the pose error [s]; infinite if it is unknown.
        window: (x_min, x_max) ahead of the mean pose that the ranges may extend to [m].
        transform: for the moments; None for ``SigmaPoints()``.
        map_error: error of the map, in addition to the error of the pose.
        max_misfit: largest deviation of a cubic from its line [m].
        max_sigma: largest standard deviation of the lateral position of a line [m]; its range ends
            where it passes this. Infinite for no limit.

    Returns:
        The lines in the order of ``lines``; ``left_out`` has the reasons of the others by slot.

    Raises:
        TypeError: ``lines`` is not a mapping from slots to polylines.
        ValueError: ``ego`` is not over three variables, or another value is out of range.

    >>> lines = {Slot.EGO_LEFT: Polyline([[-100, 1.75], [200, 1.75]]),
    ...          Slot.EGO_RIGHT: Polyline([[-100, -1.75], [200, -1.75]])}
    >>> scene = map_scene(lines, Gaussian([0, 0, 0], np.diag([0.1, 0.2, 0.01]) ** 2))
    >>> scene.centre(0.0).sigma.round(3), scene.width(0.0).sigma.round(3)
    (np.float64(0.2), np.float64(0.024))
    """
    check_lines(lines, ego)
    check_max_sigma(max_sigma)
    x_min, x_max = (floats(end, "window").item() for end in window)
    view = view_of(ego, (x_min, x_max), map_error)
    pose_error = PoseError(ego_cov(ego), correlation_time)
    slots = [Slot(slot) for slot in lines]
    if not lines:
        return _without_lines(pose_error, map_error, {})
    seen = stretches([*lines.values()], ego.mean, view.window, view.max_turn)
    left_out = {slots[i]: reason for i, reason in seen.left_out.items()}
    if not len(seen.given):
        return _without_lines(pose_error, map_error, left_out)
    heading_sigma = 0.0 if map_error is None else map_error.heading_sigma
    pose = Gaussian.trusted(np.zeros(3), pose_error.cov)
    is_shorter, uncertain, short = np.zeros((3, len(seen.given)), dtype=bool)
    for trial in count():
        refit = Refit(
            seen, ego.mean, map_error=map_error, max_misfit=max_misfit, room=view.room, step=STEP
        )
        specific_covs = (
            np.zeros((len(seen.given), N, N)) if refit.noise_cov is None else refit.noise_cov
        )
        x_ranges = valid_ranges(
            refit(ego.mean[None])[0], refit.x_range, pose_error.cov, specific_covs, heading_sigma
        )
        kept = (
            (x_ranges[:, 1] - x_ranges[:, 0] >= MIN_RANGE) & ~refit.is_across & ~short & ~uncertain
        )
        kept &= (refit.x_range % STEP == 0).all(axis=1)
        if not kept.any():
            break
        function = ExtendedRefit(refit, kept)
        mean, cov = (transform or SigmaPoints()).moments(_Flat(function, ego.mean), pose)
        means, covs = mean.reshape(-1, N), diagonal_blocks(cov, N)
        # From the means that are sent, as a receiver does.
        x_ranges = valid_ranges(
            means, refit.x_range[kept], pose_error.cov, specific_covs[kept], heading_sigma
        )
        ended = x_ranges[:, 1] - x_ranges[:, 0] < MIN_RANGE
        if ended.any():
            short[np.flatnonzero(kept)[ended]] = True
            continue
        certain = certain_ranges(means, covs, x_ranges, max_sigma)
        long = (certain != x_ranges).any(axis=1)
        if not long.any():
            break
        places = np.flatnonzero(kept)[long]
        shorter = _shorter(refit.x_range[places], x_ranges[long], certain[long])
        is_shorter[places] = True
        uncertain[places] = (trial >= TRIALS) | (np.diff(shorter)[:, 0] < MIN_RANGE)
        ends = refit.x_range.copy()
        ends[places] = np.where(uncertain[places, None], ends[places], shorter)
        seen = replace(seen, x_range=ends)
    left_out |= {slots[i]: LeftOut.TOO_SHORT for i in seen.given[~kept]}
    left_out |= {slots[i]: LeftOut.UNCERTAIN for i in seen.given[is_shorter & ~kept]}
    if not kept.any():
        return _without_lines(pose_error, map_error, left_out)
    given = [slots[i] for i in seen.given[kept]]
    # The scene checks the joint covariance, and so those of its lines.
    gaussians = map(Gaussian.trusted, means, covs)
    found = [
        MapLine(slot, gaussian, kind=lines[slot].kind, x_min=low, x_max=high)
        for slot, gaussian, (low, high) in zip(given, gaussians, x_ranges.tolist(), strict=True)
    ]
    return Scene(
        tuple(found),
        cov,
        pose_error,
        refit.x_range[kept],
        map_error,
        left_out,
        refit.quartic[kept],
        specific_covs[kept],
    )


def _shorter(
    fit_ranges: NDArray[np.float64], x_ranges: NDArray[np.float64], certain: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the (L, 2) ranges to be fitted for lines to be valid where they are certain.

    A line that is certain nowhere may be so if less of it is fitted: half of what is ahead.
    """
    car = np.clip(0.0, fit_ranges[:, 0], fit_ranges[:, 1])[:, None]
    half = car + (fit_ranges - car) / 2
    return np.where(np.isnan(certain), half, certain + (fit_ranges - x_ranges))


def _without_lines(
    pose_error: PoseError, map_error: MapError | None, left_out: dict[Slot, LeftOut]
) -> Scene:
    return Scene((), np.zeros((0, 0)), pose_error, np.zeros((0, 2)), map_error, left_out)


class _Flat:
    """The parameters of all lines as one output, so that a transform gives their joint moments.

    They are functions of the displacement in the ego frame, as at a receiver: so both take the same
    sigma points.
    """

    def __init__(self, function: ExtendedRefit, pose: NDArray[np.float64]) -> None:
        self._function, self._pose = function, pose
        c, s = math.cos(pose[2]), math.sin(pose[2])
        self._to_map = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        own = function.noise_cov
        self.noise_cov = None if own is None else block_diagonal(own)

    def __call__(self, displacements: NDArray[np.float64]) -> NDArray[np.float64]:
        poses = self._pose + displacements @ self._to_map
        return self._function(poses).reshape(len(poses), -1)
