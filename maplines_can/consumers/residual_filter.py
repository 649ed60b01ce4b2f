"""Kalman filter for residuals of lines whose errors last."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..values.linalg import block_diagonal
from .error_times import cover, transition

#: Correlation times of what lines and cameras have of their own [s]. An error of a map changes
#: within some 20 m, or hardly within a kilometre.
FAST, SLOW = 1.0, 30.0
#: Most correlation times of the pose error in the state, if a range of them is stated.
POSE_NODES = 3
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

    The innovations are linear in the residuals, but for outliers. So what a constant error of the
    pose from the first cycle on adds to them is known: the response of the filter to ``H``.

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
        self._responses = np.zeros((3, 3 * POSE_NODES))  # of the mean to a constant error
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
        self._mean, self._responses = self._mean @ F.T, self._responses @ F.T
        self._cov = F @ self._cov @ F.T + block_diagonal([*Q_pose, *Q_own])
        self._G = np.hstack([*[model.H] * POSE_NODES, *[np.eye(n)] * len(own)])

    def update(
        self, z: NDArray[np.float64], model: ResidualModel
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Update with (..., n) residuals; return their whitened innovations.

        Args:
            z: the residuals.
            model: of the cycle, as in the prediction.

        Returns:
            (..., n) whitened innovations, and (3, n) what a pose error of 1 m along, 1 m across and
            1 rad, which is constant since the first cycle, adds to them.
        """
        G, cov = self._G, self._cov
        white = model.noise_cov * self._weight
        S = G @ cov @ G.T + white
        innovation, response = z - self._mean @ G.T, model.H.T - self._responses @ G.T
        whitening = np.linalg.inv(np.linalg.cholesky(S)).T
        w = np.asarray(innovation @ whitening)
        K = np.linalg.solve(S, G @ cov).T
        if self._noise.heavy_tails:
            innovation = innovation * outlier_weight(w)
        self._mean = self._mean + innovation @ K.T
        self._responses = self._responses + response @ K.T
        J = np.eye(len(cov)) - K @ G
        self._cov = J @ cov @ J.T + K @ white @ K.T  # Joseph's form stays definite
        return w, np.asarray(response @ whitening)

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
        responses = np.zeros((3, size))
        mean[..., to], responses[:, to] = self._mean[..., of], self._responses[:, of]
        cov[np.ix_(to, to)] = self._cov[np.ix_(of, of)]
        own = np.zeros((len(blocks), len(keys), len(keys)))
        of, to = (np.array([all_.index(key) for key in kept], int) for all_ in (self._keys, keys))
        own[:, to[:, None], to] = self._own_blocks[:, of[:, None], of]
        self._mean, self._cov, self._own_blocks, self._keys = mean, cov, own, keys
        self._responses = responses


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


def threshold(probability: float, n: int) -> float:
    """Return the value that a chi-square variable of n degrees of freedom exceeds so often.

    >>> round(threshold(0.01, 2), 3)
    9.21
    """
    from scipy.special import chdtri

    return float(chdtri(n, probability))
