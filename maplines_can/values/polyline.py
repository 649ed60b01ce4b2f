"""Map lines as point sequences, with an index of long ones, and values that apply along a line."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import lib
from ..core.memory import pointer
from .arrays import floats, number_text
from .elementary import sin_cos
from .line import Kind

#: Limit of ``Polyline.resampled``; 10^7 points take 160 MB.
MAX_POINTS = 10**7
#: Largest rounding error of single-precision coordinates [m].
MAX_ROUNDING = 1e-3
#: Lines of more points keep bounding boxes of so many segments each, so that a query does not visit
#: all points.
INDEXED, RUN = 2048, 512
#: Parts of such a line begin and end at multiples of this length along it [m], so that the next
#: query uses the same part.
BLOCK = 100.0
#: Most points of a part; if there are more near the car, it is sampled evenly, for a window of
#: 100 m at least every 0.7 m.
MAX_NEAR = 1000
#: Parts of lines that are kept for the next query.
KEPT = 16

#: A kind, or pairs of the arc length from which a kind applies [m], ascending from 0, and the kind.
Kinds: TypeAlias = Kind | Sequence[tuple[float, Kind]]


@dataclass(frozen=True, eq=False)
class Polyline:
    """Points of one map line, in or against the driving direction.

    Its length is computed once. A line of more than 2048 points also keeps an index from its first
    window query on, so that the time of a query hardly depends on the number of points.

    Args:
        points: (n, 2) finite, n >= 2, in the map frame [m]. Coordinates in single precision
            are accepted as long as their rounding error is at most 1 mm.
        kind: kind of marking or boundary; where it changes, pairs (s, kind) that apply from the
            arc length s [m] to the next pair. The first s is 0. ``kind`` is then the kind of the
            greatest length, and ``kinds`` are the pairs.

    Raises:
        ValueError: the shape is wrong, a value is not finite, single precision is too coarse, or
            the arc lengths of the kinds do not increase from 0 to less than the length.

    >>> Polyline([[0, 0], [3, 4]]).length
    5.0
    >>> line = Polyline([[0, 0], [9, 0]], [(0, Kind.DASHED), (4, Kind.SOLID)])
    >>> line.kind.name, line.kind_at(3.9).name, line.kind_at(4.0).name
    ('SOLID', 'DASHED', 'SOLID')
    """

    points: NDArray[np.float64]
    kind: Kind = Kind.UNKNOWN
    #: (n,) arc length from the first point to each point [m].
    distance: NDArray[np.float64] = field(init=False, repr=False)
    #: pairs (s, kind) if the kind changes along the line; empty if it does not.
    kinds: Pieces[Kind] = field(init=False, repr=False)

    if TYPE_CHECKING:  # the fields have the types after conversion

        def __init__(self, points: ArrayLike, kind: Kinds = Kind.UNKNOWN) -> None: ...

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
        self._set(points, distance, _checked(self.kind, distance[-1]))

    @classmethod
    def trusted(
        cls,
        points: NDArray[np.float64],
        kind: Kinds = Kind.UNKNOWN,
        distance: NDArray[np.float64] | None = None,
    ) -> Polyline:
        """Return a line of the given arrays without copying or checking them.

        The arrays, also of (n,) arc lengths if they are known [m], become read-only. For points
        that are computed from those of other lines, or checked together; otherwise call
        ``Polyline``.
        """
        line = object.__new__(cls)
        line._set(points, _arc_lengths(points) if distance is None else distance, kind)
        return line

    def _set(self, points: NDArray[np.float64], distance: NDArray[np.float64], kind: Kinds) -> None:
        points.setflags(write=False)
        distance.setflags(write=False)
        kinds: Pieces[Kind] = ()
        if not isinstance(kind, Kind):
            kinds = merged(kind)
            kind = longest(kinds, float(distance[-1]))
            kinds = kinds if len(kinds) > 1 else ()
        vars(self).update(points=points, distance=distance, kind=kind, kinds=kinds)

    @cached_property
    def _boxes(self) -> NDArray[np.float64]:
        """(runs, 4) lower and upper corners around ``RUN`` successive segments each."""
        starts = np.arange(0, len(self.points) - 1, RUN)
        rows = np.minimum(starts[:, None] + np.arange(RUN + 1), len(self.points) - 1)
        runs = self.points[rows]
        return np.hstack([runs.min(axis=1), runs.max(axis=1)])

    @property
    def length(self) -> float:
        """Length of the line [m]."""
        return float(self.distance[-1])

    def kind_at(self, s: float) -> Kind:
        """Return the kind at an arc length [m]."""
        return value_at(self.kinds, s) if self.kinds else self.kind

    def parts(self) -> Iterator[Polyline]:
        """Yield the parts of one kind each."""
        if not self.kinds:
            yield self
        for (start, end), kind in extents(self.kinds, self.length):
            yield Polyline(self.between(start, end), kind)

    def between(self, start: float, end: float) -> NDArray[np.float64]:
        """Return the (n, 2) points from an arc length to a greater one [m]."""
        inside = (self.distance > start) & (self.distance < end)
        return self.at(np.concatenate([[start], self.distance[inside], [end]]))

    def at(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (n, 2) points at (n,) arc lengths [m]."""
        return np.column_stack([np.interp(s, self.distance, p) for p in self.points.T])

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
        found = Polyline(self.at(s))
        kinds = [(float(np.interp(at, s, found.distance)), kind) for at, kind in self.kinds]
        return Polyline.trusted(found.points, kinds or self.kind, found.distance)

    def near(self, point: NDArray[np.float64], reach: float) -> Polyline:
        """Return the part of the line up to ``reach`` [m] from its point nearest to a point.

        It may be longer. A line of few points is returned as a whole.
        """
        if len(self.points) <= INDEXED:
            return self
        points, distance = map(np.ascontiguousarray, (self.points, self.distance))
        arrays = pointer(points), pointer(distance), RUN, pointer(self._boxes)
        s = lib.maplines_nearest_place(len(points), *arrays, *point.tolist())
        return _part(self, math.floor((s - reach) / BLOCK), math.ceil((s + reach) / BLOCK))


def _checked(kind: Kinds, length: float) -> Kinds:
    """Return a kind, or pairs, of a line of a length; raise ValueError for others."""
    if not isinstance(kind, Sequence):
        return Kind(kind)
    pairs = [(float(s), Kind(one)) for s, one in kind]
    s = [start for start, _ in pairs]
    if s[:1] != [0.0] or not all(one < other for one, other in pairwise([*s, length])):
        raise ValueError(
            "kinds must be pairs (s, kind) with increasing s from 0 to less than the length of "
            f"{length:g} m, got {kind!r}"
        )
    return pairs


def _arc_lengths(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (n,) arc lengths of (n, 2) points from the first one."""
    x, y = (points[1:] - points[:-1]).T
    found = np.zeros(len(points))
    np.sqrt(x * x + y * y).cumsum(out=found[1:])  # as in C; hypot of NumPy depends on the machine
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


def to_ego(points: ArrayLike, pose: ArrayLike) -> NDArray[np.float64]:
    """Transform (..., 2) points [m] from the map frame to the frame of a car at ``pose``.

    The pose is (3,) e_x [m], e_y [m], e_h [rad], heading counter-clockwise from the map's x axis.

    >>> to_ego([[0.0, 5.0]], [0.0, 0.0, np.pi / 2]).round(9) + 0.0
    array([[5., 0.]])
    """
    e_x, e_y, e_h = floats(pose, "pose").tolist()
    s, c = sin_cos(e_h)
    return (floats(points, "points") - [e_x, e_y]) @ np.array([[c, -s], [s, c]])


def to_map(points: ArrayLike, pose: ArrayLike) -> NDArray[np.float64]:
    """Transform (..., 2) points [m] from the frame of a car at ``pose`` to the map frame.

    >>> to_map([[5.0, 0.0]], [0.0, 0.0, np.pi / 2]).round(9) + 0.0
    array([[0., 5.]])
    """
    e_x, e_y, e_h = floats(pose, "pose").tolist()
    s, c = sin_cos(e_h)
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


T = TypeVar("T")
#: Pairs of the position from which a value applies [m], ascending from 0, and the value.
Pieces = tuple[tuple[float, T], ...]


def value_at(pieces: Sequence[tuple[float, T]], s: float) -> T:
    """Return the value at a position [m]; before the first one, that of the first piece.

    >>> [value_at([(0.0, "a"), (4.0, "b")], s) for s in (3.9, 4.0)]
    ['a', 'b']
    """
    return next((value for start, value in reversed(pieces) if start <= s), pieces[0][1])


def extents(pieces: Sequence[tuple[float, T]], end: float) -> list[tuple[tuple[float, float], T]]:
    """Return from where to where each value applies [m], if the last one does up to ``end``.

    >>> extents([(0.0, "a"), (4.0, "b")], 9.0)
    [((0.0, 4.0), 'a'), ((4.0, 9.0), 'b')]
    """
    stops = [start for start, _ in pieces] + [end]
    return list(zip(pairwise(stops), (value for _, value in pieces), strict=True))


def longest(pieces: Sequence[tuple[float, T]], end: float) -> T:
    """Return the value that applies to the greatest length up to ``end``; of equals, the first.

    >>> longest([(0.0, "a"), (4.0, "b"), (6.0, "a")], 7.0)
    'a'
    """
    lengths: dict[T, float] = {}
    for (start, stop), value in extents(pieces, end):
        lengths[value] = lengths.get(value, 0.0) + stop - start
    return max(lengths, key=lengths.__getitem__)


def merged(pieces: Sequence[tuple[float, T]]) -> Pieces[T]:
    """Return the pieces without those that continue the value before.

    >>> merged([(0.0, "a"), (4.0, "a"), (6.0, "b")])
    ((0.0, 'a'), (6.0, 'b'))
    """
    kept = [True, *(one != other for (_, one), (_, other) in pairwise(pieces))]
    return tuple(piece for piece, is_new in zip(pieces, kept, strict=True) if is_new)
