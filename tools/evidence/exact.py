"""Definiteness in exact arithmetic."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction
from math import lcm
from typing import Any

Rational = Fraction | float | int


def is_positive_definite(matrix: Sequence[Sequence[Rational]]) -> bool:
    """Return whether a symmetric matrix is positive definite, without any rounding.

    The elimination of Bareiss keeps to whole numbers: its pivots are the leading minors of the
    matrix times a common denominator, all of which are positive if and only if the matrix is
    positive definite (Sylvester). The entries may be floats: each is a rational number.

    >>> is_positive_definite([[1.0, 1.0], [1.0, 1.0 + 2**-52]])
    True
    >>> is_positive_definite([[1.0, 1.0], [1.0, 1.0]])
    False
    """
    rational = [[Fraction(entry) for entry in row] for row in matrix]
    scale = lcm(*(entry.denominator for row in rational for entry in row))
    A = [[int(entry * scale) for entry in row] for row in rational]
    last = 1
    for k, pivot_row in enumerate(A):
        pivot = pivot_row[k]
        if pivot <= 0:
            return False
        for row in A[k + 1 :]:
            factor = row[k]
            for j in range(k + 1, len(A)):
                row[j] = (pivot * row[j] - factor * pivot_row[j]) // last
        last = pivot
    return True


def covers(cov: Any, mean: Iterable[float], true_cov: Any, true_mean: Iterable[float]) -> bool:
    """Return whether a covariance exceeds a true one plus the square of the error of the mean.

    Args:
        cov: (n, n).
        mean: (n,).
        true_cov: (n, n).
        true_mean: (n,).
    """
    means = zip(map(float, mean), map(float, true_mean), strict=True)
    d = [Fraction(a) - Fraction(b) for a, b in means]
    difference = [
        [Fraction(a) - Fraction(b) - d[i] * d_j for a, b, d_j in zip(*rows, d, strict=True)]
        for i, rows in enumerate(zip(cov.tolist(), true_cov.tolist(), strict=True))
    ]
    return is_positive_definite(difference)
