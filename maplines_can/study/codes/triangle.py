"""The upper triangle of the covariance, entry by entry: as linear signals, or as floats.

Linear signals are the literal reading of the paper, each scaled for its two states. With each entry
rounded to the nearest, a nearly singular matrix is usually not positive definite any more.
``LinearCovering`` therefore searches raw values for a small matrix that covers the true one.

DroneCAN uses float16, MAVLink float32. A DBC has no type for float16, so these are signals of 16
bits that hold the pattern of IEEE 754 binary16; float32 are signals of type float.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ...values.errors import LayoutError
from ...wire.layout.message_layout import Layout
from ...wire.layout.record_signals import PARAMETER_SIGNALS
from .code import ENTRY, Array, Coded, CovarianceCode, check, nearest_raw

#: The upper triangle, row by row, as in the paper.
PAIRS = tuple((i, j) for i in range(4) for j in range(i, 4))
#: Margin of the covering matrix [steps], for rounding in a check by another algorithm.
SLACK = 1e-6


def triangle_name(i: int, j: int) -> str:
    """Return the name of the signal of an entry."""
    return f"Cov{PARAMETER_SIGNALS[i]}{PARAMETER_SIGNALS[j]}"


def half_name(i: int, j: int) -> str:
    """Return the name of the signal of a float16 entry."""
    return f"{triangle_name(i, j)}Half"


# ---- linear signals -------------------------------------------------------------------


class _LinearTriangle(CovarianceCode):
    """Base of codes with linear entries."""

    def __init__(self, layout: Layout) -> None:
        self.entries = {pair: layout[triangle_name(*pair)] for pair in PAIRS}
        self.signals = tuple(self.entries.values())
        check(layout, self.signals, ENTRY)

    def decode(self, raw: Mapping[str, NDArray[np.int64]]) -> Array:
        cov = np.empty((len(raw[self.signals[0].name]), 4, 4))
        for (i, j), signal in self.entries.items():
            cov[:, i, j] = cov[:, j, i] = signal.physical(raw[signal.name])
        return cov

    def widest(self) -> dict[str, int]:
        return {s.name: s.raw_max if i == j else 0 for (i, j), s in self.entries.items()}


class LinearNearest(_LinearTriangle):
    """Each entry rounded to the nearest."""

    name = "LinearNearest"
    about = "the upper triangle of the covariance, 16 bits linear each, rounded to the nearest"
    positive_definite = False
    covering = False

    def encode(self, error: Array, resolution: Array) -> Coded:
        raw: dict[str, NDArray[np.int64]] = {}
        cut = np.zeros(len(error), dtype=bool)
        target = error + np.diag(resolution)
        for (i, j), signal in self.entries.items():
            raw[signal.name], beyond = nearest_raw(signal, target[:, i, j])
            cut |= beyond
        return Coded(raw, cut, ~cut)


class LinearCovering(_LinearTriangle):
    """Entries rounded to the nearest, with variances raised until the matrix covers the true one.

    Raising each variance by the rounding errors in its row is always enough, since a symmetric
    matrix with a dominant diagonal is positive semidefinite. From there each variance is lowered
    step by step while the matrix still covers the true one.
    """

    name = "Linear"
    about = "the upper triangle of the covariance, 16 bits linear each, variances raised to cover"
    positive_definite = False
    covering = True

    def encode(self, error: Array, resolution: Array) -> Coded:
        n = len(error)
        step = np.sqrt([self.entries[i, i].factor for i in range(4)])  # unit of each state
        with np.errstate(over="ignore"):
            target = error + np.diag(resolution)
        raw: dict[str, NDArray[np.int64]] = {}
        cut = np.zeros(n, dtype=bool)
        excess = -target / (step[:, None] * step)  # of the decoded matrix over the target
        for (i, j), signal in self.entries.items():
            if i != j:
                raw[signal.name], beyond = nearest_raw(signal, target[:, i, j])
                cut |= beyond
                excess[:, i, j] += signal.physical(raw[signal.name]) / (step[i] * step[j])
                excess[:, j, i] = excess[:, i, j]
        off = excess * (1 - np.eye(4))
        wanted = np.ceil(np.abs(off).sum(axis=2) - np.einsum("nii->ni", excess) + SLACK)
        for i in range(4):
            excess[:, i, i] += wanted[:, i]
        live = np.isfinite(excess).all(axis=(1, 2))
        # Lower the variance first that is smallest in steps: there a step matters most.
        order = np.argsort(wanted, axis=1)
        rows = np.arange(n)
        for place in (*range(4), *range(4)):
            state = order[:, place]
            for _ in range(4):
                trial = excess.copy()
                trial[rows, state, state] -= 1
                trial[~live] = np.eye(4)
                fits = live & (np.linalg.eigvalsh(trial)[:, 0] > SLACK) & (wanted[rows, state] > 1)
                if not fits.any():
                    break
                excess[rows[fits], state[fits], state[fits]] -= 1
                wanted[rows[fits], state[fits]] -= 1
        for i in range(4):
            signal = self.entries[i, i]
            limited = signal.limited(wanted[:, i])
            cut |= limited != wanted[:, i]
            raw[signal.name] = limited.astype(np.int64)
        return Coded(raw, cut, ~cut & live)


# ---- floating-point numbers -----------------------------------------------------------


class _FloatTriangle(CovarianceCode):
    """Base of codes with floating-point entries, rounded to the nearest."""

    positive_definite = False
    covering = False
    _type: ClassVar[Any]
    _pattern: ClassVar[Any]
    _is_float: ClassVar[bool]

    def __init__(self, layout: Layout) -> None:
        bits = 8 * np.dtype(self._type).itemsize
        name = triangle_name if self._is_float else half_name
        self.entries = {pair: layout[name(*pair)] for pair in PAIRS}
        self.signals = tuple(self.entries.values())
        for signal in self.signals:
            conversion = signal.factor, signal.offset, signal.signed, signal.is_float
            if signal.length != bits or conversion != (1, 0, False, self._is_float):
                kind = "a float" if self._is_float else "an unsigned pattern"
                raise LayoutError(
                    f"{layout.source}: signal {signal.name} must be {kind} of {bits} bits, with "
                    "factor 1 and offset 0"
                )

    def encode(self, error: Array, resolution: Array) -> Coded:
        raw: dict[str, NDArray[np.int64]] = {}
        fits = np.ones(len(error), dtype=bool)
        with np.errstate(over="ignore"):
            target = error + np.diag(resolution)
            for (i, j), signal in self.entries.items():
                value = target[:, i, j].astype(self._type)
                fits &= np.isfinite(value)
                raw[signal.name] = value.view(self._pattern).astype(np.int64)
        return Coded(raw, ~fits, fits)

    def decode(self, raw: Mapping[str, NDArray[np.int64]]) -> Array:
        cov = np.empty((len(raw[self.signals[0].name]), 4, 4))
        with np.errstate(invalid="ignore"):  # any bits may be received, also those of a NaN
            for (i, j), signal in self.entries.items():
                value = raw[signal.name].astype(self._pattern).view(self._type)
                cov[:, i, j] = cov[:, j, i] = value
        return cov

    def widest(self) -> dict[str, int]:
        largest = np.array(np.finfo(self._type).max, dtype=self._type).view(self._pattern)
        return {s.name: int(largest) if i == j else 0 for (i, j), s in self.entries.items()}


class Float32Triangle(_FloatTriangle):
    """Ten numbers in single precision."""

    name = "Float32"
    about = "the upper triangle of the covariance as ten float32"
    _type, _pattern, _is_float = np.float32, np.uint32, True


class Float16Triangle(_FloatTriangle):
    """Ten numbers in half precision: variances below 6e-8 lose digits or become zero."""

    name = "Float16"
    about = "the upper triangle of the covariance as ten float16 in SI units"
    _type, _pattern, _is_float = np.float16, np.uint16, False
