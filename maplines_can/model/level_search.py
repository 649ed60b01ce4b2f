"""Choice of levels: of those that cover a line, the ones that tell the least wrong of it.

The cost of levels is the divergence of what they decode to from the true covariance, plus the
logarithm of the largest ratio of variances, of the lateral position or the direction of the line.
With a tilt, covariances are sheared, so that the lateral level is one of T_0 alone.
"""

from __future__ import annotations

import math
import struct
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from functools import cached_property, reduce
from operator import add
from typing import NamedTuple

from ..wire.layout.record_signals import OWN_SIGNALS, TILT, Signal
from .elementary import log2
from .joint import LN_2, compared, largest_ratio
from .levels import (
    RATIOS,
    SHAPE,
    TILTS,
    add_lateral,
    arc_of,
    noise,
    point_noise,
    shape_level,
    spacing_of,
)
from .lines import Curve
from .matrices import Matrix, Vector, diagonal, matrix
from .signals import level

#: Raw values above the least one of the level of the points, or of the shape, that are tried.
TRIED = (0, 1, 2, 3, 5)
#: Spacings for which the second of them is tried, at most, and those of the best of these for which
#: all are.
SPACINGS, CHOSEN = 256, 16
#: Each so many of them is tried with all tilts, before the best are chosen; its neighbours are like
#: it.
TILTED = 11
#: More than any level squared [m^2].
BEYOND = 1e100
#: Added to the variances that errors of points cause: those of points far apart may be singular.
SINGULAR = diagonal([1e-6] * 4)
#: Entries without those of T_0, of the lower triangle, column by column; and those of T_0.
LOWER = ((1, 1), (2, 1), (3, 1), (2, 2), (3, 2), (3, 3), (1, 0), (2, 0), (3, 0))


class Wanted(NamedTuple):
    """What levels have to cover, of the coefficients of T_0 .. T_3."""

    target: Matrix  #: E: less what is common to all lines
    common: Matrix  #: C
    true: Matrix  #: T: to which the sum is to be close


class LevelSearch:
    """Search for the levels of a line."""

    def __init__(self, signals: Mapping[str, Signal]) -> None:
        self.lateral, self.points, self.shape = (signals[name] for name in OWN_SIGNALS)
        self.tilts = TILTS[: signals[TILT].raw_max + 1] if TILT in signals else TILTS[:1]

    @cached_property
    def squares(self) -> list[list[float]]:
        """Squares of the levels a, p and b of all raw values."""
        of_signals = (level, self.lateral), (level, self.points), (shape_level, self.shape)
        return [
            [of(signal, raw) * of(signal, raw) for raw in range(signal.raw_max + 1)]
            for of, signal in of_signals
        ]

    @cached_property
    def straight(self) -> dict[int, tuple[Matrix, float]]:
        """N of a straight line, and r^2 d, of all raw values of the shape that are tried.

        These are all, or at equal distances. N has single precision, as in the tables of the core.
        """
        shape, line = self.shape, Curve(Vector([0.0] * 4), 0.0, 1.0)
        step = -(-(shape.raw_max + 1 - shape.raw_min) // SPACINGS)
        while math.gcd(step, len(RATIOS)) != 1:
            step += 1
        found = {}
        for raw in range(shape.raw_min, shape.raw_max + 1, step):
            spacing = spacing_of(shape, raw)
            N = matrix(map(_single, row) for row in point_noise(line, spacing))
            found[raw] = N, _single(spacing.uncertainty)
        return found

    def spacings(self, wanted: Wanted, curve: Curve) -> list[int]:
        """Return the raw values of the shape that suit the errors of points best.

        Of all that are tried, they have the least cost without T_0, with one level of the points
        and their best tilt. Straight lines that are stretched as the line is on average choose the
        same ones, or nearly so.
        """
        stretch, squared = [*map(float, arc_of(curve)[0])], self.squares[1]
        mean = min(stretch) * max(stretch)
        of_tilts = [Wanted(*(sheared(S, tilt) for S in wanted)) for tilt in self.tilts]
        costs: dict[int, float] = {}
        for n, (k, (N, amount)) in enumerate(self.straight.items()):
            S = N * mean + amount * SHAPE
            bounds, of_levels = [], []
            for tilt, of in zip(self.tilts, of_tilts, strict=True):
                if tilt and n % TILTED:
                    continue
                R = sheared(S, tilt)
                least = least_by_variances(squared, R, of.target)
                bounds.append(least_cost(_at(squared, least + TRIED[1]) * R, of))
                raw = least_raw(squared, R, of.target, least) + TRIED[1]
                cost = direction_cost(_at(squared, raw) * R, of)
                of_levels.append(math.inf if raw > self.points.raw_max else cost)
            bound = math.nan if any(map(math.isnan, bounds)) else min(bounds)
            costs[k] = bound if bound > min(of_levels) else min(of_levels)
        return sorted(costs, key=lambda k: (costs[k], k))[:CHOSEN]

    def encode(
        self, wanted: Wanted, curve: Curve, spacings: Sequence[int]
    ) -> tuple[dict[str, int], bool]:
        """Return the levels with the least cost, and whether they cover the line.

        Of all tilts, with some spacings and some levels of the points, or some of the shape alone.
        """
        _, of_points, of_shape = self.squares
        levels, least_so_far = (0, 0, 0, 0), math.inf
        tried = [(noise(self.shape, k, curve), of_points, k) for k in spacings]
        for t, tilt in enumerate(self.tilts):
            E = sheared(wanted.target, tilt)
            for S, squared, k in [*tried, (SHAPE, of_shape, None)]:
                R = sheared(S, tilt)
                least = least_raw(squared, R, E, least_by_variances(squared, R, E))
                for raw in (least + n for n in TRIED):
                    square = _at(squared, raw)
                    bound = least_cost(square * S, wanted)
                    if raw >= len(squared) or bound >= least_so_far:
                        break  # higher levels cost no less
                    lateral = bisect_left(self.squares[0], shortfall(square * R - E))
                    cost = self.cost(square * S, lateral, tilt, wanted)
                    cost = bound if bound > cost else cost
                    if cost < least_so_far:  # the first one with the least cost
                        levels = (lateral, 0, raw, t) if k is None else (lateral, raw, k, t)
                        least_so_far = cost
        names = OWN_SIGNALS if len(self.tilts) == 1 else (*OWN_SIGNALS, TILT)
        return dict(zip(names, levels, strict=False)), math.isfinite(least_so_far)

    def cost(self, own: Matrix, lateral: int, tilt: float, wanted: Wanted) -> float:
        """Return the cost of a covariance with a lateral level; infinite if there is no such."""
        decoded = wanted.common + own
        add_lateral(decoded, _at(self.squares[0], lateral), tilt)
        by_trace, ratio = compared(wanted.true, decoded)
        cost = by_trace + LN_2 * log2(ratio * largest_ratio(decoded, wanted.true))
        return cost if lateral <= self.lateral.raw_max and math.isfinite(cost) else math.inf


def sheared(S: Matrix, tilt: float) -> Matrix:
    """Return a covariance for which a lateral level with a tilt is one of T_0 alone.

    The tilt times the coefficient of T_0 is taken from that of T_1: of the lower triangle.
    """
    found = matrix(S)
    if tilt:  # so that no infinite entry becomes NaN
        found[1][0] -= tilt * S[0][0]
        found[1][1] = S[1][1] - tilt * S[1][0] - tilt * found[1][0]
        found[2][1] -= tilt * S[2][0]
        found[3][1] -= tilt * S[3][0]
    return found


def _single(x: float) -> float:
    """Return a number in single precision."""
    return float(struct.unpack("f", struct.pack("f", x))[0])


def _at(squared: Sequence[float], raw: int) -> float:
    """Return the square of a level; beyond the greatest raw value, that of the greatest."""
    return squared[min(max(raw, 0), len(squared) - 1)]


def least_by_variances(squared: Sequence[float], S: Matrix, E: Matrix) -> int:
    """Return the least raw value, 1 or more, whose multiple of S covers all variances but one."""
    shares = E.diagonal() / (S + SINGULAR).diagonal()
    return max(bisect_left(squared, max(0.0, *shares[1:])), 1)


def least_raw(squared: Sequence[float], S: Matrix, E: Matrix, begin: int) -> int:
    """Return the least raw value whose multiple of S covers E, but for T_0.

    It is one more than the greatest raw value if none covers. Those below ``begin`` do not. Steps
    double until the bracket is shorter, and are halved then.
    """
    low, high, step = begin - 1, len(squared), 1
    while high - low > 1:
        middle = low + min(step, (high - low) // 2)
        if pivots(_at(squared, middle) * (S + SINGULAR) - E) is not None:
            high = middle
        else:
            low = middle
        step *= 2
    return high


def pivots(M: Matrix) -> list[tuple[float, float]] | None:
    """Return the pivots of a matrix without T_0, each with what is left of the entry of T_0 then.

    None if a pivot is not positive: the rest of the matrix is not definite.
    """
    a, b, c, d, e, f, g, h, i = (M[row][column] for row, column in LOWER)
    if not a > 0:
        return None
    d1 = d - b * b / a
    e1, h1 = e - b * c / a, h - b * g / a
    if not d1 > 0:
        return None
    f2 = f - c * c / a - e1 * e1 / d1
    i2 = i - c * g / a - e1 * h1 / d1
    return [(a, g), (d1, h1), (f2, i2)] if f2 > 0 else None


def shortfall(M: Matrix) -> float:
    """Return what to add to the entry of T_0 to make a matrix semidefinite; or ``BEYOND``."""
    found = pivots(M)
    if found is None:
        return BEYOND
    short = reduce(add, (x * x / pivot for pivot, x in found)) - M[0][0]
    return short if math.isfinite(short) else BEYOND


def least_cost(own: Matrix, wanted: Wanted) -> float:
    """Return a lower bound of a cost.

    With r > 1 the largest ratio of the variances of the direction, at five places, to the true
    ones, the divergence is (1 / r - 1 + ln r) / 2 at least, and ln r is 2 (r - 1) / (r + 1).
    """
    r = largest_direction(own + wanted.common, wanted.true)
    return (r - 1) * (5 * r - 1) / (2 * r * (r + 1))


def direction_cost(own: Matrix, wanted: Wanted) -> float:
    """Return the cost without T_0: for the direction of the line, whatever its lateral position."""
    decoded = own + wanted.common
    (C11, C21, C31, C22, C32, C33), determinant = cofactors(decoded)
    T11, T21, T31, T22, T32, T33 = (wanted.true[i][j] for i, j in LOWER[:6])
    of_true = cofactors(wanted.true)[1]
    if not (determinant and of_true):
        return math.inf
    trace = T11 * C11 + T22 * C22 + T33 * C33 + 2 * (T21 * C21 + T31 * C31 + T32 * C32)
    r = largest_direction(decoded, wanted.true)
    by_trace = (trace / determinant - 3) / 2
    cost = by_trace + LN_2 * log2(determinant / of_true * r * r) / 2
    return cost if math.isfinite(cost) else math.inf


def cofactors(M: Matrix) -> tuple[tuple[float, ...], float]:
    """Return the cofactors of a matrix without T_0, of its lower triangle, and its determinant."""
    a, b, c, d, e, f = (M[i][j] for i, j in LOWER[:6])
    C = d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b
    return C, a * C[0] + b * C[1] + c * C[2]


def largest_direction(decoded: Matrix, true: Matrix) -> float:
    """Return the largest ratio of variances of the direction, at five places; 1 if it is less."""
    pairs = zip(directions(decoded), directions(true), strict=True)
    return max(1.0, *(variance * (1 / x) if x else 1.0 for variance, x in pairs))


def directions(S: Matrix) -> list[float]:
    """Return variances of the derivative with respect to w at -1, 1, -1/2, 1/2 and 0."""
    at_ends = S[1][1] + 16 * S[2][2] + 81 * S[3][3] + 18 * S[3][1]
    end = 8 * S[2][1] + 72 * S[3][2]
    between, half = S[1][1] + 4 * S[2][2], 4 * S[2][1]
    centre = S[1][1] - 6 * S[3][1] + 9 * S[3][3]
    return [at_ends - end, at_ends + end, between - half, between + half, centre]
