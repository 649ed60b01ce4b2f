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
    kept = list(parts[:1])
    rows = [0]
    count = len(parts[0])
    for part in parts[1:]:
        (x0, y0), (x1, y1) = kept[-1][-1].tolist(), part[0].tolist()
        is_near = math.hypot(x1 - x0, y1 - y0) <= SNAP
        rows.append(count - is_near)
        kept.append(part[1:] if is_near else part)
        count += len(kept[-1])
    line = Polyline(np.concatenate(kept), kind)
    return line, line.distance[rows].tolist()
