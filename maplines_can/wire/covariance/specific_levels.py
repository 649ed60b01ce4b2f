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

from ...values.elementary import exp2, log2, tan
from ...values.fixed_order import congruence, inverse, product, total
from ...values.seen_lines import NODES, SHAPE
from ..layout.signals import OCTAVE, Signal
from .code import Array
from .joint import LN_2, TRIANGLE, compared, entries_first, largest_ratio

#: log2 of the level b of the shape [m]: that of the raw value 0, which means b = 0, and by how much
#: that of the greatest raw value exceeds it.
SHAPE_OFFSET, SHAPE_OCTAVES = -10.0, 10.2
#: Values of r, by the remainder of the raw value of the shape.
RATIOS = np.array([0.0, *np.cumprod([0.5, 1.8, 1.8, 1.8, 1.8])])
#: Raw values above the least one of the level of the points, or of the shape, that are tried.
TRIED = np.array([0, 1, 2, 3, 5])
#: Spacings for which the second of them is tried, at most, and those of the best of these for which
#: all are. The first ones for which it is tried; of the others, only those that may be better.
SPACINGS, CHOSEN, FIRST = 256, 16, 24
#: More than any level squared [m^2].
BEYOND = 1e100
#: Added to the variances that errors of points cause: those of points far apart may be singular.
SINGULAR = 1e-6
#: Entries without those of T_0, of the lower triangle, column by column.
_LOWER = ((1, 1), (2, 1), (3, 1), (2, 2), (3, 2), (3, 3))
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

    def _near_noise(self, arc: Arc) -> Array:
        """Return (4, 4, L, S) ``noise`` at all raw values that are searched, of straight lines.

        They are stretched as the others are on average, and choose the same spacings, or nearly so.
        """
        squared = (arc.stretch.min(axis=-1) * arc.stretch.max(axis=-1))[:, None]
        noise = np.empty((4, 4, len(squared), len(self.searched)))
        *of_points, of_shape = self.straight
        for (i, j), values in zip(TRIANGLE, of_points, strict=True):
            noise[i, j] = noise[j, i] = squared * values
        for i in range(4):
            noise[i, i] += of_shape * SHAPE[i]
        return noise

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

    def spacings(
        self, target: Array, common: Array, true: Array, J: Array, arc: Arc
    ) -> NDArray[np.int64]:
        """Return the (L, K) raw values of the shape that suit the errors of points best.

        Of all that are searched, they have the least cost with one level of the points. Arguments
        as for ``encode``.
        """
        E, C, T = _in_metres(target, common, true, J)
        near, last = self._near_noise(arc), self.points.raw_max
        least = _least_by_variances(self._points_squared, near, E)
        second = self._points_squared.take(least + TRIED[1], mode="clip")
        bound = _least_cost(second * near, C, T)
        cost = np.full(bound.shape, np.inf)

        def assess(line: NDArray[np.intp], k: NDArray[np.intp]) -> None:
            own, of_line = near[:, :, line, k], E[..., line, 0]
            raw = least_raw(self._points_squared, own, of_line, least[line, k]) + TRIED[1]
            own = self._points_squared.take(raw, mode="clip") * own
            _, found = self._cost(of_line, C[..., line, 0], T[..., line, 0], own)
            found = np.where(raw > last, np.inf, found)
            cost[line, k] = np.where(bound[line, k] > found, bound[line, k], found)

        first = bound.argsort(axis=1, kind="stable")[:, :FIRST]
        assess(np.arange(len(first)).repeat(first.shape[1]), first.ravel())
        others = ~(bound > np.sort(cost, axis=1)[:, :CHOSEN][:, -1:])
        others[np.arange(len(first))[:, None], first] = False
        assess(*np.nonzero(others))
        return np.asarray(self.searched[cost.argsort(axis=1, kind="stable")[:, :CHOSEN]])

    def encode(
        self,
        target: Array,
        common: Array,
        true: Array,
        J: Array,
        arc: Arc,
        spacings: NDArray[np.int64],
    ) -> tuple[dict[str, NDArray[np.int64]], NDArray[np.bool_]]:
        """Return raw values of levels that cover targets together with common covariances.

        Of some spacings with some levels of the points, and of some levels of the shape alone,
        those are chosen with the least cost: the divergence from the true covariance plus the
        logarithm of the largest ratio of variances, of the lateral position or the direction of
        the line at nine places of its range.

        Args:
            target: (L, 4, 4) symmetric matrices to be covered; they may be indefinite.
            common: (L, 4, 4) what is added to the covariances of the levels, of the coefficients of
                T_0 .. T_3.
            true: (L, 4, 4) the covariances to which the sums are to be close.
            J: (L, 4, 4) derivatives of ``bases``.
            arc: of the lines.
            spacings: (L, K) of ``spacings``, for this target or a similar one.

        Returns:
            (L,) raw values by signal, and the (L,) lines whose targets they cover.
        """
        E, C, T = _in_metres(target, common, true, J)
        noise = entries_first(self.noise(arc, spacings))
        p, of_points = _levels_tried(self._points_squared, noise, E)
        shape = np.diag(SHAPE)[..., None, None] + np.zeros((len(J), 1))
        k_shape, of_shape = _levels_tried(self._shapes_squared, shape, E)
        k = np.concatenate([spacings.repeat(len(TRIED), axis=1), k_shape], axis=1)
        raw_p = np.concatenate([p, np.zeros_like(k_shape)], axis=1)
        own = np.concatenate([of_points, of_shape], axis=3)
        raw_a, cost = self._cost(E, C, T, own)
        bound = _least_cost(own, C, T)
        cost = np.where(bound > cost, bound, cost)
        cost[(raw_p > self.points.raw_max) | (k > self.shape.raw_max)] = np.inf
        best = np.arange(len(k)), cost.argmin(axis=1)
        raw = {self.lateral: raw_a[best], self.points: raw_p[best], self.shape: k[best]}
        limited = {s.name: s.limited(values).astype(np.int64) for s, values in raw.items()}
        return limited, np.isfinite(cost[best])

    def covered(
        self,
        raw: Mapping[str, NDArray[np.int64]],
        target: Array,
        common: Array,
        J: Array,
        means: Array,
        fit_ranges: Array,
    ) -> NDArray[np.bool_]:
        """Return the (L,) lines whose targets raw levels cover. Arguments as for ``encode``."""
        wanted = congruence(inverse(J), target) - common
        return _shortfall(entries_first(self.decode(raw, means, fit_ranges) - wanted)) <= 0

    def _shape_level(self, raw: NDArray[np.int64] | Array) -> Array:
        """Return the levels b of raw values of the shape [m]."""
        return np.where(raw == 0, 0.0, exp2(SHAPE_OFFSET + self._shape_step * raw))

    def _cost(self, E: Array, C: Array, true: Array, own: Array) -> tuple[NDArray[np.int64], Array]:
        """Return lateral levels with which covariances cover targets E, and their cost.

        E, C and true are (4, 4, L, 1), own is (4, 4, L, K), the others are (L, K).
        """
        raw_a = np.searchsorted(self._lateral_squared, _shortfall(own - E))
        decoded = C + own
        decoded[0, 0] += self._lateral_squared.take(raw_a, mode="clip")
        true, decoded = (np.moveaxis(X, (0, 1), (-2, -1)) for X in (true, decoded))
        with np.errstate(invalid="ignore", divide="ignore"):
            divergence, ratio = compared(true, decoded)
            cost = divergence + LN_2 * log2(ratio * largest_ratio(decoded, true))
        possible = (raw_a <= self.lateral.raw_max) & np.isfinite(cost)
        return raw_a, np.where(possible, cost, np.inf)


def _in_metres(target: Array, common: Array, true: Array, J: Array) -> tuple[Array, Array, Array]:
    """Return targets less what is common, that, and true covariances, as (4, 4, L, 1) entries.

    They are those of the coefficients of T_0 .. T_3.
    """
    to_metres = inverse(J)
    wanted, of_true = (congruence(to_metres, X) for X in (target, true))
    E, C, T = (entries_first(X)[..., None] for X in (wanted - common, common, of_true))
    return E, C, T


def _levels_tried(squared: Array, covs: Array, E: Array) -> tuple[NDArray[np.int64], Array]:
    """Return raw values of levels for (4, 4, L, K) covariances, and what these become with them.

    Those of one covariance come one after the other: (L, K * n) raw values and (4, 4, L, K * n).
    """
    least = least_raw(squared, covs, E, _least_by_variances(squared, covs, E))
    raw = (least[..., None] + TRIED).reshape(len(least), -1)
    return raw, squared.take(raw, mode="clip") * covs.repeat(len(TRIED), axis=3)


def _least_by_variances(squared: Array, covs: Array, E: Array) -> NDArray[np.int64]:
    """Return the (...,) least raw values, 1 or more, whose multiples cover all variances but one.

    Arguments as for ``least_raw``.
    """
    needed = np.zeros(())
    with np.errstate(invalid="ignore", over="ignore"):
        for i in range(1, 4):
            quotient = E[i, i] / (covs[i, i] + SINGULAR)
            needed = np.where(quotient > needed, quotient, needed)
    return np.searchsorted(squared, needed).clip(1)


def least_raw(squared: Array, covs: Array, E: Array, begin: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the (...,) least raw values whose multiples of a covariance cover, but for entry 0.

    They are one more than the greatest raw value if none covers.

    Args:
        squared: (n,) squares of the levels of all raw values, which increase.
        covs: (4, 4, ...) covariances for the level 1.
        E: (4, 4, ...) what is to be covered.
        begin: (...,) raw values to begin with, of which those below do not cover.
    """
    low, high, step = begin - 1, np.full_like(begin, len(squared)), 1
    rest = {(i, j): covs[i, j] + (SINGULAR if i == j else 0.0) for i, j in _LOWER}
    while (is_open := high - low > 1).any():
        middle = low + np.minimum(step, (high - low) // 2)
        level = squared.take(middle, mode="clip")
        a, b, c, d, e, f = (level * rest[ij] - E[ij] for ij in _LOWER)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            d1 = d - b * b / a
            e1 = e - b * c / a
            f2 = f - c * c / a - e1 * e1 / d1
        covers = (a > 0) & (d1 > 0) & (f2 > 0)
        low, high = (
            np.where(is_open & ~covers, middle, low),
            np.where(is_open & covers, middle, high),
        )
        step *= 2
    return high


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def _least_cost(own: Array, C: Array, true: Array) -> Array:
    """Return lower bounds of the (...,) costs of (4, 4, ...) covariances own + C; 0 or NaN if none.

    Let r be the largest ratio of the variances of the direction of the line, at five places of its
    range, to the true ones. If it is more than 1, the divergence is (1 / r - 1 + ln r) / 2 at
    least, and ln r is 2 (r - 1) / (r + 1) at least.
    """
    r = np.ones(())
    for variance, true_one in zip(_directions(own + C), _directions(true), strict=True):
        ratio = variance / true_one
        r = np.where(ratio > r, ratio, r)
    return np.asarray((r - 1) * (5 * r - 1) / (2 * r * (r + 1)))


def _directions(S: Array) -> list[Array]:
    """Return variances of the derivative with respect to w at -1, 1, -1/2, 1/2 and 0.

    S has the (4, 4, ...) entries of covariances.
    """
    at_ends = S[1, 1] + 16 * S[2, 2] + 81 * S[3, 3] + 18 * S[3, 1]
    end = 8 * S[2, 1] + 72 * S[3, 2]
    between, half = S[1, 1] + 4 * S[2, 2], 4 * S[2, 1]
    centre = S[1, 1] - 6 * S[3, 1] + 9 * S[3, 3]
    return [at_ends - end, at_ends + end, between - half, between + half, centre]


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def _shortfall(M: Array) -> Array:
    """Return what to add to entry (0, 0) of (4, 4, ...) matrices to make them semidefinite.

    It is beyond all levels if nothing does: the rest of the matrix is not definite.
    """
    # The Cholesky factor of the rest, with the last row of a 4x4 matrix that ends with entry 0.
    a, b, c, d, e, f = (M[ij] for ij in _LOWER)
    g, h, i = M[1, 0], M[2, 0], M[3, 0]
    d1 = d - b * b / a
    e1, h1 = e - b * c / a, h - b * g / a
    f2 = f - c * c / a - e1 * e1 / d1
    i2 = i - c * g / a - e1 * h1 / d1
    short = g * g / a + h1 * h1 / d1 + i2 * i2 / f2 - M[0, 0]
    definite = (a > 0) & (d1 > 0) & (f2 > 0) & np.isfinite(short)
    return np.where(definite, short, BEYOND)


def _level(signal: Signal, raw: NDArray[np.int64] | Array) -> Array:
    """Return the levels of raw values: 0 for 0, else 2 to the power of the physical value."""
    return np.where(raw == 0, 0.0, exp2(signal.physical(raw)))
