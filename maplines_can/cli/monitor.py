"""The command ``maplines monitor``."""

from __future__ import annotations

import argparse
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..desk.console import Console, check_terminal, has_colours, has_unicode, open_console
from ..desk.live import live_facts
from ..desk.screen import Painter
from ..desk.terminal import ASCII, Look
from ..desk.traffic import Traffic
from ..desk.watch import Watch
from .command_line import add_command, natural, number, option_group, seconds
from .options import (
    add_bus,
    add_codec,
    add_cycle,
    add_faults,
    add_transfer_timeout,
    bus_settings,
    decoder_of,
    fault_opener,
    keyed_codec,
)

DESCRIPTION = """\
Show the lines of a bus in this terminal, also over ssh: state, age and lost records of each line,
its lateral position with its standard deviation, the road from above, width and centre of the ego
lane, dropped frames by reason, the last changes and, if there is room, the messages by CAN ID.

In the road, | is the mean of a line, and = - . are 1, 2 and 3 standard deviations (with UTF-8, a
bar and shades of grey); : is a line that must not be used, < and > are beyond the edges.

Keys: q or Ctrl-C ends, p pauses the picture while counting goes on, and plays; f or / asks for a
text, and shows what has it in its name (Enter keeps it, Esc does not); r counts from 0, without
filter. Colours follow TERM and NO_COLOR. For a pipe or a file there is 'maplines receive'."""


def add_monitor(commands: Any) -> None:
    """Add the command ``monitor``."""
    example = "maplines monitor --interface socketcan --channel vcan0"
    parser = add_command(commands, "monitor", _monitor, DESCRIPTION, example)
    add_bus(parser)
    add_codec(parser)
    add_cycle(parser)
    add_transfer_timeout(parser)
    add_faults(parser)
    add = option_group(parser, "output").add_argument
    add(
        "--at",
        type=number(float, -1000, 1000),
        nargs="+",
        default=[20.0, 40.0],
        metavar="X",
        help="x at which the lateral position is told, and the ego lane with that at 0 [m] "
        "(default: 20 40)",
    )
    add(
        "--span",
        type=number(float, 0.1, 1000),
        default=7.0,
        metavar="Y",
        help="lateral distance from the car to the edges of the road from above [m] (default: 7)",
    )
    add(
        "--rate",
        type=number(float, 0.1, 50),
        default=4.0,
        metavar="HZ",
        help="how often the screen is drawn (default: 4)",
    )
    add(
        "--ascii", action="store_true", help="show ASCII only (default: if the locale has no UTF-8)"
    )
    add("--count", type=natural, metavar="N", help="end after drawing facts N times")
    add("--seconds", type=seconds, metavar="S", help="end after this time [s]")


def _monitor(arguments: argparse.Namespace) -> int:
    check_terminal()
    codec = keyed_codec(arguments)
    traffic = Traffic(codec.layout, **({"bitrate": arguments.bitrate} if arguments.bitrate else {}))
    decoder, opener = decoder_of(codec, arguments), fault_opener(arguments)
    with live_facts(codec, decoder, traffic, opener, **bus_settings(arguments)) as live:
        look = Look(
            name=live.link.name,
            dbc=Path(codec.layout.source).name,
            at=tuple(arguments.at),
            span=arguments.span,
            **(ASCII if arguments.ascii or not has_unicode() else {}),
        )
        watch = Watch(look)
        with suppress(KeyboardInterrupt), open_console(watch.say) as console:
            _show(live, _Display(watch, console, arguments.seconds), arguments)
    return 0


class _Display:
    """The screen of a watch, until a key or the time ends it."""

    def __init__(self, watch: Watch, console: Console, duration: float | None) -> None:
        self.watch, self._console = watch, console
        self._painter = Painter(colours=has_colours())
        self._end = None if duration is None else time.monotonic() + duration

    def draw(self) -> None:
        """Write what has changed."""
        if self._console.is_blank():
            self._painter.forget()
        size = self._console.size()
        if text := self._painter.paint(self.watch.rows(*size), *size):
            self._console.write(text)

    def is_over(self, wait: float) -> bool:
        """Wait for a time [s], and draw what keys change; return whether to end."""
        now = time.monotonic()
        until = now + wait if self._end is None else min(now + wait, self._end)
        while True:
            if not self.watch.press(self._console.wait(max(0.0, until - now))):
                return True
            now = time.monotonic()
            if now >= until:
                return self._end is not None and now >= self._end
            self.draw()  # there was a key, or the size or the screen has changed


def _show(live: Any, display: _Display, arguments: argparse.Namespace) -> None:
    for count, facts in enumerate(live.each(display.is_over, 1 / arguments.rate), 1):
        display.watch.add(facts)
        display.draw()
        if count == arguments.count:
            break
