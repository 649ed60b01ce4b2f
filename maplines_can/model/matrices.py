"""Linear algebra of lists of rows, with the order of operations of the core (``c/src/linalg.c``).

BLAS and LAPACK choose the order of sums by the processor; here it is part of the rule.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

Row = list[float]
Matrix = list[Row]


def product(A: Sequence[Sequence[float]], B: Sequence[Sequence[float]]) -> Matrix:
    """Return A B; the terms are added one after the other, the first one first."""
    columns = [*zip(*B, strict=True)]
    return [[dot(row, column) for column in columns] for row in A]


def square(A: Sequence[Sequence[float]]) -> Matrix:
    """Return A A^T."""
    return [[dot(row, other) for other in A] for row in A]


def dot(a: Sequence[float], b: Sequence[float]) -> float:
    """Return the scalar product, the first terms first."""
    total = a[0] * b[0]
    for i in range(1, len(a)):
        total += a[i] * b[i]
    return total


def added(A: Matrix, B: Matrix) -> Matrix:
    """Return A + B."""
    return [[a + b for a, b in zip(*rows, strict=True)] for rows in zip(A, B, strict=True)]


def diagonal(values: Iterable[float]) -> Matrix:
    """Return the matrix with these values on its diagonal."""
    entries = [*values]
    return [[x if i == j else 0.0 for j in range(len(entries))] for i, x in enumerate(entries)]


def total(values: Sequence[float]) -> float:
    """Return the sum: halves are added to each other until one is left.

    >>> total([1.0, 2.0, 3.0, 4.0, 5.0])
    15.0
    """
    terms = [*values]
    while (n := len(terms)) > 1:
        half = (n + 1) // 2
        terms = [terms[i] + terms[i + half] for i in range(n - half)] + terms[n - half : half]
    return terms[0]


def cholesky(S: Matrix) -> Matrix:
    """Return the lower triangular factor; NaN from the first pivot on that is not positive.

    >>> cholesky([[4.0, 2.0], [2.0, 5.0]])
    [[2.0, 0.0], [1.0, 2.0]]
    """
    n, rest = len(S), [[*row] for row in S]
    L = [[0.0] * n for _ in range(n)]
    for j in range(n):
        L[j][j] = math.sqrt(rest[j][j]) if rest[j][j] > 0 else math.nan
        for i in range(j + 1, n):
            L[i][j] = rest[i][j] / L[j][j]
            for k in range(j + 1, i + 1):
                rest[i][k] -= L[i][j] * L[k][j]
    return L


def is_definite(S: Matrix) -> bool:
    """Return whether the Cholesky factor exists."""
    return not math.isnan(cholesky(S)[-1][-1])


def upper_solution(U: Matrix, B: Matrix) -> Matrix:
    """Return X of U X = B, with U upper triangular."""
    n, X = len(U), [[*row] for row in B]
    for i in reversed(range(n)):
        X[i] = [x / U[i][i] for x in X[i]]
        for k in range(i):
            X[k] = [x - U[k][i] * solved for x, solved in zip(X[k], X[i], strict=True)]
    return X


def inverse(A: Matrix) -> Matrix:
    """Return the inverse, by the elimination of Gauss and Jordan with partial pivoting.

    >>> inverse([[0.0, 2.0], [4.0, 0.0]])
    [[0.0, 0.25], [0.5, 0.0]]
    """
    n = len(A)
    M = [[*row, *unit] for row, unit in zip(A, diagonal([1.0] * n), strict=True)]
    for k in range(n):
        chosen = max(range(k, n), key=lambda i: abs(M[i][k]))  # the first largest
        M[k], M[chosen] = M[chosen], M[k]
        M[k] = [x / M[k][k] for x in M[k]]
        for i in range(n):
            if i != k:
                M[i] = [x - M[i][k] * pivot for x, pivot in zip(M[i], M[k], strict=True)]
    return [row[n:] for row in M]
