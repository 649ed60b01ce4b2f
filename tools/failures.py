#!/usr/bin/env python3
"""Break the bus in earnest, under a real kernel, and see how soon the receiver is right again.

    tools/vcan python3 tools/run.py python tools/failures.py            every failure, 3 minutes
    tools/vcan python3 tools/run.py python tools/failures.py --only down killed

Each failure has real processes: `maplines send`, `maplines receive --json`, cangen, and the
kernel's interfaces vcan0 (classic frames), vcan1 (CAN FD) and vcan2 (classic only). A delivered
line is wrong if it is not, to the last bit, one of those that were sent (all but its time and age),
or if it is delivered twice. A second sender sends another scene, so that a line of both is wrong.

Times are from the end of the cause: until every slot has delivered a line that was sent after
it, and until all of them are VALID. Lines lost are those that the receiver counts by their
counters: who gives up lines while the interface is down leaves counters out, too.

Ends with a nonzero status where a wrong line was delivered, or the receiver did not recover.
"""

import argparse
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
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

from maplines_can.bus import Link, Receiver
from maplines_can.line import MapLine
from maplines_can.scenarios import scenario
from maplines_can.study.listing import line_dict
from maplines_can.study.sending import scene_lines
from maplines_can.wire import Codec

MAPLINES = [sys.executable, "-m", "maplines_can.cli"]
FIRST, OTHER = "highway", "street-turn"
SLOTS, PAGES = 4, 4  # lines of a scene, and frames of a line
#: How long something that must happen may take [s].
PATIENCE = 30.0
#: How long the interface is down, and the bus is flooded; by how much the clock is set [s].
OUTAGE, FLOOD, HOUR = 2.0, 3.0, 3600.0
#: By how many queues of its socket the receiver is stopped, and memory of a frame there [bytes].
QUEUES, FRAME_BYTES = 3.5, 768
#: Error frames as a controller's driver makes them (linux/can/error.h).
ERRORS = {
    "bus off": "20000040#0000000000000000",
    "error passive": "20000004#0030000000008888",
    "no acknowledgement": "20000020#0000000000000000",
    "bit error": "20000008#0000020000000000",
    "overflow of the controller": "20000004#0001000000000000",
    "restarted": "20000100#0000000000000000",
}


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
                return [int(group) for group in match.groups()]
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
        lines = [line for _, line in self.out]
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
        receiver.each_slot(": INVALID", receiver.out[-1][0])
        receiver.end()
        row.delivered, row.lost = receiver.figures(r"(\d+) lines from \d+ frames; (\d+) lines lost")
        row.wrong = receiver.wrong(self.scenes)
        if row.delivered != len(receiver.out):
            row.problem = f"it says {row.delivered} lines and printed {len(receiver.out)}"


@cache
def expected(scene):
    """What may be received of the lines of a scene, but for time and age."""
    codec = Codec.from_dbc()
    decoder, lines = codec.decoder(), set()
    for line in scene_lines(scenario(scene)):
        for frame in codec.encode(line):
            answer = decoder.feed(frame.can_id, frame.data, 0)
            if isinstance(answer, MapLine):
                lines.add(content(line_dict(answer)))
    return lines


def content(line):
    """All of a line but what differs from one sending to the next, as text."""
    return json.dumps({k: v for k, v in line.items() if k not in {"t", "age", "e2e"}})


# ---- the failures -----------------------------------------------------------------------


def down(row):
    """Interface down and up."""
    with restored("vcan0"), Stage(row) as stage:
        receiver, sender = stage.receiver, stage.senders[0]
        began = time.monotonic()
        ip("link set vcan0 down")
        row.detected = receiver.note("is lost", began) - began
        sender.note("is lost", began)
        invalid = receiver.each_slot(": INVALID", began) - began
        time.sleep(OUTAGE)
        stage.recovered(*after(lambda: ip("link set vcan0 up")))
        for process in (receiver, sender):
            process.note("is back")
        said = sum("is lost" in text for _, text in receiver.notes)
    row.seen = f"reported by both ends, by the receiver {said}x; INVALID after {invalid:.2f} s"


def unplugged(row):
    """Interface deleted, and a new one of its name."""
    with restored("vcan0"), Stage(row) as stage:
        receiver = stage.receiver
        began = time.monotonic()
        ip("link del vcan0")
        row.detected = receiver.note("is lost", began) - began
        invalid = receiver.each_slot(": INVALID", began) - began

        def plug():
            ip("link add dev vcan0 type vcan")
            ip("link set vcan0 mtu 72 up")

        stage.recovered(*after(plug))
    row.seen = f"reported by both ends; INVALID after {invalid:.2f} s; the new interface is found"


def killed(row):
    """Sender killed with SIGKILL, and a new one."""
    with Stage(row) as stage:
        receiver = stage.receiver
        stage.killed = True
        receiver.deliver(10 * SLOTS)
        began = time.monotonic()
        stage.senders[0].end(signal.SIGKILL)
        row.detected = receiver.each_slot(": INVALID", began) - began
        starts, since_ns = after(lambda: None)
        _, over = stage.send(OTHER)
        again = receiver.each_again(starts, since_ns)
        valid = receiver.each_again(starts, since_ns, valid=True)
        # It says that it sends when it has begun to.
        row.lines_again, row.valid_again = max(0.0, again - over), max(0.0, valid - over)
        jumps = sum(check["wrong_sequence"] for check in last_checks(receiver))
    row.seen = (
        f"INVALID by silence; {over - began:.1f} s later a sender whose counters start anew: its "
        f"first lines are delivered, {jumps} slots of {SLOTS} note the jump"
    )


def stopped(row):
    """Receiver stopped, its socket overflows."""
    queue = int(Path("/proc/sys/net/core/rmem_default").read_text())
    with Stage(row) as stage:
        receiver = stage.receiver
        lines = len(receiver.out)
        began = time.monotonic()
        receiver.child.send_signal(signal.SIGSTOP)
        stage.witness.more(int(QUEUES * queue // FRAME_BYTES))
        pause = time.monotonic() - began
        over, since_ns = after(lambda: receiver.child.send_signal(signal.SIGCONT))
        stage.recovered(over, since_ns)
        receiver.until("gap", lambda: sum(check["lost"] for check in last_checks(receiver)))
        gap = next(when for when, line in receiver.out if when >= over and line["e2e"]["lost"])
        row.detected = gap - over
        old = [line for when, line in receiver.out[lines:] if when >= over]
        old = sum(line["t"] * 1e9 < since_ns - 1e8 for line in old)
    missing = row.sent - row.delivered
    row.seen = (
        f"{pause:.1f} s away; then {old} lines that had waited, with the time of their frames; the "
        f"counters tell {row.lost} of {missing} lost"
    )
    if row.lost != missing:
        row.problem = f"{missing} lines are missing, and the counters tell {row.lost}"


def two_senders(row):
    """Two senders by mistake on the same slots."""
    with Stage(row) as stage:
        receiver = stage.receiver
        second, began = stage.send(OTHER)
        first_word = receiver.note(": INVALID", began)
        row.detected = receiver.each_slot("TWO SENDERS", began) - began
        receiver.deliver(40 * SLOTS)
        states = [line["e2e"]["state"] for when, line in receiver.out if when > first_word]
        share = sum(state == "VALID" for state in states) / max(1, len(states))
        now, now_ns = after(second.end)
        over = second.out[0][0]  # it sums up when it has sent its last line
        stage.recovered(over, now_ns - int(1e9 * (now - over)))
    row.seen = (
        f"INVALID after {first_word - began:.2f} s, named on all slots after {row.detected:.2f} s; "
        f"{100 * share:.0f} % of the lines while there are two are VALID"
    )


def other_traffic(row):
    """Flood of another ID, as fast as the kernel can."""
    with Stage(row) as stage:
        stage.flood("-I", "001", "-L", "8", "-g", "0", "-p", "10")
        before = traffic(stage.channel)
        time.sleep(FLOOD)
        rate = (traffic(stage.channel) - before) / FLOOD
        stage.recovered(*after(stage.others[-1].end))
        invalid = sum(": INVALID" in text for _, text in stage.receiver.notes)
    row.seen = (
        f"{rate:.0f} frames/s; the kernel keeps them from the receiver; "
        f"INVALID {invalid} times in between"
    )


def random_traffic(row):
    """Flood of random frames on all IDs, as fast as the kernel can."""
    with Stage(row) as stage:
        began = stage.flood("-g", "0", "-p", "10")
        before = traffic(stage.channel)
        row.detected = stage.receiver.note(": INVALID", began) - began
        time.sleep(FLOOD)
        rate = (traffic(stage.channel) - before) / (FLOOD + row.detected)
        stage.recovered(*after(stage.others[-1].end))
        errors = sum(check["errors"] for check in last_checks(stage.receiver))
    row.seen = f"{rate:.0f} frames/s; {errors} of them are errors on a slot: INVALID while it lasts"


def forged(row):
    """Flood of random frames on the ID of a line, 200 a second."""
    with Stage(row) as stage:
        began = stage.flood("-I", "340", "-L", "8", "-g", "5")
        time.sleep(FLOOD)
        ended, since_ns = after(stage.others[-1].end)
        said = [when for when, text in stage.receiver.notes if "ego left" in text and when > began]
        states = [
            line["e2e"]["state"]
            for when, line in stage.receiver.out
            if began < when < ended and line["slot"] == "EGO_LEFT"
        ]
        stage.recovered(ended, since_ns)
        checks = {line["slot"]: line["e2e"] for _, line in stage.receiver.out}
    row.detected = said[0] - began if said else None
    on_it, two = checks.pop("EGO_LEFT"), ", reported as a second sender"
    row.seen = (
        f"on that slot {on_it['errors']} errors and {on_it['wrong_sequence']} records out of "
        f"sequence{two * on_it['two_senders']}, {states.count('VALID')} of {len(states)} lines "
        f"VALID; on the others {sum(check['errors'] for check in checks.values())} errors"
    )


def error_frames(row):
    """Error frames of a controller."""
    with Stage(row) as stage:
        settings = {"interface": "socketcan", "channel": stage.channel}
        with Link(**settings) as link, Receiver(link, Codec.from_dbc().decoder()) as inside:
            for frame in ERRORS.values():
                subprocess.run(["cansend", stage.channel, frame], check=True)
            over, since_ns = after(lambda: None)
            stage.recovered(over, since_ns)
            stats = inside.stats()
    row.seen = (
        f"{stats.error_frames} of {len(ERRORS)} counted apart ({', '.join(ERRORS)}); "
        "vcan has no controller that could mean them"
    )
    if stats.error_frames != len(ERRORS):
        row.problem = f"{stats.error_frames} of {len(ERRORS)} error frames were counted"


def listen_only(row):
    """Listen-only."""
    command = "ip link set vcan0 type can listen-only on"
    refused = subprocess.run(command.split(), capture_output=True, text=True, check=False)
    before = traffic("vcan0")
    with Stage(row) as stage:
        stage.receiver.deliver(10 * SLOTS)
        stage.recovered(*after(lambda: None))
    (frames,) = stage.senders[0].figures(r"in (\d+) frames")
    others = traffic("vcan0") - before - frames
    row.seen = (
        f"vcan has no such mode ({refused.stderr.strip()}); what it asks of a receiver holds: "
        f"{others} frames on the bus beside the sender's {frames}"
    )
    if others:
        row.problem = f"{others} frames are not the sender's"


def no_fd(row):
    """CAN FD on an interface without it."""
    said = []
    with Stage(row, "vcan2") as stage:
        for job in (["send"], ["receive"]):
            process = Process(*MAPLINES, *job, *stage.on, "--fd")
            stage.others.append(process)
            process.note("has no CAN FD")
            status = process.end(None)
            said.append(f"{job[0]} ends with status {status}")
            if status != 1:
                row.problem = f"{process.command} ends with status {status}"
        text = process.notes[-1][1].strip().removeprefix("maplines: error: socketcan vcan2 ")
        stage.recovered(*after(lambda: None))
    row.seen = f"{' and '.join(said)}: {text!r}; the classic sender beside them goes on"


def fd_gone(row):
    """Interface comes back without CAN FD."""
    with restored("vcan1"), Stage(row, "vcan1", fd=True) as stage:
        receiver = stage.receiver
        began = time.monotonic()
        ip("link set vcan1 down")
        row.detected = receiver.note("is lost", began) - began
        ip("link set vcan1 mtu 16 up")
        invalid = receiver.each_slot(": INVALID", began)
        heard = len(receiver.out)

        def repair():
            ip("link set vcan1 down")
            ip("link set vcan1 mtu 72 up")

        time.sleep(OUTAGE)  # longer than the longest pause between two attempts
        early = len(receiver.out) - heard
        stage.recovered(*after(repair))
    row.seen = f"INVALID after {invalid - began:.2f} s; {early} lines until it has CAN FD again"


def clock_back(row):
    """Clock set back by an hour."""
    set_clock(row, -HOUR)


def clock_forward(row):
    """Clock set forward by an hour."""
    set_clock(row, HOUR)


def set_clock(row, by):
    if not is_guest():
        row.seen = "not tried: this would be the clock of a real machine"
        return
    before, started = time.time(), time.monotonic()
    try:
        with Stage(row) as stage:
            receiver = stage.receiver
            began = time.monotonic()
            notes = len(receiver.notes)
            over, since_ns = after(
                lambda: time.clock_settime(time.CLOCK_REALTIME, time.time() + by)
            )
            stage.recovered(over, since_ns)
            said = [when for when, text in receiver.notes[notes:] if "INVALID" in text]
            row.detected = said[0] - began if said else None
    finally:
        time.clock_settime(time.CLOCK_REALTIME, before + time.monotonic() - started)
    row.seen = (
        f"INVALID on {len(said)} slots, by a gap in the time stamps"
        if said
        else "not noticed: delivery goes on without INVALID"
    )


# ---- helpers ----------------------------------------------------------------------------


def after(cure):
    """Do it; returns when it was done, on our clock [s] and on that of the stamps [ns]."""
    cure()
    return time.monotonic(), time.time_ns()


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


def last_checks(receiver):
    """The checks of each slot with its last line."""
    return list({line["slot"]: line["e2e"] for _, line in receiver.out}.values())


def is_guest():
    return "User Mode Linux" in Path("/proc/cpuinfo").read_text()


# ---- the table --------------------------------------------------------------------------

FAILURES = {
    function.__name__.replace("_", "-"): function
    for function in (
        *(down, unplugged, killed, stopped, two_senders, other_traffic, random_traffic, forged),
        *(error_frames, listen_only, no_fd, fd_gone, clock_back, clock_forward),
    )
}


def run(name):
    """Have a failure happen; returns its row, whatever comes of it."""
    failure = FAILURES[name]
    row = Row(name, failure.__doc__.strip().rstrip("."))
    try:
        failure(row)
    except (FailedError, OSError, subprocess.CalledProcessError) as error:
        row.problem = str(error)
    return row


def table(rows):
    """The figures, and below them what was seen, in Markdown."""
    heads = ["failure", "detected [s]", "lines again [s]", "VALID again [s]"]
    heads += ["sent", "given up", "delivered", "lost by counters", "wrong"]
    lines = ["| " + " | ".join(heads) + " |", "|---" + "|---:" * (len(heads) - 1) + "|"]
    for row in rows:
        times = (row.detected, row.lines_again, row.valid_again)
        cells = ["-" if t is None else f"{t:.2f}" for t in times]
        counts = (row.sent, row.given_up, row.delivered, row.lost, row.wrong)
        lines.append("| " + " | ".join([row.failure, *cells, *map(str, counts)]) + " |")
    lines += [""]
    lines += [
        f"- **{row.failure}**: {row.seen}" + f" NOT MET: {row.problem}" * bool(row.problem)
        for row in rows
    ]
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", choices=FAILURES, default=list(FAILURES))
    parser.add_argument("--json", action="store_true", help="for machines")
    arguments = parser.parse_args()
    if not any(name == "vcan0" for _, name in socket.if_nameindex()):
        parser.error("there is no vcan0 here: run it inside tools/vcan")
    rows = []
    for name in arguments.only:
        if sys.stderr.isatty():
            print(name, file=sys.stderr)
        rows.append(run(name))
    if arguments.json:
        print(json.dumps([asdict(row) | {"met": row.met} for row in rows], indent=2))
    else:
        print(table(rows))
    return 0 if all(row.met for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
