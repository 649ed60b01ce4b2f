"""The command ``maplines plot``."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..values.errors import MaplinesError
from .command_line import add_command, note, option_group
from .decode import distances, slots
from .file_arguments import add_force, check_new
from .frame_source import add_part, add_times, choose_dbc, note_log
from .options import add_codec, keyed_codec

PICTURES = (".png", ".svg", ".pdf")

DESCRIPTION = """\
Draw the lines in logs: the lateral position at each x of --at over time, with its bands of 1, 2 and
3 standard deviations; the width and the centre of the ego lane, if the sender states the pose
error; the age of the lines, the end-to-end (E2E) state of each slot, when whole scenes leave out a
line, and the frames that were dropped. Several logs are drawn over each other, each from its own
begin on.

With --above T the lines are drawn from above, as they were at this time.

A page (-o FILE.html) opens offline; there one can zoom, hide a line and read values. With --truth,
the file that 'maplines drive --truth' wrote, the true positions are drawn, too."""


def add_plot(commands: Any) -> None:
    """Add the command ``plot``."""
    example = (
        "maplines plot drive.blf --at 20,40 -o drive.html\n"
        "         maplines plot drive.blf --above 12.5 -o lane.png"
    )
    parser = add_command(commands, "plot", _plot, DESCRIPTION, example)
    add_codec(parser)
    add_times(parser)
    add_part(parser)
    parser.add_argument("logs", metavar="LOG", nargs="+", help="log file, as for 'decode'")
    add = option_group(parser, "output").add_argument
    add(
        "--at",
        type=distances,
        default=(20.0,),
        metavar="X,...",
        help="distances ahead of the car [m] (default: 20)",
    )
    add("--slots", type=slots, metavar="NAME,...", help="these lines only, such as ego-left")
    add("--above", type=float, metavar="T", help="draw the lines at this time from above [s]")
    add("--truth", metavar="FILE", help="true lines of the first log")
    add(
        "-o",
        "--out",
        metavar="FILE",
        required=True,
        help=f"picture ({' '.join(PICTURES)}) or page (.html)",
    )
    add_force(parser)


def _plot(arguments: argparse.Namespace) -> int:
    from ..recordings.plots import panels_of, recorded, write_page, write_picture
    from ..recordings.plots.log_panels import above, distinct

    out = picture_path(arguments)
    choose_dbc(arguments)
    codec = keyed_codec(arguments, clock=None)
    recordings, status = [], 0
    for log in arguments.logs:
        source: Any = sys.stdin.buffer if log == "-" else log
        found, damage = recorded(
            source,
            codec,
            arguments.at,
            slots=arguments.slots,
            time=arguments.time,
            times=arguments.times,
            channel=arguments.channel,
        )
        note_log(log, found.log)
        if damage:
            note(f"error: {damage}")
            status = 1
        recordings.append(found)
    if arguments.truth is not None:
        recordings[0] = _with_truth(recordings[0], arguments.truth)
    if arguments.above is None:
        panels = panels_of(recordings, arguments.at)
    else:
        panels = [above(recordings, arguments.above)]
        if not panels[0].bands:
            raise ValueError(f"--above {arguments.above:g}: there is no line in the second before")
    title = ", ".join(recording.name for recording in distinct(recordings))
    (write_page if out.suffix == ".html" else write_picture)(panels, title, out)
    note(f"written: {out}")
    return status


def picture_path(arguments: argparse.Namespace) -> Path:
    """Return the path of ``-o``, checked: a picture or a page, and new without ``--force``."""
    out = Path(arguments.out)
    if out.suffix not in (*PICTURES, ".html"):
        raise ValueError(f"-o {out}: a plot has the suffix {', '.join(PICTURES)} or .html")
    check_new(arguments, out)
    return out


def _with_truth(recording: Any, path: str) -> Any:
    from ..simulation.truth import Y_PLACES, read_truth

    truth = read_truth(path)
    t = truth.time - recording.begin
    lines = {slot: (t, rows[:, : len(Y_PLACES)]) for slot, rows in truth.lines.items()}
    low = min(rows["t"].min() for rows in recording.lines.values())
    high = max(rows["t"].max() for rows in recording.lines.values())
    here = (t >= low - 1) & (t <= high + 1)
    if not here.any():
        raise MaplinesError(f"{path}: is of another time than {recording.name}")
    return replace(recording, truth={slot: (t[here], y[here]) for slot, (_, y) in lines.items()})
