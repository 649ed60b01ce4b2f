"""Write the DBC of a record, and the table of its fields, from a description of its signals."""

from __future__ import annotations

import re
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from cantools.database.can import Database, Message, Node, Signal
from cantools.database.can.formats.dbc.dbc_attribute import DbcAttribute
from cantools.database.can.formats.dbc.dbc_attribute_definition import DbcAttributeDefinition
from cantools.database.can.formats.dbc.dbc_specifics import DbcSpecifics

from ...values.line import Slot
from ...values.output_files import whole_file
from ...wire.layout.message_layout import Layout
from ...wire.layout.pose_layout import SCENE2, SCENES
from ...wire.layout.record_signals import PAGE_BYTES, POSE_PREFIX, SECURED_SIGNALS, slot_title
from ...wire.layout.slot_messages import fd_length
from .record_pages import MESSAGES, RecordPages, SceneSpec, SignalSpec, dbc_signal

__all__ = ["TRANSFER_ID_BITS", "DbcWriter", "PoseSpec", "SceneSpec", "SignalSpec", "paged"]

TRANSFER_ID_BITS = 4
#: Largest payload of CAN FD; a longer record has no FD message [byte].
MAX_FD_PAYLOAD = 64


# fmt: off
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
_TRAILER = (
    "the number of the key, the freshness value and the MAC over SecOCDataId, all bytes before "
    "Freshness, and the freshness value in 64 bits."
)
_SCENE = "A whole scene: the pose error and the lines that are seen from this pose, jointly"
_BESIDE = (
    ". Its lines belong to those of Scene if both have the same SceneCounter, and the same pose "
    "error but for Age."
)


@dataclass(frozen=True)
class PoseSpec:
    """Message of the pose error, whose slots are those of the lines."""

    pages: tuple[tuple[SignalSpec, ...], ...]  #: the signals of each page, in the order of bits
    page_bits: int = 3
    transfer_id_bits: int = 2
    can_id: int = 0x35C
    fd_can_id: int = 0x35D
    secured_can_id: int = 0x35E
    data_id: int = 0x4D5C
    secured_data_id: int = 0x4D5E

    @property
    def record(self) -> RecordPages:
        """Pages of the record."""
        return RecordPages(self.pages, self.page_bits, self.transfer_id_bits, POSE_PREFIX)


@dataclass(frozen=True)
class DbcWriter:
    """Writer of a DBC: pages of signals and the slots that have messages, or whole scenes.

    All signals are little-endian, except those that an authenticated message adds, which are
    big-endian as in AUTOSAR.
    """

    pages: tuple[tuple[SignalSpec, ...], ...] = ()  #: the signals of each page, in order of bits
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
    transfer_id_bits: int = TRANSFER_ID_BITS
    optional_pages: int = 0  #: pages at the end that are sent only if HasCovariance is 1
    pose: PoseSpec | None = None  #: message of the pose error, if there is one
    scene: SceneSpec | None = None  #: messages of whole scenes, in place of those of lines

    def __post_init__(self) -> None:
        _ = self.record  # which checks the pages

    @property
    def record(self) -> RecordPages:
        """Pages of the record of a line."""
        return RecordPages(self.pages, transfer_id_bits=self.transfer_id_bits)

    def dbc(self) -> str:
        """Return the text of the DBC."""
        text = str(self.database().as_dbc_string(sort_signals=None)).replace("\r\n", "\n")
        return re.sub(r"^ SG_ .*$", _without_exponents, text, flags=re.MULTILINE)

    def database(self) -> Database:
        """Return the database of the DBC, from which ``Layout.from_dbc`` reads the same layout."""
        definitions = _attribute_definitions()
        for name, part in (
            ("SecOCDataId", self.first_secured_can_id),
            ("MapLinePose", self.pose),
            ("MapLineScene", self.scene),
        ):
            if part is None:
                del definitions[name]
        network = {"BusType": "CAN FD", "CovarianceCode": self.covariance_code}
        return Database(
            messages=list(self._messages()),
            nodes=[
                Node("PositionEcu", "Knows the pose and the map, and sends the lines."),
                Node("AdasEcu", "Fuses the lines, steers by them or checks its camera with them."),
            ],
            version="1",
            dbc_specifics=DbcSpecifics(
                attributes=_attributes(network), attribute_definitions=definitions
            ),
        )

    def layout(self, slots: int = len(Slot)) -> Layout:
        """Return the layout of the DBC, with the first slots only."""
        writer = replace(self, slots=self.slots[:slots])
        return Layout.from_dbc(writer.database())

    def table(self) -> str:
        """Return the fields as a Markdown table, for the page beside the DBC."""
        return self.scene.table() if self.scene else self.record.table()

    def _messages(self) -> Iterator[Message]:
        """Yield the messages of lines, of the pose error and of whole scenes."""
        secured = self.first_secured_can_id
        optional = f"; the last {self.optional_pages} only if HasCovariance is 1"
        for slot in self.slots:
            yield from self._formats(
                self.record,
                slot_title(slot),
                f"The {slot.name.replace('_', ' ').lower()} line",
                (self.first_can_id + slot, self.first_fd_can_id + slot, secured and secured + slot),
                {"MapLineSlot": int(slot), "E2EDataId": self.first_data_id + slot},
                self.first_secured_data_id + slot,
                optional if self.optional_pages else "",
            )
        if pose := self.pose:
            yield from self._formats(
                pose.record,
                "Pose",
                "The pose error, which all lines of a cycle share",
                (pose.can_id, pose.fd_can_id, secured and pose.secured_can_id),
                {"MapLinePose": 1, "E2EDataId": pose.data_id},
                pose.secured_data_id,
            )
        if self.scene:
            yield from self._scene_messages(self.scene)

    def _formats(
        self,
        record: RecordPages,
        name: str,
        what: str,
        can_ids: tuple[int, int, int | None],
        attributes: dict[str, int],
        secured_data_id: int,
        optional: str = "",
    ) -> Iterator[Message]:
        """Yield the classic message of a record, and the FD and authenticated ones if any."""
        can_id, fd_can_id, secured_can_id = can_ids
        size = record.record_bytes
        about = (
            f"{what}: {len(record.pages)} pages, sent back to back with the same transfer number"
            f"{optional}."
        )
        yield self._message(name, can_id, PAGE_BYTES, record.paged(), about, attributes)
        if size <= MAX_FD_PAYLOAD:
            about = f"{what}: the pages of {name} laid end to end."
            signals, length = record.end_to_end(), fd_length(size)
            yield self._message(f"{name}Fd", fd_can_id, length, signals, about, attributes, True)
        if secured_can_id is not None:
            about = f"{what}, authenticated (AUTOSAR SecOC, AES-CMAC): {name}Fd, then {_TRAILER}"
            title, signals = f"{name}SecOc", record.end_to_end()
            yield self._secured(
                title, secured_can_id, signals, size, about, attributes, secured_data_id
            )

    def _scene_messages(self, scene: SceneSpec) -> Iterator[Message]:
        """Yield the messages of whole scenes, and the authenticated ones if any."""
        for i, owner in enumerate(owner for owner in MESSAGES if owner in scene.fixed):
            name, data_id = MESSAGES[owner], scene.first_data_id + i
            attributes = {"MapLineScene": SCENES.index(owner) + 1, "E2EDataId": data_id}
            signals, size = scene.signals(owner, scene.places), scene.record_bytes(scene.places)
            about = f"{_SCENE}{_BESIDE if owner == SCENE2 else '.'}"
            can_id, length = scene.first_can_id + i, fd_length(size, PAGE_BYTES)
            yield self._message(name, can_id, length, signals, about, attributes, True)
            if self.first_secured_can_id is not None:
                places = scene.secured_places
                yield self._secured(
                    f"{name}SecOC",
                    self.first_secured_can_id + i,
                    scene.signals(owner, places),
                    scene.record_bytes(places),
                    f"{name} of {places} lines, authenticated (AUTOSAR SecOC, AES-CMAC): its first "
                    f"bytes, then {_TRAILER}",
                    attributes,
                    data_id + len(MESSAGES),
                )

    def _secured(
        self,
        name: str,
        can_id: int,
        signals: list[Signal],
        size: int,
        about: str,
        attributes: dict[str, int],
        data_id: int,
    ) -> Message:
        """Return the authenticated message of a record of ``size`` bytes."""
        specs = (
            _KEY_ID,
            replace(_FRESHNESS, bits=8 * self.freshness_bytes),
            replace(_MAC, bits=8 * self.mac_bytes),
        )
        tail = sum(spec.bits for spec in specs)
        length = fd_length(size + tail // 8)
        start = 8 * length - tail
        for spec in specs:
            signals.append(dbc_signal(spec, start + 7, byte_order="big_endian"))
            start += spec.bits
        secured = {"SecOCDataId": data_id}
        return self._message(name, can_id, length, signals, about, attributes, True, secured)

    def _message(
        self,
        name: str,
        can_id: int,
        length: int,
        signals: list[Signal],
        about: str,
        attributes: dict[str, int],
        is_fd: bool = False,
        more: dict[str, int] | None = None,
    ) -> Message:
        values = attributes | {
            "GenMsgCycleTime": self.cycle_ms,
            "GenMsgSendType": 0,
            "VFrameFormat": 14 if is_fd else 0,
        }
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
            dbc_specifics=DbcSpecifics(attributes=_attributes(values | (more or {}))),
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
        DbcAttributeDefinition("MapLinePose", 0, "BO_", "INT", 0, 1),
        DbcAttributeDefinition("MapLineScene", 0, "BO_", "INT", 0, len(MESSAGES)),
        DbcAttributeDefinition("E2EDataId", 0, "BO_", "INT", 0, 0xFFFF),
        DbcAttributeDefinition("SecOCDataId", 0, "BO_", "INT", 0, 0xFFFF),
        DbcAttributeDefinition("GenMsgCycleTime", 0, "BO_", "INT", 0, 65535),
        DbcAttributeDefinition("GenMsgSendType", "Cyclic", "BO_", "ENUM", choices=send_types),
        DbcAttributeDefinition("VFrameFormat", "StandardCAN", "BO_", "ENUM", choices=formats),
    )
    return OrderedDict((definition.name, definition) for definition in definitions)


def write_dbc(writer: DbcWriter, path: str | Path, page: Callable[[str], str]) -> tuple[Path, Path]:
    """Write a DBC, and its page with the same name and the suffix ``.md``.

    Args:
        writer: of the DBC.
        path: of the DBC.
        page: gives the text of the page for the name of the DBC.
    """
    dbc = Path(path).with_suffix(".dbc")
    beside = dbc.with_suffix(".md")
    with whole_file(dbc) as part, whole_file(beside) as part_of_page:
        part.write_text(writer.dbc())
        part_of_page.write_text(page(dbc.name))
    return dbc, beside


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
