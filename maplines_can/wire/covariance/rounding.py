"""Rounding of the means of lines to the steps of a message."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..layout.signals import Signal
from .code import Array

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


def rounded_means(
    signals: Sequence[Signal], means: Array, own: Array, J: Array, resolution: float
) -> tuple[dict[str, NDArray[np.int64]], NDArray[np.bool_]]:
    """Return the (L,) raw values of means by signal, and which lines fit.

    Each parameter is rounded to its conditional mean given the errors of those before it, so the
    error of the lateral position is small all over the range, whatever the steps are. It is the
    smallest where the line-specific covariance is the least: the covariance must cover the error,
    which would enlarge it most there.

    Args:
        signals: of y_off, beta, c0 and c1.
        means: (L, 4) lines.
        own: (L, 4, 4) line-specific covariances, positive semidefinite.
        J: (L, 4, 4) derivatives of ``seen_lines.bases``.
        resolution: standard deviation of the coefficients of J in addition [m].
    """
    inverse = np.linalg.inv(J)
    in_metres = inverse @ own @ inverse.swapaxes(1, 2)
    values, vectors = np.linalg.eigh((in_metres + in_metres.swapaxes(1, 2)) / 2)
    values = values.clip(0)
    size = values / (1 + values / LARGEST**2) + resolution**2
    root = J @ (vectors * np.sqrt(size)[:, None, :])
    cov = root @ root.swapaxes(1, 2)
    L = np.linalg.cholesky(cov[:, ORDER][:, :, ORDER])
    raw: dict[str, NDArray[np.int64]] = {}
    fits = np.ones(len(means), dtype=bool)
    z = np.zeros_like(means)  # the errors so far, in terms of L
    for row, state in enumerate(ORDER):
        signal, mean = signals[state], means[:, state]
        expected = (L[:, row, :row] * z[:, :row]).sum(axis=1)
        nearest = signal.raw(mean + expected)
        limited = signal.limited(nearest)
        fits &= nearest == limited
        raw[signal.name] = limited.astype(np.int64)
        error = signal.physical(limited) - mean
        z[:, row] = (error - expected) / L[:, row, row]
    return raw, fits
