"""Messages that say where a line lies: those of production cars, and this project's own.

Where a source does not say whether it sends coefficients of a polynomial or curvatures,

    y = c_0 + c_1 x + c_2 x^2 + c_3 x^3    or    y = c_0 + c_1 x + c_2 x^2/2 + c_3 x^3/6,

the first is assumed. Its steps have the greater effect.
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...values.line import PARAMETERS
from ...wire import Layout
from ...wire.layout.signals import PARAMETER_SIGNALS, Signal
from ..dbc.covariance_spec import covariance_signals

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Message:
    """Parameters of one line as a message sends them."""

    maker: str  #: of the car or camera
    name: str  #: with its CAN ID
    signals: tuple[Signal | None, ...]  #: of y_off, beta, c0, c1 or values for them; None: not sent
    polynomial: bool  #: sends tan(beta), c0/2 and c1/6, not beta, c0 and c1
    documented: bool  #: the source says which of the two
    uncertainty: str  #: what the message says about it
    source: str  #: of these figures
    certainty: str  #: how reliable they are
    distance: bool = False  #: sends |y_off|; the side follows from which line it is

    @property
    def bits(self) -> int:
        """Number of bits of the line's parameters."""
        return sum(signal.length for signal in self.signals if signal)

    def sent(self, lines: ArrayLike) -> Array:
        """Return the (..., 4) values of (..., 4) lines before rounding."""
        values = np.array(lines, dtype=float)
        if self.distance:
            values[..., 0] = np.abs(values[..., 0])
        if self.polynomial:
            values[..., 1] = np.tan(values[..., 1])
        return values / self._scale

    def read(self, values: ArrayLike, lines: ArrayLike) -> Array:
        """Return the (..., 4) lines of (..., 4) values; only the side is taken from ``lines``."""
        read = np.asarray(values, dtype=float) * self._scale
        if self.polynomial:
            read[..., 1] = np.arctan(read[..., 1])
        if self.distance:
            read[..., 0] = np.copysign(read[..., 0], np.asarray(lines, dtype=float)[..., 0])
        return read

    def rounded(self, lines: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Round lines to the values of the message.

        Returns:
            (..., 4) lines as they are read; a parameter that is not sent is 0.
            (..., 4) which parameters were out of range and were clipped.
        """
        values = self.sent(lines)
        clipped = np.zeros(values.shape, dtype=bool)
        for i, signal in enumerate(self.signals):
            if signal is None:
                values[..., i] = 0.0
                continue
            raw = signal.raw(values[..., i])
            limited = signal.limited(raw)
            clipped[..., i] = raw != limited
            values[..., i] = signal.physical(limited)
        return self.read(values, lines), clipped

    @property
    def _scale(self) -> Array:
        return np.array([1.0, 1.0, 2.0, 6.0] if self.polynomial else [1.0, 1.0, 1.0, 1.0])


def default_message(layout: Layout | None = None) -> Message:
    """Return the mean of this project's message, as its DBC describes it.

    Args:
        layout: by default that of ``dbc/maplines.dbc``.
    """
    layout = layout or Layout.from_dbc()
    covariance = sum(
        layout[spec.name].length for spec in covariance_signals(layout.covariance_code)
    )
    return Message(
        "this project",
        "MapLine",
        tuple(layout[name] for name in PARAMETER_SIGNALS),
        polynomial=False,
        documented=True,
        uncertainty=f"covariance, {covariance} b" if covariance else "none",
        source="the DBC",
        certainty="it is the contract",
    )


# The keys of a signal in messages.toml.
def _signal(
    name: str,
    *,
    bits: int,
    factor: float,
    offset: float = 0.0,
    unit: str = "",
    signed: bool = False,
    limits: tuple[float, float] = (-math.inf, math.inf),
) -> Signal:
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
    # A limit printed in decimals still admits the raw value that it stands for.
    first, last = (limits[0] - offset) / factor - 1e-6, (limits[1] - offset) / factor + 1e-6
    return Signal(
        name=name,
        start=0,  # the place in the frame does not matter here
        length=bits,
        big_endian=False,
        signed=signed,
        factor=factor,
        offset=offset,
        unit=unit,
        raw_min=low if low > first else math.ceil(first),
        raw_max=high if high < last else math.floor(last),
    )


def _message(table: dict[str, Any]) -> Message:
    signals = [table.pop(state, None) for state in PARAMETERS]
    given = zip(PARAMETERS, signals, strict=True)
    return Message(signals=tuple(spec and _signal(name, **spec) for name, spec in given), **table)


#: Messages of production cars, from public sources; ``messages.toml`` says which.
PRODUCTION = tuple(
    map(
        _message,
        tomllib.loads(files(__package__).joinpath("messages.toml").read_text("utf-8"))["messages"],
    )
)
