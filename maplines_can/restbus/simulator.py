"""Simulation of the nodes around a device under test, on a real or a virtual clock."""

from __future__ import annotations

import sys
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

from ..bus import Lateness, Link, Sent
from ..bus.clock import Clock, to_ns
from ..bus.link import link_of
from ..bus.periodic import PeriodicCall, QueueSending
from ..bus.tx_queue import TxQueue
from ..logs.j1939 import source_of
from ..logs.log_writer import message_of
from ..values.errors import MaplinesError, RestbusError
from ..values.line import MapLineList, Slot
from ..values.scene import Scene
from ..wire import Frame
from .broadcasts import PAUSE_NS, Broadcasts
from .config import Config, LinesConfig
from .frame_faults import FaultySending, parse_faults
from .messages import DbcMessage
from .toml_tables import listed, nearest

if TYPE_CHECKING:
    import can

#: Pause until a frame is sent again that met a full transmit queue [ns], and most that wait.
RETRY_NS, MAX_WAITING = 1_000_000, 256

COMMANDS = {
    "set": "set Message.Signal VALUE",
    "reset": "reset Message.Signal",
    "start": "start Message",
    "stop": "stop Message",
    "fault": "fault loss=0.1",
}


class Restbus:
    """Simulation of the nodes around a device under test.

    Everything is done by the thread that runs the clock, at absolute deadlines. With a
    ``VirtualClock`` and a ``VirtualTimeBus``, a minute takes a second::

        clock = VirtualClock()
        network = VirtualNetwork(clock)
        restbus = Restbus(Config.load("car.toml"), VirtualTimeBus(network), clock)
        restbus.start()
        clock.run_for(60.0)

    Args:
        config: what to send. It is used up by a run.
        bus: an open bus of python-can, or a ``Link``; it stays open.
        clock: runs the simulation.
        on_sent: called with each frame and its time [ns], such as to log it.
        on_error: called with the text of a command of `command` that is wrong; by default,
            it is printed on standard error.
    """

    def __init__(
        self,
        config: Config,
        bus: Link | can.BusABC,
        clock: Clock,
        *,
        on_sent: Callable[[Frame, int], object] | None = None,
        on_error: Callable[[str], object] | None = None,
    ) -> None:
        self.config, self.clock = config, clock
        self._link, self._on_sent = link_of(bus), on_sent
        self._on_error = on_error or partial(print, file=sys.stderr)
        self._faults = FaultySending(clock, self._put, config.seed)
        self._waiting: deque[Frame] = deque()
        self._check_bus()
        self._sending = {
            name: _MessageSending(message, clock, self._faults.send, broadcasts)
            for (name, message), broadcasts in zip(
                config.messages.items(), self._broadcasts(config.messages.values()), strict=True
            )
        }
        lines = config.lines
        self._lines = None if lines is None else _LinesSending(lines, clock, self._faults.send)
        self._start_ns = clock.now_ns
        self.frames = 0  #: frames handed to the bus
        self.unsent: Counter[str] = Counter()  #: frames that the bus did not take, by reason
        self.commands = 0  #: commands and events that were executed
        self._check_events()

    @property
    def now(self) -> float:
        """Time since the start [s]."""
        return (self.clock.now_ns - self._start_ns) / 1e9

    def start(self) -> None:
        """Begin now: all delays and times of the configuration count from here."""
        self._start_ns = self.clock.now_ns
        for event in self.config.events:
            self.clock.call_at(
                self._start_ns + to_ns(event.at), partial(self._execute, event.command)
            )
        if self.config.faults:
            self._faults.set(self.config.faults)
        for sending in self._senders.values():
            sending.begin(self._start_ns)

    def stop(self) -> None:
        """Send nothing more, but frames that faults hold back."""
        for sending in self._senders.values():
            sending.stop()
        self._faults.finish()

    def command(self, text: str) -> None:
        """Execute a command as soon as possible, in the thread of the clock; from any thread.

        The commands are those of ``COMMANDS``. An error is passed to ``on_error``.
        """
        self.clock.call_at(self.clock.now_ns, partial(self._try, text))

    def execute(self, text: str) -> None:
        """Execute a command now; only in the thread of the clock.

        Raises:
            RestbusError: the command is wrong.
        """
        self._execute(text)

    def as_dict(self) -> dict[str, Any]:
        """Return the counters, for JSON."""
        return {
            "seconds": self.now,
            "frames": self.frames,
            "unsent": dict(self.unsent),
            "commands": self.commands,
            "faults": self._faults.counts(),
            "outages": self._link.outages,
            "notices": self.config.notices,
            "messages": {name: sending.as_dict() for name, sending in self._senders.items()},
        }

    @property
    def _senders(self) -> dict[str, _MessageSending | _LinesSending]:
        lines = {} if self._lines is None else {"lines": self._lines}
        return {**self._sending, **lines}

    # ---- commands ------------------------------------------------------------------

    def _check_events(self) -> None:
        """Check all events in their order: a signal may contradict one that was set before."""
        parse_faults(self.config.faults or "off", 0)
        for event in self.config.events:
            try:
                execute = self._parsed(event.command)
            except MaplinesError as error:
                raise RestbusError(f"event at {event.at:g} s: {error}") from error
            if event.command.split()[0] in ("set", "reset"):
                execute()
        for message in self.config.messages.values():
            message.reset()

    def _try(self, text: str) -> None:
        try:
            self._execute(text)
        except MaplinesError as error:
            self._on_error(str(error))

    def _execute(self, text: str) -> None:
        self._parsed(text)()
        self.commands += 1

    def _parsed(self, text: str) -> Callable[[], object]:
        """Return what a command does; all that can be wrong is wrong now."""
        word, _, rest = text.strip().partition(" ")
        rest = rest.strip()
        if word not in COMMANDS:
            raise RestbusError(f"unknown command {word!r}{nearest(word, COMMANDS, 'there are')}")
        if not rest:
            raise RestbusError(f"{word} needs more, such as {COMMANDS[word]!r}")
        if word == "fault":
            parse_faults(rest, 0)  # raises if it is wrong
            return partial(self._faults.set, rest)
        if word in ("start", "stop"):
            if rest not in self._senders:
                hint = nearest(rest, self._senders, "there are")
                raise RestbusError(f"{word}: there is no message {rest!r}{hint}")
            sending = self._senders[rest]
            return sending.stop if word == "stop" else sending.restart
        target, _, value = rest.partition(" ")
        name, _, signal = target.partition(".")
        if name not in self._sending:
            hint = nearest(name, self._sending, "there are")
            raise RestbusError(f"{word}: there is no message {name!r}{hint}")
        message = self._sending[name].message
        if word == "reset":
            message.check(signal)
            return partial(message.reset, signal)
        message.check(signal, _value(value))
        return partial(message.set, signal, _value(value))

    # ---- sending -------------------------------------------------------------------

    def _check_bus(self) -> None:
        """Check that the bus can carry what is sent."""
        lines = self.config.lines
        names = [message.name for message in self.config.messages.values() if message.is_fd]
        if lines is not None and lines.fd:
            names.append("lines")
        if names and not self._link.carries_fd:
            raise RestbusError(
                f"{listed(names)}: sent as CAN FD, and {self._link.name} is open for classic CAN; "
                "set fd = true in [bus], or open it for CAN FD"
            )

    def _broadcasts(self, messages: Iterable[DbcMessage]) -> Iterator[Broadcasts | None]:
        """Yield, of each message, what sends its frames one after the other; None if all at once.

        Raises:
            RestbusError: an address has no time for its messages.
        """
        senders: dict[int, Broadcasts] = {}
        load: defaultdict[int, float] = defaultdict(float)
        for message in messages:
            if not message.is_broadcast:
                yield None
                continue
            address = source_of(message.can_id)
            load[address] += message.frames_each * PAUSE_NS * message.count / message.cycle_ms
            if load[address] > 1e6:
                raise RestbusError(
                    f"message {message.name}: J1939 sends its {message.frames_each} frames 50 ms "
                    f"apart, and address {address} has no time for them; lengthen cycle_ms"
                )
            yield senders.setdefault(address, Broadcasts(self.clock))

    def _put(self, frame: Frame) -> None:
        """Hand a frame to the bus, after those that wait for room in its queue."""
        if self._waiting:
            if len(self._waiting) < MAX_WAITING:
                self._waiting.append(frame)
            else:
                self.unsent["full"] += 1
        elif not self._handed_over(frame):
            self._waiting.append(frame)
            self.clock.call_at(self.clock.now_ns + RETRY_NS, self._retry)

    def _retry(self) -> None:
        while self._waiting:
            if not self._handed_over(self._waiting[0]):
                self.clock.call_at(self.clock.now_ns + RETRY_NS, self._retry)
                return
            self._waiting.popleft()

    def _handed_over(self, frame: Frame) -> bool:
        """Hand a frame to the bus; return False if its transmit queue is full."""
        result = self._link.send(message_of(frame))
        if result is Sent.OK:
            self.frames += 1
            if self._on_sent is not None:
                self._on_sent(frame, self.clock.now_ns)
        elif result is Sent.DOWN:
            self.unsent["down"] += 1
        return result is not Sent.FULL


def _value(text: str) -> float | str:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text.strip()


class _MessageSending:
    """Periodic sending of a message, with its bursts."""

    def __init__(
        self,
        message: DbcMessage,
        clock: Clock,
        send: Callable[[Frame], object],
        broadcasts: Broadcasts | None,
    ) -> None:
        self.message, self._clock, self._send = message, clock, send
        self._broadcasts, self._frames = broadcasts, 0
        self._start_ns = clock.now_ns
        self._call: PeriodicCall | None = None
        self._generation = 0  # a burst of an earlier one is not finished
        self._lateness, self._overruns = Lateness(0.0, 0.0, 0.0), 0

    def begin(self, start_ns: int) -> None:
        self._start_ns = start_ns
        if self.message.is_on:
            self._begin(start_ns + to_ns(self.message.start_ms / 1000))

    def restart(self) -> None:
        """Begin again now, if it is stopped."""
        if self._call is None:
            self._begin(self._clock.now_ns)

    def stop(self) -> None:
        """Send nothing more until `restart`."""
        call, self._call = self._call, None
        self._generation += 1
        if call is not None:
            call.stop()
            self._overruns += call.overruns
            self._lateness = call.lateness()

    def as_dict(self) -> dict[str, Any]:
        call = self._call
        lateness = self._lateness if call is None else call.lateness()
        overruns = self._overruns + (0 if call is None else call.overruns)
        return {"frames": self._frames, "overruns": overruns, "lateness": lateness._asdict()}

    def _begin(self, first_ns: int) -> None:
        period_ns = to_ns(self.message.cycle_ms / 1000)
        self._call = PeriodicCall(self._clock, period_ns, self._burst, start_ns=first_ns)

    def _burst(self, deadline_ns: int) -> None:
        gap_ns, generation = to_ns(self.message.gap_ms / 1000), self._generation
        self._frame(deadline_ns, generation)
        for number in range(1, self.message.count):
            t_ns = deadline_ns + number * gap_ns
            self._clock.call_at(t_ns, partial(self._frame, t_ns, generation))

    def _frame(self, t_ns: int, generation: int) -> None:
        if generation != self._generation:
            return
        frames = self.message.frames((t_ns - self._start_ns) / 1e9)
        if self._broadcasts is None:
            self._count_and_send(frames[0])
        else:
            self._broadcasts.put(partial(self._count_and_send, frame) for frame in frames)

    def _count_and_send(self, frame: Frame) -> None:
        self._frames += 1
        self._send(frame)


class _LinesSending:
    """Sending of lines: they are computed once a period, and sent by a ``TxQueue``."""

    def __init__(self, lines: LinesConfig, clock: Clock, send: Callable[[Frame], object]) -> None:
        self._lines, self._clock, self._start_ns = lines, clock, clock.now_ns
        codec = lines.codec
        self._encoder = codec.encoder()
        max_age = codec.layout.max_age
        queue = TxQueue(codec, lines.period, fd=lines.fd, count=None, max_age=max_age)
        self._sending = QueueSending(clock, queue, self._count_and_send)
        self._send, self._sent = send, 0
        self._call: PeriodicCall | None = None

    def begin(self, start_ns: int) -> None:
        self._start_ns = start_ns
        self._begin(start_ns + to_ns(self._lines.start))

    def restart(self) -> None:
        """Begin again now, if it is stopped."""
        if self._call is None:
            self._begin(self._clock.now_ns)

    def stop(self) -> None:
        """Send nothing more until `restart`."""
        call, self._call = self._call, None
        if call is not None:
            call.stop()
        self._sending.queue.put((), self._sending.now)  # ends a scene
        self._retract(set())

    def as_dict(self) -> dict[str, Any]:
        sending = self._sending
        lateness = sending.lateness()._asdict()
        return {
            "frames": self._sent,
            "transfers": sending.transfers,
            "overruns": sending.overruns,
            "lateness": lateness,
        }

    def _begin(self, first_ns: int) -> None:
        period_ns = to_ns(self._lines.period)
        self._call = PeriodicCall(self._clock, period_ns, self._publish, start_ns=first_ns)

    def _publish(self, deadline_ns: int) -> None:
        lines = self._lines.lines((deadline_ns - self._start_ns) / 1e9)
        queue, now = self._sending.queue, self._sending.now
        if lines is None:  # the end of a drive or a log
            self.stop()
            return
        if isinstance(lines, Scene):
            queue.put_scene(self._encoder.prepare_scene(lines, fd=self._lines.fd), now)
        else:
            left_out = lines.left_out if isinstance(lines, MapLineList) else ()
            self._retract({line.slot for line in lines} - set(left_out))
            queue.put(lines, now)
        self._sending.update()

    def _retract(self, kept: set[Slot]) -> None:
        for slot in set(Slot) - kept:
            self._sending.queue.drop(slot)
        self._sending.update()

    def _count_and_send(self, frame: Frame) -> None:
        self._sent += 1
        self._send(frame)
