"""Signals of a record, as a DBC describes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from ...errors import LayoutError
from .requirements import pages_of
from .signals import PAGE_BYTES, Signal


@dataclass(frozen=True, eq=False, kw_only=True)
class RecordLayout:
    """Signals of a record, which is the concatenation of the pages of its messages.

    Args:
        signals: by name, in the order of their bits.
        source: name of the DBC in error messages.
    """

    signals: Mapping[str, Signal]
    source: str

    def __getitem__(self, name: str) -> Signal:
        """Return the signal of this name.

        Raises:
            LayoutError: there is none.
        """
        try:
            return self.signals[name]
        except KeyError:
            raise LayoutError(
                f"{self.source}: there is no signal {name!r}; each message of a map line needs it, "
                "within the pages of 8 bytes"
            ) from None

    @cached_property
    def pages(self) -> int:
        """Number of pages of a record."""
        return len(pages_of(self.signals))

    @property
    def record_bytes(self) -> int:
        """Length of a record."""
        return self.pages * PAGE_BYTES

    @property
    def crc_offset(self) -> int:
        """First byte of the checksum within the record."""
        return self["Crc"].start // 8
