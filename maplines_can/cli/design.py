"""The command ``maplines design``."""

from __future__ import annotations

import argparse
import json
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..maps.tour import town_path
from ..study.design.conditional import SceneDesign, design_scenes
from ..study.design.planner import MAX_FRAMES, Targets
from ..study.design.scene_frames import LINES, WholeSceneDesign, design_whole_scenes
from ..study.design.search import SETS, Design, design, sets_of
from ..study.scenes.map_scenes import drawn_scenes, maps_of
from ..study.sets import Gaussians, line_set
from ..values.line import PARAMETERS
from .command_line import add_command, add_json, number, option_group, positive, progress_bar
from .file_arguments import add_force, check_new

__all__ = ["add_design"]

ABOUT = """\
Design a message layout: find the widths and factors of all fields and the order of the covariance
rows that meet a target, and write the DBC and a page about it.

The divergence is the Kullback-Leibler divergence (KL) from the covered target to the decoded
Gaussian; 0 is exact. The covered target is the sent Gaussian, widened by the rounding error of its
mean.

Targets, one of them or both:
  --frames N   the least divergence in N classic CAN frames
  --max-kl X   the fewest bits with a divergence of at most X nat, mean over each set: 1e-2 is all
               standard deviations 5 % too large, 1e-3 is 1.6 %, 1e-4 is 0.5 %

for lines like those of a set:
  paper        uncertainty from the pose alone: nearly singular covariances
  road         uncertainty from pose and map, as a car would send them
  survey       the same as road, of maps that were thinned to a point each 1 to 15 m, with errors
  both         paper and road, with equal weights
  LOG          a log of lines, as for 'decode', or the .parquet that 'decode -o' wrote
  FILE         your own Gaussians, .npz, .csv or .parquet: mean (N, 4) and cov (N, 4, 4)

With any design, each decoded covariance is positive definite and covers the one that was sent.
Lines unlike those of the set are covered too, by a covariance that is wider than necessary (status
SATURATED), or are reported as OUT_OF_RANGE.

With --scenes: the Pose message and the records that are conditional on it, as in maplines-pose.dbc,
for random scenes of 4 lines. --max-kl is then that of a line; without it, the widths are those of
maplines-pose.dbc, and the figures say what each of their bits is for. The ranges stay as they are.

With --whole-scenes: the records of whole scenes, as in maplines-scene.dbc. All bits of the frame
are used; the search exchanges them between fields and moves ranges, until the standard deviations
of lateral positions, width and centre of the lane that a receiver decodes are as little as possible
above those that were sent. Scenes are drawn on the maps of --map, in turn with an error of the pose
like that of a production car or a poor one, and with a map that is exact, has errors of its points,
or drifts, too; and as many on random roads. It takes some minutes.

Figures are given twice: predicted, from the steps and ranges of the fields; measured, through the
DBC and the codec on lines that the search has not seen.
"""
EXAMPLES = """\
examples:
  maplines design --frames 3 --set road --out short.dbc
  maplines design --max-kl 1e-3 --set road --range y_off=16,beta=0.35 --out lean.dbc
  maplines design --frames 4 --set both --keep-mean --json
  maplines demo --dbc short.dbc
  maplines design --scenes --max-kl 1e-2 --out lean-pose.dbc
  maplines design --whole-scenes --map a.xodr b.osm --other-map c.xodr --out scene.dbc
  maplines design --whole-scenes --lines 5 --map my.xodr --rounds 3 --out five.dbc
"""
#: Scenes for the search, if --n does not say otherwise.
SCENES_N, LINES_N = 60, 5000
#: Rounds of the search for whole scenes.
ROUNDS = 10
HELD_OUT_SEED = 1_000_003


def add_design(commands: Any) -> None:
    """Add the command ``design``."""
    parser = add_command(commands, "design", _run, ABOUT, "")
    parser.epilog = EXAMPLES
    add = option_group(parser, "message").add_argument
    add(
        "--frames",
        type=number(int, 1, MAX_FRAMES),
        metavar="N",
        help=f"number of classic CAN frames of a line, 1 to {MAX_FRAMES}",
    )
    add("--max-kl", type=positive, metavar="X", help="largest divergence [nat]")
    add(
        "--scenes",
        action="store_true",
        help="design the Pose message and the records that are conditional on it",
    )
    add(
        "--whole-scenes",
        action="store_true",
        help="design the records of whole scenes, for the maps of --map",
    )
    add(
        "--lines",
        dest="places",
        type=number(int, *LINES),
        metavar="N",
        help=f"lines of a frame with --whole-scenes, {LINES[0]} to {LINES[1]} (default: 4)",
    )
    scenario = option_group(parser, "scenario").add_argument
    scenario(
        "--map",
        dest="maps",
        nargs="+",
        default=[],
        metavar="FILE",
        help="maps for --whole-scenes, as 'maplines map' reads them (default: the town of this "
        "package)",
    )
    scenario(
        "--other-map",
        dest="other_maps",
        nargs="+",
        default=[],
        metavar="FILE",
        help="maps for the figures of scenes that the search has not seen (default: other places "
        "of the same maps)",
    )
    scenario(
        "--rounds",
        type=number(int, 0, 1000),
        metavar="N",
        help="rounds of the search for whole scenes, at most; 0 only measures maplines-scene.dbc "
        f"(default: {ROUNDS})",
    )
    scenario(
        "--set",
        dest="lines",
        default="both",
        metavar="SET",
        help="lines to design for, see above (default: both)",
    )
    add(
        "--range",
        dest="ranges",
        type=_of_states,
        default={},
        metavar="PARAMETER=END,...",
        help="ends of the mean's ranges: y_off [m], beta [rad], c0 [1/m], c1 [1/m^2] "
        "(default: those of the DBC of this package, y_off=32,beta=0.5,c0=0.125,c1=0.03125)",
    )
    add(
        "--sigma",
        dest="sigmas",
        type=_of_states,
        default={},
        metavar="PARAMETER=MOST,...",
        help="greatest standard deviations (default: twice the greatest of the set)",
    )
    add("--keep-mean", action="store_true", help="leave the mean as in the DBC of this package")
    add(
        "--max-lateral",
        type=positive,
        default=Targets.max_lateral,
        metavar="M",
        help="largest effect of rounding the mean on the lateral position at 80 m [m] "
        f"(default: {Targets.max_lateral:g})",
    )
    add(
        "--max-saturated",
        type=number(float, 1e-9, 1),
        default=Targets.max_saturated,
        metavar="SHARE",
        help="largest share of saturated lines; a smaller one needs wider ranges, and so more "
        f"bits (default: {Targets.max_saturated:g})",
    )
    scenario(
        "--n",
        type=number(int, 10, 10**6),
        metavar="N",
        help="lines of each set for the search, and as many for the figures, 100 or more; few "
        f"lines determine the ends of the ranges poorly (default: {LINES_N}); with --scenes, "
        f"scenes, 10 or more, and with --whole-scenes those of each map (default: {SCENES_N})",
    )
    scenario("--seed", type=number(int, 0, 2**32), default=0, help="seed of the sets (default: 0)")
    option_group(parser, "output").add_argument(
        "--out",
        default="design.dbc",
        metavar="FILE",
        help="the DBC; its description gets the same name with the suffix .md (default: "
        "design.dbc)",
    )
    add_force(parser)
    add_json(parser, "all figures and fields")


def _run(arguments: argparse.Namespace) -> int:
    if Path(arguments.out).suffix.lower() != ".dbc":
        raise ValueError(f"--out must be a file that ends in .dbc, got {arguments.out!r}")
    if not Path(arguments.out).parent.is_dir():  # the search takes long
        raise ValueError(f"--out must be in a folder that exists, got {arguments.out!r}")
    check_new(arguments, arguments.out, Path(arguments.out).with_suffix(".md"))
    if arguments.n is None:
        are_scenes = arguments.scenes or arguments.whole_scenes
        arguments.n = SCENES_N if are_scenes else LINES_N
    result: Design | SceneDesign | WholeSceneDesign
    if arguments.whole_scenes:
        result = _whole_scenes(arguments)
    elif arguments.maps or arguments.other_maps or arguments.places or arguments.rounds is not None:
        raise ValueError("--map, --other-map, --lines and --rounds need --whole-scenes")
    else:
        result = (_scenes if arguments.scenes else _lines_alone)(arguments)
    dbc, page = result.write(arguments.out, _command(arguments))
    if arguments.json:
        print(json.dumps(result.as_dict() | {"dbc": str(dbc), "page": str(page)}, indent=2))
    else:
        print(result.text())
        print(f"\n{dbc}: the message layout\n{page}: its description")
    return 0


def _scenes(arguments: argparse.Namespace) -> SceneDesign:
    """Return the design of records that are conditional on the pose error."""
    if _has_line_options(arguments):
        raise ValueError(
            "--scenes must not be given with --frames, --range, --sigma or --keep-mean: the ranges "
            "and the frames are those of maplines-pose.dbc"
        )
    with progress_bar(" %") as update:
        return design_scenes(
            arguments.max_kl, n=arguments.n, seed=arguments.seed, progress=_percent(update)
        )


def _whole_scenes(arguments: argparse.Namespace) -> WholeSceneDesign:
    """Return the design of records of whole scenes."""
    if arguments.scenes or arguments.max_kl or _has_line_options(arguments):
        raise ValueError(
            "--whole-scenes must not be given with --scenes, --max-kl, --frames, --range, --sigma "
            "or --keep-mean: the frame is one of 64 bytes, and all of its bits are used"
        )
    maps = maps_of(arguments.maps or [town_path()])
    others = maps_of(arguments.other_maps) or maps
    drawn = list(drawn_scenes(maps, arguments.n, arguments.seed))
    held_out = list(drawn_scenes(others, arguments.n, arguments.seed + HELD_OUT_SEED))
    with progress_bar(" %") as update:
        return design_whole_scenes(
            drawn,
            held_out,
            lines=arguments.places or 4,
            rounds=ROUNDS if arguments.rounds is None else arguments.rounds,
            progress=_percent(update),
        )


def _has_line_options(arguments: argparse.Namespace) -> bool:
    """Whether options are given that are of records of single lines only."""
    given = (arguments.frames, arguments.ranges, arguments.sigmas, arguments.keep_mean)
    return any(map(bool, given))


def _lines_alone(arguments: argparse.Namespace) -> Design:
    """Return the design of records with a covariance of their own."""
    targets = Targets(
        frames=arguments.frames,
        max_kl=arguments.max_kl,
        ranges=arguments.ranges,
        sigmas=arguments.sigmas,
        keep_mean=arguments.keep_mean,
        max_lateral=arguments.max_lateral,
        max_saturated=arguments.max_saturated,
    )
    sets, held_out = _lines(arguments)
    with progress_bar(" %") as update:
        return design(sets, targets, held_out=held_out, progress=_percent(update))


def _percent(update: Callable[[int, int], None]) -> Callable[[float, float], None]:
    return lambda done, total: update(round(100 * done / total), 100)


def _lines(
    arguments: argparse.Namespace,
) -> tuple[dict[str, Gaussians], dict[str, Gaussians] | None]:
    """Return lines for the search, and lines for the figures."""
    if arguments.lines in SETS:
        return (
            sets_of(arguments.lines, arguments.n, arguments.seed),
            sets_of(arguments.lines, arguments.n, arguments.seed + HELD_OUT_SEED),
        )
    own = line_set(arguments.lines)
    chunks = [chunk() for chunk in own.chunks(arguments.n, 10_000, arguments.seed)]
    means, covs = (np.concatenate(parts) for parts in zip(*chunks, strict=True))
    return {own.name: Gaussians(means, covs)}, None


def _command(arguments: argparse.Namespace) -> str:
    """Return the command that repeats the design."""
    of_mean = {
        "--frames": arguments.frames,
        "--max-kl": arguments.max_kl,
        "--set": arguments.lines,
        "--range": ",".join(f"{k}={v:g}" for k, v in arguments.ranges.items()) or None,
        "--sigma": ",".join(f"{k}={v:g}" for k, v in arguments.sigmas.items()) or None,
        "--keep-mean": arguments.keep_mean,
        "--max-lateral": arguments.max_lateral,
        "--max-saturated": arguments.max_saturated,
    }
    options: dict[str, Any] = of_mean
    if arguments.whole_scenes:
        options = {
            "--whole-scenes": True,
            "--lines": arguments.places,
            "--rounds": arguments.rounds,
            "--map": [Path(file).name for file in arguments.maps] or None,
            "--other-map": [Path(file).name for file in arguments.other_maps] or None,
        }
    elif arguments.scenes:
        options = {"--scenes": True, "--max-kl": arguments.max_kl}
    options |= {"--n": arguments.n, "--seed": arguments.seed, "--out": Path(arguments.out).name}
    words = ["maplines", "design"]
    for flag, value in options.items():
        if value is None or value is False:
            continue
        values = [] if value is True else value if isinstance(value, list) else [value]
        words += [flag, *(f"{x:g}" if isinstance(x, float) else str(x) for x in values)]
    return shlex.join(words)


def _of_states(text: str) -> dict[str, float]:
    """Parse numbers of some states, for argparse."""
    numbers = {}
    for part in text.split(","):
        state, _, digits = part.partition("=")
        try:
            numbers[state.strip()] = float(digits)
        except ValueError:
            numbers = {}
            break
    if not numbers or not set(numbers) <= set(PARAMETERS):
        raise argparse.ArgumentTypeError(
            f"must be numbers of {', '.join(PARAMETERS)}, such as y_off=16,beta=0.35, got {text!r}"
        )
    return numbers
