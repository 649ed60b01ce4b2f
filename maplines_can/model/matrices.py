"""Linear algebra of plain numbers, with the order of operations of the core (``c/src/linalg.c``).

BLAS and LAPACK choose the order of sums by the processor; here it is part of the rule. ``+``, ``-``
and, with a number, ``*`` and ``/`` are entrywise, and so is ``*`` of two vectors. ``@`` adds the
first terms first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import reduce
from itertools import repeat
from operator import add, mul, sub, truediv
from typing import Any, Self, TypeVar

T = TypeVar("T")

#: Most sweeps of Jacobi's method; it converges in 5 to 8.
SWEEPS = 16
#: An entry off the diagonal is 0 if it is no more than this share of both entries on the diagonal.
NEGLIGIBLE = 2.0**-60


class _Entries(list[T]):
    """Entries with entrywise arithmetic: with those of another one, or with a number."""

    def _with(self, operation: Callable[[Any, Any], Any], other: Any) -> Self:
        return type(self)(map(operation, self, other if isinstance(other, list) else repeat(other)))

    def __add__(self, other: Self) -> Self:  # type: ignore[override]
        return self._with(add, other)

    def __sub__(self, other: Self) -> Self:
        return self._with(sub, other)

    def __mul__(self, other: Self | float) -> Self:  # type: ignore[override]
        return self._with(mul, other)

    def __truediv__(self, other: Self | float) -> Self:
        return self._with(truediv, other)

    __iadd__ = __add__  # type: ignore[assignment]
    __rmul__ = __imul__ = __mul__  # type: ignore[assignment]


class Vector(_Entries[float]):
    """Numbers.

    >>> Vector([1.0, 2.0]) + 3 * Vector([1.0, 1.0]), Vector([1.0, 2.0]) @ Vector([3.0, 4.0])
    ([4.0, 5.0], 11.0)
    """

    def __matmul__(self, other: Sequence[float]) -> float:
        return reduce(add, map(mul, self, other)) if self else 0.0

    def norm(self) -> float:
        """Return the length, with the sum of ``total``."""
        return math.sqrt(dot_by_halves(self, self))

    def outer(self, other: Vector | None = None) -> Matrix:
        """Return a b^T, or a a^T."""
        return Matrix((self if other is None else other) * x for x in self)


class Matrix(_Entries[Vector]):
    """Rows."""

    @property
    def T(self) -> Matrix:  # noqa: N802 - as in the literature
        """The transposed matrix."""
        return matrix(zip(*self, strict=True))

    def __matmul__(self, other: Matrix) -> Matrix:
        columns = other.T
        return Matrix(Vector(row @ column for column in columns) for row in self)

    def diagonal(self) -> Vector:
        """Return the entries on the diagonal."""
        return Vector(row[i] for i, row in enumerate(self))

    def block(self, rows: Iterable[int], columns: Iterable[int]) -> Matrix:
        """Return some rows and columns."""
        chosen = [*columns]
        return matrix([self[i][j] for j in chosen] for i in rows)

    def block_of(self, i: int, j: int) -> Matrix:
        """Return the block of two lines, of 4 rows and columns."""
        return matrix(row[4 * j : 4 * j + 4] for row in self[4 * i : 4 * i + 4])

    def with_blocks(self, blocks: Iterable[Matrix]) -> Matrix:
        """Return S + blkdiag(blocks), of blocks of 4 rows."""
        found = matrix(self)
        for i, block in enumerate(blocks):
            own = slice(4 * i, 4 * i + 4)
            for row, more in zip(found[own], block, strict=True):
                row[own] = Vector(row[own]) + more
        return found

    def is_finite(self) -> bool:
        """Return whether all entries are numbers."""
        return all(math.isfinite(x) for row in self for x in row)

    def symmetric(self) -> Matrix:
        """Return the mean of S and S^T."""
        return (self + self.T) / 2

    def congruence(self, S: Matrix) -> Matrix:
        """Return A S A^T, exactly symmetric."""
        return (self @ S @ self.T).symmetric()

    # ---- factors and solutions ------------------------------------------------------------------

    def cholesky(self) -> Matrix:
        """Return the lower triangular factor; NaN from the first pivot on that is not positive.

        >>> matrix([[4.0, 2.0], [2.0, 5.0]]).cholesky()
        [[2.0, 0.0], [1.0, 2.0]]
        """
        n, rest = len(self), matrix(self)
        L = diagonal([0.0] * n)
        for j in range(n):
            L[j][j] = math.sqrt(rest[j][j]) if rest[j][j] > 0 else math.nan
            for i in range(j + 1, n):
                L[i][j] = rest[i][j] / L[j][j]
                for k in range(j + 1, i + 1):
                    rest[i][k] -= L[i][j] * L[k][j]
        return L

    def is_definite(self) -> bool:
        """Return whether the Cholesky factor exists."""
        return not math.isnan(self.cholesky()[-1][-1])

    def lower_solution(self, B: Matrix) -> Matrix:
        """Return X with L X = B for a lower triangular L.

        >>> matrix([[2.0, 0.0], [1.0, 2.0]]).lower_solution(matrix([[2.0], [5.0]]))
        [[1.0], [2.0]]
        """
        X = matrix(B)
        for i in range(len(X)):
            X[i] /= self[i][i]
            for k in range(i + 1, len(X)):
                X[k] -= self[k][i] * X[i]
        return X

    def upper_solution(self, B: Matrix) -> Matrix:
        """Return X with U X = B for an upper triangular U."""
        X = matrix(B)
        for i in reversed(range(len(X))):
            X[i] /= self[i][i]
            for k in range(i):
                X[k] -= self[k][i] * X[i]
        return X

    def inverse(self) -> Matrix:
        """Return the inverse, by the elimination of Gauss and Jordan with partial pivoting.

        >>> matrix([[0.0, 2.0], [4.0, 0.0]]).inverse()
        [[0.0, 0.25], [0.5, 0.0]]
        """
        n = len(self)
        M = matrix([*row, *unit] for row, unit in zip(self, diagonal([1.0] * n), strict=True))
        for k in range(n):
            chosen = max(range(k, n), key=lambda i: abs(M[i][k]))  # the first largest
            M[k], M[chosen] = M[chosen], M[k]
            M[k] /= M[k][k]
            for i in range(n):
                if i != k:
                    M[i] -= M[i][k] * M[k]
        return matrix(row[n:] for row in M)

    # ---- eigenvalues ----------------------------------------------------------------------------

    def eigen(self) -> tuple[Vector, Matrix]:
        """Return the eigenvalues of a symmetric matrix, in no order, and the vectors as columns.

        By Jacobi's method. Each round rotates disjoint pairs: all columns, then all rows.
        """
        A, V = self, diagonal([1.0] * len(self))
        for _ in range(SWEEPS):
            is_done = True
            for pairs in rounds(len(self)):
                turns = [(p, q, *_rotation(A[p][p], A[q][q], A[p][q])) for p, q in pairs]
                if any(sine != 0 for _, _, _, sine in turns):
                    is_done = False
                    A, V = A.T.rotated(turns).T.rotated(turns), V.rotated(turns)
                for p, q in pairs:
                    A[p][q] = A[q][p] = 0.0
            if is_done:
                break
        return A.diagonal(), V.T

    def rotated(self, turns: Iterable[tuple[int, int, float, float]]) -> Matrix:
        """Return a matrix with pairs of its rows rotated, by their indices, cosine and sine."""
        rows = Matrix(self)
        for p, q, c, s in turns:
            rows[p], rows[q] = c * self[p] - s * self[q], s * self[p] + c * self[q]
        return rows

    # ---- covariances ----------------------------------------------------------------------------

    def scale(self) -> Vector:
        """Return the standard deviations of a covariance, with 1 in place of 0."""
        return Vector(math.sqrt(x if x > 0 else 1.0) for x in self.diagonal())

    def positive_part(self, more: float = 0.0) -> Matrix:
        """Return a symmetric matrix with 0 in place of its negative eigenvalues.

        To the others a share of each is added.
        """
        values, V = self.eigen()
        kept = Vector(value * (1 + more) if value > 0 else 0.0 for value in values)
        return (Matrix(row * kept for row in V) @ V.T).symmetric()

    def square_root(self) -> Matrix:
        """Return a lower triangular L with L L^T = S, which may be singular.

        That of a singular one is by the eigenvalues of the correlations that are not tiny: rows are
        reflected to be lower triangular (Householder). One that depends on those before it takes no
        column.
        """
        n, variances, L = range(len(self)), self.diagonal(), self.cholesky()
        tiny = 8 * len(self) * 2.0**-52
        if all(L[i][i] * L[i][i] > tiny * variances[i] for i in n):
            return L
        values, V = (self / self.scale().outer()).eigen()
        roots = Vector(math.sqrt(value if value > tiny else 0.0) for value in values)
        M = Matrix(row * roots for row in V)
        L, k = diagonal([0.0] * len(self)), 0
        for j in n:
            v = Vector(M[j][k:])
            length = v.norm()
            if length > tiny:
                v[0] += math.copysign(length, v[0])
                twice = 2 / dot_by_halves(v, v)
                for row in M:
                    rest = Vector(row[k:])
                    row[k:] = rest - dot_by_halves(rest, v) * twice * v
                for i in n[j:]:
                    L[i][j] = M[i][k] * (1.0 if M[j][k] > 0 else -1.0)
                k += 1
        return Matrix(L[i] * math.sqrt(max(variances[i], 0.0)) for i in n)


def matrix(rows: Iterable[Iterable[float]]) -> Matrix:
    """Return the matrix of some rows."""
    return Matrix(map(Vector, rows))


def diagonal(values: Iterable[float]) -> Matrix:
    """Return the matrix with these values on its diagonal."""
    x = [*values]
    return matrix([x[i] if i == j else 0.0 for j in range(len(x))] for i in range(len(x)))


def total(values: Sequence[float]) -> float:
    """Return the sum: halves are added to each other until one is left.

    >>> total([1.0, 2.0, 3.0, 4.0, 5.0])
    15.0
    """
    terms = [*values]
    while (n := len(terms)) > 1:
        half = (n + 1) // 2
        terms = [*map(add, terms, terms[half:]), *terms[n - half : half]]
    return terms[0]


def dot_by_halves(a: Sequence[float], b: Sequence[float]) -> float:
    """Return the scalar product, with the sum of ``total``."""
    return total([*map(mul, a, b)])


def _rotation(a: float, b: float, off: float) -> tuple[float, float]:
    """Return cosine and sine of the rotation that makes an entry 0, unless that is negligible."""
    if not abs(off) > NEGLIGIBLE * math.sqrt(abs(a * b)):
        return 1.0, 0.0
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
