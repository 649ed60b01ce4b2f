"""Lines of a map as the core has them, and what a car sees of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import ffi, lib
from ..core.memory import new, pointer, pointers
from ..values.arrays import floats
from ..values.line import LeftOut
from ..values.polyline import INDEXED, Polyline, to_map
from ..values.scene import MapError

#: Sets of lines that are kept for the next query.
KEPT = 16
#: Largest angle between the car's x axis and a line that it sees [rad]; farther along, the line
#: is nearly parallel to the y axis, and no function y(x).
MAX_TURN: float = math.radians(65.0)
#: Reasons by their numbers in the core, from 1 on; 0 is that a line is given.
REASONS = (
    LeftOut.NOT_IN_WINDOW,
    LeftOut.ACROSS,
    LeftOut.TOO_SHORT,
    LeftOut.UNCERTAIN,
    LeftOut.FEW_POINTS,
)


class Paths(NamedTuple):
    """Lines of a map as the core has them; it only reads them, so threads share them."""

    memory: Any
    lines: int
    points: int  #: of all lines

    def work(self, together: int = 0, poses: int = 0) -> Any:
        """Return memory for a query in which so many lines are propagated together."""
        return new("double[]", lib.maplines_work_size(self.lines, self.points, together, poses))


@lru_cache(maxsize=KEPT)
def _paths(lines: tuple[Polyline, ...]) -> Paths:
    """Return lines as the core has them. A car asks for the same lines again and again."""
    points = [np.ascontiguousarray(line.points, float) for line in lines]
    distances = [np.ascontiguousarray(line.distance, float) for line in lines]
    count = [*map(len, points)]
    memory = new("double[]", lib.maplines_paths_size(len(lines), sum(count)))
    lib.maplines_prepare_paths(len(lines), count, pointers(points), pointers(distances), memory)
    return Paths(memory, len(lines), sum(count))


def point_errors(line: Polyline) -> NDArray[np.float64]:
    """Return the errors that the points of a line show, across it.

    ``map_lines`` takes the error of the points from their mean square near the car, as far as it is
    more than the stated one. The error of a point is the fourth divided difference of the five
    points about it, by its standard deviation for independent errors of 1 m (pseudo-residuals:
    Gasser, Sroka and Jennen-Steinmetz, Residual variance and residual pattern in nonlinear
    regression, Biometrika 73, 1986). Bends that are sharp for the spacing of the points count as
    errors; errors that neighbouring points have in common do not. Up to 1 m.

    Args:
        line: line of the map.

    Returns:
        (n,) errors of its n points, 0 or more [m]; NaN for two points at each end.

    >>> line = Polyline([[x, 0.05 * (x == 8)] for x in range(0, 18, 2)])
    >>> point_errors(line).round(3)
    array([  nan,   nan, 0.006, 0.024, 0.036, 0.024, 0.006,   nan,   nan])
    """
    squares = np.empty(len(line.points))
    lib.maplines_point_errors(_paths((line,)).memory, pointer(squares))
    squares[:2] = squares[-2:] = np.nan
    return np.sqrt(squares)


def paths_near(lines: Sequence[Polyline], start: Callable[..., None], query: Any) -> Paths:
    """Return lines, of long ones what is near the car of a query.

    ``start`` is the function of the core that says from where and how far lines are followed.
    """
    if any(len(line.points) > INDEXED for line in lines):
        place = ffi.new("double[12]")
        start(query, place)
        x, y, reach = place[0:3]
        lines = [line.near(np.array([x, y]), reach) for line in lines]
    return _paths(tuple(lines))


def numbers_of(map_error: MapError | None) -> tuple[float, ...]:
    """Return the error of a map as the core reads it."""
    if map_error is None:
        return (0.0, 0.0, 0.0, 0.0)
    return (1.0, map_error.point_sigma, map_error.offset_sigma, map_error.heading_sigma)


def checked_pose(pose: ArrayLike) -> NDArray[np.float64]:
    """Return a pose as an array of floats, or raise ValueError."""
    pose = floats(pose, "pose")
    if pose.shape != (3,) or not all(map(math.isfinite, pose.tolist())):
        raise ValueError(f"pose must be finite with shape (3,), got {pose!r}")
    return pose


def checked_window(window: tuple[float, float]) -> tuple[float, float]:
    """Return the ends of a window as floats [m], or raise ValueError."""
    x_min, x_max = floats(window, "window").tolist()
    if not -np.inf < x_min < x_max < np.inf:
        raise ValueError(f"window must have finite x_min < x_max [m], got {window}")
    return x_min, x_max


def check_misfit(max_misfit: float) -> None:
    """Check the largest deviation of a cubic from its line [m], or raise ValueError."""
    if not max_misfit > 0:
        raise ValueError(f"max_misfit must be more than 0 m, got {max_misfit!r}")


class Stretch(NamedTuple):
    """What a car sees of a line: a function y(x) in its frame."""

    line: int  #: which of the lines it is of
    x_range: tuple[float, float]  #: ends within the window [m]
    points: NDArray[np.float64]  #: (2, n) x, ascending but for close points, and y [m]

    def lateral(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (k,) lateral positions at (k,) x; beyond, those of the ends [m]."""
        ascending, y = np.maximum.accumulate(self.points[0]), self.points[1]
        return np.asarray(np.interp(x, ascending, y))


def stretches(
    lines: Sequence[Polyline],
    pose: ArrayLike,
    window: tuple[float, float],
    max_turn: float = MAX_TURN,
) -> list[Stretch]:
    """Return the stretches of lines that a car sees in a window.

    As for ``points_in_window``, but with a largest angle between a line and the car's x axis [rad].
    If a line returns to the car's surroundings, as in a hairpin or a roundabout, that part is
    excluded.
    """
    look = [*checked_pose(pose).tolist(), *checked_window(window), max_turn]
    paths = paths_near(lines, lib.maplines_look_from, look)
    left_out, count = ffi.new("uint8_t[]", paths.lines), ffi.new("size_t[]", paths.lines)
    x_ranges, points = np.empty((paths.lines, 2)), np.empty((2, paths.points))
    arrays = pointer(x_ranges), pointer(points[0]), pointer(points[1])
    lib.maplines_see_lines(paths.memory, look, paths.work(), left_out, count, *arrays)
    given = [i for i in range(paths.lines) if not left_out[i]]
    parts = np.split(points, np.cumsum([*count[0 : len(given)]], dtype=int), axis=1)
    rows = zip(given, x_ranges.tolist(), parts, strict=False)
    return [Stretch(line, (low, high), part) for line, (low, high), part in rows]


def points_in_window(
    line: Polyline, pose: ArrayLike, window: tuple[float, float]
) -> NDArray[np.float64]:
    """Return the (k, 2) points of a line in the map frame that a car sees in a window [m].

    The ends of the window are interpolated. The points are ordered by x in the ego frame, and there
    are none if nothing of the line is seen. The line is followed along its arc length in both
    directions from the point nearest to the car, until it leaves the window, turns more than 65 deg
    away from the car's x axis, or ends.

    >>> points_in_window(Polyline([[0, 1], [30, 1]]), [5.0, 0.0, 0.0], (-20, 10))
    array([[ 0.,  1.],
           [15.,  1.]])
    """
    seen = stretches([line], pose, window)
    if not seen:
        return np.empty((0, 2))
    low, high = seen[0].x_range
    x = seen[0].points[0]
    x = np.concatenate([[low], x[(x > low) & (x < high)], [high]])
    return to_map(np.column_stack([x, seen[0].lateral(x)]), pose)
