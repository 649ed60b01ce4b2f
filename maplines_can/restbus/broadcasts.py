"""Messages of J1939 of more than 8 bytes: announced to all (BAM), then sent packet by packet.

Packets carry no parameter group, so an address sends one message after the other (J1939-21).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable

from ..bus.clock import Clock
from ..logs.j1939 import BAM, PACKET, TP_CM, TP_DT, pgn_of, source_of
from ..wire import Frame

#: Pause between two frames: J1939-21 allows 50 to 200 ms [ns].
PAUSE_NS = 50_000_000
#: Priority of the frames, and their receiver: all addresses.
_PRIORITY, _TO_ALL = 7 << 26, 0xFF00


def packets(can_id: int, data: bytes) -> list[Frame]:
    """Return the frames of a message: the announcement, and its packets of 7 bytes.

    >>> [frame.data.hex() for frame in packets(0x18FECA03, bytes(range(9)))]
    ['20090002ffcafe00', '0100010203040506', '020708ffffffffff']
    """
    parts = [data[n : n + PACKET] for n in range(0, len(data), PACKET)]
    announcement = bytes([BAM, *len(data).to_bytes(2, "little"), len(parts), 0xFF])
    announcement += pgn_of(can_id).to_bytes(3, "little")
    frames = [announcement, *(bytes([n, *part]) for n, part in enumerate(parts, 1))]
    return [
        Frame(
            _PRIORITY | (TP_DT if n else TP_CM) << 8 | _TO_ALL | source_of(can_id),
            payload.ljust(PACKET + 1, b"\xff"),
            is_extended=True,
        )
        for n, payload in enumerate(frames)
    ]


class Broadcasts:
    """Sending of such messages of one address, one after the other.

    Args:
        clock: on which the pauses pass.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._waiting: deque[Callable[[], object]] = deque()
        self._is_busy = False

    def put(self, frames: Iterable[Callable[[], object]]) -> None:
        """Send the frames of a message, by calls, after those of the messages before it."""
        self._waiting += frames
        if not self._is_busy:
            self._next()

    def _next(self) -> None:
        self._is_busy = bool(self._waiting)
        if self._waiting:
            self._waiting.popleft()()
            self._clock.call_at(self._clock.now_ns + PAUSE_NS, self._next)
