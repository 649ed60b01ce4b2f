"""Reasons why a received frame gives no line."""

from enum import Enum

__all__ = ["NOT_BELIEVED", "Reason"]


class Reason(Enum):
    """What became of a frame that delivered no line. Counted, never raised."""

    PENDING = "held until the other pages of its transfer are there"
    FOREIGN = "its CAN ID carries no map line"
    LENGTH = "its payload has the wrong length"
    PAGE = "its page number is not in the DBC"
    DUPLICATE = "its page or its line came already"
    REPLACED = "another frame of the same transfer and page took its place"
    STALE = "a line of its slot that is as new or newer was already delivered"
    INCOMPLETE = "a part of another line came before its own was complete"
    TIMEOUT = "the rest of its transfer or line did not come in time"
    MIXED = "the pages of its record do not belong together"
    CRC = "the checksum of its record does not hold"
    CONTENT = "its record says what no sender may say"
    UNAUTHENTICATED = "its message has no MAC, and this receiver asks for one"
    KEY = "its MAC is made with a key that this receiver does not have"
    MAC = "its MAC does not hold"
    REPLAY = "its MAC holds, but its freshness value is not newer than the last one accepted"
    AGE = "its MAC holds, but its freshness value is not of this time"


#: Of frames that say nothing of a line, since nobody knows who sent them or when.
NOT_BELIEVED = frozenset(
    {Reason.UNAUTHENTICATED, Reason.KEY, Reason.MAC, Reason.REPLAY, Reason.AGE}
)
