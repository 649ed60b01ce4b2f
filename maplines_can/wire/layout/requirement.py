"""Requirement on a signal, and requirements that many signals share."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...values.errors import LayoutError
from .signals import Signal

#: Most bits of an integer that a double represents exactly.
EXACT_BITS = 53
#: Least factor, and greatest physical value of any bits; their squares are still finite doubles.
MIN_FACTOR, FARTHEST = 1e-30, 1e30
#: Greatest exponent of 2 that a level may hold, so that its square is finite.
FARTHEST_OCTAVE = 200
#: Greatest magnitude of the exponent of 2 of a spacing: a line has not too many points.
FARTHEST_SPACING_OCTAVE = 10
#: Unit of an exponent of 2.
OCTAVE = "octave"


@dataclass(frozen=True)
class Requirement:
    """A property that a signal must have.

    Args:
        needs: the property, which completes "the signal needs ...".
        met: whether a signal has it.
        cure: what to change in the DBC.
    """

    needs: str
    met: Callable[[Signal], bool]
    cure: str


@dataclass(frozen=True)
class Relation:
    """A property that several signals of a record must have together.

    Args:
        name: the signal to change.
        needs: the property, which completes "the signal needs ...".
        met: whether the signals of a record have it.
        cure: what to change in the DBC.
    """

    name: str
    needs: str
    met: Callable[[Mapping[str, Signal]], bool]
    cure: str


def unit(*units: str) -> Requirement:
    """Return the requirement that the unit is one of these, or that there is none."""
    return Requirement(
        f'the unit "{units[0]}", or none',
        lambda signal: signal.unit in ("", *units),
        "convert factor, offset and range to it",
    )


def length(bits: int) -> Requirement:
    """Return the requirement of this number of bits."""
    return Requirement(f"{bits} bits", lambda signal: signal.length == bits, f"give it {bits} bits")


def holds(low: int, high: int, what: str = "") -> Requirement:
    """Return the requirement that the range contains all values from ``low`` to ``high``."""
    values = f"{low} to {high}" if low < high else f"{low}"
    return Requirement(
        f"a range that holds {values}{what}",
        lambda signal: _within(signal, low) and _within(signal, high),
        "widen the signal and its range [min|max]",
    )


def _within(signal: Signal, physical: float) -> bool:
    return bool(signal.raw_min <= signal.raw(physical) <= signal.raw_max)


INTEGER = Requirement("an integer type", lambda s: not s.is_float, "remove its SIG_VALTYPE_")
UNSIGNED = Requirement(
    "an unsigned type", lambda s: not s.signed, "write + for the - after @0 or @1"
)
EXACT = Requirement(
    f"at most {EXACT_BITS} bits",
    lambda s: s.length <= EXACT_BITS,
    "make it narrower, since a double represents no more bits exactly",
)
FINITE = Requirement(
    f"a factor other than 0, from {MIN_FACTOR:g} in magnitude, and values up to {FARTHEST:g}",
    lambda s: abs(s.factor) >= MIN_FACTOR and bool(np.abs(s.reach).max() <= FARTHEST),
    "correct factor and offset",
)
SOME_RANGE = Requirement(
    "a range [min|max] that contains a value of its bits",
    lambda s: s.raw_min <= s.raw_max,
    "correct min and max, or write [0|0] for the range of all bits",
)
POSITIVE = Requirement(
    "a positive factor", lambda s: s.factor > 0, "change the sign of the factor and the offset"
)
IDENTITY = Requirement(
    "factor 1 and offset 0", lambda s: (s.factor, s.offset) == (1, 0), "write (1,0)"
)
WHOLE_RANGE = Requirement(
    "the range of all its bits",
    lambda s: (s.raw_min, s.raw_max) == s.all_raw,
    "widen its range [min|max], or write [0|0]",
)

#: Requirements of a physical value, which is rounded to a step.
QUANTITY = (INTEGER, EXACT, FINITE, SOME_RANGE)
#: Requirements of a number that is sent unchanged.
NUMBER = (INTEGER, UNSIGNED, IDENTITY, EXACT, SOME_RANGE)
#: Requirements of whole bytes.
BYTES = (INTEGER, UNSIGNED, IDENTITY)


def _octaves(signal: Signal) -> list[float]:
    """Return the exponents of 2 of the least and the greatest spacing of any bits.

    They are infinite if the spacing is not positive.
    """
    if signal.unit == OCTAVE:
        return [*signal.reach]
    return [math.log2(value) if value > 0 else math.inf for value in signal.reach]


#: Requirements of the exponent of 2 of a standard deviation or a time.
SCALE = (
    *QUANTITY,
    UNSIGNED,
    POSITIVE,
    unit(OCTAVE),
    Requirement(
        f"values from -{FARTHEST_OCTAVE} to {FARTHEST_OCTAVE} for any bits",
        lambda s: bool(np.abs(s.reach).max() <= FARTHEST_OCTAVE),
        "correct factor and offset",
    ),
)
#: Requirements of a scale whose raw value 0 means that there is none, or that it is unknown.
LEVEL = (
    *SCALE,
    Requirement(
        "a range that holds the raw values 0 and 1",
        lambda s: s.raw_min <= 0 and s.raw_max >= 1,
        "widen the signal and its range [min|max]",
    ),
)
#: Requirements of a spacing of points, in halves of a line's length.
SPACING = (
    *QUANTITY,
    UNSIGNED,
    POSITIVE,
    Requirement(
        f'the unit "{OCTAVE}" for the exponent of 2 of a distance, or "1" for a distance',
        lambda s: s.unit in (OCTAVE, "1"),
        "write one of them",
    ),
    Requirement(
        f"distances from 2^-{FARTHEST_SPACING_OCTAVE} to 2^{FARTHEST_SPACING_OCTAVE} for any bits",
        lambda s: max(map(abs, _octaves(s))) <= FARTHEST_SPACING_OCTAVE,
        "correct factor and offset",
    ),
)
#: Requirement of an end of a range that is sent exactly.
WHOLE_METRES = Requirement(
    "factor 1 and a whole offset",
    lambda s: s.factor == 1 and s.offset.is_integer(),
    "write (1,-32) for metres from -32 on",
)
#: Requirements of a distance in whole metres.
DISTANCE = (
    *QUANTITY,
    UNSIGNED,
    unit("m"),
    Requirement("factor 1 and offset 0", lambda s: (s.factor, s.offset) == (1, 0), "write (1,0)"),
)


def check(signal: Signal, requirements: Sequence[Requirement], source: str) -> None:
    """Check that a signal meets its requirements.

    Raises:
        LayoutError: it does not meet a requirement.
    """
    for requirement in requirements:
        if not requirement.met(signal):
            raise LayoutError(
                f"{source}: signal {signal.name} is {in_dbc(signal)}, but it needs "
                f"{requirement.needs}; {requirement.cure}"
            )


def in_dbc(signal: Signal) -> str:
    """Return a signal in the notation of a DBC, with its start bit in the record."""
    kind, low, high = f" (float{signal.length})", "", ""
    if not signal.is_float:
        kind = ""
        low, high = (_plain(signal.physical_one(raw)) for raw in (signal.raw_min, signal.raw_max))
    order, sign = int(not signal.big_endian), "-" if signal.signed else "+"
    return (
        f"{signal.start}|{signal.length}@{order}{sign}"
        f' ({_plain(signal.factor)},{_plain(signal.offset)}) [{low}|{high}] "{signal.unit}"{kind}'
    )


def _plain(number: float) -> str:
    return f"{number:.12g}"
