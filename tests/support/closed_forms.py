"""Mean and variance of functions of a Gaussian with mean m and standard deviation s."""

from typing import Any

import numpy as np


def square(m: Any, s: Any) -> Any:
    """(mean, variance) of x^2."""
    return m**2 + s**2, 4 * m**2 * s**2 + 2 * s**4


def exponential(m: Any, s: Any) -> Any:
    """(mean, variance) of exp x: log-normal."""
    return np.exp(m + s**2 / 2), np.expm1(s**2) * np.exp(2 * m + s**2)


def sine(m: Any, s: Any) -> Any:
    """(mean, variance) of sin x."""
    mean = np.sin(m) * np.exp(-(s**2) / 2)
    return mean, (1 - np.exp(-2 * s**2) * np.cos(2 * m)) / 2 - mean**2


#: Functions and their closed forms.
CLOSED = [(np.square, square), (np.exp, exponential), (np.sin, sine)]
