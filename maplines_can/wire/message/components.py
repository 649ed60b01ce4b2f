"""Mixtures on the wire: weights that fit their signal, and parts that cover the whole."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["deficit", "quantized_weights"]

Array = NDArray[np.float64]


def quantized_weights(weights: Array, steps: int) -> NDArray[np.int64]:
    """Whole numbers of ``1 / steps``, 1 or more each, that add up to the whole.

    The largest remainders are rounded up (Hamilton's method), so that no weight
    is off by a step or more unless it had to be raised to 1.

    Args:
        weights: (N, k) positive, each row of sum 1.
        steps: how many steps make the whole, k or more.

    >>> quantized_weights(np.array([[0.005, 0.335, 0.66]]), 32)
    array([[ 1, 10, 21]])
    """
    wanted = weights * steps
    parts = np.maximum(1, np.floor(wanted)).astype(np.int64)
    rows = np.arange(len(parts))
    for _ in range(weights.shape[1]):
        missing = steps - parts.sum(axis=1)
        parts[rows, (wanted - parts).argmax(axis=1)] += missing > 0
        excess = np.where(parts > 1, parts - wanted, -np.inf)
        parts[rows, excess.argmax(axis=1)] -= missing < 0
    return parts


def deficit(
    weights: Array, means: Array, covs: Array, decoded_weights: Array, decoded_means: Array
) -> Array:
    """What each part must cover besides its own, for the whole to be covered.

    The decoded mixture's covariance is at least
    ``B = sum w'_i (S_i + d_i d_i^T + (m'_i - m')(m'_i - m')^T)``, since each part covers
    its own. What it should be is the true covariance about the decoded mean,
    ``T = S + (m - m')(m - m')^T``. The positive part of T - B, added to what
    each part covers, closes the gap.

    Args:
        weights: (N, k) true weights.
        means: (N, k, 4).
        covs: (N, k, 4, 4).
        decoded_weights: (N, k).
        decoded_means: (N, k, 4).

    Returns:
        (N, 4, 4) positive semidefinite; zero where nothing is missing.
    """

    def whole(w: Array, m: Array, S: Array, about: Array) -> Array:
        spread = m - about[:, None, :]
        return np.einsum("nk,nkij->nij", w, S + spread[..., :, None] * spread[..., None, :])

    mean, decoded_mean = (
        np.einsum("nk,nki->ni", w, m)
        for w, m in ((weights, means), (decoded_weights, decoded_means))
    )
    d = means - decoded_means
    T = whole(weights, means, covs, mean)
    off = mean - decoded_mean
    T += off[:, :, None] * off[:, None, :]
    own = covs + d[..., :, None] * d[..., None, :]
    gap = T - whole(decoded_weights, decoded_means, own, decoded_mean)
    scale = np.sqrt(np.einsum("nii->ni", T))
    scale = np.where(scale > 0, scale, 1.0)
    scale2 = scale[:, :, None] * scale[:, None, :]
    values, vectors = np.linalg.eigh(gap / scale2)
    # A little more than the gap, for the rounding of whoever checks it.
    values = np.where(values > 0, values * (1 + 1e-6), 0.0)
    return (vectors * values[:, None, :]) @ vectors.transpose(0, 2, 1) * scale2
