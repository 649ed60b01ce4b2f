"""Records: the description of each signal, and its place on pages and in whole scenes."""

from __future__ import annotations

import re
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from cantools.database.can import Signal
from cantools.database.conversion import BaseConversion

from ...values.line import Slot
from ...wire.layout.pose_layout import SCENE, SCENE2, SceneOwner
from ...wire.layout.record_signals import LINE, PAGE, PAGE_BYTES, TRANSFER_ID, slot_title

#: A slot in the name of a signal, and in a sentence about it.
_SLOT = re.compile("|".join(rf"\b{slot_title(slot)}(?=[A-Z]|\b)" for slot in Slot))


@dataclass(frozen=True, kw_only=True)
class SignalSpec:
    """One signal of the record: physical = raw * factor + offset."""

    name: str
    bits: int
    factor: float = 1
    offset: float = 0
    unit: str = ""  #: of the physical value
    signed: bool = False  #: two's complement
    is_float: bool = False  #: IEEE 754 binary32
    choices: dict[int, str] | None = None  #: names of raw values
    about: str  #: what the signal is, for its comment in the DBC
    why: str  #: why it has this width, for the table beside the DBC

    def finer(self, bits: int) -> SignalSpec:
        """Return the signal with more bits, for finer steps over the same range.

        Raises:
            ValueError: no bit is left.
        """
        if self.bits + bits < 1:
            raise ValueError(f"{self.name} has {self.bits} bits, so finer_bits cannot be {bits}")
        return replace(self, bits=self.bits + bits, factor=self.factor / 2.0**bits)

    @property
    def range(self) -> tuple[float, float]:
        """Smallest and largest physical value."""
        low = -(2 ** (self.bits - 1)) if self.signed else 0
        high = low + 2**self.bits - 1
        if self.factor == 1 and self.offset == 0:  # exact even beyond the precision of a float
            return low, high
        return _plain(low * self.factor + self.offset), _plain(high * self.factor + self.offset)


def _plain(value: float) -> float:
    """Return a number without the digits that rounding adds, whole numbers as int."""
    value = float(f"{value:.15g}")
    return int(value) if value.is_integer() else value


# fmt: off
_PAGE = SignalSpec(
    name=PAGE, bits=0,
    about="Page of the record: the multiplexer.",
    why="as many as pages")
_TRANSFER_ID = SignalSpec(
    name=TRANSFER_ID, bits=0,
    about="Transfer that the page belongs to: the low bits of Counter. A line is accepted only if "
          "all pages have the same number and the checksum over all of them is correct.",
    why="distinguishes {} transfers in a row, long enough for an incomplete one to time out")
# fmt: on


@dataclass(frozen=True)
class RecordPages:
    """Pages of a record.

    Each page ends with its number, so that the first page can begin with the header of E2E
    profile 5. On the other pages the transfer number comes before it; on the first page this is
    the low bits of Counter.

    Args:
        pages: the signals of each page, in the order of their bits.
        page_bits: width of the page number; None for the least.
        transfer_id_bits: width of the transfer number.
        prefix: of the names of both, whose widths another record of the DBC may have otherwise.

    Raises:
        ValueError: a page has more than 64 bits.
    """

    pages: tuple[tuple[SignalSpec, ...], ...]
    page_bits: int | None = None
    transfer_id_bits: int = 4
    prefix: str = ""

    def __post_init__(self) -> None:
        for number in range(len(self.pages)):
            bits = sum(spec.bits for spec, _ in self.placed(number))
            if bits > 8 * PAGE_BYTES:
                raise ValueError(f"page {number} has {bits} bits, more than {8 * PAGE_BYTES}")

    @property
    def record_bytes(self) -> int:
        """Length of a record."""
        return PAGE_BYTES * len(self.pages)

    def placed(self, number: int) -> Iterator[tuple[SignalSpec, int]]:
        """Yield the signals of a page and their first bits."""
        start = 0
        for spec in self.pages[number]:
            yield spec, start
            start += spec.bits
        page_bits = self.page_bits or max(1, (len(self.pages) - 1).bit_length())
        end = 8 * PAGE_BYTES - page_bits
        if number > 0:
            bits = self.transfer_id_bits
            yield (
                replace(
                    _TRANSFER_ID,
                    name=f"{self.prefix}{TRANSFER_ID}{number}",
                    bits=bits,
                    why=_TRANSFER_ID.why.format(2**bits),
                ),
                end - bits,
            )
        yield replace(_PAGE, name=self._page, bits=page_bits), end

    @property
    def _page(self) -> str:
        return f"{self.prefix}{PAGE}"

    def paged(self) -> list[Signal]:
        """Return the signals of the multiplexed message."""
        signals = []
        for number in range(len(self.pages)):
            for spec, start in self.placed(number):
                if spec.name != self._page:
                    ids: dict[str, Any] = {
                        "multiplexer_ids": [number],
                        "multiplexer_signal": self._page,
                    }
                    signals.append(dbc_signal(spec, start, **ids))
                elif number == 0:
                    signals.append(dbc_signal(spec, start, is_multiplexer=True))
        return signals

    def end_to_end(self) -> list[Signal]:
        """Return the signals of all pages laid end to end."""
        signals = []
        for number in range(len(self.pages)):
            for spec, start in self.placed(number):
                name = f"{self._page}{number}" if spec.name == self._page else spec.name
                start += 8 * PAGE_BYTES * number
                signals.append(dbc_signal(replace(spec, name=name), start))
        return signals

    def table(self) -> str:
        """Return the fields as a Markdown table, for the page beside the DBC.

        Signals that differ only in their page or slot share a row, as ``*``.
        """
        places: dict[str, dict[int, list[str]]] = {}
        for number in range(len(self.pages)):
            for spec, start in self.placed(number):
                of_page = places.setdefault(cells_of(spec), {}).setdefault(number, [])
                of_page.append(f"{start}..{start + spec.bits - 1}")
        rows = [table_head("page: bits")]
        for cells, pages in places.items():
            place = "; ".join(f"{number}: {', '.join(bits)}" for number, bits in pages.items())
            rows.append(f"| {place} | {cells} |")
        return "\n".join(rows)


def table_head(place: str) -> str:
    """Return the head of a table of fields, whose first column is their place."""
    titles = [place, "signal", "width", "factor", "range", "unit", "what it is", "why so wide"]
    return f"| {' | '.join(titles)} |\n{'|---' * len(titles)}|"


def cells_of(spec: SignalSpec) -> str:
    """Return the cells of a signal but its place; slots and numbers of transfers become ``*``."""
    low, high = spec.range
    name = re.sub(rf"({TRANSFER_ID})\d+$", r"\1*", _SLOT.sub("*", spec.name))
    return (
        f"`{name}` | {spec.bits} | {spec.factor:.6g} | {low:.6g} .. {high:.6g} "
        f"| {spec.unit or '-'} | {_SLOT.sub('line', spec.about)} | {spec.why}"
    )


def dbc_signal(
    spec: SignalSpec, start: int, byte_order: str = "little_endian", **multiplexing: Any
) -> Signal:
    """Return a signal of cantools that starts at a bit of its message."""
    low, high = (None, None) if spec.is_float else spec.range
    return Signal(
        name=spec.name,
        start=start,
        length=spec.bits,
        byte_order=byte_order,  # type: ignore[arg-type]
        is_signed=spec.signed,
        conversion=BaseConversion.factory(
            scale=_plain(spec.factor),
            offset=_plain(spec.offset),
            choices=OrderedDict(spec.choices) if spec.choices else None,
            is_float=spec.is_float,
        ),
        minimum=low,
        maximum=high,
        unit=spec.unit or None,
        comment=spec.about,
        receivers=["AdasEcu"],
        **multiplexing,
    )


# ---- whole scenes -------------------------------------------------------------------------------

#: Names of the messages, in the order in which they are sent.
MESSAGES: Mapping[SceneOwner, str] = {SCENE2: "Scene2", SCENE: "Scene"}


@dataclass(frozen=True)
class SceneSpec:
    """Messages of whole scenes: the pose error, and lines at equal distances of whole bytes.

    The last bits of a line without a fixed slot name its slot; those of the others have room for
    signals of the record.

    Args:
        head: signals before the lines, in the order of their bits.
        line: signals of each line, in the order of their bits.
        tails: signals of the record in the last bits of the first lines, which have a fixed slot.
        slot: signal in the last bits of lines without a fixed slot.
        fixed: slots of the first lines of each message; without Scene2 there is no such message.
        places: lines of a record.
        secured_places: lines of an authenticated record.
        first_can_id: of Scene2; Scene follows, then the authenticated messages.
        first_data_id: E2E data ID of Scene2; that of Scene follows, then their SecOC data IDs.

    Raises:
        ValueError: a tail is not in a line with a fixed slot of each record.
    """

    head: tuple[SignalSpec, ...]
    line: tuple[SignalSpec, ...]
    tails: tuple[SignalSpec, ...]
    slot: SignalSpec
    fixed: Mapping[SceneOwner, tuple[Slot, ...]]
    places: int = 4
    secured_places: int = 3
    first_can_id: int = 0x378
    first_data_id: int = 0x4D78

    def __post_init__(self) -> None:
        for owner, slots in self.fixed.items():
            if len(self.tails) > min(len(slots), self.secured_places):
                raise ValueError(
                    f"{MESSAGES[owner]} has {len(slots)} fixed slots and {self.secured_places} "
                    f"places if it is authenticated, but there are {len(self.tails)} tails"
                )

    @property
    def head_bytes(self) -> int:
        """Bytes before the lines."""
        return _whole_bytes(sum(spec.bits for spec in self.head))

    @property
    def stride_bytes(self) -> int:
        """Bytes from one line to the next."""
        tail = max(spec.bits for spec in (*self.tails, self.slot))
        return _whole_bytes(sum(spec.bits for spec in self.line) + tail)

    def record_bytes(self, places: int) -> int:
        """Bytes of a record of so many lines."""
        return self.head_bytes + self.stride_bytes * places

    def titles(self, owner: SceneOwner, places: int) -> list[str]:
        """Return the starts of the names of so many lines."""
        fixed = [*map(slot_title, self.fixed[owner])]
        return [*fixed, *(f"{LINE}{i + 1}" for i in range(len(fixed), places))][:places]

    def signals(self, owner: SceneOwner, places: int) -> list[Signal]:
        """Return the signals of a record of so many lines."""
        signals = [dbc_signal(spec, start) for spec, start in _in_row(self.head)]
        for place, title in enumerate(self.titles(owner, places)):
            first = 8 * (self.head_bytes + self.stride_bytes * place)
            for spec, start in _in_row(self.line):
                signals.append(dbc_signal(_of_line(spec, title), first + start))
            names_slot = place >= len(self.fixed[owner])
            tails = [_of_line(self.slot, title)] if names_slot else self.tails[place : place + 1]
            end = first + 8 * self.stride_bytes
            signals += [dbc_signal(tail, end - tail.bits) for tail in tails]
        return signals

    def table(self) -> str:
        """Return the fields as a Markdown table, for the page beside the DBC.

        Bits of a line, as ``*``, are counted from its first byte.
        """
        end = 8 * self.stride_bytes
        rows = [
            *(("", spec, start) for spec, start in _in_row(self.head)),
            *(("each line: ", _of_line(spec, "*"), start) for spec, start in _in_row(self.line)),
            *(
                (f"line {place}: ", spec, end - spec.bits)
                for place, spec in enumerate(self.tails, start=1)
            ),
            ("other lines: ", _of_line(self.slot, "*"), end - self.slot.bits),
        ]
        lines = [
            f"| {where}{start}..{start + spec.bits - 1} | {cells_of(spec)} |"
            for where, spec, start in rows
        ]
        return "\n".join([table_head("bits"), *lines])


def _whole_bytes(bits: int) -> int:
    return -(-bits // 8)


def _in_row(specs: tuple[SignalSpec, ...]) -> Iterator[tuple[SignalSpec, int]]:
    """Yield signals that follow each other, and their first bits."""
    start = 0
    for spec in specs:
        yield spec, start
        start += spec.bits


def _of_line(spec: SignalSpec, title: str) -> SignalSpec:
    return replace(spec, name=f"{title}{spec.name}")
