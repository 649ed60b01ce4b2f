"""The command ``maplines study maps``."""

from __future__ import annotations

import argparse
import json
from typing import Any

from ..maps.tour import town_path
from ..study.scenes.map_scenes import drawn_scenes, maps_of
from ..study.scenes.sigma_ratios import of_carriers, ratios_text
from .parsing import add_json, number, option_group
from .stderr import Bar, progress_bar

__all__ = ["add_maps"]

ABOUT = """\
Send scenes around random poses on maps, and of random roads, by all records with the pose error:
how many lines do not fit, and why, and how much less certain a receiver is than the sender.

Each scene has the lines of the ego lane and of its neighbours. Poses have errors like that of a
production car and of a poor one in turn; the map is exact, has errors of its points, or drifts,
too.
"""


def add_maps(commands: Any, bar: Bar = progress_bar) -> argparse.ArgumentParser:
    """Add the command ``maps`` to those of ``maplines study``; returns its parser.

    Args:
        commands: subparsers, as returned by ``ArgumentParser.add_subparsers``.
        bar: progress bar.
    """
    parser: argparse.ArgumentParser = commands.add_parser(
        "maps",
        help="Compare the records of scenes on your maps.",
        description=ABOUT,
        epilog="example: maplines study maps my.xodr other.osm --n 300",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "maps",
        nargs="*",
        metavar="FILE",
        help="maps, as 'maplines map' reads them (default: the town of this package)",
    )
    scenario = option_group(parser, "scenario").add_argument
    scenario(
        "--n",
        type=number(int, 1, 10**6),
        default=120,
        metavar="N",
        help="scenes of each map, and of random roads (default: 120)",
    )
    scenario("--seed", type=number(int, 0, 2**32), default=0, help="seed (default: 0)")
    add_json(parser, "all figures")
    parser.set_defaults(run=lambda arguments: _run(arguments, bar))
    return parser


def _run(arguments: argparse.Namespace, bar: Bar) -> int:
    maps = maps_of(arguments.maps or [town_path()])
    drawn = list(drawn_scenes(maps, arguments.n, arguments.seed))
    with bar(" kinds of records") as update:
        found = of_carriers(drawn, update)
    if arguments.json:
        figures = {
            carrier: {name: ratios.as_dict() for name, ratios in of_maps.items()}
            for carrier, of_maps in found.items()
        }
        print(json.dumps(figures, indent=2))
    else:
        print(ratios_text(found))
    return 0
