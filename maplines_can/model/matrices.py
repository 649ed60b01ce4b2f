"""Linear algebra of lists of rows, with the order of operations of the core (``c/src/linalg.c``).

BLAS and LAPACK choose the order of sums by the processor; here it is part of the rule.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

Row = list[float]
Matrix = list[Row]

#: Most sweeps of Jacobi's method; it converges in 5 to 8.
SWEEPS = 16
#: An entry off the diagonal is 0 if it is no more than this share of both entries on the diagonal.
NEGLIGIBLE = 2.0**-60


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


def subtracted(A: Matrix, B: Matrix) -> Matrix:
    """Return A - B."""
    return [[a - b for a, b in zip(x, y, strict=True)] for x, y in zip(A, B, strict=True)]


def outer(d: Sequence[float]) -> Matrix:
    """Return d d^T."""
    return [[x * y for y in d] for x in d]


def symmetric(A: Matrix) -> Matrix:
    """Return the mean of A and A^T."""
    n = range(len(A))
    return [[(A[i][j] + A[j][i]) / 2 for j in n] for i in n]


def diagonal(values: Iterable[float]) -> Matrix:
    """Return the matrix with these values on its diagonal."""
    entries = [*values]
    return [[x if i == j else 0.0 for j in range(len(entries))] for i, x in enumerate(entries)]


def transposed(A: Matrix) -> Matrix:
    """Return A^T."""
    return [list(column) for column in zip(*A, strict=True)]


def congruence(A: Matrix, S: Matrix) -> Matrix:
    """Return A S A^T, exactly symmetric."""
    return symmetric(product(product(A, S), transposed(A)))


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


def lower_solution(L: Matrix, B: Matrix) -> Matrix:
    """Return X with L X = B for a lower triangular L.

    >>> lower_solution([[2.0, 0.0], [1.0, 2.0]], [[2.0], [5.0]])
    [[1.0], [2.0]]
    """
    X = [list(row) for row in B]
    for i, row in enumerate(X):
        X[i] = [x / L[i][i] for x in row]
        for k in range(i + 1, len(L)):
            X[k] = [x - L[k][i] * y for x, y in zip(X[k], X[i], strict=True)]
    return X


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


def eigen(S: Matrix) -> tuple[Row, Matrix]:
    """Return the eigenvalues of a symmetric matrix, in no order, and the eigenvectors as columns.

    By Jacobi's method. Each round rotates disjoint pairs of rows: all columns, then all rows.
    """
    n = len(S)
    A, V = [list(row) for row in S], diagonal([1.0] * n)
    for _ in range(SWEEPS):
        is_done = True
        for pairs in rounds(n):
            turns = [_rotation(A[p][p], A[q][q], A[p][q]) for p, q in pairs]
            if any(turn is not None for turn in turns):
                is_done = False
                for (p, q), turn in zip(pairs, turns, strict=True):
                    c, s = turn or (1.0, 0.0)
                    for row in (*A, *V):
                        row[p], row[q] = c * row[p] - s * row[q], s * row[p] + c * row[q]
                for (p, q), turn in zip(pairs, turns, strict=True):
                    c, s = turn or (1.0, 0.0)
                    upper, lower = A[p], A[q]
                    A[p] = [c * x - s * y for x, y in zip(upper, lower, strict=True)]
                    A[q] = [s * x + c * y for x, y in zip(upper, lower, strict=True)]
            for p, q in pairs:
                A[p][q] = A[q][p] = 0.0
        if is_done:
            break
    return [A[i][i] for i in range(n)], V


def _rotation(a: float, b: float, off: float) -> tuple[float, float] | None:
    """Return cosine and sine of the rotation that makes an entry 0; None if that is negligible."""
    if not abs(off) > NEGLIGIBLE * math.sqrt(abs(a * b)):
        return None
    theta = (b - a) / (2 * off)
    t = 1 / (abs(theta) + math.sqrt(theta * theta + 1))
    t = -t if theta < 0 else t
    c = 1 / math.sqrt(t * t + 1)
    return c, t * c


def rounds(n: int) -> list[list[tuple[int, int]]]:
    """Return the rounds of a tournament of n: disjoint pairs (p, q) with p < q, each once.

    >>> rounds(4)
    [[(0, 3), (1, 2)], [(0, 2), (1, 3)], [(0, 1), (2, 3)]]
    """
    even = n + n % 2
    ring, found = list(range(1, even)), []
    for _ in range(even - 1):
        order = [0, *ring]
        pairs = [sorted((order[i], order[even - 1 - i])) for i in range(even // 2)]
        found.append([(p, q) for p, q in pairs if q < n])
        ring = [ring[-1], *ring[:-1]]
    return found


def positive_part(S: Matrix, more: float = 0.0) -> Matrix:
    """Return a symmetric matrix with 0 in place of its negative eigenvalues.

    Args:
        S: the matrix.
        more: what is added to the others, as a share of each.
    """
    values, V = eigen(S)
    kept = [value * (1 + more) if value > 0 else 0.0 for value in values]
    scaled = [[v * value for v, value in zip(row, kept, strict=True)] for row in V]
    return symmetric(product(scaled, [*zip(*V, strict=True)]))
