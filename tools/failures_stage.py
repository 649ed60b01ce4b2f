"""Where the failures of failures.py happen: a sender and a receiver, and who watches them.

A failure opens a Stage, has its cause happen there, and waits for what it must lead to; all that
is counted goes into its Row.
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
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import can

from maplines_can import map_lines
from maplines_can.cli.output import line_dict
from maplines_can.line import MapLine, Slot
from maplines_can.scenarios import scenario
from maplines_can.wire import Codec

MAPLINES = [sys.executable, "-m", "maplines_can.cli"]
#: Scene of each stage's own sender.
FIRST = "highway"
SLOTS, PAGES = 4, 4  # lines of a scene, and frames of a line
#: Slot of the line that is sent last; no scene of a stage has it.
LAST = Slot.ROUTE
#: How long something that must happen may take [s].
PATIENCE = 30.0
#: By how much a failure may set the clock [s].
HOUR = 3600.0


class FailedError(Exception):
    """What must happen did not."""


@dataclass
class Row:
    """What a failure did."""

    name: str
    failure: str
    seen: str = ""
    detected: float | None = None  #: from its begin to the receiver's first word of it [s]
    lines_again: float | None = None  #: from its end [s]
    valid_again: float | None = None  #: from its end [s]
    sent: int = 0  #: lines that were whole on the bus
    given_up: int = 0  #: lines that the sender could not send
    delivered: int = 0
    lost: int = 0  #: by their counters
    timed_out: int = 0  #: of the lines sent, those whose frames came too far apart, by their stamps
    wrong: int = 0
    problem: str = ""  #: why it is not met

    @property
    def met(self):
        """No wrong line, and all is well again."""
        return not self.wrong and not self.problem


class Process:
    """A child, with what it says and when."""

    def __init__(self, *command):
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
        self.out, self.notes = [], []  # of (when [s, monotonic], text)
        self.readers = [
            threading.Thread(target=self._read, args=(stream, kept), daemon=True)
            for stream, kept in ((self.child.stdout, self.out), (self.child.stderr, self.notes))
        ]
        for reader in self.readers:
            reader.start()

    def _read(self, stream, kept):
        for text in stream:
            with self.changed:
                kept.append((time.monotonic(), self.parse(text) if kept is self.out else text))
                self.changed.notify_all()
        with self.changed:
            self.changed.notify_all()

    def parse(self, text):
        """A line of its output."""
        return text

    def until(self, what, found):
        """Wait for a true answer of a function of what was said; return it."""
        answer = None

        def look():
            nonlocal answer
            answer = found()
            return answer or not any(reader.is_alive() for reader in self.readers)

        with self.changed:
            self.changed.wait_for(look, PATIENCE)
        if not answer:
            said = "; ".join(text.strip() for _, text in self.notes[-3:])
            raise FailedError(f"{self.command}: no {what} in {PATIENCE:g} s; said last: {said}")
        return answer

    def note(self, words, since=0.0):
        """When it first said so since then [s, monotonic]."""

        def found():
            said = (when for when, text in self.notes if when >= since and words in text)
            return next(said, None)

        return self.until(f"{words!r}", found)

    def end(self, number=signal.SIGTERM):
        """End it, and wait until all it said is here; returns its exit status."""
        if number is not None and self.child.poll() is None:
            self.child.send_signal(number)
        try:
            self.child.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self.child.kill()
            self.child.wait()
        for reader in self.readers:
            reader.join()
        self.child.stdout.close()
        self.child.stderr.close()
        return self.child.returncode

    def figures(self, pattern):
        """Numbers in what it said, the last time that it did."""
        for _, text in reversed(self.out + self.notes):
            if isinstance(text, str) and (match := re.search(pattern, text)):
                return [int(group or 0) for group in match.groups()]
        raise FailedError(f"{self.command} ended without a word of what it did")


class Listener(Process):
    """`maplines receive --json`; its output are lines."""

    def parse(self, text):
        """A line, as a dictionary."""
        return json.loads(text)

    def each_slot(self, words, since):
        """When it had said so of all slots [s, monotonic]."""

        def found():
            slots = {}
            for when, text in self.notes:
                slot = text.removeprefix("maplines: ").split(":")[0]
                if when >= since and words in text:
                    slots.setdefault(slot, when)
            return max(slots.values()) if len(slots) == SLOTS else None

        return self.until(f"{words!r} of each slot", found)

    def each_again(self, since, since_ns, *, valid=False):
        """When each slot had delivered a line of after that, by both clocks [s, monotonic]."""

        def found():
            slots = {}
            for when, line in self.out:
                good = not valid or line["e2e"]["state"] == "VALID"
                is_new = 0 <= line["t"] - since_ns / 1e9 < HOUR / 2  # by a clock that may be set
                if when >= since and good and is_new:
                    slots.setdefault(line["slot"], when)
            return max(slots.values()) if len(slots) == SLOTS else None

        return self.until("line of each slot" + " that is VALID" * valid, found)

    def deliver(self, lines):
        """Wait for so many more lines."""
        goal = len(self.out) + lines
        self.until(f"{lines} more lines", lambda: len(self.out) >= goal)

    def wrong(self, scenes):
        """Lines that nobody sent, and lines that came twice."""
        known = set().union(*map(expected, scenes))
        lines = [line for _, line in self.out if line["slot"] != LAST.name]
        twice = len(lines) - len({(line["slot"], line["t"]) for line in lines})
        return twice + sum(content(line) not in known for line in lines)


class Witness:
    """Counts the frames of map lines on an interface, as another node would."""

    def __init__(self, channel):
        self.frames = 0
        self.socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self.socket.setsockopt(socket.SOL_SOCKET, 33, 2**24)  # SO_RCVBUFFORCE: loses none
        self.socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
        ids = b"".join(struct.pack("=II", can_id, 0x7FF) for can_id in Codec.from_dbc().can_ids)
        self.socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, ids)
        self.socket.bind((channel,))

    def more(self, frames):
        """Wait for so many more frames than were there when it looked last."""
        self.seen()
        goal = self.frames + frames
        self.socket.settimeout(PATIENCE)
        while self.frames < goal:
            self.take()

    def seen(self):
        """All frames so far."""
        self.socket.settimeout(0)
        with contextlib.suppress(BlockingIOError):
            while True:
                self.take()
        return self.frames

    def take(self):
        """Count a frame, if one comes in time."""
        try:
            self.frames += bool(self.socket.recv(72))
        except BlockingIOError:
            raise
        except TimeoutError as error:
            raise FailedError("the bus is silent") from error
        except OSError:  # the interface is down, said once
            return


class Stage:
    """A sender and a receiver on an interface, and what they make of it."""

    def __init__(self, row, channel="vcan0", *, fd=False):
        self.row, self.channel, self.fd = row, channel, ["--fd"] * fd
        self.scenes, self.senders, self.others = [], [], []
        self.witness = Witness(channel)
        self.killed = False
        self.receiver = None

    def __enter__(self):
        on = ["--interface", "socketcan", "--channel", self.channel, *self.fd]
        self.on = on
        before = listening()
        self.receiver = Listener(*MAPLINES, "receive", *on, "--json")
        self.others.append(self.receiver)
        deadline = time.monotonic() + PATIENCE
        while listening() <= before:
            if time.monotonic() > deadline:
                raise FailedError("the receiver does not start")
            time.sleep(0.01)
        self.send(FIRST)
        self.receiver.each_again(*after(lambda: None), valid=True)
        return self

    def __exit__(self, kind, error, trace):
        try:
            if kind is None:
                self.account()
        finally:
            for process in self.senders + self.others:
                process.end(signal.SIGKILL)
            self.witness.socket.close()

    def send(self, scene):
        """Start a sender; returns it and when it began to send [s, monotonic]."""
        sender = Process(*MAPLINES, "send", *self.on, "--scenario", scene, "--rate", "20")
        self.scenes.append(scene)
        self.senders.append(sender)
        return sender, sender.note("lines of")

    def flood(self, *arguments):
        """Start cangen; returns when [s, monotonic]."""
        began = time.monotonic()
        self.others.append(Process("cangen", self.channel, *arguments))
        return began

    def recovered(self, over, since_ns):
        """Wait until all is well, after the cause was over at [s, monotonic] and [ns, stamps]."""
        self.row.lines_again = self.receiver.each_again(over, since_ns) - over
        self.row.valid_again = self.receiver.each_again(over, since_ns, valid=True) - over

    def account(self):
        """End the sender, then the receiver when all has come, and count."""
        row, receiver = self.row, self.receiver
        frames = 0
        for sender in self.senders:
            if sender.end() == -signal.SIGKILL:
                continue
            lines, of_them = sender.figures(r"sent (\d+) lines in (\d+) frames")
            down, full = sender.figures(r"; (\d+) lines given up .* down, (\d+) with")
            row.sent, frames = row.sent + lines, frames + of_them
            row.given_up += down + full
        if self.killed:
            row.sent += (self.witness.seen() - frames) // PAGES
        attempts = self.drain()
        receiver.end()
        row.delivered, row.lost = receiver.figures(r"(\d+) lines from \d+ frames; (\d+) lines lost")
        row.wrong = receiver.wrong(self.scenes)
        if row.delivered != len(receiver.out):
            row.problem = f"it says {row.delivered} lines and printed {len(receiver.out)}"
        row.delivered -= sum(line["slot"] == LAST.name for _, line in receiver.out)
        # A process that is not scheduled for half a cycle while it sends the frames of a line exceeds
        # the time-out. How often that happens depends on the machine; that nothing else is lost, not.
        frames = receiver.figures(r"dropped frames: .*?(?:(\d+) timeout)?; (\d+) still waiting")
        row.timed_out = sum(frames) // PAGES - (attempts - 1)

    def drain(self):
        """Have the receiver take all that is in its queue; returns how often that was tried.

        A line of a slot of its own is sent until it is printed: frames are taken in the order in
        which they came.
        """
        codec, receiver = Codec.from_dbc(), self.receiver
        deadline, attempts = time.monotonic() + PATIENCE, 0

        def printed():
            return any(line["slot"] == LAST.name for _, line in receiver.out)

        with can.Bus(interface="socketcan", channel=self.channel) as bus:
            while not printed():
                if time.monotonic() > deadline:
                    raise FailedError("the receiver does not take what is sent")
                attempts += 1
                for frame in codec.encode(MapLine.mean_only(LAST, [0, 0, 0, 0])):
                    bus.send(
                        can.Message(
                            arbitration_id=frame.can_id, data=frame.data, is_extended_id=False
                        )
                    )
                with receiver.changed:
                    receiver.changed.wait_for(printed, 1.0)
        return attempts


@cache
def expected(scene):
    """What may be received of the lines of a scene, but for time and age."""
    codec, scene = Codec.from_dbc(), scenario(scene)
    decoder, lines = codec.decoder(), set()
    for line in map_lines(scene.lines[:4], scene.ego, scene.window):
        for frame in codec.encode(line):
            answer = decoder.feed(frame.can_id, frame.data, 0)
            if isinstance(answer, MapLine):
                lines.add(content(line_dict(answer)))
    return lines


def content(line):
    """All of a line but what differs from one sending to the next, as text."""
    return json.dumps({k: v for k, v in line.items() if k not in {"t", "age", "e2e"}})


def after(cure):
    """Do it; returns when it was done, on our clock [s] and on that of the stamps [ns]."""
    cure()
    return time.monotonic(), time.time_ns()


def last_checks(receiver):
    """The checks of each slot with its last line."""
    return list({line["slot"]: line["e2e"] for _, line in receiver.out}.values())


# ---- the kernel -------------------------------------------------------------------------


def ip(arguments):
    subprocess.run(["ip", *arguments.split()], check=True)


@contextlib.contextmanager
def restored(channel):
    """Whatever happens, the interface is up afterwards, with CAN FD."""
    try:
        yield
    finally:
        if channel not in (name for _, name in socket.if_nameindex()):
            ip(f"link add dev {channel} type vcan")
        ip(f"link set {channel} down")
        ip(f"link set {channel} mtu 72 up")


def traffic(channel):
    """Frames that the interface has sent."""
    return int(Path("/sys/class/net", channel, "statistics/tx_packets").read_text())


def listening():
    """Receivers that the kernel knows of; a filter of a socket is one."""
    text = Path("/proc/net/can/stats").read_text()
    return int(re.search(r"(\d+) current receive list entries", text)[1])


def is_guest():
    return "User Mode Linux" in Path("/proc/cpuinfo").read_text()
