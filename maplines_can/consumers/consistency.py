"""Test of whether residuals with errors that last are plausible, with a rate of false alarms."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from ..values.linalg import block_diagonal
from .error_times import cover, transition

#: Correlation times of what lines and cameras have of their own [s]. An error of a map changes
#: within some 20 m, or hardly within a kilometre.
FAST, SLOW = 1.0, 30.0
#: The longest window has about this many correlation times of the pose error, and at least
#: ``SLOW``: for so long, the filter takes what grows slowly for an error of a map or of a camera.
#: A lasting fault of b standard deviations adds b^2 / 2 to the noncentrality of the sum for each.
#: In longer windows, the test would find what it is not for, such as small errors that last
#: longer than the model says.
CORRELATION_TIMES = 8.0
#: Longest correlation time that counts for the windows [s].
MAX_TIME = 60.0
#: The shortest window of more than one cycle [s].
SHORTEST = 0.125
#: Ratio of the lengths of windows. With 2, every tenth alarm would be that of two windows.
RATIO = 4.0
#: Most false alarms that can be designed [1/h].
MAX_ALARMS = 10.0
HOUR = 3600.0
#: Most correlation times of the pose error in the state, if a range of them is stated.
POSE_NODES = 3
#: Numbers of images in the sums that are tested in each image, in Gaussian noise and with heavy
#: tails.
SINGLE, SPANS = (1,), (4, 6, 8)
#: Probability with which a Gaussian innovation counts as an outlier, if there are heavy tails. With
#: 0.01, sums of four images of Student's t fail up to twice as often as those of Gaussian ones.
OUTLIERS = 0.02


@dataclass(frozen=True)
class CameraNoise:
    """What is known of the noise of a camera's lines beyond its covariance.

    The noise is a sum of independent parts whose covariances add up to the stated one, in any
    shares. One of them is white; the others are Gaussian and last.

    Args:
        correlation_time: the longest one of the parts that last [s]; 0 if all noise is white.
        heavy_tails: the white part has tails up to those of Student's t-distribution with four
            degrees of freedom; else it is Gaussian.
        period: least time between two images [s].

    Raises:
        ValueError: a value is out of range.
    """

    correlation_time: float = 1.0
    heavy_tails: bool = True
    period: float = 0.05

    def __post_init__(self) -> None:
        if not 0 <= self.correlation_time <= SLOW:
            raise ValueError(
                f"correlation_time must be 0 s to {SLOW:g} s, got {self.correlation_time!r}; state "
                "errors that last for longer in CameraBias"
            )
        if not 0 < self.period < math.inf:
            raise ValueError(f"period must be more than 0 s and finite, got {self.period!r}")


#: Gaussian noise that is new in each image.
WHITE_NOISE = CameraNoise(0.0, heavy_tails=False)


class ResidualModel(NamedTuple):
    """Covariances of residuals ``z = H delta + f + g + v`` of a cycle, for n residuals.

    The error ``delta`` of the pose lasts for its correlation time, ``f`` for ``FAST`` and ``g`` for
    ``SLOW``; ``v`` is as ``CameraNoise`` says. An error of a line whose correlation time is not
    known, but between both, is in ``f`` and in ``g`` with its full covariance: then the sum of
    their spectra is at least 0.7 of its own at each frequency, and mostly more than it.
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

    The state s has the pose error delta, f, g, and the part of the noise that lasts, c. Where a
    correlation time is known within a range only, the error is a sum of processes, each with a
    state of its own; see ``cover``. The prediction keeps the marginal covariance that the model
    states for each cycle, also where that changes, and turns the pose error with the car:

        s' = E D R s + w,   E = exp(-dt / T),   cov(w) = S' - E D R S R^T D E

    with the stationary covariances S and S' of the two cycles, the rotation R of (along, across),
    the ratio D of the standard deviations, and the diagonal matrix E for the times T of the
    errors. Without a fault, the covariance of all whitened innovations together is at most the
    identity, and it is the identity if all times are known.

    If the noise has heavy tails, an outlier changes the state the less, the greater it is. So the
    filter does not follow what jumps, either, and the sums of innovations find it.

    Args:
        batch: shape of the leading axes of the residuals. All of them have the same model, so the
            gain is computed once.
        noise: what is known of the noise.
    """

    def __init__(self, batch: tuple[int, ...] = (), noise: CameraNoise = WHITE_NOISE) -> None:
        self._batch, self._noise = batch, noise
        times, self._weight = cover(0.0, noise.correlation_time, noise.period)
        self._camera = times[times > 0]
        self._own_times = np.array([FAST, SLOW, *self._camera])
        self._keys: tuple[object, ...] = ()
        self._pose_blocks = np.zeros((POSE_NODES, 3, 3))  # stationary covariances
        self._own_blocks = np.zeros((len(self._own_times), 0, 0))
        self._mean = np.zeros((*batch, 3 * POSE_NODES))
        self._cov = np.zeros((3 * POSE_NODES,) * 2)
        self._G = np.zeros((0, 3 * POSE_NODES))

    def predict(
        self,
        model: ResidualModel,
        dt: float,
        correlation_time: float | tuple[float, float],
        turn: float = 0.0,
        keys: tuple[object, ...] | None = None,
        kept: NDArray[np.float64] | None = None,
    ) -> None:
        """Predict to the next cycle.

        Args:
            model: of that cycle.
            dt: time since the last one [s].
            correlation_time: of the pose error, or the shortest and the longest that it may have
                [s].
            turn: of the car since the last one [rad].
            keys: identities of the residuals; errors of new ones are unknown. None: the same ones.
            kept: (n,) largest correlations of the errors f of both cycles, from 0 to 1; 0 if it is
                another line, whose g is another one, too. None: 1.
        """
        n = len(model.H)
        keys = tuple(range(n)) if keys is None else keys
        if keys != self._keys:
            self._select(keys)
        times, weights = _pose_nodes(correlation_time, self._noise.period)
        c, s = math.cos(turn), math.sin(turn)
        R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        camera = np.broadcast_to(self._weight * model.noise_cov, (len(self._camera), n, n))
        own = np.stack([model.fast_cov, model.slow_cov, *camera])
        # Whether the error turns with the car or not, no more of it than this remains.
        decay = np.exp(-dt / times[:, None] - np.array([1.0, 1.0, 0.0]) * abs(turn))
        F_pose, Q_pose, self._pose_blocks = transition(
            self._pose_blocks, weights[:, None, None] * model.pose_cov, decay, R
        )
        decay = np.exp(-dt / self._own_times)[:, None].repeat(n, axis=1)
        if kept is not None:
            decay[0] = np.minimum(decay[0], kept)
            decay[1] *= kept > 0
        F_own, Q_own, self._own_blocks = transition(self._own_blocks, own, decay, np.eye(n))
        F = block_diagonal([*F_pose, *F_own])
        self._mean = self._mean @ F.T
        self._cov = F @ self._cov @ F.T + block_diagonal([*Q_pose, *Q_own])
        self._G = np.hstack([*[model.H] * POSE_NODES, *[np.eye(n)] * len(own)])

    def update(self, z: NDArray[np.float64], noise_cov: NDArray[np.float64]) -> NDArray[np.float64]:
        """Update with (..., n) residuals; return their (..., n) whitened innovations.

        Args:
            z: the residuals.
            noise_cov: (n, n) of the noise, as in the model.
        """
        G, cov = self._G, self._cov
        white = noise_cov * self._weight
        S = G @ cov @ G.T + white
        innovation = z - self._mean @ G.T
        w = np.asarray(innovation @ np.linalg.inv(np.linalg.cholesky(S)).T)
        K = np.linalg.solve(S, G @ cov).T
        if self._noise.heavy_tails:
            innovation = innovation * outlier_weight(w)
        self._mean = self._mean + innovation @ K.T
        J = np.eye(len(cov)) - K @ G
        self._cov = J @ cov @ J.T + K @ white @ K.T  # Joseph's form stays definite
        return w

    def _select(self, keys: tuple[object, ...]) -> None:
        """Keep the state of the residuals that remain."""
        kept = [key for key in keys if key in self._keys]
        blocks = range(len(self._own_blocks))

        def places(every: tuple[object, ...]) -> NDArray[np.int64]:
            first = (3 * POSE_NODES + b * len(every) for b in blocks)
            own = (at + every.index(key) for at in first for key in kept)
            return np.array([*range(3 * POSE_NODES), *own])

        of, to = places(self._keys), places(keys)
        size = 3 * POSE_NODES + len(blocks) * len(keys)
        mean, cov = np.zeros((*self._batch, size)), np.zeros((size, size))
        mean[..., to] = self._mean[..., of]
        cov[np.ix_(to, to)] = self._cov[np.ix_(of, of)]
        own = np.zeros((len(blocks), len(keys), len(keys)))
        of, to = (np.array([all_.index(key) for key in kept], int) for all_ in (self._keys, keys))
        own[:, to[:, None], to] = self._own_blocks[:, of[:, None], of]
        self._mean, self._cov, self._own_blocks, self._keys = mean, cov, own, keys


def _pose_nodes(
    correlation_time: float | tuple[float, float], period: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the (POSE_NODES,) times [s] and weights of the pose error; 0 for those not needed."""
    shortest, longest = np.broadcast_to(correlation_time, 2).tolist()
    found, weight = cover(shortest, longest, period, POSE_NODES)
    times, weights = np.full(POSE_NODES, longest), np.zeros(POSE_NODES)
    times[: len(found)], weights[: len(found)] = found, weight
    return times, weights


def outlier_weight(w: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (..., 1) weights of (..., n) whitened innovations, less than 1 for outliers."""
    square = (w**2).sum(axis=-1, keepdims=True)
    return np.asarray(np.minimum(1.0, threshold(OUTLIERS, w.shape[-1]) / square.clip(1e-9)))


class ConsistencyResult(NamedTuple):
    """Result of a test. Each field is of the shape of the batch."""

    statistic: NDArray[np.float64]  #: the largest one of this cycle, in units of its threshold
    alarm: NDArray[np.bool_]
    raised: NDArray[np.bool_]  #: the alarm begins in this cycle


class ConsistencyTest:
    """Chi-square test of residuals with at most a designed number of false alarms per hour.

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
    or lasts. If a correlation time is known within a range only, the covariance of a sum is less
    than that of white innovations, and so is the number of false alarms.

    If the noise has heavy tails, an outlier counts with the length of ``OUTLIERS`` only, and the
    sums of the last ``SPANS`` innovations take the place of each of them.

    Each set of residuals has windows of its own, in the time in which it is seen.

    An alarm lasts until no test has failed for the longest window. A fault that lasts fails in it
    again, so it is one alarm.

    Args:
        false_alarms: expected number [1/h].
        batch: shape of the leading axes of the residuals.
        noise: what is known of the noise.

    Raises:
        ValueError: the number is not more than 0 and at most 10.
    """

    def __init__(
        self,
        false_alarms: float,
        batch: tuple[int, ...] = (),
        noise: CameraNoise = WHITE_NOISE,
    ) -> None:
        if not 0 < false_alarms <= MAX_ALARMS:
            raise ValueError(
                f"false_alarms must be more than 0 and up to {MAX_ALARMS:g} per hour, "
                f"got {false_alarms!r}"
            )
        self._rate = false_alarms / HOUR
        self._batch, self._noise = batch, noise
        self._filter = ResidualFilter(batch, noise)
        self._recent: dict[int, _Recent] = {}
        self._spans = SPANS if noise.heavy_tails else SINGLE
        self._windows: dict[object, _Windows] = {}
        self._calm = np.full(batch, np.inf)  # time since a test failed [s]

    def step(
        self,
        z: NDArray[np.float64],
        model: ResidualModel,
        dt: float,
        correlation_time: float | tuple[float, float],
        turn: float = 0.0,
        keys: tuple[object, ...] | None = None,
        kept: NDArray[np.float64] | None = None,
    ) -> ConsistencyResult:
        """Test (..., n) residuals.

        Args:
            z: the residuals.
            model: their covariances.
            dt: time since the last ones [s].
            correlation_time: of the pose error, or the shortest and the longest that it may have
                [s].
            turn: of the car within this time [rad].
            keys: identities of the residuals; None: the same as before.
            kept: see ``ResidualFilter.predict``.
        """
        self._filter.predict(model, dt, correlation_time, turn, keys, kept)
        w = self._filter.update(z, model.noise_cov)
        lengths = window_lengths(float(np.max(correlation_time)))
        # Lines that come and go do not begin the windows of the others anew.
        key = (w.shape[-1] if keys is None else keys), len(lengths)
        if key not in self._windows:
            self._windows[key] = _Windows(lengths, self._batch, w.shape[-1])
        share = self._rate / (len(lengths) + len(self._spans))
        if self._noise.heavy_tails:
            w = w * np.sqrt(outlier_weight(w))
        recent = self._recent.setdefault(w.shape[-1], _Recent(self._spans)).add(w, dt, share)
        statistic = np.maximum(recent, self._windows[key].add(w, dt, share))
        failed = statistic > 1
        alarmed = self._calm <= lengths[-1]
        self._calm = np.where(failed, 0.0, self._calm + dt)
        return ConsistencyResult(statistic, self._calm <= lengths[-1], failed & ~alarmed)


class _Recent:
    """Sums of the last whitened innovations, which are tested in each image.

    Args:
        spans: numbers of images.
    """

    def __init__(self, spans: tuple[int, ...]) -> None:
        self.spans = spans
        self._last: deque[NDArray[np.float64]] = deque(maxlen=max(spans))

    def add(self, w: NDArray[np.float64], dt: float, rate: float) -> NDArray[np.float64]:
        """Add (..., n) innovations; return the largest statistic of the sums that end with them.

        Args:
            w: whitened innovations.
            dt: time since the last ones [s].
            rate: false alarms per second for each span.

        Returns:
            (...,) in units of the thresholds.
        """
        self._last.appendleft(w)
        limit = threshold(rate * min(dt, SHORTEST), w.shape[-1])
        largest, total = np.zeros(w.shape[:-1]), np.zeros(w.shape)
        for k, one in enumerate(self._last, 1):
            total = total + one
            if k in self.spans:
                largest = np.maximum(largest, (total**2).sum(axis=-1) / (k * limit))
        return largest


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
    longest = max(CORRELATION_TIMES * min(correlation_time, MAX_TIME), SLOW)
    most = round(math.log(longest / SHORTEST, RATIO))
    return SHORTEST * RATIO ** np.arange(most + 1.0)


def threshold(probability: float, n: int) -> float:
    """Return the value that a chi-square variable of n degrees of freedom exceeds so often.

    >>> round(threshold(0.01, 2), 3)
    9.21
    """
    return float(chdtri(n, probability))
