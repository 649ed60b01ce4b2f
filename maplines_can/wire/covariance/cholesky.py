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

from ...values import fixed_order
from ...values.elementary import exp2, log2
from ..layout.record_layout import RecordLayout
from ..layout.signals import PARAMETER_SIGNALS
from .cholesky_one import (
    AMPLIFIED,
    ATTEMPTS,
    LIFTS,
    MARGIN,
    SLACK,
    WIDER,
    CholeskyOne,
)
from .code import Array, Coded, CodedOne, check_octaves
from .factor import BLOCK, CholeskyFactor, PowersOfTwo

#: Up to this number, covariances are encoded one by one.
FEW = 6


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
        check_octaves(layout, [self.inflation])
        self._variance_factors = PowersOfTwo(self.inflation)
        self._sigma_factors = PowersOfTwo(self.inflation, share=0.5)
        #: (k,) variances beyond which no pivot and ratios can cover: encoding them may overflow.
        self.reachable: Array = np.empty(len(rows))
        factor = self.factor
        for state, pivot, ratios in zip(factor.order, factor.pivots, factor.ratios, strict=True):
            reach = 1.0
            for ratio in ratios:
                reach += max(map(abs, ratio.physical_range)) ** 2
            self.reachable[state] = exp2(2 * pivot.physical_range[1]) * reach
        reachable = self.reachable.tolist()
        self._one = CholeskyOne(factor, self.inflation, self._variance_factors, reachable)

    def encode(self, error: Array, resolution: Array) -> Coded:
        """Encode covariances.

        Args:
            error: (N, k, k) positive semidefinite target that the decoded covariance must cover:
                the covariance plus d d^T, with d the error of the decoded mean.
            resolution: (k,) variances of the mean's rounding error, a floor for singular matrices.
        """
        if len(error) > FEW:
            return self._encode_many(error, resolution)
        least = resolution.tolist()
        coded = [self.encode_one(rows, least) for rows in error.tolist()]
        return Coded(
            {s.name: np.array([one.raw[s.name] for one in coded], int) for s in self.signals},
            np.array([one.saturated for one in coded], bool),
            np.array([one.covered for one in coded], bool),
        )

    def encode_one(self, error: list[list[float]], resolution: list[float]) -> CodedOne:
        """Encode one (k, k) covariance: as ``encode`` to the last bit."""
        try:
            return self._one.encode(error, resolution)
        except (ArithmeticError, ValueError):  # a number is infinite or NaN on the way
            with np.errstate(all="ignore"):
                return self._encode_many(np.array([error]), np.array(resolution)).first()

    def _encode_many(self, error: Array, resolution: Array) -> Coded:
        """Encode (N, k, k) targets by arrays: as ``encode``."""
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
            for _ in range(ATTEMPTS):
                covered, excess = self._encode_block(error[rows], resolution, scale, rows, coded)
                if covered.all():
                    break
                rows, scale = rows[~covered], WIDER * scale[~covered] * excess
        lost = ~coded.covered
        if lost.any():
            for name, raw in self.widest().items():
                coded.raw[name][lost] = raw
        return coded

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

    @property
    def reach(self) -> Array:
        """(k,) largest standard deviations of a decoded covariance."""
        return np.sqrt(self.reachable)

    def widest(self) -> dict[str, int]:
        """Return the raw values of the widest covariance, for a line without a covariance."""
        return self.factor.widest() | {self.inflation.name: self.inflation.raw_max}

    def _encode_block(
        self, error: Array, resolution: Array, scale: Array, rows: NDArray[np.intp], coded: Coded
    ) -> tuple[NDArray[np.bool_], Array]:
        """Encode (n, k, k) targets, each multiplied by its scale, into these rows of ``coded``.

        Returns the (n,) rows that the decoded covariance covers, and for the others the ratio of
        the needed to the available inflation.
        """
        order = self.factor.order
        M = [[error[:, i, j].copy() for j in order] for i in order]
        floor = [resolution[i] * scale for i in order]
        target = [[scale * M[i][j] for j in range(i + 1)] for i in range(len(order))]
        for i in range(len(order)):
            target[i][i] = target[i][i] + floor[i]
        raw, L, lifted = self._quantize(target, floor)
        inflation, covered, excess = self._least_inflation(*_whitened(L, M))
        raw[self.inflation.name] = inflation
        for name, value in raw.items():
            coded.raw[name][rows] = value.astype(np.int64)
        coded.saturated[rows] = lifted
        coded.covered[rows] = covered
        return covered, excess

    def _least_inflation(self, W: Array, margin: Array) -> tuple[Array, NDArray[np.bool_], Array]:
        """Return the least (n,) raw inflations that cover (n, k, k) targets, which are whitened.

        The inflation covers if ``((2^inflation - margin) / (1 + MARGIN)) I - W`` has a Cholesky
        factor. Whatever does not exceed an entry of the diagonal does not cover. The search starts
        there, with steps of 1, 2, 4, ... until one covers, then it halves the last step.

        Returns also which are covered by the largest inflation, and for those that are not, the
        ratio of what they need to it.
        """
        most = float(self.inflation.raw_max)
        bound = W[:, 0, 0]
        for i in range(1, W.shape[-1]):
            bound = np.maximum(bound, W[:, i, i])
        exponent = log2(bound * (1 + MARGIN) + margin)
        steps = np.ceil((exponent - self.inflation.offset) / self.inflation.factor)
        high = self.inflation.limited(steps)
        low = high - 1  # the highest raw value that is known not to cover
        covered = np.zeros(len(W), dtype=bool)
        rows, step = np.arange(len(W)), 1.0
        while rows.size:
            fits = self._covers(high[rows], W[rows], margin[rows])
            covered[rows] = fits
            rows = rows[~fits & (high[rows] < most)]
            low[rows], high[rows] = high[rows], np.minimum(high[rows] + step, most)
            step *= 2
        rows = np.flatnonzero(covered & (high - low > 1))
        while rows.size:
            middle = low[rows] + np.floor((high[rows] - low[rows]) / 2)
            fits = self._covers(middle, W[rows], margin[rows])
            high[rows], low[rows] = (
                np.where(fits, middle, high[rows]),
                np.where(fits, low[rows], middle),
            )
            rows = rows[high[rows] - low[rows] > 1]
        lost = ~covered
        if not lost.any():
            return high, covered, np.zeros(0)
        largest = fixed_order.eigen(W[lost])[0].max(axis=-1)
        needed = np.maximum(largest, 0) * (1 + MARGIN) + margin[lost]
        given = self._variance_factors.of_one(self.inflation.raw_max)
        return high, covered, np.maximum(needed / given, 1.0)

    def _covers(self, raw: Array, W: Array, margin: Array) -> NDArray[np.bool_]:
        """Return which (n,) raw inflations cover (n, k, k) targets, which are whitened."""
        given = self._variance_factors.of(raw.astype(np.int64))
        diagonal = (given - margin) / (1 + MARGIN)
        rest = -W
        for i in range(W.shape[-1]):
            rest[:, i, i] += diagonal
        return fixed_order.is_definite(rest)

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
        for i, (sigmas, pivot) in enumerate(
            zip(self.factor.sigmas, self.factor.pivots, strict=True)
        ):
            target: list[Array] = []
            for j in range(i):
                rest = S[i][j] - sum(target[k] * L[j][k] for k in range(j))
                target.append(rest / L[j][j])
            exact = np.sqrt(np.maximum(S[i][i] - sum(x * x for x in target), floor[i]))
            nearest = pivot.raw(log2(exact))
            chosen = pivot.limited(nearest)
            for trial in range(LIFTS + 1):
                sigma = sigmas.of(chosen.astype(np.int64))
                row, overflow = self._choose_ratios(i, target, sigma, A, raw)
                over = overflow > 1
                if trial == LIFTS or not over.any():
                    break
                lift = np.ceil(log2(overflow) / pivot.factor + SLACK)
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


def _whitened(L: list[list[Array]], M: list[list[Array]]) -> tuple[Array, Array]:
    """Return (N, k, k) matrices L^-1 M L^-T, and (N,) margins for their rounding.

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
        XM = [sum(X[i][k] * M[k][j] for k in range(i + 1)) for j in range(i + 1)]
        for j in range(i + 1):
            W[:, i, j] = W[:, j, i] = sum(XM[k] * X[j][k] for k in range(j + 1))
        amplification += sum(X[i][k] * X[i][k] * M[k][k] for k in range(i + 1))
    return W, MARGIN + AMPLIFIED * amplification
