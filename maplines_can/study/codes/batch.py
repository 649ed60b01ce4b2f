"""Base of the codes that decode arrays only, and rounding that several codes share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import final

import numpy as np
from numpy.typing import NDArray

from ...wire.covariance.code import Array, CovarianceCode
from ...wire.message.signals import Signal

__all__ = ["BatchCode", "nearest_raw"]


class BatchCode(CovarianceCode):
    """A code whose single records are decoded as batches of one."""

    @final
    def decode_one(self, raw: Mapping[str, int]) -> Array:
        names = (signal.name for signal in self.signals)
        return self.decode({name: np.array([raw[name]]) for name in names})[0]


def nearest_raw(signal: Signal, physical: Array) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the (N,) nearest raw values within the range, and which were clipped to it."""
    nearest = signal.raw(physical)
    limited = signal.limited(nearest)
    return limited.astype(np.int64), nearest != limited
