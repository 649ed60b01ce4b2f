"""Reassembly of a record from its pages: all of one transfer, or nothing.

Pages are collected by transfer ID, each transfer by itself::

    page   0 1   2       0 1   3       2       0 1 2 3
    ID     7 7   7       8 8   7       8       7 7 7 7
    -----------------------------------------------------> time
           transfer 7 is complete: |           DUPLICATE, four times
           transfer 8 waits for page 3; it is dropped after the time-out
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from ..wire.layout.record_signals import PAGE_BYTES
from .records import Component, PagedLayout, RawRecord
from .signals import read
from .whole_scenes import WholeRecord

Content = Component | RawRecord | WholeRecord


class Record(NamedTuple):
    """A record all of whose pages have come, with its content or why it is rejected."""

    payload: bytes
    t_ns: int  #: time of its first frame
    frames: int  #: that carried it
    content: Content | str


@dataclass
class _Transfer:
    t_ns: int  #: time of its first page
    pages: dict[int, bytes] = field(default_factory=dict)


class Reassembly:
    """Reassembly of the records of one owner; ``content`` reads one that came at a time."""

    def __init__(
        self,
        layout: PagedLayout,
        content: Callable[[bytes, int], Content | str],
        timeout_ns: int,
        counts: Counter[str],
        transfers: int,
    ) -> None:
        self._layout, self._content = layout, content
        self._timeout_ns = timeout_ns  # longest time between the first and the last page
        self._counts = counts  # dropped frames by reason
        self._ids = 2 ** layout["TransferId0"].length
        self._places = min(self._ids, transfers)  # of transfers that are remembered
        self._incomplete: dict[int, _Transfer] = {}  # by transfer ID, in the order of beginning
        self._complete: dict[int, Record] = {}  # good records, likewise

    @property
    def pending(self) -> int:
        """Frames of incomplete transfers."""
        return sum(len(transfer.pages) for transfer in self._incomplete.values())

    def add_page(self, data: bytes, t_ns: int) -> Record | str:
        """Add a page to its transfer; return the record that it completes, or why none."""
        if len(data) != PAGE_BYTES:
            return "LENGTH"
        page = self._read("Page0", 0, data)
        if page >= self._layout.pages:
            return "PAGE"
        own = self._read(f"TransferId{page}", page, data)
        self.expire(t_ns)
        if own not in self._incomplete and self._is_known(own, page, data, t_ns):
            return "DUPLICATE"
        for other in [*self._incomplete]:
            if other != own and (other - own) % self._places == 0:
                if 2 * ((own - other) % self._ids) > self._ids:
                    return "INCOMPLETE"  # older than what has its place
                self._drop(other, "INCOMPLETE")
        transfer = self._incomplete.setdefault(own, _Transfer(t_ns))
        if page in transfer.pages:
            ahead = self._ahead(page, data, transfer.pages[page])
            if data == transfer.pages[page]:
                return "DUPLICATE"
            if ahead < 0:
                return "REPLACED"  # of an older transfer
            if ahead > 0:  # all that came before is of an older one
                self._drop(own, "REPLACED")
                transfer = self._incomplete[own] = _Transfer(t_ns)
            else:
                self._counts["REPLACED"] += 1
        transfer.pages[page] = data
        needed = range(self._needed(transfer.pages))
        if not transfer.pages.keys() >= {*needed}:
            return "PENDING"
        payload = b"".join(transfer.pages[page] for page in needed)
        record = self.complete(payload, transfer.t_ns, len(needed))
        self._counts["INCOMPLETE"] += len(transfer.pages) - len(needed)  # they belong to no record
        del self._incomplete[own]
        return record

    def complete(self, payload: bytes, t_ns: int, frames: int) -> Record:
        """Read a record; after a good one, forget the previous round of transfer IDs.

        An incomplete transfer whose ID is ahead by up to half the number of IDs must have begun
        after a good record. If it began before, its ID was used before, too::

            ID     7 7   8 8 8 8  9 9 9 9  ...  15 15 15 15            7 7 7 7
            -----------------------------------------------------> time
                   transfer 7 lost two pages    |
                                                it is 8 ahead of 15, but older: INCOMPLETE
        """
        record = Record(payload, t_ns, frames, self._content(payload, t_ns))
        if isinstance(record.content, str):
            return record
        own = record.content.counter % self._ids
        self._complete[own] = record
        for other in [*self._complete]:
            ahead = (other - own) % self._ids
            if 0 < ahead < self._ids // 2 or (ahead > 0 and ahead % self._places == 0):
                del self._complete[other]
        for other in [*self._incomplete]:
            if other == own:
                break
            if (other - own) % self._ids <= self._ids // 2:
                self._drop(other, "INCOMPLETE")
        return record

    def whole(self, payload: bytes) -> bytes:
        """Return the record at the beginning of a payload with room for the longest one."""
        pages = range(self._layout.pages)
        return payload[: PAGE_BYTES * self._needed({i: _page(payload, i) for i in pages})]

    def expire(self, t_ns: int) -> None:
        """Drop what has timed out at a time; if the clock was set back, that is everything."""
        for other, transfer in [*self._incomplete.items()]:
            if abs(t_ns - transfer.t_ns) > self._timeout_ns:
                self._drop(other, "TIMEOUT")

    def _needed(self, pages: dict[int, bytes]) -> int:
        """Return how many pages the record has, as far as those that have come say it."""
        if self._layout.short_pages < self._layout.pages:
            page = self._layout["HasCovariance"].start // (8 * PAGE_BYTES)
            if page in pages and not self._read("HasCovariance", page, pages[page]):
                return self._layout.short_pages
        return self._layout.pages

    def _is_known(self, own: int, page: int, data: bytes, t_ns: int) -> bool:
        """Return whether a page is one of a good record that is not older than the time-out."""
        record = self._complete.get(own)
        is_recent = record is not None and abs(t_ns - record.t_ns) <= self._timeout_ns
        return record is not None and is_recent and _page(record.payload, page) == data

    def _ahead(self, page: int, data: bytes, before: bytes) -> int:
        """Return whether the counter of a page is newer (1) or older (-1) than that of another.

        It is newer if it is ahead by less than half of the modulus; only one page has it.
        """
        counter = self._layout["Counter"]
        if page != counter.start // (8 * PAGE_BYTES):
            return 0
        one, other = (self._read("Counter", page, of_page) for of_page in (data, before))
        ahead, modulus = (one - other) % 2**counter.length, 2**counter.length
        return 0 if ahead == 0 else 1 if 2 * ahead < modulus else -1

    def _read(self, name: str, page: int, data: bytes) -> int:
        """Return the raw value of a signal of a page."""
        return read(self._layout[name], bytes(PAGE_BYTES * page) + data)

    def _drop(self, transfer_id: int, reason: str) -> None:
        self._counts[reason] += len(self._incomplete.pop(transfer_id).pages)


def _page(payload: bytes, page: int) -> bytes:
    return payload[PAGE_BYTES * page : PAGE_BYTES * (page + 1)]
