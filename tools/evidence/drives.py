"""A drive that one process sends and another one receives, and the slots of its lines.

The sender is the command "maplines drive"; the other process receives. The received lines must be
those of the log of the sender, bit for bit and in order.

The slots are checked by the received lines alone and the poses that the sender states. A line is
followed from cycle to cycle: where it was seen in one cycle is where it must be in the next one,
within 1 m, or its slot has another line. At a lane change of the car, the left line becomes the
right one, or the right line the left one. Each lane change of the route must be seen once, in its
order, to its side and near its place, and must be one in the truth that the sender records; and
wherever a slot has a new line, the lines of all slots must be boundaries of the lanes around the
car, as in the evidence "slots".
"""

from __future__ import annotations

import csv
import json
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from answers import lines_of

from maplines_can import Codec, Link, MapLine, Receiver, Slot, maps, read_log
from maplines_can.study.scenes.map_scenes import SLOTS
from maplines_can.wire import Decoder

from .bus import values_of
from .harness import evidence
from .slots import Witness
from .witness import seen_from

#: Distance from cycle to cycle beyond which a slot has another line [m].
JUMP = 1.0
#: Largest distance of a lane change from that of the route: along the route [m].
NEAR = 30.0
#: Mean of the time by which the age of a line is rounded up [s].
AGE_ROUNDING = 0.004
#: Cycles within which the lines of a cycle arrive, even from a sender that is late.
PATIENCE = 4
#: Points of a line that are followed to the next cycle [m].
GRID = np.arange(-4.0, 12.5, 0.5)


@evidence
def simulated(
    route: str = "", seconds: float | None = None, fd: bool = False, seed: int = 0
) -> dict[str, Any]:
    """Record a drive through the town without waiting and without a bus, and check its slots.

    Args:
        route: A..B of lanes of the town; the tour by default, 11.9 km in 753 s.
        seconds: the drive ends after this part [s].
        fd: CAN FD.
        seed: of the errors.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = command_of(folder, route, seconds, 20.0, seed, fd=fd)
        done = subprocess.run([*command, "--as-fast-as-possible"], capture_output=True, check=True)
        return checked_slots(folder, route, json.loads(done.stdout))


@evidence
def real_time(
    interface: str = "udp_multicast",
    channel: str = "",
    route: str = "",
    seconds: float | None = None,
    rate: float = 20.0,
    fd: bool = False,
    seed: int = 0,
) -> dict[str, Any]:
    """Send a drive in real time from one process to another, and check each line that arrives.

    On SocketCAN, candump must see each frame as well, if it is installed.

    Args:
        interface: of python-can.
        channel: such as vcan0.
        route: A..B of lanes of the town; the tour by default, 11.9 km in 753 s.
        seconds: the drive ends after this part [s].
        rate: of the cycles [Hz].
        fd: CAN FD.
        seed: of the errors.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = command_of(folder, route, seconds, rate, seed, fd=fd)
        bus: dict[str, Any] = {"interface": interface} | ({"channel": channel} if channel else {})
        for option, value in bus.items():
            command += [f"--{option}", value]
        log, dump = folder / "drive.log", folder / "candump.log"
        with candump(bus, dump) as dumped:
            sent, arrived, figures = transmitted(command, bus, fd=fd)
        was_sent, received = ([values_of(x) for x in of] for of in (decoded(log), arrived))
        figures |= {
            "lines lost": len(was_sent) - len(received),
            "received as they were sent": received == was_sent != [],
        }
        if dumped is not None:
            seen, own = ([(f.can_id, f.data) for f in read_log(path)] for path in (dumped, log))
            figures |= {"frames that candump saw": len(seen), "the same frames": seen == own}
        return {"bus": figures, **checked_slots(folder, route, sent)}


def command_of(
    folder: Path, route: str, seconds: float | None, rate: float, seed: int, *, fd: bool
) -> list[str]:
    """Return the command of the sender, which records its log and the truth in a folder."""
    command = [sys.executable, "-m", "maplines_can", "drive", "--json", "--force", "--lines", "4"]
    command += ["--record", str(folder / "drive.log"), "--truth", str(folder / "truth.csv")]
    command += ["--seed", str(seed), "--rate", str(rate)] + ["--fd"] * fd
    command += ["--route", route] if route else []
    return command + (["--seconds", str(seconds)] if seconds is not None else [])


def checked_slots(folder: Path, name: str, sent: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of the slots of a drive, and what its sender counted."""
    road_map = maps.load(maps.town_path())
    first, *via, last = name.split("..") if name else ("", "")
    route = road_map.route(first, last, via) if name else maps.town_tour(road_map)
    slots = slots_of(folder, road_map, route)
    same = slots["slots with another line"] == sent["slot_changes"]
    return {"slots": slots | {"as many with another line as counted": same}, "sender": sent}


def transmitted(
    command: Sequence[str], bus: dict[str, Any], *, fd: bool
) -> tuple[dict[str, Any], list[MapLine], dict[str, Any]]:
    """Let a process send the drive, and receive it; return its sums, the lines and the figures."""
    arrived: list[MapLine] = []
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
    figures = {
        "frames lost": sent["frames"] - stats.frames,
        "lines missing by their counters": stats.lost,
        "frames dropped": sum(stats.counts.values()),
        "not sent": sent["down"] + sent["full"],
    }
    return sent, arrived, figures


def free_port() -> int:
    """Return a free UDP port, so that no other bus of this machine interferes."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.bind(("", 0))
        return int(found.getsockname()[1])


def new_decoder() -> Decoder:
    """Return a decoder of a bus that may be silent for long."""
    return Codec.from_dbc().decoder(timeout_ms=3_600_000)


def decoded(path: Path) -> list[MapLine]:
    """Return the lines in a log."""
    decoder = new_decoder()
    fed = (decoder.feed(f.can_id, f.data, f.t_ns) for f in read_log(path))
    return [line for answer in fed for line in lines_of(answer)]


@contextmanager
def candump(bus: dict[str, Any], path: Path) -> Iterator[Path | None]:
    """Run candump on a SocketCAN interface, with its output in a file, if it is installed."""
    if bus["interface"] != "socketcan" or not shutil.which("candump"):
        yield None
        return
    with path.open("w") as file:
        process = subprocess.Popen(["candump", "-L", bus["channel"]], stdout=file)
        try:
            time.sleep(1.0)
            yield path
            time.sleep(1.0)
        finally:
            process.terminate()
            process.wait()


def slots_of(folder: Path, road_map: maps.Map, route: maps.Route) -> dict[str, Any]:
    """Return the figures of the slots of a recorded drive."""
    with (folder / "truth.csv").open() as file:
        rows = list(csv.DictReader(file))
    sent = lines_of_cycles(decoded(folder / "drive.log"), rows)
    has = [k for k, cycle in enumerate(sent) if cycle]  # a sender that is late leaves some out
    changed = [k for k, row in enumerate(rows) if float(row["lane_changed"])]
    recorded = np.searchsorted(has, changed).tolist()
    rows = [rows[k] for k in has]
    cycles = known_lines([sent[k] for k in has])
    poses = np.array(
        [[float(row[f"stated_{name}"]) for name in ("x", "y", "heading")] for row in rows]
    )
    places = [route.start]
    for point in poses[1:, :2]:
        places.append(along(route, point, places[-1]))
    changes, counts = changes_of(cycles, poses)
    witness, wrong = Witness(road_map), list[str]()
    for change in changes:
        k = change.last
        at_car = {slot: position(seen, poses, k) for slot, seen in cycles[k].items()}
        if not witness.is_right(at_car, poses[k]):
            wrong.append(f"{rows[k]['drive_time']} s")
    ego = [change for change in changes if change.side]
    planned = [change for change in route.changes if change.end < places[-1]]
    of_route = len(ego) == len(planned) and all(
        change.side == ("left" if plan.is_left else "right")
        and plan.start - NEAR <= places[change.first] <= plan.end + NEAR
        for change, plan in zip(ego, planned, strict=True)
    )
    of_truth = len(ego) == len(recorded) and all(
        k - 1 <= change.first <= k + PATIENCE  # the age is rounded, too
        for change, k in zip(ego, recorded, strict=True)
    )
    away = [row["lane"] != row["stated_lane"] for row in rows]
    return {
        "cycles of which a line was sent": len(rows),
        "slots with another line": counts["slots with another line"],
        "of these without a line now": counts["of these without a line now"],
        "moments at which slots change": len(changes),
        "moments with a wrong slot": len(wrong),
        "wrong": wrong[:10],
        "lane changes of the route": len(planned),
        "lane changes seen": [
            f"{rows[change.first]['drive_time']} s, to the {change.side}, "
            f"{rows[change.first - 1]['stated_lane']} to {rows[change.last]['stated_lane']}"
            for change in ego
        ],
        "each is that of the route": of_route,
        "each is that of the truth": of_truth,
        "cycles on another lane than believed": sum(away),
    }


def changes_of(cycles: Sequence[Any], poses: Any) -> tuple[list[Change], Counter[str]]:
    """Return when slots get other lines, and how many do; cycles are those of ``known_lines``."""
    changes, counts = list[Change](), Counter[str]()
    # The first and the last lines of the slots are not of the same cycle.
    for k in range(PATIENCE + 1, len(cycles) - PATIENCE):
        jumps = {slot: jump(cycles[k - 1], cycles[k], slot, poses, k) for slot in SLOTS}
        new = {slot: value for slot, value in jumps.items() if not abs(value) <= JUMP}
        if not new:
            continue
        counts["slots with another line"] += len(new)
        counts["of these without a line now"] += int(np.isnan(list(new.values())).sum())
        if not changes or k - changes[-1].last > PATIENCE:
            changes.append(Change(k))
        changes[-1].last = k
        changes[-1].jumps |= new
    return changes, counts


@dataclass
class Change:
    """Slots that get another line at about the same time.

    A line is sent at the time of its slot within a cycle, and a sender that is late leaves some
    out: so the lines of one cycle may arrive in the next ones.
    """

    first: int  #: cycle
    last: int = 0  #: cycle
    jumps: dict[Slot, float] = field(default_factory=dict)  #: [m]

    @property
    def side(self) -> str:
        """The side to which the car changes lanes; empty if it does not."""
        sides = {np.sign(self.jumps.get(slot, 0.0)) for slot in SLOTS[:2]}
        return {(1.0,): "left", (-1.0,): "right", (0.0,): ""}.get((*sides,), "neither")


def lines_of_cycles(lines: list[MapLine], rows: Any) -> list[dict[Slot, MapLine]]:
    """Return the lines that were sent of the pose of each cycle."""
    times = np.array([float(row["time"]) for row in rows])
    cycles: list[dict[Slot, MapLine]] = [{} for _ in rows]
    for line in lines:
        if np.isfinite(line.age):
            of_pose = 1e-9 * (line.t_ns or 0) - line.age + AGE_ROUNDING
            after = min(int(times.searchsorted(of_pose)), len(times) - 1)
            k = min((max(after - 1, 0), after), key=lambda i: abs(times[i] - of_pose))
            cycles[k][line.slot] = line
    return cycles


def known_lines(sent: list[dict[Slot, MapLine]]) -> list[dict[Slot, tuple[MapLine, int]]]:
    """Return the lines that a receiver knows in each cycle, and the cycles of their poses.

    A line that was not sent in a cycle is known from the one before.
    """
    known = [{slot: (line, k) for slot, line in lines.items()} for k, lines in enumerate(sent)]
    for slot in SLOTS:
        for k, then in pairwise([k for k, lines in enumerate(sent) if slot in lines]):
            if then - k <= PATIENCE + 1:
                for lines in known[k + 1 : then]:
                    lines[slot] = sent[k][slot], k
    return known


def jump(before: Any, now: Any, slot: Slot, poses: Any, k: int) -> float:
    """Return how far the line of a slot is to the left of where it was, at the car [m].

    Infinite if there was none, and NaN if there is none now.
    """
    if slot not in now:
        return np.nan if slot in before else 0.0
    if slot not in before:
        return np.inf
    step = position(now[slot], poses, k) - position(before[slot], poses, k)
    return step if np.isfinite(step) else 0.0  # it is not beside the car


def position(seen: tuple[MapLine, int], poses: Any, k: int) -> float:
    """Return the lateral position at the car, in cycle k, of a line of an earlier one [m].

    NaN if it is not beside the car, or does not fit into the message.
    """
    line, cycle = seen
    x = GRID[(line.x_min <= GRID) & (line.x_max >= GRID)]
    if len(x) < 2 or not line.is_usable:
        return np.nan
    cos, sin = np.cos(poses[cycle, 2]), np.sin(poses[cycle, 2])
    points = np.column_stack([x, line.y(x)]) @ [[cos, sin], [-sin, cos]] + poses[cycle, :2]
    local = seen_from(points, poses[k : k + 1])[0]
    return float(np.interp(0.0, local[:, 0], local[:, 1], left=np.nan, right=np.nan))


def along(route: maps.Route, point: Any, last: float) -> float:
    """Return the distance along a route of a point shortly after the last one [m]."""
    shortly = slice(*route.line.distance.searchsorted([last - 5, last + 50]))
    squares = ((route.line.points[shortly] - point) ** 2).sum(axis=1)
    return float(route.line.distance[shortly][squares.argmin()])
