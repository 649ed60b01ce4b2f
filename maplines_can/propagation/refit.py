"""Refit: the parameters of map lines as functions of the pose, for many poses at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import ffi, lib
from ..core.memory import pointer
from ..values.arrays import floats
from ..values.errors import IllPosedError
from ..values.polyline import Polyline
from ..values.scene import MapError
from .paths import (
    MAX_TURN,
    REASONS,
    check_misfit,
    checked_pose,
    checked_window,
    numbers_of,
    paths_near,
)

#: Default of the largest deviation of a cubic from its line [m].
MAX_MISFIT = 0.1
#: Points to which the cubic of a line is fitted.
POINTS = 64


class Refit:
    """Function from a pose to the cubics that map lines are, seen from there.

    The stretch of each line is selected once, in a window relative to ``pose``, so that the
    function is smooth, and shortened to the range that a cubic follows within ``max_misfit``. It is
    the line around the point nearest to the car, until it leaves the window, turns away or ends.
    Its cubic ``v = p0 + p1 u + p2 u^2 + p3 u^3`` (Map Line Interface, section III-A) is fitted by
    weighted least squares, so that its chords between the points of the map are those of the line:
    points are samples of a road, and the result depends little on their spacing. For each pose the
    cubic, and the T_4 that it leaves of the line, are transformed to the ego frame, and a cubic is
    fitted to them at 64 Chebyshev nodes. The cost per pose does not depend on the number of points.

    Args:
        polyline: the line; or several lines, for which each call returns parameters.
        pose: (3,) mean pose (e_x [m], e_y [m], e_h [rad]) in the map frame.
        window: (x_min, x_max) in the ego frame of ``pose``; the line in it is used [m].
        map_error: error of the map points; transforms add its effect to the covariance. Of their
            independent errors, the larger of the stated and of what the points show counts.
        max_misfit: largest deviation of the cubic from the line within ``x_range``, after averages
            over some metres and without what errors of the points explain [m]. What remains of it,
            and the errors that the points show, are covered by ``noise_cov``. Infinite for a fit to
            all of the window without that cover, as in the paper.
        max_turn: largest angle between a line and the x axis of ``pose`` [rad]; the line is not
            used farther along.
        room: distance behind the car at which a range begins at least, if the line does [m].
        step: of which the ends of the ranges are multiples, for lines that are long enough; 0 for
            any [m].

    Raises:
        TypeError: a line is no ``Polyline``.
        ValueError: ``pose``, ``window``, ``max_misfit``, ``room`` or ``step`` is wrong, or there is
            no line.
        IllPosedError: a line is not in the window, or is nearly perpendicular to the x axis.

    >>> road = Polyline([[x, 2.0] for x in range(0, 100, 5)])
    >>> refit = Refit(road, [0.0, 0.0, 0.0], window=(-20.0, 80.0))
    >>> refit.x_range
    array([ 0., 80.])
    >>> refit([10.0, 0.5, 0.0]).round(9) + 0.0
    array([1.5, 0. , 0. , 0. ])
    >>> refit([[0.0, 0.0, 0.1], [0.0, 0.0, 1.57]]).round(3) + 0.0  # the second is perpendicular
    array([[ 2.01, -0.1 ,  0.  ,  0.  ],
           [  nan,   nan,   nan,   nan]])
    """

    # More parameters than six: all choices of a fit, and most callers need two.
    def __init__(
        self,
        polyline: Polyline | Sequence[Polyline],
        pose: ArrayLike,
        window: tuple[float, float] = (-20.0, 80.0),
        map_error: MapError | None = None,
        *,
        max_misfit: float = MAX_MISFIT,
        max_turn: float = MAX_TURN,
        room: float = 0.0,
        step: float = 0.0,
    ) -> None:
        check_misfit(max_misfit)
        for name, value in (("room", room), ("step", step)):
            if not 0 <= value < np.inf:
                raise ValueError(f"{name} must be 0 m or more and finite, got {value!r}")
        lines = _lines(polyline)
        look = [*checked_pose(pose).tolist(), *checked_window(window), max_turn]
        settings = [max_misfit, room, step, *numbers_of(map_error)]
        paths = paths_near(lines, lib.maplines_look_from, look)
        memory, left_out = refits_memory(len(lines)), ffi.new("uint8_t[]", len(lines))
        arguments = paths.memory, look, settings, paths.work(), left_out, pointer(memory)
        count = lib.maplines_refit_lines(*arguments)
        for i, reason in enumerate(left_out):
            if reason:
                which = "the line" if len(lines) == 1 else f"line {i} of {len(lines)}"
                raise IllPosedError(
                    f"{which} cannot be given: {REASONS[reason - 1]}; the window is {window} m"
                )
        if count < len(lines):
            raise IllPosedError(
                f"no cubic follows line {count} of {len(lines)} within {max_misfit:g} m in the "
                f"window {window} m; its coordinates are too large, or max_misfit is too small"
            )
        has_noise = map_error is not None or max_misfit < np.inf
        self._set(memory, count, () if isinstance(polyline, Polyline) else (count,), has_noise)
        self.pose = np.array(look[:3])

    @classmethod
    def of_memory(cls, memory: NDArray[np.float64], lines: int, *, has_noise: bool) -> Refit:
        """Return the refits of lines that the core has set in ``refits_memory``; without a pose.

        ``has_noise`` is whether they have a covariance of map error and misfit.
        """
        refit = object.__new__(cls)
        refit._set(memory, lines, (lines,), has_noise)
        return refit

    def _set(
        self, memory: NDArray[np.float64], n: int, trailing: tuple[int, ...], has_noise: bool
    ) -> None:
        self._memory, self._count, self._trailing = memory, n, trailing
        fields = np.empty((21 + 2 * POINTS) * n)
        lib.maplines_refit_fields(pointer(memory), pointer(fields))
        fields.setflags(write=False)
        x_range, one, noise_cov, points = np.split(fields, [2 * n, 5 * n, 21 * n])
        misfit, is_across, quartic = one.reshape(3, *trailing)
        #: (2,), or (L, 2): range that the cubics describe, in the frame of the mean pose [m].
        self.x_range = x_range.reshape(*trailing, 2)
        #: (), or (L,): largest deviation of the cubic from the line in its range [m].
        self.misfit = np.asarray(misfit)
        #: (), or (L,): whether the line is nearly perpendicular to the x axis of the mean pose.
        self.is_across = np.asarray(is_across, dtype=bool)
        #: (), or (L,): coefficient of the polynomial T_4 that the cubic leaves of the line [m].
        self.quartic = np.asarray(quartic)
        #: (4, 4), or (L, 4, 4): covariance of map error and misfit; None without both.
        self.noise_cov = noise_cov.reshape(*trailing, 4, 4) if has_noise else None
        #: (L, K, 2) points to which the cubics are fitted, in the frame of the mean pose [m].
        self.points = points.reshape(n, POINTS, 2)

    def __call__(self, poses: ArrayLike) -> NDArray[np.float64]:
        """Return the lines (y_off, beta, c0, c1) for poses.

        Args:
            poses: (N, 3), or (3,) for a single pose [m, m, rad].

        Returns:
            (N, 4), or (N, L, 4) for several lines. A row is NaN if, seen from the pose, the
            points are not a function of x or nearly perpendicular to the x axis.

        Raises:
            IllPosedError: the same, for a single pose.
        """
        poses = floats(poses, "poses")
        if poses.ndim == 1:
            line = self(poses[None])[0]
            if np.isnan(line).any():
                raise IllPosedError(
                    "the points of the line are not a function of x, or are nearly perpendicular "
                    f"to the x axis, at the pose ({poses[0]:g} m, {poses[1]:g} m, "
                    f"{np.degrees(poses[2]):g} deg), so no cubic y(x) describes them; shorten the "
                    "window or check the heading"
                )
            return line
        if poses.ndim != 2 or poses.shape[1] != 3:
            raise ValueError(f"poses must have shape (N, 3) or (3,), got {poses.shape}")
        values = np.empty((len(poses), *self._trailing, 4))
        given = np.ascontiguousarray(poses)
        arguments = len(poses), pointer(given), pointer(values)
        lib.maplines_refit_values(pointer(self._memory), *arguments)
        return values

    def extended(
        self, poses: NDArray[np.float64], *, are_displacements: bool = False
    ) -> NDArray[np.float64]:
        """Return the (N, L, 4) lines, extrapolated from the mean pose where they are none.

        Poses are (N, 3) in the frame of the map, or displacements in that of the car. The value is
        that of the farthest pose with one that halving the distance finds, extended linearly, so
        that a transform keeps the spread in that direction.

        Raises:
            IllPosedError: a line is no function of x next to the mean pose.
        """
        values, given = np.empty((len(poses), self._count, 4)), np.ascontiguousarray(poses)
        arguments = len(poses), pointer(given), are_displacements, pointer(values)
        if not lib.maplines_refit_extended_values(pointer(self._memory), *arguments):
            raise IllPosedError("a line is not a function of x, seen from the mean pose")
        return values


def refits_memory(lines: int) -> NDArray[np.float64]:
    """Return memory for the refits of lines: numbers without pointers, so it may be copied."""
    return np.empty(lib.maplines_refits_size(lines))


def _lines(polyline: Polyline | Sequence[Polyline]) -> list[Polyline]:
    lines = [polyline] if isinstance(polyline, Polyline) else list(polyline)
    if not lines:
        raise ValueError("polyline must be a Polyline or a sequence of at least one, got none")
    for line in lines:
        if not isinstance(line, Polyline):
            raise TypeError(
                f"polyline must be a Polyline or a sequence of them, got {type(line).__name__}"
            )
    return lines
