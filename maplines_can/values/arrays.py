"""Conversion of a caller's numbers to float arrays, with readable errors."""

from __future__ import annotations

import sys
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: The largest float, 1.8e308.
LARGEST = sys.float_info.max
#: Messages show an integer of more bits by its magnitude instead of its digits.
SHORT_BITS = 128


def floats(values: ArrayLike, name: str) -> NDArray[np.float64]:
    """Return the values as an array of floats, without a copy if they already are one.

    The message of an error has the name of the argument.

    Raises:
        ValueError: a number is complex, or is an integer beyond the largest float.

    >>> floats([1, 2.5], "x")
    array([1. , 2.5])
    >>> floats([0, 10**400], "x")
    Traceback (most recent call last):
    ...
    ValueError: x must be numbers from -1.8e+308 to 1.8e+308, got an integer of about 1e400
    """
    if getattr(getattr(values, "dtype", None), "kind", "") == "c":
        raise ValueError(f"{name} must be real, got {values!r}")
    try:
        return np.asarray(values, dtype=float)
    except OverflowError:
        given = np.asarray(values, dtype=object).ravel().tolist()
        worst = next(x for x in given if isinstance(x, int) and abs(x) > LARGEST)
        raise ValueError(
            f"{name} must be numbers from {-LARGEST:.2g} to {LARGEST:.2g}, got {number_text(worst)}"
        ) from None


def row_values(values: ArrayLike, n: int) -> NDArray[Any]:
    """Return the values of n rows: (n,), or (1,) if all have the same, which is checked once.

    Of no rows there are none.

    Raises:
        ValueError: the values are neither (n,) nor one for all.

    >>> row_values([3, 4], 2), row_values(3, 2), row_values(3, 0).shape
    (array([3, 4]), array([3]), (0,))
    """
    given = np.asarray(values)
    return given.reshape(1)[:n] if given.shape in ((), (1,)) else np.broadcast_to(given, n)


def is_plain(value: object) -> TypeGuard[float]:
    """Return whether a value is a float, or an integer of Python that is not beyond the floats.

    >>> is_plain(0.5), is_plain(10**400), is_plain(np.float32(0.5))
    (True, False, False)
    """
    if isinstance(value, float):
        return True
    return isinstance(value, int) and -LARGEST <= value <= LARGEST


def count_text(count: int, noun: str) -> str:
    """Return a number of things as text, for a reader.

    >>> count_text(1, "pose error"), count_text(0, "line")
    ('1 pose error', '0 lines')
    """
    return f"{count} {noun}{'s' * (count != 1)}"


def number_text(value: object) -> str:
    """Return the repr of a value, or the magnitude of an integer with too many digits to print.

    >>> number_text(0.5), number_text(-(10**400))
    ('0.5', 'an integer of about -1e400')
    """
    if isinstance(value, int) and value.bit_length() > SHORT_BITS:
        sign = "-" if value < 0 else ""
        return f"an integer of about {sign}1e{round(value.bit_length() * np.log10(2))}"
    return repr(value)
