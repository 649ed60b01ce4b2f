"""Messages of a slot: their CAN IDs, and the layout of the authenticated ones."""

from __future__ import annotations

from dataclasses import dataclass

from ...line import Slot

#: Upper bound of a cycle time and of a time-out, one hour [ms].
LONGEST_MS = 3_600_000


@dataclass(frozen=True)
class SecuredLayout:
    """Layout of AUTOSAR's secured I-PDU, the payload of an authenticated message.

    The authentic I-PDU comes first: the record, padding, and the key ID in the last byte. The
    truncated freshness value follows (its low bytes), then the truncated MAC (its first bytes).

    Args:
        length: of the secured I-PDU [byte].
        freshness_bytes: of the truncated freshness value, 1 to 7.
        mac_bytes: of the truncated MAC, 1 to 8.
    """

    length: int
    freshness_bytes: int
    mac_bytes: int

    @property
    def authentic_bytes(self) -> int:
        """Length of the authentic I-PDU."""
        return self.length - self.freshness_bytes - self.mac_bytes


@dataclass(frozen=True)
class SlotMessages:
    """Messages of one slot, in each frame format.

    Args:
        slot: the line slot.
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


def fd_length(length: int) -> int:
    """Return the shortest CAN FD payload length of at least ``length`` bytes (ISO 11898-1).

    >>> fd_length(24), fd_length(25)
    (24, 32)
    """
    return next(n for n in (*range(9), 12, 16, 20, 24, 32, 48, 64) if n >= length)
