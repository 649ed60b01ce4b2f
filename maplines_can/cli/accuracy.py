"""The command ``maplines accuracy``."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..bus import LogFrame, LogSummary, read_log
from ..logs.first_frames import FirstFrames
from ..logs.log_part import Window, of_channel
from ..simulation.accuracy import MIN_CURVATURE, REQUIREMENTS, Accuracy, accuracy_of
from ..simulation.sender_consistency import consistency_of, map_consistency_of
from ..simulation.truth import PLACES, Truth, read_truth, truth_paths
from ..values.arrays import count_text
from ..values.errors import DriveFileError, LogError
from ..values.line import MapLine, Slot
from ..values.text_table import aligned
from ..wire import Decoder, Reason
from .command_line import add_command, add_json, note, option_group, with_progress
from .decode import slots
from .file_arguments import add_force, check_new
from .frame_source import add_part, add_times, check_received, note_log
from .options import add_codec, add_cycle, add_transfer_timeout, decoder_of, keyed_codec

PICTURES = (".png", ".svg", ".pdf")

DESCRIPTION = """\
Compare the lines in the log of a drive with the true ones: the lateral, heading and curvature
errors at 0, 20, 40 and 80 m ahead, and the absolute and the relative accuracy as EDMap defines
them; and compare these with the requirements that a survey of HD maps lists. First, a sentence says
whether the errors are as large as the sender states, by a chi-square test of the lateral errors in
stated standard deviations; and a second one whether what it states for its map is right, by the
part of the errors that the pose does not explain.

TRUTH and LOG are what 'maplines drive --record' writes; TRUTH is the one beside LOG, if it is not
given. Each line is compared with the truth at the time of its pose, within its range."""


def add_accuracy(commands: Any) -> None:
    """Add the command ``accuracy``."""
    example = "maplines accuracy drive.blf --plot accuracy.png"
    parser = add_command(commands, "accuracy", _accuracy, DESCRIPTION, example)
    parser.add_argument(
        "truth",
        nargs="?",
        metavar="TRUTH",
        help="truth of the drive, .csv or .parquet (default: beside LOG, such as "
        "drive.truth.parquet beside drive.blf)",
    )
    parser.add_argument("log", metavar="LOG", help="log of the same drive, as for 'decode'")
    option_group(parser, "output").add_argument(
        "--plot",
        metavar="FILE",
        help=f"draw the errors into this file: {', '.join(PICTURES)}",
    )
    add_force(parser)
    add_codec(parser)
    add_cycle(parser)
    add_transfer_timeout(parser)
    add_times(parser)
    add_part(parser)
    option_group(parser, "message").add_argument(
        "--slots", type=slots, metavar="NAME,...", help="lines of these slots only: ego-left,..."
    )
    add_json(parser)


def _accuracy(arguments: argparse.Namespace) -> int:
    if arguments.plot and Path(arguments.plot).suffix.lower() not in PICTURES:
        raise ValueError(
            f"--plot must be a file that ends in {', '.join(PICTURES)}, got {arguments.plot!r}"
        )
    check_new(arguments, arguments.plot)
    received = _LogLines(arguments)
    truth = read_truth(arguments.truth or truth_of(arguments.log))
    accuracy = accuracy_of(truth, received.lines())
    note_log(arguments.log, received.summary)
    received.check(accuracy)
    _print(accuracy, truth, received.summary, arguments)
    return received.status


class _LogLines:
    """Lines of a part of a log, with a decoder for each channel.

    Raises:
        LogError: the log cannot be opened.
    """

    def __init__(self, arguments: argparse.Namespace) -> None:
        self._arguments, self._log = arguments, arguments.log
        log = read_log(self._log, times=arguments.times)
        self._frames, self.summary = of_channel(log, arguments.channel, self._log), log.summary
        self._window, self._slots = Window(arguments.time), arguments.slots or tuple(Slot)
        self._codec = keyed_codec(arguments, clock=None)
        self._decoders: dict[str, Decoder] = {}
        self._first = FirstFrames()
        self.status, self._is_empty = 0, True

    def lines(self) -> Iterator[MapLine]:
        """Yield the lines of the part; those before damage are compared, too."""
        try:
            for frame in with_progress(self._frames, " frames"):
                if self._window.is_over(frame.t_ns):
                    self._window.check_frames(len(self._decoders), self._log)
                    break
                yield from self._feed(frame)
        except LogError as error:
            if self._is_empty:
                raise
            note(f"error: {error}")
            self.status = 1

    def _feed(self, frame: LogFrame) -> Iterator[MapLine]:
        if self._is_empty:
            self._first.add(frame)
        new = self._decoders.get(frame.channel) or decoder_of(self._codec, self._arguments)
        decoder = self._decoders.setdefault(frame.channel, new)
        found = decoder.feed(frame.can_id, frame.data, frame.t_ns, is_extended=frame.is_extended)
        if isinstance(found, Reason):
            return
        if not frame.has_time:
            raise LogError(f"{self._log}: has no time stamps; record it with candump -L")
        self._is_empty = False
        for line in found:
            t = (line.t_ns or 0) / 1e9
            if line.slot in self._slots and self._window.takes(t, self._log):
                yield line

    def check(self, accuracy: Accuracy) -> None:
        """Raise LogError if there is no line."""
        if self._is_empty:
            pose_errors = sum(decoder.pose_errors for decoder in self._decoders.values())
            if not pose_errors:
                check_received(self._log, self._first, self._codec, self.summary)
            raise LogError(
                f"{self._log}: has no lines, and {count_text(pose_errors, 'pose error')}"
            )
        if not accuracy.received:
            raise LogError(f"{self._log}: none of its lines is in the part that was chosen")


def _print(
    accuracy: Accuracy, truth: Truth, summary: LogSummary, arguments: argparse.Namespace
) -> None:
    """Print the accuracy, and draw it if a picture is asked for."""
    if arguments.plot:
        from ..pictures.accuracy_picture import draw_accuracy

        draw_accuracy(accuracy, arguments.plot)
    if arguments.json:
        consistency = consistency_of(accuracy)
        rest: dict[str, Any] = {"lane_changes": truth.lane_changes, "log": summary.as_dict()}
        rest["consistency"] = None if consistency is None else consistency.as_dict()
        of_map = map_consistency_of(accuracy)
        rest["map"] = None if of_map is None else of_map.as_dict()
        print(json.dumps(accuracy.as_dict() | rest, indent=2))
    else:
        print(as_text(accuracy))
        if arguments.plot:
            print(f"\npicture: {arguments.plot}")


#: Headings of the errors, with their units, and the factors from the unit of the error.
_SHOWN = {
    "lateral": ("lateral [cm]", 100.0),
    "heading": ("heading [deg]", 1.0),
    "curvature": ("curvature [%]", 1.0),
    "absolute": ("absolute [cm]", 100.0),
    "relative": ("relative [cm]", 100.0),
}


def as_text(accuracy: Accuracy) -> str:
    """Return the errors and the requirements of the survey as tables.

    The first sentence says whether the errors are as large as the sender states, and the second
    one whether those of its map are.
    """
    consistency, of_map = consistency_of(accuracy), map_consistency_of(accuracy)
    blank = [""] * (len(PLACES) + 1)
    rows = [["error", "", *(f"{x} m" for x in PLACES), "whole line"]]
    for quantity, (heading, factor) in _SHOWN.items():
        columns = accuracy.errors[quantity].shape[1]
        found = [accuracy.figures(quantity, i) for i in range(columns)]
        for k, name in enumerate(("rms", "95 %", "max")):
            cells = [f"{one[name] * factor:.3g}" if one["n"] else "-" for one in found]
            cells = [*cells, ""] if columns > 1 else [*blank[:-1], *cells]
            rows.append([heading if not k else "", name, *cells])
    rows.append(["lines", "", *(str(accuracy.figures("lateral", i)["n"]) for i in range(4)), ""])
    rows[-1][-1] = str(accuracy.figures("absolute", 0)["n"])
    verdicts = [["requirement of the survey", "", *(f"{x} m" for x in PLACES), "whole line"]]
    for requirement in REQUIREMENTS:
        met = [
            {True: "met", False: "missed", None: "-"}[m] for m in accuracy.met(requirement).values()
        ]
        cells = [*met, ""] if len(met) > 1 else [*blank[:-1], *met]
        verdicts.append([requirement.quantity, requirement.source, *cells])
    return "\n".join(
        [
            *([] if consistency is None else [consistency.text(accuracy), ""]),
            *([] if of_map is None else [of_map.text(), ""]),
            f"{count_text(accuracy.received, 'line')} received, {accuracy.lines} compared with the "
            f"truth, {accuracy.saturated} of these saturated; not compared: "
            f"{accuracy.without_values} too old or out of range, {accuracy.other_lane} "
            "while the car was on another lane than it believed, "
            f"{accuracy.unknown} without a true line",
            "",
            aligned(rows, left=2),
            "",
            aligned(verdicts, left=2),
            "",
            "A requirement is met if 95 % of the errors are within it. Absolute: largest deviation "
            "of a line\nfrom the true one; relative: after both are aligned (EDMap). Curvature: "
            f"lines of radii up to {1 / MIN_CURVATURE:g} m.",
        ]
    )


def truth_of(log: str) -> Path:
    """Return the truth beside a log; the newer one if there are two.

    Raises:
        DriveFileError: there is none.
    """
    paths = truth_paths(log)
    found = [path for path in paths if path.is_file()]
    if not found:
        names = " nor ".join(str(path) for path in paths)
        raise DriveFileError(
            f"{log}: there is no truth beside it, neither {names}; give it as "
            "'maplines accuracy TRUTH LOG'"
        )
    return max(found, key=lambda path: path.stat().st_mtime_ns)
