"""Choice of levels: of those that cover a line, the ones that tell the least wrong of it.

The cost of levels is the divergence of what they decode to from the true covariance, plus the
logarithm of the largest ratio of variances, of the lateral position or the direction of the line.
"""

from __future__ import annotations

import math
import struct
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from ..wire.layout.signals import OCTAVE, Signal
from .elementary import exp2, log2
from .joint import LN_2, compared, largest_ratio
from .levels import (
    GOLDEN_RATIO,
    RATIOS,
    SHAPE,
    Levels,
    LevelSignals,
    arc_of,
    level_covariance,
    noise,
    point_noise,
    shape_level,
)
from .lines import Curve
from .matrices import Matrix, Row, added, congruence, diagonal, inverse, subtracted
from .signals import level, physical

#: Raw values above the least one of the level of the points, or of the shape, that are tried.
TRIED = (0, 1, 2, 3, 5)
#: Spacings for which the second of them is tried, at most, and those of the best of these for which
#: all are. The first ones for which it is tried; of the others, only those that may be better.
SPACINGS, CHOSEN, FIRST = 256, 16, 24
#: More than any level squared [m^2].
BEYOND = 1e100
#: Added to the variances that errors of points cause: those of points far apart may be singular.
SINGULAR = 1e-6
#: Entries without those of T_0, of the lower triangle, column by column.
LOWER = ((1, 1), (2, 1), (3, 1), (2, 2), (3, 2), (3, 3))


@dataclass(frozen=True)
class Wanted:
    """What levels have to cover, of the coefficients of T_0 .. T_3."""

    target: Matrix  #: E: less what is common to all lines
    common: Matrix  #: C
    true: Matrix  #: T: to which the sum is to be close

    @classmethod
    def of(cls, target: Matrix, common: Matrix, true: Matrix, J: Matrix) -> Wanted:
        """Return what is given of the parameters, and J of ``bases``."""
        to_metres = inverse(J)
        wanted = subtracted(congruence(to_metres, target), common)
        return cls(wanted, common, congruence(to_metres, true))


@dataclass(frozen=True)
class LevelSearch:
    """Search for the levels of a line."""

    signals: LevelSignals

    @cached_property
    def squares(self) -> tuple[Row, Row, Row]:
        """Squares of the levels a, p and b of all raw values."""
        lateral, points, shape = self.signals
        of_levels = [
            [level(one, {one.name: raw}) ** 2 for raw in range(one.raw_max + 1)]
            for one in (lateral, points)
        ]
        shapes = [shape_level(shape, raw) for raw in range(shape.raw_max + 1)]
        return of_levels[0], of_levels[1], [b * b for b in shapes]

    @cached_property
    def searched(self) -> list[int]:
        """Raw values of the shape that are tried: all, or at equal distances."""
        first, last = self.signals.shape.raw_min, self.signals.shape.raw_max
        step = -(-(last + 1 - first) // SPACINGS)
        while math.gcd(step, len(RATIOS)) != 1:
            step += 1
        return list(range(first, last + 1, step))

    @cached_property
    def straight(self) -> list[tuple[Matrix, float]]:
        """N of a straight line, and r^2 d, of all raw values that are tried.

        They have single precision, as in the tables of the core.
        """
        line, found = Curve([0.0] * 4, 0.0, 1.0, 0.0), []
        for raw in self.searched:
            d, phase, amount = spacing_of(self.signals.shape, raw)
            N = point_noise(line, d, phase)
            found.append(([[_single(x) for x in row] for row in N], _single(amount)))
        return found

    def near_noise(self, curve: Curve) -> list[Matrix]:
        """Return the noise at all raw values that are tried, of straight lines.

        They are stretched as the line is on average, and choose the same spacings, or nearly so.
        """
        stretch = arc_of(curve).stretch
        squared = min(stretch) * max(stretch)
        found = []
        for N, amount in self.straight:
            S = [[squared * x for x in row] for row in N]
            for i, share in enumerate(SHAPE):
                S[i][i] += amount * share
            found.append(S)
        return found

    def spacings(self, wanted: Wanted, curve: Curve) -> list[int]:
        """Return the raw values of the shape that suit the errors of points best.

        Of all that are searched, they have the least cost with one level of the points.
        """
        near, squared, last = self.near_noise(curve), self.squares[1], self.signals.points.raw_max
        least = [least_by_variances(squared, S, wanted.target) for S in near]
        bound = []
        for S, raw in zip(near, least, strict=True):
            own = scaled(_at(squared, raw + TRIED[1]), S)
            bound.append(least_cost(own, wanted))
        cost = [math.inf] * len(near)

        def assess(k: int) -> None:
            raw = least_raw(squared, near[k], wanted.target, least[k]) + TRIED[1]
            _, found = self.cost(scaled(_at(squared, raw), near[k]), wanted)
            found = math.inf if raw > last else found
            cost[k] = bound[k] if bound[k] > found else found

        first = sorted(range(len(near)), key=lambda k: (math.isnan(bound[k]), bound[k]))[:FIRST]
        for k in first:
            assess(k)
        limit = sorted(cost)[min(CHOSEN, len(cost)) - 1]
        for k in range(len(near)):
            if k not in first and not bound[k] > limit:
                assess(k)
        return [self.searched[k] for k in sorted(range(len(near)), key=lambda k: cost[k])[:CHOSEN]]

    def encode(self, wanted: Wanted, curve: Curve, spacings: Sequence[int]) -> tuple[Levels, bool]:
        """Return the levels with the least cost, and whether they cover the line.

        Of some spacings with some levels of the points, and of some levels of the shape alone.
        """
        tried: list[tuple[int, int, Matrix]] = []  # raw values of the points and the shape
        squared = self.squares[1]
        for k in spacings:
            S = noise(self.signals.shape, k, curve)
            least = least_raw(
                squared, S, wanted.target, least_by_variances(squared, S, wanted.target)
            )
            tried += [(least + n, k, scaled(_at(squared, least + n), S)) for n in TRIED]
        shape, squared = diagonal(SHAPE), self.squares[2]
        begin = least_by_variances(squared, shape, wanted.target)
        least = least_raw(squared, shape, wanted.target, begin)
        tried += [(0, least + n, scaled(_at(squared, least + n), shape)) for n in TRIED]
        best, best_cost = (0, *tried[0][:2]), math.nan
        for points, k, own in tried:
            lateral, cost = self.cost(own, wanted)
            bound = least_cost(own, wanted)
            cost = bound if bound > cost else cost
            if points > self.signals.points.raw_max or k > self.signals.shape.raw_max:
                cost = math.inf
            if not cost >= best_cost:  # the first one with the least cost
                best, best_cost = (lateral, points, k), cost
        limits = [signal.raw_max for signal in self.signals]
        raw = [min(value, most) for value, most in zip(best, limits, strict=True)]
        return Levels(*raw), math.isfinite(best_cost)

    def covered(self, raw: Levels, target: Matrix, common: Matrix, J: Matrix, curve: Curve) -> bool:
        """Whether levels cover a target."""
        wanted = subtracted(congruence(inverse(J), target), common)
        own = level_covariance(self.signals, raw, curve)
        return shortfall(subtracted(own, wanted)) <= 0

    def cost(self, own: Matrix, wanted: Wanted) -> tuple[int, float]:
        """Return the lateral level with which a covariance covers the target, and its cost."""
        squared = self.squares[0]
        raw = bisect_left(squared, shortfall(subtracted(own, wanted.target)))
        decoded = added(wanted.common, own)
        decoded[0][0] += _at(squared, raw)
        by_trace, ratio = compared(wanted.true, decoded)
        cost = by_trace + LN_2 * log2(ratio * largest_ratio(decoded, wanted.true))
        is_possible = raw <= self.signals.lateral.raw_max and math.isfinite(cost)
        return raw, cost if is_possible else math.inf


def spacing_of(signal: Signal, raw: int) -> tuple[float, float, float]:
    """Return d, the phase, and r^2 d of a raw value of the shape."""
    d = physical(signal, {signal.name: raw})
    d = exp2(d) if signal.unit == OCTAVE else d
    turns, ratio = raw * GOLDEN_RATIO, RATIOS[raw % len(RATIOS)]
    return d, turns - math.floor(turns), ratio * ratio * d


def _single(x: float) -> float:
    """Return a number in single precision."""
    return float(struct.unpack("f", struct.pack("f", x))[0])


def _at(squared: Sequence[float], raw: int) -> float:
    """Return the square of a level; beyond the greatest raw value, that of the greatest."""
    return squared[min(max(raw, 0), len(squared) - 1)]


def scaled(factor: float, S: Matrix) -> Matrix:
    """Return a multiple of a matrix."""
    return [[factor * x for x in row] for row in S]


def least_by_variances(squared: Sequence[float], S: Matrix, E: Matrix) -> int:
    """Return the least raw value, 1 or more, whose multiple of S covers all variances but one."""
    needed = 0.0
    for i in range(1, 4):
        needed = max(needed, E[i][i] / (S[i][i] + SINGULAR))
    return max(bisect_left(squared, needed), 1)


def least_raw(squared: Sequence[float], S: Matrix, E: Matrix, begin: int) -> int:
    """Return the least raw value whose multiple of S covers E, but for T_0.

    It is one more than the greatest raw value if none covers. Those below ``begin`` do not. Steps
    double until the bracket is shorter, and are halved then.
    """
    low, high, step = begin - 1, len(squared), 1
    while high - low > 1:
        middle = low + min(step, (high - low) // 2)
        if _rest_is_definite(_at(squared, middle), S, E):
            high = middle
        else:
            low = middle
        step *= 2
    return high


def _rest_is_definite(factor: float, S: Matrix, E: Matrix) -> bool:
    a, b, c, d, e, f = (
        factor * (S[i][j] + (SINGULAR if i == j else 0.0)) - E[i][j] for i, j in LOWER
    )
    if not a > 0:
        return False
    d1, e1 = d - b * b / a, e - b * c / a
    return d1 > 0 and f - c * c / a - e1 * e1 / d1 > 0


def shortfall(M: Matrix) -> float:
    """Return what to add to the entry of T_0 to make a matrix semidefinite.

    It is beyond all levels if nothing does: the rest of the matrix is not definite.
    """
    a, b, c, d, e, f = (M[i][j] for i, j in LOWER)
    g, h, i = M[1][0], M[2][0], M[3][0]
    if not a > 0:
        return BEYOND
    d1 = d - b * b / a
    e1, h1 = e - b * c / a, h - b * g / a
    if not d1 > 0:
        return BEYOND
    f2 = f - c * c / a - e1 * e1 / d1
    i2 = i - c * g / a - e1 * h1 / d1
    if not f2 > 0:
        return BEYOND
    short = g * g / a + h1 * h1 / d1 + i2 * i2 / f2 - M[0][0]
    return short if math.isfinite(short) else BEYOND


def least_cost(own: Matrix, wanted: Wanted) -> float:
    """Return a lower bound of a cost.

    With r > 1 the largest ratio of the variances of the direction, at five places, to the true
    ones, the divergence is (1 / r - 1 + ln r) / 2 at least, and ln r is 2 (r - 1) / (r + 1).
    """
    r = 1.0
    for variance, true in zip(
        directions(added(own, wanted.common)), directions(wanted.true), strict=True
    ):
        if true and variance / true > r:
            r = variance / true
    return (r - 1) * (5 * r - 1) / (2 * r * (r + 1))


def directions(S: Matrix) -> Row:
    """Return variances of the derivative with respect to w at -1, 1, -1/2, 1/2 and 0."""
    at_ends = S[1][1] + 16 * S[2][2] + 81 * S[3][3] + 18 * S[3][1]
    end = 8 * S[2][1] + 72 * S[3][2]
    between, half = S[1][1] + 4 * S[2][2], 4 * S[2][1]
    centre = S[1][1] - 6 * S[3][1] + 9 * S[3][3]
    return [at_ends - end, at_ends + end, between - half, between + half, centre]
