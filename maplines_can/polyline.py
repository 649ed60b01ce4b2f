"""Map lines as point sequences, and the points of them near the car."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import floats, number_text

#: Limit of ``Polyline.resampled``; 10^7 points take 160 MB.
MAX_POINTS = 10**7


@dataclass(frozen=True, eq=False)
class Polyline:
    """Points of one map line, in or against the driving direction.

    Args:
        points: (n, 2) finite, n >= 2, in the map frame [m].

    Raises:
        ValueError: the shape is wrong, or a value is not finite.

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
        """(n,) arc length from the first point to each point [m]."""
        return np.append(0.0, np.hypot(*np.diff(self.points, axis=0).T).cumsum())

    @property
    def length(self) -> float:
        """Length of the line [m]."""
        return float(self.distance[-1])

    def resampled(self, spacing: float) -> Polyline:
        """Return the line with evenly spaced points, at most ``spacing`` [m] apart.

        Raises:
            ValueError: ``spacing`` is not positive, or asks for more than 10^7 points.

        >>> Polyline([[0, 0], [10, 0]]).resampled(2.5).points[:, 0]
        array([ 0. ,  2.5,  5. ,  7.5, 10. ])
        """
        if not spacing > 0:
            raise ValueError(f"spacing must be more than 0 m, got {number_text(spacing)}")
        spacing = floats(spacing, "spacing").item()
        distance = self.distance
        if distance[-1] > MAX_POINTS * spacing:
            raise ValueError(
                f"spacing must be {distance[-1] / MAX_POINTS:g} m or more for a line of "
                f"{distance[-1]:g} m ({MAX_POINTS:g} points), got {spacing!r}"
            )
        s = np.linspace(0, distance[-1], max(1, int(np.ceil(distance[-1] / spacing))) + 1)
        return Polyline(np.column_stack([np.interp(s, distance, p) for p in self.points.T]))

    def window(self, pose: ArrayLike, x_min: float, x_max: float) -> NDArray[np.float64]:
        """Return the (k, 2) points near the car with x_min <= x <= x_max in the ego frame [m].

        These are the consecutive points around the one nearest to the car. If the
        road returns to the car's surroundings, as in a hairpin, its other branch is
        excluded. The result is empty if no point lies in the window.

        Args:
            pose: (3,) e_x [m], e_y [m], e_h [rad] of the car in the map frame.
            x_min: start of the window in the ego frame [m].
            x_max: end of the window in the ego frame [m].

        Raises:
            ValueError: ``pose`` is not finite or not of shape (3,).
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
    """Return (n,) which points ``Polyline.window`` takes from each of several lines.

    The lines are (n, 2) concatenated points in the ego frame [m], and the number of each line's.
    """
    x, y = ego.T
    inside = (x_min <= x) & (x <= x_max)
    off = np.where(inside, np.hypot(x - min(max(0.0, x_min), x_max), y), np.inf)
    gaps = np.cumsum(~inside)  # constant along each run of points inside the window
    stretch = np.empty_like(gaps)  # that constant for the selected run of each line
    start = 0
    for length in lengths:
        line = slice(start, start + length)
        stretch[line] = gaps[start + off[line].argmin()]
        start += length
    return inside & (gaps == stretch)


def to_ego(points: ArrayLike, pose: ArrayLike) -> NDArray[np.float64]:
    """Transform (..., 2) points [m] from the map frame to the frame of a car at ``pose``.

    The pose is (3,) e_x [m], e_y [m], e_h [rad], heading counter-clockwise from the map's x axis.

    >>> to_ego([[0.0, 5.0]], [0.0, 0.0, np.pi / 2]).round(9) + 0.0
    array([[5., 0.]])
    """
    e_x, e_y, e_h = floats(pose, "pose")
    c, s = np.cos(e_h), np.sin(e_h)
    return (floats(points, "points") - [e_x, e_y]) @ np.array([[c, -s], [s, c]])
