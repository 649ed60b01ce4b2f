"""Reassembly of records from frames: all pages of one transfer, or nothing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import takewhile
from typing import Generic, Literal, NamedTuple, Protocol, TypeVar

from ...values.errors import LayoutError
from ..layout.packing import pieces_of
from ..layout.pose_layout import Owner
from ..layout.signals import PAGE, PAGE_BYTES, TRANSFER_ID, Signal
from ..reasons import Reason
from ..records.record import Content, RecordReader

#: Owner of records: slots, or the pose error.
Key = TypeVar("Key", bound=Owner)
Key_co = TypeVar("Key_co", bound=Owner, covariant=True)


class ReceivedLayout(Protocol[Key_co]):
    """What the reassembly needs to know of a ``Layout`` or ``PoseLayout``."""

    def __getitem__(self, name: str) -> Signal:
        """Return the signal of this name."""

    @property
    def pages(self) -> int:
        """Number of pages of a record."""

    @property
    def short_pages(self) -> int:
        """Number of pages of a record whose ``HasCovariance`` is 0."""

    @property
    def message_of_id(self) -> Mapping[tuple[int, bool], tuple[Key_co, bool]]:
        """Map from (CAN ID, extended) to (owner, is_whole_record)."""

    @property
    def data_id_of_secured(self) -> Mapping[tuple[int, bool], int]:
        """Map from (CAN ID, extended) to the SecOC data ID."""


class Record(NamedTuple, Generic[Key, Content]):
    """A complete record of a slot, decoded or rejected."""

    slot: Key
    payload: bytes
    t_ns: int  #: time of its first frame [ns]
    frames: int  #: frames that carried it
    content: Content | Reason


@dataclass
class _Transfer:
    """The pages of one transfer received so far."""

    t_ns: int  #: time of the first page
    pages: dict[int, bytes]


class Reassembler(Generic[Key, Content]):
    """Reassembler of multi-frame records, with one state per slot; time is an argument.

    The records of the pose error are those of one more slot, with a ``Reassembler`` of their own.
    A record whose ``HasCovariance`` is 0 ends after the first ``Layout.short_pages``; other pages
    with its transfer ID do not belong to it and are dropped (INCOMPLETE).

    Pages are collected by transfer ID, each transfer by itself, until it is complete or times
    out. A damaged page may damage the transfer whose ID it has, but it neither ends another one nor
    counts as delivered. Pages of a good record are remembered for one time-out; identical pages
    within it are duplicates::

        page   0 1   2       0 1   3       2       0 1 2 3
        ID     7 7   7       8 8   7       8       7 7 7 7
        -----------------------------------------------------> time
               transfer 7 is complete: |           duplicates
               transfer 8 waits for page 3; it is dropped after the time-out

    A transfer ID is used again after as many records as there are IDs. Three rules keep two
    transfers with the same ID apart. Only the first one depends on time:

    - The time-out is by default shorter than the time after which an ID is used again.
    - If the pages with the counter of two transfers have the same ID but different counters, the
      newer one is kept. The transfer with the older one is dropped as a whole (REPLACED).
    - When a good record is complete, an incomplete transfer whose ID is ahead by up to half the
      number of IDs must have begun after it. If it began before, it belongs to the previous round
      of IDs and is dropped (INCOMPLETE).

    ::

        ID     7 7   8 8 8 8  9 9 9 9  ...  15 15 15 15            7 7 7 7
        -----------------------------------------------------> time
               transfer 7 lost two pages    |
                                            it is 8 ahead of 15, but older: dropped

    In the remaining case only the checksum, which covers the whole counter, rejects a record that
    is put together from two transfers; it misses one in 2^16. With transfer IDs of 4 bits, this
    case requires all of the following: the two records are 16 or a multiple of 16 apart; their
    pages arrive within one time-out; the page with the counter is received from only one of them;
    and none of the 8 records before the second one is received completely after the first page.

    Whether a record is new is decided by its counter, see ``SequenceCheck``. Memory is constant:
    each slot has as many transfers as there are transfer IDs.

    Args:
        layout: CAN IDs and pages.
        reader: reader of the records.
        timeouts_ns: longest time between the first and the last page of a transfer, for each slot
            [ns].
        verify: returns the record of an authenticated payload and its data ID, or the reason
            why it is not authentic. If given, only authenticated frames are accepted; if None,
            only unauthenticated ones.
    """

    def __init__(
        self,
        layout: ReceivedLayout[Key],
        reader: RecordReader[Content],
        timeouts_ns: Mapping[Key, int],
        verify: Callable[[bytes, int], bytes | Reason] | None = None,
    ) -> None:
        self._ids, self._data_id_of_secured = layout.message_of_id, layout.data_id_of_secured
        self._reader, self._verify = reader, verify
        self._pages, self._short_pages = layout.pages, layout.short_pages
        self._record_bytes = PAGE_BYTES * layout.pages
        self._timeouts_ns = timeouts_ns
        _, self._read_page = _reader(layout[f"{PAGE}0"])
        self._read_transfer_id = [
            _reader(layout[f"{TRANSFER_ID}{page}"])[1] for page in range(layout.pages)
        ]
        counter = layout["Counter"]
        self._counter_page, self._read_counter = _reader(counter)
        self._counters = 2**counter.length
        self._transfer_ids = 2 ** layout[f"{TRANSFER_ID}0"].length
        self._form: tuple[int, Callable[[bytes], int]] | None = None
        if self._short_pages < self._pages:
            self._form = _reader(layout["HasCovariance"])
        self._incomplete: dict[Key, dict[int, _Transfer]] = {slot: {} for slot in timeouts_ns}
        self._complete: dict[Key, dict[int, Record[Key, Content]]]
        self._complete = {slot: {} for slot in timeouts_ns}
        #: Frames dropped here, by reason.
        self.counts: Counter[Reason] = Counter()

    @property
    def pending(self) -> int:
        """Frames of incomplete transfers."""
        transfers = (t for of_slot in self._incomplete.values() for t in of_slot.values())
        return sum(len(transfer.pages) for transfer in transfers)

    def feed(
        self, can_id: int, data: bytes, t_ns: int, is_extended: bool = False
    ) -> Record[Key, Content] | Reason:
        """Add a frame to its transfer; return the record that it completes.

        Returns:
            The record, or the reason why the frame completes none. All reasons but PENDING are
            counted.
        """
        known = self._ids.get((can_id, is_extended))
        if known is None:
            return self._dropped(Reason.FOREIGN)
        slot, is_whole_record = known
        data_id = self._data_id_of_secured.get((can_id, is_extended))
        if data_id is not None or self._verify is not None:
            return self._feed_secured(slot, data_id, bytes(data), t_ns)
        if is_whole_record:
            if len(data) < self._record_bytes:
                return self._dropped(Reason.LENGTH)
            return self._completed(slot, self._whole(bytes(data)), t_ns, 1)
        if len(data) != PAGE_BYTES:
            return self._dropped(Reason.LENGTH)
        return self._feed_page(slot, bytes(data), t_ns)

    def expire(self, t_ns: int) -> None:
        """Drop the transfers that have timed out at ``t_ns`` [ns]."""
        for slot in self._incomplete:
            self._expire_slot(slot, t_ns)

    def _feed_secured(
        self, slot: Key, data_id: int | None, data: bytes, t_ns: int
    ) -> Record[Key, Content] | Reason:
        if data_id is None:
            return self._dropped(Reason.UNAUTHENTICATED)
        if self._verify is None:
            return self._dropped(Reason.KEY)
        payload = self._verify(data, data_id)
        if isinstance(payload, Reason):
            return self._dropped(payload)
        return self._completed(slot, self._whole(payload), t_ns, 1)

    def _whole(self, data: bytes) -> bytes:
        """Return the record at the beginning of a payload that has room for the longest one."""
        if self._form is not None:
            page, read = self._form
            if not read(data[page * PAGE_BYTES : (page + 1) * PAGE_BYTES]):
                return data[: self._short_pages * PAGE_BYTES]
        return data[: self._record_bytes]

    def _feed_page(self, slot: Key, data: bytes, t_ns: int) -> Record[Key, Content] | Reason:
        page = self._read_page(data)
        if page >= self._pages:
            return self._dropped(Reason.PAGE)
        transfer_id = self._read_transfer_id[page](data)
        self._expire_slot(slot, t_ns)
        incomplete = self._incomplete[slot]
        if transfer_id not in incomplete and self._is_known(slot, transfer_id, page, data, t_ns):
            return self._dropped(Reason.DUPLICATE)
        transfer = incomplete.setdefault(transfer_id, _Transfer(t_ns, {}))
        before = transfer.pages.get(page)
        if before == data:
            return self._dropped(Reason.DUPLICATE)
        if before is not None:
            ahead = self._counters_ahead(page, data, before)
            if 2 * ahead >= self._counters:  # of an older transfer
                return self._dropped(Reason.REPLACED)
            if ahead:  # of a newer one
                self._drop(slot, transfer_id, Reason.REPLACED)
                transfer = incomplete[transfer_id] = _Transfer(t_ns, {})
            else:
                self.counts[Reason.REPLACED] += 1
        transfer.pages[page] = data
        pages = self._needed(transfer)
        if len(transfer.pages) < pages or not all(i in transfer.pages for i in range(pages)):
            return Reason.PENDING
        payload = b"".join(transfer.pages[i] for i in range(pages))
        record = self._completed(slot, payload, transfer.t_ns, pages)
        if foreign := len(transfer.pages) - pages:
            self.counts[Reason.INCOMPLETE] += foreign
        del incomplete[transfer_id]
        return record

    def _needed(self, transfer: _Transfer) -> int:
        """Return the number of pages of the record of a transfer, as far as its pages say it."""
        if self._form is not None:
            page, read = self._form
            if page in transfer.pages and not read(transfer.pages[page]):
                return self._short_pages
        return self._pages

    def _counters_ahead(self, page: int, data: bytes, before: bytes) -> int:
        """Return how far the counter of a page is ahead of another's; 0 if pages have none."""
        if page != self._counter_page:
            return 0
        return (self._read_counter(data) - self._read_counter(before)) % self._counters

    def _completed(self, slot: Key, payload: bytes, t_ns: int, frames: int) -> Record[Key, Content]:
        """Decode a record; remember a good one, and forget those of the previous round of IDs."""
        record = Record(slot, payload, t_ns, frames, self._reader.read(payload, slot, t_ns))
        if not isinstance(record.content, Reason):
            complete, own = self._complete[slot], self._read_transfer_id[0](payload[:PAGE_BYTES])
            complete[own] = record
            half = self._transfer_ids // 2
            for other in [i for i in complete if 0 < (i - own) % self._transfer_ids < half]:
                del complete[other]
            # A dict keeps the order of insertion, so these began before this record.
            begun_before = takewhile(lambda i: i != own, list(self._incomplete[slot]))
            for other in [i for i in begun_before if (i - own) % self._transfer_ids <= half]:
                self._drop(slot, other, Reason.INCOMPLETE)
        return record

    def _is_known(self, slot: Key, transfer_id: int, page: int, data: bytes, t_ns: int) -> bool:
        """Return whether a page is one of a good record not older than the time-out."""
        record = self._complete[slot].get(transfer_id)
        if record is None or self._is_old(slot, record.t_ns, t_ns):
            return False
        return record.payload[page * PAGE_BYTES : (page + 1) * PAGE_BYTES] == data

    def _is_old(self, slot: Key, since_ns: int, t_ns: int) -> bool:
        # Frames may arrive slightly out of order; if the clock is set back, everything is old.
        return abs(t_ns - since_ns) > self._timeouts_ns[slot]

    def _expire_slot(self, slot: Key, t_ns: int) -> None:
        held = self._incomplete[slot].items()
        for i in [i for i, transfer in held if self._is_old(slot, transfer.t_ns, t_ns)]:
            self._drop(slot, i, Reason.TIMEOUT)

    def _drop(self, slot: Key, transfer_id: int, reason: Reason) -> None:
        self.counts[reason] += len(self._incomplete[slot].pop(transfer_id).pages)

    def _dropped(self, reason: Reason) -> Reason:
        self.counts[reason] += 1
        return reason


def _reader(signal: Signal) -> tuple[int, Callable[[bytes], int]]:
    """Return the page of an unsigned signal, and a function that reads it from this page."""
    (page, shift, bits, _), *more = pieces_of(signal)
    if more:
        raise LayoutError(f"signal {signal.name} must lie within a page")
    order: Literal["big", "little"] = "big" if signal.big_endian else "little"
    mask = 2**bits - 1
    return page, lambda data: int.from_bytes(data, order) >> shift & mask
