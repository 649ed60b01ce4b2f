"""The command ``maplines figures``."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from ..study.figures.paper import draw_figures, figure_paths
from .options import add_dbc, add_draws, codec_from
from .overwriting import add_force, check_new
from .parsing import add_command, add_json, option_group
from .stderr import progress_bar

__all__ = ["add_figures"]


def add_figures(commands: Any) -> None:
    """Add the command ``figures``."""
    parser = add_command(
        commands,
        "figures",
        _figures,
        "Draw the figures of the paper, before and after the bus, as PNG and SVG.",
        "maplines figures --out figures",
    )
    option_group(parser, "output").add_argument(
        "--out", required=True, metavar="DIR", help="folder for the figures"
    )
    add_force(parser)
    add_draws(parser, samples=100_000)
    add_dbc(parser)
    add_json(parser, "the paths of the figures")


def _figures(arguments: argparse.Namespace) -> int:
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
