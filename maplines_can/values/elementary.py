"""Elementary functions whose results are the same to the last bit on any machine.

Those of mathematical libraries differ from each other in the last bits. A scene is decoded with
sines, and a line of a map is the same from any machine. So the core has its own, with an error of
at most four units in the last place, and these are its values.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import ffi, lib
from ..core.memory import pointer
from .arrays import floats

Array = NDArray[np.float64]

#: Numbers of the functions in the core.
_EXP2, _LOG2, _TAN, _SIN_COS = 0, 1, 2, 4


def exp2(x: ArrayLike) -> Array:
    """Return the (...,) powers of 2 of exponents from -2000 to 2000; others are limited to these.

    >>> exp2([-1.0, 0.5, 10.0])
    array([5.00000000e-01, 1.41421356e+00, 1.02400000e+03])
    """
    return _values(_EXP2, x)


def log2(x: ArrayLike) -> Array:
    """Return the (...,) logarithms to base 2; -inf for 0 and below, NaN for NaN.

    >>> log2([0.25, 1.0, 3.0, 0.0])
    array([-2.       ,  0.       ,  1.5849625,      -inf])
    """
    return _values(_LOG2, x)


def tan(x: ArrayLike) -> Array:
    """Return the (...,) tangents of angles [rad].

    >>> tan([0.0, 0.25])
    array([0.        , 0.25534192])
    """
    return _values(_TAN, x)


def sin_cos(x: ArrayLike) -> tuple[Array, Array]:
    """Return the (...,) sines and cosines of angles [rad]; NaN for those that are not finite.

    >>> sin_cos(np.pi / 6)
    (array(0.5), array(0.8660254))
    """
    angle = np.asarray(floats(x, "x"), order="C")
    sine, cosine = np.empty(angle.shape), np.empty(angle.shape)
    lib.maplines_elementary(_SIN_COS, angle.size, *map(pointer, (angle, sine, cosine)))
    return sine, cosine


def _values(function: int, x: ArrayLike) -> Array:
    given = np.asarray(floats(x, "x"), order="C")
    found = np.empty(given.shape)
    lib.maplines_elementary(function, given.size, pointer(given), pointer(found), ffi.NULL)
    return found
