"""The command ``maplines view``."""

from __future__ import annotations

import argparse
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ..bus import LogFrame, read_log
from ..desk.facts import Facts
from ..desk.history import FactHistory
from ..desk.live import PERIOD, live_facts
from ..desk.log_facts import facts_of_log
from ..desk.server import ViewServer, about
from ..desk.traffic import Traffic
from ..logs.log_part import Window, of_channel
from ..values.errors import LogError
from ..wire import LineCodec
from .command_line import add_command, note, option_group
from .frame_source import add_part, add_times, choose_dbc
from .options import (
    add_bus,
    add_codec,
    add_cycle,
    add_faults,
    add_port,
    add_transfer_timeout,
    bus_settings,
    decoder_of,
    fault_opener,
    keyed_codec,
)

#: Facts of the past of a bus that are kept.
FIVE_MINUTES = round(300 / PERIOD)

DESCRIPTION = """\
Show the lines of a bus, or of a log, in a page of your browser, until Ctrl-C: from above with
their bands of 1, 2 and 3 standard deviations, over time, their correlations, the end-to-end (E2E)
state of each message, what was lost or dropped and why, and the bus load.

The page of a bus goes back five minutes. That of a log has a time line with the faults, and plays
at 0.1 to 10 times the speed. Its keys are under '?'.

The page is for this machine only, unless --host is given."""


def add_view(commands: Any) -> None:
    """Add the command ``view``."""
    example = (
        "maplines view --interface socketcan --channel vcan0\n"
        "         maplines view drive.blf --dbc auto"
    )
    parser = add_command(commands, "view", _view, DESCRIPTION, example)
    parser.add_argument(
        "log",
        metavar="LOG",
        nargs="?",
        help="log file, as for 'decode', of which --channel is a channel (default: the bus)",
    )
    add_bus(parser)
    add_codec(parser)
    add_cycle(parser)
    add_transfer_timeout(parser)
    add_times(parser)
    add_part(parser, channel=False)
    add_faults(parser)
    add_port(parser)
    option_group(parser, "output").add_argument(
        "--host",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="address of this machine on which others reach the page, such as 0.0.0.0; they then "
        "see all that it shows, without a password and without encryption (default: 127.0.0.1, "
        "this machine only)",
    )


def _view(arguments: argparse.Namespace) -> int:
    with (
        suppress(KeyboardInterrupt),
        _source(arguments) as (history, what, run),
        served(history, what, arguments.host, arguments.port) as server,
    ):
        run(server)
        wait_for_ctrl_c()
    return 0


@contextmanager
def served(history: FactHistory, what: Facts, host: str, port: int) -> Iterator[ViewServer]:
    """Serve the page, and print its address.

    Raises:
        BusError: the address cannot be used.
    """
    server = ViewServer(history, what, host, port)
    thread = threading.Thread(target=server.serve_forever, name="maplines view", daemon=True)
    thread.start()
    try:
        note(f"the page is {server.url}; stop with Ctrl-C")
        if not server.is_loopback:
            note(
                f"--host {host}: whoever reaches this machine on port {server.port} can read all "
                "that the page shows"
            )
        yield server
    finally:
        server.close()


def wait_for_ctrl_c() -> None:
    """Wait; Ctrl-C does not end a wait without a limit on Windows."""
    while True:
        time.sleep(1.0)


Source = tuple[FactHistory, dict[str, Any], Callable[[ViewServer], None]]


@contextmanager
def _source(arguments: argparse.Namespace) -> Iterator[Source]:
    """Yield the history, what it is of, and the function that fills it."""
    if arguments.log is None:
        if not Window(arguments.time).is_all:
            raise ValueError("--time is a part of LOG; leave it out on a bus")
        yield from _bus(arguments)
        return
    for option in ("interface", "faults"):
        if getattr(arguments, option) is not None:
            raise ValueError(f"--{option} is of a bus; leave it out, or LOG")
    yield from _log(arguments)


def _traffic(codec: LineCodec, arguments: argparse.Namespace) -> Traffic:
    return Traffic(codec.layout, **({"bitrate": arguments.bitrate} if arguments.bitrate else {}))


def _bus(arguments: argparse.Namespace) -> Iterator[Source]:
    codec = keyed_codec(arguments)
    history = FactHistory(FIVE_MINUTES)
    decoder, traffic = decoder_of(codec, arguments), _traffic(codec, arguments)
    opener, settings = fault_opener(arguments), bus_settings(arguments)
    with live_facts(codec, decoder, traffic, opener, **settings) as live:

        def run(server: ViewServer) -> None:
            for facts in live.each(server.over.wait):
                history.add(facts)

        yield history, about(codec, live.link.name, is_live=True), run


def _log(arguments: argparse.Namespace) -> Iterator[Source]:
    arguments.logs = [arguments.log]
    choose_dbc(arguments)
    codec = keyed_codec(arguments, clock=None)
    log = read_log(arguments.log, times=arguments.times)
    frames = of_channel(log, arguments.channel, arguments.log)
    history = FactHistory()
    what = about(codec, Path(arguments.log).name, is_live=False)

    def read(server: ViewServer) -> None:
        facts = facts_of_log(
            _timed(frames, arguments.log),
            codec,
            channel=arguments.channel,
            decoder=decoder_of(codec, arguments),
            traffic=_traffic(codec, arguments),
        )
        if error := _fill(history, facts, Window(arguments.time), server.over):
            server.about["error"] = error
            note(f"error: {error}")
        history.end()

    def run(server: ViewServer) -> None:
        threading.Thread(target=read, args=(server,), name="maplines log", daemon=True).start()

    yield history, what, run


def _timed(frames: Iterable[LogFrame], name: str) -> Iterator[LogFrame]:
    for frame in frames:
        if not frame.has_time:
            raise LogError(f"{name}: has no time stamps; record it with candump -L")
        yield frame


def _fill(
    history: FactHistory, facts: Iterable[Facts], window: Window, over: threading.Event
) -> str | None:
    """Add the facts in a window until the server is over; return what the page lacks, and why."""
    is_empty = True
    try:
        for one in facts:
            is_empty = False
            if over.is_set() or window.is_over(round(1e9 * one["t"])):
                break
            if window.takes(one["t"], "the log") and not history.add(one):
                return "the log is too long; the page shows its begin only"
    except LogError as error:
        return str(error)
    if is_empty:
        return "the log has no frame of a message of this DBC; take another --dbc, or --dbc auto"
    if not history.contents()["count"]:
        return "there is nothing in --time"
    return None
