"""Linear algebra of lists of rows, with the order of operations of the core (``c/src/linalg.c``).

BLAS and LAPACK choose the order of sums by the processor; here it is part of the rule.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial, reduce
from operator import add, sub, truediv

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
    """Return the scalar product, the first terms first; 0 of none."""
    products = [x * y for x, y in zip(a, b, strict=True)] or [0.0]
    found = products[0]
    for term in products[1:]:
        found += term
    return found


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


def dot_by_halves(a: Sequence[float], b: Sequence[float]) -> float:
    """Return the scalar product, with the sum of ``total``."""
    return total([x * y for x, y in zip(a, b, strict=True)])


def norm(a: Sequence[float]) -> float:
    """Return the length, with the sum of ``total``."""
    return math.sqrt(dot_by_halves(a, a))


def entrywise(operation: Callable[[float, float], float], A: Matrix, B: Matrix) -> Matrix:
    """Return the results of an operation on the entries of two matrices."""
    return [[operation(a, b) for a, b in zip(x, y, strict=True)] for x, y in zip(A, B, strict=True)]


def added(*matrices: Matrix) -> Matrix:
    """Return A + B, or of more matrices, the first ones first."""
    return reduce(partial(entrywise, add), matrices)


def subtracted(A: Matrix, B: Matrix) -> Matrix:
    """Return A - B."""
    return entrywise(sub, A, B)


def scaled(factor: float, A: Matrix) -> Matrix:
    """Return a multiple of A."""
    return [[factor * x for x in row] for row in A]


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
    kept_V = [[v * value for v, value in zip(row, kept, strict=True)] for row in V]
    return symmetric(product(kept_V, transposed(V)))


def scale_of(S: Matrix) -> Row:
    """Return the standard deviations of a covariance, with 1 in place of 0."""
    return [math.sqrt(row[i] if row[i] > 0 else 1.0) for i, row in enumerate(S)]


def square_root(S: Matrix) -> Matrix:
    """Return a lower triangular L with L L^T = S, which may be singular."""
    tiny, L = 8 * len(S) * 2.0**-52, cholesky(S)
    is_regular = all(L[i][i] * L[i][i] > tiny * row[i] for i, row in enumerate(S))
    return L if is_regular else _semidefinite_root(S, tiny)


def _semidefinite_root(S: Matrix, tiny: float) -> Matrix:
    """Return ``square_root`` by the eigenvalues above ``tiny`` of the correlations.

    Rows are reflected to be lower triangular (Householder). One that depends on those before it
    takes no column.
    """
    values, V = eigen(entrywise(truediv, S, outer(scale_of(S))))
    roots = [math.sqrt(value if value > tiny else 0.0) for value in values]
    M = [[x * root for x, root in zip(row, roots, strict=True)] for row in V]
    L, k = diagonal([0.0] * len(S)), 0
    for j in range(len(S)):
        v = M[j][k:]
        length = norm(v)
        if length > tiny:
            v[0] += math.copysign(length, v[0])
            twice = 2 / dot_by_halves(v, v)
            for row in M:
                share = dot_by_halves(row[k:], v) * twice
                row[k:] = [x - share * y for x, y in zip(row[k:], v, strict=True)]
            for i in range(j, len(S)):
                L[i][j] = M[i][k] * (1.0 if M[j][k] > 0 else -1.0)
            k += 1
    return [[x * math.sqrt(max(S[i][i], 0.0)) for x in row] for i, row in enumerate(L)]
