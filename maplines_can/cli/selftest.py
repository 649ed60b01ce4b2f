"""The command ``maplines selftest``."""

from __future__ import annotations

import argparse
import json
import sys
import time
from typing import Any

from ..testing.back_to_back import HAS_MAC, Difference, compare_all
from ..testing.log_streams import compare_logs
from ..testing.map_streams import compare_maps
from ..testing.sender_comparison import compare_senders
from ..values.errors import missing_extra
from ..wire import SHIPPED, default_dbc_path
from .command_line import add_command, add_json, number, option_group, seconds
from .options import add_encoding, layout_from

__all__ = ["add_selftest"]

DESCRIPTION = """\
Compare the core with the model of maplines_can.model, which has the rules of dbc/README.md in plain
Python. Both get the frames of a faulty, hostile bus: lost, repeated, reordered, damaged and late
ones, two senders, restarts, wrong keys and jumping clocks. Every decoded number, reason, counter
and state is compared to the last bit, after each frame. Then both encode random lines, many of
which exceed the message, and the records must be equal. Both propagate random poses through random
maps to lines and scenes, which must be equal to the last bit. At last both parse damaged logs. The
status is 1 if one differs."""


def add_selftest(commands: Any) -> None:
    """Add the command ``selftest``."""
    parser = add_command(
        commands, "selftest", _selftest, DESCRIPTION, "maplines selftest --seconds 60 --seed 2"
    )
    add = option_group(parser, "scenario").add_argument
    add(
        "--seconds",
        type=seconds,
        default=10.0,
        metavar="N",
        help="time after which no further stream begins (default: 10)",
    )
    add(
        "--seed",
        type=number(int, 0, 10**9),
        default=1,
        metavar="N",
        help="seed of the streams, which are the same ones on any machine (default: 1)",
    )
    option_group(parser, "message").add_argument(
        "--dbc",
        action="append",
        metavar="FILE",
        help=f"DBC of the messages; can be repeated (default: {', '.join(SHIPPED)})",
    )
    add_encoding(parser)
    add_json(parser)


def _selftest(arguments: argparse.Namespace) -> int:
    paths = arguments.dbc or [str(default_dbc_path(name)) for name in SHIPPED]
    layouts = [layout_from(path, arguments.encoding) for path in paths]
    if not HAS_MAC and any(layout.secured is not None for layout in layouts):
        missing = missing_extra("authenticated frames are not compared", "secoc")
        print(f"maplines: {missing}", file=sys.stderr)
    begin = time.perf_counter()

    def passed(share: float) -> bool:
        return time.perf_counter() - begin >= share * arguments.seconds

    found = compare_all(layouts, arguments.seed, lambda: passed(0.4))
    senders = compare_senders(layouts, arguments.seed, lambda: passed(0.7))
    maps = compare_maps(arguments.seed, lambda: passed(0.95))
    logs = compare_logs(arguments.seed, lambda: passed(1.0))
    if arguments.json:
        counts = {"frames": found.frames, "records": found.records, "streams": found.streams}
        row = _row(found.difference, **counts) | {
            "senders": _row(senders.difference, records=senders.equal),
            "maps": _row(maps.difference, queries=maps.equal),
            "logs": _row(logs.difference, logs=logs.equal),
        }
        print(json.dumps(row, indent=2))
    else:
        print(found, senders, maps, logs, sep="\n")
    return 0 if all(x.difference is None for x in (found, senders, maps, logs)) else 1


def _row(difference: Difference | None, **counts: Any) -> dict[str, Any]:
    return counts | {"difference": None if difference is None else difference._asdict()}
