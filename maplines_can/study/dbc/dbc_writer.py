"""From a description of the wire to its DBC and to the table of its fields."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from cantools.database.can import Database, Message, Node, Signal
from cantools.database.can.formats.dbc.dbc_attribute import DbcAttribute
from cantools.database.can.formats.dbc.dbc_attribute_definition import DbcAttributeDefinition
from cantools.database.can.formats.dbc.dbc_specifics import DbcSpecifics
from cantools.database.conversion import BaseConversion

from ...line import Slot
from ...wire.message.layout import PAGE, PAGE_BYTES, SECURED_SIGNALS, TRANSFER_ID, fd_length

__all__ = ["DbcWriter", "SignalSpec", "paged"]


@dataclass(frozen=True)
class SignalSpec:
    """One signal of the record.

    Args:
        name: in the DBC.
        bits: width.
        factor: physical = raw factor + offset.
        unit: of the physical value.
        about: what it is, for the DBC's comment.
        why: why it has this width, for the page beside the DBC.
        offset: see factor.
        signed: two's complement.
        choices: names of raw values.
        is_float: an IEEE 754 number of 32 bits.
    """

    name: str
    bits: int
    factor: float
    unit: str
    about: str
    why: str
    offset: float = 0.0
    signed: bool = False
    choices: dict[int, str] | None = None
    is_float: bool = False

    def finer(self, bits: int) -> SignalSpec:
        """The signal with so many bits more, for finer steps over the same range.

        Raises:
            ValueError: no bit is left.
        """
        if self.bits + bits < 1:
            raise ValueError(f"{self.name} has {self.bits} bits, so finer_bits cannot be {bits}")
        return replace(self, bits=self.bits + bits, factor=self.factor / 2.0**bits)

    @property
    def range(self) -> tuple[float, float]:
        """Least and greatest physical value."""
        low = -(2 ** (self.bits - 1)) if self.signed else 0
        high = low + 2**self.bits - 1
        if self.factor == 1 and self.offset == 0:  # exact, where a float has too few digits
            return low, high
        return _plain(low * self.factor + self.offset), _plain(high * self.factor + self.offset)


def _plain(value: float) -> float:
    """The number as a person would write it in a DBC."""
    value = float(f"{value:.15g}")
    return int(value) if value.is_integer() else value


@dataclass(frozen=True)
class DbcWriter:
    """What is on the wire: pages of signals, and the slots that carry them.

    Each page ends with its number, so that the first page can begin with the
    header of E2E profile 5; before it the other pages repeat the transfer number, which
    in the first one is the low bits of Counter. Everything is little-endian, but for what
    an authenticated message adds, which is as AUTOSAR has it.

    Args:
        pages: the signals of each page, in the order of their bits.
        first_can_id: of the classic message of slot 0; the others follow.
        first_fd_can_id: of the FD message of slot 0; the others follow.
        first_data_id: E2E data ID of slot 0; the others follow.
        cycle_ms: cycle time [ms].
        covariance_code: which code the covariance is written in.
        slots: that have messages.
        first_secured_can_id: of the authenticated FD message of slot 0; the others follow.
            None for a bus without.
        first_secured_data_id: SecOC data ID of slot 0; the others follow.
        freshness_bytes: of the freshness value that are sent, 1 to 7.
        mac_bytes: of the MAC that are sent, 1 to 8.
    """

    pages: tuple[tuple[SignalSpec, ...], ...]
    first_can_id: int = 0x340
    first_fd_can_id: int = 0x348
    first_data_id: int = 0x4D40
    cycle_ms: int = 50
    covariance_code: str = "Cholesky"
    slots: tuple[Slot, ...] = tuple(Slot)
    first_secured_can_id: int | None = None
    first_secured_data_id: int = 0x4D50
    freshness_bytes: int = SECURED_SIGNALS["Freshness"]
    mac_bytes: int = SECURED_SIGNALS["Mac"]

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
        """The text of the DBC."""
        definitions = _attribute_definitions()
        if self.first_secured_can_id is None:
            del definitions["SecOCDataId"]
        carriers = [self._classic]
        if len(self.pages) * PAGE_BYTES <= LARGEST_FD_PAYLOAD:
            carriers.append(self._fd)
        if self.first_secured_can_id is not None:
            carriers.append(self._secured)
        messages = [message(slot) for slot in self.slots for message in carriers]
        database = Database(
            messages=messages,
            nodes=[
                Node("PositionEcu", "Knows the pose and the map, and sends the lines."),
                Node("AdasEcu", "Fuses the lines, steers by them or checks its camera with them."),
            ],
            version="1",
            dbc_specifics=DbcSpecifics(
                attributes=OrderedDict(
                    BusType=DbcAttribute("CAN FD", definitions["BusType"]),
                    CovarianceCode=DbcAttribute(
                        self.covariance_code, definitions["CovarianceCode"]
                    ),
                ),
                attribute_definitions=definitions,
            ),
        )
        return str(database.as_dbc_string(sort_signals=None)).replace("\r\n", "\n")

    def table(self) -> str:
        """The fields as a Markdown table, for the page beside the DBC."""
        rows = [
            "| page | bits | signal | width | factor | range | unit | what it is | why so wide |"
        ]
        rows.append("|---|---|---|---|---|---|---|---|---|")
        for number in range(len(self.pages)):
            for spec, start in self._placed(number):
                low, high = spec.range
                end = start + spec.bits - 1
                rows.append(
                    f"| {number} | {start}..{end} | `{spec.name}` | {spec.bits} | "
                    f"{spec.factor:.6g} | {low:.6g} .. {high:.6g} | {spec.unit or '-'} | "
                    f"{spec.about} | {spec.why} |"
                )
        return "\n".join(rows)

    def _placed(self, number: int) -> Iterator[tuple[SignalSpec, int]]:
        start = 0
        for spec in self.pages[number]:
            yield spec, start
            start += spec.bits
        end = 8 * PAGE_BYTES - self.page_bits
        if number > 0:
            yield replace(_TRANSFER_ID, name=f"{TRANSFER_ID}{number}"), end - TRANSFER_ID_BITS
        yield _page_spec(self.page_bits), end

    def _classic(self, slot: Slot) -> Message:
        signals = []
        for number in range(len(self.pages)):
            for spec, start in self._placed(number):
                if spec.name != PAGE:
                    mux: dict[str, Any] = {"multiplexer_ids": [number], "multiplexer_signal": PAGE}
                    signals.append(_signal(spec, start, **mux))
                elif number == 0:
                    signals.append(_signal(spec, start, is_multiplexer=True))
        about = (
            f"The {_slot_words(slot)} line: {len(self.pages)} pages, sent back to back with one "
            "transfer number."
        )
        return self._message(_slot_name(slot), self.first_can_id + slot, PAGE_BYTES, signals, about)

    def _fd(self, slot: Slot) -> Message:
        length = fd_length(PAGE_BYTES * len(self.pages))
        name = _slot_name(slot) + "Fd"
        about = f"The {_slot_words(slot)} line: the pages of {_slot_name(slot)} laid end to end."
        can_id, signals = self.first_fd_can_id + slot, self._end_to_end()
        return self._message(name, can_id, length, signals, about, is_fd=True)

    def _secured(self, slot: Slot) -> Message:
        specs = _secured_specs(self.freshness_bytes, self.mac_bytes)
        tail = sum(spec.bits for spec in specs) // 8
        length = fd_length(PAGE_BYTES * len(self.pages) + tail)
        signals, start = self._end_to_end(), 8 * (length - tail)
        for spec in specs:
            signals.append(_signal(spec, start + 7, big_endian=True))
            start += spec.bits
        name = _slot_name(slot) + "SecOc"
        about = (
            f"The {_slot_words(slot)} line, authenticated (AUTOSAR SecOC, AES-CMAC): "
            f"{_slot_name(slot)}Fd, then the key's number, the freshness value and the MAC over "
            "SecOCDataId, all bytes before Freshness, and the freshness value in 64 bits."
        )
        can_id = (self.first_secured_can_id or 0) + slot
        data_id = self.first_secured_data_id + slot
        return self._message(
            name, can_id, length, signals, about, is_fd=True, secured_data_id=data_id
        )

    def _end_to_end(self) -> list[Signal]:
        signals = []
        for number in range(len(self.pages)):
            for spec, start in self._placed(number):
                suffix = str(number) if spec.name == PAGE else ""
                signals.append(_signal(spec, start + 8 * PAGE_BYTES * number, suffix=suffix))
        return signals

    def _message(
        self,
        name: str,
        can_id: int,
        length: int,
        signals: list[Signal],
        about: str,
        is_fd: bool = False,
        secured_data_id: int | None = None,
    ) -> Message:
        definitions = _attribute_definitions()
        slot = can_id - (self.first_fd_can_id if is_fd else self.first_can_id)
        if secured_data_id is not None:
            slot = secured_data_id - self.first_secured_data_id
        values: dict[str, Any] = {
            "MapLineSlot": slot,
            "E2EDataId": self.first_data_id + slot,
            "GenMsgCycleTime": self.cycle_ms,
            "GenMsgSendType": 0,
            "VFrameFormat": 14 if is_fd else 0,
        }
        if secured_data_id is not None:
            values["SecOCDataId"] = secured_data_id
        return Message(
            frame_id=can_id,
            name=name,
            length=length,
            signals=signals,
            comment=about,
            senders=["PositionEcu"],
            send_type="Cyclic",
            cycle_time=self.cycle_ms,
            is_fd=is_fd,
            sort_signals=None,
            dbc_specifics=DbcSpecifics(
                attributes=OrderedDict(
                    (name, DbcAttribute(value, definitions[name])) for name, value in values.items()
                )
            ),
        )


TRANSFER_ID_BITS = 4
#: A longer record has no CAN FD message [byte].
LARGEST_FD_PAYLOAD = 64
_TRANSFER_ID = SignalSpec(
    TRANSFER_ID,
    TRANSFER_ID_BITS,
    1,
    "",
    "Which transfer the page belongs to: the low bits of Counter. A line is accepted only when all "
    "its pages carry the same number and the checksum over all of them holds.",
    "tells 16 transfers in a row apart, long after a lost page's transfer has timed out",
)


def paged(signals: Sequence[SignalSpec]) -> tuple[tuple[SignalSpec, ...], ...]:
    """Signals on as few pages as a search finds; the header of E2E first.

    Each page is filled as far as its signals allow (a subset sum); where
    the last ones do not fit, other fillings are tried, always the same ones.

    Args:
        signals: the first two are the header; any of 1 to 56 bits.
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
    """Indices of sizes whose sum comes next to ``space`` from below, early ones first."""
    reached: dict[int, tuple[int, ...]] = {0: ()}
    for index, size in enumerate(sizes):
        for total, chosen in list(reached.items()):
            if total + size <= space:
                reached.setdefault(total + size, (*chosen, index))
    return set(reached[max(reached)])


def _secured_specs(freshness_bytes: int, mac_bytes: int) -> tuple[SignalSpec, ...]:
    return (
        SignalSpec(
            "KeyId",
            8,
            1,
            "",
            "Number of the key of the MAC, which covers it.",
            "a byte: the old key and the new one, and room to number them on",
        ),
        SignalSpec(
            "Freshness",
            8 * freshness_bytes,
            1,
            "us",
            "Low bytes of the freshness value: the sender's time since 1970, and always more than "
            "in the frame before.",
            "7 bytes last 2283 years, so each frame says all of it and none is needed to "
            "synchronise; a record of 32 bytes leaves 16 in the next length of CAN FD",
        ),
        SignalSpec(
            "Mac",
            8 * mac_bytes,
            1,
            "",
            "First bytes of the AES-CMAC (RFC 4493).",
            "64 bits, the least that NIST SP 800-38B advises without an analysis of guesses",
        ),
    )


def _page_spec(bits: int) -> SignalSpec:
    return SignalSpec(PAGE, bits, 1, "", "Page of the record: the multiplexer.", "as many as pages")


def _slot_name(slot: Slot) -> str:
    return "".join(part.capitalize() for part in slot.name.split("_"))


def _slot_words(slot: Slot) -> str:
    return slot.name.replace("_", " ").lower()


def _signal(
    spec: SignalSpec,
    start: int,
    suffix: str = "",
    *,
    big_endian: bool = False,
    **multiplexing: Any,
) -> Signal:
    low, high = (None, None) if spec.is_float else spec.range
    return Signal(
        name=spec.name + suffix,
        start=start,
        length=spec.bits,
        byte_order="big_endian" if big_endian else "little_endian",
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


def _attribute_definitions() -> OrderedDict[str, Any]:
    frame_formats = ["StandardCAN", "ExtendedCAN", *["reserved"] * 12, "StandardCAN_FD"]
    definitions = (
        DbcAttributeDefinition("BusType", "CAN", "", "STRING"),
        DbcAttributeDefinition("CovarianceCode", "Cholesky", "", "STRING"),
        DbcAttributeDefinition("MapLineSlot", 0, "BO_", "INT", 0, len(Slot) - 1),
        DbcAttributeDefinition("E2EDataId", 0, "BO_", "INT", 0, 0xFFFF),
        DbcAttributeDefinition("SecOCDataId", 0, "BO_", "INT", 0, 0xFFFF),
        DbcAttributeDefinition("GenMsgCycleTime", 0, "BO_", "INT", 0, 65535),
        DbcAttributeDefinition(
            "GenMsgSendType", "Cyclic", "BO_", "ENUM", choices=["Cyclic", "Event", "IfActive"]
        ),
        DbcAttributeDefinition(
            "VFrameFormat", "StandardCAN", "BO_", "ENUM", choices=[*frame_formats, "ExtendedCAN_FD"]
        ),
    )
    return OrderedDict((definition.name, definition) for definition in definitions)
