"""Part of a log: a channel, and a time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..values.errors import LogError
from .frame_block import FrameBlock, LogFrame
from .log_summary import LogReader

Record = TypeVar("Record", LogFrame, FrameBlock)

#: First and last time [s].
Time = tuple[float, float]
ALL: Time = (-math.inf, math.inf)
#: Smaller times are from the first line of the log on [s].
MIN_ABSOLUTE = 1e8
#: Time after the window in which frames are still read, so that its last lines are complete, also
#: those of a channel that is late [s].
AFTER = 1.0
#: Most channels in a message.
_MAX_SHOWN = 20


class ChannelError(LogError):
    """A log has no frame of the channel that was asked for."""


class Window:
    """Which lines of a log are in a time, and when it need not be read further.

    The frames before are decoded as well, so that the lines and their states are those of the whole
    log.

    Args:
        time: first and last time [s]: from the first line on, or of the clock of the log if they
            are more than ``MIN_ABSOLUTE``.

    Raises:
        ValueError: the first time is not before the last one.
    """

    def __init__(self, time: Time = ALL) -> None:
        low, high = time
        if not low < high:  # true for nan, too
            raise ValueError(f"time must be (first, last) in seconds, the first before, got {time}")
        self.is_all = time == ALL
        #: Time of the first line [s]; None before it.
        self.begin: float | None = None
        self._time = time

    def see(self, t: float, name: object) -> None:
        """Take the time of a line [s]; the first one is the begin.

        Raises:
            LogError: it is nan: the log has no times.
        """
        if self.begin is None:
            if math.isnan(t) and not self.is_all:
                raise LogError(f"{name}: has no time stamps, so that no time can be chosen")
            self.begin = t

    @property
    def bounds(self) -> Time:
        """First and last time [s]; before the first line those from there on are infinite."""
        begin = math.inf if self.begin is None else self.begin
        low, high = (t if t > MIN_ABSOLUTE or math.isinf(t) else t + begin for t in self._time)
        return low, high

    def has(self, t: float) -> bool:
        """Return whether a time is in the window [s]."""
        low, high = self.bounds
        return self.is_all or low <= t <= high

    def takes(self, t: float, name: object) -> bool:
        """Return whether a line is in the window, by its time [s]; the first one is its begin.

        Raises:
            LogError: the log has no times.
        """
        self.see(t, name)
        return self.has(t)

    def are_in(self, t: NDArray[Any]) -> NDArray[np.bool_]:
        """Return which times are in the window [s]."""
        low, high = self.bounds
        return np.full(len(t), self.is_all) | ((t >= low) & (t <= high))

    def is_over(self, t_ns: int) -> bool:
        """Return whether a log is read far enough, by the time of a frame [ns]."""
        return not self.is_all and t_ns / 1e9 > self.bounds[1] + AFTER

    def check_frames(self, frames: int, name: object) -> None:
        """Raise LogError if the window is over, and no frame has been before."""
        if not frames:
            raise LogError(f"{name}: begins after the time {self._time[1]:g} s")


def time_of(text: str) -> Time:
    """Return the time of a text, such as ``--time``.

    Raises:
        ValueError: it is none.

    >>> time_of("10..20"), time_of("30..")
    ((10.0, 20.0), (30.0, inf))
    """
    first, dots, last = text.partition("..")
    try:
        low, high = float(first or "-inf"), float(last or "inf")
    except ValueError:
        low, high = 1.0, 0.0
    if not dots or not low < high:
        raise ValueError("must be FROM..TO in seconds, such as 10..20 or 30..")
    return low, high


def of_channel(records: LogReader[Record], channel: str | None, name: object) -> LogReader[Record]:
    """Return an iterator over the frames of one channel of a log; None is all channels.

    Args:
        records: frames, or blocks of them.
        channel: its name, as in ``LogFrame``.
        name: of the log, for messages.

    Raises:
        ChannelError: at the end, there was no frame of this channel, but of others.
    """
    return records if channel is None else LogReader(_kept(records, channel, name), records.summary)


def _kept(records: LogReader[Any], channel: str, name: object) -> Iterator[Any]:
    others: dict[str, None] = {}
    is_found = False
    try:
        for record in records:
            part = record
            if isinstance(record, FrameBlock):
                others |= dict.fromkeys(record.channels)
                place = record.channels.index(channel) if channel in record.channels else -1
                part = record.where(record.channel == place)
                part = replace(part, channel=np.zeros_like(part.channel), channels=(channel,))
            else:
                others[record.channel] = None
                part = [record] if record.channel == channel else []
            is_found |= len(part) > 0
            if len(part) > 0:
                yield record if isinstance(record, LogFrame) else part
    finally:
        records.close()
    if others and not is_found:
        named = [*others][:_MAX_SHOWN]
        more = f" and {len(others) - len(named)} more" if len(others) > len(named) else ""
        raise ChannelError(
            f"{name}: has no frame of channel {channel!r}; there are "
            f"{', '.join(map(repr, named))}{more}"
        )
