"""Covariances as raw values, and the check of the signals that hold exponents."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..layout.record_layout import RecordLayout
from ..layout.signals import OCTAVES, Signal

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Coded:
    """Covariances as raw values.

    Args:
        raw: (N,) values by signal.
        saturated: (N,) whether a value is at the end of its range.
        covered: (N,) for a covering code, whether the decoded covariance covers the target; for
            another code, whether no value was clipped. If False, the line must not be used.
    """

    raw: dict[str, NDArray[np.int64]]
    saturated: NDArray[np.bool_]
    covered: NDArray[np.bool_]

    def first(self) -> CodedOne:
        """Return the first one."""
        raw = {name: values.item(0) for name, values in self.raw.items()}
        return CodedOne(raw, self.saturated.item(0), self.covered.item(0))


class CodedOne(NamedTuple):
    """One covariance as raw values; see ``Coded``."""

    raw: dict[str, int]
    saturated: bool
    covered: bool


def check_octaves(layout: RecordLayout, signals: Sequence[Signal]) -> None:
    """Check that no bits of these signals, which hold exponents of 2, can overflow a float.

    Raises:
        LayoutError: a signal is not within ``OCTAVES``.
    """
    for signal in signals:
        OCTAVES.check(signal, layout.source)
