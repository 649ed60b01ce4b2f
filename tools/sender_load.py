#!/usr/bin/env python3
"""Measure the CPU of a sender of joint scenes of eight lines, beside python-can's own cyclic tasks.

    python tools/sender_load.py                     20 Hz, three DBCs, about three minutes
    python tools/sender_load.py --period 0.02       50 Hz
    python tools/sender_load.py --quick             a few seconds, as a smoke test

Each row is run for a while, in turns; the table has the medians. A share is CPU time of the whole
process over time, in percent of one core; the ratio is that over the share of python-can's
``send_periodic`` in the same turn. All send the same number of frames per period on a virtual bus
without listeners:

  wake-ups alone   nothing is sent: a thread that waits for the deadlines of the pose error and of
                   each line. No transmitter that spreads its lines over the period takes less
  bus.send alone   a thread that sends all frames at once, once a period
  send_periodic    python-can's cyclic tasks, one a frame, which is how it repeats frames; those of
                   a line are started at the line's phase. They send constants: no age, no counter
  transmitter      `Transmitter` with a scene that was published once
  with map_scene   the same with a new scene in each period, made in another thread

Wake-ups are cheap on a quiet machine and dear on a busy one, where each finds cold caches.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial

# BLAS reads these when NumPy is loaded.
os.environ.update(OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1", OMP_NUM_THREADS="1")

import can
from cycle_calls import highway_lines

from maplines_can.bus import Transmitter
from maplines_can.logs.log_writer import message_of
from maplines_can.propagation import map_scene
from maplines_can.simulation.scenarios import scenario
from maplines_can.values.line import Slot
from maplines_can.wire import Codec, default_dbc_path

PEER = "send_periodic"


@contextmanager
def repeated(period: float, call: Callable[[], None]) -> Iterator[None]:
    """Call in a thread of its own, once per period [s], at absolute times."""
    ended = threading.Event()

    def run() -> None:
        deadline = time.monotonic()
        while not ended.wait(max(0.0, deadline - time.monotonic())):
            call()
            deadline += period

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


class Rows:
    """What is measured: each method begins it, and its context ends it."""

    def __init__(self, dbc: str, period: float) -> None:
        highway = scenario("highway")
        self.period, self.codec = period, Codec.from_dbc(default_dbc_path(dbc))
        lines = dict(zip(Slot, highway_lines(), strict=True))
        self.make = partial(map_scene, lines, highway.ego)
        self.fd = self.codec.layout.scene is not None  # a whole scene is a CAN FD frame
        frames = self.codec.encoder().encode_scene(self.make(), fd=self.fd)
        self.transfers = [[message_of(frame) for frame in each] for each in frames.values()]
        self.bus = can.Bus(interface="virtual", channel=f"load of {dbc}")

    @contextmanager
    def wake_ups_alone(self) -> Iterator[None]:
        """Wait for the deadline of each transfer."""
        with repeated(self.period / len(self.transfers), lambda: None):
            yield

    @contextmanager
    def bus_send_alone(self) -> Iterator[None]:
        """Send all frames once a period."""
        messages = [message for transfer in self.transfers for message in transfer]

        def send() -> None:
            for message in messages:
                self.bus.send(message)

        with repeated(self.period, send):
            yield

    @contextmanager
    def send_periodic(self) -> Iterator[None]:
        """Let python-can repeat each frame."""
        for transfer in self.transfers:
            for message in transfer:
                self.bus.send_periodic(message, self.period)
            time.sleep(self.period / len(self.transfers))
        try:
            yield
        finally:
            self.bus.stop_all_periodic_tasks()

    @contextmanager
    def transmitter(self) -> Iterator[None]:
        """Publish a scene once."""
        with Transmitter(self.bus, self.codec, period=self.period, fd=self.fd) as transmitter:
            transmitter.publish(self.make())
            yield

    @contextmanager
    def with_map_scene(self) -> Iterator[None]:
        """Make and publish a scene in each period."""
        with (
            Transmitter(self.bus, self.codec, period=self.period, fd=self.fd) as transmitter,
            repeated(self.period, lambda: transmitter.publish(self.make())),
        ):
            yield


def load(context: Callable[[], AbstractContextManager[None]], seconds: float) -> float:
    """Return the share of a core that runs within a context, once it has settled."""
    with context():
        time.sleep(seconds / 10)
        cpu, start = time.process_time(), time.perf_counter()
        time.sleep(seconds)
        return (time.process_time() - cpu) / (time.perf_counter() - start)


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--period", type=float, default=0.05, help="[s] [%(default)s]")
    parser.add_argument("--seconds", type=float, default=2.0, help="of one turn [%(default)s]")
    parser.add_argument("--turns", type=int, default=5, help="of each row [%(default)s]")
    parser.add_argument("--quick", action="store_true", help="two short turns")
    options = parser.parse_args(argv)
    turns, seconds = (2, 0.2) if options.quick else (options.turns, options.seconds)
    for dbc in ("maplines.dbc", "maplines-pose.dbc", "maplines-scene.dbc"):
        rows = Rows(dbc, options.period)
        calls = {
            "wake-ups alone": rows.wake_ups_alone,
            "bus.send alone": rows.bus_send_alone,
            PEER: rows.send_periodic,
            "transmitter": rows.transmitter,
            "with map_scene": rows.with_map_scene,
        }
        results = [
            {what: load(call, seconds) for what, call in calls.items()} for _ in range(turns)
        ]
        count = sum(map(len, rows.transfers))
        print(f"{dbc}: {len(rows.transfers)} transfers, {count} frames per {options.period:g} s")
        for what in calls:
            share = statistics.median(result[what] for result in results)
            ratio = statistics.median(result[what] / result[PEER] for result in results)
            cycle = 1e6 * share * options.period
            print(f"   {what:<15} {100 * share:6.2f} % {cycle:7.0f} us/cycle {ratio:6.2f}x")
        rows.bus.shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
