"""Elementary functions whose results are the same to the last bit on any machine.

Those of mathematical libraries differ from each other in the last bits. A scene is decoded with
sines and an encoder decodes what it encodes, so both sides need the same ones; and a line of a map
is the same from any machine. They are here, and in ``c/src/elementary.c``, which has the same
operations in the same order. Each is a polynomial in a reduced argument, with an error of at most
four units in the last place. Addition, multiplication, division and square root are the same
everywhere by IEEE 754; so are ``rint``, ``floor``, ``fmod``, ``ldexp`` and ``frexp``, which are
exact.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import floats

Array = NDArray[np.float64]


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(map(float.fromhex, text.split()))


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
_SIN = _numbers("""
    -0x1.5555555555555p-3 0x1.1111111111111p-7 -0x1.a01a01a01a01ap-13 0x1.71de3a556c734p-19
    -0x1.ae64567f544e4p-26 0x1.6124613a86d09p-33 -0x1.ae7f3e733b81fp-41 0x1.952c77030ad4ap-49
""")
_COS = _numbers("""
    -0x1.0000000000000p-1 0x1.5555555555555p-5 -0x1.6c16c16c16c17p-10 0x1.a01a01a01a01ap-16
    -0x1.27e4fb7789f5cp-22 0x1.1eed8eff8d898p-29 -0x1.93974a8c07c9dp-37 0x1.ae7f3e733b81fp-45
    -0x1.6827863b97d97p-53
""")
#: Coefficients of atan(t) / t in powers of t^2: (-1)^k / (2 k + 1).
_ATAN = _numbers("""
    0x1.0000000000000p+0 -0x1.5555555555555p-2 0x1.999999999999ap-3 -0x1.2492492492492p-3
    0x1.c71c71c71c71cp-4 -0x1.745d1745d1746p-4 0x1.3b13b13b13b14p-4 -0x1.1111111111111p-4
    0x1.e1e1e1e1e1e1ep-5 -0x1.af286bca1af28p-5 0x1.8618618618618p-5 -0x1.642c8590b2164p-5
    0x1.47ae147ae147bp-5
""")
#: pi / 2 in three parts; a product of the first two with up to 20 bits is exact.
_HALF_PI = _numbers("0x1.921fb54400000p+0 0x1.0b4611a600000p-34 0x1.3198a2e037073p-69")
_TWO_BY_PI, _PI_BY_2, _TWO_PI = _numbers(
    "0x1.45f306dc9c883p-1 0x1.921fb54442d18p+0 0x1.921fb54442d18p+2"
)
#: Angles beyond this are first reduced by whole turns of 2 pi as a float: as if the angle were off
#: by less than half a unit in its last place.
_FAR = 1e5
_SQRT_HALF = float.fromhex("0x1.6a09e667f3bcdp-1")
#: Up to this number, values are computed one by one: with few, arrays cost more than they save.
FEW = 16


def exp2(x: ArrayLike) -> Array:
    """Return the (...,) powers of 2 of exponents from -2000 to 2000; others are limited to these.

    >>> exp2([-1.0, 0.5, 10.0])
    array([5.00000000e-01, 1.41421356e+00, 1.02400000e+03])
    """
    limited = floats(x, "x").clip(-2000.0, 2000.0)
    whole = np.rint(limited)
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):
        power = np.nan_to_num(whole).astype(np.int64)
        return np.asarray(np.ldexp(_polynomial(limited - whole, _EXP2), power))


def log2(x: ArrayLike) -> Array:
    """Return the (...,) logarithms to base 2; -inf for 0 and below, NaN for NaN.

    >>> log2([0.25, 1.0, 3.0, 0.0])
    array([-2.       ,  0.       ,  1.5849625,      -inf])
    """
    values = floats(x, "x")
    if values.size <= FEW:
        results = [log2_one(value) for value in values.ravel().tolist()]
        return np.array(results).reshape(values.shape)
    mantissa, exponent = np.frexp(values)
    is_low = mantissa < _SQRT_HALF
    m = np.where(is_low, 2 * mantissa, mantissa)
    e = np.where(is_low, exponent - 1, exponent).astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (m - 1) / (m + 1)
        result = e + s * _polynomial(s * s, _LOG2)
    result = np.where(values <= 0, -np.inf, result)
    return np.where(np.isposinf(values), np.inf, result)


def log2_one(x: float) -> float:
    """Return one logarithm: as ``log2`` to the last bit."""
    if not 0 < x < math.inf:
        return -math.inf if x <= 0 else float(x)
    m, e = math.frexp(x)
    if m < _SQRT_HALF:
        m, e = 2 * m, e - 1
    s = (m - 1) / (m + 1)
    return e + s * _polynomial_one(s * s, _LOG2)


def sin_cos(x: ArrayLike) -> tuple[Array, Array]:
    """Return the (...,) sines and cosines of angles [rad]; NaN for those that are not finite.

    >>> sin_cos(np.pi / 6)
    (array(0.5), array(0.8660254))
    """
    angle = floats(x, "x")
    if angle.size <= FEW:
        pairs = [sin_cos_one(value) for value in angle.ravel().tolist()]
        sines, cosines = np.array(pairs).reshape(-1, 2).T
        return sines.reshape(angle.shape), cosines.reshape(angle.shape)
    with np.errstate(invalid="ignore"):
        if (is_far := np.abs(angle) > _FAR).any():
            angle = np.where(is_far, np.fmod(angle, _TWO_PI), angle)
        turns = np.rint(angle * _TWO_BY_PI)
        r = ((angle - turns * _HALF_PI[0]) - turns * _HALF_PI[1]) - turns * _HALF_PI[2]
        r2 = r * r
        sine = r + (r * r2) * _polynomial(r2, _SIN)
        cosine = 1 + r2 * _polynomial(r2, _COS)
        quarter = np.where(np.isfinite(turns), turns, 0.0).astype(np.int64) & 3
    is_odd = (quarter & 1) == 1
    s, c = np.where(is_odd, cosine, sine), np.where(is_odd, sine, cosine)
    return np.where(quarter >= 2, -s, s), np.where((quarter == 1) | (quarter == 2), -c, c)


def sin_cos_one(x: float) -> tuple[float, float]:
    """Return sine and cosine of one angle: as ``sin_cos`` to the last bit."""
    if not math.isfinite(x):
        return math.nan, math.nan
    angle = math.fmod(x, _TWO_PI) if abs(x) > _FAR else x
    turns = round(angle * _TWO_BY_PI)
    angle += 0.0  # without -0.0, as of rint, which keeps the sign of 0
    r = ((angle - turns * _HALF_PI[0]) - turns * _HALF_PI[1]) - turns * _HALF_PI[2]
    r2 = r * r
    s = r + (r * r2) * _polynomial_one(r2, _SIN)
    c = 1 + r2 * _polynomial_one(r2, _COS)
    return ((s, c), (c, -s), (-s, -c), (-c, s))[turns & 3]


def tan_one(x: float) -> float:
    """Return one tangent: as ``tan`` to the last bit."""
    sine, cosine = sin_cos_one(x)
    return sine / cosine


def tan(x: ArrayLike) -> Array:
    """Return the (...,) tangents of angles [rad].

    >>> tan([0.0, 0.25])
    array([0.        , 0.25534192])
    """
    sine, cosine = sin_cos(x)
    return np.asarray(sine / cosine)


def atan(x: ArrayLike) -> Array:
    """Return the (...,) angles of tangents, from -pi/2 to pi/2 [rad].

    >>> atan([1.0, -np.inf])
    array([ 0.78539816, -1.57079633])
    """
    tangent = floats(x, "x")
    if tangent.size <= FEW:
        angles = [_atan_one(value) for value in tangent.ravel().tolist()]
        return np.array(angles).reshape(tangent.shape)
    size = np.abs(tangent)
    is_steep = size > 1
    t = np.where(is_steep, 1 / np.where(is_steep, size, 1.0), size)
    for _ in range(2):  # tan(a / 2) = tan a / (1 + sqrt(1 + tan^2 a))
        t = t / (1 + np.sqrt(1 + t * t))
    angle = 4 * (t * _polynomial(t * t, _ATAN))
    return np.copysign(np.where(is_steep, _PI_BY_2 - angle, angle), tangent)


def _atan_one(x: float) -> float:
    """Return the angle of one tangent: as ``atan`` to the last bit."""
    t = 1 / abs(x) if abs(x) > 1 else abs(x)
    for _ in range(2):
        t = t / (1 + math.sqrt(1 + t * t))
    angle = 4 * (t * _polynomial_one(t * t, _ATAN))
    return math.copysign(_PI_BY_2 - angle if abs(x) > 1 else angle, x)


def hypot(x: Array, y: Array) -> Array:
    """Return the (...,) lengths of vectors (x, y); NaN if x or y is one.

    The relative error is at most 2^-52 from 1e-150 to 1e154; squares of what is longer overflow.

    >>> hypot(np.array([3.0, 1e200]), np.array([4.0, 0.0]))
    array([ 5., inf])
    """
    with np.errstate(over="ignore"):  # infinite then, as in C
        return np.asarray(np.sqrt(x * x + y * y))


def _polynomial(x: Array, coefficients: tuple[float, ...]) -> Array:
    """Return the (...,) values of a polynomial by Horner's scheme, the highest power last."""
    *lower, value = coefficients
    total = np.full_like(x, value)
    for coefficient in reversed(lower):
        total *= x
        total += coefficient
    return total


def _polynomial_one(x: float, coefficients: tuple[float, ...]) -> float:
    """Return one value of a polynomial: as ``_polynomial`` to the last bit."""
    total = 0.0
    for coefficient in reversed(coefficients):  # the first product is 0, and adds nothing
        total = total * x + coefficient
    return total
