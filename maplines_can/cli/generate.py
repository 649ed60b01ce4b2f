"""The command ``maplines generate``: one subcommand for what it writes."""

from __future__ import annotations

import argparse
from importlib import import_module
from typing import Any

#: What is generated: module in this package, and one line of help. The module adds subcommand X
#: with its function ``add_X``.
GENERATORS = {
    "c": ("generate_c", "the C core with the tables of a DBC: a sender and a receiver in an ECU"),
    "fmu": ("generate_fmu", "a receiver or a sender as an FMU, for simulators"),
    "vectors": ("generate_vectors", "frames and the lines that they are, for any other receiver"),
}

DESCRIPTION = "Generate from a DBC what an ECU needs: one subcommand for each."


def add_generate(commands: Any) -> None:
    """Add the command ``generate`` with its subcommands."""
    rows = "".join(f"\n  {name:<9}{text}" for name, (_, text) in GENERATORS.items())
    parser = commands.add_parser(
        "generate",
        description=f"{DESCRIPTION}\n\nwhat:{rows}",
        epilog="example: maplines generate c --dbc maplines.dbc --out ecu",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    what = parser.add_subparsers(required=True, metavar="WHAT")
    for name, (module, _) in GENERATORS.items():
        getattr(import_module(f".{module}", __package__), f"add_{name}")(what)
