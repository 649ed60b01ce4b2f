"""Levels of what a line has of its own: a covariance in a few bits.

What a line has of its own, apart from the error of the pose, has a known structure. The misfit of
the cubic and a common offset of the map move the line sideways, independent errors of the map
points bend it. So its covariance is modelled as

    a^2 e e^T + p^2 N(spacing, phase)

with e the direction of y_off and N the covariance of a cubic through points with independent unit
errors in any direction. They are at equal distances along the line. The first one is ahead of the
end of the range by a phase, a share of that distance. One raw value k stands for both: the phase is
the fraction of k times the golden ratio. So next to any spacing and phase there is a level, and
where the points are dense, and the phase does not matter, the spacings are fine.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ...seen_lines import NODES, bases
from ..message.requirement import OCTAVE
from ..message.signals import Signal
from .code import Array
from .joint import divergence, largest_ratio

#: Raw values above the least one of the points' level that are tried.
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


class OwnLevels:
    """Code of covariances of what lines have of their own, as levels.

    Args:
        lateral: signal of log2 a [m]; the raw value 0 means a = 0.
        points: signal of log2 p [m]; the raw value 0 means p = 0.
        spacing: signal of the spacing, or with the unit ``OCTAVE`` of its exponent of 2. Its raw
            values stand for the phase, too.
    """

    def __init__(self, lateral: Signal, points: Signal, spacing: Signal) -> None:
        self.lateral, self.points, self.spacing = lateral, points, spacing
        self.signals = (lateral, points, spacing)

    def noise(self, means: Array, fit_ranges: Array) -> Array:
        """Return the (L, S, 4, 4) N of lines for all raw values of the spacing, as for ``encode``.

        Args:
            means: (L, 4) lines.
            fit_ranges: (L, 2) ranges [m].
        """
        raw = np.arange(self.spacing.raw_min, self.spacing.raw_max + 1)
        lines = zip(means, fit_ranges, strict=True)
        return np.array([point_noise(*line, *self._arrangement(raw)) for line in lines])

    def _arrangement(self, raw: NDArray[np.int64]) -> tuple[Array, Array]:
        """Return spacings and phases."""
        raw = raw.clip(self.spacing.raw_min, self.spacing.raw_max)
        spacing = self.spacing.physical(raw)
        if self.spacing.unit == OCTAVE:
            spacing = np.exp2(spacing)
        return spacing, np.asarray(raw * GOLDEN_RATIO % 1.0)

    def decode(
        self, raw: Mapping[str, NDArray[np.int64]], means: Array, fit_ranges: Array
    ) -> Array:
        """Return the (L, 4, 4) covariances of (L,) raw values by signal."""
        J = bases(means, fit_ranges)
        p = _level(self.points, raw[self.points.name])
        arranged = zip(*self._arrangement(raw[self.spacing.name]), strict=True)
        noise = [
            point_noise(mean, fit_range, *np.reshape(one, (2, 1)))[0]
            for mean, fit_range, one in zip(means, fit_ranges, arranged, strict=True)
        ]
        cov = J @ (p[:, None, None] ** 2 * np.reshape(noise, (-1, 4, 4))) @ J.swapaxes(1, 2)
        cov[:, 0, 0] += _level(self.lateral, raw[self.lateral.name]) ** 2
        return np.asarray(cov + cov.swapaxes(1, 2)) / 2

    def encode(
        self, target: Array, common: Array, true: Array, J: Array, noise: Array
    ) -> tuple[dict[str, NDArray[np.int64]], NDArray[np.bool_]]:
        """Return raw values of levels that cover targets together with common covariances.

        Of all spacings and some levels of the points, those are chosen with the least cost: the
        divergence from the true covariance plus the logarithm of the largest ratio of variances,
        of the lateral position or the direction of the line at nine places of its range.

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
        E, C, T = (((X + X.swapaxes(1, 2)) / 2)[:, None, None] for X in (E, C, T))
        # That of points far apart may be singular.
        whitening = np.linalg.inv(np.linalg.cholesky(noise[..., 1:, 1:] + 1e-6 * np.eye(3)))
        whitened = whitening @ E[:, 0, :, 1:, 1:] @ whitening.swapaxes(-1, -2)  # (L, S, 3, 3)
        least = np.linalg.eigvalsh(whitened)[..., -1].clip(1e-30)
        least_raw = np.ceil(_raw(self.points, np.sqrt(least))).clip(self.points.raw_min + 1)
        lines = np.arange(len(E))[:, None]
        _, _, cost = self._cost(E, C, T, noise, least_raw[..., None] + TRIED[1:2])
        chosen = cost[..., 0].argsort(axis=1, kind="stable")[:, :CHOSEN]
        raw_p, raw_a, cost = self._cost(
            E, C, T, noise[lines, chosen], least_raw[lines, chosen][..., None] + TRIED
        )
        best = cost.reshape(len(E), -1).argmin(axis=1)
        at = (lines[:, 0], *np.unravel_index(best, cost.shape[1:]))
        raw = {
            self.lateral: raw_a[at],
            self.points: raw_p[at],
            self.spacing: chosen[at[:2]] + self.spacing.raw_min,
        }
        limited = {s.name: s.limited(values).astype(np.int64) for s, values in raw.items()}
        return limited, np.isfinite(cost[at])

    def _cost(
        self, E: Array, C: Array, true: Array, noise: Array, raw_p: Array
    ) -> tuple[Array, Array, Array]:
        """Return raw levels of points and lateral levels that cover targets E, and their cost.

        E, C and true are (L, 1, 1, 4, 4), the noise is (L, S, 4, 4), the others are (L, S, T).
        """
        p = _level(self.points, raw_p)
        M = p[..., None, None] ** 2 * noise[:, :, None] - E  # (L, S, T, 4, 4)
        short = _shortfall(M)
        level_a = _raw(self.lateral, np.sqrt(short.clip(1e-30)))
        raw_a = np.where(short > 0, np.ceil(level_a).clip(1), 0)
        decoded = C + M + E
        decoded[..., 0, 0] += _level(self.lateral, raw_a) ** 2
        with np.errstate(invalid="ignore", divide="ignore"):
            cost = divergence(true, decoded) + np.log(largest_ratio(decoded, true))
        possible = (raw_p <= self.points.raw_max) & (raw_a <= self.lateral.raw_max)
        return raw_p, raw_a, np.where(possible & np.isfinite(cost), cost, np.inf)


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
