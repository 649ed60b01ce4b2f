"""Sensitivity of the KL divergence to the width of each field, without encoding a line.

With ``T = S + F`` the covered target, F the resolution of the mean's grid, and L its Cholesky
factor in some order of the rows, four effects cost divergence. Each is a property of a set of
covariances:

- rounding: a ratio of step D costs D^2 / 24, a pivot of step D octaves (D ln 2)^2 / 12, for any
  covariance;
- inflation, which compensates the rounding: about as much as the rounding and a little more. It
  depends on the steps alone, and is estimated from a sample of roundings;
- ends of a range: a ratio r beyond an end e lifts its pivot by g = |r| / e, which costs
  ln g + (g^-2 - 1) / 2;
- the mean's grid: it blurs covariances that are thinner than it. The blur is
  ln sqrt(det (S + F) / det S), to first order the sum of D_i^2 (S^-1)_ii / 24 over the steps of
  the mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Bits = NDArray[np.signedinteger[Any]]

#: Margin of the inflation of the core: ``INFLATION_MARGIN``.
MARGIN = 1e-6
#: Cost of rounding with its inflation over that of rounding alone, in the limit of small steps.
PIVOT_WEIGHT, RATIO_WEIGHT = 2.0, 2.6
#: Least and most bits of pivots and ratios that are tried.
MIN_BITS, MAX_BITS = 3, 20
#: Steps of ratios are these times a power of two: exact in decimals and in binary.
STEPS = np.outer(2.0 ** np.arange(-24, 4), (1.0, 1.25, 1.5, 1.75)).ravel()
#: Places of zero in a ratio's range: eighths of it.
ZEROS = np.arange(1, 8) / 8
#: Least distance of both ends of a ratio's range from zero.
MIN_END = 1.0
#: Largest ratios of unseen lines over the outermost ones of the set.
UNSEEN = 2.0
#: Number of sampled roundings.
DRAWS = 1000
#: Share of roundings whose inflation the field holds. The encoder repeats the others with a target
#: that is 2 % larger. This costs little unless all inflations are below 2 %.
INFLATION_HELD = 0.998
RETRY = float(np.log2(1.02))
#: Estimate of the greatest possible inflation over the greatest sampled one.
SELDOM_MORE = 1.1


@dataclass(frozen=True)
class Width:
    """Width, step and range of a field."""

    bits: int
    factor: float  #: step
    offset: float  #: physical value of raw 0
    #: Expected divergence of the rounding with its share of the inflation, plus that of the ends
    #: with the price of lines beyond them [nat].
    loss: float = 0.0
    beyond: float = 0.0  #: share of the lines beyond an end
    beyond_loss: float = 0.0  #: their expected divergence [nat]
    unseen_loss: float = 0.0  #: the part of it for unseen lines [nat]

    @property
    def end(self) -> float:
        """Greatest physical value; the least is the offset."""
        return self.offset + (2**self.bits - 1) * self.factor

    @property
    def zero(self) -> float:
        """Place of 0 in the range, from 0 at its low end to 1 at its high one."""
        return -self.offset / (2**self.bits * self.factor)


def rows_of(T: Array, floor: Array, order: tuple[int, ...]) -> tuple[Array, Array]:
    """Return Cholesky factors in the form of the message.

    Args:
        T: (N, 4, 4) positive semidefinite.
        floor: (4,) least squared pivots.
        order: of the rows.

    Returns:
        (N, 4) log2 of the pivots, (N, 4, 4) rows over their pivots, both in the order of the rows.
    """
    L = np.zeros_like(T)
    for i, row in enumerate(order):
        for j, column in enumerate(order[:i]):
            rest = T[:, row, column] - np.einsum("nk,nk->n", L[:, i, :j], L[:, j, :j])
            L[:, i, j] = rest / L[:, j, j]
        pivot = T[:, row, row] - np.einsum("nk,nk->n", L[:, i, :i], L[:, i, :i])
        L[:, i, i] = np.sqrt(np.maximum(pivot, floor[row]))
    pivots = np.einsum("nii->ni", L)
    return np.log2(pivots), L / pivots[:, :, None]


def pivot_widths(low: float, high: float) -> list[Width]:
    """Return the widths of a pivot from ``low`` to ``high`` octaves, from MIN_BITS to MAX_BITS."""
    widths = []
    for bits in range(MIN_BITS, MAX_BITS + 1):
        factor = _rounded_up((high - low) / (2**bits - 1))
        loss = PIVOT_WEIGHT * (factor * np.log(2)) ** 2 / 12
        widths.append(Width(bits, factor, low, loss))
    return widths


class RatioSpread:
    """The values of one ratio over a set, and the loss of a range on them.

    Unseen lines are assumed to reach further than those of the set: beyond the outermost line on
    either side, with the weight of that line.

    Args:
        values: (N,) of the ratio.
        weights: (N,) with the sum 1.
    """

    def __init__(self, values: Array, weights: Array) -> None:
        outer = np.array([values.argmax(), values.argmin()])
        further, rare = UNSEEN * values[outer], weights[outer]
        self._grids: list[tuple[Array, Array]] | None = None
        self._unseen = _tails(further, rare)
        self._all = _tails(np.concatenate([values, further]), np.concatenate([weights, rare]))

    def width(self, bits: int, factor: float, zero: float, price: float) -> Width:
        """Return the width with a step and a range.

        Args:
            bits: of the field.
            factor: step.
            zero: place of 0 in the range, from 0 to 1.
            price: added to the loss for a share of 1 beyond the ends [nat].
        """
        return self._widths(np.array([bits]), np.array([factor]), np.array([zero]), price)[0]

    def widths(self, price: float) -> list[Width]:
        """Return the widths with step and range of least loss, from MIN_BITS to MAX_BITS."""
        factor = STEPS[:, None]
        if self._grids is None:
            self._grids = [
                self._losses(factor, *_ends(bits, factor, ZEROS), 0.0)[:2]
                for bits in range(MIN_BITS, MAX_BITS + 1)
            ]
        charged = np.array([loss + price * beyond for loss, beyond in self._grids])
        best = charged.reshape(len(charged), -1).argmin(axis=1)
        i, j = np.unravel_index(best, charged.shape[1:])
        return self._widths(np.arange(MIN_BITS, MAX_BITS + 1), STEPS[i], ZEROS[j], price)

    def _widths(self, bits: Bits, factor: Array, zero: Array, price: float) -> list[Width]:
        """Return a width for each of the values."""
        ends = _ends(bits, factor, zero)
        offset, unseen = -factor * 2**bits * zero, _beyond(self._unseen, *ends)[0]
        columns = (bits, factor, offset, *self._losses(factor, *ends, price), unseen)
        return [Width(*row) for row in zip(*(c.tolist() for c in columns), strict=True)]

    def _losses(
        self, factor: Array, low: Array, high: Array, price: float
    ) -> tuple[Array, Array, Array]:
        """Return loss, beyond and beyond_loss; the loss of a too narrow range is infinite."""
        beyond_loss, beyond = _beyond(self._all, low, high)
        loss = RATIO_WEIGHT * factor**2 / 24 + beyond_loss + price * beyond
        return np.where(np.minimum(low, high) < MIN_END, np.inf, loss), beyond, beyond_loss


def _ends(bits: int | Bits, factor: Array, zero: Array) -> tuple[Array, Array]:
    """Return the distances from 0 to the ends of the values that are rounded into a range."""
    return factor * (2**bits * zero + 0.5), factor * (2**bits * (1 - zero) - 0.5)


def _tails(values: Array, weights: Array) -> list[tuple[Array, Array]]:
    """Return magnitudes and sums of weight, log and inverse square, below and above zero."""
    sides = []
    for v in (-values, values):
        order = np.argsort(-v)
        order = order[v[order] > 0]
        v, w = v[order], weights[order]
        sums = np.cumsum([w, w * np.log(v), w / v**2], axis=1)
        sides.append((v[::-1], np.concatenate([np.zeros((3, 1)), sums], axis=1)))
    return sides


def _beyond(tails: list[tuple[Array, Array]], low: Array, high: Array) -> tuple[Array, Array]:
    """Return the expected loss and the share of the values beyond the ends of a range."""
    loss, beyond = np.zeros(()), np.zeros(())
    for end, (ascending, sums) in zip((low, high), tails, strict=True):
        count = len(ascending) - np.searchsorted(ascending, end, side="right")
        share, logs, squares = sums[:, count]
        loss = loss + logs - share * np.log(end) + (end**2 * squares - share) / 2
        beyond = beyond + share
    return loss, beyond


def conservative(pivots: Array, ratios: Array, inflation: Width) -> Array:
    """Return (DRAWS,) divergences of roundings with their inflation, for any covariance [nat].

    Args:
        pivots: (4,) steps [octave].
        ratios: (6,) steps.
        inflation: its field.
    """
    trace, log_det, needed = _roundings(tuple(pivots), tuple(ratios))
    steps = np.ceil(np.maximum(needed, 0) / inflation.factor)
    log_factor = steps * inflation.factor * np.log(2)
    return (trace * np.exp(-log_factor) - 4 + 4 * log_factor - log_det) / 2


def inflation_width(bits: int, pivots: Array, ratios: Array) -> Width:
    """Return the field for the inflation that the steps need."""
    needed = _roundings(tuple(pivots), tuple(ratios))[2]
    most = float(needed.max()) * SELDOM_MORE
    if most > RETRY:
        most = float(np.quantile(needed, INFLATION_HELD))
    return Width(bits, _rounded_up(most / (2**bits - 1)), 0.0)


@lru_cache(maxsize=1024)  # a search comes back to the same steps: 25 MB
def _roundings(pivots: tuple[float, ...], ratios: tuple[float, ...]) -> tuple[Array, Array, Array]:
    """Return traces and log determinants of ``L'^-1 T L'^-T``, and their inflation [octave].

    They are (DRAWS,), one for each rounding.
    """
    u = np.random.default_rng(0).uniform(-0.5, 0.5, size=(DRAWS, 10))
    A = np.zeros((DRAWS, 4, 4))
    A[:, range(4), range(4)] = np.exp2(u[:, :4] * np.array(pivots))
    A[:, *np.tril_indices(4, -1)] = u[:, 4:] * np.array(ratios)
    W = A @ np.swapaxes(A, 1, 2)
    log_det = 2 * np.log(np.einsum("nii->ni", A)).sum(axis=1)
    needed = np.log2(np.linalg.eigvalsh(W)[:, -1] * (1 + MARGIN) + MARGIN)
    return np.einsum("nii->n", W), log_det, needed


def blurs(S: Array, F: Array) -> Array:
    """Return the (N,) blur by the mean's grid: ln sqrt(det (S + F) / det S) [nat].

    Args:
        S: (N, 4, 4) covariances.
        F: (4,) variances of the grid's rounding.
    """
    variances = np.einsum("nii->ni", S) + F
    scale = np.sqrt(variances)
    # A matrix that is singular in double precision is as thin as that precision shows.
    correlation = S / scale[:, :, None] / scale[:, None, :] + 1e-15 * np.eye(4)
    grid = np.einsum("ni,ij->nij", F / variances, np.eye(4))
    blurred, sharp = np.linalg.slogdet(correlation + grid)[1], np.linalg.slogdet(correlation)[1]
    return np.asarray((blurred - sharp) / 2, dtype=float)


def _rounded_up(value: float, digits: int = 3) -> float:
    """Return the next greater decimal number with a number of digits, to be readable in a DBC.

    >>> _rounded_up(0.033444), _rounded_up(0.05), _rounded_up(1.211)
    (0.0335, 0.05, 1.22)
    """
    exponent = int(np.floor(np.log10(value))) - digits + 1
    steps = np.ceil(value / 10.0**exponent * (1 - 1e-12))
    return float(f"{steps * 10.0**exponent:.{digits}g}")
