"""The command ``maplines truth``."""

from __future__ import annotations

import argparse
from typing import Any

from ..scenarios import SCENARIOS, scenario
from ..study.accuracy.table import accuracy_table
from ..study.accuracy.text import as_csv, as_markdown, as_text
from .options import add_dbc, add_draws, add_job, codec_from
from .progress import progress_bar

__all__ = ["add_truth"]


def add_truth(jobs: Any) -> None:
    """Add the job ``truth`` to those of ``maplines``."""
    parser = add_job(
        jobs,
        "truth",
        _truth,
        "Judge each representation of a line against a million samples, before and after the wire.",
        "maplines truth --scenario street-turn-10deg --format csv > truth.csv",
    )
    parser.add_argument(
        "--scenario",
        action="append",
        choices=list(SCENARIOS),
        help="only this one; may be repeated",
    )
    parser.add_argument("--format", choices=["text", "csv", "markdown"], default="text")
    add_draws(parser, samples=1_000_000)
    add_dbc(parser)


def _truth(arguments: argparse.Namespace) -> int:
    scenes = [scenario(name) for name in arguments.scenario or SCENARIOS]
    with progress_bar(" rows") as progress:
        rows = accuracy_table(
            scenes,
            n=arguments.samples,
            seed=arguments.seed,
            codec=codec_from(arguments.dbc),
            progress=progress,
        )
    writers = {"text": as_text, "csv": as_csv, "markdown": as_markdown}
    print(writers[arguments.format](rows).rstrip("\n"))
    return 0
