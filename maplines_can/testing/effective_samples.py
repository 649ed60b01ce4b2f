"""Number of independent samples that say as much as a series of errors that last.

The square of an error that lasts for many samples is nearly the same in all of them. With the
autocorrelation matrices R(k) of whitened errors of d variables, the mean of n squared norms (NEES)
of a Gaussian process has the variance of ``n / tau`` independent ones:

    tau = 1 + 2 sum_k (1 - k / n) |R(k)|^2 / d        |.| is the Frobenius norm

R(k) is estimated from the errors themselves, whose mean is 0 if they are consistent: so an error
that never changes is one sample, not none, and the scale of the errors does not matter. (From the
series of the squares it is estimated worse.) Two sums bound what is lost and what is noise:

    short   up to the first k beyond 3 tau (Sokal): little noise, but it ends too early if most of
            the error is white, and a part lasts
    long    up to n / 3. By Bartlett's formula, noise adds d (1 - k / n) tau / n to each term of
            |R(k)|^2 / d, which is linear in tau: what it adds to the sum is solved for

tau is the larger one. Measured: docs/promises.md, "Testing".
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: The short sum ends at so many times its own value.
SOKAL = 3.0
#: Least share of the largest eigenvalue of a variable that counts.
LEAST = 1e-12


def effective_samples(errors: NDArray[np.float64]) -> float:
    """Return the number of independent samples of which squared norms have the same mean error.

    Args:
        errors: (n, d) in equal steps of time, n > d, whitened or of any other scale.

    Returns:
        From 1 to n.

    >>> rng = np.random.default_rng(0)
    >>> white = rng.standard_normal((300, 1))
    >>> round(effective_samples(white)), round(effective_samples(np.full((300, 1), 0.7)))
    (292, 2)
    """
    n = len(errors)
    correlation = correlations(errors)
    d = correlation.shape[-1]
    if d == 0:  # there is no error at all
        return float(n)
    weight = 1 - np.arange(n) / n
    terms = 2 * weight * (correlation**2).sum(axis=(1, 2)) / d
    sums = 1 + np.cumsum(terms) - terms[0]
    short = sums[np.argmax((np.arange(n) >= SOKAL * sums) | (np.arange(n) == n - 1))]
    long = n // 3
    noise = 2 * d * (weight[1 : long + 1] ** 2).sum() / n
    return float(n / max(1.0, short, sums[long] / (1 + noise)))


def correlations(errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (n, d, d) autocorrelation matrices of all lags, of the variables that vary."""
    n = len(errors)
    length = 1 << (2 * n - 1).bit_length()
    spectrum = np.fft.rfft(errors, length, axis=0)
    products = spectrum[:, :, None].conj() * spectrum[:, None, :]
    cov = np.fft.irfft(products, length, axis=0)[:n] / n
    values, vectors = np.linalg.eigh(cov[0])
    known = values > LEAST * values[-1]
    whitening = vectors[:, known] / np.sqrt(values[known])
    return np.asarray(whitening.T @ cov @ whitening)
