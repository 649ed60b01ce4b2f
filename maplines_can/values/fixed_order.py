"""Linear algebra with a fixed order of operations: the same bits on any machine.

BLAS and LAPACK choose the order of sums by the size of a problem and by the processor, so their
last bits differ between machines, and between one matrix and a batch. What an encoder decides and
what a decoder rebuilds is computed here instead, and in ``c/src/linalg.c`` with the same operations
in the same order. All functions take any number of matrices at once, on the leading axes.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Most sweeps of the Jacobi method; it converges in 5 to 8.
SWEEPS = 16
#: An entry off the diagonal is taken for 0 if it is this share of both entries on the diagonal.
NEGLIGIBLE = 2.0**-60
#: Up to this number, matrices are taken one by one: with few, arrays cost more than they save.
FEW = 3
#: Most rows of a matrix for which ``cholesky`` does so.
FEW_ROWS = 4


def product(A: Array, B: Array) -> Array:
    """Return the (..., n, m) products of (..., n, k) and (..., k, m) matrices.

    The terms are added one after the other, the first one first.

    >>> product(np.array([[1.0, 2.0]]), np.array([[3.0], [4.0]]))
    array([[11.]])
    """
    C = A[..., :, :1] * B[..., :1, :]
    for k in range(1, A.shape[-1]):
        C = C + A[..., :, k : k + 1] * B[..., k : k + 1, :]
    return np.asarray(C)


def congruence(A: Array, S: Array) -> Array:
    """Return the (..., n, n) matrices A S A^T, exactly symmetric: the mean with their transposes.

    >>> congruence(np.array([[1.0, 1.0]]), np.eye(2))
    array([[2.]])
    """
    C = product(product(A, S), A.mT)
    return np.asarray((C + C.mT) / 2)


def total(values: Array) -> Array:
    """Return the (...,) sums of the last axis; halves are added to each other until one is left.

    >>> total(np.array([1.0, 2.0, 3.0, 4.0, 5.0]))
    array(15.)
    """
    return np.asarray(row_total(values.T).T)


def row_total(values: Array) -> Array:
    """Return the (...) sums over the first axis: as ``total`` over the last one."""
    while (n := len(values)) > 1:
        half = (n + 1) // 2
        sums = values[: n - half] + values[half:]
        values = sums if n % 2 == 0 else np.concatenate([sums, values[n - half : half]])
    return np.asarray(values[0])


def cholesky(S: Array) -> Array:
    """Return the (..., n, n) lower triangular factors of matrices, of which the lower part is read.

    NaN from the first pivot on that is not positive.

    >>> cholesky(np.array([[4.0, 2.0], [2.0, 5.0]]))
    array([[2., 0.],
           [1., 2.]])
    """
    n = S.shape[-1]
    if n <= FEW_ROWS and S.size <= FEW * n * n:
        factors = [_cholesky_one(rows) for rows in S.reshape(-1, n, n).tolist()]
        return np.array(factors).reshape(S.shape)
    rest, L = S.copy(), np.zeros_like(S)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for j in range(n):
            pivot = rest[..., j, j]
            L[..., j, j] = np.sqrt(np.where(pivot > 0, pivot, np.nan))
            L[..., j + 1 :, j] = rest[..., j + 1 :, j] / L[..., j, j, None]
            column = L[..., j + 1 :, j]
            rest[..., j + 1 :, j + 1 :] -= column[..., :, None] * column[..., None, :]
    return L


def _cholesky_one(rest: list[list[float]]) -> list[list[float]]:
    """Return ``cholesky`` of the rows of one matrix, which are overwritten."""
    n = len(rest)
    L = [[0.0] * n for _ in range(n)]
    for j in range(n):
        pivot = math.sqrt(rest[j][j]) if rest[j][j] > 0 else math.nan
        column = [row[j] / pivot for row in rest[j + 1 :]]
        L[j][j] = pivot
        for i, factor in enumerate(column, j + 1):
            L[i][j] = factor
            row = rest[i]
            for k in range(j + 1, i + 1):
                row[k] -= factor * column[k - j - 1]
    return L


def is_definite(S: Array) -> NDArray[np.bool_]:
    """Return the (N,) matrices, of (N, n, n), of which ``cholesky`` has no NaN.

    >>> is_definite(np.array([[[4.0, 2.0], [2.0, 5.0]], [[4.0, 2.0], [2.0, 1.0]]]))
    array([ True, False])
    """
    if len(S) <= FEW:
        return np.array([is_definite_one(rows) for rows in S.tolist()], dtype=bool)
    n = S.shape[-1]
    rest = [[S[:, i, j].copy() for j in range(i + 1)] for i in range(n)]
    definite = np.ones(len(S), dtype=bool)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for k in range(n):
            pivot = rest[k][k]
            definite &= pivot > 0
            root = np.sqrt(pivot)
            column = [rest[i][k] / root for i in range(k + 1, n)]
            for i in range(k + 1, n):
                for j in range(k + 1, i + 1):
                    rest[i][j] -= column[i - k - 1] * column[j - k - 1]
    return definite


def is_definite_one(rest: list[list[float]]) -> bool:
    """Return ``is_definite`` of the rows of one matrix, which are overwritten.

    The lower part is read.
    """
    n = len(rest)
    for k in range(n):
        if not rest[k][k] > 0:
            return False
        root = math.sqrt(rest[k][k])
        column = [row[k] / root for row in rest[k + 1 :]]
        for i, factor in enumerate(column):
            row = rest[k + 1 + i]
            for j in range(i + 1):
                row[k + 1 + j] -= factor * column[j]
    return True


def _copy_for(L: Array, B: Array) -> Array:
    """Return a copy of (..., n, m) right-hand sides for each of the (..., n, n) matrices."""
    if L.shape[:-2] == B.shape[:-2]:
        return B.copy()
    shape = np.broadcast_shapes(L.shape[:-2], B.shape[:-2])
    return np.array(np.broadcast_to(B, (*shape, *B.shape[-2:])))


def lower_solution(L: Array, B: Array) -> Array:
    """Return the (..., n, m) solutions of L X = B for lower triangular (..., n, n) matrices.

    >>> lower_solution(np.array([[2.0, 0.0], [1.0, 2.0]]), np.array([[2.0], [5.0]]))
    array([[1.],
           [2.]])
    """
    n = L.shape[-1]
    rest = _copy_for(L, B)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for i in range(n):
            rest[..., i, :] /= L[..., i, i, None]
            rest[..., i + 1 :, :] -= L[..., i + 1 :, i, None] * rest[..., i, None, :]
    return rest


def upper_solution(L: Array, B: Array) -> Array:
    """Return the (..., n, m) solutions of L^T X = B for lower triangular (..., n, n) matrices.

    >>> upper_solution(np.array([[2.0, 0.0], [1.0, 2.0]]), np.array([[3.0], [2.0]]))
    array([[1.],
           [1.]])
    """
    n = L.shape[-1]
    rest = _copy_for(L, B)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for i in reversed(range(n)):
            rest[..., i, :] /= L[..., i, i, None]
            rest[..., :i, :] -= L[..., i, :i, None] * rest[..., i, None, :]
    return rest


def inverse(A: Array) -> Array:
    """Return the (..., n, n) inverses by Gauss and Jordan's elimination with partial pivoting.

    Entries of the inverse of a singular matrix are NaN or infinite.

    >>> inverse(np.array([[0.0, 2.0], [4.0, 0.0]]))
    array([[0.  , 0.25],
           [0.5 , 0.  ]])
    """
    n = A.shape[-1]
    M = np.concatenate([A, np.broadcast_to(np.eye(n), A.shape)], axis=-1)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for k in range(n):
            chosen = k + np.abs(M[..., k:, k]).argmax(axis=-1)[..., None, None]  # the first largest
            upper = np.take_along_axis(M, chosen, axis=-2)
            np.put_along_axis(M, chosen, M[..., k, None, :].copy(), axis=-2)
            M[..., k, None, :] = upper / upper[..., k, None]
            for i in range(n):
                if i != k:
                    M[..., i, :] -= M[..., i, k, None] * M[..., k, :]
    return np.asarray(M[..., n:])


def eigen(S: Array) -> tuple[Array, Array]:
    """Return the (..., n) eigenvalues and (..., n, n) eigenvectors of symmetric matrices.

    They are in no order. By Jacobi's method: each round rotates disjoint pairs of rows, first all
    columns, then all rows (Golub and Van Loan, Matrix Computations, section 8.5). An entry that is
    negligible is not rotated, so that the result for a matrix does not depend on the others.

    >>> values, _ = eigen(np.array([[2.0, 1.0], [1.0, 2.0]]))
    >>> np.sort(values).round(12)
    array([1., 3.])
    """
    n = S.shape[-1]
    A = S.copy()
    V = np.zeros_like(A)
    V[..., range(n), range(n)] = 1.0
    rounds = _rounds(n)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for _ in range(SWEEPS):
            is_done = True
            for p, q in rounds:
                a, b, off = A[..., p, p], A[..., q, q], A[..., p, q]
                turns = np.abs(off) > NEGLIGIBLE * np.sqrt(np.abs(a * b))
                if not turns.any():
                    A[..., p, q] = A[..., q, p] = 0.0
                    continue
                is_done = False
                theta = (b - a) / (2 * off)
                t = 1 / (np.abs(theta) + np.sqrt(theta * theta + 1))
                t = np.where(turns, np.where(theta < 0, -t, t), 0.0)
                c = 1 / np.sqrt(t * t + 1)
                s = t * c
                for M in (A, V):
                    left, right = M[..., p], M[..., q]
                    M[..., p], M[..., q] = (
                        c[..., None, :] * left - s[..., None, :] * right,
                        s[..., None, :] * left + c[..., None, :] * right,
                    )
                upper, lower = A[..., p, :], A[..., q, :]
                A[..., p, :], A[..., q, :] = (
                    c[..., None] * upper - s[..., None] * lower,
                    s[..., None] * upper + c[..., None] * lower,
                )
                A[..., p, q] = A[..., q, p] = 0.0
            if is_done:
                break
    return A[..., range(n), range(n)].copy(), V


def _rounds(n: int) -> list[tuple[list[int], list[int]]]:
    """Return the rounds of a tournament of n: disjoint pairs (p, q) with p < q, each once."""
    even = n + n % 2
    ring = [*range(1, even)]
    rounds = []
    for _ in range(even - 1):
        order = [0, *ring]
        pairs = [
            sorted((order[i], order[even - 1 - i]))
            for i in range(even // 2)
            if max(order[i], order[even - 1 - i]) < n
        ]
        rounds.append(([p for p, _ in pairs], [q for _, q in pairs]))
        ring = [ring[-1], *ring[:-1]]
    return rounds
