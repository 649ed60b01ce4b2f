"""Boundaries of the lanes of a lane section: exact at any s, and sampled for polylines."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right

import numpy as np

from .profiles import Array, Profiles
from .reference_line import Complex
from .road import MAX_COORDINATE, RoadRecord

#: Largest distance of a sampled line from the exact one [m], with a margin to 0.5 mm.
CHORD_ERROR = 0.45e-3
#: Largest distance of samples [m].
MAX_SPACING = 50.0
#: Points nearer to each other are one [m].
SAME = 1e-4
#: Shorter intervals of s, and lane sections, are points [m].
SHORTEST = 1e-6
#: Negative widths up to this one are rounding errors [m].
WIDTH_TOLERANCE = 1e-4
#: Most samples of all boundaries of a lane section together.
MAX_SAMPLES = 500_000
#: Most pieces into which an interval is divided at once.
MAX_PIECES = 1000
#: Refinements of the samples; each at least halves an interval.
_PASSES = 30
#: Parts of an interval at whose ends the lines are evaluated: first, and after a refinement.
_QUARTERS, _HALVES = np.linspace(0, 1, 5)[:, np.newaxis], np.linspace(0, 1, 3)[:, np.newaxis]


class SamplingError(ValueError):
    """Boundaries that are too far away, or need too many samples."""


class Boundaries:
    """Boundary lines of a lane section.

    Args:
        road: that has the lane section.
        index: of the lane section.

    Attributes:
        start: s of the start [m].
        end: s of the end [m].
        rows: for the id of a lane, the rows of its inner and its outer boundary. The inner one is
            nearer to lane 0.
        negative: ids of lanes with a negative width somewhere; it is taken as 0. Known after
            ``sampled``.
    """

    def __init__(self, road: RoadRecord, index: int) -> None:
        lanes = road.sections[index].lanes
        self.start, self.end = road.extent(index)
        self._road = road
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
        position, tangent = self._road.reference(s, at)
        t = self._offsets(s, at)
        if self._road.roll is not None:
            t *= np.cos(self._road.roll(s, at))
        return position + 1j * tangent * t

    def edges(self, lane_id: int, s: Array) -> tuple[Complex, Complex]:
        """Return (n,) points of the inner and of the outer boundary of a lane.

        At the end of the lane section, these are the limits from before it.
        """
        at = np.minimum(s, math.nextafter(self.end, -math.inf))
        points = self(s, at)
        inner, outer = self.rows[lane_id]
        return points[inner], points[outer]

    def _offsets(self, s: Array, at: Array) -> Array:
        """Return (rows, n) offsets from the reference line [m]."""
        widths = self._widths(s, at)
        if self._borders is not None:
            self._add_borders(widths, self._borders(s, at))
        if widths.size and (least := widths.min(axis=1)).min() < 0:
            self._least = np.minimum(self._least, np.where(least < -WIDTH_TOLERANCE, least, 0.0))
            widths = np.maximum(widths, 0.0)
        t = np.zeros((len(self._ids) + 1, len(s)))
        split = len(self._left)
        np.cumsum(widths[:split], axis=0, out=t[1 : split + 1])
        np.cumsum(-widths[split:], axis=0, out=t[split + 1 :])
        return t + self._road.lane_offset(s, at)

    def _add_borders(self, widths: Array, borders: Array) -> None:
        """Replace the widths of lanes that have borders by the distance from the inner boundary."""
        for lane_ids, sign, first in ((self._left, 1, 0), (self._right, -1, len(self._left))):
            inner = np.zeros(widths.shape[1])
            for row in range(first, first + len(lane_ids)):
                if self._bordered[row]:
                    widths[row] = sign * borders[row] - inner
                inner = inner + np.maximum(widths[row], 0.0)

    def sampled(self) -> Complex:
        """Return (rows, k) points whose chords are within ``CHORD_ERROR`` of the boundaries.

        Where a function jumps, both of its values are points.

        Raises:
            SamplingError: the boundaries are too far away, or need too many samples.
        """
        points = _sampled(self, self._breaks())
        following = np.abs(points[:, 2::2] - points[:, 1:-1:2]).max(axis=0)
        keep = np.ones(points.shape[1], bool)
        keep[1:-1:2] = following > SAME  # else the start of the next interval stands for both
        return points[:, keep]

    def _breaks(self) -> Array:
        """Return the (n,) ends of the intervals in which all functions are smooth."""
        road = self._road
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


def _sampled(lines: Boundaries, breaks: Array) -> Complex:
    """Return (rows, 2 n) points of both ends of n intervals, in the order of s."""
    a, b = breaks[:-1], breaks[1:]
    rows = len(lines.rows) + 1
    pieces = np.ceil((b - a) / MAX_SPACING)
    starts: list[Array] = []
    ends: list[Complex] = []
    count = 0
    fractions = _QUARTERS
    for _ in range(_PASSES):
        count += int(pieces.sum()) * rows
        if count > MAX_SAMPLES:
            raise SamplingError(f"its boundaries need more than {MAX_SAMPLES} points")
        a, b = _divided(a, b, pieces.astype(int))
        s = a + (b - a) * fractions  # (f, n)
        points = lines(s.ravel(), np.broadcast_to((a + b) / 2, s.shape).ravel())
        points = points.reshape(rows, len(fractions), len(a))
        deviation = _deviation(points)
        if not (deviation < 2 * MAX_COORDINATE).all():  # true for NaN too
            raise SamplingError(f"its boundaries are not within {2 * MAX_COORDINATE:g} m")
        bad = (deviation > CHORD_ERROR) & (b - a > 2 * SHORTEST)
        starts.append(a[~bad])
        ends.append(points[:, :: len(fractions) - 1, ~bad])
        if not bad.any():
            break
        a, b, pieces = a[bad], b[bad], _pieces(points[:, :, bad])
        fractions = _QUARTERS if lines.negative else _HALVES  # widths cut at 0 have kinks
    order = np.concatenate(starts).argsort()
    both = np.concatenate(ends, axis=2)[:, :, order]  # (rows, 2, n)
    if not np.abs(both).max() < 2 * MAX_COORDINATE:  # true for NaN too
        raise SamplingError(f"its boundaries are not within {2 * MAX_COORDINATE:g} m")
    return both.transpose(0, 2, 1).reshape(len(both), -1)


def _divided(a: Array, b: Array, pieces: np.ndarray) -> tuple[Array, Array]:
    """Return the intervals from a to b, each divided into pieces."""
    if (pieces == 1).all():
        return a, b
    first = np.repeat(np.cumsum(pieces) - pieces, pieces)
    step = np.repeat((b - a) / pieces, pieces)
    index = np.arange(len(first)) - first
    start = np.repeat(a, pieces) + index * step
    end = np.where(index + 1 == np.repeat(pieces, pieces), np.repeat(b, pieces), start + step)
    return start, end


def _deviation(points: Complex) -> Array:
    """Return (n,) largest distances of the points inside from the chord; (rows, f, n) points."""
    chord = points[:, -1:] - points[:, :1]
    inside = points[:, 1:-1] - points[:, :1]
    size = np.abs(chord)
    is_closed = size == 0
    deviation = np.abs((inside * chord.conj()).imag) / np.where(is_closed, 1.0, size)
    if is_closed.any():
        deviation = np.where(is_closed, np.abs(inside), deviation)
    found: Array = deviation.max(axis=(0, 1))
    return found


def _pieces(points: Complex) -> Array:
    """Return (n,) numbers of pieces whose chords are near enough; (rows, f, n) points.

    The distance from a chord is an eighth of the second difference at the ends of two pieces. At
    the ends of the interval, it is extrapolated.
    """
    second = np.abs(points[:, 2:] - 2 * points[:, 1:-1] + points[:, :-2]).max(axis=0)  # (f - 2, n)
    largest = second.max(axis=0)
    if len(second) > 1:
        extrapolated = np.maximum(2 * second[0] - second[1], 2 * second[-1] - second[-2])
        largest = np.maximum(largest, extrapolated)
    count = (points.shape[1] - 1) * np.sqrt(largest / (8 * CHORD_ERROR))
    return np.clip(np.ceil(count), 2, MAX_PIECES)
