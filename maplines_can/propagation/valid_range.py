"""Valid range: how far a cubic follows a line of the map."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..values.seen_lines import NODES
from .stretches import Stretches

#: As ``NODES``, for the search, which fits many ranges.
_COARSE = np.cos(np.pi * np.arange(32) / 31)[::-1]
#: Starts of the ranges that are tried, as shares of the way from the car back to the window's end.
_STARTS = np.array([0.0, 0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0])
#: A metre behind the car counts this share of a metre ahead.
BEHIND = 0.5
#: Ends that are tried in each round of the search, as shares of the interval that contains the
#: end of the longest range, and the number of rounds.
_ENDS = np.array([0.25, 0.5, 0.75, 1.0])
_ROUNDS = 4


def _fit_matrix(nodes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (K, K + 4) matrix from values at the nodes to the residuals of their cubic fit,
    and to its coefficients, of w^0 first.
    """
    powers = np.vander(nodes, 4, increasing=True)
    coefficients = np.linalg.pinv(powers)
    return np.hstack([(np.eye(len(nodes)) - powers @ coefficients).T, coefficients.T])


_FIT = _fit_matrix(NODES)
_COARSE_RESIDUALS = np.ascontiguousarray(_fit_matrix(_COARSE)[:, :-4].T)


def at_nodes(
    x_range: NDArray[np.float64], nodes: NDArray[np.float64] = NODES
) -> NDArray[np.float64]:
    """Return the (..., K) positions of the nodes in (..., 2) ranges."""
    low, high = x_range[..., :1], x_range[..., 1:]
    return (low + high) / 2 + (high - low) / 2 * nodes


class Fitted(NamedTuple):
    """Least-squares fits of cubics to L lines in ranges of them."""

    x_range: NDArray[np.float64]  #: (L, 2) [m]
    x: NDArray[np.float64]  #: (L, K) positions of the nodes [m]
    y: NDArray[np.float64]  #: (L, K) lateral positions of the lines at the nodes [m]
    least: NDArray[np.float64]  #: (L,) least deviation of a line from its cubic [m]
    greatest: NDArray[np.float64]  #: (L,) greatest deviation of a line from its cubic [m]

    @property
    def shift(self) -> NDArray[np.float64]:
        """(L,) shift of the cubics that makes their largest deviations least [m]."""
        return (self.greatest + self.least) / 2

    @property
    def misfit(self) -> NDArray[np.float64]:
        """(L,) largest deviation of the shifted cubics [m]."""
        return (self.greatest - self.least) / 2


def fit(stretches: Stretches, x_range: NDArray[np.float64]) -> Fitted:
    """Return the fits in the (L, 2) ranges of all stretches.

    The deviations are those at the nodes and at all points of the lines within the ranges.
    """
    x = at_nodes(x_range)
    y = stretches.lateral(x)
    fits = y @ _FIT
    at_node, q = fits[:, : len(NODES)], fits[:, len(NODES) :]
    low, high = x_range.T
    of_line = np.vstack([q.T, (low + high) / 2, (high - low) / 2])
    q0, q1, q2, q3, centre, half = of_line[:, stretches.line]
    w = (stretches.x - centre) / half
    at_point = stretches.y - (q0 + w * (q1 + w * (q2 + w * q3)))
    at_point[np.abs(w) >= 1] = 0.0  # between the extremes, as the residuals have the mean 0
    least = np.minimum(at_node.min(axis=1), np.minimum.reduceat(at_point, stretches.first))
    greatest = np.maximum(at_node.max(axis=1), np.maximum.reduceat(at_point, stretches.first))
    return Fitted(x_range, x, y, least, greatest)


def longest_ranges(
    stretches: Stretches, max_misfit: float, room: float = 0.0, step: float = 0.0
) -> Fitted:
    """Return the fits in the longest ranges of the stretches with a misfit of at most a limit.

    The ranges begin at least ``room`` [m] behind the car, if the line does. With a ``step``, their
    ends are multiples of it, but for ranges that are too short for that [m].

    The least-squares fit is shifted to halve the span of its deviations. This matters for points
    that are far apart in a bend: the line between them is all on one side of the bend.
    """
    fits = fit(stretches, _whole(stretches.x_range, step))
    bad = np.flatnonzero(fits.misfit > max_misfit)
    if len(bad):
        x_range = _whole(stretches.x_range, step)
        x_range[bad] = _whole(_search(stretches, bad, max_misfit, room), step)
        while len(bad := np.flatnonzero((fits := fit(stretches, x_range)).misfit > max_misfit)):
            car = np.clip(0.0, *x_range[bad].T)[:, None]
            x_range[bad] = _whole(car + 0.97 * (x_range[bad] - car), step)
    return fits


def _whole(x_range: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Return (L, 2) ranges with their ends moved inwards to multiples of a step, if it is not 0."""
    if not step:
        return x_range.copy()
    inner = np.column_stack([np.ceil(x_range[:, 0] / step), np.floor(x_range[:, 1] / step)]) * step
    return np.where(inner[:, :1] + step <= inner[:, 1:], inner, x_range)


def _search(
    stretches: Stretches, lines: NDArray[np.intp], max_misfit: float, room: float
) -> NDArray[np.float64]:
    """Return the (B, 2) ranges with the longest reach of B lines, about ``room`` behind the car.

    Each start that is tried is a candidate. The interval that contains the end of its longest
    range is narrowed in rounds. Candidates that cannot become the best of their line are dropped.
    """
    low, high = stretches.x_range[lines].T[:, :, None]  # (B, 1)
    car = np.clip(-room, low, high)
    begin = (car + (low - car) * _STARTS).ravel()
    which = np.arange(len(lines)).repeat(len(_STARTS))
    inner, outer = car[which, 0], high[which, 0]
    found = begin == inner
    for _ in range(_ROUNDS):
        ends = inner[:, None] + (outer - inner)[:, None] * _ENDS  # (C, E)
        x_range = np.stack(np.broadcast_arrays(begin[:, None], ends), axis=-1)
        x = at_nodes(x_range.reshape(-1, 2), _COARSE)
        y = stretches.lateral(x, lines[which].repeat(len(_ENDS)))
        residual = _COARSE_RESIDUALS @ y.T  # (K, C E)
        span = residual.max(axis=0) - residual.min(axis=0)
        good = (span <= 2 * max_misfit).reshape(ends.shape)
        some = good.any(axis=1)
        rows, last = np.arange(len(ends)), len(_ENDS) - 1
        farthest = last - good[:, ::-1].argmax(axis=1)
        outer = np.where(some, ends[rows, (farthest + 1).clip(max=last)], ends[:, 0])
        inner = np.where(some, ends[rows, farthest], inner)
        found |= some
        reach = np.where(found, inner - BEHIND * begin, -np.inf)
        best = np.full(len(lines), -np.inf)
        np.maximum.at(best, which, reach)
        kept = outer - BEHIND * begin >= best[which]
        begin, inner, outer, found, which, reach = (
            values[kept] for values in (begin, inner, outer, found, which, reach)
        )
    order = np.lexsort([reach, which])
    chosen = order[np.searchsorted(which[order], np.arange(len(lines)), side="right") - 1]
    return np.column_stack([begin, inner])[chosen]
