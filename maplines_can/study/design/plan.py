"""Targets of a design, and plans: the widths of all signals of a message layout."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ...values.line import PARAMETERS
from ...wire.layout.signals import PARAMETER_SIGNALS
from .sensitivity import Width, inflation_width

Array = NDArray[np.float64]

#: The longest record that also fits into a CAN FD frame.
MAX_FRAMES = 8
INFLATION = "Inflation"


@dataclass(frozen=True)
class Targets:
    """Targets of a design.

    Args:
        frames: classic frames of a line; None for as few as ``max_kl`` needs.
        max_kl: largest KL divergence of the covered target, mean over each set [nat]; None for
            the least that the frames allow.
        ranges: ends of the mean's ranges by state; the others as in the project's own DBC.
        sigmas: greatest standard deviations by state; the others are twice the sets' greatest.
        keep_mean: leave the mean's widths as they are in the project's own DBC.
        max_lateral: largest effect of the mean's rounding on the lateral position at 80 m of a
            straight line [m].
        max_saturated: largest share of saturated lines of each set, which a range limits.

    Raises:
        ValueError: neither frames nor max_kl is given, or a value is out of range.
    """

    frames: int | None = None
    max_kl: float | None = None
    ranges: Mapping[str, float] = field(default_factory=dict)
    sigmas: Mapping[str, float] = field(default_factory=dict)
    keep_mean: bool = False
    max_lateral: float = 0.05
    max_saturated: float = 5e-3

    def __post_init__(self) -> None:
        if self.frames is None and self.max_kl is None:
            raise ValueError("frames or max_kl must be given: the length of a line, or its KL")
        if self.frames is not None and self.frames not in range(1, MAX_FRAMES + 1):
            raise ValueError(
                f"frames must be from 1 to {MAX_FRAMES}, as one CAN FD frame holds, "
                f"got {self.frames!r}"
            )
        for name in ("max_kl", "max_lateral", "max_saturated"):
            value = getattr(self, name)
            if value is not None and not 0 < value < np.inf:
                raise ValueError(f"{name} must be positive, got {value!r}")
        if self.max_saturated > 1:
            raise ValueError(f"max_saturated is a share, at most 1, got {self.max_saturated!r}")
        for what in ("ranges", "sigmas"):
            for state, value in getattr(self, what).items():
                if state not in PARAMETERS or not 0 < value < np.inf:
                    raise ValueError(
                        f"{what} must be positive numbers of {', '.join(PARAMETERS)}, "
                        f"got {state}={value!r}"
                    )
        if self.keep_mean and self.ranges:
            raise ValueError("ranges must not be given with keep_mean, which keeps them")


@dataclass(frozen=True)
class Prediction:
    """Figures of a plan as predicted by the sensitivities."""

    kl_mean: float  #: of the covered target, with inflation and saturation [nat]
    kl_p99: float  #: of the rounding and its inflation alone [nat]
    saturated: float  #: share of the lines of the set where it is greatest
    lateral_error: float  #: largest at 80 m on a straight line [m]
    blur: float  #: median of the set [nat]


@dataclass(frozen=True)
class WidthPlan:
    """Widths of the mean and of the covariance."""

    order: tuple[int, ...]  #: rows of the covariance, as indices into the mean
    mean: tuple[int, ...]  #: bits
    fields: Mapping[str, Width]  #: pivots, ratios and inflation, by signal
    price: float  #: of a share of 1 of lines beyond the end of a range [nat]

    @property
    def bits(self) -> int:
        """Number of bits of mean and covariance."""
        return sum(self.mean) + sum(width.bits for width in self.fields.values())

    @property
    def steps(self) -> tuple[Array, Array]:
        """(4,) of the pivots and (6,) of the ratios, row by row."""
        pivots = [self.fields[pivot].factor for pivot, _ in names_of(self.order)]
        ratios = [self.fields[ratio].factor for _, row in names_of(self.order) for ratio in row]
        return np.array(pivots), np.array(ratios)

    def changed(self, **fields: Width) -> WidthPlan:
        """Return a plan with other widths, and the inflation that their steps need."""
        plan = replace(self, fields={**self.fields, **fields})
        inflation = inflation_width(plan.fields[INFLATION].bits, *plan.steps)
        return replace(plan, fields={**plan.fields, INFLATION: inflation})


def names_of(order: Sequence[int]) -> Iterator[tuple[str, list[str]]]:
    """Yield the signals of each row: its pivot and its ratios."""
    for i, row in enumerate(order):
        name = PARAMETER_SIGNALS[row]
        yield f"Pivot{name}", [f"Ratio{name}{PARAMETER_SIGNALS[column]}" for column in order[:i]]
