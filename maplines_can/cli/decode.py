"""The command ``maplines decode``."""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Generator, Mapping
from contextlib import closing
from dataclasses import replace
from typing import Any

from ..bus import read_log
from ..values.errors import LogError
from ..values.line import MapLine
from ..wire import POSE, Decoder, Reason, SceneView
from .fitting_dbc import MAX_IDS, dbc_hint
from .options import (
    add_codec,
    add_cycle,
    add_scenes,
    add_transfer_timeout,
    check_scenes,
    decoder_of,
    keyed_codec,
)
from .output import (
    POSE_ERROR,
    check_text,
    counts_text,
    is_another_scene,
    line_dict,
    pose_errors_text,
    scene_dict,
    slot_text,
    write_csv,
)
from .parsing import add_command, option_group
from .stderr import note, with_progress

#: No log of a car has more channels. Each one needs a decoder, some 16 kB.
MAX_CHANNELS = 256

DESCRIPTION = """\
Print the lines in a log file, or in a pipe as they arrive, one row of JSON each. At the end,
standard error shows how many frames were dropped and why, and the end-to-end (E2E) state of each
slot and of the pose error.

If the sender states the error of the pose from which the lines of a cycle are seen, these lines
are a scene. --scenes prints the joint covariance of each scene.

With --csv, a line that must not be used (usable is false: OUT_OF_RANGE, or too old) has empty cells
instead of values.

LOG has a format of python-can (.asc .blf .csv .db .mf4 .trc), or is the output of candump, with or
without -L, -t and -x. Without -L and -t it has no time stamps: "t" is null, no frame times out,
cycles without data are not counted, and the lines of a sender that restarts are dropped until its
counter has caught up. So prefer -L."""


def add_decode(commands: Any) -> None:
    """Add the command ``decode``."""
    example = (
        "maplines decode drive.blf --csv > drive.csv\n         candump -L vcan0 | maplines decode -"
    )
    parser = add_command(commands, "decode", _decode, DESCRIPTION, example)
    add_codec(parser)
    add_cycle(parser)
    add_transfer_timeout(parser)
    parser.add_argument("log", metavar="LOG", help="log file, or - for standard input")
    rows = option_group(parser, "output").add_mutually_exclusive_group()
    rows.add_argument("--csv", action="store_true", help="print CSV instead of JSON")
    add_scenes(rows)


def _decode(arguments: argparse.Namespace) -> int:
    codec = keyed_codec(arguments, clock=None)
    check_scenes(codec, arguments)
    decoders: dict[str, Decoder] = {}
    scenes: dict[str, SceneView] = {}  # the newest of each channel, with --scenes
    last_ns = status = beyond = 0
    has_time = True
    frames = read_log(sys.stdin.buffer if arguments.log == "-" else arguments.log)
    can_ids: set[int] = set()

    def print_scene(channel: str, view: SceneView) -> None:
        row = scene_dict(view) | ({} if has_time else {"t": None})
        print(json.dumps(row | {"channel": channel}), flush=True)

    def see(channel: str) -> None:
        """Print the scene before if there is a new one, which may still get lines."""
        if not arguments.scenes:
            return
        view = decoders[channel].latest_scene(last_ns)
        before = scenes.get(channel, view)
        is_new = is_another_scene(view, before)
        if is_new:
            print_scene(channel, before)
        if view.received is not None and (is_new or before is view or not view.stale):
            scenes[channel] = view

    def lines() -> Generator[tuple[str, MapLine], None, None]:
        nonlocal last_ns, status, beyond, has_time
        try:
            for frame in with_progress(frames, " frames"):
                if len(can_ids) < MAX_IDS:
                    can_ids.add(frame.can_id)
                if frame.channel not in decoders:
                    if len(decoders) == MAX_CHANNELS:
                        beyond += 1
                        continue
                    decoders[frame.channel] = decoder_of(codec, arguments)
                has_time = frame.has_time
                last_ns = frame.t_ns
                found = decoders[frame.channel].feed(
                    frame.can_id, frame.data, last_ns, is_extended=frame.is_extended
                )
                if not isinstance(found, Reason):
                    for line in found:
                        yield frame.channel, line if has_time else replace(line, t_ns=None)
                see(frame.channel)
        except LogError as error:  # the intact records have been read by now
            note(f"error: {error}")
            status = 1
        if beyond:
            note(
                f"error: {arguments.log}: {beyond} frames are not read, they are of channels "
                f"beyond the first {MAX_CHANNELS}; split the log by channel"
            )
            status = 1
        for channel, decoder in decoders.items():
            decoder.expire(last_ns + 10**18)  # counts the incomplete lines at the end of the log
            see(channel)
        for channel, scene in scenes.items():  # that nothing has followed
            print_scene(channel, scene)

    with closing(lines()) as rows:  # ends the progress bar
        try:
            if arguments.csv:
                write_csv(sys.stdout, rows)
            else:
                for channel, line in rows:
                    print(json.dumps(line_dict(line) | {"channel": channel}), flush=True)
        except KeyboardInterrupt:  # the counters so far are still useful
            status = 130
    if not has_time:
        note(
            "the log has no time stamps, so nothing that depends on time is checked; use candump -L"
        )
    _summarize(decoders, last_ns)
    is_empty = not any(decoder.lines or decoder.pose_errors for decoder in decoders.values())
    if not status and can_ids and is_empty:
        dropped = sum((decoder.counts for decoder in decoders.values()), Counter())
        if hint := dbc_hint(can_ids, codec, dropped):
            note(f"error: {arguments.log}: {hint}")
            return 1
    return status


def _summarize(decoders: Mapping[str, Decoder], last_ns: int) -> None:
    """Print the counters of all frames, and the state of each slot at the end of the log."""
    total = sum((decoder.counts for decoder in decoders.values()), Counter())
    note(
        f"{sum(d.lines for d in decoders.values())} lines"
        f"{pose_errors_text(sum(d.pose_errors for d in decoders.values()))} from "
        f"{sum(d.frames for d in decoders.values())} frames; "
        f"{sum(d.lost for d in decoders.values())} lines lost by their counters; "
        f"dropped frames: {counts_text({reason.name: n for reason, n in total.items()})}"
    )
    for channel, decoder in decoders.items():
        where = f"{channel} " if len(decoders) > 1 else ""
        for owner, check in decoder.checks.items():
            name = POSE_ERROR if owner == POSE else slot_text(owner.name)
            check.elapse(last_ns)
            stats = check.stats()
            if stats.status is not None:
                note(f"{where}{name}: {check_text(stats)}")
