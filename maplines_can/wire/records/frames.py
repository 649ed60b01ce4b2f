"""CAN frames of a record: classic pages, one CAN FD frame, or one authenticated CAN FD frame."""

from __future__ import annotations

from typing import NamedTuple

from ...values.errors import EncodeError, LayoutError
from ..layout.message_layout import Layout
from ..layout.pose_layout import POSE, Owner
from ..layout.signals import PAGE_BYTES
from ..layout.slot_messages import RecordMessages, SecuredLayout
from ..protection.secoc import Authenticator, check_freshness


class Frame(NamedTuple):
    """CAN frame to be sent on any bus."""

    can_id: int
    data: bytes
    is_fd: bool = False
    is_extended: bool = False


class FrameWriter:
    """Writer of the frames of a record; with an authenticator, all frames are authenticated.

    Raises:
        LayoutError: there is an authenticator, but the DBC has no authenticated message, or its
            freshness value is too short.
    """

    def __init__(self, layout: Layout, authenticator: Authenticator | None) -> None:
        if authenticator is not None:
            if layout.secured is None:
                raise LayoutError(
                    f"{layout.source} has no authenticated message (SecOCDataId), and classic CAN "
                    "and plain CAN FD are not authenticated; take maplines-secoc.dbc, or no key"
                )
            check_freshness(authenticator, layout.secured)
        self._layout, self._authenticator = layout, authenticator

    @property
    def is_authenticated(self) -> bool:
        """Whether all frames are authenticated."""
        return self._authenticator is not None

    def write(self, record: bytes, owner: Owner, fd: bool) -> list[Frame]:
        """Return the frames of a record of a line, or of the pose error.

        Raises:
            EncodeError: the DBC has no such message, or classic CAN is requested with an
                authenticator.
        """
        messages = self._layout.messages_of.get(owner)
        if owner != POSE:
            return self._write(record, messages, self._layout.secured, f"slot {owner!r}", fd)
        secured = None if self._layout.pose is None else self._layout.pose.secured
        return self._write(record, messages, secured, "the pose error", fd)

    def _write(
        self,
        record: bytes,
        messages: RecordMessages | None,
        secured: SecuredLayout | None,
        owner: str,
        fd: bool,
    ) -> list[Frame]:
        if self._authenticator is not None:
            if not fd:
                raise EncodeError(
                    "classic CAN is not authenticated; send CAN FD (fd=True), or without a key"
                )
            if messages is None or secured is None or messages.secured_can_id is None:
                raise EncodeError(f"{self._layout.source} has no authenticated message for {owner}")
            data = self._authenticator.secure(record, messages.secured_data_id, secured)
            return [Frame(messages.secured_can_id, data, True, messages.secured_is_extended)]
        can_id = None if messages is None else messages.fd_can_id if fd else messages.can_id
        if messages is None or can_id is None:
            kind = "CAN FD" if fd else "classic"
            raise EncodeError(f"{self._layout.source} has no {kind} message for {owner}")
        if fd:
            padded = record.ljust(messages.fd_length, b"\0")
            return [Frame(can_id, padded, True, messages.fd_is_extended)]
        return [
            Frame(can_id, record[start : start + PAGE_BYTES], False, messages.is_extended)
            for start in range(0, len(record), PAGE_BYTES)
        ]
