"""The command ``maplines study production``."""

from __future__ import annotations

import argparse
import json
from typing import Any

from ..study.production_messages import as_csv, as_markdown, as_records, as_text, production_table
from .parsing import number, option_group

__all__ = ["add_production"]


def add_production(subparsers: Any) -> argparse.ArgumentParser:
    """Add the job ``production`` to the subparsers of ``maplines study`` and return its parser."""
    about = "Print the lateral rounding error of production lane messages and of this project's."
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "production",
        help=about,
        description=about,
        epilog="example: maplines study production --markdown",
    )
    add = option_group(parser, "scenario").add_argument
    add(
        "--n",
        type=number(int, 100, 10**6),
        default=2000,
        metavar="N",
        help="number of lines, 100 or more (default: %(default)s)",
    )
    add(
        "--seed",
        type=number(int, 0, 2**32),
        default=0,
        help="seed of the roads and their errors (default: %(default)s)",
    )
    form = option_group(parser, "output").add_mutually_exclusive_group()
    form.add_argument("--markdown", action="store_true", help="print Markdown tables")
    form.add_argument("--csv", action="store_true", help="print all figures as CSV")
    form.add_argument("--json", action="store_true", help="print all figures as JSON")
    parser.set_defaults(run=_production)
    return parser


def _production(arguments: argparse.Namespace) -> int:
    rows = production_table(arguments.n, arguments.seed)
    if arguments.json:
        print(json.dumps(as_records(rows), indent=2))
    else:
        write = as_markdown if arguments.markdown else as_csv if arguments.csv else as_text
        print(write(rows), end="")
    return 0
