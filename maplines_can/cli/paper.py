"""The commands about the scenarios of the paper: ``scenarios``, ``claims`` and ``figures``."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from ..simulation.scenarios import SCENARIOS, STREETS, scenario
from .command_line import add_command, add_json, option_group, progress_bar
from .file_arguments import add_force, check_new
from .options import add_dbc, add_draws, codec_from

__all__ = ["add_claims", "add_figures", "add_scenarios"]

CLAIMS = """\
Compare each representation of a line (Gaussians by several transforms, mixtures) with Monte Carlo
samples of the line, before and after it is encoded for the bus."""


def add_scenarios(commands: Any) -> None:
    """Add the command ``scenarios``."""
    description = "List the scenarios that 'send' and 'demo' can send."
    parser = add_command(
        commands, "scenarios", _scenarios, description, "maplines scenarios --json"
    )
    add_json(parser, "the scenarios")


def _scenarios(arguments: argparse.Namespace) -> int:
    if arguments.json:
        rows = [
            {
                "name": each.name,
                "about": each.about,
                "ego_sigma": each.ego.sigma.tolist(),
                "window": each.window,
                "lines": [slot.name for slot in each.lines],
            }
            for each in (SCENARIOS | STREETS).values()
        ]
        print(json.dumps(rows, indent=2))
    else:
        for each in (SCENARIOS | STREETS).values():
            print(f"{each.name:<20}{each.about}")
    return 0


def add_claims(commands: Any) -> None:
    """Add the command ``claims``."""
    example = "maplines claims --scenario street-turn-10deg --format csv > claims.csv"
    parser = add_command(commands, "claims", _claims, CLAIMS, example)
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
    from ..study.representations import accuracy_table, as_csv, as_markdown, as_text

    with progress_bar(" rows") as progress:
        rows = accuracy_table(
            [scenario(name) for name in arguments.scenario or SCENARIOS],
            n=arguments.samples,
            seed=arguments.seed,
            codec=codec_from(arguments.dbc, encoding=arguments.encoding),
            progress=progress,
        )
    writers = {"text": as_text, "csv": as_csv, "markdown": as_markdown}
    print(writers[arguments.format](rows).rstrip("\n"))
    return 0


def add_figures(commands: Any) -> None:
    """Add the command ``figures``."""
    description = "Draw the figures of the paper, before and after the bus, as PNG and SVG."
    example = "maplines figures --out figures"
    parser = add_command(commands, "figures", _figures, description, example)
    option_group(parser, "output").add_argument(
        "--out", required=True, metavar="DIR", help="folder for the figures"
    )
    add_force(parser)
    add_draws(parser, samples=100_000)
    add_dbc(parser)
    add_json(parser, "the paths of the figures")


def _figures(arguments: argparse.Namespace) -> int:
    from ..study.figures.paper import draw_figures, figure_paths

    check_new(arguments, *figure_paths(Path(arguments.out)))
    with progress_bar(" figures") as progress:
        paths = draw_figures(
            Path(arguments.out),
            seed=arguments.seed,
            samples=arguments.samples,
            codec=codec_from(arguments.dbc, encoding=arguments.encoding),
            progress=progress,
        )
    if arguments.json:
        print(json.dumps([str(path) for path in paths], indent=2))
    else:
        print(f"{len(paths)} files in {arguments.out}")
    return 0
