"""A drive that one process sends and another one receives.

The sender is the command "maplines drive"; the other process receives. The received lines must be
those of the log of the sender, bit for bit and in order. That slots change as lanes do,
tests/cli/test_drive.py shows; that candump sees the same frames, tests/test_socketcan.py.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from answers import lines_of

from maplines_can import Codec, Link, MapLine, Receiver, read_log
from maplines_can.wire import Decoder

from .harness import evidence


@evidence
def drives(
    interface: str = "udp_multicast",
    channel: str = "",
    route: str = "",
    seconds: float | None = None,
    rate: float = 20.0,
    fd: bool = False,
    seed: int = 0,
) -> dict[str, Any]:
    """Send a drive in real time from one process to another, and check each line that arrives.

    Args:
        interface: of python-can.
        channel: such as vcan0.
        route: A..B of lanes of the town; the tour by default, 11.9 km in 753 s.
        seconds: the drive ends after this part [s].
        rate: of the cycles [Hz].
        fd: CAN FD.
        seed: of the errors.
    """
    bus: dict[str, Any] = {"interface": interface} | ({"channel": channel} if channel else {})
    arrived: list[MapLine] = []
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder, "drive.log")
        command = [sys.executable, "-m", "maplines_can", "drive", "--json", "--lines", "4"]
        command += ["--record", str(log), "--seed", str(seed), "--rate", str(rate)] + ["--fd"] * fd
        command += ["--route", route] if route else []
        command += ["--seconds", str(seconds)] if seconds is not None else []
        for option, value in bus.items():
            command += [f"--{option}", value]
        with (
            Link(**bus, fd=fd) as link,
            Receiver(link, new_decoder(), on_line=arrived.append) as receiver,
        ):
            done = subprocess.run(command, capture_output=True, check=False)
            if done.returncode:
                sys.exit(done.stderr.decode())
            sent = json.loads(done.stdout)
            end = time.monotonic() + 30
            while receiver.stats().lines < sent["lines"] and time.monotonic() < end:
                time.sleep(0.1)
            stats = receiver.stats()
        decoder = new_decoder()
        fed = (decoder.feed(f.can_id, f.data, f.t_ns) for f in read_log(log))
        was_sent = [values_of(line) for answer in fed for line in lines_of(answer)]
        figures = {
            "frames lost": sent["frames"] - stats.frames,
            "lines missing by their counters": stats.lost,
            "frames dropped": sum(stats.counts.values()),
            "not sent": sent["down"] + sent["full"],
            "lines lost": len(was_sent) - len(arrived),
            "received as they were sent": [*map(values_of, arrived)] == was_sent != [],
        }
    return figures | {"sender": sent}


def new_decoder() -> Decoder:
    """Return a decoder of a bus that may be silent for long."""
    return Codec.from_dbc().decoder(timeout_ms=3_600_000)


def values_of(line: MapLine) -> tuple[Any, ...]:
    """Return what must be equal of a line that is sent and received."""
    return (
        *(line.slot, line.kind, line.status, line.x_min, line.x_max, line.age),
        line.gaussian.mean.tobytes(),
        line.gaussian.cov.tobytes(),
    )
