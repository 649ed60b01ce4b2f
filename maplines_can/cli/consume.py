"""The command ``maplines consume``: one subcommand for each consumer."""

from __future__ import annotations

import argparse
from importlib import import_module
from typing import Any

#: Consumers: module in this package, and one line of help. The module adds subcommand X with its
#: function ``add_X``.
CONSUMERS = {
    "fusion": ("consume_fusion", "fuse received scenes and camera lines into the ego lane"),
    "steer": ("consume_steer", "follow the ego lane: demanded curvature and speed"),
    "check": ("consume_check", "compare the lines with those of a camera"),
}

DESCRIPTION = "Use the received lines as a car does: one subcommand for each consumer."


def add_consume(commands: Any) -> None:
    """Add the command ``consume`` with its subcommands."""
    rows = "".join(f"\n  {name:<8}{text}" for name, (_, text) in CONSUMERS.items())
    parser = commands.add_parser(
        "consume",
        description=f"{DESCRIPTION}\n\nconsumers:{rows}",
        epilog="example: maplines consume fusion --simulate --seconds 10",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    consumers = parser.add_subparsers(required=True, metavar="CONSUMER")
    for name, (module, _) in CONSUMERS.items():
        getattr(import_module(f".{module}", __package__), f"add_{name}")(consumers)
