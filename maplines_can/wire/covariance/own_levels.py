"""Levels of what a line has of its own: a covariance in a few bits.

What a line has of its own, apart from the error of the pose, has a known structure. The misfit of
the cubic and a common offset of the map move the line sideways, independent errors of the map
points bend it. So its covariance is modelled as

    a^2 e e^T + p^2 N(spacing)

with e the direction of y_off and N the covariance of a cubic through points with independent unit
errors. N depends on the spacing of the points in relation to the range in which the cubic is
fitted. In the coefficients of the normalised variable w, -1 to 1 in that range, it is a table of a
4x4 matrix for each level of the spacing.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ...line import line_of_cubic
from ..message.signals import Signal
from .code import Array

#: Points at which a line is fitted, in the normalised variable.
NODES = np.cos(np.pi * np.arange(64) / 63)[::-1]
#: Positions of the map points relative to the range, over which N is averaged [spacings].
PHASES = (0.0, 0.25, 0.5, 0.75)
#: Raw values above the least one of the points' level that are tried.
TRIED = np.array([1, 2, 3, 5, 8])


def bases(means: Array, fit_ranges: Array) -> Array:
    """Return the (L, 4, 4) derivatives of lines with respect to their coefficients of w^0 .. w^3.

    Args:
        means: (L, 4) lines.
        fit_ranges: (L, 2) ranges [m].
    """
    centre, half = fit_ranges.mean(axis=1), np.diff(fit_ranges, axis=1)[:, 0] / 2
    shape = (4, 4, len(means))
    q = np.broadcast_to(np.eye(4)[:, :, None], shape)
    J = line_of_cubic(q, np.broadcast_to(centre, shape[1:]), np.broadcast_to(half, shape[1:]))
    J = J.transpose(1, 2, 0).copy()  # (L, parameters, coefficients)
    J[:, 1] = np.tan(J[:, 1]) * np.cos(means[:, 1, None]) ** 2
    return J


@lru_cache
def point_noise(spacing: float) -> Array:
    """Return the (4, 4) covariance of the coefficients of w^0 .. w^3 for unit errors of points.

    ``spacing`` is their distance in units of half the range.
    """
    V = np.linalg.pinv(np.vander(NODES, 4, increasing=True))
    cov = np.zeros((4, 4))
    for phase in PHASES:
        position = (NODES + 1) / spacing + phase
        below = np.floor(position).astype(int)
        share = position - below
        W = np.zeros((len(NODES), below[-1] + 2))
        W[np.arange(len(NODES)), below] = 1 - share
        W[np.arange(len(NODES)), below + 1] = share
        VW = V @ W
        cov += VW @ VW.T / len(PHASES)
    return cov


class OwnLevels:
    """Code of covariances of what lines have of their own, as levels.

    Args:
        lateral: signal of log2 a [m]; the raw value 0 means a = 0.
        points: signal of log2 p [m]; the raw value 0 means p = 0.
        spacing: signal of log2 of the spacing.
    """

    def __init__(self, lateral: Signal, points: Signal, spacing: Signal) -> None:
        self.lateral, self.points, self.spacing = lateral, points, spacing
        raws = np.arange(spacing.raw_min, spacing.raw_max + 1)
        self._noise = np.array([point_noise(2.0**level) for level in spacing.physical(raws)])
        self._whitening = np.linalg.inv(np.linalg.cholesky(self._noise[:, 1:, 1:]))

    def decode(self, raw: Mapping[str, NDArray[np.int64]], J: Array) -> Array:
        """Return the (L, 4, 4) covariances of (L,) raw values by signal.

        ``J`` are the (L, 4, 4) derivatives of ``bases``.
        """
        cov = np.zeros((len(J), 4, 4))
        p = _level(self.points, raw[self.points.name])
        place = raw[self.spacing.name] - self.spacing.raw_min
        noise = self._noise.take(place, axis=0, mode="clip")
        cov += J @ (p[:, None, None] ** 2 * noise) @ J.swapaxes(1, 2)
        cov[:, 0, 0] += _level(self.lateral, raw[self.lateral.name]) ** 2
        return (cov + cov.swapaxes(1, 2)) / 2

    def encode(
        self, target: Array, rest: Array, J: Array, resolution: Array
    ) -> tuple[dict[str, NDArray[np.int64]], Array]:
        """Return raw values whose covariances cover targets, and the divergence that they cost.

        Of all spacings and some levels of the points, those are chosen for which the whole
        covariance of the line is closest.

        Args:
            target: (L, 4, 4) symmetric matrices to be covered; they may be indefinite.
            rest: (L, 4, 4) the other part of the covariance of the lines: that of the pose.
            J: (L, 4, 4) derivatives of ``bases``.
            resolution: (4,) variances of the mean's rounding error, for the divergence: rest +
                target may be singular.

        Returns:
            (L,) raw values by signal, and the (L,) KL from rest + target + resolution to rest +
            the decoded covariance [nat], infinite if no levels cover the target.
        """
        inverse = np.linalg.inv(J)
        E = inverse @ target @ inverse.swapaxes(1, 2)  # in coefficients of w
        C = inverse @ rest @ inverse.swapaxes(1, 2)
        E, C = (E + E.swapaxes(1, 2)) / 2, (C + C.swapaxes(1, 2)) / 2
        whitened = (
            self._whitening @ E[:, None, 1:, 1:] @ self._whitening.swapaxes(1, 2)
        )  # (L, S, 3, 3)
        least = np.linalg.eigvalsh(whitened)[..., -1].clip(1e-30)
        raw_p = np.floor(_raw(self.points, np.sqrt(least)))[..., None] + TRIED  # (L, S, T)
        raw_p = raw_p.clip(self.points.raw_min + 1)
        p = _level(self.points, raw_p)
        M = p[..., None, None] ** 2 * self._noise[:, None] - E[:, None, None]  # (L, S, T, 4, 4)
        solved = np.linalg.solve(M[..., 1:, 1:], M[..., 1:, :1])[..., 0]
        short = (M[..., 0, 1:] * solved).sum(axis=-1) - M[..., 0, 0]
        raw_a = np.where(
            short > 0, np.ceil(_raw(self.lateral, np.sqrt(short.clip(1e-30)))).clip(1), 0
        )
        decoded = C[:, None, None] + M + E[:, None, None]
        decoded[..., 0, 0] += _level(self.lateral, raw_a) ** 2
        floor = (inverse * resolution) @ inverse.swapaxes(1, 2)
        kl = _divergence((C + E + floor)[:, None, None], decoded)
        possible = (raw_p <= self.points.raw_max) & (raw_a <= self.lateral.raw_max)
        kl = np.where(possible & np.isfinite(kl), kl, np.inf).reshape(len(E), -1)
        best = kl.argmin(axis=1)
        rows = np.arange(len(E))
        shape = raw_p.shape
        raw = {
            self.lateral.name: raw_a.reshape(len(E), -1)[rows, best],
            self.points.name: raw_p.reshape(len(E), -1)[rows, best],
            self.spacing.name: best // shape[-1] + self.spacing.raw_min,
        }
        limited = {
            signal.name: signal.limited(raw[signal.name]).astype(np.int64)
            for signal in (self.lateral, self.points, self.spacing)
        }
        return limited, kl[rows, best]


def _level(signal: Signal, raw: NDArray[np.int64]) -> Array:
    """Return the levels of raw values: 0 for 0, else 2 to the power of the physical value."""
    return np.where(raw == 0, 0.0, np.exp2(signal.physical(raw)))


def _raw(signal: Signal, level: Array) -> Array:
    """Return the raw values of positive levels, not rounded."""
    return (np.log2(level) - signal.offset) / signal.factor


@np.errstate(invalid="ignore", divide="ignore")
def _divergence(true: Array, decoded: Array) -> Array:
    """Return the (...,) KL of zero-mean Gaussians with (..., n, n) covariances [nat]."""
    n = true.shape[-1]
    ratio = np.linalg.solve(decoded, np.broadcast_to(true, decoded.shape))
    trace = np.trace(ratio, axis1=-2, axis2=-1)
    sign, log_det = np.linalg.slogdet(decoded)
    true_sign, true_log_det = np.linalg.slogdet(true)
    kl = (trace - n + log_det - true_log_det) / 2
    return np.where((sign > 0) & (true_sign > 0), kl, np.inf)
