"""Reassembly of records from frames: all pages of one transfer, or nothing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Generic, Literal, NamedTuple

from ...values.errors import LayoutError
from ..layout.message_layout import Layout
from ..layout.packing import pieces_of
from ..layout.pose_layout import Owner, PoseLayout
from ..layout.signals import PAGE, PAGE_BYTES, TRANSFER_ID, Signal
from ..reasons import Reason
from ..records.record import Content, RecordReader
from .times import limited_ns

#: Function that returns the record of an authenticated payload and its SecOC data ID, or the
#: reason why it is not authentic, as a ``Verifier`` does.
Verify = Callable[[bytes, int], bytes | Reason]


class Record(NamedTuple, Generic[Content]):
    """A complete record, read or rejected."""

    owner: Owner
    payload: bytes
    t_ns: int  #: time of its first frame [ns]
    frames: int  #: frames that carried it
    content: Content | Reason


@dataclass
class _Transfer:
    """The pages of one transfer received so far."""

    t_ns: int  #: time of the first page
    pages: dict[int, bytes] = field(default_factory=dict)


class _Paging:
    """Pages of the records of a layout: how many there are, and what each page says of itself."""

    def __init__(self, layout: Layout | PoseLayout) -> None:
        self.pages, self._short_pages = layout.pages, layout.short_pages
        self.record_bytes = layout.record_bytes
        self.transfer_ids = 2 ** layout[f"{TRANSFER_ID}0"].length
        _, self.page = _reader(layout[f"{PAGE}0"])
        #: Functions that read the transfer ID of each page.
        self.transfer_id = [_reader(layout[f"{TRANSFER_ID}{i}"])[1] for i in range(self.pages)]
        self._counter_page, self._counter = _reader(layout["Counter"])
        self._counters = 2 ** layout["Counter"].length
        self._form: tuple[int, Callable[[bytes], int]] | None = None
        if self._short_pages < self.pages:
            self._form = _reader(layout["HasCovariance"])

    def whole(self, data: bytes) -> bytes:
        """Return the record at the beginning of a payload that has room for the longest one."""
        if self._form is not None:
            page, read = self._form
            if not read(data[page * PAGE_BYTES : (page + 1) * PAGE_BYTES]):
                return data[: self._short_pages * PAGE_BYTES]
        return data[: self.record_bytes]

    def needed(self, pages: Mapping[int, bytes]) -> int:
        """Return the number of pages of the record of a transfer, as far as its pages say it."""
        if self._form is not None:
            page, read = self._form
            if page in pages and not read(pages[page]):
                return self._short_pages
        return self.pages

    def is_newer(self, page: int, data: bytes, before: bytes) -> bool | None:
        """Return whether a page has a newer counter than another one; None if it has the same.

        A counter is newer if it is ahead by less than half of the modulus. Only one page has it.
        """
        if page != self._counter_page:
            return None
        ahead = (self._counter(data) - self._counter(before)) % self._counters
        return 2 * ahead < self._counters if ahead else None


@dataclass
class _Inbox(Generic[Content]):
    """What was received of the records of one owner."""

    owner: Owner
    paging: _Paging
    timeout_ns: int
    verify: Verify | None
    incomplete: dict[int, _Transfer] = field(default_factory=dict)  #: by transfer ID
    complete: dict[int, Record[Content]] = field(default_factory=dict)  #: good ones, likewise

    def is_old(self, since_ns: int, t_ns: int) -> bool:
        """Return whether a time [ns] is farther from now than the time-out."""
        # Frames may arrive slightly out of order; if the clock is set back, everything is old.
        return abs(t_ns - since_ns) > self.timeout_ns

    def is_known(self, transfer_id: int, page: int, data: bytes, t_ns: int) -> bool:
        """Return whether a page is one of a good record not older than the time-out."""
        record = self.complete.get(transfer_id)
        if record is None or self.is_old(record.t_ns, t_ns):
            return False
        return record.payload[page * PAGE_BYTES : (page + 1) * PAGE_BYTES] == data


class Reassembler(Generic[Content]):
    """Reassembler of multi-frame records, with one state per owner; time is an argument.

    The owners are the slots and, if the DBC has its message, the pose error. A record whose
    ``HasCovariance`` is 0 ends after the first ``Layout.short_pages``; other pages with its
    transfer ID do not belong to it and are dropped (INCOMPLETE).

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
    each owner has as many transfers as there are transfer IDs.

    Args:
        layout: CAN IDs and pages.
        reader: reader of the records.
        timeouts_ns: longest time between the first and the last page of a transfer, for each owner
            [ns].
        verifiers: for each owner whose frames are authenticated; of the others, only
            unauthenticated frames are accepted.
    """

    def __init__(
        self,
        layout: Layout,
        reader: RecordReader[Content],
        timeouts_ns: Mapping[Owner, int],
        verifiers: Mapping[Owner, Verify] | None = None,
    ) -> None:
        self._reader = reader
        self._inboxes: dict[Owner, _Inbox[Content]] = {}
        # By CAN ID: the inbox, whether a frame is a whole record, and its SecOC data ID.
        self._routes: dict[tuple[int, bool], tuple[_Inbox[Content], bool, int | None]] = {}
        verifiers = {} if verifiers is None else verifiers
        for of_owners in (layout, layout.pose):
            if of_owners is None:
                continue
            paging = _Paging(of_owners)
            for can_id, (owner, is_whole) in of_owners.message_of_id.items():
                if owner not in self._inboxes:
                    self._inboxes[owner] = _Inbox(
                        owner, paging, timeouts_ns[owner], verifiers.get(owner)
                    )
                data_id = of_owners.data_id_of_secured.get(can_id)
                self._routes[can_id] = self._inboxes[owner], is_whole, data_id
        #: Frames dropped here, by reason.
        self.counts: Counter[Reason] = Counter()

    @property
    def pending(self) -> int:
        """Frames of incomplete transfers."""
        transfers = (t for inbox in self._inboxes.values() for t in inbox.incomplete.values())
        return sum(len(transfer.pages) for transfer in transfers)

    def owner_of(self, can_id: int, is_extended: bool) -> Owner:
        """Return the owner of the records that frames with this CAN ID carry; it must be known."""
        return self._routes[can_id, is_extended][0].owner

    def feed(
        self, can_id: int, data: bytes, t_ns: int, is_extended: bool = False
    ) -> Record[Content] | Reason:
        """Add a frame to its transfer; return the record that it completes.

        Returns:
            The record, or the reason why the frame completes none. All reasons but PENDING are
            counted.
        """
        route = self._routes.get((can_id, is_extended))
        if route is None:
            return self._dropped(Reason.FOREIGN)
        inbox, is_whole, data_id = route
        t_ns = limited_ns(t_ns, "t_ns")
        if data_id is not None or inbox.verify is not None:
            return self._feed_secured(inbox, data_id, bytes(data), t_ns)
        if is_whole:
            if len(data) < inbox.paging.record_bytes:
                return self._dropped(Reason.LENGTH)
            return self._completed(inbox, inbox.paging.whole(bytes(data)), t_ns, 1)
        if len(data) != PAGE_BYTES:
            return self._dropped(Reason.LENGTH)
        return self._feed_page(inbox, bytes(data), t_ns)

    def expire(self, t_ns: int) -> None:
        """Drop the transfers that have timed out at ``t_ns`` [ns]."""
        for inbox in self._inboxes.values():
            self._expire(inbox, t_ns)

    def _feed_secured(
        self, inbox: _Inbox[Content], data_id: int | None, data: bytes, t_ns: int
    ) -> Record[Content] | Reason:
        if data_id is None:
            return self._dropped(Reason.UNAUTHENTICATED)
        if inbox.verify is None:
            return self._dropped(Reason.KEY)
        payload = inbox.verify(data, data_id)
        if isinstance(payload, Reason):
            return self._dropped(payload)
        return self._completed(inbox, inbox.paging.whole(payload), t_ns, 1)

    def _feed_page(
        self, inbox: _Inbox[Content], data: bytes, t_ns: int
    ) -> Record[Content] | Reason:
        paging, incomplete = inbox.paging, inbox.incomplete
        page = paging.page(data)
        if page >= paging.pages:
            return self._dropped(Reason.PAGE)
        transfer_id = paging.transfer_id[page](data)
        self._expire(inbox, t_ns)
        if transfer_id not in incomplete and inbox.is_known(transfer_id, page, data, t_ns):
            return self._dropped(Reason.DUPLICATE)
        transfer = incomplete.setdefault(transfer_id, _Transfer(t_ns))
        before = transfer.pages.get(page)
        if before == data:
            return self._dropped(Reason.DUPLICATE)
        if before is not None:
            is_newer = paging.is_newer(page, data, before)
            if is_newer is False:  # of an older transfer
                return self._dropped(Reason.REPLACED)
            if is_newer:
                self._drop(inbox, transfer_id, Reason.REPLACED)
                transfer = incomplete[transfer_id] = _Transfer(t_ns)
            else:
                self.counts[Reason.REPLACED] += 1
        transfer.pages[page] = data
        needed = range(paging.needed(transfer.pages))
        if not transfer.pages.keys() >= set(needed):
            return Reason.PENDING
        payload = b"".join(map(transfer.pages.__getitem__, needed))
        record = self._completed(inbox, payload, transfer.t_ns, len(needed))
        if foreign := len(transfer.pages) - len(needed):
            self.counts[Reason.INCOMPLETE] += foreign
        del incomplete[transfer_id]
        return record

    def _completed(
        self, inbox: _Inbox[Content], payload: bytes, t_ns: int, frames: int
    ) -> Record[Content]:
        """Read a record; remember a good one, and forget those of the previous round of IDs."""
        content = self._reader.read(payload, inbox.owner, t_ns)
        record = Record(inbox.owner, payload, t_ns, frames, content)
        if isinstance(content, Reason):
            return record
        own, modulus = inbox.paging.transfer_id[0](payload[:PAGE_BYTES]), inbox.paging.transfer_ids
        inbox.complete[own] = record
        for other in list(inbox.complete):
            if 0 < (other - own) % modulus < modulus // 2:
                del inbox.complete[other]
        for other in list(inbox.incomplete):  # in the order in which they began
            if other == own:
                break
            if (other - own) % modulus <= modulus // 2:
                self._drop(inbox, other, Reason.INCOMPLETE)
        return record

    def _expire(self, inbox: _Inbox[Content], t_ns: int) -> None:
        for transfer_id, transfer in list(inbox.incomplete.items()):
            if inbox.is_old(transfer.t_ns, t_ns):
                self._drop(inbox, transfer_id, Reason.TIMEOUT)

    def _drop(self, inbox: _Inbox[Content], transfer_id: int, reason: Reason) -> None:
        self.counts[reason] += len(inbox.incomplete.pop(transfer_id).pages)

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
