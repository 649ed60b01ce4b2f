"""What is on a bus: its load, and the messages by CAN ID."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from functools import cache

from ..bus.frame_timing import frame_bits
from ..logs.first_frames import CanId
from ..wire import Layout
from ..wire.layout.slot_messages import FD_LENGTHS
from .facts import Facts

#: Most CAN IDs that are told apart; the frames of others are counted together.
MAX_IDS = 512
#: Spacings of a message of which the mean is told.
SPACINGS = 20


class _Message:
    """Frames of a CAN ID."""

    __slots__ = ("count", "length", "times")

    def __init__(self) -> None:
        self.count = self.length = 0
        self.times = deque[int](maxlen=SPACINGS + 1)

    @property
    def spacing(self) -> float | None:
        """Mean time between the last frames [s]; None before the second."""
        n = len(self.times) - 1
        return (self.times[-1] - self.times[0]) / 1e9 / n if n > 0 else None


class Traffic:
    """Counter of the frames of a bus.

    Args:
        layout: of the lines, whose messages have names.
        bitrate: nominal bit rate [bit/s].
        data_bitrate: of the data phase of CAN FD [bit/s]; by default four times the nominal one.

    >>> from maplines_can.wire import Layout
    >>> traffic = Traffic(Layout.from_dbc())
    >>> for k in range(3):
    ...     traffic.add(CanId(0x340, False), 8, 50_000_000 * k)
    ...     facts = traffic.facts(50_000_000 * k)
    >>> facts["load"], facts["messages"]["0x340"]
    (0.0054, {'owner': 'EGO_LEFT', 'frames': 3, 'length': 8, 'spacing': 0.05, 'last': 0.1})
    """

    def __init__(
        self, layout: Layout, bitrate: float = 500_000, data_bitrate: float | None = None
    ) -> None:
        self._owners = {
            CanId(*key): getattr(owner, "name", str(owner))
            for key, (owner, _) in layout.message_of_id.items()
        }
        fast = 4 * bitrate if data_bitrate is None else data_bitrate

        @cache
        def seconds(length: int, is_extended: bool, is_fd: bool) -> float:
            lengths = FD_LENGTHS if is_fd else FD_LENGTHS[:9]
            length = lengths[min(bisect_left(lengths, length), len(lengths) - 1)]
            bits = frame_bits(length, is_extended=is_extended, is_fd=is_fd)
            return bits.nominal / bitrate + bits.data / fast

        self._seconds = seconds
        self._messages: dict[CanId, _Message] = {}
        self._frames = self._beyond = self._errors = 0
        self._busy = 0.0  # since the last call of `facts` [s]
        self._since: int | None = None

    def add(self, can_id: CanId, length: int, t_ns: int, *, is_fd: bool = False) -> None:
        """Count a data frame; one of more than 8 bytes is of CAN FD in any case.

        Args:
            can_id: of the frame.
            length: of its data [byte].
            t_ns: time of its reception [ns].
            is_fd: whether it is of CAN FD.
        """
        self._frames += 1
        self._busy += self._seconds(length, can_id.is_extended, is_fd or length > 8)
        message = self._messages.get(can_id)
        if message is None:
            if len(self._messages) == MAX_IDS and can_id not in self._owners:
                self._beyond += 1
                return
            message = self._messages[can_id] = _Message()
        message.count += 1
        message.length = length
        message.times.append(t_ns)

    def add_error(self) -> None:
        """Count an error frame."""
        self._errors += 1

    def facts(self, t_ns: int) -> Facts:
        """Return the facts of the traffic up to a time [ns].

        ``load`` is the largest share of the bus time, by the worst case of bit stuffing, since the
        call before, and None in the first call. ``messages`` is by CAN ID, in their order: owner
        (of one of the lines' DBC), frames, length of the last one [byte], mean spacing of the last
        `SPACINGS` and time of the last one [s].
        """
        before, self._since = self._since, t_ns
        busy, self._busy = self._busy, 0.0
        elapsed = 0.0 if before is None else (t_ns - before) / 1e9
        each = sorted(self._messages.items(), key=lambda item: item[0].key)
        return {
            "load": round(busy / elapsed, 6) if elapsed > 0 else None,
            "frames": self._frames,
            "error_frames": self._errors,
            "beyond": self._beyond,
            "messages": {
                f"{can_id.number:#x}{'x' * can_id.is_extended}": {
                    "owner": self._owners.get(can_id),
                    "frames": message.count,
                    "length": message.length,
                    "spacing": message.spacing,
                    "last": message.times[-1] / 1e9,
                }
                for can_id, message in each
            },
        }
