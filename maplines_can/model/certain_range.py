"""Where a line is certain: the part of a range in which its lateral position is known well enough.

The variance of the lateral position is a polynomial of degree 6 in x.
"""

from __future__ import annotations

import math

from .elementary import tan
from .matrices import Matrix, Row, dot
from .stretches import limited

#: Zeros of T_7, at which the polynomial is sampled.
_POSITIVE = [
    *map(float.fromhex, ("0x1.bc4c04d71abc1p-2", "0x1.904c37505de4bp-1", "0x1.f329c0558e969p-1"))
]
NODES = [*(-x for x in reversed(_POSITIVE)), 0.0, *_POSITIVE]
#: Most steps to a zero.
NEWTON_STEPS = 200


def certain_range(
    mean: Row, cov: Matrix, begin: float, end: float, max_sigma: float
) -> tuple[float, float] | None:
    """Return the part of a range, about the place nearest to the car, that is certain enough [m].

    The standard deviation of the lateral position is at most a limit there. None if it is not even
    at that place. The variance is a polynomial of degree 6 in x.
    """
    centre, half = (begin + end) / 2, (end - begin) / 2
    if not max_sigma < math.inf:
        return begin, end
    excess = [0.0] * 7  # coefficients of T_0 .. T_6
    for w in NODES:
        value, T = lateral_variance(mean, cov, centre + half * w), [1.0, w]
        while len(T) < len(excess):
            T.append(2 * w * T[-1] - T[-2])
        for j in range(7):
            excess[j] += (2 if j else 1) / 7 * value * T[j]
    excess[0] -= max_sigma * max_sigma
    if not excess[0] + _sum([abs(e) for e in excess[1:]]) > 0:  # no T_i exceeds 1
        return begin, end
    car = (limited(0.0, begin, end) - centre) / half
    before, last = excess[5:]
    for e in reversed(excess[:5]):  # Clenshaw's method
        before, last = e - last, before + last * (2 * car)
    if before + last * car > 0:
        return None
    found = [begin, end]
    for w in zeros_of(powers_of(excess)):
        x = centre + half * w
        if w <= car:
            found[0] = max(found[0], x)
        if w >= car:
            found[1] = min(found[1], x)
    return found[0], found[1]


def _sum(values: Row) -> float:
    """Return the sum of the values, one after the other."""
    return dot(values, [1.0] * len(values))


def lateral_variance(mean: Row, cov: Matrix, x: float) -> float:
    """Return the variance of the lateral position of a line [m^2]."""
    slope = tan(mean[1])
    J = [1.0, (1 + slope * slope) * x, x * x / 2, x * x * x / 6]
    return dot([dot(J, column) for column in zip(*cov, strict=True)], J)


def powers_of(e: Row) -> Row:
    """Return the coefficients of w^0 .. w^6 from those of T_0 .. T_6."""
    return [
        *(e[0] - e[2] + e[4] - e[6], e[1] - 3 * e[3] + 5 * e[5], 2 * e[2] - 8 * e[4] + 18 * e[6]),
        *(4 * e[3] - 20 * e[5], 8 * e[4] - 48 * e[6], 16 * e[5], 32 * e[6]),
    ]


def zeros_of(a: Row) -> Row:
    """Return where a polynomial changes its sign from -1 to 1, in ascending order.

    The zeros of each derivative separate those of the one before.
    """
    derivatives = [a]
    while len(derivatives[-1]) > 2:
        derivatives.append([i * x for i, x in enumerate(derivatives[-1])][1:])
    zeros: Row = []
    for own in reversed(derivatives):
        bounds = [-1.0, *zeros, 1.0]
        signs = [_value(own, w)[0] < 0 for w in bounds]
        zeros = [
            _zero_between(own, bounds[i], bounds[i + 1])
            for i in range(len(bounds) - 1)
            if signs[i] != signs[i + 1]
        ]
    return zeros


def _value(a: Row, w: float) -> tuple[float, float]:
    """Return value and derivative of a polynomial."""
    value, slope = a[-1], 0.0
    for x in reversed(a[:-1]):
        slope = slope * w + value
        value = value * w + x
    return value, slope


def _zero_between(a: Row, low: float, high: float) -> float:
    """Return a zero by Newton's method, or halving where that leaves the interval or is slow."""
    rises = _value(a, low)[0] < 0
    w, before = (low + high) / 2, high - low
    step = before
    for _ in range(NEWTON_STEPS):
        value, slope = _value(a, w)
        if value == 0:
            break
        low, high = (w, high) if (value < 0) == rises else (low, w)
        chosen = w - value / slope if slope else math.nan
        if not (low < chosen < high and abs(chosen - w) < abs(before) / 2):
            chosen = low + (high - low) / 2
        before, step, last = step, chosen - w, w
        w = chosen
        if w in (last, low, high):
            break
    return w
