"""Frames of logs: one by one, and as arrays."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core import ffi
from ..core.memory import structure

#: Frames of a block by default. Its arrays of classic CAN take 1.5 MB.
BLOCK_FRAMES = 1 << 16
#: Most bytes of data of a frame, those of CAN FD.
MAX_DATA = 64
#: Most bytes of an object or a block of a binary log, packed and unpacked; writers make containers
#: of 128 kB in BLF, and the standard of MF4 recommends blocks of 4 MB at most.
MAX_OBJECT = 1 << 24
#: Time from which a float has no nanoseconds [s]; those of dates are taken as microseconds.
_DATES = 1e6


class LogFrame(NamedTuple):
    """Data frame of a log."""

    can_id: int
    data: bytes
    t_ns: int  #: time of reception as logged [ns]: absolute, or from the start of the log
    is_extended: bool
    channel: str  #: of the interface; empty if the log has none
    has_time: bool  #: False if the log has no time stamps (candump without -L and -t)


@dataclass(frozen=True, eq=False)
class FrameBlock:
    """Data frames of a log as arrays, in the order of the file; n frames.

    Args:
        can_id: (n,) uint32.
        is_extended: (n,) bool.
        t_ns: (n,) int64, time as in ``LogFrame`` [ns].
        has_time: (n,) bool, whether the log has that time.
        channel: (n,) uint16, place in ``channels``.
        length: (n,) uint8, bytes of data.
        data: (n, 8) or (n, 64) uint8, C-contiguous; zero from the length on.
        channels: names of the channels so far; those of a block begin with those of the one before.
    """

    can_id: NDArray[np.uint32]
    is_extended: NDArray[np.bool_]
    t_ns: NDArray[np.int64]
    has_time: NDArray[np.bool_]
    channel: NDArray[np.uint16]
    length: NDArray[np.uint8]
    data: NDArray[np.uint8]
    channels: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.can_id)

    def part(self, begin: int, end: int) -> FrameBlock:
        """Return the frames from a place on, up to another."""
        return self.where(slice(begin, end))

    def where(self, here: slice | NDArray[np.bool_ | np.int64]) -> FrameBlock:
        """Return the frames of a slice, of a mask, or at places."""
        return FrameBlock(
            can_id=self.can_id[here],
            is_extended=self.is_extended[here],
            t_ns=self.t_ns[here],
            has_time=self.has_time[here],
            channel=self.channel[here],
            length=self.length[here],
            data=self.data[here],
            channels=self.channels,
        )


class LogCore:
    """Reader of ordinary records in C, which fills its arrays again and again."""

    def __init__(self) -> None:
        n = BLOCK_FRAMES
        kinds = np.uint32, np.uint8, np.int64, np.uint16, np.uint8
        self._arrays: tuple[NDArray[Any], ...] = (
            *(np.empty(n, kind) for kind in kinds),
            np.empty((n, MAX_DATA), np.uint8),
        )
        names = "can_id", "is_extended", "t_ns", "channel", "length", "data"
        arrays = dict(zip(names, self._arrays, strict=True))
        #: A ``maplines_log_t``.
        self.state = structure("maplines_log_t", {"capacity": n, **arrays})
        self._channels: tuple[str, ...] = ()

    @property
    def is_full(self) -> bool:
        """Whether the last call ended because there was no more room."""
        return bool(self.state.frames == BLOCK_FRAMES)

    def read(self, parse: Any, data: bytes, place: int, *other: int) -> int:
        """Read records from a place on; return the place reached, or of one of another form.

        Args:
            parse: function of the core.
            data: of the log.
            place: in them.
            other: arguments of the function.
        """
        left = ffi.from_buffer(data) + place
        return place + int(parse(self.state, len(data) - place, left, *other))

    def block(self) -> FrameBlock:
        """Return the frames of the last call, all of which have a time."""
        state = self.state
        n = state.frames
        can_id, is_extended, t_ns, channel, length, data = (one[:n] for one in self._arrays)
        width = 8 if n == 0 or length.max() <= 8 else MAX_DATA
        for k in range(len(self._channels), state.channels):
            self._channels += (ffi.string(state.names[k]).decode(),)
        return FrameBlock(
            can_id=can_id.copy(),
            is_extended=is_extended.astype(bool),
            t_ns=t_ns.copy(),
            has_time=np.ones(n, bool),
            channel=channel.copy(),
            length=length.copy(),
            data=data[:, :width].copy(),
            channels=self._channels,
        )


def stamp_ns(t: float) -> int:
    """Return a time stamp [s] in nanoseconds, without the digits that a float does not have."""
    return round(t * 1e9) if abs(t) < _DATES else round(t * 1e6) * 1000


def block_of(frames: Sequence[LogFrame], numbers: dict[str, int]) -> FrameBlock:
    """Return one frame or more as a block.

    Args:
        frames: in their order.
        numbers: those of the channels so far, by name; new ones are added.
    """
    can_ids, payloads, times, extended, channels, has_time = zip(*frames, strict=True)
    length = np.fromiter(map(len, payloads), np.uint8, len(frames))
    width = 8 if length.max() <= 8 else MAX_DATA
    data = b"".join(payload.ljust(width, b"\0") for payload in payloads)
    return FrameBlock(
        can_id=np.array(can_ids, np.uint32),
        is_extended=np.array(extended),
        t_ns=np.array(times, np.int64),
        has_time=np.array(has_time),
        channel=np.array([numbers.setdefault(one, len(numbers)) for one in channels], np.uint16),
        length=length,
        data=np.frombuffer(data, np.uint8).reshape(-1, width),
        channels=tuple(numbers),
    )


def frames_of(block: FrameBlock) -> Iterator[LogFrame]:
    """Yield the frames of a block one by one."""
    names = "can_id", "length", "t_ns", "is_extended", "channel", "has_time"
    columns = (getattr(block, name).tolist() for name in names)
    for k, (can_id, length, t_ns, is_extended, channel, has_time) in enumerate(
        zip(*columns, strict=True)
    ):
        data = block.data[k, :length].tobytes()
        yield LogFrame(can_id, data, t_ns, is_extended, block.channels[channel], has_time)


def joined_blocks(blocks: Sequence[FrameBlock]) -> FrameBlock:
    """Return blocks of one log as one; their channels have the same numbers."""
    if len(blocks) == 1:
        return blocks[0]
    width = max(block.data.shape[1] for block in blocks)
    wide = [
        block
        if block.data.shape[1] == width
        else np.pad(block.data, ((0, 0), (0, width - block.data.shape[1])))
        for block in blocks
    ]
    data = np.concatenate([one.data if isinstance(one, FrameBlock) else one for one in wide])
    names = "can_id", "is_extended", "t_ns", "has_time", "channel", "length"
    arrays = {name: np.concatenate([getattr(block, name) for block in blocks]) for name in names}
    return FrameBlock(**arrays, data=data, channels=blocks[-1].channels)
