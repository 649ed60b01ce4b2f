"""The upper triangle of the covariance as linear signals: the literal reading of the paper.

Each entry is a DBC signal of its own, scaled for its two states. Rounded to the nearest, the
matrix is as a rule no covariance at all where it is nearly singular. ``Linear`` therefore
searches among raw values for the smallest matrix that covers what is sent.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ...errors import LayoutError
from ...wire.covariance.code import Array, Coded
from ...wire.message.layout import Layout
from ...wire.message.signals import STATE_SIGNALS
from .batch import BatchCode, nearest_raw

__all__ = ["PAIRS", "Linear", "LinearNearest", "triangle_name"]

#: The upper triangle, row by row, as the paper sends it.
PAIRS = tuple((i, j) for i in range(4) for j in range(i, 4))
#: Steps of slack between what is sent and what covers it, for the rounding of who checks.
SLACK = 1e-6


def triangle_name(i: int, j: int) -> str:
    """The signal of an entry."""
    return f"Cov{STATE_SIGNALS[i]}{STATE_SIGNALS[j]}"


class _LinearTriangle(BatchCode):
    """Entries of the upper triangle as linear signals."""

    def __init__(self, layout: Layout) -> None:
        self.entries = {pair: layout[triangle_name(*pair)] for pair in PAIRS}
        self.signals = tuple(self.entries.values())
        for signal in self.signals:
            if signal.offset or signal.factor <= 0:
                raise LayoutError(
                    f"{layout.source}: signal {signal.name} needs a positive factor and no offset"
                )

    def decode(self, raw: Mapping[str, NDArray[np.int64]]) -> Array:
        cov = np.empty((len(raw[self.signals[0].name]), 4, 4))
        for (i, j), signal in self.entries.items():
            cov[:, i, j] = cov[:, j, i] = signal.physical(raw[signal.name])
        return cov

    def widest(self) -> dict[str, int]:
        return {
            signal.name: signal.raw_max if i == j else 0 for (i, j), signal in self.entries.items()
        }


class LinearNearest(_LinearTriangle):
    """Each entry by itself, rounded to the nearest."""

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


class Linear(_LinearTriangle):
    """The entries, with variances raised until the matrix covers what is sent.

    Raising each variance by the rounding errors in its row is always enough
    (a symmetric matrix with a dominant diagonal is positive semidefinite); from there each is
    lowered, step by step, as far as the matrix goes on covering.
    """

    name = "Linear"
    about = "the upper triangle of the covariance, 16 bits linear each, variances raised to cover"
    positive_definite = False
    covering = True

    def encode(self, error: Array, resolution: Array) -> Coded:
        n = len(error)
        step = np.sqrt([self.entries[i, i].factor for i in range(4)])  # a unit for each state
        with np.errstate(over="ignore"):
            target = error + np.diag(resolution)
        raw: dict[str, NDArray[np.int64]] = {}
        cut = np.zeros(n, dtype=bool)
        excess = -target / (step[:, None] * step)  # of the decoded over the target
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
        # The step that matters most first: the variance that is smallest for its step.
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
