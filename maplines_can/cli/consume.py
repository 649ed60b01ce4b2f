"""The command ``maplines consume``: what a car does with received lines."""

from __future__ import annotations

import argparse
from typing import Any

from .consume_check import add_check
from .consume_steer import add_steer

#: Functions that add a sub-command.
CONSUMERS = (add_steer, add_check)

DESCRIPTION = """\
Use received lines as a car does, from a bus or from a log:

  steer   follow the ego lane: demanded curvature and speed
  check   compare the lines with those of a camera"""


def add_consume(commands: Any) -> None:
    """Add the command ``consume`` with its sub-commands."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "consume",
        description=DESCRIPTION,
        epilog="example: maplines consume check --log drive.blf --simulate",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    consumers = parser.add_subparsers(title="consumers", required=True, metavar="CONSUMER")
    for add in CONSUMERS:
        add(consumers)
