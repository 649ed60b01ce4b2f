"""Received lines as arrays: a row a line, a row a component of a mixture, a row a scene.

``wire/reception/rows.py`` has the members of the rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..wire.reasons import Reason

#: Reason of a frame that has completed lines, among the places in ``Reason``.
COMPLETE = 255
#: Reasons by their numbers in ``LineBlock.reasons``.
REASONS = tuple(Reason)


@dataclass(frozen=True, eq=False)
class LineBlock:
    """What has come of a block of frames.

    Args:
        lines: (n,) of `LINE_ROW`, in the order of their frames.
        components: (m,) of `COMPONENT_ROW`, of the lines that are mixtures.
        scenes: (k,) of `SCENE_ROW`, those that a newer one has followed; empty if not asked for.
        channel: (n,) uint16 of the lines, place in ``channels``.
        scene_channel: (k,) uint16 of the scenes.
        has_time: (n,) bool, whether the log has the time of a line.
        reasons: (frames,) uint8, why each frame has completed no line: a place in `REASONS`, or
            `COMPLETE` if it has.
        first_frame: place in the log of the first frame.
        channels: names of the channels so far.
        has_left_out: whether scenes say which lines are left out: they are whole scenes.
    """

    lines: NDArray[np.void]
    components: NDArray[np.void]
    scenes: NDArray[np.void]
    channel: NDArray[np.uint16]
    scene_channel: NDArray[np.uint16]
    has_time: NDArray[np.bool_]
    reasons: NDArray[np.uint8]
    first_frame: int
    channels: tuple[str, ...]
    has_left_out: bool

    def __len__(self) -> int:
        return len(self.lines)
