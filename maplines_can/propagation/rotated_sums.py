"""Sums of the normal equations of points as polynomials in the cosine and sine of a rotation.

The order of their terms is fixed, and that of ``c/propagation``: so both give the same bits.
"""

from __future__ import annotations

from math import comb

import numpy as np
from numpy.typing import NDArray

from ..values.fixed_order import row_total
from ..values.seen_lines import NODES

#: Greatest degree of the sums.
DEGREE = 6
#: Powers k of u in the sums mean(u^k) and mean(v u^k), by the degrees of the sums.
_SUMS = [(1, 0), (0, 1), (2, 0), (1, 1), (3, 0), (2, 1), (4, 0), (3, 1), (5, 0), (6, 0)]
_DEGREES = np.array(_SUMS).sum(axis=1)
#: (DEGREE + 1,) first sum of at least each degree.
_FIRST = _DEGREES.searchsorted(np.arange(DEGREE + 1)).tolist()
#: Exponents of a and b of the moments mean(a^i b^j), by i + j.
_EXPONENTS = [(degree - j, j) for degree in range(1, DEGREE + 1) for j in range(degree + 1)]
_A, _B = np.array(_EXPONENTS).T
#: (K, M) powers of the nodes in the moments.
_POWERS = np.multiply.accumulate([np.ones_like(NODES), *[NODES] * DEGREE])[_A].T


def _terms() -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return (2, DEGREE + 1, 10) moments and factors: term j of a sum is that of s^j.

    u = c a + s b and v = c b - s a. By the binomial theorem, u^k has the terms a^(k-j) b^j, and
    v u^k the terms a^(k-j) b^(j+1) and a^(k+2-j) b^(j-1).
    """
    place = {exponents: i for i, exponents in enumerate(_EXPONENTS)}
    moments = np.zeros((2, DEGREE + 1, len(_DEGREES)), dtype=np.intp)
    factors = np.zeros((2, DEGREE + 1, len(_DEGREES)))
    for row, (k, of_v) in enumerate(_SUMS):
        for j in range(k + of_v + 1):
            if not of_v:
                moments[0, j, row], factors[0, j, row] = place[k - j, j], comb(k, j)
                continue
            if j <= k:
                moments[0, j, row], factors[0, j, row] = place[k - j, j + 1], comb(k, j)
            if j >= 1:
                moments[1, j, row] = place[k + 2 - j, j - 1]
                factors[1, j, row] = comb(k, j - 1)
    return moments, factors


_MOMENTS, _FACTORS = _terms()


def sums_of_points(b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (DEGREE + 1, 10, L, 1) coefficients of the sums of points (a, b) after rotations.

    Of each line, a are the nodes and b is (L, K). Coefficient j of a sum of degree d is that of
    c^(d - j) s^j; it is 0 for j > d.
    """
    powers = np.ones((DEGREE + 1, *b.T.shape))
    for k in range(DEGREE):
        np.multiply(powers[k], b.T, out=powers[k + 1])
    terms = _POWERS[:, :, None] * powers[_B].swapaxes(0, 1)  # (K, M, L)
    moments = row_total(terms) / len(NODES)
    first, second = _FACTORS[..., None] * moments[_MOMENTS]
    return np.asarray((first - second)[..., None])


def rotated_sums(
    sums: NDArray[np.float64], c: NDArray[np.float64], s: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the (10, L, N) values of ``sums_of_points`` for (N,) cosines and sines.

    With u = c a + s b and v = c b - s a, they are mean(u^k), k = 1 .. 4, at the even places, mean(v
    u^k), k = 0 .. 3, at the odd ones, and mean(u^k), k = 5 and 6.
    """
    powers = np.ones((2, DEGREE + 1, len(c)))
    for k in range(DEGREE):
        np.multiply(powers[:, k], (c, s), out=powers[:, k + 1])
    total = sums[0] * powers[0, _DEGREES, None]
    for j in range(1, DEGREE + 1):
        own = slice(_FIRST[j], None)
        total[own] += sums[j, own] * (powers[0, _DEGREES[own] - j] * powers[1, j])[:, None]
    return total
