"""What the codes for comparison share."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import final

import numpy as np

from ...wire.covariance.code import Array, CovarianceCode
from ...wire.layout.message_layout import Layout
from ...wire.layout.signals import Bounds, Signal


class BatchCode(CovarianceCode):
    """Base of codes that decode a single record as a batch of one."""

    @final
    def decode_one(self, raw: Mapping[str, int]) -> Array:
        names = (signal.name for signal in self.signals)
        return self.decode({name: np.array([raw[name]]) for name in names})[0]


#: Bounds of an entry of a matrix.
ENTRY = Bounds(offset=0)


def check_linear(layout: Layout, signals: Iterable[Signal]) -> None:
    """Raise ``LayoutError`` unless the signals are within ``ENTRY``."""
    for signal in signals:
        ENTRY.check(signal, layout.source)
