"""From frames to records: all pages of one transfer, or nothing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

from ...errors import LayoutError
from ...line import Slot
from ..message.layout import PAGE, PAGE_BYTES, TRANSFER_ID, Layout
from ..message.packing import pieces_of
from ..message.signals import Signal
from ..reasons import Reason

__all__ = ["Reassembler", "Record"]


class Record(NamedTuple):
    """A whole record of a slot, not yet checked."""

    slot: Slot
    payload: bytes
    t_ns: int  #: of its first frame
    frames: int  #: that carried it
    transfer: int  #: its number


@dataclass
class _Transfer:
    """The pages of one transfer that have come so far."""

    t_ns: int  #: of the first page
    pages: dict[int, bytes]


class Reassembler:
    """Pages to records, a state machine per slot; time is an argument.

    Pages are gathered by transfer number, each transfer by itself, until it is whole
    or times out. Nothing moves anything else: a damaged page may spoil its own
    transfer, but neither ends another nor counts as delivered. ``remember`` says which
    records hold; for the length of a time-out their pages are duplicates.
    Whether a record is news its counter says, which is not the business of this class.
    Memory is constant: each slot has as many transfers as there are numbers.

    Args:
        layout: which IDs and how many pages.
        timeout_ns: how long a transfer may take [ns].
        verify: from an authenticated payload and its data ID to the record, or why not; with
            it nothing else is taken, and without it nothing that is authenticated.
    """

    def __init__(
        self,
        layout: Layout,
        timeout_ns: int,
        verify: Callable[[bytes, int], bytes | Reason] | None = None,
    ) -> None:
        self._ids = layout.page_of_id
        self._data_id_of_secured, self._verify = layout.data_id_of_secured, verify
        self._pages = layout.pages
        self._record_bytes = layout.record_bytes
        self._timeout_ns = timeout_ns
        self._read_page = _reader(layout[f"{PAGE}0"])
        self._read_transfer_id = [
            _reader(layout[f"{TRANSFER_ID}{page}"]) for page in range(layout.pages)
        ]
        self._transfers = 2 ** layout[f"{TRANSFER_ID}0"].length
        self._held: dict[Slot, dict[int, _Transfer]] = {slot: {} for slot in layout.channels}
        self._whole: dict[Slot, dict[int, Record]] = {slot: {} for slot in layout.channels}
        #: Frames by what became of them; those of delivered lines are not in it.
        self.counts: Counter[Reason] = Counter()

    @property
    def pending(self) -> int:
        """Frames that are held."""
        transfers = (transfer for held in self._held.values() for transfer in held.values())
        return sum(len(transfer.pages) for transfer in transfers)

    def feed(
        self, can_id: int, data: bytes, t_ns: int, is_extended: bool = False
    ) -> Record | Reason:
        """Take a frame.

        Returns:
            The record that it completes, or what became of it.
        """
        known = self._ids.get((can_id, is_extended))
        if known is None:
            return self._dropped(Reason.FOREIGN)
        slot, is_fd = known
        data_id = self._data_id_of_secured.get((can_id, is_extended))
        if data_id is not None or self._verify is not None:
            return self._feed_secured(slot, data_id, bytes(data), t_ns)
        if is_fd:
            if len(data) < self._record_bytes:
                return self._dropped(Reason.LENGTH)
            return self._feed_record(slot, bytes(data[: self._record_bytes]), t_ns)
        if len(data) != PAGE_BYTES:
            return self._dropped(Reason.LENGTH)
        return self._feed_page(slot, bytes(data), t_ns)

    def remember(self, record: Record) -> None:
        """The record holds: its pages are known, and those of the next transfers are not."""
        whole = self._whole[record.slot]
        whole[record.transfer] = record
        for number in [
            n for n in whole if (n - record.transfer) % self._transfers < self._transfers // 2
        ]:
            if number != record.transfer:
                del whole[number]

    def expire(self, t_ns: int) -> None:
        """Give up the transfers that have taken too long by now."""
        for slot in self._held:
            self._expire_slot(slot, t_ns)

    def _feed_secured(
        self, slot: Slot, data_id: int | None, data: bytes, t_ns: int
    ) -> Record | Reason:
        if data_id is None:
            return self._dropped(Reason.UNAUTHENTICATED)
        if self._verify is None:
            return self._dropped(Reason.KEY)
        payload = self._verify(data, data_id)
        if isinstance(payload, Reason):
            return self._dropped(payload)
        return self._feed_record(slot, payload[: self._record_bytes], t_ns)

    def _feed_record(self, slot: Slot, payload: bytes, t_ns: int) -> Record:
        return Record(slot, payload, t_ns, 1, self._read_transfer_id[0](payload[:PAGE_BYTES]))

    def _feed_page(self, slot: Slot, data: bytes, t_ns: int) -> Record | Reason:
        page = self._read_page(data)
        if page >= self._pages:
            return self._dropped(Reason.PAGE)
        number = self._read_transfer_id[page](data)
        self._expire_slot(slot, t_ns)
        if number not in self._held[slot] and self._is_known(slot, number, page, data, t_ns):
            return self._dropped(Reason.DUPLICATE)
        transfer = self._held[slot].setdefault(number, _Transfer(t_ns, {}))
        before = transfer.pages.get(page)
        if before == data:
            return self._dropped(Reason.DUPLICATE)
        if before is not None:
            self.counts[Reason.REPLACED] += 1
        transfer.pages[page] = data
        if len(transfer.pages) < self._pages:
            return Reason.PENDING
        del self._held[slot][number]
        payload = b"".join(transfer.pages[i] for i in range(self._pages))
        return Record(slot, payload, transfer.t_ns, self._pages, number)

    def _is_known(self, slot: Slot, number: int, page: int, data: bytes, t_ns: int) -> bool:
        """Whether a page is of a record that was whole a moment ago."""
        record = self._whole[slot].get(number)
        if record is None or self._is_old(record.t_ns, t_ns):
            return False
        return record.payload[page * PAGE_BYTES : (page + 1) * PAGE_BYTES] == data

    def _is_old(self, since_ns: int, t_ns: int) -> bool:
        # Time stamps may swap by a little; a clock that was set back makes all that was old.
        return abs(t_ns - since_ns) > self._timeout_ns

    def _expire_slot(self, slot: Slot, t_ns: int) -> None:
        held = self._held[slot]
        for number in [n for n, transfer in held.items() if self._is_old(transfer.t_ns, t_ns)]:
            self._give_up(slot, number, Reason.TIMEOUT)

    def _give_up(self, slot: Slot, number: int, reason: Reason) -> None:
        self.counts[reason] += len(self._held[slot].pop(number).pages)

    def _dropped(self, reason: Reason) -> Reason:
        self.counts[reason] += 1
        return reason


def _reader(field: Signal) -> Callable[[bytes], int]:
    """Reads one field out of the page in which it lies."""
    (_, shift, bits, _), *more = pieces_of(field)
    if more:
        raise LayoutError(f"signal {field.name} must lie within a page")
    order: Literal["big", "little"] = "big" if field.big_endian else "little"
    mask = 2**bits - 1
    return lambda data: int.from_bytes(data, order) >> shift & mask
