"""Boundaries of the lanes of a lane section: exact at any s, and sampled for polylines.

The lane sections of a road are sampled together, so that NumPy computes with long arrays.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .profiles import Array, Profiles
from .reference_line import Complex
from .road import MAX_COORDINATE, RoadRecord

#: Largest distance of the tested points of a line from its samples [m]. Those in between may be
#: an eighth farther away, with thirds, and are within 0.5 mm.
CHORD_ERROR = 0.43e-3
#: Largest distance of samples [m].
MAX_SPACING = 50.0
#: Points nearer to each other are one [m].
SAME = 1e-4
#: Shorter intervals of s, and lane sections, are points [m].
SHORTEST = 1e-6
#: Negative widths up to this one are rounding errors [m].
WIDTH_TOLERANCE = 1e-4
#: Most samples of all boundaries of a road together.
MAX_SAMPLES = 1_000_000
#: Most pieces into which an interval is divided at once.
MAX_PIECES = 1000
#: Refinements of the samples; each at least halves an interval.
_PASSES = 30
#: Parts of an interval at whose ends the lines are evaluated: first, and after a refinement.
_QUARTERS, _THIRDS = np.linspace(0, 1, 5), np.linspace(0, 1, 4)


class SamplingError(ValueError):
    """Boundaries that are too far away, or need too many samples."""


class Boundaries:
    """Boundary lines of a lane section.

    Args:
        road: that has the lane section.
        index: of the lane section.

    Attributes:
        index: of the lane section.
        start: s of the start [m].
        end: s of the end [m].
        rows: for the id of a lane, the rows of its inner and its outer boundary. The inner one is
            nearer to lane 0.
        negative: ids of lanes with a negative width somewhere; it is taken as 0. Known after
            ``sampled``.
    """

    def __init__(self, road: RoadRecord, index: int) -> None:
        lanes = road.sections[index].lanes
        self.index = index
        self.start, self.end = road.extent(index)
        self.road = road
        self._left = sorted(lane_id for lane_id in lanes if lane_id > 0)
        self._right = sorted((lane_id for lane_id in lanes if lane_id < 0), reverse=True)
        self._ids = [*self._left, *self._right]
        self.rows: dict[int, tuple[int, int]] = {}
        for side in (self._left, self._right):
            inner = 0
            for lane_id in side:
                self.rows[lane_id] = inner, len(self.rows) + 1
                inner = len(self.rows)
        records = [lanes[lane_id] for lane_id in self._ids]
        self._widths = Profiles([record.width for record in records])
        self._bordered = [not record.width and bool(record.border) for record in records]
        self._borders = Profiles([r.border for r in records]) if any(self._bordered) else None
        self._least = np.zeros(len(records))
        self._level = np.array([record.is_level for record in records], dtype=bool)

    @property
    def is_point(self) -> bool:
        """Whether the lane section has no length."""
        return self.end - self.start < SHORTEST

    @property
    def negative(self) -> list[int]:
        """Ids of lanes with a negative width at a sample."""
        return [i for i, least in zip(self._ids, self._least, strict=True) if least < 0]

    @property
    def outermost(self) -> tuple[int, int]:
        """Rows of the leftmost and of the rightmost boundary; 0 if that is lane 0."""
        left, right = self._left[-1:], self._right[-1:]
        return self.rows[left[0]][1] if left else 0, self.rows[right[0]][1] if right else 0

    def __call__(self, s: Array, at: Array) -> Complex:
        """Return (rows, n) points of lane 0 and of the outer boundaries of the lanes.

        Args:
            s: (n,) positions along the reference line [m].
            at: (n,) positions that select the pieces of all functions; within the lane section,
                and on the same side of their starts as the stretch of interest.
        """
        return _points(self.road, [self], np.zeros(len(s), int), s[:, None], at)[:, :, 0]

    def edges(self, lane_id: int, s: Array) -> tuple[Complex, Complex]:
        """Return (n,) points of the inner and of the outer boundary of a lane.

        At the end of the lane section, these are the limits from before it.
        """
        at = np.minimum(s, math.nextafter(self.end, -math.inf))
        points = self(s, at)
        inner, outer = self.rows[lane_id]
        return points[inner], points[outer]

    def offsets(self, s: Array, at: Array) -> Array:
        """Return (rows, n) offsets from lane 0, positive on the left [m]."""
        widths = self._widths(s, at)
        if self._borders is not None:
            self._add_borders(widths, self._borders(s, at))
        if widths.size and widths.min() < 0:
            least = widths.min(axis=1)
            self._least = np.minimum(self._least, np.where(least < -WIDTH_TOLERANCE, least, 0.0))
            widths = np.maximum(widths, 0.0)
        if self.road.roll is not None and self._level.any():  # all are rolled later
            widths[self._level] /= np.cos(self.road.roll(s, at))
        t = np.zeros((len(self._ids) + 1, len(s)))
        split = len(self._left)
        widths[:split].cumsum(axis=0, out=t[1 : split + 1])
        np.negative(widths[split:], out=widths[split:]).cumsum(axis=0, out=t[split + 1 :])
        return t

    def _add_borders(self, widths: Array, borders: Array) -> None:
        """Replace the widths of lanes that have borders by the distance from the inner boundary."""
        for lane_ids, sign, first in ((self._left, 1, 0), (self._right, -1, len(self._left))):
            inner = np.zeros(widths.shape[1])
            for row in range(first, first + len(lane_ids)):
                if self._bordered[row]:
                    widths[row] = sign * borders[row] - inner
                inner = inner + np.maximum(widths[row], 0.0)

    def breaks(self) -> Array:
        """Return the (n,) ends of the intervals in which all functions are smooth."""
        road = self.road
        functions = (road.reference, self._widths, self._borders, road.lane_offset, road.roll)
        inside = []
        for starts in (function.starts for function in functions if function is not None):
            first = bisect_right(starts, self.start + SHORTEST)
            inside += starts[first : bisect_left(starts, self.end - SHORTEST, first)]
        breaks = [self.start]
        for s in sorted(inside):
            if s - breaks[-1] > SHORTEST:
                breaks.append(s)
        return np.array([*breaks, self.end])


def sampled(road: RoadRecord, sections: Sequence[Boundaries]) -> list[Complex]:
    """Return (rows, k) points of each lane section whose chords are within ``CHORD_ERROR``.

    Where a function jumps, both of its values are points.

    Args:
        road: that has the lane sections.
        sections: in the order of s.

    Raises:
        SamplingError: the boundaries are too far away, or need too many samples.
    """
    if not sections:
        return []
    owner, both = _sampled(road, sections)
    ends = owner.searchsorted(np.arange(len(sections)), side="right").tolist()
    found = []
    for section, first, last in zip(sections, [0, *ends[:-1]], ends, strict=True):
        points = both[: len(section.rows) + 1, first:last].reshape(len(section.rows) + 1, -1)
        following = np.abs(points[:, 2::2] - points[:, 1:-1:2]).max(axis=0)
        keep = np.ones(points.shape[1], bool)
        keep[1:-1:2] = following > SAME  # else the start of the next interval stands for both
        found.append(points[:, keep])
    return found


def _sampled(road: RoadRecord, sections: Sequence[Boundaries]) -> tuple[NDArray[np.intp], Complex]:
    """Return (n,) lane sections of intervals, and (rows, n, 2) points of their ends, by s."""
    breaks = [section.breaks() for section in sections]
    a = np.concatenate([one[:-1] for one in breaks])
    b = np.concatenate([one[1:] for one in breaks])
    owner = np.arange(len(sections)).repeat([len(one) - 1 for one in breaks])
    rows = max(len(section.rows) for section in sections) + 1
    pieces = np.ceil((b - a) / MAX_SPACING)
    found: list[tuple[Array, NDArray[np.intp], Complex]] = []
    count = 0
    fractions = _QUARTERS
    for _ in range(_PASSES):
        count += int(pieces.sum()) * rows
        if count > MAX_SAMPLES:
            raise SamplingError(f"the boundaries of its lanes need more than {MAX_SAMPLES} points")
        a, b, owner = _divided(a, b, owner, pieces.astype(int))
        s = a[:, None] + (b - a)[:, None] * fractions  # (n, f)
        points = _points(road, sections, owner, s, (a + b) / 2)
        deviation = _deviation(points)
        is_near = deviation < 2 * MAX_COORDINATE  # false for NaN
        if not is_near.all():
            raise _too_far(sections[owner[is_near.argmin()]])
        bad = (deviation > CHORD_ERROR) & (b - a > 2 * SHORTEST)
        good = ~bad
        found.append((a[good], owner[good], points[:, good][:, :, [0, -1]]))
        if not bad.any():
            break
        a, b, owner, pieces = a[bad], b[bad], owner[bad], _pieces(points[:, bad])
        # Widths cut at 0 have kinks.
        fractions = _QUARTERS if any(section.negative for section in sections) else _THIRDS
    starts, owners, ends = zip(*found, strict=True)
    order = np.concatenate(starts).argsort(kind="stable")
    owner, both = np.concatenate(owners)[order], np.concatenate(ends, axis=1)[:, order]
    is_near = np.abs(both).max(axis=(0, 2)) < 2 * MAX_COORDINATE  # false for NaN
    if not is_near.all():
        raise _too_far(sections[owner[is_near.argmin()]])
    return owner, both


def _too_far(section: Boundaries) -> SamplingError:
    where = f"lane section {section.index}"
    return SamplingError(f"{where}: its boundaries are not within {2 * MAX_COORDINATE:g} m")


def _points(
    road: RoadRecord,
    sections: Sequence[Boundaries],
    owner: NDArray[np.intp],
    s: Array,
    at: Array,
) -> Complex:
    """Return (rows, n, f) points of lane 0 and of the outer boundaries of the lanes.

    The rows that a lane section does not have are those of lane 0.

    Args:
        road: that has the lane sections.
        sections: in the order of s.
        owner: (n,) lane section of each stretch, sorted.
        s: (n, f) positions along the reference line [m].
        at: (n,) positions that select the pieces of all functions; see ``Boundaries.__call__``.
    """
    n, f = s.shape
    s, at = s.ravel(), at.repeat(f)
    position, tangent = road.reference(s, at)
    t = np.zeros((max(len(section.rows) for section in sections) + 1, n * f))
    stops = owner.searchsorted(np.arange(len(sections) + 1)) * f
    for section, first, last in zip(sections, stops.tolist(), stops[1:].tolist(), strict=False):
        if first < last:
            part = slice(first, last)
            t[: len(section.rows) + 1, part] = section.offsets(s[part], at[part])
    t += road.lane_offset(s, at)
    if road.roll is not None:
        t *= np.cos(road.roll(s, at))
    found = position + 1j * tangent * t
    return found.reshape(-1, n, f)


def _divided(
    a: Array, b: Array, owner: NDArray[np.intp], pieces: NDArray[np.intp]
) -> tuple[Array, Array, NDArray[np.intp]]:
    """Return the intervals from a to b, each divided into pieces, and their lane sections."""
    if (pieces == 1).all():
        return a, b, owner
    first = (pieces.cumsum() - pieces).repeat(pieces)
    step = ((b - a) / pieces).repeat(pieces)
    index = np.arange(len(first)) - first
    start = a.repeat(pieces) + index * step
    end = np.where(index + 1 == pieces.repeat(pieces), b.repeat(pieces), start + step)
    return start, end, owner.repeat(pieces)


def _deviation(points: Complex) -> Array:
    """Return (n,) largest distances of the points inside from the chord; (rows, n, f) points."""
    chord = points[..., -1:] - points[..., :1]
    inside = points[..., 1:-1] - points[..., :1]
    size = np.abs(chord)
    is_closed = size == 0
    deviation = np.abs((inside * chord.conj()).imag) / np.where(is_closed, 1.0, size)
    if is_closed.any():
        deviation = np.where(is_closed, np.abs(inside), deviation)
    found: Array = deviation.max(axis=(0, 2))
    return found


def _pieces(points: Complex) -> Array:
    """Return (n,) numbers of pieces whose chords are near enough; (rows, n, f) points.

    The distance from a chord is an eighth of the second difference at the ends of two pieces. At
    the ends of the interval, it is extrapolated.
    """
    second = np.abs(points[..., 2:] - 2 * points[..., 1:-1] + points[..., :-2]).max(axis=0)
    largest = second.max(axis=1)  # of (n, f - 2)
    if second.shape[1] > 1:
        first, last = second[:, :2], second[:, -2:]
        extrapolated = np.maximum(2 * first[:, 0] - first[:, 1], 2 * last[:, 1] - last[:, 0])
        largest = np.maximum(largest, extrapolated)
    count = (points.shape[2] - 1) * np.sqrt(largest / (8 * CHORD_ERROR))
    return np.clip(np.ceil(count), 2, MAX_PIECES)
