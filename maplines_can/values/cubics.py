"""Cubics as lines: from their coefficients, through points by least squares, from another pose.

A decoder computes what scenes have in common with these functions, so their operations have a fixed
order: that of ``c/src/seen_lines.c``. Points are on the first axis, so that those of many lines are
computed at once.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .elementary import atan, sin_cos, tan
from .fixed_order import row_total

Array = NDArray[np.float64]

#: Smallest advance along the car's x axis, as a share of the length of the line. A straight line
#: satisfies this if its angle to the x axis is less than 80 deg.
MIN_ADVANCE = 0.17
#: The slope of such a line.
_STEEPEST = math.sqrt(1 / (MIN_ADVANCE * MIN_ADVANCE) - 1)


def line_of_cubic(q: Array, centre: Array, half: Array) -> Array:
    """Return the (..., 4) lines of cubics in the normalised variable ``w = (u - centre) / half``.

    Of the coefficients q, (4, ...) of w^0 .. w^3 [m], they are the value and derivatives at u = 0,
    the first derivative as an angle.
    """
    lines = derivatives(q, centre, half)
    lines[..., 1] = atan(lines[..., 1])
    return lines


def derivatives(q: Array, centre: Array, half: Array) -> Array:
    """Return what ``line_of_cubic`` does, with the slope in place of its angle."""
    q0, q1, q2, q3 = q
    r = 1 / half
    r2 = 2 * r * r
    w = -centre * r
    # Horner's scheme, repeated, gives the Taylor coefficients at w.
    q3_w = q3 * w
    value2 = q2 + q3_w
    value1 = q1 + w * value2
    slope2 = value2 + q3_w
    values = np.array(
        [
            q0 + w * value1,
            (value1 + w * slope2) * r,
            (slope2 + q3_w) * r2,
            q3 * (3 * r2 * r),
        ]
    )
    return values.transpose(*range(1, values.ndim), 0)


class CubicFit(NamedTuple):
    """Cubics that are fitted to points."""

    coefficients: Array  #: (4, ...) of w^0 .. w^3
    rest: Array  #: (K, ...) what the cubics leave of the values


def cubic_fit(w: Array, v: Array, weights: Array) -> CubicFit:
    """Fit cubics to K points each.

    By polynomials that are orthogonal on the points, each of which follows from the two before
    (Forsythe, Journal of the SIAM 5, 1957): there is no matrix, and nothing to pivot.

    Args:
        w: (K, ...) places of the points, from -1 to 1.
        v: (K, ...) values there.
        weights: (K,) positive weights of the squares of what is left.

    >>> w = np.linspace(-1, 1, 5)
    >>> cubic_fit(w, 1 + w**3, np.ones(5)).coefficients.round(12) + 0.0
    array([1., 0., 0., 1.])
    """
    of_points = np.empty_like(w)
    of_points[...] = weights.reshape(-1, *(1,) * (w.ndim - 1))
    # The polynomials p0 .. p3, of which p0 is 1, and with n their squared norms.
    n0, on_v, on_w = _sums(of_points, of_points * v, of_points * w)
    share0, a0 = on_v / n0, on_w / n0
    rest, p1 = v - share0, w - a0
    weighted = of_points * p1
    n1, on_v, on_w = _sums(weighted * p1, weighted * rest, weighted * (w * p1))
    share1, a1, b1 = on_v / n1, on_w / n1, n1 / n0
    rest, p2 = rest - share1 * p1, (w - a1) * p1 - b1
    weighted = of_points * p2
    n2, on_v, on_w = _sums(weighted * p2, weighted * rest, weighted * (w * p2))
    share2, a2, b2 = on_v / n2, on_w / n2, n2 / n1
    rest, p3 = rest - share2 * p2, (w - a2) * p2 - b2 * p1
    weighted = of_points * p3
    n3, on_v = _sums(weighted * p3, weighted * rest)
    share3 = on_v / n3
    # Their coefficients, but for 1 of the highest power.
    p1_0 = 0.0 - a0
    p2_0, p2_1 = 0.0 - a1 * p1_0 - b1, p1_0 - a1
    p3_0, p3_1, p3_2 = 0.0 - a2 * p2_0 - b2 * p1_0, p2_0 - a2 * p2_1 - b2, p2_1 - a2
    q = (
        share0 + share1 * p1_0 + share2 * p2_0 + share3 * p3_0,
        share1 + share2 * p2_1 + share3 * p3_1,
        share2 + share3 * p3_2,
        share3,
    )
    return CubicFit(np.array(q) + 0.0, rest - share3 * p3)  # without -0.0


def _sums(*terms: Array) -> Array:
    """Return the (N, ...) sums of N arrays (K, ...) over their first axis, all at once."""
    shape = terms[0].shape
    rows = np.concatenate([values.reshape(shape[0], -1) for values in terms], axis=1)
    return row_total(rows).reshape(len(terms), *shape[1:])


class FitPoints(NamedTuple):
    """Places on a line to which a cubic is fitted, in the normalised variable -1 to 1."""

    nodes: Array  #: (K,)
    weights: Array  #: (K,)
    quartic: Array  #: (K,) what a fitted cubic leaves of T_4


@lru_cache(maxsize=16)
def fit_points(points: int, end_weight: float) -> FitPoints:
    """Return the extrema of a Chebyshev polynomial; the weights are 1, but for those of both ends.

    4 points are the roots of one: a cubic interpolates them.
    """
    k = np.arange(points)
    _, nodes = sin_cos(np.pi * (k + 0.5) / 4 if points == 4 else np.pi * k / (points - 1))
    weights = np.ones(points)
    weights[[0, -1]] = end_weight
    square = nodes * nodes
    T_4 = 8 * (square * square) - 8 * square + 1
    fit = FitPoints(nodes, weights, cubic_fit(nodes, T_4, weights).rest)
    for values in fit:
        values.flags.writeable = False  # all callers share them
    return fit


def points_of(
    lines: Array,
    window: tuple[Array, Array],
    quartic: Array,
    fit: FitPoints,
    axes: int,
) -> tuple[Array, Array]:
    """Return x and y of points of lines with quartics, (K, ...) with this number of further axes.

    y is NaN for a line that points backwards: l(x) contains tan(beta), which is the same for it.
    """
    x_min, x_max = window
    nodes, bend = (values.reshape(-1, *(1,) * axes) for values in (fit.nodes, fit.quartic))
    y_off, beta, c0, c1 = (lines[..., i] for i in range(4))
    x = (x_min + x_max) / 2 + (x_max - x_min) / 2 * nodes
    slope = np.where(np.abs(beta) < np.pi / 2, tan(beta), np.nan)
    return x, y_off + x * (slope + x * (c0 / 2 + x * c1 / 6)) + quartic * bend


class Poses(NamedTuple):
    """Poses in the frame of lines, with what each line needs of them."""

    x: Array  #: (...,) [m]
    y: Array  #: (...,) [m]
    sine: Array  #: (...,) of the heading
    cosine: Array  #: (...,) of the heading

    @classmethod
    def of(cls, poses: Array) -> Poses:
        """Return (..., 3) poses."""
        return cls(poses[..., 0], poses[..., 1], *sin_cos(poses[..., 2]))


def refitted(x: Array, y: Array, poses: Poses, weights: Array) -> Array:
    """Return the (..., 4) lines of (K, ...) points in the ego frames of (...,) other poses.

    A line that is no function of x there is NaN.
    """
    s, t = x - poses.x, y - poses.y
    d, c = poses.sine, poses.cosine
    u, v = c * s + d * t, c * t - d * s
    well_posed = is_function(u, v)
    centre, half = (u[0] + u[-1]) / 2, np.abs(u[0] - u[-1]) / 2
    is_lost = None if well_posed.all() else ~well_posed
    if is_lost is not None:
        half = np.where(is_lost, 1.0, half)  # not 0; that fit is discarded
    w = (u - centre) / half
    lines = line_of_cubic(cubic_fit(w, v, weights).coefficients, centre, half)
    if is_lost is not None:
        lines[is_lost] = np.nan
    return lines


def is_function(u: Array, v: Array) -> NDArray[np.bool_]:
    """Return the (...,) lines that are functions of u by their (K, ...) points.

    None is nearly perpendicular to the u axis, see ``MIN_ADVANCE``.
    """
    advance, aside = (u[1:] - u[:-1]) * np.sign(u[-1] - u[0]), v[1:] - v[:-1]
    return np.asarray((np.abs(aside) < _STEEPEST * advance).all(axis=0))
