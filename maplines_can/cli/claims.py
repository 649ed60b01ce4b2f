"""The command ``maplines claims``."""

from __future__ import annotations

import argparse
from typing import Any

from ..simulation.scenarios import SCENARIOS, scenario
from ..study.representations import accuracy_table, as_csv, as_markdown, as_text
from .options import add_dbc, add_draws, codec_from
from .parsing import add_command, option_group
from .stderr import progress_bar

__all__ = ["add_claims"]

DESCRIPTION = """\
Compare each representation of a line (Gaussians by several transforms, mixtures) with Monte Carlo
samples of the line, before and after it is encoded for the bus."""


def add_claims(commands: Any) -> None:
    """Add the command ``claims``."""
    parser = add_command(
        commands,
        "claims",
        _claims,
        DESCRIPTION,
        "maplines claims --scenario street-turn-10deg --format csv > claims.csv",
    )
    option_group(parser, "scenario").add_argument(
        "--scenario",
        action="append",
        choices=list(SCENARIOS),
        metavar="NAME",
        help=f"scenario: {', '.join(SCENARIOS)}; can be repeated (default: all)",
    )
    option_group(parser, "output").add_argument(
        "--format",
        choices=["text", "csv", "markdown"],
        default="text",
        help="format of the table (default: text)",
    )
    add_draws(parser, samples=1_000_000)
    add_dbc(parser)


def _claims(arguments: argparse.Namespace) -> int:
    scenarios = [scenario(name) for name in arguments.scenario or SCENARIOS]
    with progress_bar(" rows") as progress:
        rows = accuracy_table(
            scenarios,
            n=arguments.samples,
            seed=arguments.seed,
            codec=codec_from(arguments.dbc, encoding=arguments.encoding),
            progress=progress,
        )
    writers = {"text": as_text, "csv": as_csv, "markdown": as_markdown}
    print(writers[arguments.format](rows).rstrip("\n"))
    return 0
