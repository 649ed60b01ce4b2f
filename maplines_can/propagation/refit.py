"""Refit: the parameters of map lines as functions of the pose, for many poses at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import ffi, lib
from ..core.memory import pointer
from ..values.arrays import floats
from ..values.errors import IllPosedError
from ..values.line import PARAMETERS
from ..values.map_error import MapError
from ..values.polyline import Polyline
from .paths import (
    MAX_TURN,
    check_given,
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
    For each pose the stretch is transformed to the ego frame (u, v), and a
    cubic ``v = p0 + p1 u + p2 u^2 + p3 u^3`` is fitted by least squares (Map Line Interface,
    section III-A) at 64 Chebyshev nodes of the range, interpolated on the line. The result
    therefore depends on the line and not on the spacing of its points, and deviates little more
    than the best cubic. A rotation mixes u and v linearly. Each sum of the normal equations is
    therefore a polynomial in the cosine and sine of the rotation, whose coefficients are computed
    once: the cost per pose does not depend on the number of points.

    Args:
        polyline: the line; or several lines, for which each call returns parameters.
        pose: (3,) mean pose (e_x [m], e_y [m], e_h [rad]) in the map frame.
        window: (x_min, x_max) in the ego frame of ``pose``; the line in it is used [m].
        map_error: error of the map points; transforms add its effect to the covariance.
        max_misfit: largest deviation of the cubic from the line within ``x_range`` [m]. What
            remains of it is covered by ``noise_cov``. Infinite for a fit to all of the window
            without that cover, as in the paper.
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
        self.pose = np.array(checked_pose(pose))
        look = [*self.pose.tolist(), *checked_window(window), max_turn]
        settings = [max_misfit, room, step, *numbers_of(map_error)]
        paths = paths_near(lines, lib.maplines_look_from, look)
        memory, left_out = refits_memory(len(lines)), ffi.new("uint8_t[]", len(lines))
        place = pointer(memory)
        count = lib.maplines_refit_lines(
            paths.memory, look, settings, paths.work(), left_out, place
        )
        check_given(list(left_out), window)
        if count < len(lines):
            raise IllPosedError(
                f"no cubic follows line {count} of {len(lines)} within {max_misfit:g} m in the "
                f"window {window} m; its coordinates are too large, or max_misfit is too small"
            )
        has_noise = map_error is not None or max_misfit < np.inf
        self._lines = Refits(memory, count, has_noise=has_noise)
        self._trailing = () if isinstance(polyline, Polyline) else (count,)

    @property
    def x_range(self) -> NDArray[np.float64]:
        """(2,), or (L, 2): range that the cubics describe, in the frame of the mean pose [m]."""
        return self._lines.x_range.reshape(*self._trailing, 2)

    @property
    def misfit(self) -> NDArray[np.float64]:
        """(), or (L,): largest deviation of the cubic from the line in its range [m]."""
        return self._lines.misfit.reshape(self._trailing)

    @property
    def points(self) -> NDArray[np.float64]:
        """(L, K, 2) points to which the cubics are fitted, in the frame of the mean pose [m]."""
        return self._lines.points

    @property
    def is_across(self) -> NDArray[np.bool_]:
        """(), or (L,): whether the line is nearly perpendicular to the x axis of the mean pose."""
        return self._lines.is_across.reshape(self._trailing)

    @property
    def noise_cov(self) -> NDArray[np.float64] | None:
        """(4, 4), or (L, 4, 4): covariance of map error and misfit; None without both."""
        found = self._lines.noise_cov
        return None if found is None else found.reshape(*self._trailing, 4, 4)

    @property
    def quartic(self) -> NDArray[np.float64]:
        """(), or (L,): coefficient of the polynomial T_4 that the cubic leaves of the line [m]."""
        return self._lines.quartic.reshape(self._trailing)

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
                _raise_ill_posed(poses)
            return line
        if poses.ndim != 2 or poses.shape[1] != 3:
            raise ValueError(f"poses must have shape (N, 3) or (3,), got {poses.shape}")
        return self._lines(poses).reshape(len(poses), *self._trailing, len(PARAMETERS))


def refits_memory(lines: int) -> NDArray[np.float64]:
    """Return memory for the refits of lines: numbers without pointers, so it may be copied."""
    return np.empty(lib.maplines_refits_size(lines))


class Refits:
    """Lines as functions of the pose: a view of the memory that the core has set.

    Args:
        memory: as of ``refits_memory``.
        count: number of lines L in it.
        has_noise: whether they have a covariance of map error and misfit.
    """

    def __init__(self, memory: NDArray[np.float64], count: int, *, has_noise: bool) -> None:
        self._memory, self.count = memory, n = memory, count
        fields = np.empty((21 + 2 * POINTS) * n)
        lib.maplines_refit_fields(pointer(memory), pointer(fields))
        fields.setflags(write=False)
        self.x_range = fields[: 2 * n].reshape(n, 2)  #: (L, 2)
        self.misfit = fields[2 * n : 3 * n]  #: (L,)
        self.is_across = fields[3 * n : 4 * n].astype(bool)  #: (L,)
        self.quartic = fields[4 * n : 5 * n]  #: (L,)
        #: (L, 4, 4), or None
        self.noise_cov = fields[5 * n : 21 * n].reshape(n, 4, 4) if has_noise else None
        self.points = fields[21 * n :].reshape(n, POINTS, 2)  #: (L, K, 2)

    def __call__(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (N, L, 4) lines for (N, 3) poses; NaN where they are no functions of x."""
        values, given = np.empty((len(poses), self.count, 4)), np.ascontiguousarray(poses)
        lib.maplines_refit_values(
            pointer(self._memory), len(poses), pointer(given), pointer(values)
        )
        return values

    def extended(
        self, poses: NDArray[np.float64], *, are_displacements: bool = False
    ) -> NDArray[np.float64]:
        """Return the (N, L, 4) lines, extrapolated from the mean pose where they are none.

        Poses are (N, 3) in the frame of the map, or displacements in that of the car.
        The value is that of the farthest pose with one that halving the distance finds, extended
        linearly, so that a transform keeps the spread in that direction.

        Raises:
            IllPosedError: a line is no function of x next to the mean pose.
        """
        values, given = np.empty((len(poses), self.count, 4)), np.ascontiguousarray(poses)
        asked = len(poses), pointer(given), are_displacements, pointer(values)
        if not lib.maplines_refit_extended_values(pointer(self._memory), *asked):
            raise IllPosedError("a line is not a function of x, seen from the mean pose")
        return values


def _raise_ill_posed(pose: NDArray[np.float64]) -> NoReturn:
    raise IllPosedError(
        "the points of the line are not a function of x, or are nearly perpendicular "
        f"to the x axis, at the pose ({pose[0]:g} m, {pose[1]:g} m, "
        f"{np.degrees(pose[2]):g} deg), so no cubic y(x) describes them; shorten the window "
        "or check the heading"
    )


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
