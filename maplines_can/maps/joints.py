"""Joints of lines where one lane continues another."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..line import Kind
from ..polyline import Polyline

#: Ends of lines nearer to each other are one point [m].
SNAP = 0.05
#: A line ends if it continues farther away than this [m].
MAX_GAP = 0.3


def gap(line: Polyline, following: Polyline) -> float:
    """Return the distance from the end of a line to the start of another one [m]."""
    (x0, y0), (x1, y1) = line.points[-1].tolist(), following.points[0].tolist()
    return math.hypot(x1 - x0, y1 - y0)


def joined(
    parts: Sequence[NDArray[np.float64]], kind: Kind = Kind.UNKNOWN
) -> tuple[Polyline, list[float]]:
    """Return a line through the points of its parts, and the positions at which these begin [m].

    Where a part begins within ``SNAP`` of the end of the one before, its first point is left out.

    >>> line, begins = joined([np.array([[0, 0], [9, 0]]), np.array([[9, 0.01], [20, 0]])])
    >>> len(line.points), begins
    (3, [0.0, 9.0])
    """
    points = np.concatenate(parts)
    first = np.array([len(part) for part in parts[:-1]], dtype=np.intp).cumsum()
    step = points[first] - points[first - 1]
    is_near = np.hypot(step[:, 0], step[:, 1]) <= SNAP
    if is_near.any():
        keep = np.ones(len(points), bool)
        keep[first[is_near]] = False
        points = points[keep]
    line = Polyline.trusted(points, kind)
    return line, [0.0, *line.distance[first - is_near.cumsum()].tolist()]
