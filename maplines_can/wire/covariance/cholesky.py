"""Default covariance code: a Cholesky factor that is quantized with feedback.

Let ``S = L L^T`` be the covariance in the order of the rows, with L lower triangular, and
``S' = L' L'^T`` the decoded covariance. With ``A = L'^-1 L``,

    KL(N(0, S) || N(0, S')) = sum_i ((a_ii^2 - 1) / 2 - ln a_ii) + 1/2 sum_{i>j} a_ij^2,

so each entry of A contributes to the divergence by itself. The signals are the pivots
``log2 L'_ii`` and the ratios ``L'_ij / L'_ii``. Row by row, from the diagonal outwards, each ratio
is chosen such that its a_ij is closest to zero *given the entries that are already quantized*. So
every |a_ij| is at most half a step, for any covariance, and the expected divergence is a constant
of the code: a ratio of step D costs D^2 / 24, and a pivot of step D (in octaves) costs
(D ln 2)^2 / 12.

The decoded covariance covers the target, for two reasons. First, if a ratio is out of range, its
pivot is lifted until the ratio fits. This adds variance only in the one direction that is narrower
than the code can represent. Second, the matrix is multiplied by 2^inflation, the least one for
which S' minus the mean square error about the decoded mean is positive definite: for which it has a
Cholesky factor, in units of the decoded one. All operations are in a fixed order, that of
``c/src/cholesky.c``, so that the raw values are the same on any machine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ...values.elementary import exp2
from ..layout.record_layout import RecordLayout
from ..layout.signals import OCTAVES, PARAMETER_SIGNALS
from .factor import CholeskyFactor, PowersOfTwo

Array = NDArray[np.float64]


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
        self._sigma_factors = PowersOfTwo(self.inflation, share=0.5)
        #: (k,) variances beyond which no pivot and ratios can cover: encoding them may overflow.
        self.reachable: Array = np.empty(len(rows))
        factor = self.factor
        for state, pivot, ratios in zip(factor.order, factor.pivots, factor.ratios, strict=True):
            reach = 1.0
            for ratio in ratios:
                reach += max(map(abs, ratio.physical_range)) ** 2
            self.reachable[state] = exp2(2 * pivot.physical_range[1]) * reach

    def decode(self, raw: Mapping[str, NDArray[np.int64]]) -> Array:
        """Return the (N, k, k) covariances of (N,) raw values by signal."""
        return self.factor.decode(raw, self._sigma_factors.of(raw[self.inflation.name]))

    def decode_one(self, raw: Mapping[str, int]) -> Array:
        """Return one (k, k) covariance: as ``decode`` to the last bit."""
        return self.factor.decode_one(raw, self._sigma_factors.of_one(raw[self.inflation.name]))

    def factors(self, raw: Mapping[str, NDArray[np.int64]]) -> Array:
        """Return the (N, k, k) square roots F of the decoded covariances F F^T.

        Row i belongs to state i; F is lower triangular with its rows in the order of the DBC.
        """
        return self.factor.factors(raw, self._sigma_factors.of(raw[self.inflation.name]))
