"""From frames to records: all pages of one burst, or nothing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Literal, NamedTuple

from ..errors import LayoutError
from ..line import Slot
from .layout import BURST, PAGE, PAGE_BYTES, Field, Layout
from .packing import pieces_of

__all__ = ["Reason", "Reassembler", "Record"]


class Reason(Enum):
    """What became of a frame that delivered no line. Counted, never raised."""

    PENDING = "held until the other pages of its burst are there"
    FOREIGN = "its CAN ID carries no map line"
    LENGTH = "its payload has the wrong length"
    PAGE = "its page number is not in the DBC"
    DUPLICATE = "its page is there already, or its line was already delivered"
    STALE = "its burst was already given up"
    INCOMPLETE = "another page of its burst was lost"
    TIMEOUT = "the rest of its burst did not come in time"
    MIXED = "the pages of its record do not belong together"
    CRC = "the checksum of its record does not hold"
    CONTENT = "its record says what no sender may say"


class Record(NamedTuple):
    """A whole record of a slot, not yet checked."""

    slot: Slot
    payload: bytes
    t_ns: int  #: of its first frame
    frames: int  #: that carried it


@dataclass
class _Burst:
    """The pages of one burst that have come so far."""

    number: int
    t_ns: int  #: of the first page
    pages: dict[int, bytes]


class Reassembler:
    """Pages to records, a state machine per slot; time is an argument.

    A slot holds one burst at a time. A page of a newer burst (up to half the
    numbers ahead) ends the one that is held; a page of an older one is dropped,
    unless the held burst has timed out: then the sender may have started anew.
    What was delivered last is remembered as long, against duplicates.
    Memory is constant: one burst a slot.

    Args:
        layout: which IDs and how many pages.
        timeout_ns: how long a burst may take [ns].
    """

    def __init__(self, layout: Layout, timeout_ns: int) -> None:
        self._ids = layout.page_of_id
        self._pages = layout.pages
        self._record_bytes = layout.record_bytes
        self._timeout_ns = timeout_ns
        self._read_page = _reader(layout[f"{PAGE}0"])
        self._read_burst = _reader(layout[f"{BURST}0"])
        self._bursts = 2 ** layout[f"{BURST}0"].length
        self._held: dict[Slot, _Burst] = {}
        self._done: dict[Slot, _Burst] = {}
        #: Frames by what became of them; those of delivered lines are not in it.
        self.counts: Counter[Reason] = Counter()

    @property
    def pending(self) -> int:
        """Frames that are held."""
        return sum(len(burst.pages) for burst in self._held.values())

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
        if is_fd:
            if len(data) < self._record_bytes:
                return self._dropped(Reason.LENGTH)
            return self._feed_record(slot, bytes(data[: self._record_bytes]), t_ns)
        if len(data) != PAGE_BYTES:
            return self._dropped(Reason.LENGTH)
        return self._feed_page(slot, bytes(data), t_ns)

    def expire(self, t_ns: int) -> None:
        """Give up the bursts that have taken too long by now."""
        for slot, burst in list(self._held.items()):
            if self._is_old(burst, t_ns):
                self._give_up(slot, Reason.TIMEOUT)

    def _feed_page(self, slot: Slot, data: bytes, t_ns: int) -> Record | Reason:
        page, number = self._read_page(data), self._read_burst(data)
        if page >= self._pages:
            return self._dropped(Reason.PAGE)
        if late := self._late(slot, number, t_ns):
            return self._dropped(late)
        held = self._held.get(slot)
        if held and self._is_old(held, t_ns):
            self._give_up(slot, Reason.TIMEOUT)
            held = None
        if held and held.number != number:
            if not self._is_newer(number, held.number):
                return self._dropped(Reason.STALE)
            self._give_up(slot, Reason.INCOMPLETE)
            held = None
        if held is None:
            held = self._held[slot] = _Burst(number, t_ns, {})
        if page in held.pages:
            return self._dropped(Reason.DUPLICATE)
        held.pages[page] = data
        if len(held.pages) < self._pages:
            return Reason.PENDING
        del self._held[slot]
        self._done[slot] = held
        payload = b"".join(held.pages[i] for i in range(self._pages))
        return Record(slot, payload, held.t_ns, self._pages)

    def _feed_record(self, slot: Slot, payload: bytes, t_ns: int) -> Record | Reason:
        number = self._read_burst(payload[:PAGE_BYTES])
        if late := self._late(slot, number, t_ns):
            return self._dropped(late)
        self._done[slot] = _Burst(number, t_ns, {})
        return Record(slot, payload, t_ns, 1)

    def _late(self, slot: Slot, number: int, t_ns: int) -> Reason | None:
        """Whether a burst is the last one again, or comes after a newer one."""
        done = self._done.get(slot)
        if done is None or self._is_old(done, t_ns):
            return None
        if done.number == number:
            return Reason.DUPLICATE
        return None if self._is_newer(number, done.number) else Reason.STALE

    def _is_newer(self, number: int, than: int) -> bool:
        return 0 < (number - than) % self._bursts <= self._bursts // 2

    def _is_old(self, burst: _Burst, t_ns: int) -> bool:
        # Time stamps may swap by a little; a clock that was set back makes every burst old.
        return abs(t_ns - burst.t_ns) > self._timeout_ns

    def _give_up(self, slot: Slot, reason: Reason) -> None:
        self.counts[reason] += len(self._held.pop(slot).pages)

    def _dropped(self, reason: Reason) -> Reason:
        self.counts[reason] += 1
        return reason


def _reader(field: Field) -> Callable[[bytes], int]:
    """Reads one field out of a page."""
    (_, shift, bits, _), *more = pieces_of(field)
    if more:
        raise LayoutError(f"signal {field.name} must lie within a page")
    order: Literal["big", "little"] = "big" if field.big_endian else "little"
    mask = 2**bits - 1
    return lambda data: int.from_bytes(data, order) >> shift & mask
