"""Hypotheses about the error of GNSS, weighed by how well each predicts the fixes.

In a street canyon the error of a fix is ten times that of the open road, and the receiver need not
know it. So a filter that has not been told the error carries a bank of filters, which differ in the
standard deviation and the correlation time of the error only (``GNSS_ERRORS``; multiple models:
Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, section
11.6). In another one, the odometry is wrong, and GNSS is as on the open road: without it, the bank
would take wrong odometry for an error of GNSS. If it is likelier than all others, GNSS and odometry
contradict each other (``consistency``).

The weights are those of Bayes, by the likelihoods of innovations. Four things make them robust:

    renewal       At any time, the error may be replaced by an independent one of any hypothesis:
                  another satellite, another street. So each filter is mixed with one that has the
                  pose of the whole bank, and an error about which nothing is known. This is how
                  the bank forgets, and how a jump of the error leaves the pose alone.
    dependence    No hypothesis is exactly right, so fixes that follow each other closely are no
                  independent evidence for one: those of ``INDEPENDENT`` count as a single one.
    outliers      A fix is one with the density ``OUTLIER`` whatever the hypothesis. So one that
                  all filters reject says nothing about them, and a hypothesis that rejects what
                  another one predicts soon has no weight.
    discarding    The likeliest one loses its weight if its innovations have a mean that they cannot
                  have (``consistency``), unless it is a ramp on an open road (``drift``). The least
                  bad one need not be good.

``Localisation`` has the K filters of each of n cars as n K rows, those of a car in a row. A filter
that has been told the error has K = 1. A fix that states its own error overrides all hypotheses.
An error that is told is not renewed, but may change at once (``changed``).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from ..values.linalg import squared_distance
from .association import GATES, Verdict
from .drift import GOES_ON
from .motion_model import ERRORS, GNSS, SPEED, YAW_RATE, N
from .observation_models import Innovation
from .sensor_errors import GaussMarkov, SensorErrors

Array = NDArray[np.float64]

#: The errors of GNSS that are weighed: that of the open road, those of canyons, with increments of
#: each size and with long and short correlation times, and that of a fix that is off for a while.
GNSS_ERRORS = (
    SensorErrors.UNKNOWN_GNSS,
    GaussMarkov(4.0, 60.0),
    GaussMarkov(4.0, 8.0),
    GaussMarkov(14.0, 60.0),
    GaussMarkov(12.0, 10.0),
    GaussMarkov(32.0, 60.0),
    GaussMarkov(32.0, 10.0),
    GaussMarkov(100.0, 60.0),
)
#: Errors of odometry that is wrong [m/s, rad/s], which is the last hypothesis.
WRONG_SPEED, WRONG_YAW_RATE = GaussMarkov(5.0, 10.0), GaussMarkov(0.1, 10.0)
#: Probabilities of the hypotheses, where nothing else is known.
PRIOR = np.array([4.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.3, 0.5]) / 10.8
#: States that each hypothesis renews: (K, N).
_RENEWED = np.zeros((len(PRIOR), N), dtype=bool)
_RENEWED[:-1, GNSS] = True
_RENEWED[-1, [SPEED, YAW_RATE]] = True
#: Processes of GNSS.
_OF_GNSS = slice(GNSS.start - 3, GNSS.stop - 3)
#: Mean time until the error is replaced by another one [s].
RENEWAL = 100.0
#: Time within which fixes are no independent evidence for a hypothesis [s].
INDEPENDENT = 3.0
#: Factor of the weight of a hypothesis whose innovations contradict it.
DISCARDED = 1e-9
#: Least weight before a renewal, so that there is one.
LEAST = 1e-100
#: Squared distance from which on an error that is told may have changed, of 1e-5 in a right filter.
CHANGED = float(chdtri(2, 1e-5))
#: Density of a fix that is an outlier [1/m^2]: a tenth of the fixes, with a sigma of 200 m.
OUTLIER = 0.1 / (2 * math.pi * 200.0**2)


class Bank(NamedTuple):
    """Hypotheses about the errors of the sensors of n cars, K each."""

    weight: Array  #: (n, K) probabilities
    #: (n, K, 2, N - 3) standard deviations and correlation times [s] of the errors, as at present
    processes: Array
    at: Array  #: (n,) time of the last fix [s]
    drift: Array  #: (n,) standard deviation of what GNSS may be off by a drift [m]
    drift_at: float  #: time of it [s]

    @property
    def rows(self) -> Array:
        """(n K, 2, N - 3) standard deviations and correlation times of the errors."""
        return self.processes.reshape(-1, 2, N - 3)

    @property
    def gnss_sigma(self) -> Array:
        """(n K,) standard deviations of the GNSS error [m]."""
        return self.rows[:, 0, _OF_GNSS.start]

    @property
    def likeliest(self) -> NDArray[np.intp]:
        """(n,) rows of the likeliest hypotheses."""
        n, K = self.weight.shape
        return np.arange(n) * K + self.weight.argmax(axis=1)

    @property
    def of_open_road(self) -> slice:
        """Rows of the first hypotheses: the open road, or the error that is told."""
        return slice(None, None, self.weight.shape[1])

    @property
    def blames_odometry(self) -> NDArray[np.bool_]:
        """(n,) cars of which it is likelier than not that the odometry is wrong."""
        n, K = self.weight.shape
        return self.weight[:, -1] > 0.5 if K > 1 else np.full(n, False)


def bank(n: int, t: float, errors: SensorErrors) -> Bank:
    """Return the bank of n cars before the first fix.

    Args:
        n: number of cars.
        t: [s].
        errors: of the sensors.
    """
    processes = hypotheses(errors)
    weight = np.tile(first_weight(len(processes)), (n, 1))
    return Bank(weight, np.tile(processes, (n, 1, 1, 1)), np.full(n, t), np.zeros(n), t)


def hypotheses(errors: SensorErrors) -> Array:
    """Return the (K, 2, N - 3) standard deviations and correlation times of all hypotheses.

    K is 1 if the error of GNSS is known.
    """
    found = [errors]
    if errors.gnss is None:
        found = [replace(errors, gnss=one) for one in GNSS_ERRORS]
        found.append(replace(found[0], speed=WRONG_SPEED, yaw_rate=WRONG_YAW_RATE))
    return np.array([[one.sigmas, one.times] for one in found])


def prior(K: int) -> Array:
    """Return the (K,) probabilities of the hypotheses, where nothing else is known."""
    return np.ones(1) if K == 1 else PRIOR


def first_weight(K: int) -> Array:
    """Return the (K,) weights before the first fix: nothing speaks against the odometry yet."""
    weight = prior(K).copy()
    if K > 1:
        weight[-1] = 0.0
    return weight / weight.sum()


def mixture(mean: Array, cov: Array, weight: Array) -> tuple[Array, Array]:
    """Return the (n, m) means and (n, m, m) covariances of the mixtures of n K rows.

    >>> mixture(np.array([[0.0], [2.0]]), np.ones((2, 1, 1)), np.array([[0.5, 0.5]]))
    (array([[1.]]), array([[[2.]]]))
    """
    n, K = weight.shape
    if K == 1:
        return mean, cov
    m = mean.shape[-1]
    means, covs = mean.reshape(n, K, m), cov.reshape(n, K, m, m)
    whole = (weight[..., None] * means).sum(axis=1)
    d = means - whole[:, None]
    scaled = np.sqrt(weight)[..., None] * d
    spread = scaled.swapaxes(1, 2) @ scaled
    return whole, np.asarray((weight[..., None, None] * covs).sum(axis=1)) + spread


def stated(
    mean: Array, cov: Array, held: Bank, error: Array, known: Array
) -> tuple[Array, Array, Array, Bank]:
    """Return rows whose GNSS error is that of the fix, where it states it.

    An error of another size keeps what the two have in common: the smaller one is a part of the
    larger one, so that their covariance is the smaller variance.
    What a drift may add (``Bank.drift``) is in the error, too.

    Args:
        mean: (n K, N).
        cov: (n K, N, N).
        held: the bank.
        error: (n, 2) standard deviation [m] and correlation time [s]; NaN where not stated.
        known: (K, 2, N - 3) processes of the hypotheses, for fixes that do not state it.

    Returns:
        (n K, N) means, (n K, N, N) covariances, (n K, N) factors of the states, and the bank.
    """
    factor = np.ones(mean.shape)
    new = np.tile(known, (len(error), 1, 1, 1))
    is_stated = ~np.isnan(error[:, 0])
    new[is_stated, :, :, _OF_GNSS] = error[is_stated, None, :, None]
    drifts = held.drift > 0
    new[drifts, :, 0, _OF_GNSS] = np.hypot(
        new[drifts, :, 0, _OF_GNSS], held.drift[drifts, None, None]
    )
    new[drifts, :, 1, _OF_GNSS] = new[drifts, :, 1, _OF_GNSS].clip(min=GOES_ON)
    before = held.gnss_sigma**2
    held = held._replace(processes=new)
    after = held.gnss_sigma**2
    if (before == after).all():
        return mean, cov, factor, held
    share = np.where(after < before, after / np.where(before > 0, before, 1.0), 1.0)
    factor[:, GNSS] = share[:, None]
    mean, cov = factor * mean, factor[:, :, None] * cov * factor[:, None]
    rows = range(GNSS.start, GNSS.stop)
    cov[:, rows, rows] += (after - share**2 * before)[:, None]
    return mean, cov, factor, held


def changed(
    cov: Array, held: Bank, found: Innovation, told: NDArray[np.bool_]
) -> tuple[Array, NDArray[np.bool_]]:
    """Return covariances in which an error that is told may have changed at once.

    Another satellite, another reflection: a fix that is far beyond the gate, but by no more than
    two errors of the size that is told may differ, is no outlier. The error has changed then. What
    the pose and the error before have in common is kept, so a change says nothing about the pose,
    however often there is one.

    Args:
        cov: (n K, N, N).
        held: the bank.
        found: innovations of the n K rows, before.
        told: (n,) cars that know the error.

    Returns:
        (n K, N, N) covariances, and (n K,) whether they are others.
    """
    variance = np.where(np.repeat(told, held.weight.shape[1]), 2 * held.gnss_sigma**2, 0.0)
    S = found.S[:, 0] + variance[:, None, None] * np.eye(2)
    inside = squared_distance(found.residual[:, 0], S) <= GATES[2]
    is_other = (found.squared[:, 0] > CHANGED) & (variance > 0) & inside
    is_other &= found.verdict[:, 0] == Verdict.OUTLIER
    rows = range(GNSS.start, GNSS.stop)
    cov = cov.copy()
    cov[:, rows, rows] += np.where(is_other, variance, 0.0)[:, None]
    return cov, is_other


def renewed(
    mean: Array, cov: Array, held: Bank, given: NDArray[np.bool_], t: float
) -> tuple[Array, Array, Array, Bank]:
    """Return rows whose errors may have been renewed since the last fix.

    A row is the mixture of itself and of one that has the pose of the bank, and does not know the
    error that it is about.

    Args:
        mean: (n K, N).
        cov: (n K, N, N).
        held: the bank.
        given: (n,) cars that have a fix of which the error is not stated.
        t: time of it [s].

    Returns:
        (n K, N) means, (n K, N, N) covariances, (n K, N) factors of the states, and the bank.
    """
    n, K = held.weight.shape
    factor = np.ones(mean.shape)
    if K == 1 or not given.any():
        return mean, cov, factor, held
    renewal = np.where(given, -np.expm1(-(t - held.at) / RENEWAL), 0.0)[:, None]
    fresh = renewal * prior(K)
    weight = (1 - renewal) * held.weight.clip(min=LEAST) + fresh
    share = (fresh / weight).ravel()
    # The pose of a car whose odometry is wrong is not to be spread.
    right = weight * (np.arange(K) < K - 1)
    whole, P = mixture(mean, cov, right / right.sum(axis=1, keepdims=True))
    is_new = np.tile(_RENEWED, (n, 1))
    keep = ~is_new
    whole = np.repeat(whole, K, axis=0) * keep
    P = np.repeat(P, K, axis=0) * keep[:, :, None] * keep[:, None]
    rows = range(ERRORS.start, ERRORS.stop)
    P[:, rows, rows] += is_new[:, ERRORS] * held.rows[:, 0] ** 2
    d = whole - mean
    both = (share * (1 - share))[:, None, None] * d[:, :, None] * d[:, None]
    cov = cov + share[:, None, None] * (P - cov) + both
    factor -= is_new * np.repeat(renewal, K, axis=0)
    return mean + share[:, None] * d, cov, factor, held._replace(weight=weight)


def weighed(held: Bank, found: Innovation, given: NDArray[np.bool_], t: float) -> Bank:
    """Return the bank after a fix.

    Args:
        held: the bank.
        found: innovations of the n K rows.
        given: (n,) cars that have a fix.
        t: time of it [s].
    """
    n, K = held.weight.shape
    if K == 1 or not given.any():
        return held
    determinant = np.linalg.det(found.S[:, 0])
    density = np.exp(-found.squared[:, 0] / 2) / (2 * math.pi * np.sqrt(determinant))
    inlier = np.where(found.verdict[:, 0] == Verdict.USED, density, 0.0).reshape(n, K)
    evidence = np.minimum((t - held.at) / INDEPENDENT, 1.0)[:, None]
    weight = held.weight * np.maximum(inlier, OUTLIER) ** evidence
    weight = np.where(given[:, None], weight / weight.sum(axis=1, keepdims=True), held.weight)
    return held._replace(weight=weight, at=np.where(given, t, held.at))


def discarded(held: Bank, cars: NDArray[np.bool_]) -> Bank:
    """Return the bank without the weight of the likeliest hypotheses of (n,) cars."""
    weight = held.weight.copy()
    row = np.flatnonzero(cars)
    weight[row, held.weight[row].argmax(axis=1)] *= DISCARDED
    return held._replace(weight=weight / weight.sum(axis=1, keepdims=True))
