"""The command ``maplines demo``."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from tqdm import tqdm

from ..scenarios import scenario
from ..study.figures.picture import draw_round_trip
from ..study.round_trip import round_trip
from .options import (
    add_bus,
    add_codec,
    add_job,
    add_json,
    add_sending,
    bus_settings,
    keyed_codec,
    map_error,
    seconds,
    sending,
)
from .progress import watched
from .trip_text import trip_text

__all__ = ["add_demo"]

PICTURES = (".png", ".svg", ".pdf")


def add_demo(jobs: Any) -> None:
    """Add the job ``demo`` to those of ``maplines``."""
    parser = add_job(
        jobs,
        "demo",
        _demo,
        "Send the lines of a scene over a bus, receive them, and compare.",
        "maplines demo --scenario street-turn --fd --plot turn.png",
    )
    add_sending(parser)
    add_bus(parser, "virtual")
    add_codec(parser)
    parser.add_argument("--seconds", type=seconds, default=3.0, help="how long [s]")
    parser.add_argument("--plot", metavar="FILE", help="draw the picture: .png, .svg or .pdf")
    add_json(parser)


def _demo(arguments: argparse.Namespace) -> int:
    codec = keyed_codec(arguments)
    scene = scenario(arguments.scenario)
    alone = arguments.interface == "virtual" and arguments.channel is None
    if arguments.plot and Path(arguments.plot).suffix.lower() not in PICTURES:
        raise ValueError(f"{arguments.plot}: a picture is one of {', '.join(PICTURES)}")
    shape = "{l_bar}{bar}| {n:.1f}/{total:.1f} s"
    with tqdm(total=arguments.seconds, bar_format=shape, leave=False, disable=not watched()) as bar:
        trip = round_trip(
            scene,
            codec,
            **sending(arguments),
            map_error=map_error(arguments),
            seconds=arguments.seconds,
            interface=None if alone else bus_settings(arguments),
            faults=arguments.faults,
            tick=lambda elapsed: bar.update(min(elapsed, arguments.seconds) - bar.n),
        )
    if arguments.plot:
        draw_round_trip(trip, scene, arguments.plot)
    if arguments.json:
        print(json.dumps(trip.as_dict(), indent=2))
    else:
        print(trip_text(trip))
        if arguments.plot:
            print(f"\npicture: {arguments.plot}")
    return 0 if all(line.mean for line in trip.lines) else 1
