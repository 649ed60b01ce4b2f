"""Test for a bias: a mean of errors beside which the rest is too large to leave room for it.

Errors that last for the whole run have a mean, too, and are no fault. But a right error has the
mean square 1 in stated standard deviations: if its mean has the variance v, 1 - v remains for the
rest. With the mean m of n errors and the mean square s^2 of what is left without it,

    m^2 / v ~ chi-square of 1,   n_w s^2 / (1 - v) ~ chi-square of n_w degrees of freedom

for the n_w effective samples of the rest. Both probabilities are combined by Fisher's method
(-2 ln p_1 p_2 is chi-square of 4), with the v that suits a right estimate best, since it is not
known. So the test holds for errors of any correlation time.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtrc, chdtri, ndtri

from .effective_samples import SOKAL, correlations, effective_samples

#: Variances v of the mean that are tried.
SHARES = np.geomspace(1e-4, 0.99, 120)
#: Biases that are tried [standard deviations].
BIASES = np.geomspace(0.02, 20.0, 120)


def bias_probability(errors: NDArray[np.float64]) -> float:
    """Return the probability that a right estimate has such a mean, or a larger one.

    Args:
        errors: (n,) of a variable in stated standard deviations, in equal steps of time.

    >>> rng = np.random.default_rng(0)
    >>> white = rng.standard_normal(1200)
    >>> bias_probability(white) > 0.1, bias_probability(white + 1.2) < 1e-3
    (True, True)
    """
    rest = errors - errors.mean()
    n_w = effective_samples(rest[:, None])
    return float(_probability(errors.mean() ** 2, (rest**2).mean(), n_w))


def bias_found(errors: NDArray[np.float64], probability: float, share: float) -> float:
    """Return the bias of which a share of the runs like this one is less probable.

    The standard deviations are right, and the errors last as long as those at hand.

    Args:
        errors: (n,) of a variable, which need not be free of a bias.
        probability: that a right estimate has at least.
        share: of the runs.

    Returns:
        The bias [standard deviations].
    """
    n = len(errors)
    rest = errors - errors.mean()
    if not rest.any():
        return float(BIASES[0])
    rho = correlations(rest[:, None])[:, 0, 0]
    sums = 1 + 2 * np.cumsum(((1 - np.arange(n) / n) * rho)[1:])
    k = np.arange(1, n)
    tau = sums[np.argmax((k >= 2 * SOKAL * sums) | (k == n - 1))]
    n_w = effective_samples(rest[:, None])
    # Both are less than this in as many runs as miss the bias if either alone would show it.
    below = (1 - share) ** 0.85
    least = (BIASES + ndtri(below) * np.sqrt(max(1.0, tau) / n)).clip(min=0.0)
    found = _probability(least**2, chdtri(n_w, 1 - below) / n_w, n_w) < probability
    return float(BIASES[np.argmax(found)] if found.any() else np.inf)


def _probability(square: ArrayLike, rest: float, n_w: float) -> NDArray[np.float64]:
    """Return the (...,) probabilities of (...,) squared means and a mean square of the rest."""
    of_mean = chdtrc(1, np.asarray(square)[..., None] / SHARES)
    of_rest = chdtrc(n_w, n_w * rest / (1 - SHARES))
    fisher = -2 * np.log((of_mean * of_rest).clip(1e-300))
    return np.asarray(chdtrc(4, fisher.min(axis=-1)))
