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
which S' minus the mean square error about the decoded mean is positive semidefinite.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..layout.record_layout import RecordLayout
from ..layout.signals import PARAMETER_SIGNALS
from .code import Array, Coded, CovarianceCode, check_octaves
from .factor import BLOCK, CholeskyFactor, exp2_table, lookup, lookup_one

#: Margin of the inflation, so that a check with another algorithm's rounding passes.
MARGIN = 1e-6


class CholeskyCode(CovarianceCode):
    """Pivots and ratios that are quantized with feedback, and an inflation.

    Args:
        layout: has the signals.
        rows: names of the k rows, in the order of the states of the covariance. The arrays of
            ``CovarianceCode`` then have k where they have 4.
    """

    name = "Cholesky"
    about = "as LogCholesky, with feedback from row to row, and inflated until it covers"
    positive_definite = True
    covering = True

    def __init__(self, layout: RecordLayout, rows: Sequence[str] = PARAMETER_SIGNALS) -> None:
        self.factor = CholeskyFactor(layout, rows)
        self.inflation = layout["Inflation"]
        self.signals = (*self.factor.signals, self.inflation)
        check_octaves(layout, [self.inflation])
        self._variance_factor = exp2_table(self.inflation)
        #: (k,) variances beyond which no pivot and ratios can cover: encoding them may overflow.
        self.reachable: Array = np.empty(len(rows))
        factor = self.factor
        for state, pivot, ratios in zip(factor.order, factor.pivots, factor.ratios, strict=True):
            reach = 1 + sum(max(map(abs, ratio.physical_range)) ** 2 for ratio in ratios)
            self.reachable[state] = 2.0 ** (2 * pivot.physical_range[1]) * reach

    def encode(self, error: Array, resolution: Array) -> Coded:
        n = len(error)
        coded = Coded(
            {signal.name: np.zeros(n, dtype=np.int64) for signal in self.signals},
            np.zeros(n, dtype=bool),
            np.zeros(n, dtype=bool),
        )
        diagonal = np.einsum("nii->ni", error)
        for start in range(0, n, BLOCK):
            rows = np.arange(start, min(start + BLOCK, n))
            rows = rows[(diagonal[rows] < 4 * self.reachable).all(axis=1)]
            scale = np.ones(len(rows))
            # Once is enough, unless the inflation of the DBC is too small for its steps, or a value
            # is clipped. Then encode again, for a target that is scaled by what was missing.
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

    def decode(self, raw: Mapping[str, NDArray[np.int64]]) -> Array:
        scale = lookup(self._variance_factor, self.inflation, raw[self.inflation.name])
        return self.factor.decode(raw, scale)

    @property
    def reach(self) -> Array:
        """(k,) largest standard deviations of a decoded covariance."""
        return np.sqrt(self.reachable)

    def decode_one(self, raw: Mapping[str, int]) -> Array:
        scale = lookup_one(self._variance_factor, self.inflation, raw[self.inflation.name])
        return self.factor.decode_one(raw, scale)

    def widest(self) -> dict[str, int]:
        return self.factor.widest() | {self.inflation.name: self.inflation.raw_max}

    def _encode_block(
        self, error: Array, resolution: Array, scale: Array, rows: NDArray[np.intp], coded: Coded
    ) -> Array:
        """Encode (n, k, k) targets, each multiplied by its scale, into these rows of ``coded``.

        Returns the (n,) ratios of the needed to the available inflation; up to 1 it suffices.
        """
        order = self.factor.order
        M = [[error[:, i, j].copy() for j in order] for i in order]
        floor = [resolution[i] * scale for i in order]
        target = [[scale * M[i][j] for j in range(i + 1)] for i in range(len(order))]
        for i in range(len(order)):
            target[i][i] = target[i][i] + floor[i]
        raw, L, lifted = self._quantize(target, floor)
        needed = _largest_ratio(L, M)
        steps = (np.log2(needed) - self.inflation.offset) / self.inflation.factor
        inflation = self.inflation.limited(np.ceil(steps))
        given = lookup(self._variance_factor, self.inflation, inflation.astype(np.int64))
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
        """Factorize targets, given by the rows of their lower triangle, and quantize the factor.

        The least value of each squared pivot is ``floor``, the diagonal matrix that was added to
        the semidefinite target; rounding must not yield less. Returns the raw pivots and ratios,
        the rows of the decoded L', and which targets had a pivot lifted.
        """
        raw: dict[str, Array] = {}
        L: list[list[Array]] = []
        A: list[list[Array]] = []
        decoded: list[list[Array]] = []
        lifts: list[NDArray[np.bool_]] = []
        for i, (table, pivot) in enumerate(
            zip(self.factor.sigmas, self.factor.pivots, strict=True)
        ):
            target: list[Array] = []
            for j in range(i):
                rest = S[i][j] - sum(target[k] * L[j][k] for k in range(j))
                target.append(rest / L[j][j])
            exact = np.sqrt(np.maximum(S[i][i] - sum(x * x for x in target), floor[i]))
            nearest = pivot.raw(np.log2(exact))
            chosen = pivot.limited(nearest)
            for _ in range(4):
                sigma = lookup(table, pivot, chosen.astype(np.int64))
                row, overflow = self._choose_ratios(i, target, sigma, A, raw)
                over = overflow > 1
                if not over.any():
                    break
                lift = np.ceil(np.log2(overflow) / pivot.factor + 1e-9)
                chosen = pivot.limited(np.where(over, chosen + np.maximum(lift, 1), chosen))
            # The target takes over a lifted pivot, so the entries below it become smaller.
            lifted = chosen > nearest
            exact = np.where(lifted, sigma, exact)
            lifts.append(lifted)
            raw[pivot.name] = chosen
            decoded.append([*row, sigma])
            L.append([*target, exact])
            A.append(
                [(target[j] - sum(row[k] * A[k][j] for k in range(j, i))) / sigma for j in range(i)]
                + [exact / sigma]
            )
        return raw, decoded, np.logical_or.reduce(lifts)

    def _choose_ratios(
        self, i: int, target: list[Array], sigma: Array, A: list[list[Array]], raw: dict[str, Array]
    ) -> tuple[list[Array], Array]:
        """Quantize row i of L' left of its pivot, from the diagonal outwards.

        Each ratio is the nearest to the rest of its target after the entries already chosen. The
        rows of ``L'^-1 L`` above this one are A. The ratios are added to ``raw``. Returns the
        decoded entries, and the factor by which the decoded pivot sigma is too small for them.
        """
        row = [sigma] * i
        overflow = np.ones_like(sigma)
        for j in reversed(range(i)):
            ratio = self.factor.ratios[i][j]
            rest = target[j] - sum(row[k] * A[k][j] for k in range(j + 1, i))
            wanted = rest / (A[j][j] * sigma)
            limited, decoded, beyond = ratio.nearest(wanted)
            if beyond.any():
                end = np.abs(decoded) + ratio.factor / 2
                overflow = np.maximum(overflow, np.where(beyond, np.abs(wanted) / end, 1.0))
            raw[ratio.name] = limited
            row[j] = decoded * sigma
        return row, overflow


def _largest_ratio(L: list[list[Array]], M: list[list[Array]]) -> Array:
    """Return the (N,) largest eigenvalues of (L L^T)^-1 M, plus a margin for rounding.

    The margin increases with the condition number of the factor, as the rounding error does.
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
