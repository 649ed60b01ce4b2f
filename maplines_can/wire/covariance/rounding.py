"""Rounding of the means of lines to the steps of a message."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...values.fixed_order import congruence, inverse, lower_solution, product
from ..layout.signals import Signal
from .code import Array
from .joint import factor_or_identity

#: Order in which the parameters of a mean are rounded: C1, C0, YOff, Beta.
ORDER = (3, 2, 0, 1)
#: What is specific to a line counts up to about this standard deviation [m], so that the lateral
#: position of any line is exact to a centimetre.
LARGEST = 2.0**-8


def refined(signal: Signal, fine: Signal) -> Signal:
    """Return one signal for the sum of two, with the steps of the finer one."""
    values = fine.raw_max - fine.raw_min + 1
    ends = (signal.raw_min, signal.raw_max)
    low, high = ends if signal.factor > 0 else (-ends[1], -ends[0])
    return replace(
        signal,
        factor=fine.factor,
        offset=signal.offset + fine.offset,
        raw_min=values * low + fine.raw_min,
        raw_max=values * high + fine.raw_max,
    )


def split(
    raw: NDArray[np.int64], signal: Signal, fine: Signal
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the (L,) raw values of both signals of a ``refined`` one."""
    steps, rest = np.divmod(raw - fine.raw_min, fine.raw_max - fine.raw_min + 1)
    return steps if signal.factor > 0 else -steps, rest + fine.raw_min


def rounding_factor(own: Array, J: Array, resolution: float) -> Array:
    """Return the (L, 4, 4) Cholesky factors of what rounding errors are to be like, in ``ORDER``.

    An error is to be small where the line-specific covariance is the least: the covariance must
    cover the error, which would enlarge it most there. In metres, eigenvalues x of D_i are limited
    to x / (1 + x / LARGEST^2). If no factor exists, the parameters are rounded independently.

    Args:
        own: (L, 4, 4) line-specific covariances, positive semidefinite.
        J: (L, 4, 4) derivatives of ``seen_lines.bases``.
        resolution: standard deviation of the coefficients of J in addition [m].
    """
    identity, largest = np.eye(4), LARGEST**2
    in_metres = congruence(inverse(J), own)
    root = lower_solution(factor_or_identity(identity + in_metres / largest), identity)
    limited = (largest + resolution**2) * identity - largest * product(root.mT, root)
    cov = congruence(J, limited)
    return factor_or_identity(cov[:, ORDER][:, :, ORDER])


def rounded_means(
    signals: Sequence[Signal], means: Array, L: Array
) -> tuple[dict[str, NDArray[np.int64]], NDArray[np.bool_]]:
    """Return the (L,) raw values of means by signal, and which lines fit.

    Each parameter is rounded to its conditional mean given the errors of those before it, so the
    error of the lateral position is small all over the range, whatever the steps are.

    Args:
        signals: of y_off, beta, c0 and c1.
        means: (L, 4) lines.
        L: (L, 4, 4) of ``rounding_factor``.
    """
    raw: dict[str, NDArray[np.int64]] = {}
    fits = np.ones(len(means), dtype=bool)
    errors: list[Array] = []  # so far, in terms of L
    for row, state in enumerate(ORDER):
        signal, mean = signals[state], means[:, state]
        expected = np.zeros(len(means))
        for column, error in enumerate(errors):
            expected = expected + L[:, row, column] * error
        nearest = signal.raw(mean + expected)
        limited = signal.limited(nearest)
        fits &= nearest == limited
        raw[signal.name] = limited.astype(np.int64)
        error = signal.physical(limited) - mean
        errors.append((error - expected) / L[:, row, row])
    return raw, fits
