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

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ...values.seen_lines import NODES, SHAPE, bases
from ..layout.signals import OCTAVE, Signal
from .code import Array
from .joint import divergence, largest_ratio

#: log2 of the level b of the shape [m]: that of the raw value 0, which means b = 0, and by how much
#: that of the greatest raw value exceeds it.
SHAPE_OFFSET, SHAPE_OCTAVES = -10.0, 10.2
#: Values of r, by the remainder of the raw value of the shape.
RATIOS = np.array([0.0, *(0.5 * 1.8 ** np.arange(5))])
#: Raw values above the least one of the level of the points, or of the shape, that are tried.
TRIED = np.array([0, 1, 2, 3, 5])
#: Spacings for which all of them are tried: the best ones for the second.
CHOSEN = 24
#: More than any level squared [m^2].
BEYOND = 1e100
GOLDEN_RATIO = (1 + 5**0.5) / 2
#: (4, K) matrix from values at the nodes to the coefficients of their cubic fit.
_FIT = np.linalg.pinv(np.polynomial.chebyshev.chebvander(NODES, 3))


def point_noise(mean: Array, fit_range: Array, spacing: Array, phase: Array) -> Array:
    """Return the (S, 4, 4) covariances of the coefficients of T_0 .. T_3 for unit errors of points.

    Args:
        mean: (4,) line.
        fit_range: (2,) [m].
        spacing: (S,) distances of the points along the line, in halves of its length.
        phase: (S,) of these distances, by how much the first point is ahead of the range's start.
    """
    x = fit_range.mean() + np.ptp(fit_range) / 2 * NODES
    stretch = np.hypot(1.0, np.tan(mean[1]) + x * (mean[2] + x * mean[3] / 2))
    along = np.append(0.0, np.cumsum(np.diff(x) * (stretch[1:] + stretch[:-1])))
    place = 2 * along / along[-1] / spacing[:, None] + phase[:, None]  # (S, K)
    below = place.astype(np.int64)
    share = place - below
    points = int(below[:, -1].max()) + 2
    below += points * np.arange(len(spacing))[:, None]
    W = np.empty((len(spacing), 4, points))
    # An error across the line acts on y by the factor ``stretch``.
    for i, row in enumerate(_FIT * stretch):
        ends = [np.ravel(row * (1 - share)), np.ravel(row * share)]
        both = [
            np.bincount(below.ravel() + k, end, len(spacing) * points) for k, end in enumerate(ends)
        ]
        W[:, i] = (both[0] + both[1]).reshape(len(spacing), points)
    return np.asarray(W @ W.swapaxes(1, 2))


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

    def noise(self, means: Array, fit_ranges: Array) -> Array:
        """Return the (L, S, 4, 4) covariances for p = 1 m of all raw values of the shape.

        They are those of the coefficients of T_0 .. T_3.

        Args:
            means: (L, 4) lines.
            fit_ranges: (L, 2) ranges [m].
        """
        raw = np.arange(self.shape.raw_min, self.shape.raw_max + 1)
        lines = zip(means, fit_ranges, strict=True)
        return np.array([self._noise(*line, raw) for line in lines])

    def _noise(self, mean: Array, fit_range: Array, raw: NDArray[np.int64]) -> Array:
        """Return the (S, 4, 4) covariances of a line for p = 1 m."""
        raw = raw.clip(self.shape.raw_min, self.shape.raw_max)
        spacing = self.shape.physical(raw)
        if self.shape.unit == OCTAVE:
            spacing = np.exp2(spacing)
        noise = point_noise(
            mean, fit_range, spacing, np.asarray(raw * GOLDEN_RATIO % 1.0, dtype=float)
        )
        amount = RATIOS[raw % len(RATIOS)] ** 2 * spacing
        return np.asarray(noise + amount[:, None, None] * np.diag(SHAPE))

    def decode(
        self, raw: Mapping[str, NDArray[np.int64]], means: Array, fit_ranges: Array
    ) -> Array:
        """Return the (L, 4, 4) covariances of (L,) raw values by signal."""
        J = bases(means, fit_ranges)
        p = _level(self.points, raw[self.points.name])
        k = raw[self.shape.name].clip(self.shape.raw_min, self.shape.raw_max)
        noise = np.zeros((len(means), 4, 4))
        for i in np.flatnonzero(p):
            noise[i] = self._noise(means[i], fit_ranges[i], k[i : i + 1])[0]
        b = np.where(p == 0, self._shape_level(k), 0.0)
        own = p[:, None, None] ** 2 * noise
        own += b[:, None, None] ** 2 * np.diag(SHAPE)
        cov = J @ own @ J.swapaxes(1, 2)
        cov[:, 0, 0] += _level(self.lateral, raw[self.lateral.name]) ** 2
        return np.asarray(cov + cov.swapaxes(1, 2)) / 2

    def encode(
        self, target: Array, common: Array, true: Array, J: Array, noise: Array
    ) -> tuple[dict[str, NDArray[np.int64]], NDArray[np.bool_]]:
        """Return raw values of levels that cover targets together with common covariances.

        Of all spacings and some levels of the points, and of some levels of the shape alone, those
        are chosen with the least cost: the divergence from the true covariance plus the logarithm
        of the largest ratio of variances, of the lateral position or the direction of the line at
        nine places of its range.

        Args:
            target: (L, 4, 4) symmetric matrices to be covered; they may be indefinite.
            common: (L, 4, 4) what is added to the covariances of the levels.
            true: (L, 4, 4) the covariances to which the sums are to be close.
            J: (L, 4, 4) derivatives of ``bases``.
            noise: (L, S, 4, 4) that of ``noise``.

        Returns:
            (L,) raw values by signal, and the (L,) lines whose targets they cover.
        """
        inverse = np.linalg.inv(J)
        # In coefficients of T_0 .. T_3:
        E, C, T = (inverse @ X @ inverse.swapaxes(1, 2) for X in (target - common, common, true))
        E, C, T = (((X + X.swapaxes(1, 2)) / 2)[:, None] for X in (E, C, T))
        lines = np.arange(len(E))
        k_points, p, of_points = self._points_tried(E, C, T, noise)
        k_shape, of_shape = self._shapes_tried(E)
        k = np.concatenate([k_points, k_shape], axis=1)
        raw_p = np.concatenate([p, np.zeros_like(k_shape)], axis=1)
        raw_a, cost = self._cost(E, C, T, np.concatenate([of_points, of_shape], axis=1))
        cost[(raw_p > self.points.raw_max) | (k > self.shape.raw_max)] = np.inf
        best = lines, cost.argmin(axis=1)
        raw = {self.lateral: raw_a[best], self.points: raw_p[best], self.shape: k[best]}
        limited = {s.name: s.limited(values).astype(np.int64) for s, values in raw.items()}
        return limited, np.isfinite(cost[best])

    def _points_tried(
        self, E: Array, C: Array, true: Array, noise: Array
    ) -> tuple[Array, Array, Array]:
        """Return (L, K) raw values of the shape and the points, and their (L, K, 4, 4) covariances.

        Arguments as for ``_cost``, and the (L, S, 4, 4) of ``noise``.
        """
        # That of points far apart may be singular.
        whitening = np.linalg.inv(np.linalg.cholesky(noise[..., 1:, 1:] + 1e-6 * np.eye(3)))
        whitened = whitening @ E[..., 1:, 1:] @ whitening.swapaxes(-1, -2)  # (L, S, 3, 3)
        least = np.linalg.eigvalsh(whitened)[..., -1].clip(1e-30)
        least_raw = np.ceil(_raw(self.points, np.sqrt(least))).clip(self.points.raw_min + 1)

        def covs(raw_p: Array, of: Array) -> Array:
            return np.asarray(_level(self.points, raw_p)[..., None, None] ** 2 * of)

        raw_p = least_raw + TRIED[1]
        _, cost = self._cost(E, C, true, covs(raw_p, noise))
        cost[raw_p > self.points.raw_max] = np.inf
        chosen = cost.argsort(axis=1, kind="stable")[:, :CHOSEN]
        rows = np.arange(len(E))[:, None]
        k = np.asarray(chosen + self.shape.raw_min, dtype=float).repeat(len(TRIED), axis=1)
        raw_p = (least_raw[rows, chosen][..., None] + TRIED).reshape(k.shape)
        return k, raw_p, covs(raw_p, noise[rows, chosen].repeat(len(TRIED), axis=1))

    def _shapes_tried(self, E: Array) -> tuple[Array, Array]:
        """Return (L, K) raw values of levels of the shape, and their (L, K, 4, 4) covariances."""
        scale = 1 / np.sqrt(SHAPE[1:])
        scaled = E[:, 0, 1:, 1:] * np.outer(scale, scale)
        least = np.sqrt(np.linalg.eigvalsh(scaled)[:, -1].clip(1e-30))
        k = np.ceil((np.log2(least) - SHAPE_OFFSET) / self._shape_step)[:, None] + TRIED
        k = k.clip(max(1, self.shape.raw_min))
        return k, self._shape_level(k)[..., None, None] ** 2 * np.diag(SHAPE)

    def _shape_level(self, raw: NDArray[np.int64] | Array) -> Array:
        """Return the levels b of raw values of the shape [m]."""
        return np.where(raw == 0, 0.0, np.exp2(SHAPE_OFFSET + self._shape_step * raw))

    def _cost(self, E: Array, C: Array, true: Array, own: Array) -> tuple[Array, Array]:
        """Return lateral levels with which covariances cover targets E, and their cost.

        E, C and true are (L, 1, 4, 4), own is (L, K, 4, 4), the others are (L, K).
        """
        M = own - E
        short = _shortfall(M)
        level_a = _raw(self.lateral, np.sqrt(short.clip(1e-30)))
        raw_a = np.where(short > 0, np.ceil(level_a).clip(1), 0)
        decoded = C + own
        decoded[..., 0, 0] += _level(self.lateral, raw_a) ** 2
        with np.errstate(invalid="ignore", divide="ignore"):
            cost = divergence(true, decoded) + np.log(largest_ratio(decoded, true))
        possible = (raw_a <= self.lateral.raw_max) & np.isfinite(cost)
        return raw_a, np.where(possible, cost, np.inf)


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def _shortfall(M: Array) -> Array:
    """Return what to add to entry (0, 0) of (..., 4, 4) matrices to make them semidefinite.

    It is beyond all levels if nothing does: the rest of the matrix is not definite.
    """
    # The Cholesky factor of the rest, with the last row of a 4x4 matrix that ends with entry 0.
    a, b, c = M[..., 1, 1], M[..., 2, 1], M[..., 3, 1]
    d, e, f = M[..., 2, 2], M[..., 3, 2], M[..., 3, 3]
    g, h, i = M[..., 0, 1], M[..., 0, 2], M[..., 0, 3]
    d1 = d - b * b / a
    e1, h1 = e - b * c / a, h - b * g / a
    f2 = f - c * c / a - e1 * e1 / d1
    i2 = i - c * g / a - e1 * h1 / d1
    short = g * g / a + h1 * h1 / d1 + i2 * i2 / f2 - M[..., 0, 0]
    definite = (a > 0) & (d1 > 0) & (f2 > 0) & np.isfinite(short)
    return np.where(definite, short, BEYOND)


def _level(signal: Signal, raw: NDArray[np.int64] | Array) -> Array:
    """Return the levels of raw values: 0 for 0, else 2 to the power of the physical value."""
    return np.where(raw == 0, 0.0, np.exp2(signal.physical(raw)))


def _raw(signal: Signal, level: Array) -> Array:
    """Return the raw values of positive levels, not rounded."""
    return (np.log2(level) - signal.offset) / signal.factor
