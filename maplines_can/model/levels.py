"""Levels of the line-specific covariance: a covariance in a few bits.

In the coefficients of T_0 .. T_3 it is one of

    a^2 u u^T + b^2 diag(0, 1/4, 1, 2)                              OwnPoints is 0
    a^2 u u^T + p^2 (N(d, phase) + r^2 d diag(0, 1/4, 1, 2))        otherwise

with a, p, d and b of ``OwnLateral``, ``OwnPoints``, ``OwnShape`` and ``OwnShape``, u = (1, t, 0, 0)
with the tilt t of ``OwnTilt``, or 0, and N the covariance of a cubic through points with
independent errors of 1 m.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping
from typing import NamedTuple, cast

import numpy as np

from ..wire.layout.record_signals import OCTAVE, Signal
from .elementary import exp2, tan
from .lines import Curve, extrema
from .matrices import Matrix, Vector, diagonal, dot_by_halves, matrix
from .signals import Raw, level, value

#: Shape of a line that is uncertain, in coefficients of T_0 .. T_3.
SHAPE = diagonal([0.0, 0.25, 1.0, 2.0])
#: t by the raw value of ``OwnTilt``; what is beyond the last one is the last one.
TILTS = (0.0, 1.0, -1.0, 6.0)
#: log2 of the level b [m] for the raw value 0, and by how much that of the greatest exceeds it.
SHAPE_OFFSET, SHAPE_OCTAVES = -10.0, 10.2
#: r by the remainder of the raw value of ``OwnShape`` modulo 6.
RATIOS = (0.0, 0.5, 0.5 * 1.8, 0.5 * 1.8 * 1.8, 0.5 * 1.8 * 1.8 * 1.8, 0.5 * 1.8 * 1.8 * 1.8 * 1.8)
GOLDEN_RATIO = (1 + math.sqrt(5)) / 2
#: Share of the variances by which sums in single precision are enlarged.
SUM_ROUNDING = 2.0**-14
#: Rounds to single precision; so does each operation with such numbers.
SINGLE = cast("Callable[[float], float]", np.float32)
ONE = SINGLE(1)
#: Places at which a cubic is fitted to the points, from -1 to 1.
NODES = Vector(extrema(64)[::-1])
#: Values of T_0 .. T_3 at the nodes, and the (4, 64) matrix of the fit from values there.
_T = matrix([[1.0] * len(NODES), NODES, [2 * w * w - 1 for w in NODES]])
_T.append(2.0 * NODES * _T[2] - NODES)
FIT = matrix([dot_by_halves(a, b) for b in _T] for a in _T).inverse() @ _T
for _k, _row in enumerate(FIT):  # the second half is the first one, the odd ones negative
    _row[32:] = [-x if _k % 2 else x for x in _row[31::-1]]


def level_covariance(signals: Mapping[str, Signal], raw: Raw, curve: Curve) -> Matrix:
    """Return the covariance of the coefficients of T_0 .. T_3."""
    if raw["OwnPoints"] == 0:
        b = shape_level(signals["OwnShape"], raw["OwnShape"])
        cov = b * b * SHAPE
    else:
        p = level(signals["OwnPoints"], raw["OwnPoints"])
        cov = p * p * noise(signals["OwnShape"], raw["OwnShape"], curve)
    a = level(signals["OwnLateral"], raw["OwnLateral"])
    add_lateral(cov, a * a, TILTS[min(raw.get("OwnTilt", 0), len(TILTS) - 1)])
    return cov


def add_lateral(cov: Matrix, square: float, tilt: float) -> None:
    """Add a lateral level with a tilt: its square times u u^T."""
    mixed = square * tilt
    cov[0][0] += square
    cov[0][1] += mixed
    cov[1][0] += mixed
    cov[1][1] += mixed * tilt


def shape_level(signal: Signal, raw: int) -> float:
    """Return the level b of an uncertain shape alone [m]."""
    step = SHAPE_OCTAVES / max(1, signal.raw_max)
    return exp2(SHAPE_OFFSET + step * raw) if raw else 0.0


class Spacing(NamedTuple):
    """Spacing of the points of a line: what a raw value of ``OwnShape`` stands for."""

    distance: float  #: d, in halves of the length of the line
    phase: float  #: by how much the first point is ahead of the start of the range, in distances
    uncertainty: float  #: r^2 d, of the shape


def spacing_of(signal: Signal, raw: int) -> Spacing:
    """Return the spacing of a raw value of ``OwnShape``."""
    d = value(signal, raw)
    d = exp2(d) if signal.unit == OCTAVE else d
    turns, ratio = raw * GOLDEN_RATIO, RATIOS[raw % len(RATIOS)]
    return Spacing(d, turns - math.floor(turns), ratio * ratio * d)


def noise(signal: Signal, raw: int, curve: Curve) -> Matrix:
    """Return N(d, phase) + r^2 d diag(0, 1/4, 1, 2)."""
    spacing = spacing_of(signal, raw)
    return point_noise(curve, spacing) + spacing.uncertainty * SHAPE


def arc_of(curve: Curve) -> tuple[Vector, Vector]:
    """Return the length of a line at the nodes of its range, by trapezoids, in single precision.

    Its derivatives with respect to x; and the length up to each node, in halves of all of it.
    """
    _, beta, c0, c1 = curve.mean
    given = (curve.begin + curve.end) / 2, (curve.end - curve.begin) / 2, tan(beta), c0, c1 / 2
    centre, half, tangent, c0_, half_c1 = map(SINGLE, given)
    x = [centre + half * SINGLE(node) for node in NODES]
    slopes = [tangent + u * (c0_ + u * half_c1) for u in x]
    stretch = Vector(map(np.sqrt, (ONE + slope * slope for slope in slopes)))
    along = Vector([SINGLE(0)])
    for k in range(1, len(x)):
        along.append(along[-1] + (x[k] - x[k - 1]) * (stretch[k] + stretch[k - 1]))
    return stretch, along * (SINGLE(2) / along[-1])


def point_noise(curve: Curve, spacing: Spacing) -> Matrix:
    """Return the covariance of the coefficients for points with independent errors of 1 m.

    The points are at equal distances along the line. Between two of them, the line has shares of
    both of their errors; one across the line acts on y by the factor ``stretch``. It is computed in
    single precision; the variances are enlarged by more than the rounding of the sums.
    """
    none = Vector([SINGLE(0)] * 4)
    behind: dict[int, Vector] = defaultdict(lambda: none)  # weights of each error
    ahead: dict[int, Vector] = defaultdict(lambda: none)
    density = ONE / SINGLE(spacing.distance)
    phase = SINGLE(spacing.phase)
    columns = (Vector(map(SINGLE, column)) for column in FIT.T)
    for stretch, along, column in zip(*arc_of(curve), columns, strict=True):
        place = along * density + phase
        point = int(place)
        of_next = stretch * (place - SINGLE(point))
        behind[point] += column * (stretch - of_next)
        ahead[point + 1] += column * of_next
    effects = Matrix(behind[point] + ahead[point] for point in range(max(ahead) + 1)).T
    found = matrix(map(float, row) for row in effects @ effects.T)
    for i, row in enumerate(found):
        row[i] *= 1 + SUM_ROUNDING
    return found
