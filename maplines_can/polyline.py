"""Map lines as point sequences, and the stretch of a line that a car sees ahead of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import floats, number_text
from .line import Kind, LeftOut

#: Limit of ``Polyline.resampled``; 10^7 points take 160 MB.
MAX_POINTS = 10**7
#: Largest rounding error of single-precision coordinates [m].
MAX_ROUNDING = 1e-3
#: Lines of more points keep a search tree, so that a query does not visit all points.
INDEXED = 2048
#: Most points of such a line that a query uses; if there are more near the car, it is sampled
#: evenly, in a window of 100 m at least every 0.6 m.
MOST_NEAR = 800
#: Largest angle between the car's x axis and a line that it sees [rad]; farther along, the line
#: is nearly parallel to the y axis, and no function y(x).
MAX_TURN = math.radians(65.0)
#: Length over which the direction of a line is taken [m], so that close points with small errors
#: do not count as turns.
DIRECTION_BASE = 0.5


@dataclass(frozen=True, eq=False)
class Polyline:
    """Points of one map line, in or against the driving direction.

    Its length is computed once. A line of more than 2048 points also keeps a search tree, so that
    the time of a window query hardly depends on the number of points.

    Args:
        points: (n, 2) finite, n >= 2, in the map frame [m]. Coordinates in single precision
            are accepted as long as their rounding error is at most 1 mm.
        kind: kind of marking or boundary.

    Raises:
        ValueError: the shape is wrong, a value is not finite, or single precision is too coarse.

    >>> Polyline([[0, 0], [3, 4]]).length
    5.0
    """

    points: NDArray[np.float64]
    kind: Kind = Kind.UNKNOWN
    #: (n,) arc length from the first point to each point [m].
    distance: NDArray[np.float64] = field(init=False, repr=False)
    _tree: Any = field(init=False, repr=False)

    def __post_init__(self) -> None:
        _check_precision(self.points)
        points = np.array(floats(self.points, "points"))
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2:
            raise ValueError(f"points must have shape (n, 2) with n >= 2, got {points.shape}")
        if not np.isfinite(points).all():
            bad = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
            raise ValueError(f"points must be finite [m], but point {bad} is {points[bad]}")
        with np.errstate(over="ignore"):
            distance = np.append(0.0, np.hypot(*np.diff(points, axis=0).T).cumsum())
        for name, array in (("points", points), ("distance", distance)):
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        object.__setattr__(self, "kind", Kind(self.kind))
        object.__setattr__(self, "_tree", _Tree(points, distance) if len(points) > INDEXED else None)

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
        points = np.column_stack([np.interp(s, distance, p) for p in self.points.T])
        return Polyline(points, self.kind)

    def window(self, pose: ArrayLike, x_min: float, x_max: float) -> NDArray[np.float64]:
        """Return the (k, 2) points of the line that a car sees with x_min <= x <= x_max [m].

        The line is followed along its arc length in both directions from the point nearest to the
        car, until it leaves the window, turns more than 65 deg away from the car's x axis, or
        ends. The ends of the window are interpolated. If the line returns to the car's
        surroundings, as in a hairpin or a roundabout, that part is excluded. The result is
        ordered by x in the ego frame, and empty if nothing of the line is seen.

        Args:
            pose: (3,) e_x [m], e_y [m], e_h [rad] of the car in the map frame.
            x_min: start of the window in the ego frame [m].
            x_max: end of the window in the ego frame [m].

        Raises:
            ValueError: ``pose`` is not finite or not of shape (3,), or the window is empty.
        """
        seen = stretches([self], pose, (x_min, x_max))
        if seen.left_out:
            return np.empty((0, 2))
        low, high = seen.x_range[0]
        inside = (seen.x > low) & (seen.x < high)
        x = np.concatenate([[low], seen.x[inside], [high]])
        return to_map(np.column_stack([x, seen.lateral(x[None])[0]]), pose)

    def part_near(
        self, point: NDArray[np.float64], reach: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return points, and their arc lengths, up to ``reach`` [m] from that nearest to a point.

        A line without a search tree is returned as a whole.
        """
        if self._tree is None:
            return self.points, self.distance
        s = self._tree.nearest(point)
        a, b = self.distance.searchsorted([s - reach, s + reach])
        part = slice(max(0, a - 1), b + 1)
        points, distance = self.points[part], self.distance[part]
        if len(points) > MOST_NEAR:
            rows = distance.searchsorted(np.linspace(distance[0], distance[-1], MOST_NEAR))
            points, distance = points[rows], distance[rows]
        return points, distance


class _Tree:
    """Search tree over points of a line at most a few mean spacings apart."""

    def __init__(self, points: NDArray[np.float64], distance: NDArray[np.float64]) -> None:
        from scipy.spatial import KDTree  # loads scipy, which short lines do not need

        spacing = 4 * distance[-1] / len(points)
        count = np.ceil(np.diff(distance) / spacing).astype(int) if spacing > 0 else None
        if count is not None and (count > 1).any():
            long = np.flatnonzero(count > 1)
            between = [np.linspace(*distance[i : i + 2], count[i] + 1)[1:-1] for i in long]
            s = np.sort(np.concatenate([distance, *between]))
            points = np.column_stack([np.interp(s, distance, p) for p in points.T])
            distance = s
        self._points, self._distance = points, distance
        self._tree = KDTree(points, balanced_tree=False)
        #: Farthest that any point of the line is from the nearest point in the tree.
        self._gap = float(np.diff(distance).max()) / 2

    def nearest(self, point: NDArray[np.float64]) -> float:
        """Return the arc length of the point of the line that is nearest to a point [m]."""
        bound, _ = self._tree.query(point)
        rows = np.array(self._tree.query_ball_point(point, (bound + self._gap) * (1 + 1e-9)))
        first = np.unique(np.concatenate([rows, rows - 1]).clip(0, len(self._points) - 2))
        share, squared = nearest_share(self._points[first], self._points[first + 1], point)
        best = squared.argmin()
        i = first[best]
        return float(self._distance[i] + share[best] * (self._distance[i + 1] - self._distance[i]))


@dataclass(frozen=True, eq=False)
class Stretches:
    """Stretches of map lines as a car sees them: functions y(x) in its ego frame.

    The points of all stretches are concatenated, in ascending order of x. Each stretch includes
    the points next to both ends of its range, if the line continues there.
    """

    x: NDArray[np.float64]  #: (n,) of the points [m]
    y: NDArray[np.float64]  #: (n,) of the points [m]
    line: NDArray[np.intp]  #: (n,) which of the L stretches each point belongs to
    x_range: NDArray[np.float64]  #: (L, 2) ends of the stretches within the window [m]
    given: NDArray[np.intp]  #: (L,) which of the lines each stretch is of
    left_out: dict[int, LeftOut]  #: reasons of the lines without a stretch

    def lateral(
        self, x: NDArray[np.float64], lines: NDArray[np.intp] | None = None
    ) -> NDArray[np.float64]:
        """Return (L, k) lateral positions at (L, k) positions in the ranges of all stretches.

        With ``lines``, it is (B, k) of these B of them.
        """
        lines = np.arange(len(x)) if lines is None else lines
        return np.interp(self._key(x, lines[:, None]), self._keys, self.y)

    def position(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (L, k) indices of the points at (L, k) positions, with fractions between them."""
        places = np.arange(float(len(self.x)))
        return np.interp(self._key(x, np.arange(len(x))[:, None]), self._keys, places)

    @cached_property
    def _keys(self) -> NDArray[np.float64]:
        return self._key(self.x, self.line)

    @cached_property
    def _step(self) -> float:
        return 2 * float(np.abs(self.x).max(initial=0.0)) + 1

    def _key(self, x: NDArray[np.float64], line: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return x shifted line by line, so that one interpolation serves all lines."""
        return x + line * self._step


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def stretches(
    lines: Sequence[Polyline],
    pose: ArrayLike,
    window: tuple[float, float],
    max_turn: float = MAX_TURN,
) -> Stretches:
    """Return the stretch of each line that a car sees in a window, as ``Polyline.window`` does.

    Args:
        lines: the lines of the map.
        pose: (3,) e_x [m], e_y [m], e_h [rad] of the car in the map frame.
        window: (x_min, x_max) in the ego frame [m].
        max_turn: largest angle between a line and the car's x axis [rad].

    Raises:
        ValueError: ``pose`` is not finite or not of shape (3,), or the window is empty.
    """
    pose = floats(pose, "pose")
    if pose.shape != (3,) or not np.isfinite(pose).all():
        raise ValueError(f"pose must be finite with shape (3,), got {pose!r}")
    x_min, x_max = (floats(end, "window").item() for end in window)
    if not -np.inf < x_min < x_max < np.inf:
        raise ValueError(f"window must have finite x_min < x_max [m], got {window}")
    # If the car is not in the window, the end of the window nearest to it takes its place.
    start = np.array([min(max(0.0, x_min), x_max), 0.0])
    reach = (x_max - x_min + abs(start[0])) / math.cos(max_turn)
    parts = [line.part_near(to_map(start, pose), reach) for line in lines]
    points = to_ego(np.concatenate([points for points, _ in parts]), pose)
    distance = np.concatenate([distance for _, distance in parts])
    count = np.array([len(points) for points, _ in parts])
    last = count.cumsum() - 1
    first = last + 1 - count
    gap = np.append(0.0, distance[last] - distance[first] + 1)  # longer than DIRECTION_BASE
    distance += (gap.cumsum()[:-1] - distance[first]).repeat(count)

    share, squared = nearest_share(points[:-1], points[1:], start)
    direction = _direction(points, distance, first, last, max_turn)
    direction[last[:-1]] = BETWEEN_LINES
    seen = np.abs(direction) == 1
    left_out: dict[int, LeftOut] = {}
    nearest = first.copy()
    for i, (a, b) in enumerate(zip(first, last, strict=True)):
        k = a + int(squared[a:b].argmin())
        if not seen[k]:
            s = distance[k] + share[k] * (distance[k + 1] - distance[k])
            near = seen[a:b] & (np.abs(distance[a:b] - s) <= reach)
            if not near.any():
                left_out[i] = LeftOut.ACROSS
            k = a + int(np.where(near, squared[a:b], np.inf).argmin())
        nearest[i] = k
    given = np.array([i for i in range(len(lines)) if i not in left_out], dtype=np.intp)
    nearest = nearest[given]
    # A stretch is the run of steps in the same direction around the nearest one.
    edges = np.flatnonzero(direction[1:] != direction[:-1]) + 1
    edges = np.concatenate([[0], edges, [len(direction)]])
    run = edges.searchsorted(nearest, side="right")
    begin, end = edges[run - 1], edges[run]
    size = end - begin + 1
    stop = size.cumsum()
    line = np.arange(len(given)).repeat(size)
    within = np.arange(len(line)) - (stop - size)[line]
    forward = direction[nearest] == 1
    rows = np.where(forward, begin, end)[line] + np.where(forward, 1, -1)[line] * within
    x, y = points[rows].T
    low, high = x[stop - size].clip(min=x_min), x[stop - 1].clip(max=x_max)
    if not (low < high).all():
        left_out |= dict.fromkeys(given[~(low < high)].tolist(), LeftOut.NOT_IN_WINDOW)
    # Steps that lie in the window, at least in part, of the lines that do.
    used = (x[:-1] < x_max) & (x[1:] > x_min) & (line[:-1] == line[1:]) & (low < high)[line[:-1]]
    kept = np.append(used, False) | np.append(False, used)
    kept_lines = np.flatnonzero(low < high)
    return Stretches(
        x[kept],
        y[kept],
        kept_lines.searchsorted(line[kept]),
        np.column_stack([low, high])[kept_lines],
        given[kept_lines],
        left_out,
    )


#: Direction of a step along the car's x axis: against it, none, along it, or between two lines.
BETWEEN_LINES = 2


def _direction(
    points: NDArray[np.float64],
    distance: NDArray[np.float64],
    first: NDArray[np.intp],
    last: NDArray[np.intp],
    max_turn: float,
) -> NDArray[np.int8]:
    """Return for each step along the points 1 if it goes ahead, -1 if back, 0 if across.

    Of a short step it is the direction of the line within half of ``DIRECTION_BASE`` on both sides.
    """
    steps = np.diff(points, axis=0)
    if (np.diff(distance) < DIRECTION_BASE).any():
        middle = (distance[1:] + distance[:-1]) / 2
        line = np.arange(len(first)).repeat(last - first + 1)[:-1]
        a = distance.searchsorted(middle - DIRECTION_BASE / 2, side="right") - 1
        b = distance.searchsorted(middle + DIRECTION_BASE / 2)
        steps = points[b.clip(max=last[line])] - points[a.clip(min=first[line])]
    dx, dy = steps.T
    along = np.abs(dx) >= math.cos(max_turn) * np.hypot(dx, dy)
    return np.where(along, np.sign(dx), 0).astype(np.int8)


def nearest_share(
    begin: NDArray[np.float64], end: NDArray[np.float64], point: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where each of (n, 2) segments is nearest to a point, and the squared distances.

    The places are shares of the segments from 0 to 1.
    """
    step, offset = end - begin, point - begin
    squared = (step * step).sum(axis=1)
    share = ((offset * step).sum(axis=1) / np.where(squared > 0, squared, 1.0)).clip(0, 1)
    offset = offset - share[:, None] * step
    return share, (offset * offset).sum(axis=1)


def to_ego(points: ArrayLike, pose: ArrayLike) -> NDArray[np.float64]:
    """Transform (..., 2) points [m] from the map frame to the frame of a car at ``pose``.

    The pose is (3,) e_x [m], e_y [m], e_h [rad], heading counter-clockwise from the map's x axis.

    >>> to_ego([[0.0, 5.0]], [0.0, 0.0, np.pi / 2]).round(9) + 0.0
    array([[5., 0.]])
    """
    e_x, e_y, e_h = floats(pose, "pose")
    c, s = np.cos(e_h), np.sin(e_h)
    return (floats(points, "points") - [e_x, e_y]) @ np.array([[c, -s], [s, c]])


def to_map(points: ArrayLike, pose: ArrayLike) -> NDArray[np.float64]:
    """Transform (..., 2) points [m] from the frame of a car at ``pose`` to the map frame.

    >>> to_map([[5.0, 0.0]], [0.0, 0.0, np.pi / 2]).round(9) + 0.0
    array([[0., 5.]])
    """
    e_x, e_y, e_h = floats(pose, "pose")
    c, s = np.cos(e_h), np.sin(e_h)
    return floats(points, "points") @ np.array([[c, s], [-s, c]]) + [e_x, e_y]


def _check_precision(points: object) -> None:
    """Raise ValueError if single precision rounds coordinates by more than ``MAX_ROUNDING``."""
    dtype = getattr(points, "dtype", None)
    if dtype not in (np.float32, np.float16):
        return
    largest = np.abs(np.asarray(points)).max(initial=0.0)
    rounding = float(np.spacing(largest)) / 2
    if rounding > MAX_ROUNDING:
        raise ValueError(
            f"points must be float64: {dtype} rounds coordinates of {largest:g} m by up to "
            f"{rounding:.2g} m; subtract a local origin before the conversion, or keep float64"
        )
