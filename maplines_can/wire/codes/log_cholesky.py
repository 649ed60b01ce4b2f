"""Log-Cholesky without feedback: each pivot and each ratio rounded by itself.

The rows of ``S = L L^T`` go as pivots ``log2 L_ii`` and ratios ``L_ij / L_ii`` (Pinheiro and
Bates, Statistics and Computing 6, 1996, with each row divided by its pivot). Any
bits give a positive definite matrix. Nothing makes the result cover what was sent: an error
in one entry goes into all that lean on it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import LayoutError
from ..contract import SignalSpec
from ..field import Field
from ..layout import STATE_SIGNALS, Layout
from .code import Array, Coded, CovarianceCode, check_octaves, nearest_raw

__all__ = [
    "BLOCK",
    "PIVOTS_AND_RATIOS",
    "LogCholesky",
    "lookup",
    "pivot_signal",
    "ratio_signal",
]

#: Rows worked on at a time: all arrays of a block stay in the cache.
BLOCK = 2048


def ratio_signal(
    row: str, column: str, bits: int, factor: float, zero: float = 0.5, why: str = ""
) -> SignalSpec:
    """The signal of an entry left of the diagonal.

    Args:
        row: state of the row.
        column: state of the column.
        bits: width.
        factor: step.
        zero: where in the range 0 lies, from 0 at its low end to 1 at its high one.
        why: what the range is made for.
    """
    offset = -(2.0**bits) * zero * factor
    signed = zero == 0.5
    ends = offset, offset + 2**bits * factor
    reach = f"+-{ends[1]:g}" if signed else f"{ends[0]:g} to {ends[1]:g}"
    return SignalSpec(
        f"Ratio{row}{column}",
        bits,
        factor,
        "",
        f"Part of {row} that goes with {column}: entry ({row}, {column}) of the lower Cholesky "
        f"factor of the covariance, divided by the pivot of {row}.",
        f"step {_fraction(factor)}: the expected KL of its rounding is step^2/24; range "
        f"{reach}, {why or 'as far as a pose-only covariance drives it'}",
        offset=0.0 if signed else offset,
        signed=signed,
    )


def _fraction(factor: float) -> str:
    numerator, denominator = factor.as_integer_ratio()
    return f"{numerator}/{denominator}" if 1 < denominator < 10**6 else f"{factor:g}"


def pivot_signal(
    state: str, given: tuple[str, ...], bits: int, factor: float, offset: float
) -> SignalSpec:
    """The signal of a diagonal entry.

    Args:
        state: of the row.
        given: states of the rows before it.
        bits: width.
        factor: step [octave].
        offset: low end of the range [octave].
    """
    unit = UNITS[state]
    *first, last = given or ("",)
    of = f" given {', '.join(first)}{' and ' if first else ''}{last}" if given else ""
    return SignalSpec(
        f"Pivot{state}",
        bits,
        factor,
        "octave",
        f"log2 of the standard deviation of {state} [{unit}]{of}.",
        f"from the resolution of the mean's own grid, 2^{offset:g} {unit}, upwards in steps of "
        f"{100 * (2**factor - 1):.2g} %",
        offset=float(offset),
    )


#: Units of the states.
UNITS = dict(zip(STATE_SIGNALS, ("m", "rad", "1/m", "1/m^2"), strict=True))
#: The rows of the default wire. They are what ``maplines design`` makes of the targets in
#: dbc/README.md, where also is told why this order, these ranges and steps.
PIVOTS_AND_RATIOS = (
    pivot_signal("C1", (), 9, 0.054, -32),
    pivot_signal("C0", ("C1",), 9, 0.0401, -23),
    ratio_signal("C0", "C1", 12, 1 / 32, zero=5 / 8),
    pivot_signal("YOff", ("C1", "C0"), 9, 0.034, -12),
    ratio_signal("YOff", "C1", 8, 5 / 128),
    ratio_signal("YOff", "C0", 8, 3 / 64),
    pivot_signal("Beta", ("C1", "C0", "YOff"), 9, 0.0341, -18),
    ratio_signal("Beta", "C1", 15, 3 / 64, zero=1 / 8),
    ratio_signal("Beta", "C0", 15, 5 / 128),
    ratio_signal("Beta", "YOff", 8, 1 / 32, zero=3 / 8),
)


class LogCholesky(CovarianceCode):
    """Pivots and ratios, each the nearest.

    The order of the rows is in the names: ``RatioC0Beta`` says that C0 comes
    after Beta.
    """

    name = "LogCholesky"
    about = "log2 of the Cholesky pivots, and the rows over their pivots, each rounded by itself"
    positive_definite = True
    covering = False

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
        self.fields: list[Field] = [*self.pivots, *chain(*self.ratios)]
        for field in self.fields:
            if field.factor <= 0:
                raise LayoutError(f"{layout.source}: signal {field.name} needs a positive factor")
        if (condition := self._worst_condition()) > 1e13:
            raise LayoutError(
                f"{layout.source}: the ratios reach so far that a matrix could have the condition "
                f"{condition:.0e}, which double precision cannot hold; make their ranges narrower"
            )
        check_octaves(layout, self.pivots)
        self.sigmas = [exp2_table(field) for field in self.pivots]

    def _worst_condition(self) -> float:
        """Bound on the condition of a decoded correlation matrix, whatever its bits."""
        reach = np.zeros((4, 4))
        for i, ratios in enumerate(self.ratios):
            reach[i, :i] = [max(map(abs, ratio.physical_range)) for ratio in ratios]
        inverse = np.linalg.inv(np.eye(4) - reach)  # of the unit factor, the worst signs
        norm = np.sqrt(1 + (reach**2).sum(axis=1))
        return float(((inverse * norm) ** 2).sum())

    @classmethod
    def signals(cls, finer_bits: int = 0) -> tuple[SignalSpec, ...]:
        return tuple(spec.finer(finer_bits) for spec in PIVOTS_AND_RATIOS)

    def encode(self, error: Array, resolution: Array) -> Coded:
        raw: dict[str, NDArray[np.int64]] = {}
        cut = np.zeros(len(error), dtype=bool)
        L: list[list[Array]] = []
        for row, i in enumerate(self.order):
            entries: list[Array] = []
            for column, j in enumerate(self.order[:row]):
                rest = error[:, i, j] - sum(entries[k] * L[column][k] for k in range(column))
                entries.append(rest / L[column][column])
            variance = error[:, i, i] + resolution[i] - sum(entry**2 for entry in entries)
            pivot = np.sqrt(np.maximum(variance, resolution[i]))
            L.append([*entries, pivot])
            wanted = [np.log2(pivot), *(entry / pivot for entry in entries)]
            for field, value in zip((self.pivots[row], *self.ratios[row]), wanted, strict=True):
                raw[field.name], beyond = nearest_raw(field, value)
                cut |= beyond
        return Coded(raw, cut, ~cut)

    def decode(self, raw: Mapping[str, NDArray[np.int64]]) -> Array:
        n = len(raw[self.pivots[0].name])
        cov = np.empty((n, 4, 4))
        for start in range(0, n, BLOCK):
            rows = slice(start, start + BLOCK)
            block = {field.name: raw[field.name][rows] for field in self.fields}
            L = []
            for table, pivot, ratios in zip(self.sigmas, self.pivots, self.ratios, strict=True):
                sigma = lookup(table, pivot, block[pivot.name])
                L.append([ratio.physical(block[ratio.name]) * sigma for ratio in ratios] + [sigma])
            for i, j, value in _products(L, self._factor(block)):
                cov[rows, self.order[i], self.order[j]] = value
                cov[rows, self.order[j], self.order[i]] = value
        return cov

    def decode_one(self, raw: Mapping[str, int]) -> Array:
        L = []
        for table, pivot, ratios in zip(self.sigmas, self.pivots, self.ratios, strict=True):
            sigma = lookup_one(table, pivot, raw[pivot.name])
            L.append([ratio.physical_one(raw[ratio.name]) * sigma for ratio in ratios] + [sigma])
        cov = [[0.0] * 4 for _ in range(4)]
        for i, j, value in _products(L, self._factor_one(raw)):
            cov[self.order[i]][self.order[j]] = cov[self.order[j]][self.order[i]] = value
        return np.array(cov)

    def widest(self) -> dict[str, int]:
        pivots = {pivot.name: pivot.raw_max for pivot in self.pivots}
        none = {ratio.name: int(ratio.limited(ratio.raw(0.0))) for ratio in chain(*self.ratios)}
        return super().widest() | pivots | none

    def _factor(self, raw: Mapping[str, NDArray[np.int64]]) -> Any:
        """(N,) what multiplies ``L' L'^T``."""
        return 1.0

    def _factor_one(self, raw: Mapping[str, int]) -> float:
        """The same of one record."""
        return 1.0


def _products(L: list[list[Any]], factor: Any) -> Iterator[tuple[int, int, Any]]:
    """Lower triangle of ``factor L L^T``, for arrays and for single numbers alike."""
    for i, row in enumerate(L):
        scaled = [factor * entry for entry in row]
        for j, column in enumerate(L[: i + 1]):
            value = scaled[0] * column[0]
            for k in range(1, j + 1):
                value += scaled[k] * column[k]
            yield i, j, value


def exp2_table(field: Field) -> Array | None:
    """2 to the physical value of each raw value; None where that would be too many."""
    if field.raw_max - field.raw_min >= 1 << 16:
        return None
    return np.exp2(field.physical(np.arange(field.raw_min, field.raw_max + 1)))


def lookup(table: Array | None, field: Field, raw: NDArray[np.int64]) -> Array:
    """2 to the physical value; a raw value beyond the DBC's range counts as the range's end."""
    if table is None:
        return np.exp2(field.physical(raw))
    return table.take(raw - field.raw_min, mode="clip")


def lookup_one(table: Array | None, field: Field, raw: int) -> float:
    """The same of one value, to the last bit."""
    if table is None:
        return float(np.exp2(field.physical_one(raw)))
    return table.item(min(max(raw - field.raw_min, 0), len(table) - 1))
