"""The covariance code: log pivots and pivot-relative Cholesky rows, quantized with feedback.

Write the covariance in the order of its rows as ``S = L L^T``, L lower
triangular, and let ``S' = L' L'^T`` be what is decoded. With ``A = L'^-1 L``,

    KL(N(0, S) || N(0, S')) = sum_i ((a_ii^2 - 1) / 2 - ln a_ii) + 1/2 sum_{i>j} a_ij^2,

so the entries of A are the errors that count, each by itself. Sent are the
pivots ``log2 L'_ii`` and the ratios ``L'_ij / L'_ii``. Row by row, from the
diagonal outwards, each ratio is chosen to bring its a_ij next to zero *given
the rows as already decoded*; every a_ij then ends within half a step whatever
the covariance, and the expected divergence is a constant of the code: a ratio
of step D costs D^2 / 24, a pivot of step D (in octaves) costs (D ln 2)^2 / 12.

Two things make the result cover what is sent. A ratio beyond its range lifts
its pivot until it fits: that adds variance in the one direction that is
thinner than the code can say, and nowhere else. And the whole is multiplied by
2^inflation, the least for which S' minus the mean square error about the decoded
mean is positive semidefinite.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import LayoutError
from .layout import Field, Layout

__all__ = ["STATE_SIGNALS", "CholeskyCode", "Coded"]

#: DBC signals of the mean, in the order of the states.
STATE_SIGNALS = ("YOff", "Beta", "C0", "C1")

#: Room for the rounding of whoever checks the guarantee with another algorithm.
MARGIN = 1e-6
#: Rows worked on at a time: all arrays of a block stay in the cache.
BLOCK = 2048

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Coded:
    """Covariances as raw values, and what happened to them.

    Args:
        raw: (N,) values by signal.
        saturated: (N,) a pivot was lifted, to keep a ratio or itself in range.
        covered: (N,) the decoded covariance covers what was to be sent.
    """

    raw: dict[str, NDArray[np.int64]]
    saturated: NDArray[np.bool_]
    covered: NDArray[np.bool_]


class CholeskyCode:
    """Covariances to raw values of a layout's pivots, ratios and inflation, and back.

    The order of the rows is in the names: ``RatioC0Beta`` says that C0 comes
    after Beta.

    Raises:
        LayoutError: a pivot, a ratio or the inflation is missing.
    """

    def __init__(self, layout: Layout) -> None:
        below = {
            row: [column for column in STATE_SIGNALS if f"Ratio{row}{column}" in layout.fields]
            for row in STATE_SIGNALS
        }
        names = sorted(STATE_SIGNALS, key=lambda state: len(below[state]))
        if [len(below[name]) for name in names] != [0, 1, 2, 3]:
            raise LayoutError(
                f"{layout.source}: the ratios must order the rows, Ratio<row><column> for each "
                f"pair of {', '.join(STATE_SIGNALS)}, but there are {below}"
            )
        #: States in the order of the rows, as indices into the mean.
        self.order = [STATE_SIGNALS.index(name) for name in names]
        self.pivots = [layout[f"Pivot{name}"] for name in names]
        self.ratios = [
            [layout[f"Ratio{row}{column}"] for column in names[:i]] for i, row in enumerate(names)
        ]
        self.inflation = layout["Inflation"]
        self.fields: list[Field] = [*self.pivots, *chain(*self.ratios), self.inflation]
        for field in self.fields:
            if field.factor <= 0:
                raise LayoutError(f"{layout.source}: signal {field.name} needs a positive factor")
        if (condition := self._worst_condition()) > 1e13:
            raise LayoutError(
                f"{layout.source}: the ratios reach so far that a matrix could have the condition "
                f"{condition:.0e}, which double precision cannot hold; make their ranges narrower"
            )
        self._sigma = [_exp2_table(field) for field in self.pivots]
        self._variance_factor = _exp2_table(self.inflation)
        # Beyond this no pivot reaches, whatever the ratios: not worth a try, and may overflow.
        self._hopeless = np.empty(4)
        for state, pivot, ratios in zip(self.order, self.pivots, self.ratios, strict=True):
            reach = 1 + sum(max(map(abs, ratio.physical_range)) ** 2 for ratio in ratios)
            self._hopeless[state] = 2.0 ** (2 * pivot.physical_range[1]) * reach * 4

    def _worst_condition(self) -> float:
        """Bound on the condition of a decoded correlation matrix, whatever its bits."""
        reach = np.zeros((4, 4))
        for i, ratios in enumerate(self.ratios):
            reach[i, :i] = [max(map(abs, ratio.physical_range)) for ratio in ratios]
        inverse = np.linalg.inv(np.eye(4) - reach)  # of the unit factor, the worst signs
        norm = np.sqrt(1 + (reach**2).sum(axis=1))
        return float(((inverse * norm) ** 2).sum())

    def encode(self, error: Array, resolution: Array) -> Coded:
        """Code covariances so that none is decoded overconfident.

        Args:
            error: (N, 4, 4) what the decoded covariance must cover: the
                covariance plus d d^T, with d the error of the decoded mean.
            resolution: (4,) variances of the mean's own rounding, which are
                added before the coding: they give singular matrices a floor.
        """
        n = len(error)
        coded = Coded(
            {field.name: np.zeros(n, dtype=np.int64) for field in self.fields},
            np.zeros(n, dtype=bool),
            np.zeros(n, dtype=bool),
        )
        diagonal = np.einsum("nii->ni", error)
        for start in range(0, n, BLOCK):
            rows = np.arange(start, min(start + BLOCK, n))
            rows = rows[(diagonal[rows] < self._hopeless).all(axis=1)]
            scale = np.ones(len(rows))
            # Once is enough unless a DBC leaves too little inflation for its steps, or a value
            # meets the end of its range: then for a target that is larger by what was missing.
            for _ in range(8):
                excess = self._encode_block(error[rows], resolution, scale, rows, coded)
                again = excess > 1
                if not again.any():
                    break
                rows, scale = rows[again], (1.02 * scale * excess)[again]
        lost = ~coded.covered
        if lost.any():
            for name, raw in self.widest().items():
                coded.raw[name][lost] = raw
        return coded

    def widest(self) -> dict[str, int]:
        """Raw values of the widest covariance: what a line without one carries."""
        wide = [*self.pivots, self.inflation]
        return {field.name: field.raw_max if field in wide else 0 for field in self.fields}

    def decode(self, raw: Mapping[str, NDArray[np.int64]]) -> Array:
        """(N, 4, 4) covariances; positive definite whatever the raw values.

        Args:
            raw: (N,) values by signal.
        """
        n = len(raw[self.inflation.name])
        cov = np.empty((n, 4, 4))
        for start in range(0, n, BLOCK):
            rows = slice(start, start + BLOCK)
            block = {field.name: raw[field.name][rows] for field in self.fields}
            L = self._decode_rows(block)
            factor = _lookup(self._variance_factor, self.inflation, block[self.inflation.name])
            for i, j, value in _products(L, factor):
                cov[rows, self.order[i], self.order[j]] = value
                cov[rows, self.order[j], self.order[i]] = value
        return cov

    def decode_one(self, raw: Mapping[str, int]) -> Array:
        """(4, 4) covariance: as ``decode`` to the last bit, without the cost of arrays."""
        L = []
        for table, pivot, ratios in zip(self._sigma, self.pivots, self.ratios, strict=True):
            sigma = _lookup_one(table, pivot, raw[pivot.name])
            L.append([ratio.physical_one(raw[ratio.name]) * sigma for ratio in ratios] + [sigma])
        factor = _lookup_one(self._variance_factor, self.inflation, raw[self.inflation.name])
        cov = [[0.0] * 4 for _ in range(4)]
        for i, j, value in _products(L, factor):
            cov[self.order[i]][self.order[j]] = cov[self.order[j]][self.order[i]] = value
        return np.array(cov)

    def _decode_rows(self, raw: Mapping[str, NDArray[np.int64]]) -> list[list[Array]]:
        """L' as rows of (N,) entries, without the inflation."""
        L = []
        for table, pivot, ratios in zip(self._sigma, self.pivots, self.ratios, strict=True):
            sigma = _lookup(table, pivot, raw[pivot.name])
            L.append([ratio.physical(raw[ratio.name]) * sigma for ratio in ratios] + [sigma])
        return L

    def _encode_block(
        self, error: Array, resolution: Array, scale: Array, rows: NDArray[np.intp], coded: Coded
    ) -> Array:
        """Code one block into ``coded``; returns what is missing of each inflation, 1 or less."""
        M = [[error[:, i, j].copy() for j in self.order] for i in self.order]
        floor = [resolution[i] * scale for i in self.order]
        target = [[scale * M[i][j] for j in range(i + 1)] for i in range(4)]
        for i in range(4):
            target[i][i] = target[i][i] + floor[i]
        raw, L, lifted = self._quantize(target, floor)
        needed = _largest_ratio(L, M)
        steps = (np.log2(needed) - self.inflation.offset) / self.inflation.factor
        inflation = self.inflation.limited(np.ceil(steps))
        given = _lookup(self._variance_factor, self.inflation, inflation.astype(np.int64))
        raw[self.inflation.name] = inflation
        for name, value in raw.items():
            coded.raw[name][rows] = value.astype(np.int64)
        excess = needed / given
        coded.saturated[rows] = lifted
        coded.covered[rows] = excess <= 1
        return excess

    def _quantize(
        self, S: list[list[Array]], floor: list[Array]
    ) -> tuple[dict[str, Array], list[list[Array]], NDArray[np.bool_]]:
        """Cholesky's recursion and the quantization of its rows, in one pass.

        Args:
            S: rows of the lower triangle of the target, (N,) entries.
            floor: least value of each squared pivot. What a diagonal matrix added to
                a semidefinite one is a bound that rounding must not undercut.

        Returns:
            Raw pivots and ratios, the rows of L' that they decode to, and which
            targets had a pivot lifted.
        """
        raw: dict[str, Array] = {}
        L: list[list[Array]] = []
        A: list[list[Array]] = []
        decoded: list[list[Array]] = []
        saturated = np.zeros(len(S[0][0]), dtype=bool)
        for i, (table, pivot) in enumerate(zip(self._sigma, self.pivots, strict=True)):
            target: list[Array] = []
            for j in range(i):
                rest = S[i][j] - sum(target[k] * L[j][k] for k in range(j))
                target.append(rest / L[j][j])
            exact = np.sqrt(np.maximum(S[i][i] - sum(x * x for x in target), floor[i]))
            nearest = pivot.raw(np.log2(exact))
            chosen = pivot.limited(nearest)
            for _ in range(4):
                sigma = _lookup(table, pivot, chosen.astype(np.int64))
                row, overflow = self._choose_ratios(i, target, sigma, A, raw)
                over = overflow > 1
                if not over.any():
                    break
                lift = np.ceil(np.log2(overflow) / pivot.factor + 1e-9)
                chosen = pivot.limited(np.where(over, chosen + np.maximum(lift, 1), chosen))
            # A lifted pivot is variance of its own in the target: later rows lean on it less.
            lifted = chosen > nearest
            exact = np.where(lifted, sigma, exact)
            saturated |= lifted
            raw[pivot.name] = chosen
            decoded.append([*row, sigma])
            L.append([*target, exact])
            A.append(
                [(target[j] - sum(row[k] * A[k][j] for k in range(j, i))) / sigma for j in range(i)]
                + [exact / sigma]
            )
        return raw, decoded, saturated

    def _choose_ratios(
        self, i: int, target: list[Array], sigma: Array, A: list[list[Array]], raw: dict[str, Array]
    ) -> tuple[list[Array], Array]:
        """Row i of L' left of its pivot, from the diagonal outwards.

        Each ratio takes what is left of its target after the entries already chosen.

        Returns:
            The decoded entries, and by what factor the pivot is too small for them.
        """
        row = [sigma] * i
        overflow = np.ones_like(sigma)
        for j in reversed(range(i)):
            ratio = self.ratios[i][j]
            rest = target[j] - sum(row[k] * A[k][j] for k in range(j + 1, i))
            wanted = rest / (A[j][j] * sigma)
            nearest = ratio.raw(wanted)
            limited = ratio.limited(nearest)
            beyond = nearest != limited
            if beyond.any():
                end = np.abs(ratio.physical(limited)) + ratio.factor / 2
                overflow = np.maximum(overflow, np.where(beyond, np.abs(wanted) / end, 1.0))
            raw[ratio.name] = limited
            row[j] = ratio.physical(limited) * sigma
        return row, overflow


def _products(L: list[list[Any]], factor: Any) -> Iterator[tuple[int, int, Any]]:
    """Lower triangle of ``factor L L^T``, for arrays and for single numbers alike."""
    for i, row in enumerate(L):
        scaled = [factor * entry for entry in row]
        for j, column in enumerate(L[: i + 1]):
            value = scaled[0] * column[0]
            for k in range(1, j + 1):
                value += scaled[k] * column[k]
            yield i, j, value


def _largest_ratio(L: list[list[Array]], M: list[list[Array]]) -> Array:
    """(N,) largest eigenvalue of (L L^T)^-1 M and a little more, for rounding.

    The little grows with the condition of the factor, as the rounding does.
    """
    n = len(L)
    X: list[list[Array]] = []  # rows of L^-1
    for i in range(n):
        inverse = 1 / L[i][i]
        row = [-inverse * sum(L[i][k] * X[k][j] for k in range(j, i)) for j in range(i)]
        X.append([*row, inverse])
    W = np.empty((len(M[0][0]), n, n))
    amplification = np.zeros(len(W))
    for i in range(n):
        XM = [sum(X[i][k] * M[k][j] for k in range(i + 1)) for j in range(n)]
        for j in range(i + 1):
            W[:, i, j] = sum(XM[k] * X[j][k] for k in range(j + 1))
        amplification += sum(X[i][k] ** 2 * M[k][k] for k in range(i + 1))
    largest = np.linalg.eigvalsh(W, UPLO="L")[:, -1]
    margin = MARGIN + 32 * np.finfo(float).eps * amplification
    return np.maximum(largest, 0) * (1 + MARGIN) + margin


def _exp2_table(field: Field) -> Array | None:
    """2 to the physical value of each raw value; None where that would be too many."""
    if field.raw_max - field.raw_min >= 1 << 16:
        return None
    return np.exp2(field.physical(np.arange(field.raw_min, field.raw_max + 1)))


def _lookup(table: Array | None, field: Field, raw: NDArray[np.int64]) -> Array:
    """2 to the physical value; a raw value beyond the DBC's range counts as the range's end."""
    if table is None:
        return np.exp2(field.physical(raw))
    return table.take(raw - field.raw_min, mode="clip")


def _lookup_one(table: Array | None, field: Field, raw: int) -> float:
    if table is None:
        return float(np.exp2(field.physical_one(raw)))
    return table.item(min(max(raw - field.raw_min, 0), len(table) - 1))
