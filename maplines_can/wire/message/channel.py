"""Where the lines of a slot travel: CAN IDs, and the form of an authenticated message."""

from __future__ import annotations

from dataclasses import dataclass

from ...line import Slot

__all__ = ["Channel", "SecuredForm"]


@dataclass(frozen=True)
class SecuredForm:
    """The bytes of an authenticated message: AUTOSAR's secured I-PDU.

    The authentic I-PDU (the record, padding, the key's number in the last byte), then the
    low bytes of the freshness value, then the first bytes of the MAC.

    Args:
        length: of the payload.
        freshness_bytes: of the freshness value, 1 to 7.
        mac_bytes: of the MAC, 1 to 8.
    """

    length: int
    freshness_bytes: int
    mac_bytes: int

    @property
    def authentic_bytes(self) -> int:
        """Length of the authentic I-PDU."""
        return self.length - self.freshness_bytes - self.mac_bytes


@dataclass(frozen=True)
class Channel:
    """Where the lines of one slot travel.

    Args:
        slot: the line slot.
        name: name of its classic message, or of its FD message where there is no other.
        can_id: CAN ID of the classic message with its pages, or None.
        fd_can_id: CAN ID of the CAN FD message, or None.
        is_extended: the classic ID has 29 bits.
        fd_is_extended: the CAN FD ID has 29 bits.
        fd_length: payload length of the FD message, the record and padding.
        data_id: what the checksum is salted with, so that no line passes for another.
        cycle_ms: cycle time that the DBC asks for [ms].
        secured_can_id: CAN ID of the authenticated CAN FD message, or None.
        secured_is_extended: the authenticated ID has 29 bits.
        secured_data_id: AUTOSAR's SecOC data ID, which the MAC covers.
    """

    slot: Slot
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
