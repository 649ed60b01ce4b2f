"""Layout of a record: its signals, each within its bounds, and what they need together."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import ClassVar

from ...values.errors import LayoutError
from ...values.line import Slot
from .record_signals import (
    EXACT_BITS,
    FINE,
    FINE_SIGNALS,
    OF_SLOT,
    PAGE,
    PAGE_BYTES,
    TRANSFER_ID,
    Bounds,
    Signal,
    slot_title,
)
from .signal import first_bit


@dataclass(frozen=True, eq=False, kw_only=True)
class RecordLayout:
    """Signals of a record, which is the concatenation of the pages of its messages.

    A record whose bounds have no page is the payload of a CAN FD message.

    Args:
        signals: by name, in the order of their bits.
        source: name of the DBC in error messages.
    """

    #: What needs each signal, for error messages.
    needed_by: ClassVar[str] = "each message of a map line needs it, within the pages of 8 bytes"

    #: Prefix of page and transfer ID in the DBC.
    prefix: ClassVar[str] = ""

    signals: Mapping[str, Signal]
    source: str

    def _dbc_name(self, name: str) -> str:
        return f"{self.prefix}{name}" if name.startswith((PAGE, TRANSFER_ID)) else name

    def __getitem__(self, name: str) -> Signal:
        """Return the signal of this name.

        Raises:
            LayoutError: there is none.
        """
        try:
            return self.signals[name]
        except KeyError:
            raise LayoutError(
                f"{self.source}: there is no signal {self._dbc_name(name)!r}; {self.needed_by}"
            ) from None

    @cached_property
    def pages(self) -> int:
        """Number of pages of a record; 0 of one that has none."""
        return len(pages_of(self.signals))

    @property
    def record_bytes(self) -> int:
        """Length of a record."""
        return self.pages * PAGE_BYTES

    @property
    def secured_bytes(self) -> int:
        """Length of an authenticated record."""
        return self.record_bytes

    @property
    def crc_offset(self) -> int:
        """First byte of the checksum within the record."""
        return self["Crc"].start // 8

    @property
    def max_age(self) -> float:
        """Greatest age that a record can state [s]; the greatest raw value means "too old"."""
        return self["Age"].physical_one(self["Age"].raw_max - 1) / 1000

    def check(self, bounds: Mapping[str, Bounds]) -> None:
        """Check that the record has these signals, and that they are right.

        Raises:
            LayoutError: one is missing, the pages are not numbered 0, 1, ..., or ``check_record``
                raises it.
        """
        for name in bounds:
            if name not in (PAGE, TRANSFER_ID):
                self[name]
        if PAGE in bounds:
            self._check_pages()
        check_record(self.signals, bounds, self.source, self.record_bytes)

    def _check_pages(self) -> None:
        pages = pages_of(self.signals)
        if pages != list(range(len(pages))) or not pages:
            raise LayoutError(f"{self.source}: pages must be numbered 0, 1, ..., got {pages}")
        for page in reversed(pages):  # the reader derives the first one from the second
            self[f"{TRANSFER_ID}{page}"]

    def error(self, signal: Signal, needs: str, cure: str) -> LayoutError:
        """Return the error that a signal does not have what it needs."""
        return LayoutError(
            f"{self.source}: signal {signal.dbc_name} is {signal}, but it needs {needs}; {cure}"
        )


# ---- the check of a record ------------------------------------------------------------------

#: Bits of a page.
PAGE_BITS = 8 * PAGE_BYTES
_PAGE_OF = re.compile(rf"{PAGE}(\d+)")

Signals = Mapping[str, Signal]


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
    met: Callable[[Signals], bool]
    cure: str


def pages_of(names: Iterable[str]) -> list[int]:
    """Return the numbers of the pages of a record, from its signals, in ascending order."""
    return sorted(int(match[1]) for match in map(_PAGE_OF.fullmatch, names) if match)


def bits_of(signal: Signal) -> set[int]:
    """Return the bits of a signal in the record, numbered from the first byte's lowest bit."""
    first = first_bit(signal)
    bits = range(first, first + signal.length)
    return {i // 8 * 8 + 7 - i % 8 for i in bits} if signal.big_endian else {*bits}


def _of_pages(signals: Signals, name: str) -> list[Signal]:
    """Return the signals of this name of all pages, in the order of the pages."""
    return [signals[f"{name}{page}"] for page in pages_of(signals)]


def _of_slots(signals: Signals, name: str) -> list[Signal]:
    names = [f"{slot_title(slot)}{name}" for slot in Slot]
    return [signals[name] for name in names if name in signals]


def _named(signals: Signals, name: str) -> list[Signal]:
    """Return the signals of this name: the one, or that of each page or of each slot."""
    if name in (PAGE, TRANSFER_ID):
        return _of_pages(signals, name)
    return [signals[name]] if name in signals else _of_slots(signals, name)


# ---- signals of a record together ----------------------------------------------------------


def _same_in_each_page(signals: Signals, name: str) -> bool:
    """Return whether the signals of the pages have the same bits; page 0 has its Counter."""
    later = list(enumerate(_of_pages(signals, name)))[name == TRANSFER_ID :]
    in_page = all({bit // PAGE_BITS for bit in bits_of(s)} == {page} for page, s in later)
    return in_page and len({(s.start % PAGE_BITS, s.length, s.big_endian) for _, s in later}) <= 1


def _begins_in_counter(signals: Signals) -> bool:
    """Return whether the transfer ID of page 0 is there, and as long as the others."""
    first = signals[f"{TRANSFER_ID}0"]
    lengths = {signal.length for signal in _of_pages(signals, TRANSFER_ID)}
    return lengths == {first.length} and max(bits_of(first)) < PAGE_BITS


def _bits(signals: Signals, name: str) -> int:
    """Return the length of a signal, 0 if there is none."""
    return signals[name].length if name in signals else 0


def _is_a_share(signals: Signals) -> bool:
    """Return whether n bits of the weight are multiples of 2^-n up to 1, enough for all."""
    weight = signals["ComponentWeight"]
    step = 2.0**-weight.length
    return (weight.factor, weight.offset) == (step, step) and weight.length >= _bits(
        signals, "ComponentCount"
    )


def _refines(signals: Signals, fine: str) -> bool:
    """Return whether the range of a fine signal is one step of the signal that it is added to."""
    signal, coarse = signals[fine], signals[fine.removesuffix(FINE)]
    is_step = math.isclose(signal.factor * 2.0**signal.length, coarse.factor, rel_tol=1e-9)
    return is_step and signal.length + coarse.length <= EXACT_BITS


def _same_in_all_slots(signals: Signals, name: str) -> bool:
    laws = {(s.length, s.signed, s.factor, s.offset) for s in _of_slots(signals, name)}
    return len(laws) <= 1


RELATIONS = (
    Relation(
        "Crc",
        "Intel byte order, and to start at a multiple of 8",
        lambda signals: not signals["Crc"].big_endian and signals["Crc"].start % 8 == 0,
        "write @1, and move it",
    ),
    Relation(
        PAGE,
        "the same bits in each page, and enough bits to number all pages",
        lambda signals: (
            _same_in_each_page(signals, PAGE)
            and len(pages_of(signals)) <= 2 ** signals[f"{PAGE}0"].length
        ),
        "place it as in page 0",
    ),
    Relation(
        TRANSFER_ID,
        "the same bits in each page; in page 0, it may be the low bits of Counter",
        lambda signals: _same_in_each_page(signals, TRANSFER_ID) and _begins_in_counter(signals),
        "place it as in page 1, and Counter in page 0",
    ),
    Relation(
        TRANSFER_ID,
        "values for two lines of the most components: a bit more than ComponentCount",
        lambda signals: signals[f"{TRANSFER_ID}0"].length > _bits(signals, "ComponentCount"),
        "widen it in each page, or shorten ComponentCount",
    ),
    Relation(
        "Counter",
        f"at least as many bits as {TRANSFER_ID}",
        lambda signals: signals["Counter"].length >= _bits(signals, f"{TRANSFER_ID}0"),
        f"widen it, or shorten {TRANSFER_ID}",
    ),
    Relation(
        "SceneCounter",
        "at most as many bits as Counter, whose low bits it has",
        lambda signals: signals["SceneCounter"].length <= signals["Counter"].length,
        "shorten it",
    ),
    Relation(
        "XMax",
        "an end above the start of XMin, or no valid range could be stated",
        lambda signals: signals["XMax"].reach[1] > signals["XMin"].reach[0],
        "correct their factors and offsets",
    ),
    Relation(
        "ComponentIndex",
        "at least as many bits as ComponentCount",
        lambda signals: signals["ComponentIndex"].length >= _bits(signals, "ComponentCount"),
        "widen it, or shorten ComponentCount",
    ),
    Relation(
        "ComponentWeight",
        "with n bits, factor and offset 2^-n, and at least as many bits as ComponentCount",
        _is_a_share,
        "write (0.03125,0.03125) with 5 bits",
    ),
    *(
        Relation(
            name,
            f"a range that is one step of {name.removesuffix(FINE)}, and at most {EXACT_BITS} bits "
            "together with it",
            partial(_refines, fine=name),
            "with n bits, give it the factor of that signal divided by 2^n",
        )
        for name in FINE_SIGNALS
    ),
    *(
        Relation(
            name,
            "the same length, factor and offset for all slots",
            partial(_same_in_all_slots, name=name),
            "change it for all slots",
        )
        for name in OF_SLOT
    ),
)


def check_record(
    signals: Signals, bounds: Mapping[str, Bounds], source: str, record_bytes: int
) -> None:
    """Check the signals of a record, one by one and together.

    Args:
        signals: of the record, by name.
        bounds: of those signals that the record must have.
        source: name of the DBC.
        record_bytes: length of the record.

    Raises:
        LayoutError: a signal is not within its bounds, two signals overlap, or one is not in the
            record.
    """
    for name, own in bounds.items():
        for signal in _named(signals, name):
            own.check(signal, source)
    for relation in RELATIONS:
        applies = relation.name in bounds or relation.name in OF_SLOT
        if applies and not relation.met(signals):
            named = _named(signals, relation.name)
            has = "; ".join(f"{signal.dbc_name} is {signal}" for signal in named)
            raise LayoutError(
                f"{source}: signal {named[-1].prefix}{relation.name} needs {relation.needs}, "
                f"but {has}; {relation.cure}"
            )
    _check_places(signals, source, record_bytes)


def _check_places(signals: Signals, source: str, record_bytes: int) -> None:
    """Check that no signals overlap, and that each is in the record."""
    owner: dict[int, Signal] = {}
    for name, signal in signals.items():
        bits = bits_of(signal)
        if max(bits) >= 8 * record_bytes:
            where = "'s pages of 8 bytes" if pages_of(signals) else f" of {record_bytes} bytes"
            raise LayoutError(f"{source}: signal {signal.dbc_name} must lie in the record{where}")
        if name == f"{TRANSFER_ID}0" and bits <= bits_of(signals["Counter"]):
            continue  # the low bits of the counter
        for bit in bits:
            if (other := owner.setdefault(bit, signal)) is not signal:
                raise LayoutError(
                    f"{source}: signals {other.dbc_name} and {signal.dbc_name} overlap; move one"
                )
