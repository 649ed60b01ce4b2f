"""The command ``maplines send``."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from typing import Any

from ..bus import Link, Transmitter
from ..scenarios import scenario
from .options import (
    add_bus,
    add_codec,
    add_faults,
    add_json,
    bus_settings,
    fault_counts,
    fault_opener,
    keyed_codec,
)
from .output import faults_text, slot_text
from .parsing import add_command, natural
from .sending import add_sending, components_text, frame_format_text, lines_of
from .stderr import note

DESCRIPTION = """\
Send the lines of a scene until Ctrl-C, each as a Gaussian over its lateral offset, heading,
curvature and curvature rate. Then print the counters."""


def add_send(commands: Any) -> None:
    """Add the command ``send``."""
    example = "maplines send --interface socketcan --channel vcan0 --rate 50"
    parser = add_command(commands, "send", _send, DESCRIPTION, example)
    add_sending(parser)
    add_bus(parser)
    add_codec(parser)
    parser.add_argument(
        "--count",
        type=natural,
        metavar="N",
        help="stop after sending each line N times (default: send until Ctrl-C)",
    )
    add_faults(parser)
    add_json(parser, "the counters")


def _send(arguments: argparse.Namespace) -> int:
    codec = keyed_codec(arguments)
    lines, components = lines_of(scenario(arguments.scenario), codec, arguments)
    opener = fault_opener(arguments)
    with Link(opener, **bus_settings(arguments)) as link:
        transmitter = Transmitter(
            link, codec, period=1 / arguments.rate, fd=arguments.fd, count=arguments.count
        )
        try:
            with transmitter:
                transmitter.publish(lines)
                if not arguments.json:
                    until = f"{arguments.count} times" if arguments.count else "until Ctrl-C"
                    frame_format = frame_format_text(codec, fd=arguments.fd)
                    note(
                        f"{len(lines)} lines of {arguments.scenario} on {link.name}, "
                        f"{frame_format}, {arguments.rate:g} Hz, {until}"
                    )
                    if arguments.components != 1:
                        for line in components:
                            note(f"{slot_text(line.slot)}: {components_text(line)}")
                transmitter.wait()
        except KeyboardInterrupt:
            pass
        stats, faults = transmitter.stats(), fault_counts(opener)
        if arguments.json:
            rest = {"lateness": stats.lateness._asdict(), "outages": link.outages}
            rest["components"] = [asdict(line) for line in components]
            rest |= {"faults": faults} if faults else {}
            print(json.dumps(stats._asdict() | rest))
        else:
            print(
                f"sent {stats.lines} lines in {stats.frames} frames; {stats.down} lines given up "
                f"while the interface was down, {stats.full} with a full queue; "
                f"{stats.overruns} periods skipped because the sender was late"
            )
            if faults:
                print(f"faults: {faults_text(faults)}")
            lateness = ", ".join(f"{1e3 * value:.2f}" for value in stats.lateness)
            print(f"late by {lateness} ms (median, 99 %, maximum)")
        return 0
