"""Weights of the components of a mixture as records have them, and what their rounding leaves."""

from __future__ import annotations

import math
from collections.abc import Sequence

from .matrices import Matrix, Row, added, outer, positive_part, subtracted

#: More than the gap, so that a check with another algorithm's rounding passes.
MORE = 1e-6


def quantized_weights(weights: Sequence[float], steps: int) -> list[int]:
    """Round weights to positive multiples of ``1 / steps`` that add up to 1.

    The largest remainders are rounded up (Hamilton's method). Where weights had to be raised to one
    step, those with the greatest excess lose it.

    >>> quantized_weights([0.005, 0.335, 0.66], 32)
    [1, 10, 21]
    """
    exact = [weight * steps for weight in weights]
    multiples = [max(1, math.floor(x)) for x in exact]
    for _ in weights:
        missing = steps - sum(multiples)
        if missing > 0:
            multiples[_first_largest([x - m for x, m in zip(exact, multiples, strict=True)])] += 1
        if missing < 0:
            excess = [m - x if m > 1 else -math.inf for x, m in zip(exact, multiples, strict=True)]
            multiples[_first_largest(excess)] -= 1
    return multiples


def _first_largest(values: Sequence[float]) -> int:
    return max(range(len(values)), key=lambda i: values[i])


def moments(
    weights: Sequence[float], means: Sequence[Row], covs: Sequence[Matrix]
) -> tuple[Row, Matrix]:
    """Return mean and covariance of a mixture; the components are added one after the other."""
    n = range(len(means[0]))
    mean = [_weighted_sum(weights, [m[i] for m in means]) for i in n]
    about = []
    for m, cov in zip(means, covs, strict=True):
        about.append(added(cov, outer([x - y for x, y in zip(m, mean, strict=True)])))
    return mean, [[_weighted_sum(weights, [S[i][j] for S in about]) for j in n] for i in n]


def _weighted_sum(weights: Sequence[float], values: Sequence[float]) -> float:
    total = weights[0] * values[0]
    for weight, value in zip(weights[1:], values[1:], strict=True):
        total += weight * value
    return total


def deficit(
    weights: Sequence[float],
    means: Sequence[Row],
    covs: Sequence[Matrix],
    decoded_weights: Sequence[float],
    decoded_means: Sequence[Row],
) -> Matrix:
    """Return what to add to the covariance of each component, so that the mixture is covered.

    The decoded components cover their own mean square errors, so the decoded mixture has at least
    their covariance B. It must cover T, the true mean square error about the decoded mean: the
    positive part of T - B closes the gap.
    """
    mean, T = moments(weights, means, covs)
    own = []
    for m, decoded, cov in zip(means, decoded_means, covs, strict=True):
        own.append(added(cov, outer([x - y for x, y in zip(m, decoded, strict=True)])))
    decoded_mean, B = moments(decoded_weights, decoded_means, own)
    T = added(T, outer([x - y for x, y in zip(mean, decoded_mean, strict=True)]))
    gap = subtracted(T, B)
    sigmas = [math.sqrt(row[i]) for i, row in enumerate(T)]
    scale = [sigma if 0 < sigma < math.inf else 1.0 for sigma in sigmas]
    n = range(len(scale))
    gap = [[gap[i][j] / (scale[i] * scale[j]) for j in n] for i in n]
    if not all(math.isfinite(x) for row in gap for x in row):
        # A component is so far out of range that its own record is OUT_OF_RANGE.
        gap = [[0.0 for _ in n] for _ in n]
    lifted = positive_part(gap, MORE)
    return [[lifted[i][j] * (scale[i] * scale[j]) for j in n] for i in n]
