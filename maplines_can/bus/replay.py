"""Replay the frames of a log on a bus, at the times at which they were recorded."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import count
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..logs.first_frames import CanId, ids_text, keys_of
from ..logs.frame_block import FrameBlock, LogFrame, frames_of
from ..logs.log_part import ALL, MIN_ABSOLUTE, Time
from ..logs.log_writer import message_of
from ..logs.spacings import MAX_IDS, Spacings
from ..values.errors import BusError, LogError
from ..wire import Frame
from ..wire.layout.slot_messages import FD_LENGTHS
from .clock import SECOND_NS, Clock, RealClock, to_ns
from .link import Link, Sent
from .schedule import LatenessHistogram

#: Blocks of a log: a function that begins to read it again.
Blocks = Callable[[], Iterable[FrameBlock]]
#: Longest time for which a bus is listened to before a replay [s].
MAX_LISTEN = 1.0
#: How long a frame is tried again while the queue of the bus is full: at its recorded time, and as
#: fast as possible, where the bus sets the pace [s]; and time between two trials [s].
PATIENCE, LONG_PATIENCE, RETRY = 0.1, 2.0, 0.001
_CLASSIC_BYTES = 8
_IS_LENGTH = np.isin(np.arange(256), FD_LENGTHS)


@dataclass(frozen=True)
class Choice:
    """Which frames of a log are replayed.

    Args:
        channel: of the log; None for its only one.
        time: first and last time [s], from the first frame on, or of the clock if they are more
            than 1e8.
        has_key: returns of keys of CAN IDs (n,) which are sent; None: all are.
    """

    channel: str | None = None
    time: Time = ALL
    has_key: Callable[[NDArray[np.uint32]], NDArray[np.bool_]] | None = None

    def of(self, blocks: Iterable[FrameBlock]) -> Iterator[FrameBlock]:
        """Yield the frames that are replayed; memory is that of a block.

        Raises:
            LogError: there are no times, of which some are chosen.
        """
        begin: int | None = None
        for block in blocks:
            if begin is None and len(block):
                begin = int(block.t_ns[0])
            keep = np.ones(len(block), bool)
            if self.time != ALL and not block.has_time.all():
                raise LogError("the log has no time stamps, so that no time can be chosen")
            for bound, sign in zip(self.time, (1, -1), strict=True):
                if math.isfinite(bound):
                    t_ns = to_ns(bound) + (0 if bound > MIN_ABSOLUTE else begin or 0)
                    keep &= sign * block.t_ns >= sign * t_ns
            if self.channel is not None:
                numbers = [k for k, name in enumerate(block.channels) if name == self.channel]
                keep &= np.isin(block.channel, numbers)
            if self.has_key is not None:
                keep &= self.has_key(keys_of(block))
            yield block if keep.all() else block.where(keep)


@dataclass
class Plan:
    """What a replay is to send, from a first reading of the log; see `planned`.

    Args:
        frames: that can be sent.
        unfit: frames whose length no frame of CAN FD has; they are not sent.
        begin_ns: time of the first frame [ns].
        end_ns: time of the last one [ns].
        spacings: of the frames, by the key of their CAN ID.
        fd_keys: keys of CAN IDs whose frames are of CAN FD: stated ones, and those of which one has
            more than 8 bytes.
        channels: of the log that have such frames.
        has_time: whether the log has times.
        first_key: key of the first frame.
    """

    frames: int = 0
    unfit: int = 0
    begin_ns: int = 0
    end_ns: int = 0
    spacings: Spacings = field(default_factory=Spacings)
    fd_keys: frozenset[int] = frozenset()
    channels: tuple[str, ...] = ()
    has_time: bool = True
    first_key: int = 0

    @property
    def can_ids(self) -> list[CanId]:
        """CAN IDs of the frames."""
        return [CanId.of_key(key) for key in self.spacings.keys]

    @property
    def span(self) -> float:
        """Time from the first frame to the last one [s]."""
        return (self.end_ns - self.begin_ns) / SECOND_NS

    @property
    def listen(self) -> float:
        """Twice the longest period of a message, at most `MAX_LISTEN` [s]."""
        periods = [self.spacings.of(key).period for key in self.spacings.keys]
        known = [period for period in periods if period > 0]
        # Of a message that comes once, nobody knows the period.
        longest = max(known) if len(known) == len(periods) else MAX_LISTEN
        return min(2 * longest, MAX_LISTEN)

    @property
    def loop_ns(self) -> int:
        """Time after which a loop begins again: the first message comes a period after its last."""
        first = self.spacings.of(self.first_key)
        pause = first.period if first.period > 0 else self.span / max(self.frames - 1, 1)
        again_ns = first.last_ns + to_ns(pause) - self.begin_ns
        return max(again_ns, self.end_ns - self.begin_ns + to_ns(RETRY))


def planned(blocks: Iterable[FrameBlock], fd_keys: frozenset[int] = frozenset()) -> Plan:
    """Read what is to be sent.

    Args:
        blocks: the frames.
        fd_keys: keys of CAN IDs whose frames are of CAN FD, whatever their length.

    Raises:
        LogError: there is no frame, or more CAN IDs than a bus has.
    """
    plan, found = Plan(), set[int]()
    channels: dict[str, None] = {}
    for block in blocks:
        fit = _IS_LENGTH[block.length]
        plan.unfit += int((~fit).sum())
        block = block.where(fit)
        if not len(block):
            continue
        keys = keys_of(block)
        if not plan.frames:
            plan.begin_ns, plan.first_key = int(block.t_ns[0]), int(keys[0])
        plan.frames += len(block)
        plan.end_ns = max(plan.end_ns, int(block.t_ns.max()), plan.begin_ns)
        plan.spacings.add(keys, block.t_ns)
        is_fd = (block.length > _CLASSIC_BYTES) | np.isin(keys, [*fd_keys])
        found.update(np.unique(keys[is_fd]).tolist())
        channels |= dict.fromkeys(block.channels[k] for k in np.unique(block.channel))
        plan.has_time &= bool(block.has_time.all())
    if not plan.frames:
        raise LogError("there is no frame to send")
    if plan.spacings.beyond:
        raise LogError(f"more than {MAX_IDS} CAN IDs; choose some with --only")
    plan.fd_keys, plan.channels = frozenset(found), tuple(channels)
    return plan


class ReplayStats(NamedTuple):
    """Counters of a replay; lateness is nan if frames are sent as fast as possible."""

    frames: int  #: handed to the bus
    passes: int  #: through the log that have begun
    full: int  #: frames given up while the queue of the bus was full
    down: int  #: frames given up while the interface was down
    unfit: int  #: frames with a length that no frame has
    seconds: float  #: from the first frame to the last one
    late_mean: float  #: mean time after the recorded one [s]
    late_p99: float  #: 99th percentile [s]
    late_max: float  #: largest [s]

    def as_dict(self) -> dict[str, Any]:
        """Return the counters for JSON."""
        values = self._asdict()
        return {name: None if value != value else value for name, value in values.items()}


class Replay:
    """Sending of the frames of a log on a bus, at their times on a clock.

    Deadlines are absolute, so that they do not drift: of a frame at t, ``start + (t - begin) /
    speed``. A frame that comes too late is sent at once. While the queue of the bus is full, a
    frame is tried again for 0.1 s, and then given up; so are the next ones at once, until one is
    taken.

    Args:
        link: the bus.
        plan: what is sent, from `planned`.
        speed: by which it is faster than recorded; infinite for as fast as the bus takes frames.
        clock: the clock; None for that of the system.

    Raises:
        ValueError: the speed is not positive, or the log has no times, which any finite speed
            needs.
        BusError: there are frames of CAN FD, and the bus has none.
    """

    def __init__(
        self, link: Link, plan: Plan, *, speed: float = 1.0, clock: Clock | None = None
    ) -> None:
        if not speed > 0:
            raise ValueError(f"speed must be positive, got {speed!r}")
        if not plan.has_time and math.isfinite(speed):
            raise ValueError("the log has no time stamps; give speed=inf, as fast as possible")
        if plan.fd_keys and not link.fd:
            raise BusError(
                f"{link.name} is open for classic CAN, but frames of {_ids(plan.fd_keys)} are of "
                "CAN FD; open it with fd=True, or leave them out"
            )
        self._link, self._plan, self._speed = link, plan, speed
        self._clock = RealClock() if clock is None else clock
        self._lateness, self._late_sum = LatenessHistogram(), 0.0
        self._frames = self._passes = self._full = self._down = 0
        self._start_ns = self._last_ns = 0
        self._patience = PATIENCE if math.isfinite(speed) else LONG_PATIENCE
        self._is_stuck = False

    def alive(self) -> list[CanId]:
        """Listen to the bus; return CAN IDs of the replay that another sender sends."""
        end_ns, own = self._clock.now_ns + to_ns(self._plan.listen), {*self._plan.can_ids}
        found = set[CanId]()
        while (left_ns := end_ns - self._clock.now_ns) > 0:
            message = self._link.recv(left_ns / SECOND_NS)
            if message is not None and not message.is_error_frame:
                found.add(CanId(message.arbitration_id, message.is_extended_id))
        return sorted(found & own, key=lambda one: one.key)

    def run(self, blocks: Blocks, passes: int | None = 1) -> None:
        """Send the frames, so many times; None until an exception, such as KeyboardInterrupt.

        Args:
            blocks: begins to read what was planned.
            passes: times.

        Raises:
            LogError: the log is damaged; after the last good frame.
            BusError: the bus takes no frame at all, or never takes such a one.
        """
        self._start_ns = self._clock.now_ns
        is_paced, begin_ns, loop_ns = (
            math.isfinite(self._speed), self._plan.begin_ns, self._plan.loop_ns,
        )  # fmt: skip
        for number, block in _ahead(blocks, passes):
            self._passes = number + 1
            for frame in frames_of(block.where(_IS_LENGTH[block.length])):
                if is_paced:
                    after_ns = frame.t_ns - begin_ns + number * loop_ns
                    self._wait(self._start_ns + round(after_ns / self._speed))
                self._send(frame)

    def stats(self) -> ReplayStats:
        """Return the counters so far."""
        lateness, n = self._lateness.summary(), self._frames
        mean = self._late_sum / n if n else 0.0
        late = (mean, lateness.p99, lateness.max)
        return ReplayStats(
            n, self._passes, self._full, self._down, self._plan.unfit,
            max(self._last_ns - self._start_ns, 0) / SECOND_NS,
            *(late if math.isfinite(self._speed) else (math.nan,) * 3),
        )  # fmt: skip

    def _wait(self, deadline_ns: int) -> None:
        self._clock.run_until(deadline_ns)
        late = max(self._clock.now_ns - deadline_ns, 0) / SECOND_NS
        self._lateness.add(late)
        self._late_sum += late

    def _send(self, frame: LogFrame) -> None:
        can_id = CanId(frame.can_id, frame.is_extended)
        is_fd = can_id.key in self._plan.fd_keys
        message = message_of(Frame(frame.can_id, frame.data, is_fd, frame.is_extended))
        sent, clock = self._link.send(message), self._clock
        end_ns = clock.now_ns + (0 if self._is_stuck else to_ns(self._patience))
        while sent is Sent.FULL and clock.now_ns < end_ns:
            clock.run_until(clock.now_ns + to_ns(RETRY))
            sent = self._link.send(message)
        self._is_stuck = sent is Sent.FULL
        if self._is_stuck and math.isinf(self._speed):
            raise BusError(
                f"{self._link.name} has taken no frame for {LONG_PATIENCE:g} s; check that another "
                "node is on the bus, which acknowledges frames, and its bit rate"
            )
        self._full += sent is Sent.FULL
        self._down += sent is Sent.DOWN
        if sent is Sent.OK:
            self._frames += 1
            self._last_ns = clock.now_ns


def _ahead(blocks: Blocks, passes: int | None) -> Iterator[tuple[int, FrameBlock]]:
    """Yield the blocks of each pass; a thread reads the next one, so that none is late for that."""

    def each() -> Iterator[tuple[int, FrameBlock]]:
        for number in count() if passes is None else range(passes):
            yield from ((number, block) for block in blocks())

    source = each()
    with ThreadPoolExecutor(1, "replay") as reader:
        following = reader.submit(next, source, None)
        while (found := following.result()) is not None:
            following = reader.submit(next, source, None)
            yield found


def _ids(keys: Iterable[int]) -> str:
    return ids_text([CanId.of_key(key) for key in keys])
