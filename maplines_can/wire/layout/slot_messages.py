"""Messages of a record: their CAN IDs, and the layout of the authenticated ones."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from ...values.errors import LayoutError

#: Upper bound of a cycle time and of a time-out, one hour [ms].
MAX_MS = 3_600_000


@dataclass(frozen=True)
class SecuredLayout:
    """Layout of AUTOSAR's secured I-PDU, the payload of an authenticated message.

    The authentic I-PDU comes first: the record, padding, and the key ID in the last byte. The
    truncated freshness value follows (its low bytes), then the truncated MAC (its first bytes).

    Args:
        length: of the secured I-PDU [byte].
        freshness_bytes: of the truncated freshness value, 3 to 7.
        mac_bytes: of the truncated MAC, 1 to 8.
    """

    length: int
    freshness_bytes: int
    mac_bytes: int

    @property
    def authentic_bytes(self) -> int:
        """Length of the authentic I-PDU."""
        return self.length - self.freshness_bytes - self.mac_bytes


@dataclass(frozen=True, kw_only=True)
class RecordMessages:
    """Messages of a record, in each frame format.

    Args:
        name: name of the classic message; without one, of the CAN FD or authenticated message.
        can_id: CAN ID of the classic message with its pages, or None.
        fd_can_id: CAN ID of the CAN FD message, or None.
        is_extended: the classic CAN ID has 29 bits.
        fd_is_extended: the CAN FD ID has 29 bits.
        fd_length: payload length of the CAN FD message: the record and padding [byte].
        data_id: E2E data ID, which the checksum covers, so that a record of another slot is
            detected.
        cycle_ms: cycle time in the DBC [ms]; 0 if it has none.
        secured_can_id: CAN ID of the authenticated CAN FD message, or None.
        secured_is_extended: the CAN ID of the authenticated message has 29 bits.
        secured_data_id: SecOC data ID, which the MAC covers.
    """

    name: str
    can_id: int | None
    fd_can_id: int | None
    is_extended: bool
    fd_is_extended: bool
    fd_length: int
    data_id: int
    cycle_ms: int
    secured_can_id: int | None = None
    secured_is_extended: bool = False
    secured_data_id: int = 0

    @property
    def ids(self) -> dict[tuple[int, bool], bool]:
        """Map from (CAN ID, extended) to whether a frame has the whole record."""
        ids = {
            (self.can_id, self.is_extended): False,
            (self.fd_can_id, self.fd_is_extended): True,
            (self.secured_can_id, self.secured_is_extended): True,
        }
        return {
            (can_id, extended): is_whole
            for (can_id, extended), is_whole in ids.items()
            if can_id is not None
        }

    @property
    def secured_ids(self) -> dict[tuple[int, bool], int]:
        """Map from (CAN ID, extended) of the authenticated message to its SecOC data ID."""
        if self.secured_can_id is None:
            return {}
        return {(self.secured_can_id, self.secured_is_extended): self.secured_data_id}


class Room(NamedTuple):
    """Messages, and what they need room for."""

    name: str  #: of their owner
    messages: RecordMessages
    secured: SecuredLayout | None
    record_bytes: int
    secured_bytes: int  #: of an authenticated record


#: Payload lengths of CAN FD (ISO 11898-1) [byte].
FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)


def fd_length(length: int, multiple: int = 1) -> int:
    """Return the shortest CAN FD payload length of at least ``length`` bytes (ISO 11898-1).

    Args:
        length: [byte].
        multiple: what it must be a multiple of.

    Raises:
        ValueError: none is as long.

    >>> fd_length(24), fd_length(25), fd_length(9), fd_length(9, multiple=8)
    (24, 32, 12, 16)
    """
    found = [n for n in FD_LENGTHS if n >= length and n % multiple == 0]
    if not found:
        raise ValueError(f"a CAN FD frame has 64 bytes at most, but {length} are needed")
    return found[0]


def check_messages(records: Iterable[Room], source: str) -> None:
    """Check that the messages have room for a record, and that their CAN and data IDs are unique.

    Raises:
        LayoutError: two messages have the same CAN ID, two records have the same data ID, or a
            message is too short for a record.
    """
    owners: dict[tuple[str, object], str] = {}
    for name, messages, secured, record_bytes, secured_bytes in records:
        rooms = []
        unique = [
            ("CAN ID", messages.can_id, messages.is_extended, "classic"),
            ("CAN ID", messages.fd_can_id, messages.fd_is_extended, "CAN FD"),
            ("CAN ID", messages.secured_can_id, messages.secured_is_extended, "authenticated"),
            ("E2EDataId", messages.data_id, False, ""),
        ]
        if messages.fd_can_id is not None:
            rooms.append(("CAN FD", messages.fd_length, record_bytes))
        if messages.secured_can_id is not None:
            authentic_bytes = secured.authentic_bytes if secured else 0
            rooms.append(("authenticated", authentic_bytes, secured_bytes + 1))  # with the key ID
            unique.append(("SecOCDataId", messages.secured_data_id, False, ""))
        for frame, room, needed in rooms:
            if room < needed:
                raise LayoutError(
                    f"{source}: {name}: the {frame} message has {room} bytes for the record, but "
                    f"it needs {needed}; make it longer"
                )
        for what, number, extended, frame in unique:
            if number is None:
                continue
            own_name = f"{name} ({frame})" if frame else name
            other = owners.setdefault((what, (number, extended)), own_name)
            if other != own_name:
                raise LayoutError(
                    f"{source}: {other} and {own_name} have the same {what}, {number}, so a record "
                    "of one could be delivered as one of the other; give each its own"
                )
