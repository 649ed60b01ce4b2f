"""Lines of a scene as a message can state them, and the parts of their covariances."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...values.errors import IllPosedError
from ...values.fixed_order import congruence, eigen, inverse, product
from ...values.linalg import block_diagonal, diagonal_blocks
from ...values.line import MIN_RANGE, LeftOut
from ...values.scene import Scene
from ...values.seen_lines import SeenLines, bases
from .code import Array
from .nearest_line import is_within, nearest_line, slope_error
from .scene_code import SceneCode

#: Largest standard deviation of a line that is encoded: no D_i covers more, and none overflows.
LARGEST = 1e50
Mask = NDArray[np.bool_]


class StatedLines(NamedTuple):
    """Parts of lines that a message can state; anything for the lines that are left out."""

    means: Array  #: (L, 4) within the ranges of the message
    ranges: Array  #: (L, 2) [m]
    quartics: Array  #: (L,) [m]
    left_out: dict[int, LeftOut]  #: lines of which the message can state no part


class CovarianceParts(NamedTuple):
    """Parts of the covariances of the lines of a scene; 0 for those that do not fit."""

    J: Array  #: (L, 4, 4) derivatives of ``bases``
    due_to_pose: Array  #: (L, 4, 4)
    specific: Array  #: (L, 4, 4) line-specific, with the excess
    excess: Array  #: (L, 4, 4) squares of the errors of means that exceed the message

    @classmethod
    def of(cls, scene: Scene, stated: StatedLines, fits: NDArray[np.bool_]) -> CovarianceParts:
        """Return the parts of a scene."""
        lines = len(scene.lines)
        J, due_to_pose, specific = np.tile(np.eye(4), (lines, 1, 1)), *np.zeros((2, lines, 4, 4))
        error = np.where(fits[:, None], slope_error(scene.means, stated.means), 0.0)
        excess = error[:, :, None] * error[:, None]
        if fits.any():
            J[fits] = bases(stated.means[fits], stated.ranges[fits])
            seen = SeenLines(scene.means[fits], stated.ranges[fits], stated.quartics[fits])
            due_to_pose[fits] = diagonal_blocks(seen.spread(scene.pose_error.cov), 4)
            if scene.specific_covs is not None:
                specific[fits] = scene.specific_covs[fits]
            else:
                specific[fits] = _positive_part(
                    diagonal_blocks(scene.cov, 4)[fits] - due_to_pose[fits], J[fits]
                )
        return cls(J, due_to_pose, specific + excess, excess)

    def joint(self, scene: Scene, places: NDArray[np.intp], d: Array) -> Array:
        """Return the (4 L, 4 L) joint covariance to be covered of the lines at some places.

        Args:
            scene: the lines.
            places: of lines in the scene.
            d: (L, 4) errors of their means.
        """
        keep = (4 * places[:, None] + np.arange(4)).ravel()
        true = scene.cov[np.ix_(keep, keep)] + np.outer(d, d)
        return np.asarray(true + block_diagonal(self.excess[places]))


def stated_lines(code: SceneCode, scene: Scene) -> StatedLines:
    """Return the parts of the lines of a scene that a message can state.

    Args:
        code: of records that are conditional on the pose.
        scene: the lines.
    """
    reach = np.zeros(4) if code.entries_code is None else code.entries_code.reach
    seen = can_be_seen(scene)
    left_out = reasons(~seen, LeftOut.ACROSS)
    means, ranges = scene.means.copy(), scene.fit_ranges.copy()
    within = is_within(code.mean, means)
    least = np.zeros(len(means))  # of the lengths of the ranges of other lines [m]
    for i in np.flatnonzero(seen & ~within):
        line, fit_range = scene.lines[i], scene.fit_ranges[i]
        room = max(line.x_min - fit_range[0], 0.0) + max(fit_range[1] - line.x_max, 0.0)
        least[i] = MIN_RANGE + room
        near = nearest_line(code.mean, means[i], fit_range, least[i], reach)
        if near is None:
            left_out[int(i)] = LeftOut.MEAN
        else:
            means[i], ranges[i] = near
    first, last = code.range
    ranges[:, 0] = np.ceil(ranges[:, 0]).clip(first.physical_range[0])
    ranges[:, 1] = np.floor(ranges[:, 1]).clip(max=last.physical_range[1])
    cannot = (ranges[:, 0] > first.physical_range[1]) | (ranges[:, 1] < last.physical_range[0])
    cannot |= ranges[:, 0] >= ranges[:, 1]
    cannot |= np.diff(ranges)[:, 0] < least  # rounding inwards may leave too little
    left_out = reasons(cannot, LeftOut.RANGE) | left_out
    ranges[[*left_out]] = 0.0, 1.0
    shorter = np.diff(ranges)[:, 0] / np.diff(scene.fit_ranges)[:, 0]
    square = shorter * shorter
    return StatedLines(means, ranges, scene.quartics * (square * square), left_out)


def can_be_seen(scene: Scene) -> Mask:
    """Return which lines are functions of x and have covariances that do not overflow."""
    means, variances = scene.means, scene.cov.diagonal().reshape(-1, 4)
    large = (variances > LARGEST**2) | (np.abs(means) > LARGEST)
    if scene.specific_covs is not None:
        large |= np.einsum("lii->li", scene.specific_covs) > LARGEST**2
    small = np.logical_not(large).all(axis=1)
    return seen_lines(means, scene.fit_ranges, scene.quartics, np.asarray(small))[1]


def seen_lines(
    means: Array, fit_ranges: Array, quartics: Array, among: Mask | None = None
) -> tuple[SeenLines | None, Mask]:
    """Return lines as functions of the pose, and which of those ``among`` are functions of x.

    The first is None unless all of them are.
    """
    found = fit_ranges[:, 0] < fit_ranges[:, 1]  # it may be too short for the steps of the message
    if among is not None:
        found &= among
    seen = None
    try:
        seen = SeenLines(means[found], fit_ranges[found], quartics[found])
    except IllPosedError:
        for i in np.flatnonzero(found):
            try:
                SeenLines(means[i : i + 1], fit_ranges[i : i + 1], quartics[i : i + 1])
            except IllPosedError:
                found[i] = False
    return seen if found.all() else None, np.asarray(found)


def _positive_part(matrices: Array, J: Array) -> Array:
    """Return ``linalg.positive_part`` in coordinates with derivatives J, in a fixed order."""
    values, vectors = eigen(congruence(inverse(J), matrices))
    root = product(J, vectors * np.sqrt(values.clip(0))[:, None, :])
    return product(root, root.mT)


def reasons(lines: Mask, reason: LeftOut) -> dict[int, LeftOut]:
    """Return the reason of lines, by their places."""
    return dict.fromkeys(np.flatnonzero(lines).tolist(), reason)
