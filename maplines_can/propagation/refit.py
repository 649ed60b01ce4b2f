"""Refit: the parameters of map lines as functions of the pose, for many poses at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..values.arrays import floats
from ..values.errors import IllPosedError
from ..values.gaussian import Gaussian
from ..values.line import PARAMETERS
from ..values.map_error import MapError
from ..values.polyline import Polyline
from .in_c import RefitInC, refit_in_c
from .refit_model import RefitModel
from .stretches import (
    MAX_TURN,
    Stretches,
    check_given,
    checked_pose,
    stretches,
)
from .transform import Moments, Rule

#: Default of the largest deviation of a cubic from its line [m].
MAX_MISFIT = 0.1


class Refit:
    """Function from a pose to the cubics that map lines are, seen from there.

    The stretch of each line is selected once, in a window relative to ``pose``, so that the
    function is smooth (see ``stretches``), and shortened to the range that a cubic follows
    within ``max_misfit``. For each pose the stretch is transformed to the ego frame (u, v), and a
    cubic ``v = p0 + p1 u + p2 u^2 + p3 u^3`` is fitted by least squares (Map Line Interface,
    section III-A) at 64 Chebyshev nodes of the range, interpolated on the line. The result
    therefore depends on the line and not on the spacing of its points, and deviates little more
    than the best cubic. A rotation mixes u and v linearly. Each sum of the normal equations is
    therefore a polynomial in the cosine and sine of the rotation, whose coefficients are computed
    once: the cost per pose does not depend on the number of points.

    Args:
        polyline: the line; several lines, for which each call returns parameters; or stretches
            of lines that were selected before, for which ``window`` and ``max_turn`` are ignored.
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
        ValueError: ``pose``, ``window`` or ``max_misfit`` is wrong, or there is no line.
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
        polyline: Polyline | Sequence[Polyline] | Stretches,
        pose: ArrayLike,
        window: tuple[float, float] = (-20.0, 80.0),
        map_error: MapError | None = None,
        *,
        max_misfit: float = MAX_MISFIT,
        max_turn: float = MAX_TURN,
        room: float = 0.0,
        step: float = 0.0,
    ) -> None:
        if not max_misfit > 0:
            raise ValueError(f"max_misfit must be more than 0 m, got {max_misfit!r}")
        lines = polyline if isinstance(polyline, Stretches) else _lines(polyline)
        self.pose = np.array(checked_pose(pose))
        fit = (map_error, max_misfit, room, step)
        self._lines: RefitInC | RefitModel = refit_in_c(
            lines, self.pose, window, max_turn, *fit
        ) or RefitModel(_seen(lines, self.pose, window, max_turn), self.pose, *fit)
        self._trailing = () if isinstance(polyline, Polyline) else (self._lines.count,)

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

    def weighted_moments(self, gaussian: Gaussian, rule: Rule) -> Moments | None:
        """Return the moments over a pose by the points of a rule, without ``noise_cov``.

        None if they are to be computed from the values at the points.
        """
        lines = self._lines
        found = lines.weighted_moments(gaussian, rule) if isinstance(lines, RefitInC) else None
        if found is None:
            return None
        means, covs = found
        return Moments(means.reshape(*self._trailing, 4), covs.reshape(*self._trailing, 4, 4))

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
                self._raise_ill_posed(poses, None)
            return line
        if poses.ndim != 2 or poses.shape[1] != 3:
            raise ValueError(f"poses must have shape (N, 3) or (3,), got {poses.shape}")
        return self._lines(poses).reshape(len(poses), *self._trailing, len(PARAMETERS))

    def _raise_ill_posed(
        self, pose: NDArray[np.float64], window: tuple[float, float] | None
    ) -> NoReturn:
        where = "" if window is None else f" in the window [{window[0]:g}, {window[1]:g}] m"
        raise IllPosedError(
            f"the points of the line{where} are not a function of x, or are nearly perpendicular "
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


def _seen(
    lines: list[Polyline] | Stretches,
    pose: NDArray[np.float64],
    window: tuple[float, float],
    max_turn: float,
) -> Stretches:
    """Return the stretches of the lines, all of which must have one."""
    if isinstance(lines, Stretches):
        return lines
    seen = stretches(lines, pose, window, max_turn)
    check_given([seen.left_out.get(i) for i in range(len(lines))], window)
    return seen
