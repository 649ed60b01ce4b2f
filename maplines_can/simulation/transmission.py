"""Transmission of a drive cycle by cycle, on a bus or into a log, with its truth and counters."""

from __future__ import annotations

import copy
import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from ..bus import Link, LogWriter, Transmitter, frame_time
from ..maps import LaneTracker
from ..maps.line_source import Cycle, LineSource
from ..values.line import MapLine, MapLineList, Slot
from ..values.scene import Scene
from ..wire import SCENE, SCENE2, Frame, LineCodec, Owner, PreparedScene
from .trajectory import CarState
from .truth import TruthWriter, true_lines

if TYPE_CHECKING:
    from ..testing import FaultInjector, FaultyOpener

#: Shows the time of the drive that has passed and its whole duration [s].
Progress = Callable[[float, float], None]


@dataclass
class Counters:
    """Counters of a drive."""

    cycles: int = 0
    stopped: bool = False  #: by Ctrl-C
    late_cycles: int = 0  #: left out, because the machine was busy
    lines: int = 0
    pose_errors: int = 0
    frames: int = 0
    bus_time: float = 0.0  #: that the frames on the bus take, with the most stuff bits [s]
    cpu: float = 0.0  #: of this process [s]
    lane_changes: int = 0
    slot_changes: int = 0  #: slots that got another line: new ones, and all at a lane change
    off_map: int = 0  #: cycles without a lane near the car
    no_pose: int = 0  #: cycles in which the car did not know its pose, so that no line was sent
    other_lane: int = 0  #: cycles in which the car was on another lane than it believed
    #: lines that were not sent, by reason: of the map, or since they do not fit the message
    left_out: Counter[str] = field(default_factory=Counter)

    def add(self, cycle: Cycle) -> None:
        """Count a cycle."""
        self.cycles += 1
        self.lane_changes += cycle.tracked.lane_changed
        self.slot_changes += len(cycle.changed) if self.cycles > 1 else 0
        self.no_pose += cycle.reported is None
        self.off_map += cycle.tracked.match is None and cycle.reported is not None
        self.left_out.update(reason.name for reason in cycle.lines.left_out.values())


class TruthRecorder:
    """Recorder of the truth of each cycle.

    It has a tracker of its own, of the true pose: so the truth says where a car that knew its
    pose would have each line.
    """

    def __init__(self, writer: TruthWriter, tracker: LaneTracker, slots: tuple[Slot, ...]) -> None:
        self._writer, self._tracker, self._slots = writer, tracker, slots

    def add(self, time: float, state: CarState, cycle: Cycle) -> bool:
        """Write a cycle, and return whether the car is on the lane on which it believes to be.

        A car without a pose believes nothing.
        """
        tracked = self._tracker.lines(state.pose)
        motion = float(state.speed), float(state.yaw_rate)
        row = [time, float(state.t), *state.pose.tolist(), *motion]
        if cycle.reported is None:
            row += [math.nan] * 9
        else:
            cov = cycle.reported.cov
            row += cycle.reported.mean.tolist()
            row += [cov[i, j].item() for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))]
        self._writer.write(
            [*row, tracked.lane or "", cycle.tracked.lane or "", float(cycle.tracked.lane_changed)],
            true_lines(tracked.lines, self._slots, state.pose),
        )
        return cycle.reported is None or tracked.lane == cycle.tracked.lane


@dataclass
class Transmission:
    """Transmission of the lines of a drive.

    Args:
        source: lines of each cycle.
        states: true poses at the sending rate.
        period: between two cycles [s].
        codec: encodes the lines.
        fd: whether the frames are CAN FD.
        bitrates: nominal, and of the data phase of CAN FD [bit/s].
        open_log: returns the log that starts at a time [s]; None for no log.
        truth: recorder of the truth; None for none.
        progress: shows the progress.
    """

    source: LineSource
    states: CarState
    period: float
    codec: LineCodec
    fd: bool
    bitrates: tuple[int, int | None]
    open_log: Callable[[float], LogWriter] | None
    truth: TruthRecorder | None
    progress: Progress
    counters: Counters = field(default_factory=Counters)

    def __post_init__(self) -> None:
        self._encoder = self.codec.encoder()
        self._step = 0.0  # time that a record of a line takes, as soon as it is known

    def simulate(
        self,
        start_ns: int,
        set_clock: Callable[[int], None],
        injector: FaultInjector[Frame] | None = None,
    ) -> dict[str, Any]:
        """Encode all cycles at once, as if they were sent from a time on [ns].

        The lines of a cycle are sent back to back from the time of its pose on.

        Returns:
            The counters of the injected faults.
        """
        set_clock(start_ns)
        with self._log(start_ns) as log:
            bus = SimulatedBus(
                1e-9 * start_ns, injector, self._duration, partial(self._on_bus, log)
            )
            with self._stoppable():
                for t_ns, transfers in self._simulated_cycles(start_ns, set_clock):
                    bus.wait(1e-9 * t_ns)
                    for frame in chain.from_iterable(transfers):
                        self.counters.frames += 1
                        bus.send(frame)
            bus.close()
        return {} if injector is None else {"faults": injector.as_dict() | {"unsent": 0}}

    def _simulated_cycles(
        self, start_ns: int, set_clock: Callable[[int], None]
    ) -> Iterator[tuple[int, Iterable[list[Frame]]]]:
        """Yield the time of each cycle, with the clock set to it, and the frames of its records."""
        numbers = Counter[Owner]()
        for t_ns, state in self._cycles(start_ns):
            set_clock(t_ns)
            cycle = self._cycle(t_ns, state)
            if cycle.scene is None:
                yield t_ns, self._line_transfers(cycle.lines)
            else:
                yield t_ns, self._scene_transfers(cycle.scene, numbers)

    def send(self, opener: FaultyOpener | None, settings: dict[str, Any]) -> dict[str, Any]:
        """Send all cycles in real time, and return the counters of the transmitter.

        Args:
            opener: injects faults; None for none.
            settings: of ``Link``.
        """
        start_ns, start = time.time_ns(), time.monotonic()
        with self._log(start_ns) as log:

            def on_bus(frame: Frame) -> None:
                self._on_bus(log, frame, 1e-9 * time.time_ns())

            def sent(frame: Frame) -> None:
                self.counters.frames += 1
                if opener is None:
                    on_bus(frame)

            if opener is not None:
                opener.on_sent = on_bus
            with Link(opener, **settings) as link:
                transmitter = Transmitter(
                    link, self.codec, period=self.period, fd=self.fd, on_sent=sent
                )
                with self._stoppable(), transmitter:
                    self._publish(transmitter, start_ns, start)
                    transmitter.wait(self.period)
                stats = transmitter.stats()
                self.counters.lines = stats.lines
                self.counters.pose_errors = stats.pose_errors
                return {
                    "down": stats.down,
                    "full": stats.full,
                    "overruns": stats.overruns,
                    "outages": link.outages,
                }

    def _publish(self, transmitter: Transmitter, start_ns: int, start: float) -> None:
        """Publish each cycle when it is due, but those that are late by a period."""
        given: set[Slot] = set()
        for t_ns, state in self._cycles(start_ns):
            late = time.monotonic() - (start + 1e-9 * (t_ns - start_ns))
            if late >= self.period:
                self.counters.late_cycles += 1
                continue
            if transmitter.wait(max(-late, 0.0)):
                break
            cycle = self._cycle(t_ns, state)
            for slot in given - cycle.tracked.lines.keys():
                transmitter.retract(slot)
            given = {line.slot for line in cycle.lines}
            scene = cycle.scene
            transmitter.publish(cycle.lines if scene is None else self._prepared(scene), t_ns)

    @contextmanager
    def _stoppable(self) -> Iterator[None]:
        """Let Ctrl-C end the drive."""
        try:
            yield
        except KeyboardInterrupt:
            self.counters.stopped = True

    def _cycles(self, start_ns: int) -> Iterator[tuple[int, CarState]]:
        """Yield the time of each cycle [ns] and the true state."""
        start, end = self.states.t[0], self.states.t[-1]
        before = time.process_time()
        for i, t in enumerate(self.states.t):
            self.progress(t - start, end - start)
            yield (
                start_ns + round(1e9 * (t - start)),
                CarState(*(values[i] for values in self.states)),
            )
            self.counters.cpu = time.process_time() - before

    def _cycle(self, t_ns: int, state: CarState) -> Cycle:
        """Return the lines of a cycle, counted and with the truth recorded."""
        cycle = self.source.cycle(float(state.t), state.pose)
        self.counters.add(cycle)
        if self.truth is not None and not self.truth.add(1e-9 * t_ns, state, cycle):
            self.counters.other_lane += 1
        return cycle

    def _log(self, start_ns: int) -> AbstractContextManager[LogWriter | None]:
        return nullcontext() if self.open_log is None else self.open_log(1e-9 * start_ns)

    def _on_bus(self, log: LogWriter | None, frame: Frame, stamp: float) -> None:
        """Take a frame that was on the bus at a time [s]."""
        self.counters.bus_time += self._duration(frame)
        if log is not None:
            log.write(frame, stamp)

    def _duration(self, frame: Frame) -> float:
        """Return the time that a frame takes on the bus [s]."""
        return frame_time(frame, *self.bitrates)

    def _line_transfers(self, lines: MapLineList) -> Iterator[list[Frame]]:
        """Yield the frames of each line, with the age at which it is sent."""
        step = self._transfer_time(lines)
        ages = np.cumsum([0.0, *(step * _records(line) for line in lines)])
        aged = [replace(line, age=float(age)) for line, age in zip(lines, ages, strict=False)]
        for frames in self._encoder.encode_lines(aged, fd=self.fd):
            self.counters.lines += 1
            yield frames

    def _scene_transfers(self, scene: Scene, numbers: Counter[Owner]) -> Iterator[list[Frame]]:
        """Yield the frames of each record, the pose error first, each with its own age.

        Args:
            scene: the scene.
            numbers: next counters of the owners of records, which advance.
        """
        prepared = self._prepared(scene)
        if SCENE in prepared.owners:
            yield from self._whole_transfers(prepared)
            return
        first, age = Counter(numbers), 0.0
        self.counters.lines += len(prepared.sent_slots)
        for owner in prepared.owners:
            frames = self._encoder.encode_scene(prepared, age=age, fd=self.fd, counters=first)[
                owner
            ]
            numbers[owner] += 1
            self.counters.pose_errors += not isinstance(owner, Slot)
            age += sum(map(self._duration, frames))
            yield frames

    def _whole_transfers(self, prepared: PreparedScene) -> Iterator[list[Frame]]:
        """Yield the frames of a whole scene, each with its own age."""
        before = copy.copy(self._encoder)
        sent = self._encoder.encode_scene(prepared, fd=self.fd)
        if SCENE2 in sent:
            ages: dict[Owner, float] = {SCENE2: 0.0}
            ages[SCENE] = sum(map(self._duration, sent[SCENE2]))
            sent = before.encode_scene(prepared, age=ages, fd=self.fd)
        self.counters.pose_errors += len(sent)
        without = self._encoder.left_out(prepared, fd=self.fd)
        self.counters.lines += sum(slot not in without for slot in prepared.sent_slots)
        yield from sent.values()

    def _prepared(self, scene: Scene) -> PreparedScene:
        """Return a scene for sending, and count the lines that do not fit the message."""
        prepared = self._encoder.prepare_scene(scene, fd=self.fd)
        left_out = self._encoder.left_out(prepared, fd=self.fd).items()
        self.counters.left_out.update(why.name for slot, why in left_out if slot in scene.index)
        return prepared

    def _transfer_time(self, lines: MapLineList) -> float:
        """Return the time that a record of a line takes on the bus [s]; 0 without lines."""
        if lines and not self._step:
            blank = np.zeros(self.codec.layout.record_bytes, dtype=np.uint8)
            frames = self._encoder.frames(blank, lines[0].slot, fd=self.fd)
            self._step = sum(map(self._duration, frames))
        return self._step


def _records(line: MapLine) -> int:
    """Return how many records carry a line."""
    return 1 if line.mixture is None else len(line.mixture.weights)


class SimulatedBus:
    """Bus whose time is computed: frames follow each other without a gap.

    Args:
        now: time at which it is free [s].
        injector: of faults; None for none.
        duration: returns how long a frame takes [s].
        carry: takes a frame and the time of its end [s].
    """

    def __init__(
        self,
        now: float,
        injector: FaultInjector[Frame] | None,
        duration: Callable[[Frame], float],
        carry: Callable[[Frame, float], None],
    ) -> None:
        self._now, self._injector = now, injector
        if injector is not None:
            injector.start(now)
        self._duration, self._carry = duration, carry

    def wait(self, t: float) -> None:
        """Let the time pass until t [s], and carry the frames that are due by then."""
        while self._injector is not None and (due := self._injector.next_due) <= t:
            self._now = max(self._now, due)
            self._transmit(self._injector.due(self._now))
        self._now = max(self._now, t)

    def send(self, frame: Frame) -> None:
        """Carry the frames that a frame becomes."""
        if self._injector is None:
            self._transmit([frame])
        else:
            self.wait(self._now)
            self._transmit(self._injector.apply(frame, self._now))

    def close(self) -> None:
        """Carry the frames that are still held back."""
        if self._injector is not None:
            self._transmit(self._injector.flush())

    def _transmit(self, frames: Iterable[Frame]) -> None:
        for frame in frames:
            self._now += self._duration(frame)
            self._carry(frame, self._now)
