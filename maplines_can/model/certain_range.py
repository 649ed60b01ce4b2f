"""Where a line is certain: the part of a range in which its lateral position is known well enough.

The variance of the lateral position is a polynomial of degree 6 in x.
"""

from __future__ import annotations

import math
from itertools import pairwise

from .elementary import clipped, tan
from .lines import lateral_variance
from .matrices import Matrix, Vector

#: Zeros of T_7, at which the polynomial is sampled.
_POSITIVE = [
    *map(float.fromhex, ("0x1.bc4c04d71abc1p-2", "0x1.904c37505de4bp-1", "0x1.f329c0558e969p-1"))
]
NODES = [*(-x for x in reversed(_POSITIVE)), 0.0, *_POSITIVE]
#: Most steps to a zero.
NEWTON_STEPS = 200


def certain_range(
    mean: Vector, cov: Matrix, begin: float, end: float, max_sigma: float
) -> tuple[float, float] | None:
    """Return the part of a range, about the place nearest to the car, that is certain enough [m].

    The standard deviation of the lateral position is at most a limit there. None if it is not even
    at that place.
    """
    centre, half, slope = (begin + end) / 2, (end - begin) / 2, tan(mean[1])
    if not max_sigma < math.inf:
        return begin, end
    excess = Vector([0.0] * 7)  # coefficients of T_0 .. T_6
    for w in NODES:
        T = Vector([1.0, w])
        while len(T) < len(excess):
            T.append(2 * w * T[-1] - T[-2])
        value = lateral_variance(slope, cov, centre + half * w)
        excess += Vector((2 if j else 1) / 7 * value for j in range(7)) * T
    excess[0] -= max_sigma * max_sigma
    if not excess[0] + Vector(map(abs, excess[1:])) @ ([1.0] * 6) > 0:  # no T_i exceeds 1
        return begin, end
    car = (clipped(0.0, begin, end) - centre) / half
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


def powers_of(e: Vector) -> list[float]:
    """Return the coefficients of w^0 .. w^6 from those of T_0 .. T_6."""
    return [
        *(e[0] - e[2] + e[4] - e[6], e[1] - 3 * e[3] + 5 * e[5], 2 * e[2] - 8 * e[4] + 18 * e[6]),
        *(4 * e[3] - 20 * e[5], 8 * e[4] - 48 * e[6], 16 * e[5], 32 * e[6]),
    ]


def zeros_of(a: list[float]) -> list[float]:
    """Return where a polynomial changes its sign from -1 to 1, in ascending order.

    The zeros of its derivative separate its own.
    """
    if len(a) == 1:
        return []
    bounds = [-1.0, *zeros_of([i * x for i, x in enumerate(a)][1:]), 1.0]
    return [
        _zero_between(a, low, high)
        for low, high in pairwise(bounds)
        if (_value(a, low)[0] < 0) != (_value(a, high)[0] < 0)
    ]


def _value(a: list[float], w: float) -> tuple[float, float]:
    """Return value and derivative of a polynomial."""
    value, slope = a[-1], 0.0
    for x in reversed(a[:-1]):
        slope = slope * w + value
        value = value * w + x
    return value, slope


def _zero_between(a: list[float], low: float, high: float) -> float:
    """Return a zero by Newton's method, or halving where that leaves the interval or is slow."""
    rises = _value(a, low)[0] < 0
    w, before, step = (low + high) / 2, high - low, high - low
    for _ in range(NEWTON_STEPS):
        value, slope = _value(a, w)
        if value == 0:
            break
        low, high = (w, high) if (value < 0) == rises else (low, w)
        chosen = w - value / slope if slope else math.nan
        if not (low < chosen < high and abs(chosen - w) < abs(before) / 2):
            chosen = low + (high - low) / 2
        before, step, last, w = step, chosen - w, w, chosen
        if w in (last, low, high):
            break
    return w
