"""Reasons why a received frame does not complete a line."""

from enum import Enum


class Reason(Enum):
    """Reason why a received frame does not complete a line.

    All but PENDING are counted; none is raised.
    """

    PENDING = "held until the other pages of its transfer arrive"
    FOREIGN = "its CAN ID carries no map line"
    LENGTH = "its payload has the wrong length"
    PAGE = "its page number is not in the DBC"
    DUPLICATE = "its page or its line was already received"
    REPLACED = "another frame with its transfer ID was kept in its place"
    STALE = "a line of its slot that is as new or newer was already delivered"
    INCOMPLETE = "a frame of another record or line was received before its own was complete"
    TIMEOUT = "the rest of its transfer or line was not received in time"
    MIXED = "the pages of its record belong to different transfers"
    CRC = "the checksum of its record is wrong"
    CONTENT = "its record holds a value that no sender may send"
    POSE = "the pose error that its record belongs to was not received in time"
    UNAUTHENTICATED = "its message has no MAC, and this receiver requires one"
    KEY = "its MAC is of a key that this receiver does not have"
    MAC = "its MAC is wrong"
    REPLAY = "its MAC is valid, but its freshness value is not newer than the last accepted one"
    AGE = "its MAC is valid, but its freshness value is outside the window about the current time"
    SPACING = "records of its slot follow each other far faster than its cycle"
