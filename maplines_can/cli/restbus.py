"""The command ``maplines restbus``."""

from __future__ import annotations

import argparse
import json
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..bus import Link, LogWriter
from ..bus.clock import Clock, RealClock, VirtualClock, to_ns
from ..logs.log_writer import check_log_path
from ..restbus import Config, Restbus
from ..restbus.config import EXAMPLE
from ..values.arrays import count_text
from ..values.errors import LogError
from ..wire import Frame
from .command_line import add_command, add_json, note, number, option_group, progress_bar, seconds
from .file_arguments import add_force, check_new
from .options import add_bus, add_encoding, bus_settings
from .output import faults_text

if TYPE_CHECKING:
    from ..bus.virtual_time import VirtualTimeBus

DESCRIPTION = """\
Simulate the nodes around a device under test: the positioning ECU with its map lines, and any other
messages of any DBC, with their signals, counters and checksums (AUTOSAR E2E).

CONFIG is a TOML file; 'maplines restbus --example > restbus.toml' writes one with all keys and
comments. It has

  seconds, seed, dbc, faults     run time [s], seed, DBC of the messages, faults at the start
  [bus]                          interface, channel, bitrate, data_bitrate, fd
  [lines]                        scenario, drive, log or script; lines, dbc, fd, pose_error,
                                 period_ms, start_ms
  [[message]]                    name, dbc, cycle_ms, start_ms, count and gap_ms (bursts), on; of
                                 J1939: source_address, priority
  [message.signals]              SIGNAL = number, "named value", a list of them (one a frame),
                                 { count = [0, 9], step = 1 }, { ramp = [-1, 1], period_s = 5 },
                                 { sine = [-1, 1], period_s = 5, phase_deg = 90 } or
                                 { script = "FILE.py:FUNCTION" }
  [message.e2e]                  profile, data_id, data_id_mode, nibble, counter, crc
  [[event]]                      at_s, command

Commands, in events and, while it runs in real time, as rows on standard input:

  set Message.Signal VALUE       reset Message.Signal      fault loss=0.1,dup=0.05 (or drop 0.1)
  start Message                  stop Message              fault off
  start lines                    stop lines                quit (standard input only)

A message of more than 8 bytes is sent as CAN FD, or packet by packet in J1939. What is sent
otherwise than the DBC says is told on standard error, and by --json as "notices".

Deadlines are absolute: cycle times do not drift. With --virtual-time nothing waits, and the frames
are those of a run in real time at its deadlines."""


def add_restbus(commands: Any) -> None:
    """Add the command ``restbus``."""
    example = "maplines restbus restbus.toml --virtual-time --seconds 600 --record out.log"
    parser = add_command(commands, "restbus", _restbus, DESCRIPTION, example)
    parser.add_argument("config", nargs="?", metavar="CONFIG", help="configuration, a TOML file")
    scenario, output = option_group(parser, "scenario"), option_group(parser, "output")
    scenario.add_argument(
        "--seconds", type=seconds, metavar="S", help="run time [s] (default: that of CONFIG)"
    )
    scenario.add_argument(
        "--seed",
        type=number(int, 0, 2**32),
        metavar="N",
        help="seed of random faults and pose errors (default: that of CONFIG, or 0)",
    )
    add_bus(parser)
    add_encoding(parser)
    option_group(parser, "bus").add_argument(
        "--virtual-time",
        action="store_true",
        help="do not wait, and use no bus: only --record or --json; the time begins at 0",
    )
    output.add_argument(
        "--example", action="store_true", help="print a configuration with all keys, and end"
    )
    output.add_argument(
        "--record",
        metavar="FILE",
        help="write the frames into this log: .log (candump), .asc, .blf or .mf4",
    )
    add_force(parser)
    add_json(parser, "the counters")


def _restbus(arguments: argparse.Namespace) -> int:
    if arguments.example:
        print(EXAMPLE.read_text(encoding="utf-8"), end="")
        return 0
    if arguments.config is None:
        raise ValueError("CONFIG is missing; 'maplines restbus --example' prints one")
    if arguments.record:
        check_log_path(Path(arguments.record))
    check_new(arguments, arguments.record)
    config = Config.load(arguments.config, seed=arguments.seed, encoding=arguments.encoding)
    duration = config.seconds if arguments.seconds is None else arguments.seconds
    settings = config.bus | bus_settings(arguments)
    if arguments.virtual_time and duration is None:
        raise ValueError("--virtual-time needs an end; give --seconds, or seconds in CONFIG")
    with ExitStack() as stack:
        clock: RealClock | VirtualClock = VirtualClock() if arguments.virtual_time else RealClock()
        log = None
        if arguments.record:
            log = stack.enter_context(LogWriter(arguments.record, clock.now))

        def sent(frame: Frame, t_ns: int) -> None:
            if log is None:
                return
            try:
                log.write(frame, t_ns / 1e9)
            except LogError:  # the bus would take it for an error of its own
                clock.call_at(clock.now_ns, log.close)  # raises again, where the run ends

        bus: VirtualTimeBus | Link
        if isinstance(clock, VirtualClock):
            from ..bus.virtual_time import VirtualNetwork, VirtualTimeBus

            rates = {name: settings.get(name) for name in ("bitrate", "data_bitrate")}
            network = VirtualNetwork(clock, **rates)
            bus = stack.enter_context(VirtualTimeBus(network))
            if log is not None:
                tap = stack.enter_context(VirtualTimeBus(network))
                tap.add_listener(lambda m: sent(_frame(m), clock.now_ns))
            restbus = Restbus(config, bus, clock)
        else:
            bus = stack.enter_context(Link(**settings))
            restbus = Restbus(config, bus, clock, on_sent=sent, on_error=note)
        for text in config.notices:
            note(text)
        with suppress(KeyboardInterrupt):
            if isinstance(bus, Link) and not arguments.json:
                until = "until Ctrl-C" if duration is None else f"for {duration:g} s"
                note(f"{count_text(len(config.messages), 'message')} on {bus.name}, {until}")
            _run(restbus, clock, duration)
        restbus.stop()
        result = restbus.as_dict() | {"record": arguments.record}
    print(json.dumps(result) if arguments.json else _text(result))
    return 0


def _frame(message: Any) -> Frame:
    return Frame(message.arbitration_id, bytes(message.data), message.is_fd, message.is_extended_id)


def _run(restbus: Restbus, clock: RealClock | VirtualClock, duration: float | None) -> None:
    """Run until the end."""
    restbus.start()
    end_ns = None if duration is None else clock.now_ns + to_ns(duration)
    if isinstance(clock, VirtualClock):
        _run_virtually(clock, end_ns or 0)
    else:
        with _commands(restbus, clock):
            clock.run_until(clock.now_ns + to_ns(1e9) if end_ns is None else end_ns)


def _run_virtually(clock: Clock, end_ns: int) -> None:
    start_ns = clock.now_ns
    shape = "{l_bar}{bar}| {n:.0f}/{total:.0f} s"
    with progress_bar(" s", bar_format=shape, leave=False) as progress:
        while clock.now_ns < end_ns:
            clock.run_until(min(clock.now_ns + to_ns(1.0), end_ns))
            progress((clock.now_ns - start_ns) / 1e9, (end_ns - start_ns) / 1e9)


@contextmanager
def _commands(restbus: Restbus, clock: RealClock) -> Iterator[None]:
    """Read commands from standard input, in a thread, while the simulation runs."""

    def read() -> None:
        for row in sys.stdin:
            if row.strip() == "quit":
                clock.call_at(clock.now_ns, clock.stop)  # after the commands before it
            elif row.strip():
                restbus.command(row)

    if _may_read():
        threading.Thread(target=read, name="commands", daemon=True).start()
    yield


def _may_read() -> bool:
    """Return whether standard input can be read: not from a terminal in the background."""
    try:
        if sys.stdin is None or not sys.stdin.isatty():
            return sys.stdin is not None
        return os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
    except (AttributeError, OSError, ValueError):  # Windows has no process groups
        return True


def _text(result: dict[str, Any]) -> str:
    """Return the counters as text."""
    unsent = ", ".join(f"{n} not sent ({why})" for why, n in result["unsent"].items())
    rows = [
        f"sent {count_text(result['frames'], 'frame')} in {result['seconds']:.3f} s"
        + (f"; {unsent}" if unsent else "")
        + f"; {count_text(result['commands'], 'command')}"
    ]
    for name, counts in result["messages"].items():
        late = ", ".join(f"{1e3 * value:.2f}" for value in counts["lateness"].values())
        rows.append(
            f"  {name:<24} {counts['frames']:>8} frames, "
            f"{count_text(counts['overruns'], 'period')} skipped, "
            f"late by {late} ms (median, 99 %, maximum)"
        )
    if result["faults"]:
        rows.append(f"faults: {faults_text(result['faults'])}")
    return "\n".join(rows)
