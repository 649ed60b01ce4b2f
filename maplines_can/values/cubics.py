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
from .fixed_order import total

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
    w = -centre * r
    values = np.empty((4, *np.broadcast_shapes(q0.shape, w.shape)))
    # Horner's scheme, repeated, gives the Taylor coefficients at w.
    q3_w = q3 * w
    value2 = q2 + q3_w
    value1 = q1 + w * value2
    slope2 = value2 + q3_w
    values[0] = q0 + w * value1
    values[1] = (value1 + w * slope2) * r
    r2 = 2 * r * r
    values[2] = (slope2 + q3_w) * r2
    values[3] = q3 * (3 * r2 * r)
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
    of_points = weights.reshape(-1, *(1,) * (w.ndim - 1))
    before, p = np.zeros((1,) * w.ndim), np.ones((len(w), *(1,) * (w.ndim - 1)))
    c_before, c = np.zeros((4, *p.shape[1:])), np.zeros((4, *p.shape[1:]))
    c[0] = 1.0
    norm_before: float | Array = np.inf
    q, rest = 0.0 * c, v
    for degree in range(4):
        weighted = of_points * p
        norm = _sum(weighted * p)
        share = _sum(weighted * rest) / norm
        rest = rest - share * p
        q = q + share * c
        if degree < 3:
            a = _sum(weighted * (w * p)) / norm
            b = norm / norm_before
            before, p = p, (w - a) * p - b * before
            raised = np.concatenate([np.zeros_like(c[:1]), c[:3]])
            c_before, c = c, raised - a * c - b * c_before
            norm_before = norm
    return CubicFit(q, rest)


def _sum(values: Array) -> Array:
    """Return the (...,) sums over the first axis."""
    return total(values.T).T


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


def refitted(
    x: Array,
    y: Array,
    poses: Array,
    weights: Array,
) -> Array:
    """Return the (..., 4) lines of (K, ...) points in the ego frames of (..., 3) other poses.

    A line that is no function of x there is NaN.
    """
    s, t = x - poses[..., 0], y - poses[..., 1]
    d, c = sin_cos(poses[..., 2])
    u, v = c * s + d * t, c * t - d * s
    well_posed = is_function(u, v)
    centre = (u[0] + u[-1]) / 2
    half = np.where(well_posed, np.abs(u[0] - u[-1]) / 2, 1.0)  # not 0; that fit is discarded
    w = (u - centre) / half
    lines = line_of_cubic(cubic_fit(w, v, weights).coefficients, centre, half)
    lines[~well_posed] = np.nan
    return lines


def is_function(u: Array, v: Array) -> NDArray[np.bool_]:
    """Return the (...,) lines that are functions of u by their (K, ...) points.

    None is nearly perpendicular to the u axis, see ``MIN_ADVANCE``.
    """
    advance, aside = np.diff(u, axis=0) * np.sign(u[-1] - u[0]), np.diff(v, axis=0)
    return np.asarray((np.abs(aside) < _STEEPEST * advance).all(axis=0))
