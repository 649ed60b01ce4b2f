"""Logs as blocks of frames: each block has some ten thousand frames as arrays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from os import PathLike
from typing import IO

import numpy as np
from numpy.typing import NDArray

from ..bus import LogFrame, read_log
from ..values.errors import LogError

#: Frames of a block by default. Its arrays of classic CAN take 1.5 MB.
BLOCK_FRAMES = 1 << 16


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


def read_blocks(
    source: str | PathLike[str] | IO[bytes], *, block_frames: int = BLOCK_FRAMES
) -> Iterator[FrameBlock]:
    """Return an iterator over the data frames of a log in blocks: those of `read_log`, as arrays.

    Args:
        source: as for `read_log`.
        block_frames: most frames of a block.

    Raises:
        LogError: as by `read_log`: at once, or after the block with the last good frame.
        ValueError: ``block_frames`` is less than 1.
    """
    if block_frames < 1:
        raise ValueError(f"block_frames must be 1 frame or more, got {block_frames}")
    return _blocks_of(read_log(source), block_frames)


def _blocks_of(frames: Iterator[LogFrame], block_frames: int) -> Iterator[FrameBlock]:
    """Yield the frames of a reader in blocks; an error is raised after the frames before it."""
    numbers: dict[str, int] = {}
    error: LogError | None = None

    def until_error() -> Iterator[LogFrame]:
        nonlocal error
        try:
            yield from frames
        except LogError as raised:
            error = raised

    good = until_error()
    while block := list(islice(good, block_frames)):
        yield _block(block, numbers)
    if error is not None:
        raise error


def _block(frames: list[LogFrame], numbers: dict[str, int]) -> FrameBlock:
    can_ids, payloads, times, extended, channels, has_time = zip(*frames, strict=True)
    length = np.fromiter(map(len, payloads), np.uint8, len(frames))
    width = 8 if length.max() <= 8 else 64
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
