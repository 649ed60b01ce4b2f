"""Logs in blocks: each has some ten thousand frames as arrays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from os import PathLike
from typing import IO

import numpy as np

from ..logs.frame_block import BLOCK_FRAMES, FrameBlock, LogFrame, block_of, joined_blocks
from ..logs.log_reader import read_runs
from ..logs.log_summary import LogReader, Times
from ..values.errors import LogError

__all__ = ["BLOCK_FRAMES", "FrameBlock", "read_blocks"]


def read_blocks(
    source: str | PathLike[str] | IO[bytes],
    *,
    block_frames: int = BLOCK_FRAMES,
    times: Times = "auto",
) -> LogReader[FrameBlock]:
    """Return an iterator over the data frames of a log in blocks: those of `read_log`, as arrays.

    Logs of candump -L, ASC, BLF and MF4 are read as arrays, as far as their records are ordinary.
    A block of a stream has what has arrived, so that none waits for the next ones.

    Args:
        source: as for `read_log`.
        block_frames: most frames of a block.
        times: as for `read_log`.

    Raises:
        LogError: as by `read_log`: at once, or after the block with the last good frame.
        ValueError: ``block_frames`` is less than 1.
    """
    if block_frames < 1:
        raise ValueError(f"block_frames must be 1 frame or more, got {block_frames}")
    is_stream = not isinstance(source, str | PathLike)
    runs = read_runs(source, times=times)
    blocks = _blocks_of(runs, block_frames, 1 if is_stream else block_frames)
    return LogReader(blocks, runs.summary)


def _blocks_of(
    runs: Iterator[LogFrame | FrameBlock], block_frames: int, least: int
) -> Iterator[FrameBlock]:
    """Yield blocks of at least so many frames; an error is raised after the frames before it."""
    numbers: dict[str, int] = {}
    waiting: list[FrameBlock] = []
    frames: list[LogFrame] = []
    count = 0
    error: LogError | None = None

    def flush() -> None:
        if frames:
            waiting.append(block_of(frames, numbers))
            frames.clear()

    try:
        for run in runs:
            if isinstance(run, LogFrame):
                frames.append(run)
                count += 1
            else:
                flush()
                waiting.append(_numbered(run, numbers))
                count += len(run)
            if count >= least:
                flush()
                whole = joined_blocks(waiting)
                end = count if least < block_frames else count - count % block_frames
                for begin in range(0, end, block_frames):
                    yield whole.part(begin, min(begin + block_frames, end))
                waiting = [whole.part(end, count)] if end < count else []
                count -= end
    except LogError as raised:
        error = raised
    flush()
    if waiting:
        yield joined_blocks(waiting)
    if error is not None:
        raise error


def _numbered(run: FrameBlock, numbers: dict[str, int]) -> FrameBlock:
    """Return a run of a reader with the numbers that its channels have in all of the log."""
    own = [numbers.setdefault(name, len(numbers)) for name in run.channels]
    channel = run.channel
    if own != [*range(len(own))]:
        channel = np.array(own, np.uint16)[channel]
    return replace(run, channel=channel, channels=tuple(numbers))
