"""What is seen of lines of the map: their stretches in a window, as functions y(x)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..values.arrays import floats
from ..values.elementary import hypot, sin_cos_one
from ..values.errors import IllPosedError
from ..values.line import LeftOut
from ..values.polyline import Polyline, nearest_share, squared_length, to_map

#: Concatenated lines that are kept for the next query.
KEPT = 16
#: Largest angle between the car's x axis and a line that it sees [rad]; farther along, the line
#: is nearly parallel to the y axis, and no function y(x).
MAX_TURN = math.radians(65.0)
#: Length over which the direction of a line is taken [m], so that close points with small errors
#: do not count as turns.
DIRECTION_BASE = 0.5


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
        # Close points may run back a little; the line is then where it first comes.
        return np.maximum.accumulate(self._key(self.x, self.line))

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


@np.errstate(over="ignore", invalid="ignore")
def stretches(
    lines: Sequence[Polyline],
    pose: ArrayLike,
    window: tuple[float, float],
    max_turn: float = MAX_TURN,
) -> Stretches:
    """Return the stretch of each line that a car sees in a window.

    A line is followed along its arc length in both directions from the point nearest to the car,
    until it leaves the window, turns more than ``max_turn`` away from the car's x axis, or ends. If
    it returns to the car's surroundings, as in a hairpin or a roundabout, that part is excluded.

    Args:
        lines: the lines of the map.
        pose: (3,) e_x [m], e_y [m], e_h [rad] of the car in the map frame.
        window: (x_min, x_max) in the ego frame [m].
        max_turn: largest angle between a line and the car's x axis [rad].

    Raises:
        ValueError: ``pose`` is not finite or not of shape (3,), or the window is empty.
    """
    pose = checked_pose(pose)
    x_min, x_max = checked_window(window)
    # If the car is not in the window, the end of the window nearest to it takes its place.
    ahead = min(max(0.0, x_min), x_max)
    s, c = sin_cos_one(pose.item(2))
    _, least_cosine = sin_cos_one(max_turn)
    reach = (x_max - x_min + abs(ahead)) / least_cosine
    start = pose[:2] + np.array([ahead * c, ahead * s])
    parts = tuple([line.near(start, reach) for line in lines])
    joined = _joined(parts)

    # Steps in the direction of the car's x axis are 1, against it -1, and across 0.
    advance = c * joined.chords[0] + s * joined.chords[1]
    least = least_cosine * joined.chord
    direction = np.subtract(advance >= least, advance <= -least, dtype=np.int8)
    nearest, left_out = _nearest_steps(parts, joined, direction, start, reach)
    given = np.array([i for i in range(len(lines)) if i not in left_out], dtype=np.intp)
    x, y = joined.points - pose[:2, None]
    points = np.array([c * x + s * y, c * y - s * x])
    return _in_window(points, direction, nearest[given], (x_min, x_max), given, left_out)


def checked_pose(pose: ArrayLike) -> NDArray[np.float64]:
    """Return a pose as an array of floats.

    Raises:
        ValueError: it is not finite or not of shape (3,).
    """
    pose = floats(pose, "pose")
    if pose.shape != (3,) or not all(map(math.isfinite, pose.tolist())):
        raise ValueError(f"pose must be finite with shape (3,), got {pose!r}")
    return pose


def checked_window(window: tuple[float, float]) -> tuple[float, float]:
    """Return the ends of a window as floats [m].

    Raises:
        ValueError: it is empty, or not of two finite numbers.
    """
    x_min, x_max = floats(window, "window").tolist()
    if not -np.inf < x_min < x_max < np.inf:
        raise ValueError(f"window must have finite x_min < x_max [m], got {window}")
    return x_min, x_max


def check_given(left_out: Sequence[LeftOut | None], window: tuple[float, float]) -> None:
    """Check that all lines have a stretch in a window.

    Raises:
        IllPosedError: one is left out.
    """
    for i, reason in enumerate(left_out):
        if reason is not None:
            which = "the line" if len(left_out) == 1 else f"line {i} of {len(left_out)}"
            raise IllPosedError(f"{which} cannot be given: {reason}; the window is {window} m")


def points_in_window(
    line: Polyline, pose: ArrayLike, window: tuple[float, float]
) -> NDArray[np.float64]:
    """Return the (k, 2) points of a line in the map frame that a car sees in a window [m].

    The ends of the window are interpolated. The points are ordered by x in the ego frame, and there
    are none if nothing of the line is seen. See ``stretches``.

    >>> points_in_window(Polyline([[0, 1], [30, 1]]), [5.0, 0.0, 0.0], (-20, 10))
    array([[ 0.,  1.],
           [15.,  1.]])
    """
    seen = stretches([line], pose, window)
    if seen.left_out:
        return np.empty((0, 2))
    low, high = seen.x_range[0]
    inside = (seen.x > low) & (seen.x < high)
    x = np.concatenate([[low], seen.x[inside], [high]])
    return to_map(np.column_stack([x, seen.lateral(x[None])[0]]), pose)


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
    return _Joined(points, steps, squared, chords, hypot(*chords), count, first, last)


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


def _nearest_steps(
    parts: Sequence[Polyline],
    joined: _Joined,
    direction: NDArray[np.int8],
    start: NDArray[np.float64],
    reach: float,
) -> tuple[NDArray[np.intp], dict[int, LeftOut]]:
    """Return the (L,) steps nearest to the start that are not across, and the lines without one.

    If the nearest one of all is across, the others within reach along the line count.
    """
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
    return nearest, left_out


def _in_window(
    points: NDArray[np.float64],
    direction: NDArray[np.int8],
    nearest: NDArray[np.intp],
    window: tuple[float, float],
    given: NDArray[np.intp],
    left_out: dict[int, LeftOut],
) -> Stretches:
    """Return the stretches around the nearest steps of lines, of (2, n) points in the ego frame.

    A stretch is the run of steps in the same direction around the nearest one, and of these the
    steps that lie in the window, at least in part.
    """
    (x, y), (x_min, x_max) = points, window
    turns = np.concatenate([[0], (direction[1:] != direction[:-1]).nonzero()[0] + 1])
    run = turns.searchsorted(nearest, side="right")
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
