#!/usr/bin/env python3
"""Let the nodes of c/examples and those of Python talk over SocketCAN, and compare what comes.

    tools/vcan python3 tools/run.py python tools/c_nodes.py                60 s each way, 50 Hz
    ... tools/c_nodes.py --seconds 5 --from c --dbc maplines-pose.dbc      one of the ways
    ... tools/c_nodes.py --json

Two receivers listen on one interface: receiver_socketcan and `maplines receive`. The sender is
`maplines send` or sender_socketcan, with eight lines. All lines that are sent must come, with the
same lateral positions and standard deviations at both receivers, and so must scenes, with the same
width and centre of the lane. The exit status is 1 if something is lost or differs.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from reporting import parser_of, print_table

from maplines_can.cli.options import layout_from
from maplines_can.generation.c_files import c_files
from maplines_can.values.line import lateral, lateral_jacobian

EXAMPLES = Path(__file__).resolve().parents[1] / "c" / "examples"
FLAGS = ["-std=c99", "-O2", "-ffp-contract=off"]
#: Where receiver_socketcan evaluates lines, and scenes [m].
X, X_SCENE = 40.0, 0.0
LINE = re.compile(rf"(.{{10}}) \w+ +y\({X:.0f} m\) +(\S+) m, sigma (\S+) m")
SCENE = re.compile(r"scene +\w+ +width (\S+) m, sigma (\S+) m; centre (\S+) m, sigma (\S+) m")
#: Decimals of what receiver_socketcan prints, rounded [m].
STEP = 0.5e-6 + 1e-12
MAPLINES = [sys.executable, "-m", "maplines_can"]

Rows = dict[str, list[tuple[float, ...]]]


def build(folder: Path, dbc: str) -> None:
    """Compile the examples with the tables of a DBC into a folder."""
    for name, text in c_files({"maplines": layout_from(dbc)}).items():
        (folder / name).write_text(text, encoding="utf-8")
    core = [str(folder / name) for name in ("maplines.c", "maplines_dbc.c")]
    for name in ("receiver_socketcan", "sender_socketcan"):
        source, program = str(EXAMPLES / f"{name}.c"), str(folder / name)
        command = ["cc", *FLAGS, f"-I{folder}", source, *core, "-lm", "-o", program]
        subprocess.run(command, check=True)


def rows_of_c(text: str) -> Rows:
    """Return lateral position and sigma of lines by slot, and the rows of scenes."""
    rows: Rows = defaultdict(list)
    for line in text.splitlines():
        if found := LINE.match(line):
            slot, *values = found.groups()
            rows[slot.strip()].append(tuple(map(float, values)))
        elif found := SCENE.match(line):
            rows["scene"].append(tuple(map(float, found.groups())))
    return rows


def rows_of_python(text: str) -> Rows:
    """Return the same of what `maplines receive --json --scenes` prints."""
    rows: Rows = defaultdict(list)
    for row in map(json.loads, text.splitlines()):
        if "slot" in row:
            mean = np.array([row["mean"][name] for name in ("y_off", "beta", "c0", "c1")])
            J = lateral_jacobian(mean, X)
            values = float(lateral(mean, X)), float(np.sqrt(J @ np.array(row["cov"]) @ J))
            if row["x_min"] <= X <= row["x_max"] and row["status"] != "OUT_OF_RANGE":
                rows[row["slot"]].append(values)
        elif row.get("width") is not None:
            at = [e for name in ("width", "centre") for e in row[name] if e["x"] == X_SCENE]
            if at:  # both lines are valid there
                rows["scene"].append(tuple(e[key] for e in at for key in ("value", "sigma")))
    return rows


def wait_for_listeners(channel: str, count: int, limit: float = 60.0) -> None:
    """Wait until so many filters of raw sockets are set on an interface."""
    end = time.monotonic() + limit
    # Interface, CAN ID, mask and function; then an address that tells the sockets apart.
    entry = re.compile(rf"(?m)^\s*{channel}(?:\s+\w+){{3}}\s+(\w+)\s+\d+\s+raw")
    while time.monotonic() < end:
        lists = [Path(f"/proc/net/can/rcvlist_{kind}") for kind in ("all", "sff", "eff", "fil")]
        text = "".join(path.read_text() for path in lists if path.exists())
        if len(set(entry.findall(text))) >= count:
            return
        time.sleep(0.05)
    raise SystemExit(f"no {count} listeners on {channel} after {limit:g} s")


def wait_for_output(path: Path, quiet: float = 2.0) -> None:
    """Wait until a file has not grown for some seconds."""
    size, since = -1, time.monotonic()
    while time.monotonic() - since < quiet:
        if (now := path.stat().st_size) != size:
            size, since = now, time.monotonic()
        time.sleep(0.1)


def talk(
    folder: Path, sender: str, dbc: str, *, seconds: float, rate: float = 50.0,
    scenes: bool = True, fd: bool = False, channel: str = "vcan0",
) -> dict[str, Any]:  # fmt: skip
    """Let a sender send eight lines to both receivers, and return what they have in common."""
    cycles = round(seconds * rate)
    bus = ["--interface", "socketcan", "--channel", channel, "--dbc", dbc, *["--fd"] * fd]
    from_c = [str(folder / "sender_socketcan"), channel, str(round(1e3 / rate)), str(cycles)]
    form = "scenes" if scenes else "lines"
    command = [*from_c, form, *["fd"] * fd]
    if sender == "python":
        of_scene = ["--pose-error"] if scenes and dbc == "maplines.dbc" else []
        # At a standstill a scene is encoded once, and only its age changes.
        settings = ["--lines", "8", "--rate", str(rate), "--count", str(cycles), "--standstill"]
        command = [*MAPLINES, "send", *bus, *settings, *of_scene, "--json"]
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    files = [folder / name for name in ("c.txt", "python.txt", "notes.txt")]
    with ExitStack() as stack:
        of_c, of_python, notes = (stack.enter_context(open(file, "w+")) for file in files)
        receive = [*MAPLINES, "receive", *bus, "--json", "--scenes"]
        receivers = [
            subprocess.Popen([str(folder / "receiver_socketcan"), channel], stdout=of_c),
            subprocess.Popen(receive, stdout=of_python, stderr=notes, env=environment),
        ]
        try:
            wait_for_listeners(channel, len(receivers))
            done = subprocess.run(command, stdout=-1, text=True, check=True, env=environment)
            wait_for_output(folder / "python.txt")
        finally:
            for process in receivers:
                process.send_signal(signal.SIGINT)
            statuses = [process.wait(60) for process in receivers]
        for file in (of_c, of_python, notes):
            file.seek(0)
        text, found, said = of_c.read(), rows_of_python(of_python.read()), notes.read()
    sums = [line for line in said.splitlines() if "lost by their counters" in line]
    row = compared(sent_by(sender, done.stdout), rows_of_c(text), found, text, statuses[0])
    return row | {"said by Python": "".join(sums)}


def sent_by(sender: str, output: str) -> int:
    """Return the number of lines that a sender says it has sent."""
    return int(json.loads(output)["lines"] if sender == "python" else output.split()[0])


def compared(sent: int, c: Rows, python: Rows, text: str, status: int) -> dict[str, Any]:
    """Return counts, and the greatest difference of the rows of both receivers [m].

    A scene is printed when its receiver looks at it: on a busy machine, `maplines receive` may miss
    one that a later one replaces. Those that it prints must be among those of C, in this order.
    """
    scenes = c.pop("scene", []), python.pop("scene", [])
    same = {name: len(rows) for name, rows in c.items()} == {n: len(r) for n, r in python.items()}
    difference = np.inf
    if same and c:
        difference = max(np.abs(np.subtract(c[name], python[name])).max() for name in c)
    dropped = {what: int(n) for n, what in re.findall(r"(?m)^(\d+) dropped: (.+)$", text)}
    lines = sum(map(len, c.values()))
    equal = in_order(scenes[1], scenes[0])
    met = status == 0 and lines == sent > 0 and not dropped and difference <= STEP
    late = dropped.get("TIMEOUT", 0) > 0 and len(dropped) == 1
    return {
        "lines sent": sent,
        "lines received by C": lines,
        "lines received by Python": sum(map(len, python.values())),
        "largest difference of lines [m]": float(difference),
        "scenes received by C": len(scenes[0]),
        "scenes received by Python": len(scenes[1]),
        "of these, equal to that of C": equal,
        "dropped by C": dropped,
        "equal": bool(status == 0 and difference <= STEP and (lines == sent or late)),
        "met": bool(met and equal == len(scenes[1]) and bool(scenes[0]) == bool(scenes[1])),
    }


def in_order(some: list[tuple[float, ...]], others: list[tuple[float, ...]]) -> int:
    """Return how many rows are among others in the same order, but for rounding."""
    place = found = 0
    for row in some:
        rest = np.array(others[place:]).reshape(-1, len(row))
        hits = np.flatnonzero(np.abs(rest - row).max(axis=1, initial=0.0) <= STEP)
        if len(hits):
            place, found = place + int(hits[0]) + 1, found + 1
    return found


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=50.0, help="cycles a second (default: 50)")
    parser.add_argument("--from", dest="sender", choices=("c", "python"), help="only this sender")
    parser.add_argument("--dbc", action="append", help="DBC (default: those that need no key)")
    parser.add_argument("--fd", action="store_true", help="CAN FD")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    result: dict[str, Any] = {}
    for dbc in options.dbc or ("maplines.dbc", "maplines-pose.dbc", "maplines-scene.dbc"):
        fd = options.fd or dbc == "maplines-scene.dbc"  # which has no classic messages
        with tempfile.TemporaryDirectory() as name:
            build(Path(name), dbc)
            for sender in [options.sender] if options.sender else ("c", "python"):
                for scenes in (False, True) if dbc == "maplines.dbc" else (True,):
                    ways = {"seconds": options.seconds, "rate": options.rate, "fd": fd}
                    what = "scenes" if scenes else "lines"
                    result[f"{what} of {dbc}, from {sender}"] = talk(
                        Path(name), sender, dbc, scenes=scenes, **ways
                    )
    if options.json:
        print(json.dumps(result, indent=2))
    else:
        print_table(result, 32)
    return 0 if all(row["met"] for row in result.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
