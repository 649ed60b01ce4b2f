"""J1939: parameter groups of identifiers, and messages of more than 8 bytes put together.

A parameter group (PGN) is sent by any address and with any priority, so its identifier in a DBC is
an example. The transport protocol of J1939-21 sends 9 to 1785 bytes as packets of 7 bytes, after an
announcement to all (BAM) or to one receiver (RTS), whose CTS says which packet comes next:

    BAM 20 bytes, 3 packets, PGN    CM  20 14 00 03 ff ca fe 00
    packets                         DT  01 ..   DT  02 ..   DT  03 ..
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from ..dbc_files.parser import Database, Message

#: Parameter groups of the transport protocol: connection management, and data.
TP_CM, TP_DT = 0xEC00, 0xEB00
#: Controls of the connection management.
RTS, CTS, BAM, ABORT = 16, 17, 32, 255
#: Bytes of data in a packet; least and most bytes of a message.
PACKET, LEAST, MOST = 7, 9, 1785
#: Address that a DBC states for any sender.
ANY_SOURCE = 0xFE


def pgn_of(can_id: int) -> int:
    """Return the parameter group of an identifier.

    >>> hex(pgn_of(0x18FEF127)), hex(pgn_of(0x18EF0527))  # the second is sent to address 5
    ('0xfef1', '0xef00')
    """
    pgn = can_id >> 8 & 0x3FFFF
    return pgn if can_id >> 16 & 0xFF >= 240 else pgn & 0x3FF00


def source_of(can_id: int) -> int:
    """Return the address of the sender."""
    return can_id & 0xFF


def j1939_messages(database: Database) -> list[Message]:
    """Return the messages that are parameter groups.

    They are those whose VFrameFormat is J1939PG, and, if the ProtocolType of the DBC is J1939, the
    extended ones that state no VFrameFormat.
    """
    dbc = database.dbc
    stated = None if dbc is None else dbc.attributes.get("ProtocolType")
    by_default = None if dbc is None else dbc.attribute_definitions.get("ProtocolType")
    protocol = getattr(by_default, "default_value", None) if stated is None else stated.value

    def is_group(message: Message) -> bool:
        own = message.dbc.attributes if message.dbc else {}
        return message.is_extended_frame and (
            message.protocol == "j1939" or (protocol == "J1939" and "VFrameFormat" not in own)
        )

    return [message for message in database.messages if is_group(message)]


def nearest(can_id: int, messages: Iterable[Message]) -> Message | None:
    """Return which message of one parameter group a frame has; None if it is undecided.

    Of several, it is that with the addresses of the frame, with its source, or with `ANY_SOURCE`.
    """
    found = list(messages)
    addresses = can_id & (0xFF if can_id >> 16 & 0xFF >= 240 else 0xFFFF)
    for mask, wanted in ((0, 0), (0xFFFF, addresses), (0xFF, addresses & 0xFF), (0xFF, ANY_SOURCE)):
        if mask == 0xFFFF and can_id >> 16 & 0xFF >= 240:
            continue
        like = [message for message in found if message.frame_id & mask == wanted]
        if len(like) == 1:
            return like[0]
    return None


class Whole(NamedTuple):
    """Message that is put together."""

    can_id: int  #: as if it were one frame
    data: bytes


@dataclass
class _Transfer:
    pgn: int
    size: int
    data: bytearray = field(default_factory=bytearray)


class Reassembler:
    """Reassembler of messages of the transport protocol, frame by frame.

    ::

        announced ---- packet n + 1 ----> announced ---- last packet ----> whole
            |                                |
            +- other packet, abort, another announcement: incomplete

    Args:
        pgns: parameter groups to put together.
    """

    def __init__(self, pgns: Iterable[int]) -> None:
        #: Numbers of transfers that are not complete, or not yet, by parameter group.
        self.incomplete: Counter[int] = Counter()
        self._pgns = frozenset(pgns)
        self._transfers: dict[tuple[str, int], _Transfer] = {}

    def feed(self, can_id: int, data: bytes, channel: str = "") -> Whole | None:
        """Return the message that a frame completes; None for any other frame."""
        pgn, key = pgn_of(can_id), (channel, can_id & 0xFFFF)
        if len(data) != PACKET + 1:
            return None
        if pgn == TP_CM:
            self._connect(can_id, data, channel)
        elif pgn == TP_DT and (transfer := self._transfers.get(key)):
            if data[0] != len(transfer.data) // PACKET + 1:
                del self._transfers[key]
                return None
            transfer.data += data[1:]
            if len(transfer.data) >= transfer.size:
                del self._transfers[key]
                self.incomplete[transfer.pgn] -= 1
                to = 0 if transfer.pgn & 0xFF00 >= 0xF000 else can_id & 0xFF00
                whole = can_id & 0x1C000000 | transfer.pgn << 8 | to | source_of(can_id)
                return Whole(whole, bytes(transfer.data[: transfer.size]))
        return None

    def _connect(self, can_id: int, data: bytes, channel: str) -> None:
        """Begin, resume or end a transfer."""
        control, size, pgn = data[0], data[1] | data[2] << 8, int.from_bytes(data[5:8], "little")
        key = channel, can_id & 0xFFFF
        back = channel, (can_id & 0xFF) << 8 | can_id >> 8 & 0xFF  # of the receiver's answers
        if control in (RTS, BAM):
            self._transfers.pop(key, None)
            if pgn in self._pgns and LEAST <= size <= MOST and data[3] == -(-size // PACKET):
                self._transfers[key] = _Transfer(pgn, size)
                self.incomplete[pgn] += 1
        elif control == CTS and data[1] and (transfer := self._transfers.get(back)):
            if transfer.pgn == pgn:
                del transfer.data[max(data[2] - 1, 0) * PACKET :]  # these are sent again
        elif control == ABORT:
            for one in (key, back):
                if one in self._transfers and self._transfers[one].pgn == pgn:
                    del self._transfers[one]
