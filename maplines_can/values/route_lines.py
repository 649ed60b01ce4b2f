"""Lines of a map along a route, for a sender that has this much of a map only."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import floats
from .elementary import sin_cos
from .line import Slot
from .polyline import Polyline

#: A car farther from the line of the route is not on it [m].
MAX_OFFSET = 10.0
#: Distances behind and ahead of the last place on the route where the next one is sought [m].
SEARCH_BEHIND, SEARCH_AHEAD = 30.0, 100.0


class RoutePlace(NamedTuple):
    """Place of a car on a route."""

    section: int
    s: float  #: position along the line of the route [m]


@dataclass(frozen=True, eq=False)
class RouteLines:
    """Lines of a map along a route, section by section: a section is a lane, or a part of one.

    Args:
        path: line of the route.
        starts: position along ``path`` at which each section starts [m]: 0, and ascending.
        sections: lines of each section, by slot.

    >>> left, right, path = (Polyline([[0, y], [64, y]]) for y in (1.75, -1.75, 0))
    >>> first, second = {Slot.EGO_LEFT: left}, {Slot.EGO_LEFT: left, Slot.EGO_RIGHT: right}
    >>> along = RouteLines(path, (0.0, 32.0), (first, second))
    >>> along.locate([48.0, 0.5, 0.0])
    RoutePlace(section=1, s=48.0)
    """

    path: Polyline
    starts: tuple[float, ...]
    sections: Sequence[Mapping[Slot, Polyline]]

    def locate(self, pose: ArrayLike, last: RoutePlace | None = None) -> RoutePlace | None:
        """Return the place on the route that is nearest to a pose; None if it is not on the route.

        A car is on the route if the line of the route is at most 10 m away, and the car heads along
        it, by less than 90 degrees to either side. A route may pass a place several times: the
        place is sought near the last one first. All operations have an order, which
        ``c/fmu/pose_input.c`` follows.

        Args:
            pose: (3,) e_x [m], e_y [m], e_h [rad] of the car in the map frame.
            last: place where the car was.

        Raises:
            ValueError: the pose does not have this shape.
        """
        pose = floats(pose, "pose")
        if pose.shape != (3,):
            raise ValueError(f"pose must have shape (3,), got {pose.shape}")
        if not np.isfinite(pose).all():
            return None
        begin, distance = self.path.points[:-1].T, self.path.distance
        step = self.path.points[1:].T - begin
        share, squared = _nearest_share(begin, step, _squared_length(step), pose[:2, None])
        sine, cosine = sin_cos(pose[2])
        is_along = step[0] * cosine + step[1] * sine > 0
        is_candidate = is_along & (squared <= MAX_OFFSET**2)
        if last is not None:
            is_near = distance[1:] >= last.s - SEARCH_BEHIND
            is_near &= distance[:-1] <= last.s + SEARCH_AHEAD
            is_near &= is_candidate
            is_candidate = is_near if is_near.any() else is_candidate
        if not is_candidate.any():
            return None
        i = int(np.where(is_candidate, squared, np.inf).argmin())
        s = float(distance[i] + share[i] * (distance[i + 1] - distance[i]))
        return RoutePlace(max(0, bisect_right(self.starts, s) - 1), s)


def _nearest_share(
    begin: NDArray[np.float64],
    step: NDArray[np.float64],
    squared: NDArray[np.float64],
    point: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where (2, n) segments are nearest to a (2, 1) point, and the squared distances.

    The places are shares of the segments, of (n,) squared lengths, from 0 to 1.
    """
    offset = point - begin
    share = offset[0] * step[0] + offset[1] * step[1]
    share /= squared
    share = np.minimum(np.maximum(share, 0.0), 1.0)
    offset -= share * step
    offset *= offset
    return share, offset[0] + offset[1]


def _squared_length(steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (n,) squared lengths of (2, n) steps, a tiny number in place of 0."""
    return np.maximum(steps[0] ** 2 + steps[1] ** 2, np.finfo(float).tiny)
