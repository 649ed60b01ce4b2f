"""The command ``maplines study report``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from ..study.report.page import TITLE, write_report
from .overwriting import add_force, check_new
from .parsing import option_group

__all__ = ["add_report"]


def add_report(jobs: Any) -> argparse.ArgumentParser:
    """Add the job ``report`` to the subparsers of ``maplines study`` and return its parser."""
    about = "Write one HTML file with interactive plots of a sweep's tables."
    parser: argparse.ArgumentParser = jobs.add_parser(
        "report",
        help=about,
        description=f"{about} It includes its scripts, and opens without a network.",
        epilog="example: maplines study report sweep --out report.html",
    )
    parser.add_argument("folder", metavar="DIR", help="the tables of a sweep")
    output = option_group(parser, "output")
    output.add_argument("--out", required=True, metavar="FILE", help="the HTML file")
    output.add_argument("--title", default=TITLE, help="title of the page (default: %(default)s)")
    add_force(parser)
    parser.set_defaults(run=_report)
    return parser


def _report(arguments: argparse.Namespace) -> int:
    check_new(arguments, arguments.out)
    path = write_report(arguments.folder, Path(arguments.out), title=arguments.title)
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB", file=sys.stderr)
    return 0
