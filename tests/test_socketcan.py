"""Lines on SocketCAN against candump, canplayer and cantools, which are independent of us.

Run these tests with ``tools/vcan python3 tools/run.py pytest -m socketcan``.
"""

import re
import shutil
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from support.fake_bus import collect
from support.kernel_can import has_vcan
from support.lines import scenario_lines
from support.recordings import record

from maplines_can import Codec, Link, MapLine, Receiver, Transmitter
from maplines_can.cli import main
from maplines_can.simulation import scenario

DBC = Path(__file__).parents[1] / "dbc" / "maplines.dbc"
START, END = 0x7FE, 0x7FF
CYCLES = 12  #: 192 classic frames: they fit into the queue of a socket, whoever is late
HOUR_MS = 3_600_000


pytestmark = [
    pytest.mark.socketcan,
    pytest.mark.skipif(not has_vcan(), reason="no vcan0 here: run inside tools/vcan"),
    pytest.mark.skipif(not shutil.which("candump"), reason="no candump: apt-get install can-utils"),
]


class Candump:
    """candump -L on an interface; it listens when the constructor returns."""

    def __init__(self, channel: Any, fd: Any) -> None:
        self.process = subprocess.Popen(
            ["candump", "-L", channel], stdout=subprocess.PIPE, text=True, bufsize=1
        )
        self.channel, self.lines = channel, list[Any]()
        self.seen = {START: threading.Event(), END: threading.Event()}
        self.thread = threading.Thread(target=self.read)
        self.thread.start()
        with can.Bus(interface="socketcan", channel=channel, fd=fd) as bus:
            while not self.seen[START].wait(0.01):
                bus.send(can.Message(arbitration_id=START, is_extended_id=False))

    def read(self) -> None:
        for line in self.process.stdout:  # type: ignore[union-attr]
            can_id = int(line.split()[2].split("#")[0], 16)
            if can_id in self.seen:
                self.seen[can_id].set()
            else:
                self.lines.append(line)

    def stop(self) -> Any:
        with can.Bus(interface="socketcan", channel=self.channel) as bus:
            bus.send(can.Message(arbitration_id=END, is_extended_id=False))
        assert self.seen[END].wait(300)
        self.process.terminate()
        self.thread.join()
        self.process.wait()
        self.process.stdout.close()  # type: ignore[union-attr]
        return self.lines


def receive(channel: Any, fd: Any, send: Any) -> Any:
    """The lines that a receiver gets of a function that sends and returns their number."""
    with Link(interface="socketcan", channel=channel, fd=fd) as link:
        # No time-out: only contents are compared here, and the guest may be slow.
        decoder = Codec.from_dbc().decoder(timeout_ms=HOUR_MS)
        with Receiver(link, decoder, queue_size=10_000) as receiver:
            lines = collect(receiver, send())
        return lines, receiver.stats()


@pytest.mark.parametrize("fd", [False, True])
def test_candump_sees_a_replayed_log(fd: bool, tmp_path: Path) -> None:
    """Each frame of it with its flag, in the order of the log, and most of them in time."""
    channel = "vcan1" if fd else "vcan0"
    log = record(tmp_path / "a.log", *["--fd"] * fd, seconds=4.0)
    candump = Candump(channel, fd)
    bus = ["--interface", "socketcan", "--channel", channel, *["--fd"] * fd]
    assert main(["replay", str(log), *bus, "--speed", "5"]) == 0
    seen = [line.split() for line in candump.stop()]
    sent = [line.split() for line in log.read_text().splitlines()]
    # The digit of the flags has BRS, and since Linux 6.1 the one of CAN FD (0x4).
    frames = [[re.sub("##.", "##", row[2]).upper() for row in rows] for rows in (seen, sent)]
    assert frames[0] == frames[1]
    times = [np.array([float(row[0][1:-1]) for row in rows]) for rows in (seen, sent)]
    late = (times[0] - times[0][0]) - (times[1] - times[1][0]) / 5
    assert np.median(late - late.min()) < 0.05


@pytest.mark.parametrize(("channel", "fd"), [("vcan0", False), ("vcan1", True), ("vcan2", False)])
def test_lines_are_those_of_candump_cantools_and_canplayer(
    tmp_path: Path, channel: str, fd: bool
) -> None:
    """candump records the frames, cantools decodes them, canplayer replays them."""
    lines = scenario_lines(scenario("highway"))
    candump = Candump(channel, fd)

    def send() -> Any:
        with (
            Link(interface="socketcan", channel=channel, fd=fd) as link,
            Transmitter(link, Codec.from_dbc(), period=0.02, fd=fd, count=CYCLES) as transmitter,
        ):
            for line in lines:
                transmitter.publish(line)
            assert transmitter.wait(300)
            stats = transmitter.stats()
            assert stats.lines + stats.overruns == CYCLES * len(lines)
            return stats.lines

    received, stats = receive(channel, fd, send)
    total = len(received)
    recorded = candump.stop()
    assert stats.lost == 0
    assert not any(stats.counts.values())
    assert len(recorded) == total * (1 if fd else 4)

    witness = by_cantools("".join(recorded))
    assert len(witness) == len(recorded)
    expected = [values(line) for line in in_order(received)]
    assert values_of(witness, 1 if fd else 4) == expected

    log = tmp_path / "drive.log"
    log.write_text("".join(recorded))

    def replay() -> Any:
        subprocess.run(["canplayer", "-I", str(log), f"{channel}={channel}"], check=True)
        return total

    replayed, stats = receive(channel, fd, replay)
    assert [values(line) for line in in_order(replayed)] == expected
    assert not any(stats.counts.values())


def in_order(lines: list[MapLine]) -> list[MapLine]:
    """Lines sorted by slot, in each slot as they were received."""
    return sorted(lines, key=lambda line: line.slot)


def values(line: Any) -> Any:
    return (line.slot.name, *line.gaussian.mean.tolist(), line.x_max, line.status.name)


def by_cantools(log: Any) -> Any:
    """(message, {signal: text}) of each frame, from the command ``cantools decode``."""
    command = [sys.executable, "-m", "cantools", "decode", "--single-line", str(DBC)]
    text = subprocess.run(
        command, input=log, capture_output=True, text=True, check=True, timeout=120
    ).stdout
    frames = []
    for name, body in re.findall(r":: (\w+)\((.*)\)", text):
        pairs = re.findall(r"(\w+): ([^,]+)", body)
        frames.append((name, {signal: value.split(" ")[0].strip("'") for signal, value in pairs}))
    return frames


def values_of(frames: Any, pages: Any) -> Any:
    """The same as ``values``, from the frames that cantools decoded, sorted by slot."""
    lines, records = list[Any](), dict[Any, Any]()
    for name, signals in frames:
        record = records.setdefault(name, {})
        record.update(signals)
        record["frames"] = record.get("frames", 0) + 1
        if record["frames"] == pages:
            slot = re.sub(r"(?<!^)([A-Z])", r"_\1", name.removesuffix("Fd")).upper()
            mean = [float(record[s]) for s in ("YOff", "Beta", "C0", "C1")]
            lines.append((slot, *mean, float(record["XMax"]), record["Status"]))
            del records[name]
    order = ["EGO_LEFT", "EGO_RIGHT", "NEXT_LEFT", "NEXT_RIGHT"]
    return sorted(lines, key=lambda line: order.index(line[0]))
