"""The command ``maplines decode``."""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
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
Print the lines in a log file, one row of JSON each. Standard error shows at the end how many
frames were dropped and why, and the end-to-end (E2E) state of each slot."""


def add_decode(commands: Any) -> None:
    """Add the command ``decode``."""
    example = "maplines decode drive.blf --csv > drive.csv"
    parser = add_command(commands, "decode", _decode, DESCRIPTION, example)
    add_codec(parser)
    add_cycle(parser)
    add_transfer_timeout(parser)
    parser.add_argument(
        "log", metavar="LOG", help="log in a format of python-can: .asc .blf .csv .log .mf4 .trc"
    )
    parser.add_argument("--csv", action="store_true", help="print CSV instead of JSON")


def _decode(arguments: argparse.Namespace) -> int:
    codec = keyed_codec(arguments, clock=None)
    decoders: dict[str, Decoder] = {}
    last_ns = status = beyond = 0

    def lines() -> Iterator[tuple[str, MapLine]]:
        nonlocal last_ns, status, beyond
        try:
            for frame in with_progress(read_log(arguments.log), " frames"):
                if frame.channel not in decoders:
                    if len(decoders) == MOST_CHANNELS:
                        beyond += 1
                        continue
                    decoders[frame.channel] = decoder_of(codec, arguments)
                last_ns = frame.t_ns
                result = decoders[frame.channel].feed(
                    frame.can_id, frame.data, frame.t_ns, is_extended=frame.is_extended
                )
                if isinstance(result, MapLine):
                    yield frame.channel, result
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

    try:
        if arguments.csv:
            write_csv(sys.stdout, lines())
        else:
            for channel, line in lines():
                print(json.dumps(line_dict(line) | {"channel": channel}))
    except KeyboardInterrupt:  # the counters so far are still useful
        status = 130
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
