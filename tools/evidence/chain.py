"""The whole chain at once: a car drives through the town by lines that it receives.

    car -> GNSS, odometry, camera, landmarks -> Localisation -> map_scene -> Transmitter
     ^                                                                           |
     |                                                                          bus
     |                                                                           v
     +--- LaneSteering <- LaneFusion <- Receiver, odometry and a second camera --+

The sender gets the true motion of the car, which its simulated sensors measure. The camera of the
fusion fails for 10 s in each minute. The map has no error. The car steers by the fused lane, in
lane changes by the received line of the route. After a handover it stops; then a driver brings it
back to the lane, and lets it drive again.

The error is the lateral distance of the rear axle from the middle of the lane. NEES is the squared
error in units of the variance, for each degree of freedom. One drive is one draw of errors that
last, so it scatters about 1. Lost is what was sent, less what was received. A line that the sender
has to skip, since it is late or was retracted, is not sent, but leaves a gap in the counters.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import socket
import time
from collections import Counter, deque
from collections.abc import Collection, Iterator, Mapping
from itertools import pairwise
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from answers import lines_of

from maplines_can import Codec, Link, Receiver, Transmitter
from maplines_can.consumers.steering import SteeringState
from maplines_can.maps import LaneTracker
from maplines_can.simulation.camera import COLUMNS, LANE, PLACES
from maplines_can.simulation.car_stream import AGE, FRAME
from maplines_can.simulation.truth import true_lines
from maplines_can.wire import POSE, Frame, default_dbc_path

from .chain_parts import CAMERA_OUTAGE, Array, Consumer, Sender, World
from .closed_loop import BESIDE_CHANGE, MARGIN, PERIOD, STEP
from .figures import flat
from .harness import bar, evidence

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
FUSED = "NEES of the fused lane"


@evidence(seconds=2.0)
def simulated(
    seconds: float = 600.0, seeds: int = 1, dbc: str = DBC, seed: int = 0
) -> dict[str, Any]:
    """Drive without waiting and without a bus, with other errors for each seed."""
    drives = {}
    with bar(round(seconds) * seeds, "drive", unit=" s") as shown:
        for number in range(seed, seed + seeds):
            drives[f"seed {number}"] = drive_of(seconds, number, dbc, shown)
    if seeds == 1:
        return drives[f"seed {seed}"]
    return drives | {"all": means_of([*drives.values()])}


def means_of(drives: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the mean of each number over drives, and its standard error."""
    tables = [dict(flat(one)) for one in drives]
    found = {}
    for name, value in tables[0].items():
        if isinstance(value, float):
            values = np.array([table.get(name, math.nan) for table in tables])
            values = values[np.isfinite(values)]
            if len(values) > 1:
                error = values.std(ddof=1) / math.sqrt(len(values))
                found[name] = {"mean": float(values.mean()), "standard error": float(error)}
    return found


def drive_of(seconds: float, seed: int, dbc: str, shown: Any) -> dict[str, Any]:
    """Return the figures of a simulated drive."""
    world = World(seed)
    sender, codec = Sender(seed, world.row), Codec.from_dbc(default_dbc_path(dbc))
    encoder = codec.encoder()
    decoder = codec.decoder()
    consumer = Consumer(world, decoder)
    rows, lines, received, frames = world.row[None], 0, 0, 0
    on_the_way: deque[tuple[int, Frame]] = deque()

    def deliver(now_ns: float) -> int:
        """Deliver the frames until now; return the number of lines."""
        found = 0
        while on_the_way and on_the_way[0][0] <= now_ns:
            ns, frame = on_the_way.popleft()
            found += len(lines_of(decoder.feed(frame.can_id, frame.data, ns)))
        return found

    while world.t < seconds - STEP / 2 and not is_at_goal(world):
        sender.move(rows)
        scene = sender.cycle(rows[-1]).scene
        if scene is not None and scene.lines:
            encoded = encoder.encode_scene(scene, age=AGE)
            lines += len(encoded.keys() - {POSE})
            frames += sum(map(len, encoded.values()))
            on_the_way += spread(encoded.values(), world.t + AGE)
        received += deliver(1e9 * (world.t + LATENCY))
        before = consumer.demands
        consumer.step(0, round(1e9 * (world.t + LATENCY)))
        rows = consumer.drive(before, LATENCY)
        shown.update(PERIOD)
    received += deliver(math.inf)
    sent = {"lines": lines, "frames": frames, "cycles skipped": 0} | sender.figures()
    arrived = {"lines": received, "frames": frames, "frames dropped": 0}
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
        transmitter = Transmitter(link, Codec.from_dbc(default_dbc_path(dbc)), period=PERIOD)
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


@evidence(in_real_time=True)
def real_time(
    seconds: float = 600.0,
    interface: str = "udp_multicast",
    channel: str = "",
    dbc: str = DBC,
    seed: int = 0,
) -> dict[str, Any]:
    """Drive in real time on a bus, with the sender in a process of its own.

    The shares of a core are those of the threads that do the work, with the simulation apart. A
    cycle is skipped if the process is late by a period.

    Args:
        seconds: of the drive [s].
        interface: of python-can.
        channel: such as vcan0.
        dbc: of the package.
        seed: of all errors.
    """
    bus: dict[str, Any] = {"interface": interface}
    bus |= {"channel": channel} if channel else {}
    bus |= {"port": free_port()} if interface == "udp_multicast" else {}
    world = World(seed)
    process, pipe = started(bus, dbc, seed, world.row)
    decoder = Codec.from_dbc(default_dbc_path(dbc)).decoder()
    with (
        Link(**bus) as link,
        Receiver(link, decoder, on_line=lambda _: None) as receiver,
        bar(round(seconds), "drive", unit=" s") as shown,
    ):
        consumer, before = Consumer(world, receiver), time.process_time()
        skipped = drive_in_real_time(consumer, pipe, seconds, shown)
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
        "gaps of the counters": stats.lost,
        "frames dropped": sum(stats.counts.values()),
        "cycles skipped": skipped,
    }
    shares = shares_of(sent.pop("CPU"), dict(consumer.cpu) | {"all": used}, world.t)
    return figures_of(consumer, sent, arrived) | {
        "share of a core": shares,
        "processors of this machine": os.cpu_count(),
    }


def started(
    bus: Mapping[str, Any], dbc: str, seed: int, start: Array
) -> tuple[multiprocessing.process.BaseProcess, Connection]:
    """Return the process of the sender when it is ready, and the pipe to it."""
    context = multiprocessing.get_context("spawn")
    pipe, other = context.Pipe()
    process = context.Process(target=send, args=(other, dict(bus), dbc, seed, start), daemon=True)
    process.start()
    other.close()
    if not pipe.poll(START):
        raise RuntimeError(f"the sender did not start within {START:g} s")
    pipe.recv()
    return process, pipe


def drive_in_real_time(consumer: Consumer, pipe: Connection, seconds: float, shown: Any) -> int:
    """Drive up to a time [s], with the motion to the pipe; return the cycles skipped."""
    world, skipped = consumer.world, 0
    start, start_ns = time.monotonic(), time.time_ns()
    pipe.send(start_ns)
    rows = world.row[None]
    while world.t < seconds - STEP / 2 and not is_at_goal(world):
        due = start + world.t
        time.sleep(max(due - time.monotonic(), 0.0))
        pipe.send(rows)
        shown.update(PERIOD)
        if time.monotonic() - due >= PERIOD:
            skipped += 1
            rows = consumer.drive(consumer.demands, 0.0)
            continue
        demands = consumer.demands
        consumer.step(start_ns, time.time_ns())
        latency = STEP * math.ceil((time.monotonic() - due) / STEP)
        rows = consumer.drive(demands, min(latency, PERIOD))
    return skipped


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
    automatic = [m for m in moments if m.state is not SteeringState.HANDOVER]
    error = np.abs([m.error for m in automatic])
    handovers = [
        now.reason
        for before, now in pairwise(moments)
        if now.state is SteeringState.HANDOVER and before.state is not SteeringState.HANDOVER
    ]
    braking = [abs(m.error) for m in moments if m.state is SteeringState.HANDOVER]
    ages = np.array([m.map_age for m in moments if math.isfinite(m.map_age)])
    return {
        "seconds": round(world.t, 2),
        "km": (moments[-1].along - moments[0].along) / 1000,
        "cycles": len(moments),
        "sender": sent,
        "receiver": arrived,
        "lines lost": sent["lines"] - arrived["lines"],
        "frames lost": sent["frames"] - arrived["frames"],
        "error of the car [m]": {
            "rms": float(np.sqrt((error**2).mean())) if len(error) else math.nan,
            "95 %": float(np.quantile(error, 0.95)) if len(error) else math.nan,
            "max": float(error.max()) if len(error) else math.nan,
        },
        "share of the time driven by the lines": len(automatic) / len(moments),
        "handovers": len(handovers),
        "reasons of the handovers": dict(Counter(handovers)),
        "largest error in a handover [m]": max(braking, default=0.0),
        "age of the lines [s]": {
            "median": float(np.median(ages)),
            "95 %": float(np.quantile(ages, 0.95)),
        },
        **fused_nees(consumer),
    }


def fused_nees(consumer: Consumer) -> dict[str, dict[str, float]]:
    """Return the mean NEES of the fused lane centre, apart from lane changes.

    That while the camera fails is apart from the one over the whole drive.
    """
    rows, world = np.vstack(consumer.rows), consumer.world
    tracker = LaneTracker(world.map, world.route)
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
    table, out = np.array(squares).reshape(-1, len(PLACES)), np.array(is_out, dtype=bool)
    return {
        name: {
            f"{x:g} m": float(np.mean(known))
            for x, column in zip(PLACES, table[rows].T, strict=True)
            if len(known := column[np.isfinite(column)])
        }
        for name, rows in ((FUSED, slice(None)), (f"{FUSED}, camera failed", out))
    }


def free_port() -> int:
    """Return a free UDP port, so that no other bus of this machine interferes."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.bind(("", 0))
        return int(found.getsockname()[1])
