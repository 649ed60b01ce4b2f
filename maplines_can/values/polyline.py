"""Map lines as point sequences, and the stretch of a line that a car sees ahead of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import floats, number_text
from .line import Kind, LeftOut
from .search_tree import SearchTree, nearest_share, squared_length

#: Limit of ``Polyline.resampled``; 10^7 points take 160 MB.
MAX_POINTS = 10**7
#: Largest rounding error of single-precision coordinates [m].
MAX_ROUNDING = 1e-3
#: Lines of more points keep a search tree, so that a query does not visit all points.
INDEXED = 2048
#: Parts of such a line begin and end at multiples of this length along it [m], so that the next
#: query uses the same part.
BLOCK = 100.0
#: Most points of a part; if there are more near the car, it is sampled evenly, for a window of
#: 100 m at least every 0.7 m.
MAX_NEAR = 1000
#: Concatenated lines and parts of lines that are kept for the next query.
KEPT = 16
#: Largest angle between the car's x axis and a line that it sees [rad]; farther along, the line
#: is nearly parallel to the y axis, and no function y(x).
MAX_TURN = math.radians(65.0)
#: Length over which the direction of a line is taken [m], so that close points with small errors
#: do not count as turns.
DIRECTION_BASE = 0.5


@dataclass(frozen=True, eq=False)
class Polyline:
    """Points of one map line, in or against the driving direction.

    Its length is computed once. A line of more than 2048 points also keeps a search tree from its
    first window query on, so that the time of a query hardly depends on the number of points.

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

    if TYPE_CHECKING:  # the fields have the types after conversion

        def __init__(self, points: ArrayLike, kind: Kind = Kind.UNKNOWN) -> None: ...

    def __post_init__(self) -> None:
        _check_precision(self.points)
        points = np.array(floats(self.points, "points"))
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2:
            raise ValueError(f"points must have shape (n, 2) with n >= 2, got {points.shape}")
        if not np.isfinite(points).all():
            bad = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
            raise ValueError(f"points must be finite [m], but point {bad} is {points[bad]}")
        with np.errstate(over="ignore"):
            distance = _arc_lengths(points)
        self._set(points, distance, Kind(self.kind))

    @classmethod
    def trusted(
        cls,
        points: NDArray[np.float64],
        kind: Kind = Kind.UNKNOWN,
        distance: NDArray[np.float64] | None = None,
    ) -> Polyline:
        """Return a line of the given arrays without copying or checking them.

        The arrays become read-only. For points that are computed from those of other lines, or
        checked together; otherwise call ``Polyline(points, kind)``.

        Args:
            points: (n, 2) finite, n >= 2 [m].
            kind: kind of marking or boundary.
            distance: (n,) arc lengths from the first point [m], if they are known.
        """
        line = object.__new__(cls)
        line._set(points, _arc_lengths(points) if distance is None else distance, kind)
        return line

    def _set(self, points: NDArray[np.float64], distance: NDArray[np.float64], kind: Kind) -> None:
        points.setflags(write=False)
        distance.setflags(write=False)
        vars(self).update(points=points, distance=distance, kind=kind)

    @cached_property
    def _tree(self) -> SearchTree | None:
        return SearchTree(self.points, self.distance) if len(self.points) > INDEXED else None

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

    def near(self, point: NDArray[np.float64], reach: float) -> Polyline:
        """Return the part of the line up to ``reach`` [m] from its point nearest to a point.

        It may be longer. A line without a search tree is returned as a whole.
        """
        if self._tree is None:
            return self
        low, high = self._tree.around_nearest(point, BLOCK)
        return _part(self, math.floor((low - reach) / BLOCK), math.ceil((high + reach) / BLOCK))


def _arc_lengths(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (n,) arc lengths of (n, 2) points from the first one."""
    step = points[1:] - points[:-1]
    found = np.zeros(len(points))
    np.hypot(step[:, 0], step[:, 1]).cumsum(out=found[1:])
    return found


@lru_cache(maxsize=KEPT)
def _part(line: Polyline, begin: int, end: int) -> Polyline:
    """Return the part of a large line between two multiples of ``BLOCK`` along it."""
    a, b = line.distance.searchsorted([begin * BLOCK, end * BLOCK])
    part = slice(max(0, a - 1), b + 1)
    points, distance = line.points[part], line.distance[part]
    if len(points) > MAX_NEAR:
        rows = distance.searchsorted(np.linspace(distance[0], distance[-1], MAX_NEAR))
        points = points[rows]
    return Polyline(points)


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
    first: NDArray[np.intp]  #: (L,) index of the first point of each stretch
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


class _Joined(NamedTuple):
    """What a query needs of several lines and does not depend on the pose, concatenated.

    There is a step from each point to the next one of the line. The last one has length 0.
    """

    points: NDArray[np.float64]  #: (2, n) [m]
    steps: NDArray[np.float64]  #: (2, n) [m]
    squared: NDArray[np.float64]  #: (n,) squared lengths of the steps [m^2]
    chords: NDArray[np.float64]  #: (2, n) each short step with DIRECTION_BASE / 2 on both sides [m]
    chord: NDArray[np.float64]  #: (n,) lengths of the chords [m]
    size: NDArray[np.intp]  #: (L,) numbers of points
    first: NDArray[np.intp]  #: (L,) indices of the first points
    last: NDArray[np.intp]  #: (L,) indices of the last points


@lru_cache(maxsize=KEPT)
@np.errstate(over="ignore", invalid="ignore")
def _joined(lines: tuple[Polyline, ...]) -> _Joined:
    """Return lines concatenated. A car asks for the same lines again and again."""
    count = np.array([len(line.points) for line in lines])
    points = np.concatenate([line.points for line in lines])
    steps, chords = (np.concatenate(arrays) for arrays in zip(*map(_steps, lines), strict=True))
    points, steps, chords = (np.ascontiguousarray(xy.T) for xy in (points, steps, chords))
    last = count.cumsum() - 1
    first = last + 1 - count
    squared = squared_length(steps)
    return _Joined(points, steps, squared, chords, np.hypot(*chords), count, first, last)


def _steps(line: Polyline) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the (n, 2) steps of a line, and the chords from which their directions are taken."""
    points, distance = line.points, line.distance
    steps = np.append(np.diff(points, axis=0), [[0.0, 0.0]], axis=0)
    if not (np.diff(distance) < DIRECTION_BASE).any():
        return steps, steps
    middle = (distance[1:] + distance[:-1]) / 2
    begin = distance.searchsorted(middle - DIRECTION_BASE / 2, side="right") - 1
    end = distance.searchsorted(middle + DIRECTION_BASE / 2)
    chords = points[end.clip(max=len(points) - 1)] - points[begin.clip(min=0)]
    return steps, np.append(chords, [[0.0, 0.0]], axis=0)


@np.errstate(over="ignore", invalid="ignore")
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
    ahead = min(max(0.0, x_min), x_max)
    reach = (x_max - x_min + abs(ahead)) / math.cos(max_turn)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    start = pose[:2] + np.array([ahead * c, ahead * s])
    parts = tuple([line.near(start, reach) for line in lines])
    joined = _joined(parts)

    # Steps in the direction of the car's x axis are 1, against it -1, and across 0.
    advance = c * joined.chords[0] + s * joined.chords[1]
    least = math.cos(max_turn) * joined.chord
    direction = np.subtract(advance >= least, advance <= -least, dtype=np.int8)
    share, squared = nearest_share(joined.points, joined.steps, joined.squared, start[:, None])
    squared[joined.last] = np.inf
    squared = np.fmin(squared, np.inf)  # NaN by overflow is far away
    is_least = squared == np.minimum.reduceat(squared, joined.first).repeat(joined.size)
    hits = is_least.nonzero()[0]
    nearest = hits[hits.searchsorted(joined.first)]
    left_out: dict[int, LeftOut] = {}
    for i in (direction[nearest] == 0).nonzero()[0].tolist():
        own = slice(joined.first[i], joined.last[i] + 1)
        distance, k = parts[i].distance, nearest[i] - joined.first[i]
        s_nearest = distance[k] + share[nearest[i]] * (distance[k + 1] - distance[k])
        near = (direction[own] != 0) & (np.abs(distance - s_nearest) <= reach)
        if near.any():
            nearest[i] = own.start + np.where(near, squared[own], np.inf).argmin()
        else:
            left_out[i] = LeftOut.ACROSS
    given = np.array([i for i in range(len(lines)) if i not in left_out], dtype=np.intp)
    nearest = nearest[given]
    # A stretch is the run of steps in the same direction around the nearest one, and of these the
    # steps that lie in the window, at least in part.
    turns = np.concatenate([[0], (direction[1:] != direction[:-1]).nonzero()[0] + 1])
    run = turns.searchsorted(nearest, side="right")
    x, y = np.array([[c, s], [-s, c]]) @ (joined.points - pose[:2, None])
    before, beyond = x <= x_min, x >= x_max
    inside = (~(before[1:] & before[:-1] | beyond[1:] & beyond[:-1])).nonzero()[0]
    a, b = inside.searchsorted(turns[run - 1]), inside.searchsorted(turns[run])
    inside = np.append(inside, 0)
    begin, end = inside[a], inside[b - 1] + 1
    forward = direction[nearest] == 1
    low = x[np.where(forward, begin, end)].clip(min=x_min)
    high = x[np.where(forward, end, begin)].clip(max=x_max)
    seen = (a < b) & (low < high)
    if not seen.all():
        left_out |= dict.fromkeys(given[~seen].tolist(), LeftOut.NOT_IN_WINDOW)
        given, begin, end, forward = given[seen], begin[seen], end[seen], forward[seen]
        low, high = low[seen], high[seen]
    size = end - begin + 1
    first = size.cumsum() - size
    step = np.where(forward, 1, -1)
    rows = (np.where(forward, begin, end) - step * first).repeat(size)
    rows += step.repeat(size) * np.arange(len(rows))
    line = np.arange(len(given)).repeat(size)
    x_range = np.array([low, high]).T
    return Stretches(x[rows], y[rows], line, x_range, given, first, left_out)


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
