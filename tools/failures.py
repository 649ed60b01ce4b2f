#!/usr/bin/env python3
"""Cause failures of the bus under a real kernel and measure how soon the receiver recovers.

    tools/vcan python3 tools/run.py python tools/failures.py            every failure, 3 minutes
    tools/vcan python3 tools/run.py python tools/failures.py --only down killed

Each failure uses real processes: `maplines send`, `maplines receive --json`, cangen, and the
kernel's interfaces vcan0 (classic CAN), vcan1 (CAN FD) and vcan2 (classic CAN only). A delivered
line is wrong if it differs in any bit from all lines that were sent (except for its time and age),
or if it is delivered twice. A second sender sends another scene, so that a line of both is wrong.

Times are from the end of the cause until every slot has delivered a line that was sent after
it, and until all slots are VALID. Lost lines are those that the receiver counts by the sender's
counters; lines that the sender gives up while the interface is down are among them.

The exit status is nonzero if a wrong line was delivered or the receiver did not recover.
"""

import json
import signal
import socket
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from failures_testbed import (
    HOUR,
    MAPLINES,
    PAGES,
    SLOTS,
    Process,
    Row,
    Testbed,
    UnmetError,
    ip,
    is_guest,
    last_checks,
    restored,
    timed,
    traffic,
)
from reporting import parser_of

from maplines_can.bus import Link, Receiver
from maplines_can.wire import Codec

#: Scene of a second sender.
OTHER_SCENE = "street-turn"
#: Duration of an outage and of a flood [s].
OUTAGE, FLOOD = 2.0, 3.0
#: How often the receiver's socket queue is filled while it is suspended, and the memory of a
#: frame in the queue [bytes].
QUEUES, FRAME_BYTES = 3.5, 768
#: Error frames in the format of a controller's driver (linux/can/error.h).
ERRORS = {
    "bus off": "20000040#0000000000000000",
    "error passive": "20000004#0030000000008888",
    "no acknowledgement": "20000020#0000000000000000",
    "bit error": "20000008#0000020000000000",
    "overflow of the controller": "20000004#0001000000000000",
    "restarted": "20000100#0000000000000000",
}


# ---- the failures -----------------------------------------------------------------------


def down(row: Any) -> None:
    """Interface down and up."""
    with restored("vcan0"), Testbed(row) as testbed:
        receiver, sender = testbed.receiver, testbed.senders[0]
        started = time.monotonic()
        ip("link set vcan0 down")
        row.detected = receiver.wait_for_note("is lost", started) - started
        sender.wait_for_note("is lost", started)
        invalid = receiver.wait_for_each_slot("INVALID;", started) - started
        time.sleep(OUTAGE)
        testbed.wait_for_recovery(*timed(lambda: ip("link set vcan0 up")))
        for process in (receiver, sender):
            process.wait_for_note("is back")
        reports = sum("is lost" in text for _, text in receiver.notes)
    row.seen = f"reported by both ends, by the receiver {reports}x; INVALID after {invalid:.2f} s"


def unplugged(row: Any) -> None:
    """Interface deleted and re-created under the same name."""
    with restored("vcan0"), Testbed(row) as testbed:
        receiver = testbed.receiver
        started = time.monotonic()
        ip("link del vcan0")
        row.detected = receiver.wait_for_note("is lost", started) - started
        invalid = receiver.wait_for_each_slot("INVALID;", started) - started

        def recreate() -> None:
            ip("link add dev vcan0 type vcan")
            ip("link set vcan0 mtu 72 up")

        testbed.wait_for_recovery(*timed(recreate))
    row.seen = f"reported by both ends; INVALID after {invalid:.2f} s; the new interface is found"


def killed(row: Any) -> None:
    """Sender killed with SIGKILL, and a new one."""
    with Testbed(row) as testbed:
        receiver = testbed.receiver
        testbed.killed = True
        receiver.wait_for_lines(10 * SLOTS)
        started = time.monotonic()
        testbed.senders[0].end(signal.SIGKILL)
        row.detected = receiver.wait_for_each_slot("INVALID;", started) - started
        since, since_ns = timed(lambda: None)
        _, sending = testbed.send(OTHER_SCENE)
        again = receiver.wait_for_new_lines(since, since_ns)
        valid = receiver.wait_for_new_lines(since, since_ns, valid=True)
        # The sender reports that it sends after its first lines.
        row.lines_again, row.valid_again = max(0.0, again - sending), max(0.0, valid - sending)
        breaks = sum(check["wrong_sequence"] for check in last_checks(receiver))
    row.seen = (
        f"INVALID by silence; {sending - started:.1f} s later a sender whose counters restart: its "
        f"first lines are delivered, {breaks} slots of {SLOTS} count the sequence break"
    )


def stopped(row: Any) -> None:
    """Receiver stopped, its socket overflows."""
    queue = int(Path("/proc/sys/net/core/rmem_default").read_text())
    with Testbed(row) as testbed:
        receiver = testbed.receiver
        lines = len(receiver.out)
        started = time.monotonic()
        receiver.child.send_signal(signal.SIGSTOP)
        testbed.frame_counter.wait_for_frames(int(QUEUES * queue // FRAME_BYTES))
        pause = time.monotonic() - started
        over, since_ns = timed(lambda: receiver.child.send_signal(signal.SIGCONT))
        testbed.wait_for_recovery(over, since_ns)
        receiver.wait_for("gap", lambda: sum(check["lost"] for check in last_checks(receiver)))
        gap = next(when for when, line in receiver.out if when >= over and line["e2e"]["lost"])
        row.detected = gap - over
        late = [line for when, line in receiver.out[lines:] if when >= over]
        old = sum(line["t"] * 1e9 < since_ns - 1e8 for line in late)
    missing = row.sent - row.delivered
    row.seen = (
        f"suspended for {pause:.1f} s; then {old} lines from the queue, with the times of their "
        f"frames; by the counters {row.lost} of {missing} are lost"
    )
    if row.lost != missing:
        row.problem = f"{missing} lines are missing, but {row.lost} by the counters"


def two_senders(row: Any) -> None:
    """Two senders by mistake on the same slots."""
    with Testbed(row) as testbed:
        receiver = testbed.receiver
        second, started = testbed.send(OTHER_SCENE)
        invalid = receiver.wait_for_note("INVALID;", started)
        row.detected = receiver.wait_for_each_slot("TWO SENDERS", started) - started
        receiver.wait_for_lines(40 * SLOTS)
        states = [line["e2e"]["state"] for when, line in receiver.out if when > invalid]
        share = sum(state == "VALID" for state in states) / max(1, len(states))
        now, now_ns = timed(second.end)
        over = second.out[0][0]  # it prints its sums after its last line
        testbed.wait_for_recovery(over, now_ns - int(1e9 * (now - over)))
    row.seen = (
        f"INVALID after {invalid - started:.2f} s, reported on all slots after "
        f"{row.detected:.2f} s; while there are two, {100 * share:.0f} % of the lines are VALID"
    )


def other_traffic(row: Any) -> None:
    """Flood of another ID, as fast as the kernel can."""
    with Testbed(row) as testbed:
        testbed.flood("-I", "001", "-L", "8", "-g", "0", "-p", "10")
        before = traffic(testbed.channel)
        time.sleep(FLOOD)
        rate = (traffic(testbed.channel) - before) / FLOOD
        testbed.wait_for_recovery(*timed(testbed.others[-1].end))
        invalid = sum("INVALID;" in text for _, text in testbed.receiver.notes)
    row.seen = (
        f"{rate:.0f} frames/s; the filter in the kernel drops them; "
        f"INVALID {invalid} times meanwhile"
    )


def random_traffic(row: Any) -> None:
    """Flood of random frames on all IDs, as fast as the kernel can."""
    with Testbed(row) as testbed:
        started = testbed.flood("-g", "0", "-p", "10")
        before = traffic(testbed.channel)
        row.detected = testbed.receiver.wait_for_note("INVALID;", started) - started
        time.sleep(FLOOD)
        rate = (traffic(testbed.channel) - before) / (FLOOD + row.detected)
        testbed.wait_for_recovery(*timed(testbed.others[-1].end))
        errors = sum(check["errors"] for check in last_checks(testbed.receiver))
    row.seen = (
        f"{rate:.0f} frames/s; {errors} of them are errors on a slot: INVALID during the flood"
    )


def forged(row: Any) -> None:
    """Flood of random frames on the ID of a line, 200 a second."""
    with Testbed(row) as testbed:
        started = testbed.flood("-I", "340", "-L", "8", "-g", "5")
        time.sleep(FLOOD)
        ended, since_ns = timed(testbed.others[-1].end)
        reports = [
            when for when, text in testbed.receiver.notes if "ego left" in text and when > started
        ]
        states = [
            line["e2e"]["state"]
            for when, line in testbed.receiver.out
            if started < when < ended and line["slot"] == "EGO_LEFT"
        ]
        testbed.wait_for_recovery(ended, since_ns)
        checks = {line["slot"]: line["e2e"] for _, line in testbed.receiver.out}
    row.detected = reports[0] - started if reports else None
    ego_left, conflict = checks.pop("EGO_LEFT"), ", reported as a second sender"
    row.seen = (
        f"on that slot {ego_left['errors']} errors and {ego_left['wrong_sequence']} records out of "
        f"sequence{conflict * ego_left['two_senders']}, {states.count('VALID')} of {len(states)} "
        f"lines VALID; on the others {sum(check['errors'] for check in checks.values())} errors"
    )


def error_frames(row: Any) -> None:
    """Error frames of a controller."""
    with Testbed(row) as testbed:
        settings = {"interface": "socketcan", "channel": testbed.channel}
        with Link(**settings) as link, Receiver(link, Codec.from_dbc().decoder()) as inside:
            for frame in ERRORS.values():
                subprocess.run(["cansend", testbed.channel, frame], check=True)
            over, since_ns = timed(lambda: None)
            testbed.wait_for_recovery(over, since_ns)
            stats = inside.stats()
    row.seen = (
        f"{stats.error_frames} of {len(ERRORS)} counted separately ({', '.join(ERRORS)}); "
        "vcan has no controller that would send them"
    )
    if stats.error_frames != len(ERRORS):
        row.problem = f"{stats.error_frames} of {len(ERRORS)} error frames were counted"


def listen_only(row: Any) -> None:
    """Listen-only."""
    command = "ip link set vcan0 type can listen-only on"
    refused = subprocess.run(command.split(), capture_output=True, text=True, check=False)
    before = traffic("vcan0")
    with Testbed(row) as testbed:
        testbed.receiver.wait_for_lines(10 * SLOTS)
        testbed.wait_for_recovery(*timed(lambda: None))
    (frames,) = testbed.senders[0].figures(r"in (\d+) frames")
    others = traffic("vcan0") - before - frames - PAGES * testbed.extra_lines
    row.seen = (
        f"vcan has no such mode ({refused.stderr.strip()}); the receiver sends nothing, as the "
        f"mode requires: {others} frames on the bus beside the sender's {frames}"
    )
    if others:
        row.problem = f"{others} frames are not the sender's"


def no_fd(row: Any) -> None:
    """CAN FD on an interface without it."""
    results = []
    with Testbed(row, "vcan2") as testbed:
        for job in (["send"], ["receive"]):
            process = Process(*MAPLINES, *job, *testbed.on, "--fd")
            testbed.others.append(process)
            process.wait_for_note("has no CAN FD")
            status = process.end(None)
            results.append(f"{job[0]} ends with status {status}")
            if status != 1:
                row.problem = f"{process.command} ends with status {status}"
        text = process.notes[-1][1].strip().removeprefix("maplines: error: socketcan vcan2 ")
        testbed.wait_for_recovery(*timed(lambda: None))
    row.seen = f"{' and '.join(results)}: {text!r}; the classic sender continues"


def fd_gone(row: Any) -> None:
    """Interface comes back without CAN FD."""
    with restored("vcan1"), Testbed(row, "vcan1", fd=True) as testbed:
        receiver = testbed.receiver
        started = time.monotonic()
        ip("link set vcan1 down")
        row.detected = receiver.wait_for_note("is lost", started) - started
        ip("link set vcan1 mtu 16 up")
        reported = receiver.wait_for_note("the interface has no CAN FD", started)
        invalid = receiver.wait_for_each_slot("INVALID;", started)
        before = len(receiver.out)

        def repair() -> None:
            ip("link set vcan1 down")
            ip("link set vcan1 mtu 72 up")

        time.sleep(OUTAGE)  # longer than the longest pause between two attempts
        early = len(receiver.out) - before
        testbed.wait_for_recovery(*timed(repair))
    row.seen = (
        f"INVALID after {invalid - started:.2f} s, reason after {reported - started:.2f} s; "
        f"{early} lines until it has CAN FD again"
    )


def clock_back(row: Any) -> None:
    """Clock set back by an hour."""
    set_clock(row, -HOUR)


def clock_forward(row: Any) -> None:
    """Clock set forward by an hour."""
    set_clock(row, HOUR)


def set_clock(row: Any, by: Any) -> None:
    if not is_guest():
        row.seen = "not tried: this would set the clock of a real machine"
        return
    before, begin = time.time(), time.monotonic()
    try:
        with Testbed(row) as testbed:
            receiver = testbed.receiver
            started = time.monotonic()
            notes = len(receiver.notes)
            over, since_ns = timed(
                lambda: time.clock_settime(time.CLOCK_REALTIME, time.time() + by)
            )
            testbed.wait_for_recovery(over, since_ns)
            reports = [when for when, text in receiver.notes[notes:] if "INVALID" in text]
            row.detected = reports[0] - started if reports else None
    finally:
        time.clock_settime(time.CLOCK_REALTIME, before + time.monotonic() - begin)
    row.seen = (
        f"INVALID on {len(reports)} slots, by a gap in the time stamps"
        if reports
        else "not noticed: delivery continues without INVALID"
    )


# ---- the table --------------------------------------------------------------------------

FAILURES = {
    function.__name__.replace("_", "-"): function
    for function in (
        *(down, unplugged, killed, stopped, two_senders, other_traffic, random_traffic, forged),
        *(error_frames, listen_only, no_fd, fd_gone, clock_back, clock_forward),
    )
}


def run(name: Any) -> Any:
    """Cause a failure and return its row; a problem is in the row, too."""
    failure = FAILURES[name]
    row = Row(name, failure.__doc__.strip().rstrip("."))  # type: ignore[union-attr]
    try:
        failure(row)
    except (UnmetError, OSError, subprocess.CalledProcessError) as error:
        row.problem = str(error)
    return row


def table(rows: Any) -> Any:
    """Return the figures and, below them, the observations in Markdown."""
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


def main() -> Any:
    parser = parser_of(__doc__)
    parser.add_argument("--only", nargs="+", choices=FAILURES, default=list(FAILURES))
    parser.add_argument("--json", action="store_true", help="print JSON")
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
