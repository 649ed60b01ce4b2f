"""Levels of the line-specific covariance: a covariance in a few bits.

The line-specific part of the error of a line, which is not due to the pose, has a known structure.
A common offset of the map moves the line sideways, what the cubic misses makes its shape uncertain
(see ``propagation.cubic_fit``), and independent errors of the map points bend it. In the
coefficients of the Chebyshev polynomials T_0 .. T_3 its covariance is modelled as one of

    a^2 e e^T + b^2 SHAPE                                  without errors of points
    a^2 e e^T + p^2 (N(spacing, phase) + r^2 spacing SHAPE)

with e the direction of T_0, which is that of y_off, and N the covariance of a cubic through points
with independent unit errors in any direction. They are at equal distances along the line. The first
one is ahead of the end of the range by a phase, a share of that distance. One raw value k stands
for the spacing, the phase and r: the phase is the fraction of k times the golden ratio, and r is
given by the remainder of k. So next to any spacing and phase there is a level, and where the points
are dense, and the phase does not matter, the spacings are fine. Without errors of points k stands
for b.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from itertools import count
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...values.elementary import exp2, tan
from ...values.fixed_order import inverse, product, total
from ...values.seen_lines import NODES, SHAPE
from ..layout.signals import OCTAVE, Signal

Array = NDArray[np.float64]

#: log2 of the level b of the shape [m]: that of the raw value 0, which means b = 0, and by how much
#: that of the greatest raw value exceeds it.
SHAPE_OFFSET, SHAPE_OCTAVES = -10.0, 10.2
#: Values of r, by the remainder of the raw value of the shape.
RATIOS = np.array([0.0, *np.cumprod([0.5, 1.8, 1.8, 1.8, 1.8])])
#: Most spacings that an encoder tries.
SPACINGS = 256
#: Entries of the lower triangle of (4, 4) matrices, row by row.
TRIANGLE = [(i, j) for i in range(4) for j in range(i + 1)]
GOLDEN_RATIO = (1 + math.sqrt(5)) / 2


def _fit_matrix() -> Array:
    """Return the (4, K) matrix from values at the nodes to the coefficients of their cubic fit."""
    T_2 = 2 * NODES * NODES - 1
    T = np.stack([np.ones_like(NODES), NODES, T_2, 2 * NODES * T_2 - NODES])
    return product(inverse(total(T[:, None] * T)), T)


_FIT = _fit_matrix()


class Arc(NamedTuple):
    """Lengths of lines, at the nodes of their ranges."""

    stretch: Array  #: (..., K) derivative of the length with respect to x
    place: Array  #: (..., K) length up to the node, in halves of the whole length

    @classmethod
    def of(cls, mean: Array, fit_range: Array) -> Arc:
        """Return the lengths of (..., 4) lines in (..., 2) ranges [m]."""
        begin, end = fit_range[..., :1], fit_range[..., 1:]
        x = (begin + end) / 2 + (end - begin) / 2 * NODES
        _, beta, c0, c1 = np.moveaxis(mean, -1, 0)[..., None]
        slope = tan(beta) + x * (c0 + x * c1 / 2)
        stretch = np.sqrt(1 + slope * slope)
        steps = np.diff(x) * (stretch[..., 1:] + stretch[..., :-1])
        along = np.concatenate([np.zeros_like(begin), np.cumsum(steps, axis=-1)], axis=-1)
        return cls(stretch, 2 * along / along[..., -1:])


def point_noise(arc: Arc, spacing: Array, phase: Array) -> Array:
    """Return the (..., S, 4, 4) covariances of the coefficients of T_0 .. T_3 for unit errors.

    Args:
        arc: of (...) lines.
        spacing: (..., S) distances of the points along each line, in halves of its length.
        phase: (..., S) of these distances, by how much the first point is ahead of the range's
            start.
    """
    place = arc.place[..., None, :] / spacing[..., None] + phase[..., None]  # (..., S, K)
    below = place.astype(np.int64)
    share = place - below
    rows, points = spacing.size, int(below[..., -1].max()) + 2
    bins = below.reshape(rows, -1) + points * np.arange(rows)[:, None]
    W = np.empty((4, rows, points))
    # An error across the line acts on y by the factor ``stretch``.
    for i, row in enumerate(_FIT):
        weight = (row * arc.stretch)[..., None, :]
        ends = weight * (1 - share), weight * share
        of_below, of_above = (
            np.bincount(bins.ravel() + k, values.ravel(), rows * points)
            for k, values in enumerate(ends)
        )
        W[i] = (of_below + of_above).reshape(rows, points)
    cov = np.empty((rows, 4, 4))
    for i in range(4):
        for j in range(i + 1):  # one after the other, so that more points of other rows add 0
            cov[:, i, j] = cov[:, j, i] = np.cumsum(W[i] * W[j], axis=-1)[:, -1]
    return cov.reshape(*spacing.shape, 4, 4)


class SpecificLevels:
    """Code of line-specific covariances as levels.

    Args:
        lateral: signal of log2 a [m]; the raw value 0 means a = 0.
        points: signal of log2 p [m]; the raw value 0 means p = 0.
        shape: signal of the spacing, or with the unit ``OCTAVE`` of its exponent of 2. Its raw
            values stand for the phase and r, too, and for b if p = 0.
    """

    def __init__(self, lateral: Signal, points: Signal, shape: Signal) -> None:
        self.lateral, self.points, self.shape = lateral, points, shape
        self.signals = (lateral, points, shape)
        self._shape_step = SHAPE_OCTAVES / max(1, shape.raw_max)
        raw = np.arange(shape.raw_max + 1)
        #: Squares of the levels of all raw values [m^2].
        self._lateral_squared, self._points_squared, self._shapes_squared = (
            level * level
            for level in (
                _level(lateral, np.arange(lateral.raw_max + 1)),
                _level(points, np.arange(points.raw_max + 1)),
                self._shape_level(raw),
            )
        )
        #: Spacing, phase and r^2 times the spacing, by raw value of the shape.
        self._spacing = shape.physical(raw)
        if shape.unit == OCTAVE:
            self._spacing = exp2(self._spacing)
        turns = raw * GOLDEN_RATIO
        self._phase: Array = turns - np.floor(turns)
        ratio = RATIOS[raw % len(RATIOS)]
        self._amount = ratio * ratio * self._spacing

    @cached_property
    def straight(self) -> Array:
        """(11, S) covariances of a straight line, at the raw values that ``searched`` has.

        The lower triangle for errors of points of 1 m, row by row, and by how much the shape adds
        to it [m^2]. They have single precision, as in the tables of the C core.
        """
        raw = self.searched
        line = Arc.of(np.zeros(4), np.array([0.0, 1.0]))
        noise = point_noise(line, self._spacing[raw], self._phase[raw])
        rows = [noise[:, i, j] for i, j in TRIANGLE]
        return np.array([*rows, self._amount[raw]], dtype=np.float32).astype(float)

    @cached_property
    def searched(self) -> NDArray[np.int64]:
        """(S,) raw values of the shape that an encoder tries: all, or at equal distances.

        The distance has no common divisor with the number of ``RATIOS``.
        """
        first, last = self.shape.raw_min, self.shape.raw_max
        least = -(-(last + 1 - first) // SPACINGS)
        step = next(n for n in count(least) if math.gcd(n, len(RATIOS)) == 1)
        return np.arange(first, last + 1, step)

    def noise(self, arc: Arc, raw: NDArray[np.int64]) -> Array:
        """Return the (..., S, 4, 4) covariances of (...) lines for p = 1 m.

        They are those of the coefficients of T_0 .. T_3.

        Args:
            arc: of the lines.
            raw: (..., S) raw values of the shape.
        """
        noise = point_noise(arc, self._spacing[raw], self._phase[raw])
        return np.asarray(noise + self._amount[raw][..., None, None] * np.diag(SHAPE))

    def decode(
        self, raw: Mapping[str, NDArray[np.int64]], means: Array, fit_ranges: Array
    ) -> Array:
        """Return the (L, 4, 4) covariances of the coefficients of T_0 .. T_3 of (L,) raw values."""
        of_points, of_lateral, k = (raw[s.name] for s in (self.points, self.lateral, self.shape))
        k = k.clip(0, self.shape.raw_max)
        own = np.where(of_points == 0, self._shapes_squared[k], 0.0)[:, None, None] * np.diag(SHAPE)
        if (rows := np.flatnonzero(of_points)).size:
            noise = self.noise(Arc.of(means[rows], fit_ranges[rows]), k[rows, None])[:, 0]
            squared = self._points_squared.take(of_points[rows], mode="clip")
            own[rows] = squared[:, None, None] * noise
        own[:, 0, 0] += self._lateral_squared.take(of_lateral, mode="clip")
        return np.asarray(own)

    def _shape_level(self, raw: NDArray[np.int64] | Array) -> Array:
        """Return the levels b of raw values of the shape [m]."""
        return np.where(raw == 0, 0.0, exp2(SHAPE_OFFSET + self._shape_step * raw))


def _level(signal: Signal, raw: NDArray[np.int64] | Array) -> Array:
    """Return the levels of raw values: 0 for 0, else 2 to the power of the physical value."""
    return np.where(raw == 0, 0.0, exp2(signal.physical(raw)))
