"""Joints of lines where one lane continues another."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import NDArray

from ..values.line import Kind
from ..values.polyline import Polyline

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
    return joined_lines([(parts, kind)])[0]


def joined_lines(
    lines: Sequence[tuple[Sequence[NDArray[np.float64]], Kind]],
) -> list[tuple[Polyline, list[float]]]:
    """Return what ``joined`` does for several lines, in less time.

    Args:
        lines: the parts and the kind of each line.
    """
    parts = [part for line, _ in lines for part in line]
    points = np.concatenate(parts)
    size = np.array([len(part) for part in parts])
    first = size.cumsum() - size
    step = points[first] - points[first - 1]
    is_near = np.hypot(step[:, 0], step[:, 1]) <= SNAP
    # Lines are next to each other in the arrays: parts i to j, and rows a to b.
    heads = list(accumulate([len(line) for line, _ in lines], initial=0))
    is_near[heads[:-1]] = False
    if is_near.any():
        keep = np.ones(len(points), bool)
        keep[first[is_near]] = False
        points = points.compress(keep, axis=0)
        first -= is_near.cumsum()
    step = points[1:] - points[:-1]
    length = np.hypot(step[:, 0], step[:, 1])
    distance = np.zeros(len(points))
    rows = [*first[heads[:-1]].tolist(), len(points)]
    for a, b in pairwise(rows):
        length[a : b - 1].cumsum(out=distance[a + 1 : b])
    starts = distance[first].tolist()
    ends = zip(lines, pairwise(rows), pairwise(heads), strict=True)
    return [
        (Polyline.trusted(points[a:b], kind, distance[a:b]), starts[i:j])
        for (_, kind), (a, b), (i, j) in ends
    ]
