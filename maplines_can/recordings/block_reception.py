"""Reception of blocks of frames: the lines of `Decoder.feed`, as arrays.

``wire/reception/rows.py`` has the members of the rows.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..logs.first_frames import FirstFrames
from ..wire import Decoder, LineCodec
from ..wire.reception.check import Reason
from ..wire.reception.rows import COMPONENT_ROW, LINE_ROW, SCENE_ROW
from .blocks import FrameBlock

#: Reason of a frame that has completed lines, among the places in ``Reason``.
COMPLETE = 255
#: Reasons by their numbers in ``LineBlock.reasons``.
REASONS: tuple[Reason, ...] = tuple(Reason)
#: No log of a car has more channels. Each one needs a decoder, some 16 kB.
MAX_CHANNELS = 256
#: Longer than any time-out [ns].
_LONG_NS = 10**18

_NUMBERS = {reason: number for number, reason in enumerate(REASONS)}


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


class _Rows(NamedTuple):
    """What has come of the frames of one channel."""

    lines: NDArray[np.void]
    components: NDArray[np.void]
    scenes: NDArray[np.void]


class LogReceiver:
    """Receiver of the blocks of a log, with a decoder for each channel.

    The lines, reasons and counters are those of ``Decoder.feed`` frame by frame; a block is decoded
    by one call.

    Args:
        codec: of the lines.
        cycle_ms: as in ``Codec.decoder``.
        timeout_ms: as in ``Codec.decoder``.
        scenes: whether `feed` gives scenes, too; they take most of the time.

    Raises:
        ValueError: as ``Codec.decoder``; or scenes are asked for and the DBC has none.
    """

    def __init__(
        self,
        codec: LineCodec,
        *,
        cycle_ms: float | None = None,
        timeout_ms: float | None = None,
        scenes: bool = False,
    ) -> None:
        if scenes and codec.layout.pose is None:
            raise ValueError(f"scenes: {codec.layout.source} has no message of the pose error")
        self._new_decoder: Callable[[], Decoder] = partial(
            codec.decoder, cycle_ms=cycle_ms, timeout_ms=timeout_ms
        )
        self._new_decoder()  # raises for a wrong time
        self.codec = codec  #: of the lines
        self._has_scenes = scenes
        self._has_left_out = codec.layout.scene is not None
        self.decoders: dict[str, Decoder] = {}  #: by channel
        self.first = FirstFrames()  #: those before a line or a pose error
        self.frames = 0  #: of all blocks
        self.beyond = 0  #: frames of channels beyond the first ``MAX_CHANNELS``: not decoded
        self.last_ns = 0  #: time of the last frame [ns]
        self.has_time = True  #: whether the log has that time

    @property
    def counts(self) -> Counter[Reason]:
        """Dropped frames by reason, of all channels."""
        return sum((one.counts for one in self.decoders.values()), Counter())

    @property
    def is_empty(self) -> bool:
        """Whether there was neither a line nor a pose error."""
        return not any(one.lines or one.pose_errors for one in self.decoders.values())

    def feed(self, block: FrameBlock) -> LineBlock:
        """Decode the frames of a block; return their lines."""
        reasons = np.full(len(block), _NUMBERS[Reason.FOREIGN], np.uint8)
        if self.is_empty:
            self.first.add_block(block)
        parts = [
            self._feed_channel(block, channel, places, reasons)
            for channel, places in _by_channel(block)
            if self._knows(block.channels[channel], len(places))
        ]
        if len(block):
            self.last_ns, self.has_time = int(block.t_ns[-1]), bool(block.has_time[-1])
        return self._joined(parts, block.channels, reasons, block.has_time)

    def finish(self) -> LineBlock:
        """Count the incomplete lines at the end of the log; return the scenes at the end."""
        for decoder in self.decoders.values():
            decoder.expire(self.last_ns + _LONG_NS)
        channels = tuple(self.decoders)
        none = np.empty(0, LINE_ROW), np.empty(0, COMPONENT_ROW)
        parts = [
            (number, _Rows(*none, self._end(channel))) for number, channel in enumerate(channels)
        ]
        return self._joined(parts, channels, np.empty(0, np.uint8), np.empty(0, bool))

    def _knows(self, channel: str, frames: int) -> bool:
        """Return whether there is a decoder for a channel, now at the latest."""
        if channel not in self.decoders:
            if len(self.decoders) == MAX_CHANNELS:
                self.beyond += frames
                return False
            self.decoders[channel] = self._new_decoder()
        return True

    def _feed_channel(
        self,
        block: FrameBlock,
        channel: int,
        places: NDArray[np.int64],
        reasons: NDArray[np.uint8],
    ) -> tuple[int, _Rows]:
        arrays = (block.can_id, block.is_extended, block.t_ns, block.length, block.data)
        decoder = self.decoders[block.channels[channel]]
        rows = _Rows(*decoder.feed_arrays(*arrays, places, reasons, int(self._has_scenes)))
        rows.lines["frame"] += self.frames
        rows.scenes["frame"] += self.frames
        return channel, rows

    def _end(self, channel: str) -> NDArray[np.void]:
        """Return the scene of a channel that no other has followed."""
        times, octets = np.empty(0, np.int64), np.empty(0, np.uint8)
        block = np.empty(0, np.uint32), np.empty(0, bool), times, octets, octets.reshape(0, 0)
        decoder = self.decoders[channel]
        return _Rows(*decoder.feed_arrays(*block, times, octets, 2 * self._has_scenes)).scenes

    def _joined(
        self,
        parts: list[tuple[int, _Rows]],
        channels: tuple[str, ...],
        reasons: NDArray[np.uint8],
        has_time: NDArray[np.bool_],
    ) -> LineBlock:
        """Return the rows of all channels in the order of their frames."""
        first, self.frames = self.frames, self.frames + len(reasons)
        numbers = np.array([number for number, _ in parts], np.uint16)
        each = [rows for _, rows in parts]
        begin = 0
        for rows in each:
            rows.components["line"] += begin
            begin += len(rows.lines)
        lines = np.concatenate([np.empty(0, LINE_ROW), *(rows.lines for rows in each)])
        components = np.concatenate(
            [np.empty(0, COMPONENT_ROW), *(rows.components for rows in each)]
        )
        scenes = np.concatenate([np.empty(0, SCENE_ROW), *(rows.scenes for rows in each)])
        channel = np.repeat(numbers, [len(rows.lines) for rows in each])
        of_scenes = np.repeat(numbers, [len(rows.scenes) for rows in each])
        if len(parts) > 1:
            order = np.argsort(lines["frame"], kind="stable")
            place = np.empty_like(order)
            place[order] = np.arange(len(order))
            lines, channel = lines[order], channel[order]
            components["line"] = place[components["line"]]
            components = components[np.argsort(components["line"], kind="stable")]
            order = np.argsort(scenes["frame"], kind="stable")
            scenes, of_scenes = scenes[order], of_scenes[order]
        timed = has_time[lines["frame"] - first]
        return LineBlock(
            lines, components, scenes, channel, of_scenes, timed, reasons, first, channels,
            self._has_left_out,
        )  # fmt: skip


def _by_channel(block: FrameBlock) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Yield the channels of a block in the order of their first frames, with their frames."""
    if not len(block):
        return
    if (block.channel == block.channel[0]).all():
        yield int(block.channel[0]), np.arange(len(block))
        return
    order = np.argsort(block.channel, kind="stable")
    bounds = [0, *(np.flatnonzero(np.diff(block.channel[order])) + 1).tolist(), len(order)]
    groups = sorted((order[low:high] for low, high in pairwise(bounds)), key=lambda group: group[0])
    for group in groups:
        yield int(block.channel[group[0]]), group
