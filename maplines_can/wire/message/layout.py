"""Layout of a record, and the messages that carry it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...errors import EncodeError, LayoutError
from ...line import Slot
from .dbc_reader import Database, content_of, default_dbc_path, parse_dbc, read_text
from .record_layout import RecordLayout
from .requirements import check_record, pages_of
from .signals import (
    HEADER_SIGNALS,
    PAGE,
    PAGE_BYTES,
    PARAMETER_SIGNALS,
    SECURED_SIGNALS,
    TRANSFER_ID,
    slot_title,
)
from .slot_messages import SecuredLayout, SlotMessages, check_messages, fd_length

__all__ = [
    "PAGE",
    "PAGE_BYTES",
    "PARAMETER_SIGNALS",
    "SECURED_SIGNALS",
    "TRANSFER_ID",
    "Layout",
    "default_dbc_path",
    "fd_length",
    "slot_title",
]


@dataclass(frozen=True, eq=False, kw_only=True)
class Layout(RecordLayout):
    """Layout of a record and the messages that carry it, as a DBC describes them.

    A record is the concatenation of the pages of a multiplexed classic message, and the payload
    of one CAN FD message. A signal that every page repeats has the page number added to its name:
    ``Page0``, ``TransferId0``, ``Page1``, ... If the DBC has no transfer ID in the first page,
    that page's transfer ID is the low bits of ``Counter``.

    Args:
        signals: by name, in the order of their bits.
        messages: by slot.
        covariance_code: name of the covariance code.
        source: name of the DBC in error messages.
        secured: layout of the authenticated messages; None if there are none.

    Raises:
        LayoutError: a signal is missing or does not meet its ``requirements``, two messages have
            the same CAN ID, or two slots the same data ID.
    """

    messages: Mapping[Slot, SlotMessages]
    covariance_code: str
    secured: SecuredLayout | None = None

    def __post_init__(self) -> None:
        for name in (*HEADER_SIGNALS, *PARAMETER_SIGNALS):
            self[name]
        pages = pages_of(self.signals)
        if pages != list(range(len(pages))) or not pages:
            raise LayoutError(f"{self.source}: pages must be numbered 0, 1, ..., got {pages}")
        for page in reversed(pages):  # the reader derives the first one from the second
            self[f"{TRANSFER_ID}{page}"]
        check_record(self.signals, self.source)
        check_messages(self.messages, self.secured, self.record_bytes, self.source)

    @classmethod
    def from_dbc(cls, dbc: str | Path | Database | None = None) -> Layout:
        """Read a layout from a DBC file, or from a database that cantools has loaded from one.

        By default, the DBC is the project's ``maplines.dbc``.

        Raises:
            LayoutError: the file is missing, is larger than 64 MB, is not a DBC, or does not
                describe a map line.
            TypeError: it is neither a path nor a ``cantools.database.can.Database``.
        """
        if isinstance(dbc, str | Path | None):
            path = default_dbc_path() if dbc is None else Path(dbc)
            return cls.from_text(read_text(path), str(path))
        if not isinstance(dbc, Database):
            raise TypeError(
                "dbc must be a path, or a Database that cantools has loaded from a DBC, got a "
                f"{type(dbc).__name__}"
            )
        source = "the cantools database"
        return cls(source=source, **content_of(dbc, source)._asdict())

    @classmethod
    def from_text(cls, text: str, source: str = "DBC") -> Layout:
        """Read a layout from the text of a DBC, named ``source`` in error messages.

        Raises:
            LayoutError: the text is not a DBC, or does not describe a map line.
        """
        return cls(source=source, **parse_dbc(text, source)._asdict())

    @cached_property
    def resolution(self) -> NDArray[np.float64]:
        """(4,) variances of the mean's rounding error, factor^2 / 12, in SI units squared."""
        return np.array([self[name].factor ** 2 / 12 for name in PARAMETER_SIGNALS])

    @property
    def max_age(self) -> float:
        """Greatest age that a record can state [s]; the greatest raw value means "too old"."""
        return self["Age"].physical_one(self["Age"].raw_max - 1) / 1000

    @cached_property
    def message_of_id(self) -> dict[tuple[int, bool], tuple[Slot, bool]]:
        """Map from (CAN ID, extended) to (slot, is_whole_record)."""
        ids = {}
        for messages in self.messages.values():
            if messages.can_id is not None:
                ids[messages.can_id, messages.is_extended] = (messages.slot, False)
            if messages.fd_can_id is not None:
                ids[messages.fd_can_id, messages.fd_is_extended] = (messages.slot, True)
            if messages.secured_can_id is not None:
                ids[messages.secured_can_id, messages.secured_is_extended] = (messages.slot, True)
        return ids

    @property
    def can_ids(self) -> frozenset[int]:
        """CAN IDs of all lines, for filters."""
        return frozenset(can_id for can_id, _ in self.message_of_id)

    @cached_property
    def data_id_of_secured(self) -> dict[tuple[int, bool], int]:
        """Map from (CAN ID, extended) to the SecOC data ID."""
        return {
            (messages.secured_can_id, messages.secured_is_extended): messages.secured_data_id
            for messages in self.messages.values()
            if messages.secured_can_id is not None
        }

    def data_ids(self, slot: ArrayLike, n: int) -> NDArray[np.uint16]:
        """Return the (n,) E2E data IDs of slots, (n,) or one for all.

        Raises:
            EncodeError: the DBC has no message for a slot.
        """
        given = np.broadcast_to(np.asarray(slot), n)
        slots = given.astype(np.int64)
        table = np.full(max(Slot) + 1, -1)
        for known, messages in self.messages.items():
            table[known] = messages.data_id
        bad = (slots < 0) | (slots > max(Slot)) | (slots != given)
        bad |= table[slots.clip(0, max(Slot))] < 0
        if bad.any():
            raise EncodeError(f"{self.source} has no message for slot {given[bad][0]}")
        return table[slots].astype(np.uint16)
