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
from ..errors import LogError
from ..line import MapLine
from ..wire import Decoder
from .options import add_codec, add_cycle, add_transfer_timeout, decoder_of, keyed_codec
from .output import check_text, counts_text, line_dict, slot_text, write_csv
from .parsing import add_command
from .stderr import note, with_progress

#: No log of a car has more channels. Each one needs a decoder, some 16 kB.
MOST_CHANNELS = 256

DESCRIPTION = """\
Print the lines in a log file, or in a pipe as they arrive, one row of JSON each. At the end,
standard error shows how many frames were dropped and why, and the end-to-end (E2E) state of each
slot.

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
    parser.add_argument("--csv", action="store_true", help="print CSV instead of JSON")


def _decode(arguments: argparse.Namespace) -> int:
    codec = keyed_codec(arguments, clock=None)
    decoders: dict[str, Decoder] = {}
    last_ns = status = beyond = 0
    has_time = True
    log = sys.stdin.buffer if arguments.log == "-" else arguments.log

    def lines() -> Generator[tuple[str, MapLine], None, None]:
        nonlocal last_ns, status, beyond, has_time
        try:
            for frame in with_progress(read_log(log), " frames"):
                if frame.channel not in decoders:
                    if len(decoders) == MOST_CHANNELS:
                        beyond += 1
                        continue
                    decoders[frame.channel] = decoder_of(codec, arguments)
                has_time = frame.has_time
                last_ns = frame.t_ns
                result = decoders[frame.channel].feed(
                    frame.can_id, frame.data, last_ns, is_extended=frame.is_extended
                )
                if isinstance(result, MapLine):
                    yield frame.channel, result if has_time else replace(result, t_ns=None)
        except LogError as error:  # the intact records have been read by now
            note(f"error: {error}")
            status = 1
        if beyond:
            note(
                f"error: {arguments.log}: {beyond} frames are not read, they are of channels "
                f"beyond the first {MOST_CHANNELS}; split the log by channel"
            )
            status = 1
        for decoder in decoders.values():
            decoder.expire(last_ns + 10**18)  # counts the incomplete lines at the end of the log

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
    return status


def _summarize(decoders: Mapping[str, Decoder], last_ns: int) -> None:
    """Print the counters of all frames, and the state of each slot at the end of the log."""
    total = sum((decoder.counts for decoder in decoders.values()), Counter())
    note(
        f"{sum(d.lines for d in decoders.values())} lines from "
        f"{sum(d.frames for d in decoders.values())} frames; "
        f"{sum(d.lost for d in decoders.values())} lines lost by their counters; "
        f"dropped frames: {counts_text({reason.name: n for reason, n in total.items()})}"
    )
    for channel, decoder in decoders.items():
        where = f"{channel} " if len(decoders) > 1 else ""
        for slot, check in decoder.checks.items():
            check.elapse(last_ns)
            stats = check.stats()
            if stats.status is not None:
                note(f"{where}{slot_text(slot.name)}: {check_text(stats)}")
