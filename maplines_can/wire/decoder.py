"""A receiver's state: frames in, map lines out, everything else counted."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from ..line import MapLine, Slot
from .reassembly import Reason, Reassembler, Record

if TYPE_CHECKING:
    from .codec import Codec

__all__ = ["Decoder"]


class Decoder:
    """A receiver's state: frames in, map lines out, everything else counted.

    Made by ``Codec.decoder``. At any time
    ``frames == line_frames + sum(counts.values()) + pending``.
    """

    def __init__(self, codec: Codec, timeout_ns: int) -> None:
        self._codec = codec
        self._reassembler = Reassembler(codec.layout, timeout_ns)
        self._counters: dict[Slot, int] = {}
        self.frames = 0  #: frames fed
        self.lines = 0  #: lines delivered
        self.line_frames = 0  #: frames of the lines delivered
        self.lost = 0  #: lines missing between those delivered, by their counters

    @property
    def counts(self) -> Counter[Reason]:
        """Dropped frames by reason."""
        return self._reassembler.counts

    @property
    def pending(self) -> int:
        """Frames held for bursts that are not complete yet."""
        return self._reassembler.pending

    def feed(
        self, can_id: int, data: bytes, t_ns: int, *, is_extended: bool = False
    ) -> MapLine | Reason:
        """Take a frame. Whatever it is, this does not raise.

        Args:
            can_id: its ID.
            data: its payload.
            t_ns: when it was received, on any clock that goes on [ns].
            is_extended: it has a 29-bit ID.

        Returns:
            The line that it completes, or why there is none (PENDING: not yet).
        """
        self.frames += 1
        record = self._reassembler.feed(can_id, data, t_ns, is_extended)
        if isinstance(record, Reason):
            return record
        return self._read(record)

    def expire(self, t_ns: int) -> None:
        """Give up bursts that are not complete by ``t_ns`` [ns] less the time-out."""
        self._reassembler.expire(t_ns)

    def _read(self, record: Record) -> MapLine | Reason:
        line = self._codec.decode_one(record.payload, record.slot, record.t_ns)
        if isinstance(line, Reason):
            self.counts[line] += record.frames
            return line
        counter = self._codec.counter_of(record.payload)
        modulus = 2 ** self._codec.layout["Counter"].length
        gap = (counter - self._counters.get(record.slot, counter - 1)) % modulus
        if 0 < gap <= modulus // 2:  # else the sender has started anew
            self.lost += gap - 1
        self._counters[record.slot] = counter
        self.lines += 1
        self.line_frames += record.frames
        return line
