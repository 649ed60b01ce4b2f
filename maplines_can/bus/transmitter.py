"""Sends the latest value of each line, period after period."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from typing import NamedTuple, Self

import can

from ..errors import BusError
from ..line import MapLine, Slot
from .background import Running, Worker
from .link import Link, Sent
from .schedule import Lateness, LatenessHistogram
from .tx_queue import Encoder, FrameLike, Transfer, TxQueue

__all__ = ["Transmitter", "TransmitterStats"]

#: Pause between two attempts to put a frame into a full queue [s].
RETRY = 0.001


class TransmitterStats(NamedTuple):
    """Counters of a transmitter."""

    lines: int = 0  #: sent, all their frames
    down: int = 0  #: given up because the interface was gone
    full: int = 0  #: given up because the transmit queue stayed full for a period
    overruns: int = 0  #: deadlines of slots skipped because the thread was a period late
    frames: int = 0  #: handed to the interface, those of unfinished transfers included
    retries: int = 0  #: times that a frame met a full queue and was tried again
    lateness: Lateness = Lateness()  #: of the first frame of each slot, after its deadline


class Transmitter(Running):
    """One thread that sends every published line once each period.

    Each slot has a fixed place in the period, instead of all lines going out
    back to back: the queue of a CAN interface is short (10 frames with Linux's
    defaults, and 8 lines are 32 frames), and another node waits for 4 frames at
    most.  The frames of one line, and the parts of one mixture, do go back to back.

    Deadlines are absolute (`timing.Schedule`): nothing drifts, and a period
    that was overrun is skipped and counted.  A line that is not published again
    is sent again, older and older.

    The latest value wins, as it is when the line is encoded: at its deadline, or
    with another line up to 0.1 s before it (`tx_queue.TxQueue`).  The age is that of the
    sending; the freshness of an authenticated line is that of the encoding.

    Nothing is sent half: after a frame that could not be sent, the rest of its
    transfer is not sent either, the line is counted as ``down`` or ``full``, and the
    next period begins a transfer of its own.  A full queue is waited for until the
    line's next deadline.

    Args:
        link: where to send; stays open when the transmitter stops.
        codec: makes the frames of a line; used by the transmitter's thread only.
        period: [s].
        fd: send CAN FD frames.
        count: stop when every slot had this many deadlines; None for ever.
        clock: a clock that is never set back [s].

    Raises:
        ValueError: ``period`` or ``count`` is out of range.
        BusError: ``fd`` on a link without CAN FD.
    """

    def __init__(
        self,
        link: Link,
        codec: Encoder,
        *,
        period: float = 0.05,
        fd: bool = False,
        count: int | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if not 0.001 <= period <= 3600:
            raise ValueError(f"period must be in [0.001, 3600] s, got {period!r} s")
        if count is not None and count < 1:
            raise ValueError(f"count must be 1 or more, or None for ever, got {count!r}")
        if fd and not link.fd:
            raise BusError(
                f"{link.name} is opened without CAN FD; open it with fd=True, or send classic "
                "frames (fd=False)"
            )
        self._link, self._period, self._clock = link, period, clock
        self._changed = threading.Condition()  # guards all that follows
        self._tx_queue = TxQueue(codec, period, fd=fd, count=count)
        self._counts = TransmitterStats()
        self._lateness = LatenessHistogram()
        self._stopping = False
        self._worker = Worker("maplines transmit", self._run)

    def publish(self, line: MapLine | Iterable[MapLine], t_pose_ns: int | None = None) -> None:
        """Send this line from now on, instead of the last one of its slot.

        Args:
            line: the line, or several that shall be taken over at the same moment;
                ages go on counting from this call.
            t_pose_ns: when the pose of the lines held, on the clock of
                ``time.time_ns()`` [ns]; the age then counts from there and
                ``line.age`` is ignored.

        Raises:
            ValueError: ``t_pose_ns`` is not from that clock: more than a second
                ahead, or more than an hour ago.
            Exception: what the codec or a callback raised in the thread, which
                has ended for that reason.
        """
        self._worker.check()
        age = None
        if t_pose_ns is not None:
            age = (time.time_ns() - t_pose_ns) * 1e-9
            if not -1 <= age <= 3600:
                raise ValueError(
                    f"t_pose_ns must be on the clock of time.time_ns(), at most 1 s ahead and 1 h "
                    f"ago, got {t_pose_ns!r}, which was {age:g} s ago"
                )
        lines = [line] if isinstance(line, MapLine) else list(line)
        with self._changed:
            self._tx_queue.put(lines, self._clock(), age)
            self._changed.notify_all()

    def retract(self, slot: Slot) -> None:
        """Send no more line of this slot."""
        with self._changed:
            self._tx_queue.drop(slot)

    def stats(self) -> TransmitterStats:
        """A consistent copy of all counters."""
        with self._changed:
            return self._counts._replace(lateness=self._lateness.summary())

    def start(self) -> Self:
        """Start the thread; ``with`` does it too.  The clock starts with the first line."""
        self._worker.start()
        return self

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the transmitter has ended, for ``timeout`` [s] at most; True if it has.

        Raises:
            Exception: what ended the thread, as in `publish`.
        """
        self._worker.join(timeout)
        self._worker.check()
        return not self._worker.alive

    # ---- the thread --------------------------------------------------------------

    def _run(self) -> None:
        while (transfer := self._next()) is not None:
            self._send(transfer)

    def _next(self) -> Transfer | None:
        with self._changed:
            while not (self._stopping or self._tx_queue.over):
                now = self._clock()
                transfer = self._tx_queue.take(now)
                if transfer is not None:
                    return transfer
                self._changed.wait(self._tx_queue.wait(now))
            return None

    def _send(self, transfer: Transfer) -> None:
        sent = retries = 0
        answer = Sent.OK
        lateness = self._clock() - transfer.deadline
        for frame in transfer.frames:
            message = _message(frame)
            answer = self._link.send(message)
            while answer is Sent.FULL and self._clock() < transfer.deadline + self._period:
                time.sleep(RETRY)  # no event tells that a queue has room again
                retries += 1
                answer = self._link.send(message)
            if answer is not Sent.OK:
                break
            sent += 1
        with self._changed:
            self._lateness.add(lateness)
            self._count(
                lines=answer is Sent.OK,
                down=answer is Sent.DOWN,
                full=answer is Sent.FULL,
                overruns=transfer.skipped,
                frames=sent,
                retries=retries,
            )

    def _count(self, **steps: int) -> None:
        old = self._counts
        self._counts = old._replace(**{name: getattr(old, name) + n for name, n in steps.items()})

    def _end(self) -> None:
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        self._worker.join()


def _message(frame: FrameLike) -> can.Message:
    return can.Message(
        arbitration_id=frame.can_id,
        is_extended_id=frame.is_extended,
        is_fd=frame.is_fd,
        bitrate_switch=frame.is_fd,
        data=frame.data,
        check=False,
    )
