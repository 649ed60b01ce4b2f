"""Default covariance code: the signals of a Cholesky factor, and what a DBC may make of them.

The signals are the pivots ``log2 L_ii``, the ratios ``L_ij / L_ii``, and the inflation, an exponent
of 2 by which the matrix is multiplied. ``c/src/cholesky.c`` writes and reads them;
``model/covariance.py`` says how, and why the decoded covariance covers the target.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, combinations

import numpy as np
from numpy.typing import NDArray

from ...values.elementary import exp2
from ...values.errors import LayoutError
from .record_layout import RecordLayout
from .record_signals import OCTAVES, PARAMETER_SIGNALS, RATIO, Signal

#: Largest condition number of a decoded correlation matrix that double precision holds.
MAX_CONDITION = 1e13


class CholeskyFactor:
    """Cholesky factor as the signals ``Pivot<row>`` and ``Ratio<row><column>`` of a layout.

    Any bits decode to a positive definite matrix (Pinheiro and Bates, Statistics and Computing 6,
    1996, with each row divided by its pivot). The names give the order of the rows: with
    ``RatioC0Beta``, C0 comes after Beta.

    Args:
        layout: has the signals.
        rows: names of the rows, in the order of the states of the covariance.

    Raises:
        LayoutError: a signal is missing, the ratios do not define an order of the rows, a factor
            is not positive, or a decoded matrix could be too ill-conditioned.
    """

    def __init__(self, layout: RecordLayout, rows: Sequence[str] = PARAMETER_SIGNALS) -> None:
        below = {
            row: [column for column in rows if f"Ratio{row}{column}" in layout.signals]
            for row in rows
        }
        names = sorted(rows, key=lambda state: len(below[state]))
        if [len(below[name]) for name in names] != list(range(len(rows))):
            missing = [
                f"Ratio{a}{b} or Ratio{b}{a}"
                for a, b in combinations(rows, 2)
                if a not in below[b] and b not in below[a]
            ]
            raise LayoutError(
                f"{layout.source}: the ratios must order the rows, Ratio<row><column> for each "
                f"pair of {', '.join(rows)}, but there are {below}"
                f"{'; add ' if missing else ''}{' and '.join(missing)}"
            )
        #: Order of the rows, as indices into the states.
        self.order = [rows.index(name) for name in names]
        self.pivots = [layout[f"Pivot{name}"] for name in names]
        self.ratios = [
            [layout[f"Ratio{row}{column}"] for column in names[:i]] for i, row in enumerate(names)
        ]
        self.signals: tuple[Signal, ...] = (*self.pivots, *chain(*self.ratios))
        for pivot in self.pivots:
            OCTAVES.check(pivot, layout.source)
        for ratio in chain(*self.ratios):
            RATIO.check(ratio, layout.source)
        if (condition := self._largest_condition()) > MAX_CONDITION:
            raise LayoutError(
                f"{layout.source}: with {', '.join(ratio.name for ratio in chain(*self.ratios))} a "
                f"matrix could have the condition number {condition:.0e}, too large for double "
                "precision; give them smaller factors or fewer bits"
            )

    def _largest_condition(self) -> float:
        """Return the largest trace of the inverse correlation matrix of any bits.

        The condition number is at most this times the number of rows.
        """
        reach = np.zeros((len(self.ratios), len(self.ratios)))
        for i, ratios in enumerate(self.ratios):
            reach[i, :i] = [max(map(abs, ratio.reach)) for ratio in ratios]
        inverse = np.eye(len(reach))  # of I - reach, which has the worst signs; no term cancels
        for i in range(1, len(reach)):
            inverse[i] += reach[i, :i] @ inverse[:i]
        norm = np.sqrt(1 + (reach**2).sum(axis=1))
        return float(((inverse * norm) ** 2).sum())


class CholeskyCode:
    """Pivots and ratios that are quantized with feedback, and an inflation.

    Args:
        layout: has the signals.
        rows: names of the k rows, in the order of the states of the covariance.

    Raises:
        LayoutError: a signal is missing, or has an unsuitable factor or range.
    """

    #: Name in the DBC's attribute CovarianceCode.
    name = "Cholesky"

    def __init__(self, layout: RecordLayout, rows: Sequence[str] = PARAMETER_SIGNALS) -> None:
        self.factor = CholeskyFactor(layout, rows)
        self.inflation = layout["Inflation"]
        #: Signals that hold the covariance.
        self.signals = (*self.factor.signals, self.inflation)
        OCTAVES.check(self.inflation, layout.source)
        #: (k,) variances beyond which no pivot and ratios can cover: encoding them may overflow.
        self.reachable: NDArray[np.float64] = np.empty(len(rows))
        factor = self.factor
        for state, pivot, ratios in zip(factor.order, factor.pivots, factor.ratios, strict=True):
            reach = 1.0
            for ratio in ratios:
                reach += max(map(abs, ratio.physical_range)) ** 2
            self.reachable[state] = exp2(2 * pivot.physical_range[1]) * reach
