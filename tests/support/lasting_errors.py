"""Errors that last, for tests of assertions."""

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

Array = NDArray[np.float64]
#: 60 s at 20 Hz.
N = 1200
T = 0.05 * np.arange(N)


def gauss_markov(rng: np.random.Generator, n: int = N, d: int = 1, time: float = 0.0) -> Array:
    """Return (n, d) errors of variance 1 that last for a number of samples."""
    noise = rng.standard_normal((n, d))
    rho = np.exp(-1 / time) if time else 0.0
    noise[1:] *= np.sqrt(1 - rho**2)
    return np.asarray(lfilter([1.0], [1.0, -rho], noise, axis=0))
