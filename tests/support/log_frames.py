"""Frames of blocks, one by one."""

from maplines_can.bus import LogFrame
from maplines_can.recordings.blocks import FrameBlock


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
