"""The subcommand ``maplines generate fmu``."""

from __future__ import annotations

import argparse
import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..maps import town_path
from ..propagation import MapError
from ..values.line import Slot
from ..values.output_files import whole_file
from ..wire import SHIPPED
from .options import add_encoding, layout_from
from .overwriting import add_force, check_new
from .parsing import add_json, number, option_group
from .sending import add_map_error, map_error_of
from .ways import add_route, add_view, map_of, route_of

if TYPE_CHECKING:
    from ..generation.fmu import SentRoute
    from ..wire.layout.message_layout import Layout

__all__ = ["add_fmu"]

ABOUT = """\
Generate a node on a CAN bus as an FMU, for simulators and test benches: FMI 3.0 co-simulation with
the layered standard FMI-LS-BUS 1.0 for CAN, on the level of frames ("low cut").

  receiver   takes frames; gives the mean and the covariance of the line of each slot, its lateral
             position and standard deviation at some x, age and E2E state, and the lane with width
             and centre
  sender     takes lines with their covariances; gives frames at their deadlines, as "maplines send"
  sender --map
             takes a pose with its covariance, and computes from it the lines of the map along a
             route, which is chosen here: that of "maplines drive", or --route

The archive has the sources in C, what builds them, and a binary for each platform that a compiler
is here for: that of this machine, and Windows with MinGW (x86_64-w64-mingw32-gcc). docs/fmu.md
lists the variables.

The headers of FMI come from fmpy, which is in the extra "fmi": pip install ".[fmi]"
"""
EXAMPLES = """\
examples:
  maplines generate fmu receiver
  maplines generate fmu sender
  maplines generate fmu sender --map town.xodr --route 1..7
  maplines generate fmu receiver --dbc maplines-pose.dbc --out lane.fmu --force
  fmpy validate maplines_receiver.fmu
"""
NODES = ("receiver", "sender")


def add_fmu(subparsers: Any) -> argparse.ArgumentParser:
    """Add the subcommand ``fmu`` to those of ``maplines generate`` and return its parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "fmu",
        description=ABOUT,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("node", choices=NODES, metavar="NODE", help=", ".join(NODES))
    option_group(parser, "message").add_argument(
        "--dbc",
        default=SHIPPED[0],
        metavar="FILE",
        help=f"DBC of the messages, yours or one of {', '.join(SHIPPED)} (default: maplines.dbc)",
    )
    add_encoding(parser)
    scenario = option_group(parser, "scenario")
    scenario.add_argument(
        "--map",
        nargs="?",
        const=str(town_path()),
        metavar="FILE",
        help="map of a sender; without a file, the town of this package",
    )
    add_route(scenario)
    add_view(scenario)
    add_map_error(scenario)
    scenario.add_argument(
        "--seed",
        type=number(int, 0, 2**32),
        default=0,
        help="seed of a route chosen at random, on other maps than the town (default: 0)",
    )
    option_group(parser, "output").add_argument(
        "--out",
        metavar="FILE",
        help="name of the FMU (default: maplines_NODE.fmu; with --map, maplines_map_sender.fmu)",
    )
    add_force(parser)
    add_json(parser, "the name of the FMU, its platforms and the number of its variables")
    parser.set_defaults(run=partial(_run, parser))
    return parser


def _run(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> int:
    from ..generation.fmu import fmu_of, written

    _check_options(parser, arguments)
    kind = arguments.node if arguments.map is None else f"map_{arguments.node}"
    path = Path(arguments.out or f"maplines_{kind}.fmu")
    check_new(arguments, path)
    layout = layout_from(arguments.dbc, arguments.encoding)
    route = None if arguments.map is None else _route(arguments, layout)
    fmu = fmu_of(arguments.node, layout, route)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as part:
        part.write_bytes(written(fmu))
    figures = {
        "file": str(path),
        "platforms": list(fmu.platforms),
        "variables": len(fmu.variables),
    }
    if route is not None:
        figures |= {
            "route_m": round(route.lines.path.length, 3),
            "sections": len(route.lines.starts),
        }
    if arguments.json:
        print(json.dumps(figures, indent=2))
    else:
        platforms = ", ".join(fmu.platforms) or "none: there is no C compiler here"
        print(f"{path}\nbinaries for {platforms}")
        if route is not None:
            length = 1e-3 * route.lines.path.length
            print(
                f"lines of {route.name} along {length:.2f} km, {len(route.lines.starts)} sections"
            )
    return 0


def _check_options(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """Check that the options of a map come with one.

    Raises:
        ValueError: they do not.
    """
    if arguments.map is not None and arguments.node != "sender":
        raise ValueError("--map is of a sender: a receiver takes frames, and needs no map")
    for name in ("route", "lines", "window", "map_error", "max_sigma", "seed"):
        if arguments.map is None and getattr(arguments, name) != parser.get_default(name):
            option = "--" + name.replace("_", "-")
            raise ValueError(f"{option} is of a sender with a map; add --map FILE")


def _route(arguments: argparse.Namespace, layout: Layout) -> SentRoute:
    """Return the lines along a route that the options ask for."""
    from ..generation.fmu import SentRoute

    road_map = map_of(arguments.map)
    return SentRoute(
        road_map.name,
        road_map.along(route_of(road_map, arguments)),
        [slot for slot in tuple(Slot)[: arguments.lines] if slot in layout.messages],
        tuple(arguments.window),
        map_error_of(arguments) or MapError(),
        arguments.max_sigma,
    )
