"""Signals of a message of any DBC as raw values: places, limits, start values and pages."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterable, Iterator, Mapping
from decimal import Decimal, InvalidOperation
from fractions import Fraction
from typing import TYPE_CHECKING

from ..values.errors import RestbusError
from .toml_tables import nearest, number

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

#: Greatest float of each length, and its format of the module struct.
FLOATS = {
    16: (65504.0, "e"),
    32: (3.4028234663852886e38, "f"),
    64: (1.7976931348623157e308, "d"),
}

#: Longest signal that can be set: its limits are floats.
MOST_BITS = 1000
#: Raw value: a whole number, or that of a float.
Raw = int | float

#: Attribute with the texts of the start values, and the definition of their own attribute.
_TEXTS = "GenSigStartValueText"
_DEFINITION = re.compile(r'(BA_DEF_\s+SG_\s+"GenSigStartValue")\s(?:"[^"]*"|[^";])*;')


def with_exact_starts(dbc: str) -> str:
    """Return the text of a DBC from which `Field` reads start values.

    They are texts of another attribute, for cantools makes floats of them, which do not hold 64
    bits, or refuses the DBC if the attribute is a text.
    """
    return _DEFINITION.sub(r"\1 STRING ;", dbc).replace('"GenSigStartValue"', f'"{_TEXTS}"')


class Field:
    """Signal of a message: its bits in the payload, and the raw values that it can have.

    Args:
        signal: of the DBC.
        message: to which it belongs.
        children: signals on the pages of this one, if it is a multiplexer.
    """

    def __init__(self, signal: Signal, message: Message, children: Iterable[Signal] = ()) -> None:
        self.signal, self.name = signal, signal.name
        self._bytes = message.length
        self._is_motorola = signal.byte_order == "big_endian"
        from cantools.database.utils import start_bit

        free = 8 * message.length - start_bit(signal) - signal.length
        self._shift = free if self._is_motorola else signal.start
        bits = signal.length
        if signal.is_float:
            most = FLOATS[bits][0] if bits in FLOATS else 0.0
            self._raw_limits: tuple[Raw, Raw] = (-most, most)
        else:
            self._raw_limits = (-(1 << bits - 1), (1 << bits - 1) - 1) if signal.is_signed else (
                0, (1 << bits) - 1
            )  # fmt: skip
        #: Its bits in the payload, which is read as one Intel number; 0 if it cannot be sent.
        self.mask = 0
        if free >= 0 and (not signal.is_float or bits in FLOATS):
            self.mask = self._placed((1 << bits) - 1)
        #: Pages on which it is, of the signal that selects the page.
        self.ids = frozenset(signal.multiplexer_ids or ())
        used = sorted({page for child in children for page in child.multiplexer_ids or ()})
        named = sorted(map(int, signal.choices or ()))
        pages = (used, named) if signal.is_multiplexer else ([], [])
        used, named = ([page for page in each if self._holds(page)] for each in pages)
        #: Pages to be sent in turn: those that have signals; empty if it selects no page.
        self.turns = used or named
        #: Pages that exist: those that have signals, or a name.
        self.pages = frozenset(used + named)

    def place(self, payload: int, raw: Raw) -> int:
        """Return a payload, read as one Intel number, with a raw value at its place."""
        signal = self.signal
        if not self.mask:
            return payload
        if signal.is_float:
            code = FLOATS[signal.length][1]
            bits = int.from_bytes(struct.pack(f"<{code}", raw), "little")
        else:
            bits = int(raw) & ((1 << signal.length) - 1)
        return payload & ~self.mask | self._placed(bits)

    def raw(self, name: str, value: object) -> Raw:
        """Return the raw value of a number, or of the name of a value.

        Args:
            name: of message and signal, for errors.
            value: a physical value, or a name of the DBC's value table.

        Raises:
            RestbusError: the signal cannot have the value.
        """
        if not self.mask:
            raise RestbusError(f"{name} cannot be set: {self.unsendable}; correct the DBC")
        raw = self._named(name, value) if isinstance(value, str) else self._checked(name, value)
        if not self._holds(raw):
            raise RestbusError(f"{name}: {value!r} is {raw}, no raw value of its {self._bits}")
        return self.page(name, raw)

    def page(self, name: str, raw: Raw) -> Raw:
        """Return a raw value that selects a page that exists, or any of a signal that selects none.

        Raises:
            RestbusError: there is no such page.
        """
        if self.pages and raw not in self.pages:
            pages = ", ".join(map(str, sorted(self.pages)[:20]))
            raise RestbusError(
                f"{name} selects a page, and {raw} is none of the DBC; its pages are {pages}"
                + (", ..." if len(self.pages) > 20 else "")
            )
        return raw

    def nearest_raw(self, value: float) -> Raw:
        """Return the raw value that is nearest to a physical one, as cantools rounds it."""
        signal = self.signal
        raw: Raw = signal.conversion.numeric_scaled_to_raw(value)
        if abs(raw) >= 1 << 53:  # a float does not hold it
            # The factor is the decimal number that the DBC has.
            offset, scale = (Fraction(str(part)) for part in (signal.offset, signal.scale))
            raw = round((value - offset) / scale)
        return raw

    def physical(self, raw: Raw) -> float:
        """Return the physical value of a raw one."""
        return self.signal.offset + raw * self.signal.scale

    @property
    def unsendable(self) -> str:
        """Why it has no place in the payload; empty if it has one."""
        if self.mask:
            return ""
        signal = self.signal
        if signal.is_float and signal.length not in FLOATS:
            return f"it is a float of {signal.length} bits"
        return f"its bits lie beyond the {self._bytes} bytes of the message"

    def stated(self, where: str) -> Raw | None:
        """Return the start value that the DBC states (GenSigStartValue, raw); None if none.

        Raises:
            RestbusError: it is no raw value of the signal.
        """
        own = self.signal.dbc.attributes.get(_TEXTS)
        if own is None:
            return None
        text = str(own.value)
        value = self._start(text)
        if value is None or not self._holds(value):
            raise RestbusError(
                f"{where}: its start value in the DBC (GenSigStartValue), {text!r}, is no raw "
                f"value of its {self._bits}; correct the DBC, or set it in the configuration"
            )
        return value

    @property
    def unset(self) -> Raw:
        """Raw value of a signal for which the DBC states none.

        It is the default of the attribute, else the physical 0, else 0: the first that it can have.
        """
        definition = self.signal.dbc.attribute_definitions.get(_TEXTS)
        default = self._start(str(getattr(definition, "default_value", None)))
        if default is not None and self._holds(default):
            return default
        try:
            raw = self._checked("", 0)
        except RestbusError:
            return 0
        return raw if self._holds(raw) else 0

    def _start(self, text: str) -> Raw | None:
        """Return the raw value of the text of a start value; None if it is no number."""
        try:
            exact = Decimal(int(text, 16)) if text[:2] == "0x" else Decimal(text)
            is_whole = exact == int(exact) and not self.signal.is_float
            value = int(exact) if is_whole else float(exact)
        except (InvalidOperation, ValueError, OverflowError):
            return None
        # Tools write 15 digits, which round the greatest value of 64 bits or of a float up.
        ends = {Decimal(f"{Decimal(end):.14e}"): end for end in self._raw_limits}
        return value if self._holds(value) else ends.get(exact, value)

    @property
    def _bits(self) -> str:
        """Its length and raw values, for errors."""
        low, high = (f"{Decimal(end):.20g}" for end in self._raw_limits)
        return f"{self.signal.length} bits, [{low}, {high}]"

    def _placed(self, bits: int) -> int:
        placed = bits << self._shift
        if self._is_motorola:
            return int.from_bytes(placed.to_bytes(self._bytes, "big"), "little")
        return placed

    def _holds(self, raw: Raw) -> bool:
        low, high = self._raw_limits
        return low <= raw <= high and (self.signal.is_float or raw == int(raw))

    def _named(self, name: str, value: str) -> Raw:
        choices: Mapping[int, object] = self.signal.choices or {}
        found = [raw for raw, text in choices.items() if str(text) == value]
        if len(found) == 1:
            return int(found[0])
        if found:
            numbers = " and ".join(map(str, sorted(found)))
            raise RestbusError(f"{name}: {value!r} is the name of {numbers}; give the number")
        hint = nearest(value, map(str, choices.values()), "its named values are")
        raise RestbusError(f"{name} must be a number or a named value, got {value!r}{hint}")

    def _checked(self, name: str, value: object) -> Raw:
        """Return the raw value of a number within the limits."""
        low, high = self._limits(name)
        value = int(value) if isinstance(value, bool) else value
        is_number = isinstance(value, int | float) and abs(value) < math.inf
        if not is_number or not any(self._near(value, (low, high))):  # type: ignore[arg-type]
            number(name, value, low, high, self.signal.unit or "")
        return self.nearest_raw(value)  # type: ignore[arg-type]

    def _near(self, value: float, ends: Iterable[float]) -> Iterator[bool]:
        """Yield whether a value is that of an end: offset + n * factor and ranges are rounded."""
        for end in ends:
            slack = max(1e-6 * abs(self.signal.scale), 1e-14 * abs(end))
            yield end - slack <= value <= end + slack

    def _limits(self, name: str) -> tuple[float, float]:
        """Return the physical values that it can have: by its bits, and by the DBC's range."""
        signal, cure = self.signal, "; correct the DBC"
        if not signal.scale:
            raise RestbusError(f"{name} cannot be set: its factor in the DBC is 0{cure}")
        if signal.length > MOST_BITS:
            raise RestbusError(f"{name} cannot be set: it has more than {MOST_BITS} bits")
        low, high = sorted(self.physical(raw) for raw in self._raw_limits)
        least, most = signal.minimum, signal.maximum
        if least is None or most is None or least == most == 0:  # no range
            return low, high
        if least > most:
            raise RestbusError(
                f"{name} cannot be set: its range in the DBC is reversed, [{least}|{most}]{cure}"
            )
        if max(low, least) > min(high, most):
            raise RestbusError(
                f"{name} cannot be set: its range in the DBC, [{least}|{most}], has none of the "
                f"values of its {signal.length} bits, [{low:.12g}, {high:.12g}]{cure}"
            )
        return max(low, least), min(high, most)


class Fields:
    """Signals of a message: by name, by page, and which share bits.

    Args:
        message: of the DBC.
    """

    def __init__(self, message: Message) -> None:
        self.name = message.name
        below: dict[str | None, list[Signal]] = {}
        for signal in message.signals:
            below.setdefault(signal.multiplexer_signal, []).append(signal)
        self.all = [Field(s, message, below.get(s.name, ())) for s in message.signals]
        self._below: dict[str | None, list[Field]] = {}
        for field in self.all:
            self._below.setdefault(field.signal.multiplexer_signal, []).append(field)
        # The pages on which each signal is, by the name of the multiplexer; all that are sent.
        self._pages: dict[Field, dict[str, frozenset[int]]] = {}
        self._find(None, {})

    def named(self, name: str, where: str) -> Field:
        """Return the signal of a name.

        Raises:
            RestbusError: there is none, or there are two, or it is never sent.
        """
        found = [field for field in self.all if field.name == name]
        if not found:
            hint = nearest(name, [field.name for field in self.all], "its signals are")
            raise RestbusError(f"{where}: {self.name} has no signal {name!r}{hint}")
        if len(found) > 1:
            raise RestbusError(
                f"{where}: {self.name} has {len(found)} signals {name!r}; rename them in the DBC"
            )
        if found[0] not in self._pages:
            raise RestbusError(f"{where}: is on no page that {self.name} can have; correct the DBC")
        return found[0]

    def add(self, field: Field) -> None:
        """Add a signal that the DBC does not have; it is on no page."""
        self.all.append(field)
        self._below.setdefault(None, []).append(field)
        self._pages[field] = {}

    def present(self, raws: Mapping[Field, Raw]) -> Iterator[Field]:
        """Yield the signals on the pages that raw values select, a multiplexer before its pages.

        The raw value of a multiplexer is read after it was yielded.
        """
        return self._present(None, None, raws)

    def shared(self, one: Field, other: Field) -> int:
        """Return the bits that two signals share on a page, as a mask; 0 if none."""
        if one is other or not {one, other} <= self._pages.keys():
            return 0
        mine, its = self._pages[one], self._pages[other]
        if any(mine[name].isdisjoint(its[name]) for name in mine.keys() & its):
            return 0
        return one.mask & other.mask

    def _present(
        self, multiplexer: str | None, page: Raw | None, raws: Mapping[Field, Raw]
    ) -> Iterator[Field]:
        for field in self._below.get(multiplexer, ()):
            if page is None or page in field.ids:
                yield field
                if field.pages:
                    yield from self._present(field.name, raws[field], raws)

    def _find(
        self,
        multiplexer: str | None,
        pages: dict[str, frozenset[int]],
        exist: frozenset[int] = frozenset(),
    ) -> None:
        """Find the pages of the signals below a multiplexer, whose own and existing ones are given.

        A signal that is only on pages that do not exist is never sent, and has none.
        """
        for field in self._below.get(multiplexer, ()):
            own = pages if multiplexer is None else pages | {multiplexer: field.ids & exist}
            if all(own.values()):
                self._pages[field] = own
                self._find(field.name, own, field.pages)
