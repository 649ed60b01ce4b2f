"""Write the DBC of a record, and the table of its fields, from a description of its signals."""

from __future__ import annotations

import re
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from typing import Any

import numpy as np
from cantools.database.can import Database, Message, Node, Signal
from cantools.database.can.formats.dbc.dbc_attribute import DbcAttribute
from cantools.database.can.formats.dbc.dbc_attribute_definition import DbcAttributeDefinition
from cantools.database.can.formats.dbc.dbc_specifics import DbcSpecifics
from cantools.database.conversion import BaseConversion

from ...line import Slot
from ...wire.message.layout import PAGE, PAGE_BYTES, SECURED_SIGNALS, TRANSFER_ID, fd_length

TRANSFER_ID_BITS = 4
#: Largest payload of CAN FD; a longer record has no FD message [byte].
LARGEST_FD_PAYLOAD = 64


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
    name=TRANSFER_ID, bits=TRANSFER_ID_BITS,
    about="Transfer that the page belongs to: the low bits of Counter. A line is accepted only if "
          "all pages have the same number and the checksum over all of them is correct.",
    why="distinguishes 16 transfers in a row, long enough for an incomplete one to time out")
_KEY_ID = SignalSpec(
    name="KeyId", bits=8 * SECURED_SIGNALS["KeyId"],
    about="Number of the key of the MAC, which covers it.",
    why="a byte: the old key, the new one, and numbers for later ones")
_FRESHNESS = SignalSpec(
    name="Freshness", bits=0, unit="us",
    about="Low bytes of the freshness value: the sender's time since 1970, larger in each frame "
          "than in the frame before.",
    why="7 bytes last 2283 years, so that each frame holds the whole value and no synchronisation "
        "is needed; a record of 32 bytes leaves 16 in the next length of CAN FD")
_MAC = SignalSpec(
    name="Mac", bits=0,
    about="First bytes of the AES-CMAC (RFC 4493).",
    why="64 bits, the minimum that NIST SP 800-38B advises without an analysis of guesses")
# fmt: on


@dataclass(frozen=True)
class DbcWriter:
    """Writer of a DBC: pages of signals, and the slots that have messages.

    Each page ends with its number, so that the first page can begin with the header of E2E
    profile 5. On the other pages the transfer number comes before it; on the first page this is
    the low bits of Counter. All signals are little-endian, except those that an authenticated
    message adds, which are big-endian as in AUTOSAR.
    """

    pages: tuple[tuple[SignalSpec, ...], ...]  #: the signals of each page, in the order of bits
    first_can_id: int = 0x340  #: classic message of slot 0; the other slots follow
    first_fd_can_id: int = 0x348  #: FD message of slot 0
    first_data_id: int = 0x4D40  #: E2E data ID of slot 0
    cycle_ms: int = 50
    covariance_code: str = "Cholesky"
    slots: tuple[Slot, ...] = tuple(Slot)
    first_secured_can_id: int | None = None  #: authenticated message of slot 0, if there are any
    first_secured_data_id: int = 0x4D50  #: SecOC data ID of slot 0
    freshness_bytes: int = SECURED_SIGNALS["Freshness"]  #: 3 to 7
    mac_bytes: int = SECURED_SIGNALS["Mac"]  #: 1 to 8

    def __post_init__(self) -> None:
        for number in range(len(self.pages)):
            bits = sum(spec.bits for spec, _ in self._placed(number))
            if bits > 8 * PAGE_BYTES:
                raise ValueError(f"page {number} has {bits} bits, more than {8 * PAGE_BYTES}")

    @property
    def page_bits(self) -> int:
        """Width of the page number."""
        return max(1, (len(self.pages) - 1).bit_length())

    def dbc(self) -> str:
        """Return the text of the DBC."""
        definitions = _attribute_definitions()
        if self.first_secured_can_id is None:
            del definitions["SecOCDataId"]
        network = {"BusType": "CAN FD", "CovarianceCode": self.covariance_code}
        database = Database(
            messages=[message for slot in self.slots for message in self._messages(slot)],
            nodes=[
                Node("PositionEcu", "Knows the pose and the map, and sends the lines."),
                Node("AdasEcu", "Fuses the lines, steers by them or checks its camera with them."),
            ],
            version="1",
            dbc_specifics=DbcSpecifics(
                attributes=_attributes(network), attribute_definitions=definitions
            ),
        )
        text = str(database.as_dbc_string(sort_signals=None)).replace("\r\n", "\n")
        return re.sub(r"^ SG_ .*$", _without_exponents, text, flags=re.MULTILINE)

    def table(self) -> str:
        """Return the fields as a Markdown table, for the page beside the DBC."""
        rows = [
            "| page | bits | signal | width | factor | range | unit | what it is | why so wide |",
            "|---|---|---|---|---|---|---|---|---|",
        ]
        for number in range(len(self.pages)):
            for spec, start in self._placed(number):
                low, high = spec.range
                rows.append(
                    f"| {number} | {start}..{start + spec.bits - 1} | `{spec.name}` | {spec.bits} "
                    f"| {spec.factor:.6g} | {low:.6g} .. {high:.6g} | {spec.unit or '-'} | "
                    f"{spec.about} | {spec.why} |"
                )
        return "\n".join(rows)

    def _placed(self, number: int) -> Iterator[tuple[SignalSpec, int]]:
        """Yield the signals of a page and their first bits."""
        start = 0
        for spec in self.pages[number]:
            yield spec, start
            start += spec.bits
        end = 8 * PAGE_BYTES - self.page_bits
        if number > 0:
            yield replace(_TRANSFER_ID, name=f"{TRANSFER_ID}{number}"), end - TRANSFER_ID_BITS
        yield replace(_PAGE, bits=self.page_bits), end

    def _messages(self, slot: Slot) -> Iterator[Message]:
        """Yield the classic message of a slot, and the FD and authenticated ones if any."""
        name = "".join(word.capitalize() for word in slot.name.split("_"))
        line, size = f"The {slot.name.replace('_', ' ').lower()} line", PAGE_BYTES * len(self.pages)
        about = f"{line}: {len(self.pages)} pages, sent back to back with the same transfer number."
        yield self._message(name, self.first_can_id, PAGE_BYTES, self._paged(), about, slot)
        if size <= LARGEST_FD_PAYLOAD:
            about = f"{line}: the pages of {name} laid end to end."
            can_id, length = self.first_fd_can_id, fd_length(size)
            yield self._message(f"{name}Fd", can_id, length, self._end_to_end(), about, slot, True)
        if self.first_secured_can_id is not None:
            specs = (
                _KEY_ID,
                replace(_FRESHNESS, bits=8 * self.freshness_bytes),
                replace(_MAC, bits=8 * self.mac_bytes),
            )
            tail = sum(spec.bits for spec in specs)
            length = fd_length(size + tail // 8)
            signals, start = self._end_to_end(), 8 * length - tail
            for spec in specs:
                signals.append(_signal(spec, start + 7, byte_order="big_endian"))
                start += spec.bits
            about = (
                f"{line}, authenticated (AUTOSAR SecOC, AES-CMAC): {name}Fd, then the number of "
                "the key, the freshness value and the MAC over SecOCDataId, all bytes before "
                "Freshness, and the freshness value in 64 bits."
            )
            data_id = self.first_secured_data_id + slot
            yield self._message(
                *(f"{name}SecOc", self.first_secured_can_id, length, signals, about, slot, True),
                SecOCDataId=data_id,
            )

    def _paged(self) -> list[Signal]:
        """Return the signals of the multiplexed message."""
        signals = []
        for number in range(len(self.pages)):
            for spec, start in self._placed(number):
                if spec.name != PAGE:
                    ids: dict[str, Any] = {"multiplexer_ids": [number], "multiplexer_signal": PAGE}
                    signals.append(_signal(spec, start, **ids))
                elif number == 0:
                    signals.append(_signal(spec, start, is_multiplexer=True))
        return signals

    def _end_to_end(self) -> list[Signal]:
        """Return the signals of all pages laid end to end."""
        signals = []
        for number in range(len(self.pages)):
            for spec, start in self._placed(number):
                name = f"{PAGE}{number}" if spec.name == PAGE else spec.name
                signals.append(_signal(replace(spec, name=name), start + 8 * PAGE_BYTES * number))
        return signals

    def _message(
        self,
        name: str,
        first_can_id: int,
        length: int,
        signals: list[Signal],
        about: str,
        slot: Slot,
        is_fd: bool = False,
        **attributes: int,
    ) -> Message:
        values = {
            "MapLineSlot": int(slot),
            "E2EDataId": self.first_data_id + slot,
            "GenMsgCycleTime": self.cycle_ms,
            "GenMsgSendType": 0,
            "VFrameFormat": 14 if is_fd else 0,
        }
        return Message(
            frame_id=first_can_id + slot,
            name=name,
            length=length,
            signals=signals,
            comment=about,
            senders=["PositionEcu"],
            send_type="Cyclic",
            cycle_time=self.cycle_ms,
            is_fd=is_fd,
            sort_signals=None,
            dbc_specifics=DbcSpecifics(attributes=_attributes(values | attributes)),
        )


def _signal(
    spec: SignalSpec, start: int, byte_order: str = "little_endian", **multiplexing: Any
) -> Signal:
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


def _without_exponents(line: re.Match[str]) -> str:
    """Return a line ``SG_`` with plain decimals, since some parsers do not read exponents.

    The digits, and so the values as doubles, stay the same.
    """
    return re.sub(
        r"(?<=[(,|[])-?[\d.]+e[+-]?\d+", lambda number: f"{Decimal(number[0]):f}", line[0]
    )


def _attributes(values: dict[str, Any]) -> OrderedDict[str, DbcAttribute[Any]]:
    definitions = _attribute_definitions()
    return OrderedDict(
        (name, DbcAttribute(value, definitions[name])) for name, value in values.items()
    )


def _attribute_definitions() -> OrderedDict[str, Any]:
    formats = ["StandardCAN", "ExtendedCAN", *["reserved"] * 12, "StandardCAN_FD", "ExtendedCAN_FD"]
    send_types = ["Cyclic", "Event", "IfActive"]
    definitions = (
        DbcAttributeDefinition("BusType", "CAN", "", "STRING"),
        DbcAttributeDefinition("CovarianceCode", "Cholesky", "", "STRING"),
        DbcAttributeDefinition("MapLineSlot", 0, "BO_", "INT", 0, len(Slot) - 1),
        DbcAttributeDefinition("E2EDataId", 0, "BO_", "INT", 0, 0xFFFF),
        DbcAttributeDefinition("SecOCDataId", 0, "BO_", "INT", 0, 0xFFFF),
        DbcAttributeDefinition("GenMsgCycleTime", 0, "BO_", "INT", 0, 65535),
        DbcAttributeDefinition("GenMsgSendType", "Cyclic", "BO_", "ENUM", choices=send_types),
        DbcAttributeDefinition("VFrameFormat", "StandardCAN", "BO_", "ENUM", choices=formats),
    )
    return OrderedDict((definition.name, definition) for definition in definitions)


def paged(signals: Sequence[SignalSpec]) -> tuple[tuple[SignalSpec, ...], ...]:
    """Distribute signals to as few pages as a search finds.

    Each page is filled as far as its signals allow (a subset sum); if the last signals do not
    fit, the search repeats with other orders, the same ones at each call.

    Args:
        signals: of 1 to 56 bits; the first two are the header of E2E.
    """
    head, rest = signals[:2], list(signals[2:])
    rng = np.random.default_rng(0)
    bits = sum(spec.bits for spec in signals)
    for pages in range(1, 65):
        page_bits = max(1, (pages - 1).bit_length())
        room = [8 * PAGE_BYTES - page_bits - TRANSFER_ID_BITS * (page > 0) for page in range(pages)]
        if sum(room) < bits:
            continue
        room[0] -= sum(spec.bits for spec in head)
        for attempt in range(200):
            order = list(range(len(rest))) if not attempt else list(rng.permutation(len(rest)))
            found: list[list[int]] = []
            for space in room:
                chosen = _fullest([rest[i].bits for i in order], space)
                found.append(sorted(order[i] for i in chosen))
                order = [i for place, i in enumerate(order) if place not in chosen]
            if not order:
                placed = [tuple(rest[i] for i in page) for page in found]
                return ((*head, *placed[0]), *placed[1:])
    raise ValueError(f"the signals have {bits} bits, more than 64 pages hold")


def _fullest(sizes: Sequence[int], space: int) -> set[int]:
    """Return the indices of the sizes with the largest sum up to ``space``, early ones first."""
    reached: dict[int, tuple[int, ...]] = {0: ()}
    for index, size in enumerate(sizes):
        for total, chosen in list(reached.items()):
            if total + size <= space:
                reached.setdefault(total + size, (*chosen, index))
    return set(reached[max(reached)])
