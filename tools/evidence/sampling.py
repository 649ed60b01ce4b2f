"""Importance sampling of errors that are too rare to wait for."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.special import ndtr, ndtri

from maplines_can.simulation.camera import PLACES, Errors
from maplines_can.values.line import lateral, transform_line_or_nan

from .drive_view import DriveView

Array = NDArray[np.float64]

#: Correlation times within which a path is drawn.
MEMORY = 8.0
#: Standard errors to the ends of a 95 % confidence interval.
Z95 = 1.96


class Probability(NamedTuple):
    """Estimate of a probability, with its 95 % confidence interval."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, weights: Array) -> Probability:
        """Return the mean of (n,) weighted samples."""
        value = float(weights.mean())
        half = Z95 * float(weights.std(ddof=1)) / math.sqrt(len(weights))
        return cls(value, max(0.0, value - half), value + half)


def excursion_probability(
    K: float, rho: float, samples: int, draws: int, rng: np.random.Generator
) -> Probability:
    """Estimate P(max |u_k| > K) over the samples of a stationary AR(1) process of variance 1.

    The estimator is that of Adler, Blanchet, Liu (Efficient Monte Carlo for high excursions of
    Gaussian random fields, 2012). A time is drawn at random, the process there from its tails
    beyond K, and the rest of the path given that. The density of such a path relative to the true
    one is N / (samples P(|u| > K)), where N is the number of its samples beyond K. So each path
    counts samples P(|u| > K) / N: the relative error is small for any K. Only the path within
    ``MEMORY`` correlation times is drawn; what is beyond K farther away is neglected, which makes
    the estimate slightly too large.

    Args:
        K: the level.
        rho: autocorrelation of successive samples, less than 1.
        samples: of a path.
        draws: number of paths.
        rng: random numbers.
    """
    outside = math.erfc(K / math.sqrt(2))
    tail = ndtri(0.5 * outside * (1 - rng.random(draws)))  # below -K
    weights, near = np.empty(draws), math.ceil(MEMORY / (1 - rho))
    for i, start in enumerate(tail):
        at = int(rng.integers(samples))
        # By symmetry, the side does not matter. Both directions in time are AR(1) again.
        paths = (_path(start, rho, min(n, near), rng) for n in (at, samples - 1 - at))
        beyond = 1 + sum(int((np.abs(path) > K).sum()) for path in paths)
        weights[i] = samples * outside / beyond
    return Probability.of(weights)


def _path(start: float, rho: float, n: int, rng: np.random.Generator) -> Array:
    """Return the n samples of an AR(1) process after the first one."""
    noise = math.sqrt(1 - rho * rho) * rng.standard_normal(n)
    return np.asarray(lfilter([1.0], [1.0, -rho], noise, zi=[rho * start])[0])


def tail_probability(
    view: DriveView, k: int, place: int, K: float, errors: Errors, draws: int, seed: int
) -> Probability:
    """Estimate P(|error| > K sigma) of the lane centre of a received scene.

    Errors of pose and map are drawn about the most likely ones that make the error K sigma to
    either side (mean shift), and weighted by the ratio of the densities. The error is that of the
    cubics seen from the erroneous pose, so it need not be linear or Gaussian; sigma is that of the
    decoded covariance.

    Args:
        view: of a drive.
        k: index of its time.
        place: index in ``PLACES``.
        K: the level in decoded standard deviations.
        errors: true ones of pose and map.
        draws: number of samples.
        seed: of the samples.
    """
    rng, x = np.random.default_rng(seed), PLACES[place]
    fit = view.fit_ranges[k]
    window = fit[:, 0], fit[:, 1]
    L = np.diag(errors.pose_sigma)

    def centre(u: Array) -> Array:
        lines = transform_line_or_nan(view.lines[k], (u @ L)[:, None], window)
        return np.asarray(lateral(lines, x).mean(axis=1))

    step = 1e-3
    steps = np.vstack([np.zeros(3), step * np.eye(3)])
    gradient = centre(steps)[1:] - centre(steps)[0]
    gradient /= step
    J = np.tile([1.0, x, x**2 / 2, x**3 / 6], 2) / 2
    sigma = math.sqrt(gradient @ gradient + J @ view.own[k] @ J)
    own = np.array([errors.map_offset, errors.map_heading * x]) / math.sqrt(2)
    direction = np.append(gradient, own)
    shift = K * sigma * direction / (direction @ direction)
    side = rng.choice([-1.0, 1.0], draws)[:, None]
    u = side * shift + rng.standard_normal((draws, 5))
    error = centre(u[:, :3]) + u[:, 3:] @ own - view.true[k, :, place].mean()
    error = np.where(np.isnan(error), np.inf, error)  # no line: counts as exceeded
    log_ratio = u @ shift - shift @ shift / 2, -(u @ shift) - shift @ shift / 2
    weights = 1 / (0.5 * np.exp(log_ratio[0]) + 0.5 * np.exp(log_ratio[1]))
    return Probability.of(weights * (np.abs(error) > K * sigma))


def nominal(K: float) -> float:
    """Return P(|u| > K) of a normal variable."""
    return float(2 * ndtr(-K))
