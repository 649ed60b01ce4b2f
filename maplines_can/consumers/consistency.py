"""Test of whether residuals with errors that last are plausible, with a rate of false alarms."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.special import chdtri

#: Correlation times of what lines and cameras have of their own [s]. An error of a map changes
#: within some 20 m, or hardly within a kilometre.
FAST, SLOW = 1.0, 30.0
#: The longest window has about this many correlation times of the pose error, and at least
#: ``SLOW``: for so long, the filter takes what grows slowly for an error of a map or of a camera.
#: A lasting fault of b standard deviations adds b^2 / 2 to the noncentrality of the sum for each.
#: In longer windows, the test would find what it is not for, such as small errors that last
#: longer than the model says.
CORRELATION_TIMES = 8.0
#: The shortest window of more than one cycle [s].
SHORTEST = 0.125
#: Ratio of the lengths of windows. With 2, every tenth alarm would be that of two windows.
RATIO = 4.0
#: Most false alarms that can be designed [1/h].
MOST_ALARMS = 10.0
HOUR = 3600.0


class ResidualModel(NamedTuple):
    """Covariances of residuals ``z = H delta + f + g + v`` of a cycle, for n residuals.

    The error ``delta`` of the pose lasts for its correlation time, ``f`` for ``FAST`` and ``g`` for
    ``SLOW``; ``v`` is white. An error of a line whose correlation time is not known, but between
    both, is in ``f`` and in ``g`` with its full covariance: then the sum of their spectra is at
    least 0.7 of its own at each frequency, and mostly more than it.
    """

    H: NDArray[np.float64]  #: (n, 3) derivative with respect to along, across and heading
    pose_cov: NDArray[np.float64]  #: (3, 3)
    fast_cov: NDArray[np.float64]  #: (n, n)
    slow_cov: NDArray[np.float64]  #: (n, n)
    noise_cov: NDArray[np.float64]  #: (n, n) of v, positive definite

    @property
    def marginal(self) -> NDArray[np.float64]:
        """(n, n) covariance of the residuals of one cycle."""
        return self.H @ self.pose_cov @ self.H.T + self.fast_cov + self.slow_cov + self.noise_cov


class ResidualFilter:
    """Kalman filter for residuals whose errors are Gauss-Markov processes.

    The state s is (delta, f, g). Its prediction keeps the marginal covariance that the model states
    for each cycle, also where that changes, and turns the pose error with the car:

        s' = E D R s + w,   E = exp(-dt / T),   cov(w) = S' - E D R S R^T D E

    with the stationary covariances S and S' of the two cycles, the rotation R of (along, across),
    the ratio D of the standard deviations, and the diagonal matrix E for the times T of the three
    errors. Without a fault, the innovations are white.

    Args:
        batch: shape of the leading axes of the residuals. All of them have the same model, so the
            gain is computed once.
    """

    def __init__(self, batch: tuple[int, ...] = ()) -> None:
        self._batch = batch
        self._keys: tuple[object, ...] = ()
        self._mean = np.zeros((*batch, 3))
        self._cov = self._stationary = np.zeros((3, 3))
        self._G = np.zeros((0, 3))

    def predict(
        self,
        model: ResidualModel,
        dt: float,
        correlation_time: float,
        turn: float = 0.0,
        keys: tuple[object, ...] | None = None,
    ) -> None:
        """Predict to the next cycle.

        Args:
            model: of that cycle.
            dt: time since the last one [s].
            correlation_time: of the pose error [s].
            turn: of the car since the last one [rad].
            keys: identities of the residuals; errors of new ones are unknown. None: the same ones.
        """
        n = len(model.H)
        stationary = block_diag(model.pose_cov, model.fast_cov, model.slow_cov)
        keys = tuple(range(n)) if keys is None else keys
        if keys != self._keys:
            self._select(keys)
        c, s = math.cos(turn), math.sin(turn)
        F = np.eye(3 + 2 * n)
        F[:2, :2] = [[c, s], [-s, c]]
        before = (F @ self._stationary @ F.T).diagonal()
        ratio = np.divide(
            stationary.diagonal(), before, out=np.zeros_like(before), where=before > 0
        )
        times = np.repeat([correlation_time, FAST, SLOW], [3, n, n])
        F *= (np.exp(-dt / times) * np.sqrt(ratio))[:, None]
        # The errors are independent of each other, so all of these matrices have three blocks.
        lost = stationary - F @ self._stationary @ F.T
        ends = pairwise((0, 3, 3 + n, 3 + 2 * n))
        noise = block_diag(*(positive_part(lost[a:b, a:b]) for a, b in ends))
        self._mean = self._mean @ F.T
        self._cov = F @ self._cov @ F.T + noise
        self._stationary = F @ self._stationary @ F.T + noise
        self._G = np.hstack([model.H, np.eye(n), np.eye(n)])

    def update(self, z: NDArray[np.float64], noise_cov: NDArray[np.float64]) -> NDArray[np.float64]:
        """Update with (..., n) residuals; return their (..., n) whitened innovations."""
        G, cov = self._G, self._cov
        S = G @ cov @ G.T + noise_cov
        innovation = z - self._mean @ G.T
        K = np.linalg.solve(S, G @ cov).T
        self._mean = self._mean + innovation @ K.T
        J = np.eye(len(cov)) - K @ G
        self._cov = J @ cov @ J.T + K @ noise_cov @ K.T  # Joseph's form stays definite
        return np.asarray(innovation @ np.linalg.inv(np.linalg.cholesky(S)).T)

    def _select(self, keys: tuple[object, ...]) -> None:
        """Keep the state of the residuals that remain."""
        kept = [key for key in keys if key in self._keys]
        of, to = (
            np.array(
                [0, 1, 2, *(3 + b * len(all_) + all_.index(key) for b in (0, 1) for key in kept)]
            )
            for all_ in (self._keys, keys)
        )
        mean = np.zeros((*self._batch, 3 + 2 * len(keys)))
        mean[..., to] = self._mean[..., of]
        covs = np.zeros((2, mean.shape[-1], mean.shape[-1]))
        for cov, old in zip(covs, (self._cov, self._stationary), strict=True):
            cov[np.ix_(to, to)] = old[np.ix_(of, of)]
        self._mean, (self._cov, self._stationary), self._keys = mean, covs, keys


class Verdict(NamedTuple):
    """Result of a test. Each field is of the shape of the batch."""

    statistic: NDArray[np.float64]  #: the largest one of this cycle, in units of its threshold
    alarm: NDArray[np.bool_]
    raised: NDArray[np.bool_]  #: the alarm begins in this cycle


class ConsistencyTest:
    """Chi-square test of residuals with a designed number of false alarms per hour.

    The innovations of ``ResidualFilter`` are whitened. Tested are each of them, and their sums in
    windows of 1/8, 1/2, 2, ... seconds, one after another, up to about 8 correlation times, and at
    least 32 s::

        1/8 s  |--|--|--|--|--|--|--|--|
        1/2 s  |-----------|-----------|     each is tested when it ends
        2 s    |--------------------------

    Without a fault, the squared norm of a sum of N, over N, is chi-square distributed, and windows
    of one length are independent. A window of the length W fails with the probability
    ``rate W / J``; so each of the J lengths contributes the same number of false alarms per hour,
    and they add up to the designed one. Single innovations detect what jumps; the sums, what grows
    or lasts.

    Each set of residuals has windows of its own, in the time in which it is seen.

    An alarm lasts until no test has failed for the longest window. A fault that lasts fails in it
    again, so it is one alarm.

    Args:
        false_alarms: expected number [1/h].
        batch: shape of the leading axes of the residuals.

    Raises:
        ValueError: the number is not more than 0 and at most 10.
    """

    def __init__(self, false_alarms: float, batch: tuple[int, ...] = ()) -> None:
        if not 0 < false_alarms <= MOST_ALARMS:
            raise ValueError(
                f"false_alarms must be more than 0 and up to {MOST_ALARMS:g} per hour, "
                f"got {false_alarms!r}"
            )
        self._rate = false_alarms / HOUR
        self._batch = batch
        self._filter = ResidualFilter(batch)
        self._windows: dict[object, _Windows] = {}
        self._calm = np.full(batch, np.inf)  # time since a test failed [s]

    def step(
        self,
        z: NDArray[np.float64],
        model: ResidualModel,
        dt: float,
        correlation_time: float,
        turn: float = 0.0,
        keys: tuple[object, ...] | None = None,
    ) -> Verdict:
        """Test (..., n) residuals.

        Args:
            z: the residuals.
            model: their covariances.
            dt: time since the last ones [s].
            correlation_time: of the pose error [s].
            turn: of the car within this time [rad].
            keys: identities of the residuals; None: the same as before.
        """
        self._filter.predict(model, dt, correlation_time, turn, keys)
        w = self._filter.update(z, model.noise_cov)
        lengths = window_lengths(correlation_time)
        # Lines that come and go do not begin the windows of the others anew.
        key = (w.shape[-1] if keys is None else keys), len(lengths)
        if key not in self._windows:
            self._windows[key] = _Windows(lengths, self._batch, w.shape[-1])
        share = self._rate / (len(lengths) + 1)
        single = (w**2).sum(axis=-1) / threshold(share * min(dt, SHORTEST), w.shape[-1])
        statistic = np.maximum(single, self._windows[key].add(w, dt, share))
        failed = statistic > 1
        alarmed = self._calm <= lengths[-1]
        self._calm = np.where(failed, 0.0, self._calm + dt)
        return Verdict(statistic, self._calm <= lengths[-1], failed & ~alarmed)


class _Windows:
    """Sums of whitened innovations in windows of several lengths.

    Args:
        lengths: of the windows, ascending [s].
        batch: shape of the leading axes of the innovations.
        n: number of innovations in a cycle.
    """

    def __init__(self, lengths: NDArray[np.float64], batch: tuple[int, ...], n: int) -> None:
        self.lengths, self.n = lengths, n
        self._time = 0.0
        self._sums = np.zeros((len(lengths), *batch, n))
        self._counts = np.zeros(len(lengths))
        self._durations = np.zeros(len(lengths))

    def add(self, w: NDArray[np.float64], dt: float, rate: float) -> NDArray[np.float64]:
        """Add (..., n) innovations; return the largest statistic of the windows that end.

        Args:
            w: whitened innovations.
            dt: time since the last ones [s].
            rate: false alarms per second for each length.

        Returns:
            (...,) in units of the thresholds; 0 if no window ends.
        """
        dt = min(dt, SHORTEST)  # no test is done in a gap
        before = np.floor(self._time / self.lengths + 1e-9)
        self._time += dt
        self._sums += w
        self._counts += 1
        self._durations += dt
        largest = np.zeros(w.shape[:-1])
        for i in np.flatnonzero(np.floor(self._time / self.lengths + 1e-9) > before):
            limit = threshold(rate * self._durations[i], self.n)
            square = (self._sums[i] ** 2).sum(axis=-1) / (self._counts[i] * limit)
            largest = np.maximum(largest, square)
            self._sums[i] = self._counts[i] = self._durations[i] = 0.0
        return largest


def window_lengths(correlation_time: float) -> NDArray[np.float64]:
    """Return the lengths of the windows of ``ConsistencyTest`` [s].

    They do not depend on small changes of the time, after which the sums would begin anew.

    >>> window_lengths(1.0)
    array([ 0.125,  0.5  ,  2.   ,  8.   , 32.   ])
    """
    longest = max(CORRELATION_TIMES * correlation_time, SLOW)
    most = round(math.log(longest / SHORTEST, RATIO))
    return SHORTEST * RATIO ** np.arange(most + 1.0)


def threshold(probability: float, n: int) -> float:
    """Return the value that a chi-square variable of n degrees of freedom exceeds so often.

    >>> round(threshold(0.01, 2), 3)
    9.21
    """
    return float(chdtri(n, probability))


def positive_part(cov: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a symmetric matrix without its negative eigenvalues."""
    values, vectors = np.linalg.eigh((cov + cov.T) / 2)
    return np.asarray((vectors * values.clip(0)) @ vectors.T)
