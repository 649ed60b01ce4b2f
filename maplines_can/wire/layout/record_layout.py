"""Signals of a record, as a DBC describes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

from ...values.errors import LayoutError
from .requirements import in_dbc, pages_of
from .signals import PAGE_BYTES, TRANSFER_ID, Signal


@dataclass(frozen=True, eq=False, kw_only=True)
class RecordLayout:
    """Signals of a record, which is the concatenation of the pages of its messages.

    Args:
        signals: by name, in the order of their bits.
        source: name of the DBC in error messages.
    """

    #: What needs each signal, for error messages.
    needed_by: ClassVar[str] = "each message of a map line"

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
                f"{self.source}: there is no signal {name!r}; {self.needed_by} needs it, "
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

    @property
    def max_age(self) -> float:
        """Greatest age that a record can state [s]; the greatest raw value means "too old"."""
        return self["Age"].physical_one(self["Age"].raw_max - 1) / 1000

    def check_pages(self) -> None:
        """Check that the pages are numbered 0, 1, ..., and that each has a transfer ID.

        Raises:
            LayoutError: they are not, or one has none.
        """
        pages = pages_of(self.signals)
        if pages != list(range(len(pages))) or not pages:
            raise LayoutError(f"{self.source}: pages must be numbered 0, 1, ..., got {pages}")
        for page in reversed(pages):  # the reader derives the first one from the second
            self[f"{TRANSFER_ID}{page}"]

    def error(self, signal: Signal, needs: str, cure: str) -> LayoutError:
        """Return the error that a signal does not have what it needs."""
        return LayoutError(
            f"{self.source}: signal {signal.name} is {in_dbc(signal)}, but it needs {needs}; {cure}"
        )
