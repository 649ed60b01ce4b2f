"""Base of the codes that decode arrays only."""

from __future__ import annotations

from collections.abc import Mapping
from typing import final

import numpy as np

from ...wire.covariance.code import Array, CovarianceCode

__all__ = ["BatchCode"]


class BatchCode(CovarianceCode):
    """A code whose single records are decoded as batches of one."""

    @final
    def decode_one(self, raw: Mapping[str, int]) -> Array:
        names = (signal.name for signal in self.signals)
        return self.decode({name: np.array([raw[name]]) for name in names})[0]
