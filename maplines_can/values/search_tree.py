"""Search tree for the point of a long line that is nearest to another point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class SearchTree:
    """Search tree over points of a line at most a few mean spacings apart."""

    def __init__(self, points: NDArray[np.float64], distance: NDArray[np.float64]) -> None:
        from scipy.spatial import KDTree  # loads scipy, which short lines do not need

        spacing = 4 * distance[-1] / len(points)
        count = np.ceil(np.diff(distance) / spacing).astype(int) if spacing > 0 else None
        if count is not None and (count > 1).any():
            long = np.flatnonzero(count > 1)
            between = [
                np.linspace(distance[i], distance[i + 1], int(count[i]) + 1)[1:-1] for i in long
            ]
            s = np.sort(np.concatenate([distance, *between]))
            points = np.column_stack([np.interp(s, distance, p) for p in points.T])
            distance = s
        self._points, self._distance = points, distance
        self._tree = KDTree(points, balanced_tree=False)
        #: Farthest that any point of the line is from the nearest point in the tree.
        self._gap = float(np.diff(distance).max()) / 2

    def around_nearest(self, point: NDArray[np.float64], most: float) -> tuple[float, float]:
        """Return two arc lengths with the point of the line nearest to a point between them [m].

        They differ by at most ``most`` [m], or are equal.
        """
        bound, _ = self._tree.query(point)
        rows = np.array(self._tree.query_ball_point(point, (bound + self._gap) * (1 + 1e-9)))
        first, last = max(0, rows.min() - 1), min(rows.max() + 1, len(self._points) - 1)
        low, high = self._distance[first], self._distance[last]
        if high - low <= most:
            return float(low), float(high)
        first = np.concatenate([rows, rows - 1]).clip(0, len(self._points) - 2)
        begin = self._points[first].T
        step = self._points[first + 1].T - begin
        share, squared = nearest_share(begin, step, squared_length(step), point[:, None])
        best = squared.argmin()
        i = first[best]
        s = self._distance[i] + share[best] * (self._distance[i + 1] - self._distance[i])
        return float(s), float(s)


def nearest_share(
    begin: NDArray[np.float64],
    step: NDArray[np.float64],
    squared: NDArray[np.float64],
    point: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where each of (2, n) segments is nearest to a point, and the squared distances.

    The places are shares of the segments from 0 to 1. ``squared`` are the (n,) squared lengths of
    the segments, and the point is (2, 1).
    """
    offset = point - begin
    share = offset[0] * step[0] + offset[1] * step[1]
    share /= squared
    share = np.minimum(np.maximum(share, 0.0), 1.0)
    offset -= share * step
    offset *= offset
    return share, offset[0] + offset[1]


def squared_length(steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (n,) squared lengths of (2, n) steps, a tiny number in place of 0."""
    return np.maximum(steps[0] ** 2 + steps[1] ** 2, np.finfo(float).tiny)
