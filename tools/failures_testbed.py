"""The testbed of failures.py: a sender and a receiver as processes on a CAN interface.

A failure opens a Testbed, causes the failure, and waits for its effects and for the recovery. The
figures go into its Row.
"""

import contextlib
import json
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import can
from answers import lines_of

from maplines_can import map_lines
from maplines_can.cli.output import line_dict
from maplines_can.simulation.scenarios import scenario
from maplines_can.values.line import MapLine, Slot
from maplines_can.wire import Codec

MAPLINES = [sys.executable, "-m", "maplines_can.cli"]
#: Scene of the sender of each testbed.
SCENE = "highway"
SLOTS, PAGES = 4, 4  # lines of a scenario, and frames of a line
#: Slot of the line that is sent last; no scenario in use has it.
LAST_SLOT = Slot.ROUTE
#: How long to wait for an effect that must happen [s].
TIMEOUT = 30.0
#: By how much a failure sets the clock at most [s].
HOUR = 3600.0


class UnmetError(Exception):
    """An effect that must happen did not."""


@dataclass
class Row:
    """Figures of a failure."""

    name: str
    failure: str
    seen: str = ""
    detected: float | None = None  #: from its start to the receiver's first report of it [s]
    lines_again: float | None = None  #: from its end [s]
    valid_again: float | None = None  #: from its end [s]
    sent: int = 0  #: lines that were complete on the bus
    given_up: int = 0  #: lines that the sender could not send
    delivered: int = 0
    lost: int = 0  #: by their counters
    timed_out: int = 0  #: lines sent whose frames were too far apart by their time stamps
    wrong: int = 0
    problem: str = ""  #: why the requirement is not met

    @property
    def met(self) -> Any:
        """Whether no line is wrong and the receiver recovered."""
        return not self.wrong and not self.problem


class Process:
    """Child process with its output, line by line with the times."""

    def __init__(self, *command: Any) -> None:
        self.command = " ".join(command).replace(" ".join(MAPLINES), "maplines")
        self.child = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            bufsize=1,
        )
        self.changed = threading.Condition()
        self.out, self.notes = list[Any](), list[Any]()  # of (when [s, monotonic], text)
        self.readers = [
            threading.Thread(target=self._read, args=(stream, kept), daemon=True)
            for stream, kept in ((self.child.stdout, self.out), (self.child.stderr, self.notes))
        ]
        for reader in self.readers:
            reader.start()

    def _read(self, stream: Any, kept: Any) -> None:
        for text in stream:
            with self.changed:
                kept.append((time.monotonic(), self.parse(text) if kept is self.out else text))
                self.changed.notify_all()
        with self.changed:
            self.changed.notify_all()

    def parse(self, text: Any) -> Any:
        """Return the value of a line of its output."""
        return text

    def wait_for(self, what: Any, found: Any) -> Any:
        """Wait until a function of the output returns something true, and return that."""
        result = None

        def found_or_ended() -> Any:
            nonlocal result
            result = found()
            return result or not any(reader.is_alive() for reader in self.readers)

        with self.changed:
            self.changed.wait_for(found_or_ended, TIMEOUT)
        if not result:
            last = "; ".join(text.strip() for _, text in self.notes[-3:])
            raise UnmetError(f"{self.command}: no {what} in {TIMEOUT:g} s; last output: {last}")
        return result

    def wait_for_note(self, words: Any, since: float = 0.0) -> Any:
        """Wait for these words on stderr since a time; return when they came [s, monotonic]."""

        def found() -> Any:
            times = (when for when, text in self.notes if when >= since and words in text)
            return next(times, None)

        return self.wait_for(f"{words!r}", found)

    def end(self, number: Any = signal.SIGTERM) -> Any:
        """End the process, read the rest of its output, and return its exit status."""
        if number is not None and self.child.poll() is None:
            self.child.send_signal(number)
        try:
            self.child.wait(TIMEOUT)
        except subprocess.TimeoutExpired:
            self.child.kill()
            self.child.wait()
        for reader in self.readers:
            reader.join()
        self.child.stdout.close()  # type: ignore[union-attr]
        self.child.stderr.close()  # type: ignore[union-attr]
        return self.child.returncode

    def figures(self, pattern: Any) -> Any:
        """Return the numbers in the last line of output that matches."""
        for _, text in reversed(self.out + self.notes):
            if isinstance(text, str) and (match := re.search(pattern, text)):
                return [int(group or 0) for group in match.groups()]
        raise UnmetError(f"{self.command} ended without its sums")


class ReceiverProcess(Process):
    """`maplines receive --json`; its output is one dictionary a line."""

    def parse(self, text: Any) -> Any:
        """Return a map line as a dictionary."""
        return json.loads(text)

    def wait_for_each_slot(self, words: Any, since: Any) -> Any:
        """Wait for these words about all slots; return when the last came [s, monotonic]."""

        def found() -> Any:
            slots: dict[Any, Any] = {}
            for when, text in self.notes:
                slot = text.removeprefix("maplines: ").split(":")[0]
                if when >= since and words in text:
                    slots.setdefault(slot, when)
            return max(slots.values()) if len(slots) == SLOTS else None

        return self.wait_for(f"{words!r} of each slot", found)

    def wait_for_new_lines(self, since: Any, since_ns: Any, *, valid: bool = False) -> Any:
        """Wait for a line of each slot that is later on both clocks; return when [s, monotonic]."""

        def found() -> Any:
            slots: dict[Any, Any] = {}
            for when, line in self.out:
                accepted = not valid or line["e2e"]["state"] == "VALID"
                is_new = 0 <= line["t"] - since_ns / 1e9 < HOUR / 2  # the clock may have been set
                if when >= since and accepted and is_new:
                    slots.setdefault(line["slot"], when)
            return max(slots.values()) if len(slots) == SLOTS else None

        return self.wait_for("line of each slot" + " that is VALID" * valid, found)

    def wait_for_lines(self, lines: Any) -> None:
        """Wait for this number of further lines."""
        goal = len(self.out) + lines
        self.wait_for(f"{lines} more lines", lambda: len(self.out) >= goal)

    def wrong(self, scenarios: Any) -> Any:
        """Return the number of lines that were never sent or were delivered twice."""
        known = set().union(*map(expected, scenarios))
        lines = [line for _, line in self.out if line["slot"] != LAST_SLOT.name]
        twice = len(lines) - len({(line["slot"], line["t"]) for line in lines})
        return twice + sum(content(line) not in known for line in lines)


class FrameCounter:
    """Counter of the frames of map lines on an interface, independent of our code."""

    def __init__(self, channel: Any) -> None:
        self.frames = 0
        self.socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self.socket.setsockopt(socket.SOL_SOCKET, 33, 2**24)  # SO_RCVBUFFORCE: no frame is lost
        self.socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
        ids = b"".join(struct.pack("=II", can_id, 0x7FF) for can_id in Codec.from_dbc().can_ids)
        self.socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, ids)
        self.socket.bind((channel,))

    def wait_for_frames(self, frames: Any) -> None:
        """Wait for this number of further frames."""
        self.count()
        goal = self.frames + frames
        self.socket.settimeout(TIMEOUT)
        while self.frames < goal:
            self.read()

    def count(self) -> Any:
        """Return the number of frames so far."""
        self.socket.settimeout(0)
        with contextlib.suppress(BlockingIOError):
            while True:
                self.read()
        return self.frames

    def read(self) -> None:
        """Read and count one frame.

        Raises:
            UnmetError: no frame arrived in time.
        """
        try:
            self.frames += bool(self.socket.recv(72))
        except BlockingIOError:
            raise
        except TimeoutError as error:
            raise UnmetError("the bus is silent") from error
        except OSError:  # the interface is down; the socket reports it once
            return


class Testbed:
    """A sender and a receiver on an interface, whose figures go into a row."""

    def __init__(self, row: Any, channel: str = "vcan0", *, fd: bool = False) -> None:
        self.row, self.channel, self.fd = row, channel, ["--fd"] * fd
        self.scenarios, self.senders, self.others = list[Any](), list[Any](), list[Any]()
        self.frame_counter = FrameCounter(channel)
        self.killed = False
        self.extra_lines = 0  # sent by `drain`
        self.receiver: Any = None

    def __enter__(self) -> Any:
        on = ["--interface", "socketcan", "--channel", self.channel, *self.fd]
        self.on = on
        before = listening()
        self.receiver = ReceiverProcess(*MAPLINES, "receive", *on, "--json")
        self.others.append(self.receiver)
        deadline = time.monotonic() + TIMEOUT
        while listening() <= before:
            if time.monotonic() > deadline:
                raise UnmetError("the receiver does not start")
            time.sleep(0.01)
        self.send(SCENE)
        self.receiver.wait_for_new_lines(*timed(lambda: None), valid=True)
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        try:
            if kind is None:
                self.count_lines()
        finally:
            for process in self.senders + self.others:
                process.end(signal.SIGKILL)
            self.frame_counter.socket.close()

    def send(self, scenario: Any) -> Any:
        """Start a sender; return it and when it reported its start [s, monotonic]."""
        sender = Process(
            *MAPLINES, "send", *self.on, "--scenario", scenario, "--rate", "20", "--standstill"
        )
        self.scenarios.append(scenario)
        self.senders.append(sender)
        return sender, sender.wait_for_note("lines of")

    def flood(self, *arguments: Any) -> Any:
        """Start cangen; return when [s, monotonic]."""
        started = time.monotonic()
        self.others.append(Process("cangen", self.channel, *arguments))
        return started

    def wait_for_recovery(self, over: Any, since_ns: Any) -> None:
        """Wait for the recovery after a cause that ended at [s, monotonic] and [ns, stamps]."""
        self.row.lines_again = self.receiver.wait_for_new_lines(over, since_ns) - over
        self.row.valid_again = self.receiver.wait_for_new_lines(over, since_ns, valid=True) - over

    def count_lines(self) -> None:
        """End the sender, and the receiver after it has read all frames; fill in the row."""
        row, receiver = self.row, self.receiver
        frames = 0
        for sender in self.senders:
            if sender.end() == -signal.SIGKILL:
                continue
            lines, their_frames = sender.figures(r"sent (\d+) lines in (\d+) frames")
            down, full = sender.figures(r"; (\d+) lines given up .* down, (\d+) with")
            row.sent, frames = row.sent + lines, frames + their_frames
            row.given_up += down + full
        if self.killed:
            row.sent += (self.frame_counter.count() - frames) // PAGES
        self.extra_lines = self.drain()
        receiver.end()
        row.delivered, row.lost = receiver.figures(r"(\d+) lines from \d+ frames; (\d+) lines lost")
        row.wrong = receiver.wrong(self.scenarios)
        if row.delivered != len(receiver.out):
            row.problem = f"it counted {row.delivered} lines and printed {len(receiver.out)}"
        last_lines = sum(line["slot"] == LAST_SLOT.name for _, line in receiver.out)
        row.delivered -= last_lines
        # A sender that is suspended for half a cycle within a line exceeds the time-out of the
        # reassembly. How often depends on the machine, so these lines are counted separately.
        frames = receiver.figures(r"dropped frames: .*?(?:(\d+) timeout)?; (\d+) still waiting")
        row.timed_out = sum(frames) // PAGES - (self.extra_lines - last_lines)

    def drain(self) -> Any:
        """Wait until the receiver has read its queue; return how many lines that took.

        A line of a slot of its own is sent until it is printed: frames are read in the order of
        their arrival. It is sent again only if its transfer has surely timed out.
        """
        codec, receiver = Codec.from_dbc(), self.receiver
        encoder = codec.encoder()
        deadline, attempts = time.monotonic() + TIMEOUT, 0

        def printed() -> Any:
            return any(line["slot"] == LAST_SLOT.name for _, line in receiver.out)

        with can.Bus(interface="socketcan", channel=self.channel) as bus:
            while not printed():
                if time.monotonic() > deadline:
                    raise UnmetError("the receiver does not print the last line")
                attempts += 1
                for frame in encoder.encode(MapLine.mean_only(LAST_SLOT, [0, 0, 0, 0])):
                    bus.send(
                        can.Message(
                            arbitration_id=frame.can_id, data=frame.data, is_extended_id=False
                        )
                    )
                with receiver.changed:
                    receiver.changed.wait_for(printed, 10.0)
        return attempts


@cache
def expected(name: Any) -> Any:
    """Return the contents that may be received of the lines of a scenario."""
    codec, example = Codec.from_dbc(), scenario(name)
    encoder = codec.encoder()
    decoder, lines = codec.decoder(), set()
    first = {slot: example.lines[slot] for slot in list(example.lines)[:4]}
    for line in map_lines(first, example.ego, window=example.window):
        for frame in encoder.encode(line):
            for received in lines_of(decoder.feed(frame.can_id, frame.data, 0)):
                lines.add(content(line_dict(received, decoder.latest(received.slot, 0))))
    return lines


def content(line: Any) -> Any:
    """Return a line as text without what differs between transmissions: time, age, E2E."""
    of_reception = {"t", "age", "e2e", "usable", "state", "two_senders"}
    return json.dumps({k: v for k, v in line.items() if k not in of_reception})


def timed(action: Any) -> Any:
    """Call it; return when it was done, on our clock [s] and on that of the stamps [ns]."""
    action()
    return time.monotonic(), time.time_ns()


def last_checks(receiver: Any) -> Any:
    """Return the E2E checks of the last line of each slot."""
    return list({line["slot"]: line["e2e"] for _, line in receiver.out}.values())


# ---- the kernel -------------------------------------------------------------------------


def ip(arguments: Any) -> None:
    subprocess.run(["ip", *arguments.split()], check=True)


@contextlib.contextmanager
def restored(channel: Any) -> Iterator[None]:
    """Context after which the interface exists, is up, and has CAN FD."""
    try:
        yield
    finally:
        if channel not in (name for _, name in socket.if_nameindex()):
            ip(f"link add dev {channel} type vcan")
        ip(f"link set {channel} down")
        ip(f"link set {channel} mtu 72 up")


def traffic(channel: Any) -> Any:
    """Return how many frames the interface has sent."""
    return int(Path("/sys/class/net", channel, "statistics/tx_packets").read_text())


def listening() -> Any:
    """Return the number of receivers in the kernel; each filter of a socket is one."""
    text = Path("/proc/net/can/stats").read_text()
    return int(re.search(r"(\d+) current receive list entries", text)[1])  # type: ignore[index]


def is_guest() -> bool:
    return "User Mode Linux" in Path("/proc/cpuinfo").read_text()
