"""Recordings for tests: logs of a simulated drive, and the frames of blocks one by one."""

from __future__ import annotations

from pathlib import Path

from maplines_can.bus import LogFrame
from maplines_can.cli import main
from maplines_can.recordings.blocks import FrameBlock


def record(path: Path, *options: str, seconds: float = 12.0) -> Path:
    """Record a drive with these options of ``maplines drive``."""
    drive = ["drive", "--as-fast-as-possible", "--seconds", str(seconds), "--record", str(path)]
    assert main([*drive, "--seed", "1", *options]) == 0
    return path


def frames_of(block: FrameBlock) -> list[LogFrame]:
    """Return the frames of a block as those of `read_log`."""
    return [
        LogFrame(
            int(block.can_id[k]),
            block.data[k, : block.length[k]].tobytes(),
            int(block.t_ns[k]),
            bool(block.is_extended[k]),
            block.channels[block.channel[k]],
            bool(block.has_time[k]),
        )
        for k in range(len(block))
    ]
