"""Reception of blocks of frames: the lines of `Decoder.feed`, as arrays."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..bus.first_frames import FirstFrames
from ..values.line import MapLine
from ..wire import POSE, Decoder, E2EState, LineCodec, ReceivedScene
from ..wire.reasons import Reason
from ..wire.reception.rows import COMPONENT_ROW, LINE_ROW, SCENE_ROW
from .blocks import FrameBlock
from .line_block import COMPLETE, REASONS, LineBlock

#: No log of a car has more channels. Each one needs a decoder, some 16 kB.
MAX_CHANNELS = 256
#: Longer than any time-out [ns].
_LONG_NS = 10**18

_NUMBERS = {reason: number for number, reason in enumerate(REASONS)}


class _Rows(NamedTuple):
    """What has come of the frames of one channel."""

    lines: NDArray[np.void]
    components: NDArray[np.void]
    scenes: NDArray[np.void]


class LogReceiver:
    """Receiver of the blocks of a log, with a decoder for each channel.

    The lines, reasons and counters are those of ``Decoder.feed`` frame by frame. With the extension
    module a block is decoded by one call.

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
        self._has_scenes = scenes
        # Scene without a newer one, and its row, by channel.
        self._shown: dict[str, tuple[ReceivedScene, NDArray[np.void]]] = {}
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
        name = block.channels[channel]
        decoder: Any = self.decoders[name]
        if hasattr(decoder, "feed_arrays"):
            arrays = (block.can_id, block.is_extended, block.t_ns, block.length, block.data)
            rows = _Rows(*decoder.feed_arrays(*arrays, places, reasons, int(self._has_scenes)))
        else:
            rows = self._feed_frames(block, name, places, reasons)
        rows.lines["frame"] += self.frames
        rows.scenes["frame"] += self.frames
        return channel, rows

    def _feed_frames(
        self,
        block: FrameBlock,
        channel: str,
        places: NDArray[np.int64],
        reasons: NDArray[np.uint8],
    ) -> _Rows:
        """Decode frame by frame, with a decoder that has no C."""
        decoder = self.decoders[channel]
        lines: list[Any] = []
        components: list[Any] = []
        scenes: list[NDArray[np.void]] = []
        for k in places.tolist():
            t_ns = int(block.t_ns[k])
            data = block.data[k, : block.length[k]].tobytes()
            found = decoder.feed(
                int(block.can_id[k]), data, t_ns, is_extended=bool(block.is_extended[k])
            )
            if isinstance(found, Reason):
                reasons[k] = _NUMBERS[found]
            else:
                reasons[k] = COMPLETE
                for line in found:
                    components += _component_rows(line, len(lines))
                    lines.append(_line_row(decoder, line, k, t_ns))
            if self._has_scenes:
                self._see(channel, k, t_ns, scenes)
        return _Rows(
            np.array(lines, LINE_ROW), np.array(components, COMPONENT_ROW), _array_of(scenes)
        )

    def _see(self, channel: str, k: int, t_ns: int, scenes: list[NDArray[np.void]]) -> None:
        """Show the newest scene of a channel; one that another has followed is complete."""
        decoder, shown = self.decoders[channel], self._shown.get(channel)
        received = decoder.scene()
        if received is None or (shown is not None and shown[0] is received):
            return
        if shown is not None and shown[0][1:3] != received[1:3]:
            scenes.append(shown[1])
        self._shown[channel] = received, _scene_row(decoder, received, k, t_ns)

    def _end(self, channel: str) -> NDArray[np.void]:
        """Return the scene of a channel that no other has followed."""
        decoder: Any = self.decoders[channel]
        if hasattr(decoder, "feed_arrays"):
            one = [np.empty(0, kind) for kind in ("u4", "?", "i8", "u1", "i8", "u1")]
            one.insert(4, np.empty((0, 0), np.uint8))
            return _Rows(*decoder.feed_arrays(*one, 2 * self._has_scenes)).scenes
        shown = self._shown.pop(channel, None)
        return _array_of([] if shown is None else [shown[1]])

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
            lines, components, scenes, channel, of_scenes, timed, reasons, first, channels
        )


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


def _line_row(decoder: Decoder, line: MapLine, frame: int, t_ns: int) -> tuple[Any, ...]:
    """Return the members of `LINE_ROW` of a line that a frame has just completed."""
    check = decoder.checks[line.slot]
    checks = [check, decoder.checks[POSE]] if decoder.is_conditional else [check]
    state = next((one.state for one in checks if one.state is not E2EState.VALID), E2EState.VALID)
    two_senders = not all(one.has_one_sender(t_ns) for one in checks)
    return (
        *(frame, line.t_ns, line.x_min, line.x_max, line.age),
        *(line.gaussian.mean, line.gaussian.cov, check.counter, check.ahead or 0),
        *(line.slot, line.kind, line.status),
        1 if line.mixture is None else len(line.mixture.weights),
        *(state, check.status, two_senders),
        line.is_usable and state is E2EState.VALID and not two_senders,
    )


def _array_of(scenes: list[NDArray[np.void]]) -> NDArray[np.void]:
    return np.array(scenes, SCENE_ROW) if scenes else np.empty(0, SCENE_ROW)


def _component_rows(line: MapLine, place: int) -> Iterator[tuple[Any, ...]]:
    if line.mixture is not None:
        mixture = line.mixture
        for row in zip(mixture.weights, mixture.means, mixture.covs, strict=True):
            yield place, *row


def _scene_row(
    decoder: Decoder, received: ReceivedScene, frame: int, t_ns: int
) -> NDArray[np.void]:
    """Return the `SCENE_ROW` of the newest scene, which a frame may have changed."""
    scene, lines = received.scene, received.scene.lines
    checks = [decoder.checks[POSE], *(decoder.checks[line.slot] for line in lines)]
    row: Any = np.zeros((), SCENE_ROW)
    row["frame"], row["t_ns"], row["counter"] = frame, received.t_ns, received.counter
    row["age"] = received.age
    row["correlation_time"] = scene.pose_error.correlation_time
    row["count"], row["state"] = len(lines), checks[0].state
    row["two_senders"] = not all(one.has_one_sender(t_ns) for one in checks)
    row["usable"] = (
        all(one.state is E2EState.VALID for one in checks)
        and math.isfinite(row["age"])
        and not row["two_senders"]
    )
    for place, line in enumerate(lines):
        row["slots"][place] = line.slot
        row["x_min"][place], row["x_max"][place] = line.x_min, line.x_max
        row["mean"][place] = line.gaussian.mean
    row["cov"][: 4 * len(lines), : 4 * len(lines)] = scene.cov
    return np.asarray(row)
