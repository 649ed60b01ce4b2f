"""Nodes of a test: one that sends lines, with faults, and one that receives them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from itertools import chain
from typing import NamedTuple

from ..bus import LineListener
from ..bus.clock import TimerHandle
from ..logs.log_writer import message_of
from ..values.line import MapLine, Slot, aged
from ..values.scene import Scene
from ..wire import Codec, Frame, SceneView, SlotView
from ..wire.reception.views import STALE_CYCLES
from .bench import Bench
from .faults import Faults
from .faulty_bus import FaultyBus, parsed

#: Time between two looks at a receiver while the time passes [s].
STEP = 0.005


class SendingNode:
    """Node that sends lines: once, or in each period with a growing age.

    Args:
        bench: whose bus it joins.
        codec: encodes the lines.
        fd: send CAN FD frames.
    """

    def __init__(self, bench: Bench, codec: Codec, *, fd: bool = False) -> None:
        _check_bench(bench)
        self._bench, self._fd = bench, fd
        self._encoder, self._max_age = codec.encoder(), codec.layout.max_age
        self._bus = FaultyBus(bench.open(), Faults(direction="send"), clock=lambda: bench.now)
        self._next: TimerHandle | None = None
        self.sent = 0  #: lines that were handed to the bus, also those that a fault hit

    @property
    def faults(self) -> Faults:
        """Faults of the frames of this node; a text is read as that of ``--faults``.

        Intervals, such as those of ``loss=1@2.0-2.6``, count from the time at which they are set.
        """
        return self._bus.faults

    @faults.setter
    def faults(self, faults: Faults | str | None) -> None:
        own = parsed(Faults() if faults is None else faults)
        self._bus.faults = replace(own, direction="send")
        self._pump()

    @property
    def fault_counts(self) -> dict[str, int]:
        """Faults injected so far, by kind."""
        return {kind.value: count for kind, count in self._bus.counts.items() if count}

    def send(self, lines: MapLine | Iterable[MapLine] | Scene, age: float = 0.0) -> None:
        """Send lines now, once; or a scene, all of its records back to back.

        Args:
            lines: with ages of their own, or a scene, as from ``map_scene``.
            age: of the pose of a scene [s].

        Raises:
            EncodeError: the DBC has no such message.
        """
        if isinstance(lines, Scene):
            prepared = self._encoder.prepare_scene(lines, fd=self._fd)
            transfers = self._encoder.encode_scene(prepared, age=age, fd=self._fd)
            self._send([*chain.from_iterable(transfers.values())], len(prepared.sent_slots))
        else:
            for line in [lines] if isinstance(lines, MapLine) else lines:
                self._send(self._encoder.encode(line, fd=self._fd), 1)
        self._pump()

    def _send(self, frames: Iterable[Frame], lines: int) -> None:
        for frame in frames:
            self._bus.send(message_of(frame))
        self.sent += lines

    def publish(
        self, lines: MapLine | Iterable[MapLine] | Scene, period: float = 0.05, age: float = 0.0
    ) -> None:
        """Send lines or a scene now, and again in each period [s], instead of what was published.

        Ages grow; an age that the DBC cannot state is sent as "too old". ``age`` is that of the
        pose of a scene now [s].
        """
        own = (
            lines
            if isinstance(lines, Scene)
            else [lines]
            if isinstance(lines, MapLine)
            else [*lines]
        )
        self.stop()
        begin = self._bench.now

        def stated(age: float) -> float:
            return age if age <= self._max_age else math.inf

        def again(cycle: int) -> None:
            passed = cycle * period
            if isinstance(own, Scene):
                self.send(own, stated(age + passed))
            else:
                self.send(aged(line, stated(line.age + passed)) for line in own)
            then = begin + passed + period
            self._next = self._bench.call_at(then, lambda: again(cycle + 1))

        again(0)

    def stop(self) -> None:
        """Send nothing any more of what was published."""
        if self._next is not None:
            self._next.cancel()

    def _pump(self) -> None:
        """Send frames that were held back, and floods, when they are due."""
        self._bus.pump()
        due = math.inf if self._bus.sending is None else self._bus.sending.next_due
        if due < math.inf:
            self._bench.call_at(max(due, self._bench.now), self._pump)

    def close(self) -> None:
        """Leave the bus."""
        self.stop()
        self._bus.shutdown()


class Arrival(NamedTuple):
    """A line that was received."""

    t: float  #: since the begin of the test [s]
    line: MapLine


class ReceivingNode:
    """Node that receives lines.

    Args:
        bench: whose bus it joins.
        codec: decodes the lines.
    """

    def __init__(self, bench: Bench, codec: Codec) -> None:
        _check_bench(bench)
        self._bench = bench
        self.arrivals: list[Arrival] = []  #: all lines, in the order of their arrival
        self.listener = LineListener(
            codec.decoder(), on_line=lambda line: self.arrivals.append(Arrival(bench.now, line))
        )
        self._asserted: dict[Slot, int] = {}  # arrivals at the last assertion of a slot
        bench.listen(bench.open(), self.listener)

    def latest(self, slot: Slot, stale_cycles: float = STALE_CYCLES) -> SlotView:
        """Return the newest line of a slot, with its age and whether it may be used."""
        now_ns = self._bench.clock.now_ns
        return self.listener.latest(slot, now_ns, stale_cycles=stale_cycles)

    def latest_scene(self, stale_cycles: float = STALE_CYCLES) -> SceneView:
        """Return the newest scene, with its age and whether it may be used.

        Raises:
            ValueError: the DBC has no message of the pose error.
        """
        now_ns = self._bench.clock.now_ns
        return self.listener.latest_scene(now_ns, stale_cycles=stale_cycles)

    def assert_received(self, slot: Slot, within: float) -> MapLine:
        """Return a line of a slot that comes now; else let the time pass until one comes.

        Lines that came before are in `arrivals`; each is returned only once. In real time, what
        came since ``Bench.run_for`` comes now.

        Raises:
            AssertionError: none comes within this time [s].
        """
        __tracebackhide__ = True  # pytest shows the line of the test
        begin, known = self._bench.now, self._asserted.get(slot, 0)
        present = self._bench.present

        def news() -> list[MapLine]:
            return [a.line for a in self.arrivals[known:] if a.line.slot == slot and a.t >= present]

        if self._bench.run_until(lambda: bool(news()), within, min(STEP, within / 4)):
            self._asserted[slot] = len(self.arrivals)
            return news()[-1]
        before = [t for t, line in self.arrivals if line.slot == slot]
        others = sorted({line.slot.name for t, line in self.arrivals if t >= begin})
        raise AssertionError(
            f"no line {slot.name} arrived within {within:g} s, from {begin:.4g} to "
            f"{self._bench.now:.4g} s\n"
            f"  before that: {f'the last one at {before[-1]:.4g} s' if before else 'none'}\n"
            f"  meanwhile: {', '.join(others) if others else 'no other line'}\n"
            f"  {self._frames()}\n"
            "  look at: whether the sender publishes this slot, in each period; its DBC; and the "
            "reasons"
        )

    def assert_no_stale(
        self, *slots: Slot, during: float = 0.0, stale_cycles: float = STALE_CYCLES
    ) -> None:
        """Let the time pass, and check that no line of the slots becomes stale or too old.

        Args:
            slots: none for all of which a line has arrived.
            during: time that passes [s]; 0 to look only now.
            stale_cycles: after how many cycle times without a newer line a line is stale.

        Raises:
            AssertionError: a line is stale or too old, or there is none.
        """
        __tracebackhide__ = True
        bad: list[tuple[float, SlotView]] = []

        def look() -> bool:
            known = slots or tuple(sorted({line.slot for _, line in self.arrivals}))
            views = [self.latest(slot, stale_cycles) for slot in known]
            bad.extend(
                (self._bench.now, view) for view in views if view.stale or math.isinf(view.age)
            )
            return bool(bad)

        self._bench.run_until(look, during, STEP)
        if not bad and not slots and not self.arrivals:
            raise AssertionError(f"no line of any slot has arrived\n  {self._frames()}")
        if not bad:
            return
        raise AssertionError(self._stale_text(*bad[0]))

    def _stale_text(self, t: float, view: SlotView) -> str:
        """Return what is stale, since when, and what to look at."""
        last = next((at for at, line in reversed(self.arrivals) if line.slot == view.slot), None)
        if last is None:
            lines = [f"no line {view.slot.name} has come until {t:.4g} s"]
        else:
            what = "stale" if view.stale else "too old"
            lines = [
                f"the line {view.slot.name} is {what} at {t:.4g} s",
                f"  how much: the last one came at {last:.4g} s, {t - last:.3g} s before that; "
                f"its age is {view.age:.3g} s, its E2E state {view.state.name}",
            ]
        hint = "  look at: what the sender and the bus did then; nobody must use this line"
        return "\n".join([*lines, f"  {self._frames()}", hint])

    def _frames(self) -> str:
        """Return what became of the frames, as text."""
        stats = self.listener.stats()
        reasons = ", ".join(f"{n} {reason.name}" for reason, n in stats.counts.items() if n)
        return f"frames: {stats.frames}{f' ({reasons})' if reasons else ''}"


def _check_bench(bench: object) -> None:
    if not isinstance(bench, Bench):
        raise TypeError(
            f"the bench of a node must be a Bench, got a {type(bench).__name__}; a fixture "
            "maplines_bus of a project must give one, such as Bench('socketcan', 'vcan0')"
        )
