"""Correlation time of the pose error of a filter, from the dynamics of its own error.

The error e of a Kalman filter follows  e_k = (I - K_k H_k) F_k e_{k-1} + noise,  and the noise is
independent of the errors before it. So the covariance of the errors at two times is exact, if the
model is right (Anderson and Moore, Optimal Filtering, section 5.3):

    E[e_k e_j'] = Psi P_j,   Psi = product of (I - K_i H_i) F_i over i = j + 1 ... k

It contains the states of the biases, which make the pose error persist, and the gains, which make
it forget. The autocorrelation of a component of the pose error, in the axes of the ego frame at k:

    rho(t_k - t_j) = [Psi P_j] / sqrt([P_k] [P_j])

The correlation time is the time at which it falls to 1/e. As long as the past is too short, the
autocorrelation is continued as an exponential.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .motion_model import HEADING, N

Array = NDArray[np.float64]

#: The past is kept in spans that are at most this share of their age long, and no shorter than
#: ``SHORTEST`` [s]; so their number grows with the logarithm of the time.
SHARE, SHORTEST = 0.15, 0.1
#: Longest past that is kept [s].
LONGEST = 600.0
#: Least loss of correlation from which an exponential is continued.
MIN_LOSS = 1e-3


class _Span(NamedTuple):
    """Time from one kept covariance to the next."""

    start: float  #: [s]
    cov: Array  #: (n, N, N) at the start
    Psi: Array  #: (n, N, N) transition of the error from the start to the next span


class ErrorCorrelation:
    """Autocorrelation of the pose error of n filters up to now."""

    def __init__(self, t: float, cov: Array) -> None:
        self._spans: list[_Span] = []
        self.t = t  #: time up to which it is known [s]
        self._cov, self._open = cov, _Span(t, cov, np.eye(N) + np.zeros_like(cov))
        self._begin = np.full(len(cov), -math.inf)  # of the pose of each filter

    def advance(
        self, t: float, cov: Array, transition: Array, is_new: NDArray[np.bool_] | None = None
    ) -> None:
        """Take the covariance at a time [s], and the transition of the error to it.

        Args:
            t: [s].
            cov: (n, N, N).
            transition: (n, N, N).
            is_new: (n,) filters that start again with another pose; None for none.
        """
        if is_new is not None:
            self._begin[is_new] = t
        start, first, Psi = self._open
        self._open = _Span(start, first, transition @ Psi)
        self.t, self._cov = t, cov
        if t - start >= SHORTEST:
            self._spans.append(self._open)
            self._open = _Span(t, cov, np.eye(N) + np.zeros_like(cov))
            self._thin()

    def _thin(self) -> None:
        """Join neighbouring spans where the past is long ago, and forget what is too long ago."""
        spans, i = self._spans, len(self._spans) - 2
        while i >= 0:
            end = spans[i + 2].start if i + 2 < len(spans) else self._open.start
            if end - spans[i].start <= SHARE * (self.t - end):
                one, other = spans[i], spans.pop(i + 1)
                spans[i] = one._replace(Psi=other.Psi @ one.Psi)
            i -= 1
        while spans and self.t - spans[0].start > LONGEST:
            spans.pop(0)

    def autocorrelation(self, heading: Array) -> tuple[Array, Array]:
        """Return the autocorrelations of the pose error, and how long ago each is.

        Args:
            heading: (n,) of the cars, whose axes are used [rad].

        Returns:
            (k,) times [s] ascending, (k, n, 3) autocorrelations along, across and of the heading.
        """
        spans = [span for span in (self._open, *reversed(self._spans)) if span.start < self.t]
        if not spans:
            return np.empty(0), np.empty((0, len(heading), 3))
        c, s = np.cos(heading), np.sin(heading)
        T = np.zeros((len(heading), 3, N))
        T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = c, s, -s, c
        T[:, 2, HEADING] = 1.0
        rows, reaches = T, []  # T Psi
        for span in (self._open, *reversed(self._spans)):
            rows = rows @ span.Psi
            if span.start < self.t:
                reaches.append(rows)
        cov = np.stack([span.cov for span in spans])  # (k, n, N, N)
        joint = (np.stack(reaches) * (T @ cov)).sum(axis=-1)
        now, then = (np.asarray((T @ P * T).sum(axis=-1)) for P in (self._cov, cov))
        both = now * then
        return (
            np.array([self.t - span.start for span in spans]),
            np.where(both > 0, joint / np.sqrt(np.where(both > 0, both, 1.0)), 1.0),
        )

    def times(self, heading: Array) -> Array:
        """Return the (n, 3) correlation times along, across and of the heading [s].

        They are infinite, as unknown, as long as there is no loss of correlation to be seen. What
        was before a filter started again says nothing.

        Args:
            heading: (n,) of the cars [rad].
        """
        lags, rho = self.autocorrelation(heading)
        found = np.full((len(heading), 3), math.inf)
        if not len(lags):
            return found
        lags, rho = np.append(0.0, lags), np.concatenate([np.ones((1, *rho.shape[1:])), rho])
        own = (self.t - lags[:, None] >= self._begin)[..., None]  # (k, n, 1)
        below = own & (rho <= math.exp(-1))
        k = np.where(below.any(axis=0), below.argmax(axis=0), own.sum(axis=0) - 1)
        before = np.where(below.any(axis=0), k - 1, 0)
        one, other = (np.take_along_axis(rho, i[None], axis=0)[0] for i in (before, k))
        one, other = np.log(one.clip(1e-6)), np.log(other.clip(1e-6))
        falls = one - other > MIN_LOSS
        share = (1 + one) / np.where(falls, one - other, 1.0)
        return np.where(falls, lags[before] + share * (lags[k] - lags[before]), found)
