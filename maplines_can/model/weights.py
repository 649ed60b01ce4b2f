"""Mixtures: their moments, their weights in a record, and what the rounding of these leaves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import mul, truediv

from .matrices import Matrix, Row, added, diagonal, entrywise, outer, positive_part, subtracted

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
    mean = _weighted(weights, [[m] for m in means])[0]
    return mean, _weighted(weights, about(means, [mean] * len(means), covs))


def _weighted(weights: Sequence[float], matrices: Sequence[Matrix]) -> Matrix:
    shares = zip(weights, matrices, strict=True)
    return added(*([[weight * x for x in row] for row in A] for weight, A in shares))


def about(means: Sequence[Row], points: Sequence[Row], covs: Sequence[Matrix]) -> list[Matrix]:
    """Return the mean squares about a point of each component."""
    d = [[x - y for x, y in zip(*pair, strict=True)] for pair in zip(means, points, strict=True)]
    return [added(cov, outer(one)) for cov, one in zip(covs, d, strict=True)]


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
    mean, cov = moments(weights, means, covs)
    own = about(means, decoded_means, covs)
    decoded_mean, B = moments(decoded_weights, decoded_means, own)
    (T,) = about([mean], [decoded_mean], [cov])
    sigmas = [math.sqrt(row[i]) for i, row in enumerate(T)]
    units = outer([sigma if 0 < sigma < math.inf else 1.0 for sigma in sigmas])
    gap = entrywise(truediv, subtracted(T, B), units)
    if not all(math.isfinite(x) for row in gap for x in row):
        # A component is so far out of range that its own record is OUT_OF_RANGE.
        gap = diagonal([0.0] * len(gap))
    return entrywise(mul, positive_part(gap, MORE), units)
