"""Valid range: how far a cubic follows a line of the map."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..polyline import Stretches

#: Points at which a line is fitted. They are denser near the ends of the range, as the extrema of
#: a Chebyshev polynomial, so that the largest deviation of the least-squares fit is near the
#: least possible one.
NODES = np.cos(np.pi * np.arange(64) / 63)[::-1]
#: The same for the search, which fits many ranges.
_COARSE = np.cos(np.pi * np.arange(32) / 31)[::-1]
#: Starts of the ranges that are tried, as shares of the way from the car back to the window's end.
_STARTS = np.array([0.0, 0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0])
#: A metre behind the car counts this share of a metre ahead.
BEHIND = 0.5
#: Ends of the ranges that are tried, as shares of the way from the car to the end of the window.
_ENDS = np.linspace(0, 1, 17)
#: Halvings of the interval that contains the end of the longest range.
_HALVINGS = 4


def _residual_matrix(nodes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix from values at the nodes to the residuals of their cubic fit."""
    Q, _ = np.linalg.qr(np.vander(nodes, 4))
    return np.eye(len(nodes)) - Q @ Q.T


_RESIDUALS = _residual_matrix(NODES)
_COARSE_RESIDUALS = _residual_matrix(_COARSE)
#: The matrix from values at the nodes to the coefficients of their cubic fit, of w^0 first.
_CUBICS = np.linalg.pinv(np.vander(NODES, 4, increasing=True))


def at_nodes(x_range: NDArray[np.float64], nodes: NDArray[np.float64] = NODES) -> NDArray[np.float64]:
    """Return the (..., K) positions of the nodes in (..., 2) ranges."""
    low, high = x_range[..., :1], x_range[..., 1:]
    return (low + high) / 2 + (high - low) / 2 * nodes


def deviations(
    stretches: Stretches, x_range: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the (L,) least and greatest deviations of L lines from their cubic fits [m].

    The cubics are fitted at the nodes of the (L, 2) ranges; the deviations are those at the nodes
    and at all points of the lines within the ranges.
    """
    y = stretches.lateral(at_nodes(x_range))
    residual = y @ _RESIDUALS
    least, greatest = residual.min(axis=1), residual.max(axis=1)
    low, high = x_range[stretches.line].T
    inside = (low < stretches.x) & (stretches.x < high)
    if inside.any():
        line, x = stretches.line[inside], stretches.x[inside]
        w = (x - x_range.mean(axis=1)[line]) / ((high - low)[inside] / 2)
        q0, q1, q2, q3 = (_CUBICS @ y.T)[:, line]
        residual = stretches.y[inside] - (q0 + w * (q1 + w * (q2 + w * q3)))
        np.minimum.at(least, line, residual)
        np.maximum.at(greatest, line, residual)
    return least, greatest


class Fitted(NamedTuple):
    """Ranges in which cubics follow L lines."""

    x_range: NDArray[np.float64]  #: (L, 2) [m]
    shift: NDArray[np.float64]  #: (L,) of the cubic from the least-squares fit [m]
    misfit: NDArray[np.float64]  #: (L,) largest deviation of the shifted cubic [m]


def longest_ranges(stretches: Stretches, max_misfit: float) -> Fitted:
    """Return the longest ranges within the stretches in which the misfit is at most a limit.

    The least-squares fit is shifted to halve the span of its deviations. This matters for points
    that are far apart in a bend: the line between them is all on one side of the bend.
    """
    x_range = stretches.x_range
    least, greatest = deviations(stretches, x_range)
    bad = np.flatnonzero(greatest - least > 2 * max_misfit)
    if len(bad):
        x_range = x_range.copy()
        x_range[bad] = _search(stretches, bad, max_misfit)
        while True:
            least, greatest = deviations(stretches, x_range)
            bad = np.flatnonzero(greatest - least > 2 * max_misfit)
            if not len(bad):
                break
            car = np.clip(0.0, *x_range[bad].T)[:, None]
            x_range[bad] = car + 0.97 * (x_range[bad] - car)
    return Fitted(x_range, (greatest + least) / 2, (greatest - least) / 2)


def _search(
    stretches: Stretches, lines: NDArray[np.intp], max_misfit: float
) -> NDArray[np.float64]:
    """Return the (B, 2) ranges with the longest reach of B lines, about the car's place.

    The misfit does not always grow with the range, so ends are first tried at regular distances.
    The end is then refined by bisection.
    """
    low, high = stretches.x_range[lines].T[:, :, None]  # (B, 1)
    car = np.clip(0.0, low, high)
    begin = car + (low - car) * _STARTS  # (B, S)

    def fits(begin: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.bool_]:
        x = at_nodes(np.stack([begin, end], axis=-1), _COARSE)
        y = stretches.lateral(x.reshape(len(lines), -1), lines).reshape(x.shape)
        return np.asarray(np.ptp(y @ _COARSE_RESIDUALS, axis=-1) <= 2 * max_misfit)

    ends = car + (high - car) * _ENDS  # (B, E)
    good = fits(*np.broadcast_arrays(begin[:, :, None], ends[:, None]))  # (B, S, E)
    farthest = np.where(good, np.arange(len(_ENDS)), 0).max(axis=-1)  # (B, S)
    inner = np.take_along_axis(ends, farthest, axis=1)
    outer = np.take_along_axis(ends, (farthest + 1).clip(max=len(_ENDS) - 1), axis=1)
    for _ in range(_HALVINGS):
        middle = (inner + outer) / 2
        good = fits(begin, middle)
        inner, outer = np.where(good, middle, inner), np.where(good, outer, middle)
    rows = np.arange(len(lines))
    best = np.where(fits(begin, inner), inner - BEHIND * begin, -np.inf).argmax(axis=1)
    return np.column_stack([begin[rows, best], inner[rows, best]])
