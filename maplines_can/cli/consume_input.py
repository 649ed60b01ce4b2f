"""Input of ``maplines consume``: scenes from a bus or from a log, at even times."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from contextlib import ExitStack
from typing import NamedTuple

from ..bus import Link, Receiver, read_log
from ..line import MapLine
from ..wire import Codec, Monitor, SceneView
from .options import (
    add_bus,
    add_codec,
    add_cycle,
    add_json,
    add_transfer_timeout,
    bus_settings,
    decoder_of,
    keyed_codec,
)
from .parsing import number, seconds
from .stderr import note, with_progress

#: Period of the consumers [s].
PERIOD = 0.05
#: What to check if there is no scene.
SENDER = (
    "the sender must send the pose error, too: --pose-error of drive or send, or --dbc "
    "maplines-pose.dbc on both sides"
)


def add_input(parser: argparse.ArgumentParser, what: str) -> None:
    """Add the options of the input and of the output."""
    parser.add_argument(
        "log",
        nargs="?",
        metavar="LOG",
        help="log file, as of 'decode' (default: receive from the bus)",
    )
    add_bus(parser)
    add_codec(parser)
    add_cycle(parser)
    add_transfer_timeout(parser)
    parser.add_argument("--seconds", type=seconds, metavar="S", help="stop after this time [s]")
    parser.add_argument(
        "--every",
        type=number(float, PERIOD, 3600),
        default=1.0,
        metavar="S",
        help=f"time between two rows of {what} [s], {PERIOD:g} or more (default: 1)",
    )
    add_json(parser, "each row")


class Cycle(NamedTuple):
    """One period of a consumer."""

    t: float  #: time since the first one [s]
    now_ns: int  #: time, of a log on its clock [ns]
    view: SceneView
    source: Monitor | Receiver  #: from which it comes


def cycles(arguments: argparse.Namespace) -> Iterator[Cycle]:
    """Yield the newest scene 20 times a second, until the end or Ctrl-C.

    Raises:
        ValueError: the DBC has no message of the pose error.
    """
    codec = scene_codec(arguments)
    found = _from_log(codec, arguments) if arguments.log else _from_bus(codec, arguments)
    first: int | None = None
    for mono_ns, now_ns, source, view in found:
        first = mono_ns if first is None else first
        if arguments.seconds is not None and mono_ns - first >= arguments.seconds * 1e9:
            return
        yield Cycle((mono_ns - first) / 1e9, now_ns, view, source)


def scene_codec(arguments: argparse.Namespace) -> Codec:
    """Return the codec of the options.

    Raises:
        ValueError: the DBC has no message of the pose error.
    """
    codec = keyed_codec(arguments, clock=None if arguments.log else time.time_ns)
    if codec.layout.pose is None:
        raise ValueError(
            f"--dbc: {codec.layout.source} has no message of the pose error (MapLinePose), so "
            "there are no scenes; take the --dbc of the sender, such as maplines-pose.dbc"
        )
    return codec


def lines_of_log(path: str, codec: Codec, arguments: argparse.Namespace) -> Iterator[MapLine]:
    """Yield the lines in a log, with their times."""
    decoder = decoder_of(codec, arguments)
    for frame in read_log(path):
        found = decoder.feed(frame.can_id, frame.data, frame.t_ns, is_extended=frame.is_extended)
        if isinstance(found, MapLine):
            yield found
            yield from decoder.further


#: Time since the start of some clock [ns], time on the clock of the stamps [ns], source and scene.
Found = tuple[int, int, Monitor | Receiver, SceneView]


def _from_log(codec: Codec, arguments: argparse.Namespace) -> Iterator[Found]:
    monitor = Monitor(decoder_of(codec, arguments))
    step = round(PERIOD * 1e9)
    due: int | None = None
    for frame in with_progress(read_log(arguments.log), " frames"):
        if not frame.has_time:
            raise ValueError(f"LOG: {arguments.log} has no time stamps; record it with candump -L")
        due = frame.t_ns + step if due is None else due
        if frame.t_ns - due > 60 * 10**9:  # a pause, not a drive
            due = frame.t_ns
        while frame.t_ns >= due:
            yield due, due, monitor, monitor.latest_scene(due)
            due += step
        monitor.feed(frame.can_id, frame.data, frame.t_ns, is_extended=frame.is_extended)
    if due is not None:
        yield due, due, monitor, monitor.latest_scene(due)


def _from_bus(codec: Codec, arguments: argparse.Namespace) -> Iterator[Found]:
    with ExitStack() as stack:
        link = stack.enter_context(Link(**bus_settings(arguments)))
        receiver = stack.enter_context(
            Receiver(link, decoder_of(codec, arguments), on_line=lambda _: None)
        )
        if not arguments.json:
            note(f"listening on {link.name}; stop with Ctrl-C")
        due = time.monotonic()
        try:
            while True:
                yield time.monotonic_ns(), time.time_ns(), receiver, receiver.latest_scene()
                due = max(due + PERIOD, time.monotonic())
                receiver.wait(max(0.0, due - time.monotonic()))
        except KeyboardInterrupt:
            return
