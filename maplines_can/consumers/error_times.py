"""Gauss-Markov errors, and those whose correlation time is known within a range only."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..values.linalg import positive_part

#: Greatest ratio of neighbouring nodes: (2 + sqrt(3))^2, for which their weight is 1.
RATIO = (2 + math.sqrt(3)) ** 2


class Cover(NamedTuple):
    """Sum of Gauss-Markov processes whose covariance is at least that of each one in a range.

    If an error of covariance ``R`` lasts for any time in the range, the sum of independent errors
    of the covariance ``weight R``, one for each of the times, has a covariance that is at least its
    own: over all images together, not only within one.
    """

    times: NDArray[np.float64]  #: (m,) correlation times of the nodes, ascending [s]; 0 is white
    weight: float  #: of each node


def cover(shortest: float, longest: float, period: float, most: int = 8) -> Cover:
    """Return the sum of processes that covers all with a correlation time in a range.

    The spectrum of a first-order Gauss-Markov process of variance 1, sampled with the period dt, is

        (1 - rho^2) / (1 - 2 rho cos(w dt) + rho^2) = (1 + y^2) t / (t^2 + y^2),
        rho = exp(-dt / T),   t = tanh(dt / (2 T)),   y = tan(w dt / 2)

    so on a logarithmic scale of y it is ``sech(ln y - ln t)`` but for a factor that all have in
    common, also for white noise, t = 1. For two nodes with the ratio q of their t, the sum of both
    is least, relative to the greatest spectrum of those between, in their middle, where it is
    ``4 sqrt(q) / (q + 1)``; and relative to that of the outer node far outside, ``1 + 1 / q``. So
    each gets the weight ``max((q + 1) / (4 sqrt(q)), q / (q + 1))``, and more nodes only add.

    This is for images in equal steps, of which some may be missing. By integration, it holds for
    errors that are sums of processes in the range, too.

    Args:
        shortest: correlation time [s]; 0 for white noise.
        longest: correlation time, at least the shortest one [s].
        period: time between two images [s].
        most: greatest number of nodes, 2 or more.

    >>> cover(5.0, 5.0, 0.05)
    Cover(times=array([5.]), weight=1.0)
    >>> cover(0.0, 1.0, 0.05).times.round(2)
    array([0.  , 0.16, 1.  ])
    """
    high, low = (math.tanh(period / 2 / T) if T > 0 else 1.0 for T in (shortest, longest))
    if shortest == longest or high / low <= 1:
        return Cover(np.array([longest]), 1.0)
    steps = math.ceil(math.log(high / low) / math.log(RATIO) - 1e-9)
    count = min(max(2, 1 + steps), most)
    q = (high / low) ** (1 / (count - 1))
    inner = high / q ** np.arange(1, count - 1)
    times = [shortest, *(period / 2 / np.arctanh(inner)), longest]
    return Cover(np.array(times), max((q + 1) / (4 * math.sqrt(q)), q / (q + 1)))


def transition(
    before: NDArray[np.float64],
    after: NDArray[np.float64],
    decay: NDArray[np.float64],
    R: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the transitions of independent processes.

    Args:
        before: (b, n, n) their stationary covariances.
        after: (b, n, n) those that the model states for the next cycle.
        decay: (b,) autocorrelations, or (b, n) of each component.
        R: (n, n) rotation between the cycles.

    Returns:
        (b, n, n) transition matrices, covariances of the process noise, and covariances after them.
    """
    turned = (R @ before @ R.T).diagonal(axis1=1, axis2=2)
    stated = after.diagonal(axis1=1, axis2=2)
    ratio = np.divide(stated, turned, out=np.zeros_like(turned), where=turned > 0)
    decay = decay.reshape(len(before), -1)
    F = (decay * np.sqrt(ratio))[..., None] * R
    kept = F @ before @ F.swapaxes(1, 2)
    noise = positive_part(after - kept)
    return F, noise, kept + noise
