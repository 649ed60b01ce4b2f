"""The subcommand ``maplines generate fmu``."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from ..wire import SHIPPED
from .options import layout_from
from .overwriting import add_force, check_new
from .parsing import add_json, option_group

__all__ = ["add_fmu"]

ABOUT = """\
Generate a node on a CAN bus as an FMU, for simulators and test benches: FMI 3.0 co-simulation with
the layered standard FMI-LS-BUS 1.0 for CAN, on the level of frames ("low cut").

  receiver   takes frames; gives the mean and the covariance of the line of each slot, its lateral
             position and standard deviation at some x, age and E2E state, and the lane with width
             and centre
  sender     takes lines with their covariances; gives frames at their deadlines, as "maplines send"

The archive has the sources in C, what builds them, and a binary for each platform that a compiler
is here for: that of this machine, and Windows with MinGW (x86_64-w64-mingw32-gcc). docs/fmu.md
lists the variables.

The headers of FMI come from fmpy, which is in the extra "fmi": pip install ".[fmi]"
"""
EXAMPLES = """\
examples:
  maplines generate fmu receiver
  maplines generate fmu sender
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
    option_group(parser, "output").add_argument(
        "--out", metavar="FILE", help="name of the FMU (default: maplines_NODE.fmu)"
    )
    add_force(parser)
    add_json(parser, "the name of the FMU, its platforms and the number of its variables")
    parser.set_defaults(run=_run)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    from ..generation.fmu import fmu_of, written

    path = Path(arguments.out or f"maplines_{arguments.node}.fmu")
    check_new(arguments, path)
    fmu = fmu_of(arguments.node, layout_from(arguments.dbc))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(written(fmu))
    figures = {
        "file": str(path),
        "platforms": list(fmu.platforms),
        "variables": len(fmu.variables),
    }
    if arguments.json:
        print(json.dumps(figures, indent=2))
    else:
        platforms = ", ".join(fmu.platforms) or "none: there is no C compiler here"
        print(f"{path}\nbinaries for {platforms}")
    return 0
