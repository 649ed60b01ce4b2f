"""Received lines as arrays: a row a line, a row a component of a mixture, a row a scene.

The rows have the members of the structures of ``c/python/feed_blocks.c``, in their order, so that C
writes them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..values.line import Slot
from ..wire.reasons import Reason

#: Reason of a frame that has completed lines, among the places in ``Reason``.
COMPLETE = 255
#: Reasons by their numbers in ``LineBlock.reasons``.
REASONS = tuple(Reason)

#: A line. ``frame`` is the place in the log of the frame that has completed it. ``counter`` is that
#: of its last record, and ``ahead`` by how much it is ahead of the record before; 0 after a
#: sequence break. ``state`` is the E2E state after it, of the slot or, if this is VALID and the
#: line is conditional on the pose error, of that; ``e2e_status`` is that of the last check.
LINE_ROW = np.dtype(
    [
        ("frame", "i8"),
        ("t_ns", "i8"),
        *((name, "f8") for name in ("x_min", "x_max", "age")),
        ("mean", "f8", 4),
        ("cov", "f8", (4, 4)),
        ("counter", "u4"),
        ("ahead", "u4"),
        *((name, "u1") for name in ("slot", "kind", "status", "components")),
        *((name, "u1") for name in ("state", "e2e_status")),
        ("two_senders", "?"),
        ("usable", "?"),
    ]
)
#: A component of the mixture of a line, by its place among the lines of the block.
COMPONENT_ROW = np.dtype(
    [("line", "i8"), ("weight", "f8"), ("mean", "f8", 4), ("cov", "f8", (4, 4))]
)
_N = len(Slot)
#: A scene of ``count`` lines: the first ones of ``slots``, ``x_min``, ``x_max``, ``mean``, and of
#: the rows and columns of ``cov``. ``frame`` is the place of the last frame that has changed it.
SCENE_ROW = np.dtype(
    [
        ("frame", "i8"),
        ("t_ns", "i8"),
        ("age", "f8"),
        ("correlation_time", "f8"),
        ("counter", "u4"),
        ("count", "u1"),
        ("state", "u1"),
        ("two_senders", "?"),
        ("usable", "?"),
        ("slots", "u1", _N),
        *((name, "f8", _N) for name in ("x_min", "x_max")),
        ("mean", "f8", (_N, 4)),
        ("cov", "f8", (4 * _N, 4 * _N)),
    ]
)


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

    def __len__(self) -> int:
        return len(self.lines)
