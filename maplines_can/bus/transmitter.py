"""Send the latest value of each line, period after period."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from ..logs.log_writer import message_of
from ..values.errors import BusError, EncodeError
from ..values.line import LeftOut, MapLine, MapLineList, Slot
from ..values.scene import Scene
from ..wire import Frame, LineCodec, PreparedScene
from ..wire.encoder import classic_error
from .background import BackgroundThread
from .link import Link, Sent, link_of
from .schedule import Lateness, LatenessHistogram
from .tx_queue import Transfer, TxQueue

if TYPE_CHECKING:
    import can

#: Pause between two attempts to put a frame into a full transmit queue [s].
RETRY = 0.001


class TransmitterStats(NamedTuple):
    """Counters of a transmitter."""

    lines: int  #: lines sent with all their frames
    down: int  #: lines given up because the interface was gone
    full: int  #: lines given up because the transmit queue stayed full for a period
    overruns: int  #: deadlines skipped because the thread was a period late or more
    frames: int  #: frames handed to the interface, those of unfinished transfers included
    retries: int  #: attempts that met a full transmit queue and were repeated
    expired: int  #: records sent as too old, because lines were not published again in time
    pose_errors: int  #: pose errors sent with all their frames; each whole scene has one
    #: lines of the map that were left out of what was published, and so retracted, by reason: by
    #: ``map_lines``, ``map_scene``, or since the messages of scenes cannot state them or have no
    #: place for them
    left_out: Mapping[LeftOut, int]
    lateness: Lateness  #: of the first frame of each transfer, after its deadline

    def as_dict(self) -> dict[str, Any]:
        """Return the counters, for JSON."""
        left_out = {reason.name: n for reason, n in self.left_out.items()}
        return self._asdict() | {"left_out": left_out, "lateness": self.lateness._asdict()}


class Transmitter(BackgroundThread):
    """Thread that sends every published line once each period.

    Each slot has a fixed phase in the period, which spreads the lines over the period: the transmit
    queue of a CAN interface is short (10 frames with Linux's defaults, while 8 lines are 32
    frames), so that another node waits for at most 4 frames.  The frames of one line are sent back
    to back, and so are the components of one mixture.

    Deadlines are absolute (see ``Schedule``): they do not drift.  A deadline that is missed
    by a period or more is skipped and counted as an overrun.

    With a DBC of whole scenes, the frames of a scene are sent back to back once each period.

    A line that is not published again is sent again, with a growing age.  When its age exceeds
    ``max_age``, the transmitter no longer vouches for it: the line is sent as "too old" (the
    greatest raw value of the DBC's Age) and counted as ``expired``, so that no receiver uses it,
    while the slot stays alive.  Publish at least once per ``max_age``, even with a longer period.
    Lines that are published before `start` wait for it.

    The value sent is the latest at encoding time: the deadline, or up to 0.1 s earlier together
    with another line (see ``TxQueue``).  Freshness is also stamped then.  The age that is sent is
    not less than the age of the pose when the first frame is handed to the interface: it includes
    4 ms after the deadline, and a transfer that is later is encoded again.

    Lines are sent whole or not at all.  After a frame that could not be sent, the rest of its
    transfer is dropped, the line is counted as ``down`` or ``full``, and the next period starts
    a new transfer.  If the transmit queue is full, the transmitter retries until the line's next
    deadline.

    Args:
        link: where to send: a `Link` or an open python-can bus. It stays open when the transmitter
            stops. A bus is not reopened after an outage, see `Link`.
        codec: encodes the lines; used by the transmitter's thread only.
        period: between two transfers of a slot [s].
        fd: send CAN FD frames.
        count: stop when every slot has had this many deadlines; None for ever.
        max_age: greatest age of a line that is stated [s]; at most the greatest age that the DBC
            can state, which is the default (0.24 s with the project's DBC).
        clock: a monotonic clock [s].
        on_sent: called with each frame after it was handed to the interface, by the thread of the
            transmitter, such as to log it.

    Raises:
        TypeError: ``link`` is neither a link nor a bus, or ``codec`` is no codec.
        ValueError: ``period``, ``count`` or ``max_age`` is out of range.
        BusError: ``fd`` on a link without CAN FD.
        EncodeError: not ``fd``, and the DBC has no message for classic CAN.
    """

    def __init__(
        self,
        link: Link | can.BusABC,
        codec: LineCodec,
        *,
        period: float = 0.05,
        fd: bool = False,
        count: int | None = None,
        max_age: float | None = None,
        clock: Callable[[], float] = time.monotonic,
        on_sent: Callable[[Frame], None] | None = None,
    ) -> None:
        if not hasattr(codec, "encoder"):
            raise TypeError(f"codec must be a Codec, such as Codec.from_dbc(), got {codec!r}")
        if not 0.001 <= period <= 3600:
            raise ValueError(f"period must be in [0.001, 3600] s, got {period!r} s")
        if count is not None and count < 1:
            raise ValueError(f"count must be 1 or more, or None for ever, got {count!r}")
        stated = codec.layout.max_age
        if max_age is not None and not 0 < max_age <= stated:
            raise ValueError(
                f"max_age must be above 0 s and at most {stated:g} s, the greatest age that the "
                f"DBC can state, got {max_age!r} s"
            )
        link = link_of(link)
        if fd and not link.fd:
            raise BusError(
                f"{link.name} is opened without CAN FD; open it with fd=True, or send classic "
                "frames (fd=False)"
            )
        if not (fd or codec.layout.has_classic):
            raise classic_error(codec.layout)
        super().__init__("maplines transmit")
        self._link, self._period, self._clock, self._on_sent = link, period, clock, on_sent
        self._codec, self._encoder, self._fd = codec, codec.encoder(), fd
        max_age = stated if max_age is None else max_age
        self._tx_queue = TxQueue(codec, period, fd=fd, count=count, max_age=max_age)
        self._counts = Counter(
            lines=0, down=0, full=0, overruns=0, frames=0, retries=0, expired=0, pose_errors=0
        )
        self._left_out: Counter[LeftOut] = Counter()
        self._lateness = LatenessHistogram()

    def publish(
        self,
        line: MapLine | Iterable[MapLine] | Scene | PreparedScene,
        t_pose_ns: int | None = None,
    ) -> None:
        """Send this line from now on, instead of the previous one of its slot.

        A line that is left out is retracted: its slot does not go on with the previous one.
        ``TransmitterStats.left_out`` counts such lines by reason: those that ``map_lines`` or
        ``map_scene`` left out, and those of a scene that do not fit the message, or for which it
        has no place.

        A scene is sent instead of all that was published before: in each period the pose error
        first, then the lines that were seen from this pose. This call encodes the scene, in the
        thread of the caller, unless ``Encoder.prepare_scene`` has done so.

        Args:
            line: the line, or several lines that take effect at the same moment, such as the
                result of ``map_lines``, or a scene. Their ages grow from this call on.
            t_pose_ns: time of the vehicle pose that the lines belong to, on the clock of
                ``time.time_ns()`` [ns]. If it is given, ages are computed from it, and
                ``line.age`` is ignored.

        Raises:
            EncodeError: a scene does not fit the DBC, or was prepared for another one, see
                ``Encoder.prepare_scene``; or the DBC takes scenes only.
            ValueError: ``t_pose_ns`` is more than 1 s ahead of ``time.time_ns()``, or more
                than 1 h behind.
            RuntimeError: the transmitter was stopped, or runs in the parent process only.
            Exception: the error of the codec or of a callback that ended the thread.
        """
        self._raise_error()
        age = None
        if t_pose_ns is not None:
            age = (time.time_ns() - t_pose_ns) * 1e-9
            if not -1 <= age <= 3600:
                raise ValueError(
                    f"t_pose_ns must be on the clock of time.time_ns(), at most 1 s ahead and 1 h "
                    f"ago, got {t_pose_ns!r}, which was {age:g} s ago"
                )
        if isinstance(line, Scene | PreparedScene):
            line = self._encoder.prepare_scene(line, fd=self._fd)
        prepared = line if isinstance(line, PreparedScene) else None
        left_out = line.left_out if isinstance(line, MapLineList) else {}
        lines: list[MapLine] = []
        if not isinstance(line, PreparedScene):
            lines = [line] if isinstance(line, MapLine) else list(line)
            if lines and self._codec.layout.is_conditional:
                raise EncodeError(
                    f"{self._codec.layout.source}: its records are conditional on the pose error, "
                    "so lines are sent as scenes; publish the result of map_scene"
                )
        with self._changed:
            if self._is_stopped:
                raise RuntimeError(
                    "publish must come before stop, and in the process that called start: this "
                    "transmitter sends nothing; make a new Transmitter"
                )
            first = self._tx_queue.first
            if prepared is not None:
                left_out = self._tx_queue.left_out(prepared)
            for slot in left_out:
                self._tx_queue.drop(slot)
            self._left_out.update(left_out.values())
            if prepared is None:
                self._tx_queue.put(lines, self._clock(), age)
            else:
                self._tx_queue.put_scene(prepared, self._clock(), age)
            if self._tx_queue.first != first:  # else the thread wakes up in time
                self._changed.notify_all()

    def retract(self, slot: Slot) -> None:
        """Stop sending the line of this slot; the slot may have none.

        The slot's counter stays, so a line that is published later leaves no gap. After `stop`
        there is nothing left to retract, and nothing happens.
        """
        with self._changed:
            self._tx_queue.drop(slot)

    def stats(self) -> TransmitterStats:
        """Return a consistent copy of all counters."""
        with self._changed:
            return TransmitterStats(
                **self._counts,
                left_out=dict(self._left_out),
                lateness=self._lateness.summary(),
            )

    def start(self) -> Self:
        """Start the thread; ``with`` calls this.  The first period starts with the first line."""
        return self._start_thread()

    def _run(self) -> None:
        while (transfer := self._next_transfer()) is not None:
            self._send(transfer)

    def _next_transfer(self) -> Transfer | None:
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
        give_up = transfer.deadline + self._period
        lateness = self._clock() - transfer.deadline
        while True:
            while sent == 0 and (now := self._clock()) > transfer.latest:
                transfer = self._tx_queue.renew(transfer, now)
            frames = transfer.frames[sent:]
            result, taken = self._link.send_all([message_of(frame) for frame in frames])
            sent += taken
            if self._on_sent is not None:
                for frame in frames[:taken]:
                    self._on_sent(frame)
            if result is not Sent.FULL or self._clock() >= give_up:
                break
            time.sleep(RETRY)  # drivers do not signal that the queue has room again
            retries += 1
        with self._changed:
            self._lateness.add(lateness)
            counts = self._counts
            if result is Sent.OK:
                counts["pose_errors"] += transfer.pose_errors
                counts["lines"] += transfer.lines
                counts["expired"] += transfer.expired
            else:
                counts["down" if result is Sent.DOWN else "full"] += max(transfer.lines, 1)
            counts["overruns"] += transfer.skipped
            counts["frames"] += sent
            counts["retries"] += retries
