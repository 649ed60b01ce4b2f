"""Smooth path of a car along a polyline: position, heading and curvature by arc length."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..values.polyline import Polyline

#: Spacing of the points of the smooth path [m].
STEP = 0.5
#: Length scale of the smoothing [m]. It rounds a corner within about twice this length on both
#: sides. A circle of radius R becomes smaller by the fraction (SCALE / R)^6: 0.3 mm for R = 5 m.
SCALE = 1.0
#: The spline through the points leaves the chords by about this much at most [m].
MAX_BULGE = 0.05
#: Shortest spacing of inserted points [m].
MIN_SPACING = 0.1
#: Points nearer than this to the previous one are dropped [m].
SAME_POINT = 1e-6
#: Least length of the smooth path for 1 m of the polyline [m]; in a corner of 90 deg it is 0.7.
MIN_PROGRESS = 0.1
#: Longest path [m].
MAX_LENGTH = 1e6
#: Fewest cells of a path.
MIN_CELLS = 8


class SmoothPath:
    """Path with continuous heading and curvature that follows a polyline.

    A cubic spline through the points restores the curve that they sample, so that its curvature
    does not concentrate in the points. It is sampled evenly, and smoothed with a penalty on third
    differences (Whittaker 1923), which removes steps and corners that no car can follow:

        minimise  sum |p_i - q_i|^2 + (SCALE / STEP)^6 sum |third difference of p|^2

    Positions on the path are given by its own arc length. ``from_polyline`` converts distances
    along the polyline.

    Args:
        line: points of the path in driving order.

    Raises:
        ValueError: the length is 0 or more than 1000 km, or the path turns back on itself.
    """

    def __init__(self, line: Polyline) -> None:
        from scipy.interpolate import CubicHermiteSpline, CubicSpline

        if not SAME_POINT < line.length <= MAX_LENGTH:
            raise ValueError(
                f"path must have a length of more than 0 and up to {MAX_LENGTH:g} m, "
                f"got {line.length:g} m"
            )
        distance, points = _spline_points(line)
        count = max(MIN_CELLS, int(np.ceil(line.length / STEP)))
        grid = np.linspace(0.0, distance[-1], count + 1)
        sampled = (
            CubicSpline(distance, points)(grid)
            if len(points) > 2
            else (points[0] + np.outer(grid / grid[-1], points[1] - points[0]))
        )
        self._spline = CubicSpline(grid, _smoothed(sampled, SCALE / grid[1]))
        speed = np.hypot(*self._spline(grid, 1).T)
        if speed.min() < MIN_PROGRESS:
            s = float(grid[speed.argmin()])
            x, y = self._spline(s)
            raise ValueError(
                f"path turns back on itself at s = {s:.1f} m, near x = {x:.1f} m and y = {y:.1f} m,"
                " where no car can follow it"
            )
        # Simpson's rule on each cell; |p'| is within some per cent of 1 and varies slowly.
        middle = np.hypot(*self._spline((grid[1:] + grid[:-1]) / 2, 1).T)
        cells = (speed[:-1] + 4 * middle + speed[1:]) * grid[1] / 6
        self._arc = np.append(0.0, cells.cumsum())
        self._parameter = CubicHermiteSpline(self._arc, grid, 1 / speed)
        self._grid = grid
        tangent = self._spline(grid, 1)
        self._heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))

    @property
    def length(self) -> float:
        """Arc length of the path [m]."""
        return float(self._arc[-1])

    def from_polyline(self, distance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the arc lengths on the path at distances along the polyline [m]."""
        return np.interp(distance, self._grid, self._arc)

    def pose(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (..., 3) poses x [m], y [m], heading [rad] at (...,) arc lengths.

        The heading is continuous along the path; it may leave [-pi, pi].
        """
        u = self._parameter(s)
        dx, dy = np.moveaxis(self._spline(u, 1), -1, 0)
        near = np.interp(u, self._grid, self._heading)
        turn = np.arctan2(dy, dx) - near
        heading = near + turn - 2 * np.pi * np.rint(turn / (2 * np.pi))
        return np.concatenate([self._spline(u), heading[..., None]], axis=-1)

    def curvature(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (...,) curvatures at (...,) arc lengths [1/m], positive to the left."""
        u = self._parameter(s)
        dx, dy = np.moveaxis(self._spline(u, 1), -1, 0)
        ddx, ddy = np.moveaxis(self._spline(u, 2), -1, 0)
        return np.asarray((dx * ddy - dy * ddx) / np.hypot(dx, dy) ** 3)


def _smoothed(points: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    """Return (n, 2) points, smoothed with a penalty on their third differences.

    Args:
        points: (n, 2), evenly spaced, n >= 4.
        scale: length scale, in units of the spacing.
    """
    from scipy.linalg import solveh_banded

    third = np.array([-1.0, 3.0, -3.0, 1.0])
    bands = np.zeros((4, len(points)))  # of the symmetric matrix I + scale^6 D'D, by diagonal
    for i in range(4):
        for j in range(i, 4):
            bands[j - i, i : len(points) - 3 + i] += third[i] * third[j]
    bands *= scale**6
    bands[0] += 1.0
    return np.asarray(solveh_banded(bands, points, lower=True))


def _spline_points(line: Polyline) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return distances and points of a polyline, with points inserted into long segments.

    A spline through a long straight segment beside short ones, or through a corner, would swing
    out. The spacing at a point is that of the shorter segment beside it, and less if the line turns
    there by more than the spacing permits. It doubles from point to point away from there.
    """
    keep = np.append(0, 1 + np.flatnonzero(np.diff(line.distance) > SAME_POINT))
    distance, points = line.distance[keep], line.points[keep]
    length = np.diff(distance)
    x, y = np.diff(points, axis=0).T
    turn = np.abs(np.arctan2(x[:-1] * y[1:] - y[:-1] * x[1:], x[:-1] * x[1:] + y[:-1] * y[1:]))
    spacing = np.minimum(np.append(np.inf, length), np.append(length, np.inf))
    with np.errstate(divide="ignore"):
        spacing[1:-1] = np.minimum(spacing[1:-1], 8 * MAX_BULGE / turn)
    spacing = spacing.clip(min=MIN_SPACING)
    least = np.minimum(spacing[:-1], spacing[1:])
    inserted = [
        _graded(distance[i], distance[i + 1], spacing[i], spacing[i + 1])
        for i in np.flatnonzero(length > 2 * least)
    ]
    s = np.unique(np.concatenate([distance, *inserted]))
    return s, np.column_stack([np.interp(s, distance, values) for values in points.T])


def _graded(begin: float, end: float, first: float, last: float) -> NDArray[np.float64]:
    """Return positions between two ends whose spacing doubles away from each of them."""
    middle = (begin + end) / 2
    steps = 2.0 ** np.arange(1, 64) - 1
    up, down = begin + first * steps, end - last * steps
    return np.concatenate([up[up < middle], down[down > middle]])
