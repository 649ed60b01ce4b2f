"""What the codes for comparison add to a covariance: for clipped means, and for mixtures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..values.elementary import sin_cos, tan
from ..values.mixture import moments

Array = NDArray[np.float64]


def quantized_weights(weights: Array, steps: int) -> NDArray[np.int64]:
    """Round weights to positive multiples of ``1 / steps`` that add up to 1.

    The largest remainders are rounded up (Hamilton's method). So no weight is off by a step or
    more, unless it had to be raised to one step.

    The weights are (N, k) and positive, each row of sum 1; ``steps`` is k or more.

    Returns:
        (N, k) multiples, each row of sum ``steps``.

    >>> quantized_weights(np.array([[0.005, 0.335, 0.66]]), 32)
    array([[ 1, 10, 21]])
    """
    exact = weights * steps
    multiples = np.maximum(1, np.floor(exact)).astype(np.int64)
    rows = np.arange(len(multiples))
    for _ in range(weights.shape[1]):
        missing = steps - multiples.sum(axis=1)
        multiples[rows, (exact - multiples).argmax(axis=1)] += missing > 0
        excess = np.where(multiples > 1, multiples - exact, -np.inf)
        multiples[rows, excess.argmax(axis=1)] -= missing < 0
    return multiples


@np.errstate(over="ignore", invalid="ignore")
def deficit(
    weights: Array, means: Array, covs: Array, decoded_weights: Array, decoded_means: Array
) -> Array:
    """Return the variance to add to each component so that the whole mixture is covered.

    Each decoded component covers its own covariance, so the covariance of the decoded mixture is
    at least ``B = sum w'_i (S_i + d_i d_i^T + (m'_i - m')(m'_i - m')^T)``. It must cover the true
    covariance about the decoded mean, ``T = S + (m - m')(m - m')^T``. The positive part of
    ``T - B``, added to the covariance of each component, closes the gap.

    Weights are (N, k), means (N, k, 4), and covs (N, k, 4, 4). The result is (N, 4, 4) positive
    semidefinite, and zero where the mixture is covered already.
    """
    mean, T = moments(weights, means, covs)
    d = means - decoded_means
    own = covs + d[..., :, None] * d[..., None, :]
    decoded_mean, B = moments(decoded_weights, decoded_means, own)
    off = mean - decoded_mean
    T = T + off[:, :, None] * off[:, None, :]
    gap = T - B
    scale = np.sqrt(np.einsum("nii->ni", T))
    scale = np.where((scale > 0) & (scale < np.inf), scale, 1.0)
    scale2 = scale[:, :, None] * scale[:, None, :]
    gap /= scale2
    # On overflow some component is so far out of range that its own record is OUT_OF_RANGE.
    gap[~np.isfinite(gap).all(axis=(1, 2))] = 0.0
    values, vectors = np.linalg.eigh(gap)
    # A little more than the gap, so that a check with another algorithm's rounding passes.
    values = np.where(values > 0, values * (1 + 1e-6), 0.0)
    lifted = (vectors * values[:, None, :]) @ vectors.mT
    return (lifted + lifted.mT) / 2 * scale2


def slope_error(mean: Array, near: Array) -> Array:
    """Return the (..., 4) errors of lines whose first-order effect is that of their slopes.

    The lateral position depends on beta by its tangent, so that the error of a line is another one
    than the difference of the parameters if that of beta is large.
    """
    error = mean - near
    sine, cosine = sin_cos(near[..., 1])
    error[..., 1] = (tan(mean[..., 1]) - sine / cosine) * (cosine * cosine)
    return np.asarray(error)
