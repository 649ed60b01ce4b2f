"""Signals of the records, and what a DBC may change of each.

``COMPLETE_RECORD``, ``CONDITIONAL_RECORD``, ``POSE_RECORD``, ``OF_SLOT``, ``SCENE_RECORD``,
``SCENE_LINE`` and ``TRAILER`` list the signals. A record must have each signal of its list, and a
DBC may change what the bounds beside it leave free; besides, it chooses the byte order and the
place of each signal.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

from ...values.errors import LayoutError
from ...values.line import Slot
from .signal import Signal as Signal

#: Bytes of a page, the payload of one classic CAN frame.
PAGE_BYTES = 8


def slot_title(slot: Slot) -> str:
    """Return the name of a slot as names of signals and messages have it.

    >>> slot_title(Slot.EGO_LEFT)
    'EgoLeft'
    """
    return "".join(word.capitalize() for word in slot.name.split("_"))


# ---- what a DBC may change of a signal -----------------------------------------------------

#: Most bits of an integer that a double represents exactly.
EXACT_BITS = 53
#: Least factor, and greatest physical value of any bits; their squares are still finite doubles.
MIN_FACTOR, FARTHEST = 1e-30, 1e30


class Property(NamedTuple):
    """Something that a signal needs."""

    needs: str  #: completes "the signal needs ..."
    is_met: bool
    cure: str  #: what to change in the DBC


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """What a DBC may change of a signal: anything within these bounds.

    Each signal is an integer whose range [min|max] is that of all its bits.

    Args:
        units: allowed units, of which "" is none; any without them.
        bits: fewest and most bits.
        unsigned: it must be unsigned.
        factor: the only factor; by default any positive one.
        offset: the only offset; by default any.
        whole_offset: the offset must be a whole number.
        values: least and greatest physical value that any bits may have.
        why: reason for the number of bits, which completes "since ...".
    """

    units: tuple[str, ...] = ()
    bits: tuple[int, int] = (1, EXACT_BITS)
    unsigned: bool = False
    factor: float | None = None
    offset: float | None = None
    whole_offset: bool = False
    values: tuple[float, float] = (-FARTHEST, FARTHEST)
    why: str = ""

    def properties(self, signal: Signal) -> Iterator[Property]:
        """Yield what a signal needs, whether it has it, and the cure."""
        yield Property("an integer type", not signal.is_float, "remove its SIG_VALTYPE_")
        is_met = not (self.unsigned and signal.signed)
        yield Property("an unsigned type", is_met, "write + for the - after @0 or @1")
        names = ", ".join(f'"{unit}"' for unit in self.units if unit)
        needs = f"the unit {names}{', or none' if '' in self.units else ''}"
        is_met = not self.units or signal.unit in self.units
        yield Property(needs, is_met, "convert factor and offset to it")
        least, most = self.bits
        needs = f"{least} to {most} bits" if least < most else f"{least} bits"
        cure = f"since {self.why}" if self.why else "change its length"
        yield Property(needs, least <= signal.length <= most, cure)
        yield self._conversion(signal)
        low, high = self.values
        needs = f"values from {low:g} to {high:g} for any bits"
        is_met = low <= signal.reach[0] and signal.reach[1] <= high
        yield Property(needs, is_met, "correct factor and offset")
        is_met = (signal.raw_min, signal.raw_max) == signal.all_raw
        cure = "take fewer bits for a narrower range, or write [0|0]"
        yield Property("the range [min|max] of all its bits", is_met, cure)

    def _conversion(self, signal: Signal) -> Property:
        """Return what factor and offset need."""
        needs = f"a positive factor of {MIN_FACTOR:g} or more"
        is_met, cure = signal.factor >= MIN_FACTOR, "correct factor and offset"
        if self.factor is not None:
            needs, is_met = f"factor {self.factor:g}", signal.factor == self.factor
        if self.offset is not None:
            needs += f" and offset {self.offset:g}"
            is_met = is_met and signal.offset == self.offset
        elif self.whole_offset:
            needs += " and a whole offset"
            is_met = is_met and float(signal.offset).is_integer()
        if self.factor is not None and self.offset is not None:
            cure = f"write ({self.factor:g},{self.offset:g})"
        return Property(needs, is_met, cure)

    def check(self, signal: Signal, source: str) -> None:
        """Check that a signal is within the bounds.

        Raises:
            LayoutError: it is not.
        """
        for needs, is_met, cure in self.properties(signal):
            if not is_met:
                raise LayoutError(
                    f"{source}: signal {signal.dbc_name} is {signal}, but it needs {needs}; {cure}"
                )


def _count(bits: int, most: int = EXACT_BITS, why: str = "") -> Bounds:
    """Return the bounds of a number that is sent unchanged."""
    return Bounds(bits=(bits, most), unsigned=True, factor=1, offset=0, why=why)


def _quantity(unit: str) -> Bounds:
    """Return the bounds of a physical value, which is rounded to a step."""
    return Bounds(units=(unit, ""))


#: Unit of an exponent of 2, and the greatest one, whose square and products of four are finite.
OCTAVE, FARTHEST_OCTAVE = "octave", 200
#: Bounds of an exponent of 2, and of the exponent of a scale whose raw value 0 means none; that of
#: a scale has a table.
OCTAVES = Bounds(units=(OCTAVE, ""), values=(-FARTHEST_OCTAVE, FARTHEST_OCTAVE))
_LEVEL = replace(OCTAVES, bits=(1, 16), unsigned=True)
#: Bounds of an entry of a Cholesky factor; the covariance code bounds all of them together.
RATIO = Bounds(units=("1", "-", ""))
#: Metres that are sent exactly.
_WHOLE_METRES = Bounds(units=("m", ""), factor=1, whole_offset=True)
_METRES = Bounds(units=("m", ""), unsigned=True, factor=1, offset=0)

# ---- the signals of each record ------------------------------------------------------------

#: Signals that every page repeats: the number of the page, and of the transfer it belongs to.
PAGE, TRANSFER_ID = "Page", "TransferId"
#: Prefix of both in the pose error, so that each name has one definition in a DBC: formats such as
#: SYM have no more. Without it, they are read, too.
POSE_PREFIX = "Pose"
_PAGES = {PAGE: _count(1), TRANSFER_ID: _count(1)}
_PROTECTION = {
    "Crc": _count(16, 16),
    "Counter": _count(4, why="with fewer bits lost and late records look the same"),
}
_MEAN = {
    "YOff": _quantity("m"),
    "Beta": _quantity("rad"),
    "C0": _quantity("1/m"),
    "C1": _quantity("1/m^2"),
}
_AGE = Bounds(units=("ms", ""), bits=(2, EXACT_BITS), values=(0, FARTHEST))
#: Record of a line that has all of its covariance, but for the signals of the covariance code.
COMPLETE_RECORD: Mapping[str, Bounds] = {
    **_PROTECTION,
    **_PAGES,
    "Status": _count(3, why="it has six values"),
    "Kind": _count(3, why="it has eight values"),
    "XMin": _quantity("m"),
    "XMax": _quantity("m"),
    "Age": _AGE,
    "ComponentIndex": _count(1),
    "ComponentCount": Bounds(unsigned=True, factor=1, offset=1),
    "ComponentWeight": Bounds(units=("1", "-", ""), unsigned=True),
    **_MEAN,
}
#: End of the names of the signals that a conditional record has with a covariance: what is added
#: to each signal of the mean.
FINE = "Fine"
_FINE = {f"{name}{FINE}": replace(bounds, offset=0) for name, bounds in _MEAN.items()}
#: Levels of the line-specific covariance.
_OWN = {
    "OwnLateral": _LEVEL,
    "OwnPoints": _LEVEL,
    "OwnShape": replace(_LEVEL, units=(OCTAVE,), values=(-10, 10)),  # else too many points
}
#: Record of a line whose covariance is conditional on the pose error.
CONDITIONAL_RECORD: Mapping[str, Bounds] = {
    **_PROTECTION,
    **_PAGES,
    "Kind": COMPLETE_RECORD["Kind"],
    "XMin": _WHOLE_METRES,
    "XMax": _WHOLE_METRES,
    "HasCovariance": _count(1),
    **_OWN,
    "Quartic": _quantity("m"),
    **_FINE,
    **_MEAN,
}
#: What a record of the pose error states of it besides its covariance.
_POSE = {"Age": _AGE, "CorrelationTime": _LEVEL, "MapOffset": _LEVEL, "MapHeading": _LEVEL}
#: Record of the pose error.
POSE_RECORD: Mapping[str, Bounds] = {**_PROTECTION, **_PAGES, **_POSE}
#: Counter of a slot in the pose error, after the name of the slot.
SLOT_COUNTER = _count(3, why="with fewer bits lines of other cycles look as if they belonged to it")
#: Levels of a slot in the pose error beside complete records, after the name of the slot.
OF_SLOT: Mapping[str, Bounds] = {
    **_OWN,
    "OwnShape": replace(_LEVEL, units=("1",), values=(2**-10, 2**10)),
    "Quartic": _quantity("m"),
    "FitBehind": _METRES,
    "FitAhead": _METRES,
}
#: Record of a whole scene, but for its lines; it has no pages.
SCENE_RECORD: Mapping[str, Bounds] = {
    **_PROTECTION,
    **_POSE,
    "SceneCounter": _count(3, why="with fewer bits records of other cycles look as if they joined"),
}
#: Growth of the lateral level along the line.
TILT = "OwnTilt"
#: Line of a whole scene. The names follow the slot, or ``LINE`` and the number of the place.
SCENE_LINE: Mapping[str, Bounds] = {
    "Kind": _count(4, why="it has thirteen values"),
    "XMin": _WHOLE_METRES,
    "XMax": _WHOLE_METRES,
    **_OWN,
    TILT: _count(2, 2),
    **_MEAN,
}
#: Start of the names of a line that names its slot, before the number of its place, from 1.
LINE = "Line"
#: Slot of such a line.
SLOT = "Slot"
SLOT_BOUNDS = _count(3, 3)
#: Signals at the end of an authenticated message, in this order.
TRAILER: Mapping[str, Bounds] = {
    "KeyId": _count(8, 8),
    "Freshness": replace(
        _count(24, 56, "2 bytes of microseconds repeat after 65 ms, 3 bytes after 16.8 s"),
        units=("us", ""),
    ),
    "Mac": _count(8, 64),
}


def of_slot(slot: Slot) -> dict[str, Bounds]:
    """Return the bounds of the signals of a slot in the pose error: its counter and its levels."""
    own = {"Counter": SLOT_COUNTER, **OF_SLOT}
    return {f"{slot_title(slot)}{name}": bounds for name, bounds in own.items()}


#: Signals of the mean, in the order of the line's parameters.
PARAMETER_SIGNALS = tuple(_MEAN)
FINE_SIGNALS, OWN_SIGNALS, SLOT_SIGNALS = tuple(_FINE), tuple(_OWN), tuple(OF_SLOT)
#: Rows of the covariance of the pose error.
POSE_ROWS = ("Along", "Across", "Heading")
#: Largest size of the signals of ``TRAILER`` [byte].
SECURED_SIGNALS = {name: bounds.bits[1] // 8 for name, bounds in TRAILER.items()}
