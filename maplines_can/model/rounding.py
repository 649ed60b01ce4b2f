"""Physical values as raw ones: to the nearest step, up or down, and within a range."""

from __future__ import annotations

import math

from ..wire.layout.signals import Signal

#: Tolerance for the floating-point error of the division before directed rounding [steps].
SLACK = 1e-9


def rounded(x: float) -> float:
    """Return the nearest whole number, halves to even; infinite numbers and NaN as they are."""
    return float(round(x)) if math.isfinite(x) else x


def nearest(signal: Signal, value: float) -> float:
    """Return the nearest raw value, which may be out of range, or infinite."""
    return rounded((value - signal.offset) / signal.factor)


def limited(signal: Signal, raw: float) -> int:
    """Return a raw value within the range of its signal."""
    return int(min(max(raw, signal.raw_min), signal.raw_max))


def above(signal: Signal, value: float) -> float:
    """Return the least raw value that is not below a value; it may be out of range."""
    steps = (value - signal.offset) / signal.factor - SLACK
    raw = float(math.ceil(steps)) if math.isfinite(steps) else steps
    return raw + 1 if raw * signal.factor + signal.offset < value else raw


def below(signal: Signal, value: float) -> float:
    """Return the greatest raw value that is not above a value; it may be out of range."""
    steps = (value - signal.offset) / signal.factor + SLACK
    raw = float(math.floor(steps)) if math.isfinite(steps) else steps
    return raw - 1 if raw * signal.factor + signal.offset > value else raw
