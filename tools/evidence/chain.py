#!/usr/bin/env python3
"""Drive through the shipped town with the whole chain at once, in real time, on a bus.

    evidence_chain.py                  ten minutes, over UDP multicast between two processes
    evidence_chain.py --seconds 30     half a minute
    evidence_chain.py --simulated      without waiting, without a bus, in one process
    evidence_chain.py --simulated --seeds 6 --seconds 120    drives with other errors

Run it in the environment of the project: python3 tools/run.py python tools/evidence_chain.py

    car -> GNSS, odometry, camera, landmarks -> Localisation -> map_scene -> Transmitter
     ^                                                                           |
     |                                                                          bus
     |                                                                           v
     +--- LaneSteering <- LaneFusion <- Receiver, odometry and a second camera --+

The sender is a process of its own. Beside the bus, it gets the true motion of the car, which its
simulated sensors measure. Sensors, car, and camera are those of localisation.md, evidence_steering
and evidence_fusion; the camera of the fusion fails for 10 s in each minute. The map has no error.
The car steers by the fused lane, in lane changes by the received line of the route. After a
handover it stops; then a driver brings it back to the lane, and lets it drive again.

The error is the lateral distance of the rear axle from the middle of the lane. NEES is the squared
error in units of the variance: for each degree of freedom, 1 if the covariance is right. One drive
is one draw of errors that last, so it scatters about 1; --seeds gives the mean over drives, and its
standard error.

Lost is what was sent, less what was received. A line that the sender has to skip, since it is late
or was retracted, is not sent, but leaves a gap in the counters.

The shares of a core are those of the threads that do the work, with the simulation apart. A cycle
is skipped if the process is late by a period. The exit status is 1 if a line or a frame is lost, or
if the car leaves the lane without having handed over.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import socket
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from itertools import pairwise
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from chain_parts import CAMERA_OUTAGE, Array, Consumer, Sender, World
from maplines_can.study.closed_loop import BESIDE_CHANGE, MARGIN, PERIOD, STEP
from reporting import bar, parser_of, report

from maplines_can import Codec, Link, MapLine, Receiver, Transmitter, maps
from maplines_can.consumers.steering import State
from maplines_can.simulation.camera_view import AGE, COLUMNS, FRAME, LANE, PLACES
from maplines_can.simulation.truth import true_lines
from maplines_can.wire import POSE, Frame, Monitor, default_dbc_path

#: Largest distance from the middle of the lane at which the car is in it [m].
IN_LANE = (3.5 - 1.8) / 2
#: Distance from a lane change beyond which the fused lane is compared with the truth [m].
BESIDE = BESIDE_CHANGE + 40.0
#: Each n-th cycle is compared with the truth.
EACH = 4
#: Time from the pose to the demands in a simulated drive [s].
LATENCY = 0.04
#: Longest time to wait for lines that are on their way, and for the sender to start [s].
PATIENCE, START = 5.0, 120.0

#: DBC with a message of the pose error.
DBC = "maplines-pose.dbc"

#: Names of figures.
POSE_NEES, FUSED = "NEES of the pose", "NEES of the fused lane at 0, 20, 40 m"
OUTAGE = "the same while the camera fails"

Tick = Callable[[float], object]


def codec_of(dbc: str) -> Codec:
    """Return the codec of a DBC of the package."""
    return Codec.from_dbc(default_dbc_path(dbc))


def simulated(
    seconds: float, seed: int, dbc: str = DBC, tick: Tick = lambda _: None
) -> dict[str, Any]:
    """Drive without waiting and without a bus; return the figures."""
    world = World(seed)
    sender, codec = Sender(seed, world.row), codec_of(dbc)
    monitor = Monitor(codec.decoder())
    consumer = Consumer(world, monitor)
    rows, lines, received, frames = world.row[None], 0, 0, 0
    on_the_way: deque[tuple[int, Frame]] = deque()

    def deliver(now_ns: float) -> int:
        """Deliver the frames until now; return the number of lines."""
        found = 0
        while on_the_way and on_the_way[0][0] <= now_ns:
            ns, frame = on_the_way.popleft()
            line = monitor.feed(frame.can_id, frame.data, ns)
            found += isinstance(line, MapLine) + len(monitor.further)
        return found

    while world.t < seconds - STEP / 2 and not is_at_goal(world):
        sender.move(rows)
        scene = sender.cycle(rows[-1]).scene
        if scene is not None and scene.lines:
            encoded = codec.encode_scene(scene, age=AGE)
            lines += len(encoded.keys() - {POSE})
            frames += sum(map(len, encoded.values()))
            on_the_way += spread(encoded.values(), world.t + AGE)
        received += deliver(1e9 * (world.t + LATENCY))
        before = consumer.demands
        consumer.step(0, round(1e9 * (world.t + LATENCY)))
        rows = consumer.drive(before, LATENCY)
        tick(PERIOD)
    received += deliver(math.inf)
    sent = {"lines": lines, "frames": frames, "cycles skipped": 0} | sender.figures()
    arrived = {"lines": received, "frames": frames, "lost": lines - received}
    return figures_of(consumer, sent, arrived)


def spread(transfers: Collection[list[Frame]], start: float) -> Iterator[tuple[int, Frame]]:
    """Yield the frames of a cycle with their times [ns], spread over a period as on the bus."""
    for i, frames in enumerate(transfers):
        for k, frame in enumerate(frames):
            yield round(1e9 * (start + PERIOD * i / len(transfers) + FRAME * k)), frame


def send(pipe: Connection, bus: Mapping[str, Any], dbc: str, seed: int, start: Array) -> None:
    """Localise the car, and send the lines, until the pipe brings None; then send the figures."""
    sender, skipped = Sender(seed, start), 0
    sender.move(start[None])
    sender.cycle(start)  # the first one takes longer
    with Link(**bus) as link:
        transmitter = Transmitter(link, codec_of(dbc), period=PERIOD)
        pipe.send("ready")
        start_ns, before = pipe.recv(), time.process_time()
        with transmitter:
            while (rows := pipe.recv()) is not None:
                sender.move(rows)
                if pipe.poll():
                    skipped += 1
                    continue
                scene = sender.cycle(rows[-1]).scene
                with sender.cpu.of("lines"):
                    t_pose_ns = start_ns + round(1e9 * rows[-1, 0])
                    if scene is None:  # without a pose, there are no lines
                        transmitter.publish([], t_pose_ns)
                    else:
                        transmitter.publish(scene, t_pose_ns)
            transmitter.wait(PERIOD)
        stats = transmitter.stats()
    used = time.process_time() - before
    sent = {name: getattr(stats, name) for name in ("lines", "frames", "down", "full", "overruns")}
    sent |= {"cycles skipped": skipped, "lateness, 99 % [ms]": 1000 * stats.lateness.p99}
    pipe.send(sent | sender.figures() | {"CPU": dict(sender.cpu) | {"all": used}})


def on_bus(
    bus: Mapping[str, Any],
    seconds: float,
    seed: int,
    dbc: str = DBC,
    tick: Tick = lambda _: None,
) -> dict[str, Any]:
    """Drive in real time, with the sender in a process of its own; return the figures."""
    world = World(seed)
    context = multiprocessing.get_context("spawn")
    pipe, other = context.Pipe()
    process = context.Process(
        target=send, args=(other, dict(bus), dbc, seed, world.row), daemon=True
    )
    process.start()
    other.close()
    if not pipe.poll(START):
        raise RuntimeError(f"the sender did not start within {START:g} s")
    pipe.recv()
    lines: list[object] = []
    with (
        Link(**bus) as link,
        Receiver(link, codec_of(dbc).decoder(), on_line=lines.append) as receiver,
    ):
        consumer, skipped = Consumer(world, receiver), 0
        before, start, start_ns = time.process_time(), time.monotonic(), time.time_ns()
        pipe.send(start_ns)
        rows = world.row[None]
        while world.t < seconds - STEP / 2 and not is_at_goal(world):
            due = start + world.t
            time.sleep(max(due - time.monotonic(), 0.0))
            pipe.send(rows)
            tick(PERIOD)
            if time.monotonic() - due >= PERIOD:
                skipped += 1
                rows = consumer.drive(consumer.demands, 0.0)
                continue
            demands = consumer.demands
            consumer.step(start_ns, time.time_ns())
            latency = STEP * math.ceil((time.monotonic() - due) / STEP)
            rows = consumer.drive(demands, min(latency, PERIOD))
        used = time.process_time() - before
        pipe.send(None)
        sent = pipe.recv()
        end = time.monotonic() + PATIENCE
        while receiver.stats().frames < sent["frames"] and time.monotonic() < end:
            time.sleep(0.05)
        stats = receiver.stats()
    process.join(PATIENCE)
    arrived = {
        "lines": stats.lines,
        "frames": stats.frames,
        "lost": sent["lines"] - stats.lines,
        "gaps of the counters": stats.lost,
        "frames dropped": sum(stats.counts.values()),
        "cycles skipped": skipped,
    }
    shares = shares_of(sent.pop("CPU"), dict(consumer.cpu) | {"all": used}, world.t)
    return figures_of(consumer, sent, arrived) | {"share of a core": shares}


def is_at_goal(world: World) -> bool:
    """Return whether the car has arrived."""
    along, _ = world.place.of(world.car.pose)
    return along > world.route.goal - MARGIN


def shares_of(
    sender: dict[str, float], receiver: dict[str, float], seconds: float
) -> dict[str, Any]:
    """Return the shares of a core of the parts of both processes."""
    found: dict[str, Any] = {}
    for name, rest, cpu in (("sender", "sending", sender), ("receiver", "reception", receiver)):
        total = cpu.pop("all")
        simulation = cpu.pop("simulation")
        cpu[rest] = total - simulation - sum(cpu.values())
        found[name] = (total - simulation) / seconds
        found[f"{name}: its parts"] = {part: used / seconds for part, used in cpu.items()}
        found[f"{name}: simulation"] = simulation / seconds
    return found


def figures_of(consumer: Consumer, sent: dict[str, Any], arrived: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of a drive."""
    moments, world = consumer.moments, consumer.world
    # A car that hands over is the driver's until it drives again.
    automatic = [m for m in moments if m.state is not State.HANDOVER]
    error = np.abs([m.error for m in automatic])
    handovers = [
        now.reason
        for before, now in pairwise(moments)
        if now.state is State.HANDOVER and before.state is not State.HANDOVER
    ]
    braking = [abs(m.error) for m in moments if m.state is State.HANDOVER]
    ages = np.array([m.map_age for m in moments if math.isfinite(m.map_age)])
    nees, nees_in_outages = fused_nees(consumer)
    inside = bool(len(error)) and float(error.max()) <= IN_LANE
    return {
        "seconds": round(world.t, 2),
        "km": (moments[-1].along - moments[0].along) / 1000,
        "cycles": len(moments),
        "sender": sent,
        "receiver": arrived,
        "error of the car [m]": {
            "rms": float(np.sqrt((error**2).mean())) if len(error) else math.nan,
            "95 %": float(np.quantile(error, 0.95)) if len(error) else math.nan,
            "max": float(error.max()) if len(error) else math.nan,
        },
        "share of the time driven by the lines": len(automatic) / len(moments),
        "handovers": len(handovers),
        "reasons of the handovers": dict(Counter(handovers)),
        "largest error in a handover [m]": max(braking, default=0.0),
        "age of the lines, median and 95 % [s]": np.quantile(ages, [0.5, 0.95]).round(3).tolist(),
        FUSED: nees.round(2).tolist(),
        OUTAGE: nees_in_outages.round(2).tolist(),
        "met": inside
        and arrived["lines"] == sent["lines"] > 0
        and arrived["frames"] == sent["frames"]
        and not arrived.get("frames dropped", 0),
    }


def fused_nees(consumer: Consumer) -> tuple[Array, Array]:
    """Return the (3,) mean NEES of the fused lane centre, apart from lane changes.

    Returns:
        Over the drive, and over the outages of the camera; NaN where there is nothing.
    """
    rows, world = np.vstack(consumer.rows), consumer.world
    tracker = maps.LaneTracker(world.map, world.route)
    changes = [(c.start - BESIDE, c.end + BESIDE) for c in world.route.changes]
    squares, is_out = [], []
    for moment in consumer.moments[::EACH]:
        pose = np.array([np.interp(moment.now, rows[:, 0], column) for column in rows[:, 1:4].T])
        lines = tracker.lines(pose).lines
        if any(a <= moment.along <= b for a, b in changes):
            continue
        centre = true_lines(lines, LANE, pose)[:, COLUMNS].mean(axis=0)
        squares.append(((moment.centre[:, 0] - centre) / moment.centre[:, 1]) ** 2)
        is_out.append(CAMERA_OUTAGE[0] <= moment.now % 60 < CAMERA_OUTAGE[1])
    table = np.array(squares).reshape(-1, len(PLACES))
    return mean_of(table), mean_of(table[np.array(is_out, dtype=bool)])


def mean_of(table: Array) -> Array:
    """Return the means of the columns without NaN; NaN where there is nothing else."""
    known = np.isfinite(table)
    total, count = np.where(known, table, 0.0).sum(axis=0), known.sum(axis=0)
    return np.asarray(np.where(count, total / np.maximum(count, 1), np.nan))


def over_seeds(results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the NEES of each of two drives or more, their mean and its standard error."""
    found: dict[str, Any] = {"met": all(result["met"] for result in results)}
    for name, of in (
        (POSE_NEES, [[result["sender"][POSE_NEES]] for result in results]),
        (FUSED, [result[FUSED] for result in results]),
        (OUTAGE, [result[OUTAGE] for result in results]),
    ):
        table = np.array(of, dtype=float)
        mean = mean_of(table)
        known = np.isfinite(table).sum(axis=0)
        error = np.sqrt(mean_of((table - mean) ** 2) / np.maximum(known - 1, 1))
        found[name] = {
            "drives": table.round(2).tolist(),
            "mean": mean.round(2).tolist(),
            "standard error": error.round(2).tolist(),
        }
    return found


def free_port() -> int:
    """Return a free UDP port, so that no other bus of this machine interferes."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.bind(("", 0))
        return int(found.getsockname()[1])


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit status."""
    parser = parser_of(__doc__)
    parser.add_argument("--seconds", type=float, default=600.0, help="600 s by default")
    parser.add_argument("--seed", type=int, default=0, help="of all errors")
    parser.add_argument(
        "--seeds", type=int, default=1, help="number of drives with --simulated, from --seed on"
    )
    parser.add_argument("--interface", default="udp_multicast", help="udp_multicast by default")
    parser.add_argument("--channel", help="such as vcan0")
    parser.add_argument("--dbc", default=DBC, help=f"of the package, {DBC} by default")
    parser.add_argument("--simulated", action="store_true", help="do not wait, and use no bus")
    parser.add_argument("--json", action="store_true", help="print JSON")
    arguments = parser.parse_args(argv)
    if arguments.seeds < 1 or (arguments.seeds > 1 and not arguments.simulated):
        parser.error("--seeds must be 1 or more, and 1 without --simulated")
    bus: dict[str, Any] = {"interface": arguments.interface}
    bus |= {"channel": arguments.channel} if arguments.channel else {}
    bus |= {"port": free_port()} if arguments.interface == "udp_multicast" else {}
    seeds = range(arguments.seed, arguments.seed + arguments.seeds)
    with bar(round(arguments.seconds) * len(seeds), "drive", unit=" s") as shown:
        if arguments.simulated:
            results = [
                simulated(arguments.seconds, seed, arguments.dbc, shown.update) for seed in seeds
            ]
            result = results[0] if len(seeds) == 1 else over_seeds(results)
        else:
            result = on_bus(bus, arguments.seconds, arguments.seed, arguments.dbc, shown.update)
    return report(result | {"processors of this machine": os.cpu_count()}, arguments.json, 44)


if __name__ == "__main__":
    sys.exit(main())
