"""The command ``maplines decode``."""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

from tqdm import tqdm

from ..bus import read_log
from ..errors import LogError
from ..line import MapLine
from ..wire import Decoder
from .listing import check_text, line_dict, slot_text, write_csv
from .options import add_codec, add_cycle, add_job, decoder_of, keyed_codec
from .progress import note, watched
from .trip_text import counts_text

__all__ = ["add_decode"]

#: More channels no log of a car has; each needs a decoder, some 16 kB.
MOST_CHANNELS = 256


def add_decode(jobs: Any) -> None:
    """Add the job ``decode`` to those of ``maplines``."""
    parser = add_job(
        jobs,
        "decode",
        _decode,
        "Print the lines of a log as JSON lines or CSV, then what was dropped and why.",
        "maplines decode drive.blf --csv > drive.csv",
    )
    add_codec(parser)
    add_cycle(parser)
    parser.add_argument("log", help="a log that python-can reads: .asc .blf .csv .log .mf4 .trc")
    parser.add_argument("--csv", action="store_true", help="CSV instead of JSON lines")


def _decode(arguments: argparse.Namespace) -> int:
    codec = keyed_codec(arguments, clock=None)
    decoders: dict[str, Decoder] = {}
    last_ns = status = beyond = 0

    def lines() -> Iterator[tuple[str, MapLine]]:
        nonlocal last_ns, status, beyond
        try:
            for frame in tqdm(read_log(arguments.log), unit=" frames", disable=not watched()):
                if frame.channel not in decoders:
                    if len(decoders) == MOST_CHANNELS:
                        beyond += 1
                        continue
                    decoders[frame.channel] = decoder_of(codec, arguments)
                last_ns = frame.t_ns
                answer = decoders[frame.channel].feed(
                    frame.can_id, frame.data, frame.t_ns, is_extended=frame.is_extended
                )
                if isinstance(answer, MapLine):
                    yield frame.channel, answer
        except LogError as error:  # what is good came first
            note(f"error: {error}")
            status = 1
        if beyond:
            note(
                f"error: {arguments.log}: {beyond} frames are of channels beyond the first "
                f"{MOST_CHANNELS}, and are not read; split the log by channel"
            )
            status = 1
        for decoder in decoders.values():
            decoder.expire(last_ns + 10**18)  # nothing more comes

    try:
        if arguments.csv:
            write_csv(sys.stdout, lines())
        else:
            for channel, line in lines():
                print(json.dumps(line_dict(line) | {"channel": channel}))
    except KeyboardInterrupt:  # the counts so far are still of use
        status = 130
    _summarize(decoders, last_ns)
    return status


def _summarize(decoders: Mapping[str, Decoder], last_ns: int) -> None:
    """Note what came of the frames, and what the slots were worth when the log ended."""
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
