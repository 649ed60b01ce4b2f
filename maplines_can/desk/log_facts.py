"""The facts of a log, sampled each cycle."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from ..logs.first_frames import CanId
from ..logs.frame_block import LogFrame
from ..values.errors import LogError
from ..wire import Decoder, LineCodec
from .facts import Facts, facts_of
from .traffic import Traffic

#: Time between facts [s].
PERIOD = 0.05
#: Facts go on for this time after the last frame before a gap: by then all lines are stale and all
#: states have changed. The next facts are those of the next frame [s].
AFTER = 2.0


def facts_of_log(
    frames: Iterable[LogFrame],
    codec: LineCodec,
    *,
    channel: str | None = None,
    period: float = PERIOD,
    decoder: Decoder | None = None,
    traffic: Traffic | None = None,
) -> Iterator[Facts]:
    """Yield the facts of a log of one channel, each with ``traffic``, at times a period apart.

    Facts at a time contain the frames before it. Times are multiples of the period, so that those
    of two logs can be compared. Frames whose time is before the one before count at that time.

    Args:
        frames: of the log, such as `read_log` gives them.
        codec: of the lines.
        channel: of the frames that count; None for that of the first frame of a message of the DBC.
        period: time between facts [s].
        decoder: of the lines; one of the codec by default.
        traffic: counter of the frames; one with the usual bit rates by default.

    Raises:
        ValueError: the period is less than 1 ms.
        LogError: the log is damaged; after the facts of what is intact.
    """
    if not period >= 1e-3:
        raise ValueError(f"period must be 0.001 s or more, got {period!r}")
    step = round(period * 1e9)
    decoder = codec.decoder() if decoder is None else decoder
    traffic = Traffic(codec.layout) if traffic is None else traffic
    known = codec.layout.message_of_id
    due: int | None = None  # time of the next facts [ns]
    last, damage = 0, None

    def facts(t_ns: int) -> Facts:
        return facts_of(decoder, codec.layout, t_ns) | {"traffic": traffic.facts(t_ns)}

    try:
        for frame in frames:
            if channel is None:
                if (frame.can_id, frame.is_extended) not in known:
                    continue
                channel = frame.channel
            if frame.channel != channel:
                continue
            if due is None:
                due = (frame.t_ns // step + 1) * step
            while frame.t_ns >= due:
                yield facts(due)
                due += step
                if due > last + AFTER * 1e9:
                    due = max(due, frame.t_ns // step * step)
            last = max(last, frame.t_ns)
            traffic.add(CanId(frame.can_id, frame.is_extended), len(frame.data), last)
            decoder.feed(frame.can_id, frame.data, frame.t_ns, is_extended=frame.is_extended)
    except LogError as error:
        damage = error
    if due is not None:
        yield facts(due)
    if damage is not None:
        raise damage
