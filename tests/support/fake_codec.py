"""A codec of four pages, just enough to test the bus."""

import struct
from collections import Counter
from types import SimpleNamespace
from typing import Any

from maplines_can.values.line import MapLine, Slot
from maplines_can.wire import Frame, Reason

PAGES = 4


class FakeCodec:
    """Page: number, counter, slot, 0, age [ms], y_off [mm]."""

    layout = SimpleNamespace(max_age=60.0, is_conditional=False, has_classic=True)

    def __init__(self) -> None:
        self.counters: Counter[Any] = Counter()

    def encode_lines(self, lines: Any, *, fd: bool = False, counters: Any = None) -> Any:
        if counters is not None:
            self.counters = Counter(counters)
        return [self.encode(line, fd=fd) for line in lines]

    def encode(self, line: Any, *, fd: bool = False) -> Any:
        if line.x_max == 13.0:
            raise ValueError("x_max must not be 13 m")
        counter = self.counters[line.slot] = (self.counters[line.slot] + 1) % 256
        age, y = round(min(line.age, 60.0) * 1e3), round(line.gaussian.mean[0] * 1e3)
        head = counter, line.slot, 0, age, y
        pages = [struct.pack("<BBBBHh", page, *head) for page in range(PAGES)]
        can_id = 0x100 + line.slot
        if fd:
            return [Frame(can_id, b"".join(pages), is_fd=True)]
        return [Frame(can_id, page) for page in pages]

    def encoder(self) -> Any:
        return self

    def decoder(self) -> Any:
        return FakeDecoder()


def sent_values(opener: Any) -> Any:
    """(age [ms], y_off [mm]) of the lines that were sent on the buses of a ``FakeOpener``."""
    pages = [opener.sent.get(timeout=0).data for _ in range(opener.sent.qsize())]
    return [struct.unpack_from("<Hh", page, 4) for page in pages if page[0] == 0]


class FakeDecoder:
    can_ids = frozenset(range(0x100, 0x108))

    def __init__(self) -> None:
        self.counts: Counter[Any] = Counter()
        self.checks: dict[Any, Any] = {}
        self.lost = self.pending = 0
        self.pose_errors = 0
        self.transfers: dict[Any, Any] = {}

    def feed(self, can_id: Any, data: Any, t_ns: Any, *, is_extended: bool = False) -> Any:  # noqa: ARG002
        result = self._feed(can_id, data, t_ns)
        if isinstance(result, Reason):
            self.counts[result] += 1
            return result
        return [result]

    def feed_all(self, frames: Any) -> Any:
        return [self.feed(*frame[:3]) for frame in frames]

    def _feed(self, can_id: Any, data: Any, t_ns: Any) -> Any:
        if not 0x100 <= can_id < 0x108 or len(data) not in (8, 32):
            return Reason.FOREIGN
        for start in range(0, len(data), 8):
            page, counter, slot, _, age, y = struct.unpack_from("<BBBBHh", data, start)
            expected, of = self.transfers.get(slot, (0, counter))
            if page != 0 and (page, counter) != (expected, of):
                self.transfers.pop(slot, None)
                return Reason.INCOMPLETE
            self.transfers[slot] = page + 1, counter
        if page + 1 < PAGES:
            return Reason.PENDING
        return MapLine.with_sigma(
            Slot(slot), [y / 1e3, 0, 0, 0], [1, 1, 1, 1], age=age / 1e3, t_ns=t_ns,
        )  # fmt: skip
