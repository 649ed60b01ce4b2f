"""The command ``maplines study run``."""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from ..study.codes import CODES
from ..study.sets import DRAWN_SETS, line_set
from ..study.sweep.plan import Study
from ..study.sweep.run import run_study
from ..study.sweep.tables import read_table, summary_text
from .parsing import number
from .stderr import Bar, progress_bar

__all__ = ["add_run"]

ABOUT = """\
Send sets of Gaussians through all codes of the covariance at several widths, and measure what
comes back: whether it is definite, whether it covers, its divergence (KL), the lateral band.

A set is
  paper     lines as the pose alone makes them uncertain: nearly singular covariances
  road      the same with an uncertain map: what a real car would send
  hostile   random covariances that spare nothing
  FILE      your own Gaussians, .npz, .csv or .parquet: mean (N, 4) and cov (N, 4, 4), or
            columns mean_0 .. mean_3 and cov_00, cov_01 .. cov_33 (the upper triangle will do);
            with mean_0 .. mean_2 it is poses (x [m], y [m], heading [rad]), which see the
            lines of --map, a CSV with the columns line, x, y [m]

The tables go to DIR as Parquet: summary (codes and widths), fields (a bit more or less in each
field), terms (what each field adds to the divergence, and theory), worst (the worst cases) and
limit (how few bits could do). Stop it whenever you like: the same command goes on where it
stopped and gives the same tables, whoever did the work.
"""
EXAMPLES = """\
examples:
  maplines study run --out sweep --quick
  maplines study run --out sweep --set road --code Cholesky --finer 0 --n 1e7
  maplines study run --out mine --set drive.csv --map lanes.csv
  maplines study run --out big --n 1e8 --scheduler tcp://10.0.0.1:8786

Beyond one machine: 'dask scheduler' on one, 'dask worker ADDRESS' on each, with this package
installed; they need no common disk.
"""
#: How much is done unless it is asked for otherwise; see ``Study``.
DEFAULTS = {"n": 1_000_000, "fields_n": 100_000, "limit_n": 20_000}
#: Of --quick: under two minutes on two cores.
QUICK = {"n": 50_000, "fields_n": 20_000, "limit_n": 10_000}


def add_run(commands: Any, bar: Bar | None = progress_bar) -> argparse.ArgumentParser:
    """Add the command ``run`` to those of ``maplines study``; returns its parser.

    Args:
        commands: subparsers, as returned by ``ArgumentParser.add_subparsers``.
        bar: progress bar; None for none.
    """
    parser: argparse.ArgumentParser = commands.add_parser(
        "run",
        help="Sweep codes x widths x sets into tables; goes on where it stopped.",
        description=ABOUT,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--out", required=True, metavar="DIR", help="where the tables go, and what is done so far")
    add(
        "--set",
        action="append",
        dest="sets",
        metavar="SET",
        help=f"{', '.join(DRAWN_SETS)} or a file; may be repeated; paper and road by default",
    )
    add(
        "--code",
        action="append",
        dest="codes",
        choices=list(CODES),
        metavar="CODE",
        help=f"one of {', '.join(CODES)}; may be repeated; all by default",
    )
    add(
        "--finer",
        nargs="+",
        type=number(int, -8, 16),
        metavar="BITS",
        help="so many bits more in each field, for finer steps; -2 -1 0 1 2 by default",
    )
    add(
        "--n", type=number(int, 1, 10**12), help="Gaussians of each drawn set; 1 000 000 by default"
    )
    add("--seed", type=number(int, 0, 2**32), default=0, help="of the draws; 0 by default")
    add("--chunk", type=number(int, 100, 10**6), default=10_000, help="Gaussians at a time; 10 000")
    add("--jobs", type=number(int, 1, 1024), help="processes; as many as processors by default")
    add("--scheduler", metavar="ADDRESS", help="let the workers of this Dask scheduler do it")
    add("--map", metavar="FILE", help="the lines that the poses of a file see")
    add(
        "--window",
        nargs=2,
        type=float,
        default=(-20.0, 80.0),
        metavar=("MIN", "MAX"),
        help="where points of the map are taken, ahead of a pose [m]; -20 80 by default",
    )
    add(
        "--transform",
        choices=["sigma-points", "quadrature"],
        default="sigma-points",
        help="from a pose to a line; sigma-points by default",
    )
    add("--quick", action="store_true", help="fewer Gaussians: under two minutes on two cores")
    add("--json", action="store_true", help="print the table summary for machines")
    parser.set_defaults(run=lambda arguments: _run(arguments, bar))
    return parser


def _run(arguments: argparse.Namespace, bar: Bar | None) -> int:
    sets = [
        line_set(
            what,
            map_path=None if arguments.map is None else Path(arguments.map),
            window=tuple(arguments.window),
            transform=arguments.transform,
        )
        for what in arguments.sets or ("paper", "road")
    ]
    sizes = dict(QUICK if arguments.quick else DEFAULTS)
    if arguments.n is not None:
        sizes["n"] = arguments.n
    study = Study(
        sets,
        codes=tuple(arguments.codes or CODES),
        finer_bits=tuple(arguments.finer or (-2, -1, 0, 1, 2)),
        seed=arguments.seed,
        chunk_size=arguments.chunk,
        **sizes,
    )
    try:
        with nullcontext() if bar is None else bar(" Gaussians") as progress:
            directory = run_study(
                study,
                arguments.out,
                jobs=arguments.jobs,
                scheduler=arguments.scheduler,
                progress=progress,
            )
    except KeyboardInterrupt:
        print(
            f"maplines: stopped; what is done is in {arguments.out}, and the same command goes on",
            file=sys.stderr,
        )
        raise
    summary = read_table(directory, "summary")
    if arguments.json:
        print(json.dumps(summary, indent=2))
    else:
        print(summary_text(summary, read_table(directory, "terms")))
        print(f"\ntables: {directory.path}")
    return 0
