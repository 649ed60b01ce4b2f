"""The points of one line of the map, and what of them a car sees."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import floats, number_text

__all__ = ["Polyline", "to_ego"]

#: More than this no map has, and hardly a machine.
MOST_POINTS = 10**7


@dataclass(frozen=True, eq=False)
class Polyline:
    """Points of one line of the map, in driving order or against it.

    Args:
        points: (n, 2) finite, n >= 2 [m], in the map frame.

    Raises:
        ValueError: a shape or a value is wrong.

    >>> Polyline([[0, 0], [3, 4]]).length
    5.0
    """

    points: NDArray[np.float64]

    def __post_init__(self) -> None:
        points = np.array(floats(self.points, "points"))
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2:
            raise ValueError(f"points must have shape (n, 2) with n >= 2, got {points.shape}")
        if not np.isfinite(points).all():
            bad = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
            raise ValueError(f"points must be finite [m], but point {bad} is {points[bad]}")
        points.flags.writeable = False
        object.__setattr__(self, "points", points)

    @property
    @np.errstate(over="ignore")
    def distance(self) -> NDArray[np.float64]:
        """(n,) way along the line up to each point [m]."""
        return np.append(0.0, np.hypot(*np.diff(self.points, axis=0).T).cumsum())

    @property
    def length(self) -> float:
        """Length of the line [m]."""
        return float(self.distance[-1])

    def resampled(self, spacing: float) -> Polyline:
        """The same line with points ``spacing`` [m] apart or a little less.

        >>> Polyline([[0, 0], [10, 0]]).resampled(2.5).points[:, 0]
        array([ 0. ,  2.5,  5. ,  7.5, 10. ])
        """
        if not spacing > 0:
            raise ValueError(f"spacing must be more than 0 m, got {number_text(spacing)}")
        spacing = floats(spacing, "spacing").item()
        distance = self.distance
        if distance[-1] > MOST_POINTS * spacing:
            raise ValueError(
                f"spacing must be {distance[-1] / MOST_POINTS:g} m or more for a line of "
                f"{distance[-1]:g} m ({MOST_POINTS:g} points), got {spacing!r}"
            )
        s = np.linspace(0, distance[-1], max(1, int(np.ceil(distance[-1] / spacing))) + 1)
        return Polyline(np.column_stack([np.interp(s, distance, p) for p in self.points.T]))

    def window(self, pose: ArrayLike, x_min: float, x_max: float) -> NDArray[np.float64]:
        """(k, 2) points of the stretch near the car that has x_min <= x <= x_max [m].

        The stretch is the run of points around the one nearest to the car:
        where a road comes back near the car, its other branch is left out.
        Empty where no point of the line lies in the window.
        """
        pose = floats(pose, "pose")
        x_min, x_max = floats(x_min, "x_min").item(), floats(x_max, "x_max").item()
        if pose.shape != (3,) or not np.isfinite(pose).all():
            raise ValueError(f"pose must be finite with shape (3,), got {pose!r}")
        ego = to_ego(self.points, pose)
        return self.points[near_stretch(ego, [len(ego)], x_min, x_max)]


def near_stretch(
    ego: NDArray[np.float64], lengths: Iterable[int], x_min: float, x_max: float
) -> NDArray[np.bool_]:
    """Which points lie in the stretch of their line that ``Polyline.window`` takes.

    Args:
        ego: (n, 2) points of one or several lines, laid end to end, as seen from the car [m].
        lengths: points of each line.
        x_min: where the window begins [m].
        x_max: where it ends [m].
    """
    x, y = ego.T
    inside = (x_min <= x) & (x <= x_max)
    off = np.where(inside, np.hypot(x - min(max(0.0, x_min), x_max), y), np.inf)
    gaps = np.cumsum(~inside)  # the same number all along a run of points inside
    stretch = np.empty_like(gaps)  # the number of the run that is wanted
    start = 0
    for length in lengths:
        line = slice(start, start + length)
        stretch[line] = gaps[start + off[line].argmin()]
        start += length
    return inside & (gaps == stretch)


def to_ego(points: ArrayLike, pose: ArrayLike) -> NDArray[np.float64]:
    """(..., 2) points [m] of the map frame in the frame of a car at ``pose``.

    Args:
        points: (..., 2) in the map frame [m].
        pose: (3,) e_x [m], e_y [m], e_h [rad], heading counter-clockwise from the map's x axis.

    >>> to_ego([[0.0, 5.0]], [0.0, 0.0, np.pi / 2]).round(9) + 0.0
    array([[5., 0.]])
    """
    e_x, e_y, e_h = floats(pose, "pose")
    c, s = np.cos(e_h), np.sin(e_h)
    return (floats(points, "points") - [e_x, e_y]) @ np.array([[c, -s], [s, c]])
