"""Elementary functions with the same bits on any machine: polynomials in a reduced argument.

Those of mathematical libraries differ in the last bits, and a sender decodes what it encodes. Sums
and products are in the order of the core, ``c/src/elementary.c``.
"""

from __future__ import annotations

import math


def _numbers(text: str) -> list[float]:
    return [*map(float.fromhex, text.split())]


#: Coefficients of 2^f, ln(2)^k / k!, the highest power last.
_EXP2 = _numbers("""
    0x1.0000000000000p+0 0x1.62e42fefa39efp-1 0x1.ebfbdff82c58fp-3 0x1.c6b08d704a0c0p-5
    0x1.3b2ab6fba4e77p-7 0x1.5d87fe78a6731p-10 0x1.430912f86c787p-13 0x1.ffcbfc588b0c7p-17
    0x1.62c0223a5c824p-20 0x1.b5253d395e7c4p-24 0x1.e4cf5158b8ecap-28 0x1.e8cac7351bb25p-32
    0x1.c3bd650fc2986p-36 0x1.816193166d0f9p-40
""")
#: Coefficients of log2 in powers of ((m - 1) / (m + 1))^2: 2 / ((2 k + 1) ln 2).
_LOG2 = _numbers("""
    0x1.71547652b82fep+1 0x1.ec709dc3a03fdp-1 0x1.2776c50ef9bfep-1 0x1.a61762a7aded9p-2
    0x1.484b13d7c02a9p-2 0x1.0c9a84994022dp-2 0x1.c68f568d31760p-3 0x1.89f3b1694cffep-3
    0x1.5b9ac9b743f0dp-3 0x1.3703c1f4d0ffep-3 0x1.1964ec6fc9491p-3 0x1.00ecd7e080215p-3
""")
#: Coefficients of (sin r - r) / r^3 and (cos r - 1) / r^2 in powers of r^2.
_SIN = [(-1) ** (k + 1) / math.factorial(2 * k + 3) for k in range(8)]
_COS = [(-1) ** (k + 1) / math.factorial(2 * k + 2) for k in range(9)]
#: Coefficients of atan(t) / t in powers of t^2.
_ATAN = [(-1) ** k / (2 * k + 1) for k in range(13)]
#: pi / 2 in three parts; a product of the first two with up to 20 bits is exact.
_HALF_PI = _numbers("0x1.921fb54400000p+0 0x1.0b4611a600000p-34 0x1.3198a2e037073p-69")
#: Angles beyond this are first reduced by whole turns [rad].
_FAR = 1e5


def exp2(x: float) -> float:
    """Return 2^x: the nearest whole power, and a polynomial for the rest.

    >>> exp2(-1.0), exp2(10.0)
    (0.5, 1024.0)
    """
    whole = round(x)
    return math.ldexp(_polynomial(x - whole, _EXP2), whole)


def log2(x: float) -> float:
    """Return the logarithm to base 2; -inf for 0 and below, NaN for NaN.

    >>> log2(0.25), log2(0.0)
    (-2.0, -inf)
    """
    if not 0 < x < math.inf:
        return -math.inf if x <= 0 else x
    m, e = math.frexp(x)
    if m < math.sqrt(0.5):
        m, e = 2 * m, e - 1
    s = (m - 1) / (m + 1)
    return e + s * _polynomial(s * s, _LOG2)


def sin_cos(x: float) -> tuple[float, float]:
    """Return sine and cosine [rad]; NaN for an angle that is not finite.

    >>> sin_cos(0.0)
    (0.0, 1.0)
    """
    if not math.isfinite(x):
        return math.nan, math.nan
    angle = math.fmod(x, math.tau) if abs(x) > _FAR else x
    quarters = round(angle * (2 / math.pi))
    angle += 0.0  # without -0.0
    r = ((angle - quarters * _HALF_PI[0]) - quarters * _HALF_PI[1]) - quarters * _HALF_PI[2]
    square = r * r
    s = r + (r * square) * _polynomial(square, _SIN)
    c = 1 + square * _polynomial(square, _COS)
    return ((s, c), (c, -s), (-s, -c), (-c, s))[quarters & 3]


def tan(x: float) -> float:
    """Return the tangent [rad]."""
    sine, cosine = sin_cos(x)
    return sine / cosine


def atan(x: float) -> float:
    """Return the angle of a tangent, from -pi/2 to pi/2 [rad].

    >>> atan(0.0), atan(-math.inf) == -math.pi / 2
    (0.0, True)
    """
    t = 1 / abs(x) if abs(x) > 1 else abs(x)
    for _ in range(2):  # tan(a / 2) = tan a / (1 + sqrt(1 + tan^2 a))
        t = t / (1 + math.sqrt(1 + t * t))
    angle = 4 * (t * _polynomial(t * t, _ATAN))
    return math.copysign(math.pi / 2 - angle if abs(x) > 1 else angle, x)


def hypot(x: float, y: float) -> float:
    """Return the length of a vector."""
    return math.sqrt(x * x + y * y)


def clipped(x: float, low: float, high: float) -> float:
    """Return the number in an interval that is nearest to another one."""
    return min(high, max(low, x))


def _polynomial(x: float, coefficients: list[float]) -> float:
    """Return the value of a polynomial by Horner's scheme, the highest power last."""
    *lower, value = coefficients
    for coefficient in reversed(lower):
        value = value * x + coefficient
    return value
