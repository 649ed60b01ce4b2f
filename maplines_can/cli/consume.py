"""The command ``maplines consume``: what a car does with received lines."""

from __future__ import annotations

import argparse
from typing import Any

from .consume_check import add_check
from .consume_steer import add_steer

#: Functions that add a sub-command, by its name.
CONSUMERS = {"steer": add_steer, "check": add_check}


def add_consume(commands: Any) -> None:
    """Add the command ``consume`` with its sub-commands."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "consume", description="Use received lines as a car does."
    )
    consumers = parser.add_subparsers(title="consumers", required=True, metavar="CONSUMER")
    for add in CONSUMERS.values():
        add(consumers)
