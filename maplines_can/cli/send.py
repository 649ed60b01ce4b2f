"""The command ``maplines send``."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from typing import Any

from ..bus import Link, Transmitter
from ..scenarios import scenario
from .listing import slot_text
from .options import (
    add_bus,
    add_codec,
    add_job,
    add_json,
    add_sending,
    bus_settings,
    fault_counts,
    fault_opener,
    keyed_codec,
    map_error,
    natural,
    sending,
)
from .progress import note
from .sending import carrier_text, choose_components, scene_lines
from .trip_text import components_text, faults_text

__all__ = ["add_send"]


def add_send(jobs: Any) -> None:
    """Add the job ``send`` to those of ``maplines``."""
    parser = add_job(
        jobs,
        "send",
        _send,
        "Send the lines of a scene until Ctrl-C.",
        "maplines send --interface socketcan --channel vcan0 --rate 50",
    )
    add_sending(parser)
    add_bus(parser)
    add_codec(parser)
    parser.add_argument("--count", type=natural, help="send each line so many times, then end")
    add_json(parser)


def _send(arguments: argparse.Namespace) -> int:
    codec = keyed_codec(arguments)
    scene = scenario(arguments.scenario)
    parts = choose_components(scene, codec, **sending(arguments))
    lines = scene_lines(
        scene,
        arguments.lines,
        components=[line.parts for line in parts],
        map_error=map_error(arguments),
    )
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
                    carrier = carrier_text(codec, fd=arguments.fd)
                    note(
                        f"{len(lines)} lines of {arguments.scenario} on {link.name}, {carrier}, "
                        f"{arguments.rate:g} Hz, {until}"
                    )
                    for line in parts:
                        note(f"{slot_text(line.slot)}: {components_text(line)}")
                transmitter.wait()
        except KeyboardInterrupt:
            pass
        stats, faults = transmitter.stats(), fault_counts(opener)
        if arguments.json:
            rest = {"lateness": stats.lateness._asdict(), "outages": link.outages}
            rest["parts"] = [asdict(line) for line in parts]
            rest |= {"faults": faults} if faults else {}
            print(json.dumps(stats._asdict() | rest))
        else:
            print(
                f"sent {stats.lines} lines in {stats.frames} frames; {stats.down} lines given up "
                f"while the interface was down, {stats.full} with a full queue, "
                f"{stats.overruns} periods overrun"
            )
            if faults:
                print(f"faults: {faults_text(faults)}")
            lateness = ", ".join(f"{1e3 * value:.2f}" for value in stats.lateness)
            print(f"late by {lateness} ms (median, 99 %, most)")
        return 0
