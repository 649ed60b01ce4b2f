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
from .dbc_reader import default_dbc_path, parse_dbc, read_text
from .signals import (
    HEADER_SIGNALS,
    PAGE,
    PAGE_BYTES,
    PARAMETER_SIGNALS,
    SECURED_SIGNALS,
    TRANSFER_ID,
    Signal,
)
from .slot_messages import SecuredLayout, SlotMessages, fd_length

__all__ = [
    "PAGE",
    "PAGE_BYTES",
    "PARAMETER_SIGNALS",
    "SECURED_SIGNALS",
    "TRANSFER_ID",
    "Layout",
    "default_dbc_path",
    "fd_length",
]


@dataclass(frozen=True, eq=False)
class Layout:
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
        LayoutError: a signal is missing, or the E2E header has the wrong format.
    """

    signals: Mapping[str, Signal]
    messages: Mapping[Slot, SlotMessages]
    covariance_code: str
    source: str
    secured: SecuredLayout | None = None

    def __post_init__(self) -> None:
        for name in HEADER_SIGNALS:
            self[name]
        crc = self["Crc"]
        if crc.length != 16 or crc.start % 8 or crc.big_endian:
            raise LayoutError(f"{self.source}: Crc must be 16 bits, Intel, on a byte boundary")
        if self["Counter"].length < self[f"{TRANSFER_ID}0"].length:
            raise LayoutError(f"{self.source}: Counter must be at least as long as {TRANSFER_ID}")

    @classmethod
    def from_dbc(cls, path: str | Path | None = None) -> Layout:
        """Read a layout from a DBC file; without a path, from the project's ``maplines.dbc``.

        Raises:
            LayoutError: the file is missing, is larger than 64 MB, is not a DBC, or does not
                describe a map line.
        """
        path = default_dbc_path() if path is None else Path(path)
        return cls.from_text(read_text(path), str(path))

    @classmethod
    def from_text(cls, text: str, source: str = "DBC") -> Layout:
        """Read a layout from the text of a DBC, named ``source`` in error messages.

        Raises:
            LayoutError: the text is not a DBC, or does not describe a map line.
        """
        return cls(source=source, **parse_dbc(text, source)._asdict())

    def __getitem__(self, name: str) -> Signal:
        try:
            return self.signals[name]
        except KeyError:
            raise LayoutError(
                f"{self.source}: there is no signal {name!r}; a map line needs it in each message"
            ) from None

    @cached_property
    def pages(self) -> int:
        """Number of pages of a record."""
        return sum(name.startswith(PAGE) for name in self.signals)

    @property
    def record_bytes(self) -> int:
        """Length of a record."""
        return self.pages * PAGE_BYTES

    @property
    def crc_offset(self) -> int:
        """First byte of the checksum within the record."""
        return self["Crc"].start // 8

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
