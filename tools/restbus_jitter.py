#!/usr/bin/env python3
"""Measure jitter and drift of the restbus beside python-can's periodic sending.

    python tools/restbus_jitter.py                       5 s of 30 messages, each way twice
    python tools/restbus_jitter.py --seconds 30 --messages 60

Both send the same messages, in turns, in processes of their own: ours by one thread, python-can by
a thread for each message. The first frames are spread over 10 ms. The bus notes when each frame is
handed to it. Of each message, the cycles are compared with the one that was asked for:

  deviation half of the cycles differ by more than this from the one that was asked for
  jitter    standard deviation of the cycle times, which a few stalls of the machine make up
  worst     largest deviation of one cycle
  drift     mean cycle over the one that was asked for, minus 1

The table has the medians over the messages (worst: the largest), the smaller ones of the turns, and
python-can's over ours.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import can

from maplines_can.bus.clock import RealClock
from maplines_can.restbus import Config, Restbus

TURNS = 2


class StampingBus(can.BusABC):
    """Bus that notes when each frame is handed to it."""

    def __init__(self) -> None:
        super().__init__(channel="stamps")
        self.channel_info = "stamps"
        self.stamps: dict[int, list[int]] = {}

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        """Note the time of a frame."""
        self.stamps.setdefault(msg.arbitration_id, []).append(time.monotonic_ns())

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:  # noqa: ARG002
        return None, True


def cycles_ms(messages: int) -> list[int]:
    """Return the cycle of each message, as in a car: 10 to 100 ms."""
    return [(10, 20, 50, 100)[n % 4] for n in range(messages)]


def send(way: str, seconds: float, messages: int) -> dict[str, float]:
    """Send in one way and return its figures."""
    bus, cycles = StampingBus(), cycles_ms(messages)
    if way == "python-can":
        for n, cycle in enumerate(cycles):
            message = can.Message(arbitration_id=n, data=bytes(8), is_extended_id=False)
            bus.send_periodic(message, cycle / 1000)
            time.sleep(0.01 / messages)
        time.sleep(seconds)
        bus.stop_all_periodic_tasks()
    else:
        folder = Path(__file__).parent / "__pycache__"
        folder.mkdir(exist_ok=True)
        rows = 'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: A\n\n'
        for n in range(messages):
            rows += f'BO_ {n} M{n}: 8 A\n SG_ S{n} : 0|8@1+ (1,0) [0|255] "" A\n\n'
        (folder / "jitter.dbc").write_text(rows)
        values = {
            "dbc": "jitter.dbc",
            "message": [
                {"name": f"M{n}", "cycle_ms": cycle, "start_ms": 10 * n / messages}
                for n, cycle in enumerate(cycles)
            ],
        }
        clock = RealClock()
        restbus = Restbus(Config.from_dict(values, folder), bus, clock)
        restbus.start()
        clock.run_for(seconds)
        restbus.stop()
    deviation, jitter, worst, drift = [], [], 0.0, []
    for n, cycle in enumerate(cycles):
        gaps = [(b - a) / 1e6 for a, b in pairwise(bus.stamps[n])]
        jitter.append(statistics.pstdev(gaps))
        off = [abs(gap - cycle) for gap in gaps]
        deviation.append(statistics.median(off))
        worst = max(worst, *off)
        drift.append(abs(statistics.fmean(gaps) / cycle - 1))
    bus.shutdown()
    return {
        "deviation_us": 1e3 * statistics.median(deviation),
        "jitter_ms": statistics.median(jitter),
        "worst_ms": worst,
        "drift_ppm": 1e6 * statistics.median(drift),
    }


def main() -> None:
    """Measure both ways in turns and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=5.0, help="of each turn (default: 5)")
    parser.add_argument("--messages", type=int, default=30, help="number of them (default: 30)")
    parser.add_argument("--way", choices=("restbus", "python-can"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.way:
        print(json.dumps(send(arguments.way, arguments.seconds, arguments.messages)))
        return
    results: dict[str, list[dict[str, Any]]] = {"restbus": [], "python-can": []}
    for _ in range(TURNS):
        for way, rows in results.items():
            command = [sys.executable, __file__, "--way", way]
            command += ["--seconds", str(arguments.seconds)]
            command += ["--messages", str(arguments.messages)]
            rows.append(json.loads(subprocess.check_output(command)))
    print(f"{'':<12} {'restbus':>10} {'python-can':>10} {'ratio':>8}")
    for name in ("deviation_us", "jitter_ms", "worst_ms", "drift_ppm"):
        ours, theirs = (min(row[name] for row in rows) for rows in results.values())
        print(f"{name:<12} {ours:>10.3f} {theirs:>10.3f} {theirs / max(ours, 1e-9):>7.1f}x")


if __name__ == "__main__":
    main()
