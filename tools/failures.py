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

import json
import signal
import socket
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path

from failures_stage import (
    HOUR,
    MAPLINES,
    SLOTS,
    FailedError,
    Process,
    Row,
    Stage,
    after,
    ip,
    is_guest,
    last_checks,
    restored,
    traffic,
)
from reporting import parser_of

from maplines_can.bus import Link, Receiver
from maplines_can.wire import Codec

#: What a second sender sends.
OTHER = "street-turn"
#: How long the interface is down, and the bus is flooded [s].
OUTAGE, FLOOD = 2.0, 3.0
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
        told = receiver.note("the interface has no CAN FD", began)
        invalid = receiver.each_slot(": INVALID", began)
        heard = len(receiver.out)

        def repair():
            ip("link set vcan1 down")
            ip("link set vcan1 mtu 72 up")

        time.sleep(OUTAGE)  # longer than the longest pause between two attempts
        early = len(receiver.out) - heard
        stage.recovered(*after(repair))
    row.seen = (
        f"INVALID after {invalid - began:.2f} s, the reason is told after {told - began:.2f} s; "
        f"{early} lines until it has CAN FD again"
    )


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
    parser = parser_of(__doc__)
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
