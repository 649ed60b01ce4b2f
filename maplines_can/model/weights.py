"""Mixtures: their moments, their weights in a record, and what the rounding of these leaves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from operator import add, mul

from .matrices import Matrix, Vector, diagonal, is_finite, outer, positive_part

#: More than the gap, so that a check with another algorithm's rounding passes.
MORE = 1e-6


def quantized_weights(weights: Sequence[float], steps: int) -> list[int]:
    """Round weights to positive multiples of ``1 / steps`` that add up to 1.

    The largest remainders are rounded up (Hamilton's method). Where weights had to be raised to one
    step, those with the greatest excess lose it.

    >>> quantized_weights([0.005, 0.335, 0.66], 32)
    [1, 10, 21]
    """
    exact, places = [weight * steps for weight in weights], range(len(weights))
    multiples = [max(1, math.floor(x)) for x in exact]
    for _ in weights:
        excess = [multiples[i] - exact[i] for i in places]
        if sum(multiples) < steps:
            multiples[min(places, key=excess.__getitem__)] += 1
        elif sum(multiples) > steps:
            multiples[max((i for i in places if multiples[i] > 1), key=excess.__getitem__)] -= 1
    return multiples


def moments(
    weights: Sequence[float], means: Sequence[Vector], covs: Sequence[Matrix]
) -> tuple[Vector, Matrix]:
    """Return mean and covariance of a mixture; the components are added one after the other."""
    mean = reduce(add, map(mul, means, weights))
    return mean, reduce(add, map(mul, about(means, [mean] * len(means), covs), weights))


def about(
    means: Sequence[Vector], points: Sequence[Vector], covs: Sequence[Matrix]
) -> list[Matrix]:
    """Return the mean squares about a point of each component."""
    return [S + outer(m - point) for m, point, S in zip(means, points, covs, strict=True)]


def deficit(
    weights: Sequence[float],
    means: Sequence[Vector],
    covs: Sequence[Matrix],
    decoded_weights: Sequence[float],
    decoded_means: Sequence[Vector],
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
    sigmas = map(math.sqrt, T.diagonal())
    units = outer(Vector(sigma if 0 < sigma < math.inf else 1.0 for sigma in sigmas))
    gap = (T - B) / units
    if not is_finite(gap):  # a component is so far out of range that its record is OUT_OF_RANGE
        gap = diagonal([0.0] * len(gap))
    return positive_part(gap, MORE) * units
