"""The command ``maplines study run``."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

from ..study.codes import CODES
from ..study.sets import DRAWN_SETS, MapView, line_set
from ..study.sweep.plan import Study
from ..study.sweep.run import run_study
from ..study.sweep.summary import read_table, summary_text
from ..study.sweep.tasks import cpu_seconds
from .parsing import add_json, number, option_group
from .stderr import Bar, note, progress_bar

__all__ = ["add_run"]

ABOUT = """\
Send sets of Gaussians through all covariance codes at several widths, and evaluate the decoded
ones: whether they are positive definite, whether they cover the covariance that was sent, their
Kullback-Leibler divergence (KL) from it, and the error of the lateral position.

A set is
  paper        lines with pose error only: nearly singular covariances
  road         lines with pose and map error, as a real car would send them
  adversarial  random covariances of all kinds, singular ones too
  LOG          a log of lines, as for 'decode', or the .parquet that 'decode -o' wrote: which bits
               do the lines of your own drives need
  FILE         your own Gaussians, .npz, .csv or .parquet: mean (N, 4) and cov (N, 4, 4), or
               columns mean_0 .. mean_3 and cov_00, cov_01 .. cov_33 (the upper triangle is
               enough); with mean_0 .. mean_2 it is poses (x [m], y [m], heading [rad]), which see
               the lines of --map: a CSV with the columns line, x, y [m], or another map
               that maplines_can.maps.formats.load reads

The tables are written to DIR as Parquet: summary (codes and widths), fields (a bit more or less in
each field), terms (the part of each field in the divergence, and theory), worst (the worst cases),
limit (the fewest bits that could do) and scenes (all codes, and those that send the pose error, on
random scenes of 4 and 8 lines: whether the joint covariance is covered, and the fewest bits that
could do). You can stop the study at any time: the same command
goes on where it stopped and gives the same tables, whichever workers ran it.
"""
EXAMPLES = """\
examples:
  maplines study run --out sweep --quick
  maplines study run --out sweep --set road --code Cholesky --finer 0 --n 1e7
  maplines study run --out mine --set drive.csv --map lanes.csv
  maplines study run --out drives --set drive.blf --finer -2 -1 0
  maplines study run --out big --n 1e8 --scheduler tcp://10.0.0.1:8786

For more than one machine: run 'dask scheduler' on one and 'dask worker ADDRESS' on each, with this
package installed; they need no shared disk.
"""
#: Default sizes; see ``Study``.
DEFAULTS = {"n": 1_000_000, "fields_n": 100_000, "limit_n": 20_000, "scenes_n": 400}
#: Sizes with --quick.
QUICK = {"n": 50_000, "fields_n": 20_000, "limit_n": 10_000, "scenes_n": 60}


def add_run(commands: Any, bar: Bar = progress_bar) -> argparse.ArgumentParser:
    """Add the command ``run`` to those of ``maplines study``; returns its parser.

    Args:
        commands: subparsers, as returned by ``ArgumentParser.add_subparsers``.
        bar: progress bar.
    """
    parser: argparse.ArgumentParser = commands.add_parser(
        "run",
        help="Sweep codes x widths x sets into tables; go on where it stopped.",
        description=ABOUT,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    scenario = option_group(parser, "scenario").add_argument
    message = option_group(parser, "message").add_argument
    option_group(parser, "output").add_argument(
        "--out",
        required=True,
        metavar="DIR",
        help="directory of the tables and of the results so far: a new one, or that of the same "
        "study, which goes on",
    )
    scenario(
        "--set",
        action="append",
        dest="sets",
        metavar="SET",
        help=f"{', '.join(DRAWN_SETS)} or a file; may be repeated (default: paper and road)",
    )
    message(
        "--code",
        action="append",
        dest="codes",
        choices=list(CODES),
        metavar="CODE",
        help=f"covariance code: {', '.join(CODES)}; may be repeated (default: all)",
    )
    message(
        "--finer",
        nargs="+",
        type=number(int, -8, 16),
        metavar="BITS",
        help="additional bits of each field over its DBC (default: -2 -1 0 1 2)",
    )
    scenario(
        "--n",
        type=number(int, 1, 10**12),
        metavar="N",
        help="Gaussians of each drawn set (default: 1 000 000)",
    )
    scenario(
        "--scenes",
        type=number(int, 0, 10**6),
        metavar="N",
        help="scenes of each number of lines, 0 for none (default: 400)",
    )
    scenario("--seed", type=number(int, 0, 2**32), default=0, help="seed of the draws (default: 0)")
    add(
        "--chunk",
        type=number(int, 100, 10**6),
        default=10_000,
        metavar="N",
        help="Gaussians in a chunk; a stopped run continues at the next one (default: 10 000)",
    )
    add(
        "--jobs",
        type=number(int, 1, 1024),
        metavar="N",
        help="processes (default: one for each processor)",
    )
    add("--scheduler", metavar="ADDRESS", help="run on the workers of this Dask scheduler")
    scenario("--map", metavar="FILE", help="CSV of the lines that poses see")
    scenario(
        "--window",
        nargs=2,
        type=float,
        default=(-20.0, 80.0),
        metavar=("MIN", "MAX"),
        help="range ahead of a pose where points of the map are used [m] (default: -20 80)",
    )
    scenario(
        "--transform",
        choices=["sigma-points", "quadrature"],
        default="sigma-points",
        help="propagation from a pose to a line (default: sigma-points)",
    )
    add("--quick", action="store_true", help="fewer Gaussians, for a first look")
    add_json(parser, "the tables summary and scenes")
    parser.set_defaults(run=lambda arguments: _run(arguments, bar))
    return parser


def _estimate_text(cpu: float, jobs: int) -> str:
    """Return how long a study will take.

    >>> _estimate_text(300.0, 2)
    'this will take about 5 min of CPU time, 2.5 min on 2 processes'
    >>> _estimate_text(9.0, 1)
    'this will take about 9 s of CPU time'
    """
    scale, unit = (1, "s") if cpu < 100 else (60, "min")
    text = f"this will take about {cpu / scale:.2g} {unit} of CPU time"
    return text if jobs == 1 else f"{text}, {cpu / scale / jobs:.2g} {unit} on {jobs} processes"


def _run(arguments: argparse.Namespace, bar: Bar) -> int:
    view = None
    if arguments.map is not None:
        view = MapView(Path(arguments.map), tuple(arguments.window), arguments.transform)
    sets = [line_set(what, view) for what in arguments.sets or ("paper", "road")]
    sizes = dict(QUICK if arguments.quick else DEFAULTS)
    if arguments.n is not None:
        sizes["n"] = arguments.n
    if arguments.scenes is not None:
        sizes["scenes_n"] = arguments.scenes
    study = Study(
        sets,
        codes=tuple(arguments.codes or CODES),
        finer_bits=tuple(arguments.finer or (-2, -1, 0, 1, 2)),
        seed=arguments.seed,
        chunk_size=arguments.chunk,
        **sizes,
    )
    if not Path(arguments.out).exists():
        note(_estimate_text(cpu_seconds(study), arguments.jobs or os.cpu_count() or 1))
    try:
        with bar(" Gaussians") as progress:
            directory = run_study(
                study,
                arguments.out,
                jobs=arguments.jobs,
                scheduler=arguments.scheduler,
                progress=progress,
            )
    except KeyboardInterrupt:
        print(
            f"maplines: stopped; the same command goes on from the results in {arguments.out}",
            file=sys.stderr,
        )
        raise
    summary, scenes = (read_table(directory, name) for name in ("summary", "scenes"))
    if arguments.json:
        print(json.dumps({"summary": summary, "scenes": scenes}, indent=2))
    else:
        print(summary_text(summary, read_table(directory, "terms"), scenes))
        print(f"\ntables: {directory.path}")
    return 0
