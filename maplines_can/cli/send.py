"""The command ``maplines send``."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping
from typing import Any

from ..bus import Link, Transmitter
from ..bus.schedule import Schedule
from ..simulation.scenarios import Scenario, scenario
from ..values.line import MapLineList, Slot
from ..values.scene import Scene
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
from .parsing import add_command, add_json, natural, option_group
from .scene_sending import left_out_of, sends_scenes
from .sending import (
    AMPLITUDE,
    SINE_PERIOD,
    SPEED,
    LineComponents,
    add_sending,
    components_dict,
    components_of,
    components_text,
    frame_format_text,
    lines_of,
    rate_of,
    single_lines,
    weaving_ego,
)
from .stderr import note

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
    sent = scenario(arguments.scenario)
    rate = rate_of(sent, codec, arguments)
    components = components_of(sent, codec, arguments, rate)
    as_scene = sends_scenes(codec, arguments)
    lines = lines_of(sent, components, arguments, as_scene=as_scene)
    opener = fault_opener(arguments)
    with Link(opener, **bus_settings(arguments)) as link:
        transmitter = Transmitter(
            link, codec, period=1 / rate, fd=arguments.fd, count=arguments.count
        )
        try:
            with transmitter:
                if not arguments.json:
                    until = f"{arguments.count} times" if arguments.count else "until Ctrl-C"
                    frame_format = frame_format_text(codec, fd=arguments.fd)
                    note(
                        f"{len(single_lines(lines))} lines of {arguments.scenario}"
                        f"{' and their pose error' * as_scene} on {link.name}, "
                        f"{frame_format}, {rate:g} Hz, {until}"
                    )
                    if arguments.components != 1:
                        for line in single_lines(lines):
                            text = components_text(components[line.slot])
                            note(f"{slot_text(line.slot.name)}: {text}")
                    if left_out := left_out_of(codec, lines, fd=arguments.fd):
                        note(left_out_text(left_out))
                _publish(transmitter, lines, sent, components, arguments, rate)
        except KeyboardInterrupt:
            pass
        stats, faults = transmitter.stats(), fault_counts(opener)
        if arguments.json:
            rest = {"outages": link.outages, "components": components_dict(components)}
            rest |= {"faults": faults} if faults else {}
            print(json.dumps(stats.as_dict() | rest))
        else:
            poses = pose_errors_text(stats.pose_errors)
            print(
                f"sent {stats.lines} lines{poses} in {stats.frames} frames; "
                f"{stats.down} lines given up while the interface was down, "
                f"{stats.full} with a full queue; "
                f"{stats.overruns} periods skipped because the sender was late"
            )
            if stats.left_out:
                reasons = "; ".join(f"{n} times, {reason}" for reason, n in stats.left_out.items())
                print(f"lines left out of those published: {reasons}")
            if faults:
                print(f"faults: {faults_text(faults)}")
            lateness = ", ".join(f"{1e3 * value:.2f}" for value in stats.lateness)
            print(f"late by {lateness} ms (median, 99 %, maximum)")
        return 0


def _publish(
    transmitter: Transmitter,
    lines: MapLineList | Scene,
    scenario: Scenario,
    components: Mapping[Slot, LineComponents],
    arguments: argparse.Namespace,
    rate: float,
) -> None:
    """Publish the lines of the moving car until the transmitter ends."""
    start = time.monotonic()
    schedule: Schedule[str] = Schedule(1 / min(max(rate, MIN_RATE), MAX_RATE))
    schedule.add("pose", 0.0, start)
    pause = 0.0
    as_scene = isinstance(lines, Scene)
    while not transmitter.wait(pause):
        now, t_pose_ns = time.monotonic(), time.time_ns()
        if schedule.take(now):
            if not arguments.standstill:
                ego = weaving_ego(scenario, now - start)
                lines = lines_of(scenario, components, arguments, ego, as_scene=as_scene)
            transmitter.publish(lines, t_pose_ns)
        after = time.monotonic()
        # At least half of the time is left to the transmitter's thread.
        pause = max(schedule.wait(after) or 0.0, after - now)
