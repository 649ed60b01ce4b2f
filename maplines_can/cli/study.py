"""The commands of ``maplines study``: run, report, maps, production."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from ..engines import processors
from ..maps.tour import town_path
from ..study.codes import CODES
from ..study.production_messages import as_csv, as_markdown, as_records, as_text, production_table
from ..study.report.page import TITLE, write_report
from ..study.scenes.map_scenes import drawn_scenes, maps_of
from ..study.scenes.sigma_ratios import of_carriers, ratios_text
from ..study.sets import DRAWN_SETS, MapView, line_set
from ..study.sweep.plan import Study
from ..study.sweep.run import run_study
from ..study.sweep.summary import read_table, summary_text
from ..study.sweep.tasks import cpu_seconds
from .command_line import add_command, add_json, note, number, option_group, progress_bar
from .file_arguments import add_force, check_new

__all__ = ["add_maps", "add_production", "add_report", "add_run"]

RUN_ABOUT = """\
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
RUN_EXAMPLES = """\
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


def add_run(commands: Any) -> None:
    """Add the command ``run`` to those of ``maplines study``."""
    parser = add_command(commands, "run", _run, RUN_ABOUT, "")
    parser.epilog = RUN_EXAMPLES
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


def _run(arguments: argparse.Namespace) -> int:
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
        note(_estimate_text(cpu_seconds(study), arguments.jobs or processors()))
    try:
        with progress_bar(" Gaussians") as progress:
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
    summary, scenes = (read_table(directory.path, name) for name in ("summary", "scenes"))
    if arguments.json:
        print(json.dumps({"summary": summary, "scenes": scenes}, indent=2))
    else:
        print(summary_text(summary, read_table(directory.path, "terms"), scenes))
        print(f"\ntables: {directory.path}")
    return 0


# ---- report -------------------------------------------------------------------------------------


def add_report(commands: Any) -> None:
    """Add the command ``report``."""
    about = (
        "Write one HTML file with interactive plots of a sweep's tables. It includes its scripts, "
        "and opens\nwithout a network."
    )
    example = "maplines study report sweep --out report.html"
    parser = add_command(commands, "report", _report, about, example)
    parser.add_argument("folder", metavar="DIR", help="the tables of a sweep")
    output = option_group(parser, "output")
    output.add_argument("--out", required=True, metavar="FILE", help="the HTML file")
    output.add_argument("--title", default=TITLE, help="title of the page (default: %(default)s)")
    add_force(parser)


def _report(arguments: argparse.Namespace) -> int:
    check_new(arguments, arguments.out)
    path = write_report(arguments.folder, Path(arguments.out), title=arguments.title)
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB", file=sys.stderr)
    return 0


# ---- maps ---------------------------------------------------------------------------------------

MAPS_ABOUT = """\
Send scenes around random poses on maps, and of random roads, by all records with the pose error:
how many lines do not fit, and why, and how much less certain a receiver is than the sender.

Each scene has the lines of the ego lane and of its neighbours. Poses have errors like that of a
production car and of a poor one in turn; the map is exact, has errors of its points, or drifts,
too.
"""


def add_maps(commands: Any) -> None:
    """Add the command ``maps``."""
    example = "maplines study maps my.xodr other.osm --n 300"
    parser = add_command(commands, "maps", _maps, MAPS_ABOUT, example)
    parser.add_argument(
        "maps",
        nargs="*",
        metavar="FILE",
        help="maps, as 'maplines map' reads them (default: the town of this package)",
    )
    scenario = option_group(parser, "scenario").add_argument
    scenario(
        "--n",
        type=number(int, 1, 10**6),
        default=120,
        metavar="N",
        help="scenes of each map, and of random roads (default: 120)",
    )
    scenario("--seed", type=number(int, 0, 2**32), default=0, help="seed (default: 0)")
    add_json(parser, "all figures")


def _maps(arguments: argparse.Namespace) -> int:
    maps = maps_of(arguments.maps or [town_path()])
    drawn = list(drawn_scenes(maps, arguments.n, arguments.seed))
    with progress_bar(" kinds of records") as update:
        found = of_carriers(drawn, update)
    if arguments.json:
        figures = {
            carrier: {name: ratios.as_dict() for name, ratios in of_maps.items()}
            for carrier, of_maps in found.items()
        }
        print(json.dumps(figures, indent=2))
    else:
        print(ratios_text(found))
    return 0


# ---- production ---------------------------------------------------------------------------------


def add_production(commands: Any) -> None:
    """Add the command ``production``."""
    about = "Print the lateral rounding error of production lane messages and of this project's."
    example = "maplines study production --markdown"
    parser = add_command(commands, "production", _production, about, example)
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


def _production(arguments: argparse.Namespace) -> int:
    rows = production_table(arguments.n, arguments.seed)
    if arguments.json:
        print(json.dumps(as_records(rows), indent=2))
    else:
        write = as_markdown if arguments.markdown else as_csv if arguments.csv else as_text
        print(write(rows), end="")
    return 0
