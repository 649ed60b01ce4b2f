"""An integer Cholesky factor with a shared exponent, as SBAS Message Type 28.

RTCA DO-229, A.4.4.16: ``R = 2^(scale exponent - 5) E`` with E upper triangular, four diagonal
elements of 9 bits, six others of 10 bits, and a scale exponent of 3 bits, 99 in all; the covariance
is ``R^T R``. Here the states have fixed units and the order c0, beta, y_off, c1. SBAS makes up
for rounding by a constant that it also broadcasts; here the factor is enlarged until it covers.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ...wire.layout.message_layout import Layout
from ...wire.layout.record_signals import OCTAVES, PARAMETER_SIGNALS
from .code import ENTRY, Array, Coded, CovarianceCode, check

#: States in the order of the factor, and the unit of each.
ORDER = (2, 1, 0, 3)
UNIT = np.array([2.0**-8, 2.0**-12, 2.0**-14, 2.0**-16])
#: Relative margin of the coded matrix over the one it must cover.
MARGIN = 1e-6
TRIES = 24
#: Least squared pivot of a factor, relative to the diagonal element of its row.
MIN_PIVOT = 8 * np.finfo(float).eps


def entry_name(i: int, j: int) -> str:
    """Return the name of the signal of an entry of the factor."""
    return f"Root{PARAMETER_SIGNALS[ORDER[i]]}{PARAMETER_SIGNALS[ORDER[j]]}"


class IntegerCholesky(CovarianceCode):
    """A factor with the smallest exponent that holds it, enlarged until it covers.

    Any bits with diagonal elements of 1 or more give a positive definite matrix.
    """

    name = "IntegerCholesky"
    about = "integer Cholesky factor with a shared exponent (SBAS MT28), enlarged to cover"
    positive_definite = False
    covering = True

    def __init__(self, layout: Layout) -> None:
        self.exponent = layout["ScaleExponent"]
        self.entries = {
            (i, j): layout[entry_name(i, j)] for i in range(4) for j in range(i, 4)
        }  # of the upper triangle
        self.signals = (self.exponent, *self.entries.values())
        check(layout, [self.exponent], OCTAVES)
        check(layout, self.entries.values(), ENTRY)

    def encode(self, error: Array, resolution: Array) -> Coded:
        n, order = len(error), list(ORDER)
        with np.errstate(over="ignore"):
            M = (error + np.diag(resolution)) / (UNIT[:, None] * UNIT)
        M = M[:, order][:, :, order]
        raw = {signal.name: np.zeros(n, dtype=np.int64) for signal in self.signals}
        done = np.zeros(n, dtype=bool)
        rows = np.flatnonzero(np.isfinite(M).all(axis=(1, 2)))
        bump = np.full(n, 1.0)
        for _ in range(TRIES):
            if not len(rows):
                break
            values, fits = self._rounded(M[rows] * bump[rows, None, None])
            R = self._factor(values)
            ratio = np.full(len(rows), 2.0)
            if fits.any():
                ratio[fits] = _largest_ratio(R[fits], M[rows[fits]])
            good = fits & (ratio <= 1)
            for name, value in values.items():
                raw[name][rows[good]] = value[good]
            done[rows[good]] = True
            bump[rows] *= np.where(good, 1.0, np.maximum(ratio, 1.0) * 1.01)
            rows = rows[fits & ~good]
        for name, widest in self.widest().items():
            raw[name][~done] = widest
        return Coded(raw, np.zeros(n, dtype=bool), done)

    def _rounded(self, M: Array) -> tuple[dict[str, NDArray[np.int64]], NDArray[np.bool_]]:
        """Return raw values of (n, 4, 4) matrices, and which fit, with the smallest exponents."""
        L = _factors(M)
        least = np.full(len(M), self.exponent.physical_range[0])
        for (i, j), signal in self.entries.items():
            reach = signal.physical_range[1]
            with np.errstate(divide="ignore"):
                least = np.maximum(least, np.log2(np.abs(L[:, j, i]) / reach))
        exponent = np.ceil(least)
        fits = exponent <= self.exponent.physical_range[1]
        scale = np.exp2(exponent)
        values = {self.exponent.name: (exponent - self.exponent.offset).astype(np.int64)}
        for (i, j), signal in self.entries.items():
            element = L[:, j, i] / scale / signal.factor
            # A diagonal element of 0 would decode to a singular matrix.
            nearest = np.maximum(np.ceil(element - 1e-9), 1) if i == j else np.rint(element)
            values[signal.name] = signal.limited(nearest).astype(np.int64)
        return values, fits

    def _factor(self, raw: Mapping[str, NDArray[np.int64]]) -> Array:
        """Return the decoded upper triangular factors in the units of the code."""
        R = np.zeros((len(raw[self.exponent.name]), 4, 4))
        scale = np.exp2(self.exponent.physical(raw[self.exponent.name]))
        for (i, j), signal in self.entries.items():
            R[:, i, j] = signal.physical(raw[signal.name]) * scale
        return R

    def decode(self, raw: Mapping[str, NDArray[np.int64]]) -> Array:
        R = self._factor(raw)
        cov = np.empty((len(R), 4, 4))
        cov[:, np.array(ORDER)[:, None], np.array(ORDER)] = R.transpose(0, 2, 1) @ R
        cov *= UNIT[:, None] * UNIT
        return (cov + cov.transpose(0, 2, 1)) / 2

    def widest(self) -> dict[str, int]:
        wide = {signal.name: signal.raw_max for (i, j), signal in self.entries.items() if i == j}
        none = {signal.name: 0 for signal in self.signals}
        return none | wide | {self.exponent.name: self.exponent.raw_max}


def _factors(M: Array) -> Array:
    """Return (n, 4, 4) lower Cholesky factors of semidefinite matrices with a positive diagonal.

    Rounding can make a pivot zero or negative, for which NumPy's factorization raises for the whole
    batch. Here a pivot is at least as large as the rounding error of its row; the caller checks
    that the result covers the matrix.
    """
    L = np.zeros_like(M)
    for i in range(4):
        for j in range(i):
            L[:, i, j] = (M[:, i, j] - (L[:, i, :j] * L[:, j, :j]).sum(axis=1)) / L[:, j, j]
        pivot = M[:, i, i] - (L[:, i, :i] ** 2).sum(axis=1)
        L[:, i, i] = np.sqrt(np.maximum(pivot, MIN_PIVOT * M[:, i, i]))
    return L


def _largest_ratio(R: Array, M: Array) -> Array:
    """Return (n,) largest eigenvalues of (R^T R)^-1 M, with a margin for rounding."""
    inverse = np.linalg.inv(R)
    ratio = np.linalg.eigvalsh(inverse.transpose(0, 2, 1) @ M @ inverse)[:, -1]
    return np.asarray(ratio * (1 + MARGIN), dtype=float)
