"""The command ``maplines send``."""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

from ..bus import Link, Transmitter, TransmitterStats
from ..bus.schedule import Schedule
from ..simulation.scenario_lines import AMPLITUDE, SINE_PERIOD, SPEED, weaving_ego
from ..values.arrays import count_text
from ..wire import LineCodec
from .command_line import add_command, add_json, natural, note, option_group
from .options import (
    add_bus,
    add_codec,
    add_faults,
    bus_settings,
    fault_counts,
    fault_opener,
    keyed_codec,
)
from .output import faults_text, left_out_text, pose_errors_text, slot_text
from .sending import Sending, add_sending, components_dict, components_text, sending_of

#: Bounds of the rate at which lines are computed [1/s]. With a lower --rate they would become too
#: old; with a higher one they are sent several times with a growing age.
MIN_RATE, MAX_RATE = 20.0, 50.0

DESCRIPTION = f"""\
Send the lines of a scenario until Ctrl-C, each as a Gaussian over its lateral offset, heading,
curvature and curvature rate. Then print the counters.

The car drives along the road of the scenario at {SPEED:g} m/s and weaves within its lane: its
lateral offset is a sine with an amplitude of {AMPLITUDE:g} m and a period of {SINE_PERIOD:g} s.
The lines are computed from each new pose, at --rate, but at least {MIN_RATE:g} and at most
{MAX_RATE:g} times a second."""


def add_send(commands: Any) -> None:
    """Add the command ``send``."""
    example = "maplines send --interface socketcan --channel vcan0 --rate 50"
    parser = add_command(commands, "send", _send, DESCRIPTION, example)
    add_sending(parser)
    add_bus(parser)
    add_codec(parser)
    option_group(parser, "bus").add_argument(
        "--count",
        type=natural,
        metavar="N",
        help="stop after sending each line N times (default: send until Ctrl-C)",
    )
    option_group(parser, "scenario").add_argument(
        "--standstill",
        action="store_true",
        help="keep the car at the pose of the scenario: only the age of the lines changes",
    )
    add_faults(parser)
    add_json(parser, "the counters")


def _send(arguments: argparse.Namespace) -> int:
    codec = keyed_codec(arguments)
    sending = sending_of(codec, arguments)
    opener, period = fault_opener(arguments), 1 / sending.bus.rate
    with Link(opener, **bus_settings(arguments)) as link:
        transmitter = Transmitter(
            link, codec, period=period, fd=arguments.fd, count=arguments.count
        )
        try:
            with transmitter:
                if not arguments.json:
                    _note_start(sending, codec, link, arguments)
                _publish(transmitter, sending, moves=not arguments.standstill)
        except KeyboardInterrupt:
            pass
        stats, faults = transmitter.stats(), fault_counts(opener)
        if arguments.json:
            rest = {"outages": link.outages, "components": components_dict(sending.components)}
            rest |= {"faults": faults} if faults else {}
            print(json.dumps(stats.as_dict() | rest))
        else:
            print(_text(stats, faults))
        return 0


def _note_start(
    sending: Sending, codec: LineCodec, link: Link, arguments: argparse.Namespace
) -> None:
    """Print what is about to be sent."""
    until = count_text(arguments.count, "time") if arguments.count else "until Ctrl-C"
    authenticated = ", authenticated" if codec.authenticator else ""
    note(
        f"{count_text(len(sending.each_line), 'line')} of {arguments.scenario}"
        f"{' and their pose error' * sending.is_scene} on {link.name}, "
        f"{'CAN FD' if arguments.fd else 'classic CAN'}{authenticated}, "
        f"{sending.bus.rate:g} Hz, {until}"
    )
    if arguments.components != 1:
        for line in sending.each_line:
            text = components_text(sending.components[line.slot])
            note(f"{slot_text(line.slot.name)}: {text}")
    if left_out := sending.left_out(codec):
        note(left_out_text(left_out))


def _text(stats: TransmitterStats, faults: dict[str, int]) -> str:
    """Return the counters as text."""
    rows = [
        f"sent {count_text(stats.lines, 'line')}{pose_errors_text(stats.pose_errors)} in "
        f"{count_text(stats.frames, 'frame')}; "
        f"{count_text(stats.down, 'line')} given up while the interface was down, "
        f"{stats.full} with a full queue; "
        f"{count_text(stats.overruns, 'period')} skipped because the sender was late"
    ]
    if stats.left_out:
        reasons = "; ".join(
            f"{count_text(n, 'time')}, {reason}" for reason, n in stats.left_out.items()
        )
        rows.append(f"lines left out of those published: {reasons}")
    if faults:
        rows.append(f"faults: {faults_text(faults)}")
    lateness = ", ".join(f"{1e3 * value:.2f}" for value in stats.lateness)
    return "\n".join([*rows, f"late by {lateness} ms (median, 99 %, maximum)"])


def _publish(transmitter: Transmitter, sending: Sending, *, moves: bool) -> None:
    """Publish the lines of the moving car until the transmitter ends."""
    start = time.monotonic()
    rate = min(max(sending.bus.rate, MIN_RATE), MAX_RATE)
    schedule: Schedule[str] = Schedule(1 / rate)
    schedule.add("pose", 0.0, start)
    lines, source, pause = sending.lines, sending.source, 0.0
    while not transmitter.wait(pause):
        now, t_pose_ns = time.monotonic(), time.time_ns()
        if schedule.take(now):
            if moves:
                lines = source.seen_from(weaving_ego(source.scenario, now - start))
            transmitter.publish(lines, t_pose_ns)
        after = time.monotonic()
        # At least half of the time is left to the transmitter's thread.
        pause = max(schedule.wait(after) or 0.0, after - now)
