"""The command ``maplines decode``."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any

from ..bus import LogFrame, read_log
from ..logs.first_frames import FirstFrames
from ..values.errors import LogError
from ..values.line import MapLine
from ..wire import Decoder, LineCodec, Reason, SceneView
from .decode_tables import (
    MAX_CHANNELS,
    add_tables,
    beyond_text,
    check_tables,
    note_decoders,
    note_slots,
    write_files,
)
from .log_input import add_times, check_received, choose_dbc, note_log
from .options import (
    add_codec,
    add_cycle,
    add_scenes,
    add_transfer_timeout,
    check_scenes,
    decoder_of,
    keyed_codec,
)
from .output import is_another_scene, line_dict, scene_dict, write_csv
from .parsing import add_command, option_group
from .stderr import note, with_progress

DESCRIPTION = """\
Print the lines in a log file, or in a pipe as they arrive, one row of JSON each. At the end,
standard error shows how many frames were dropped and why, and the end-to-end (E2E) state of each
slot and of the pose error.

If the sender states the error of the pose from which the lines of a cycle are seen, these lines
are a scene. --scenes prints the joint covariance of each scene.

With -o, the lines are written to a table instead, many times as fast: see 'Tables of lines' in
docs/recordings.md. It has the columns of --csv, and the E2E state, the counter and, for each x of
--at, the lateral position and its standard deviation (y40, sigma40). Frames that are dropped are in
FILE.rejects, and scenes with the width and the centre of the ego lane in FILE.scenes (--scenes);
MF4 and MCAP have all of them in one file. Many logs are a data set in a folder, a file a log; the
same command goes on where it was stopped.

With --csv, a line that must not be used (usable is false: OUT_OF_RANGE, or too old) has empty cells
instead of values.

LOG has a format of python-can (.asc .blf .csv .db .mf4 .trc), or is the output of candump, with or
without -L, -t and -x. Without -L and -t it has no time stamps: "t" is null, no frame times out,
cycles without data are not counted, and the lines of a sender that restarts are dropped until its
counter has caught up. So prefer -L."""


def add_decode(commands: Any) -> None:
    """Add the command ``decode``."""
    example = (
        "maplines decode drive.blf --at 0,20,40 -o drive.parquet\n"
        "         candump -L vcan0 | maplines decode -"
    )
    parser = add_command(commands, "decode", _decode, DESCRIPTION, example)
    add_codec(parser)
    add_cycle(parser)
    add_transfer_timeout(parser)
    add_times(parser)
    parser.add_argument(
        "logs",
        metavar="LOG",
        nargs="+",
        help="log file, or - for standard input; with -o FOLDER also directories, and patterns "
        "such as 'drives/**/*.blf'",
    )
    rows = option_group(parser, "output").add_mutually_exclusive_group()
    rows.add_argument("--csv", action="store_true", help="print CSV instead of JSON")
    add_scenes(rows)
    add_tables(parser)


def _decode(arguments: argparse.Namespace) -> int:
    check_tables(arguments)
    choose_dbc(arguments)
    if arguments.out is None:
        return _print_lines(arguments)
    return write_files(arguments)


def _print_lines(arguments: argparse.Namespace) -> int:
    arguments.log = arguments.logs[0]
    codec = keyed_codec(arguments, clock=None)
    check_scenes(codec, arguments)
    log = DecodedLog(codec, arguments)
    with closing(log.lines()) as rows:  # ends the progress bar
        try:
            if arguments.csv:
                write_csv(sys.stdout, rows, arguments.at)
            else:
                for channel, line in rows:
                    print(
                        json.dumps(line_dict(line, arguments.at) | {"channel": channel}), flush=True
                    )
        except KeyboardInterrupt:  # the counters so far are still useful
            log.status = 130
    if not log.has_time:
        note(
            "the log has no time stamps, so nothing that depends on time is checked; use candump -L"
        )
    log.note_counters()
    if log.is_empty and log.status != 130:
        check_received(arguments.log, log.first, codec, log.summary, has_failed=bool(log.status))
    return log.status


class DecodedLog:
    """Lines and scenes in a log, with a decoder for each channel.

    Args:
        codec: of the lines.
        arguments: options of the command.

    Raises:
        LogError: the log cannot be opened.
    """

    def __init__(self, codec: LineCodec, arguments: argparse.Namespace) -> None:
        self.status, self.has_time = 0, True
        self._codec, self._arguments = codec, arguments
        source = sys.stdin.buffer if arguments.log == "-" else arguments.log
        self._frames = read_log(source, times=arguments.times)
        self.summary, self.first = self._frames.summary, FirstFrames()
        self._decoders: dict[str, Decoder] = {}
        self._scenes: dict[str, SceneView] = {}  # the newest of each channel, with --scenes
        self._lines = self._printed = self._last_ns = self._beyond = 0

    def lines(self) -> Generator[tuple[str, MapLine], None, None]:
        """Yield the lines with their channels; print the scenes."""
        try:
            for frame in with_progress(self._frames, " frames"):
                if self._knows(frame):
                    yield from self._feed(frame)
        except LogError as error:  # the intact records have been read by now
            if not self._decoders:
                raise
            note(f"error: {error}")
            self.status = 1
        if self._beyond:
            note(beyond_text(self._arguments.log, self._beyond))
            self.status = 1
        for channel, decoder in self._decoders.items():
            # This counts the incomplete lines at the end of the log.
            decoder.expire(self._last_ns + 10**18)
            self._see(channel)
        for channel, scene in self._scenes.items():  # that nothing has followed
            self._print_scene(channel, scene)

    def _knows(self, frame: LogFrame) -> bool:
        """Return whether there is a decoder for the channel of a frame, now at the latest."""
        if not self._lines:
            self.first.add(frame)
        if frame.channel in self._decoders:
            return True
        if len(self._decoders) == MAX_CHANNELS:
            self._beyond += 1
            return False
        self._decoders[frame.channel] = decoder_of(self._codec, self._arguments)
        return True

    def _feed(self, frame: LogFrame) -> Iterator[tuple[str, MapLine]]:
        """Yield the lines that a frame completes."""
        self.has_time, self._last_ns = frame.has_time, frame.t_ns
        found = self._decoders[frame.channel].feed(
            frame.can_id, frame.data, frame.t_ns, is_extended=frame.is_extended
        )
        if not isinstance(found, Reason):
            self._lines += len(found)
            for line in found:
                if self._arguments.slots is not None and line.slot not in self._arguments.slots:
                    continue
                self._printed += 1
                yield frame.channel, line if self.has_time else replace(line, t_ns=None)
        self._see(frame.channel)

    def _see(self, channel: str) -> None:
        """Print the scene before if there is a new one, which may still get lines."""
        if not self._arguments.scenes:
            return
        view = self._decoders[channel].latest_scene(self._last_ns)
        before = self._scenes.get(channel, view)
        is_new = is_another_scene(view, before)
        if is_new:
            self._print_scene(channel, before)
        if view.received is not None and (is_new or before is view or not view.stale):
            self._scenes[channel] = view

    def _print_scene(self, channel: str, view: SceneView) -> None:
        row = scene_dict(view) | ({} if self.has_time else {"t": None})
        print(json.dumps(row | {"channel": channel}), flush=True)

    @property
    def is_empty(self) -> bool:
        """Whether there was neither a line nor a pose error."""
        return not any(one.lines or one.pose_errors for one in self._decoders.values())

    def note_counters(self) -> None:
        """Print the counters of all frames, and the state of each slot at the end of the log."""
        note_log(self._arguments.log, self.summary)
        note_decoders(self._decoders, self._last_ns)
        note_slots(self._arguments, self._lines, self._printed)
