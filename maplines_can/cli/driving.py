"""A drive cycle by cycle: its lines on a bus or into a log, the truth, and counters."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..bus import Link, LogWriter, Transmitter, frame_time
from ..ego import Cycle, LineSource, State
from ..line import MapLineList, Slot
from ..maps import LaneTracker
from ..wire import Codec, Frame

if TYPE_CHECKING:
    from ..study.drives.truth import TruthWriter

#: Shows the time of the drive that has passed and its whole duration [s].
Progress = Callable[[float, float], None]


@dataclass
class Counters:
    """Counters of a drive."""

    cycles: int = 0
    late_cycles: int = 0  #: left out, because the machine was busy
    lines: int = 0
    frames: int = 0
    bus_time: float = 0.0  #: that the frames take, with the most stuff bits [s]
    cpu: float = 0.0  #: of this process [s]
    lane_changes: int = 0
    slot_changes: int = 0  #: slots that got another line: new ones, and all at a lane change
    off_map: int = 0  #: cycles without a lane near the car
    other_lane: int = 0  #: cycles in which the car was on another lane than it believed
    left_out: Counter[str] = field(default_factory=Counter)  #: lines by reason

    def add(self, cycle: Cycle) -> None:
        """Count a cycle."""
        self.cycles += 1
        self.lane_changes += cycle.scene.lane_changed
        self.slot_changes += len(cycle.changed) if self.cycles > 1 else 0
        self.off_map += cycle.scene.match is None
        self.left_out.update(reason.name for reason in cycle.lines.left_out.values())


class TruthRecorder:
    """Recorder of the truth of each cycle.

    It has a tracker of its own, of the true pose: so the truth says where a car that knew its
    pose would have each line.
    """

    def __init__(self, writer: TruthWriter, tracker: LaneTracker, slots: tuple[Slot, ...]) -> None:
        self._writer, self._tracker, self._slots = writer, tracker, slots

    def add(self, time: float, state: State, cycle: Cycle) -> bool:
        """Write a cycle, and return whether the car is on the lane on which it believes to be."""
        from ..study.drives.truth import true_lines

        scene = self._tracker.lines(state.pose)
        cov = cycle.stated.cov
        row = [time, float(state.t), *state.pose.tolist(), float(state.speed)]
        row += [float(state.yaw_rate), *cycle.stated.mean.tolist()]
        row += [cov[i, j].item() for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))]
        self._writer.write(
            [*row, scene.lane or "", cycle.scene.lane or "", float(cycle.scene.lane_changed)],
            true_lines(scene.lines, self._slots, state.pose),
        )
        return scene.lane == cycle.scene.lane


@dataclass
class Drive:
    """A drive to be sent.

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
    states: State
    period: float
    codec: Codec
    fd: bool
    bitrates: tuple[int, int | None]
    open_log: Callable[[float], LogWriter] | None
    truth: TruthRecorder | None
    progress: Progress
    counters: Counters = field(default_factory=Counters)

    def simulate(self, start_ns: int, set_clock: Callable[[int], None]) -> None:
        """Encode all cycles at once, as if they were sent from a time on [ns].

        The lines of a cycle are sent back to back from the time of its pose on.
        """
        set_clock(start_ns)
        with self._log(start_ns) as log:
            step = 0.0
            for t_ns, state in self._cycles(start_ns):
                set_clock(t_ns)
                cycle = self._cycle(t_ns, state)
                stamp = 1e-9 * t_ns
                step = step or self._transfer_time(cycle.lines)
                aged = [replace(line, age=i * step) for i, line in enumerate(cycle.lines)]
                for frames in self.codec.encode_lines(aged, fd=self.fd):
                    self.counters.lines += 1
                    for frame in frames:
                        stamp += self._count(frame)
                        if log is not None:
                            log.write(frame, stamp)

    def send(self, settings: dict[str, Any]) -> dict[str, Any]:
        """Send all cycles in real time, and return the counters of the transmitter."""
        start_ns, start = time.time_ns(), time.monotonic()
        with self._log(start_ns) as log, Link(**settings) as link:

            def sent(frame: Frame) -> None:
                self._count(frame)
                if log is not None:
                    log.write(frame, 1e-9 * time.time_ns())

            transmitter = Transmitter(
                link, self.codec, period=self.period, fd=self.fd, on_sent=sent
            )
            given: set[Slot] = set()
            try:
                with transmitter:
                    for t_ns, state in self._cycles(start_ns):
                        due = start + 1e-9 * (t_ns - start_ns)
                        late = time.monotonic() - due
                        if late >= self.period:
                            self.counters.late_cycles += 1
                            continue
                        if transmitter.wait(max(-late, 0.0)):
                            break
                        cycle = self._cycle(t_ns, state)
                        for slot in given - cycle.scene.lines.keys():
                            transmitter.retract(slot)
                        given = {line.slot for line in cycle.lines}
                        transmitter.publish(cycle.lines, t_ns)
                    transmitter.wait(self.period)
            except KeyboardInterrupt:
                pass
            stats = transmitter.stats()
            self.counters.lines = stats.lines
            return {
                "down": stats.down,
                "full": stats.full,
                "overruns": stats.overruns,
                "outages": link.outages,
            }

    def _cycles(self, start_ns: int) -> Iterator[tuple[int, State]]:
        """Yield the time of each cycle [ns] and the true state."""
        start, end = self.states.t[0], self.states.t[-1]
        before = time.process_time()
        for i, t in enumerate(self.states.t):
            self.progress(t - start, end - start)
            yield start_ns + round(1e9 * (t - start)), State(*(values[i] for values in self.states))
            self.counters.cpu = time.process_time() - before

    def _cycle(self, t_ns: int, state: State) -> Cycle:
        """Return the lines of a cycle, counted and with the truth recorded."""
        cycle = self.source.cycle(float(state.t), state.pose)
        self.counters.add(cycle)
        if self.truth is not None and not self.truth.add(1e-9 * t_ns, state, cycle):
            self.counters.other_lane += 1
        return cycle

    def _log(self, start_ns: int) -> AbstractContextManager[LogWriter | None]:
        return nullcontext() if self.open_log is None else self.open_log(1e-9 * start_ns)

    def _count(self, frame: Frame) -> float:
        """Count a frame, and return the time that it takes on the bus [s]."""
        duration = frame_time(frame, *self.bitrates)
        self.counters.frames += 1
        self.counters.bus_time += duration
        return duration

    def _transfer_time(self, lines: MapLineList) -> float:
        """Return the time that the frames of one line take on the bus [s]; 0 without lines."""
        if not lines:
            return 0.0
        blank = np.zeros(self.codec.layout.record_bytes, dtype=np.uint8)
        frames = self.codec.frames(blank, lines[0].slot, fd=self.fd)
        return sum(frame_time(frame, *self.bitrates) for frame in frames)
