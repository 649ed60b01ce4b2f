"""Input of ``maplines consume``: scenes of a bus or a log at even times, and how the car moves."""

from __future__ import annotations

import argparse
import csv
import math
import time
from array import array
from collections.abc import Callable, Container, Generator, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..bus import Link, LogSummary, Receiver, SignalDecoder, read_log, read_signals
from ..desk.facts import Facts, facts_of
from ..logs.first_frames import FirstFrames
from ..logs.log_part import Window, of_channel
from ..propagation import Motion
from ..simulation.drive_columns import COLUMNS
from ..values.arrays import count_text
from ..values.input_files import lines_of
from ..wire import LineCodec, SceneView
from .command_line import add_json, note, number, option_group, seconds, with_progress
from .frame_source import ObservedLink, add_part, add_times, note_log, why_silent
from .options import (
    add_bus,
    add_codec,
    add_cycle,
    add_transfer_timeout,
    bus_settings,
    decoder_of,
    keyed_codec,
)
from .output import counts_text

#: Period of the consumers [s].
PERIOD = 0.05
#: What to check if there are lines, but no scene.
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
        help="log file, as of 'decode', of which --channel is a channel (default: receive from the "
        "bus)",
    )
    add_bus(parser)
    add_codec(parser)
    add_cycle(parser)
    add_transfer_timeout(parser)
    add_times(parser)
    add_part(parser, channel=False)
    add = option_group(parser, "output").add_argument
    add("--seconds", type=seconds, metavar="S", help="stop after this time [s]")
    add(
        "--every",
        type=number(float, PERIOD, 3600),
        default=1.0,
        metavar="S",
        help=f"time between two rows of {what} [s], {PERIOD:g} or more (default: 1)",
    )
    add_json(parser, "each row")


class ConsumerCycle(NamedTuple):
    """One period of a consumer."""

    since_ns: int  #: time since the first one, on a clock that is never set back [ns]
    now_ns: int  #: time on the clock of the frames' time stamps [ns]
    view: SceneView

    @property
    def t(self) -> float:
        """Time since the first one [s]."""
        return self.since_ns / 1e9


#: Rows of a Parquet file that are read at a time.
BATCH = 10_000

#: Time since the start of some clock [ns], and a cycle without its time.
Found = tuple[int, int, SceneView]


class Input:
    """Newest scene of a bus or of a log, 20 times a second, until the end or Ctrl-C.

    ``with`` returns the iterator over the cycles, and ends at Ctrl-C without an error.

    Raises:
        ValueError: the DBC has no message of the pose error, or ``--time`` is given for a bus.
    """

    def __init__(self, arguments: argparse.Namespace) -> None:
        codec = scene_codec(arguments)
        self._window = Window(arguments.time)
        if not (arguments.log or self._window.is_all):
            raise ValueError("--time is a part of LOG; on a bus, --seconds ends the command")
        self._arguments, self._decoder = arguments, decoder_of(codec, arguments)
        self._codec, self._first, self._is_cut = codec, FirstFrames(), False
        self.summary = LogSummary()  #: of the log
        self._link: ObservedLink | None = None
        self._receiver: Receiver | None = None

    def __enter__(self) -> Generator[ConsumerCycle, None, None]:
        self._cycles = self._counted()
        return self._cycles

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> bool:
        self._cycles.close()
        if self._arguments.log:
            note_log(self._arguments.log, self.summary)
        return kind is KeyboardInterrupt

    @property
    def name(self) -> str:
        """Name of the log or of the interface, for the page."""
        if self._arguments.log:
            return Path(self._arguments.log).name
        return " ".join(filter(None, (self._arguments.interface, self._arguments.channel))) or "bus"

    def facts(self, now_ns: int) -> Facts:
        """Return the facts of the lines now, for the page; ``now_ns`` counts in a log only."""
        if self._receiver is None:
            return facts_of(self._decoder, self._codec.layout, now_ns)
        return facts_of(self._receiver, self._codec.layout)

    @property
    def skipped(self) -> dict[str, int]:
        """Records of the log so far that are no data frames, by kind, for JSON."""
        return {str(kind): n for kind, n in self.summary.skipped.items()}

    def report_nothing(self, what: str) -> int:
        """Print that there was nothing to use, and what to check; return the exit status.

        It is 0 if --seconds or --time leaves out what there may be. Call it after the cycles.

        Args:
            what: that was not there.
        """
        decoder, log = self._decoder, self._arguments.log
        pose_errors = count_text(decoder.pose_errors, "pose error")
        counts = f"{count_text(decoder.lines, 'line')} and {pose_errors}"
        if not (decoder.lines or decoder.pose_errors):
            why = self._why_silent()
        elif self._is_cut or not self._window.is_all:
            most, window = self._arguments.seconds, self._window
            parts = [] if most is None else [f"--seconds {most:g}"]
            parts += [] if window.is_all else ["--time"]
            note(f"{what} in {' and '.join(parts)}, with {counts}")
            return 0
        elif not decoder.pose_errors:
            why = SENDER
        else:
            why = (
                f"{counts} have been received; check whether they are too old, incomplete or not "
                "of the ego lane: 'maplines receive' and 'decode' print them"
            )
        note(f"error: {what}; {f'{log}: ' if log else ''}{why}")
        return 1

    def _why_silent(self) -> str:
        """Return why neither a line nor a pose error was received."""
        if self._link is not None:
            counts, fd = self._decoder.counts, self._arguments.fd
            return why_silent(self._link, self._codec, counts, fd=fd)
        from ..recordings.fitting import misfit

        return misfit(self._first, [self._codec], self.summary).text

    def _counted(self) -> Generator[ConsumerCycle, None, None]:
        first, most = None, self._arguments.seconds
        found = self._from_log() if self._arguments.log else self._from_bus()
        for mono_ns, now_ns, view in found:
            first = mono_ns if first is None else first
            is_over = most is not None and mono_ns - first >= most * 1e9
            if is_over or self._window.is_over(mono_ns):
                found.close()
                self._is_cut = bool(self._arguments.log)
                return
            if self._window.has(mono_ns / 1e9):
                yield ConsumerCycle(mono_ns - first, now_ns, view)

    def _from_log(self) -> Generator[Found, None, None]:
        path, decoder = self._arguments.log, self._decoder
        step = round(PERIOD * 1e9)
        due: int | None = None
        log = read_log(path, times=self._arguments.times)
        self.summary = log.summary
        frames = of_channel(log, self._arguments.channel, path)
        for frame in with_progress(frames, " frames"):
            if not frame.has_time:
                raise ValueError(f"LOG: {path} has no time stamps; record it with candump -L")
            if not decoder.lines:
                self._first.add(frame)
            due = frame.t_ns + step if due is None else due
            if frame.t_ns - due > 60 * 10**9:  # a pause, not a drive
                due = frame.t_ns
            while frame.t_ns >= due:
                yield due, due, decoder.latest_scene(due)
                due += step
            decoder.feed(frame.can_id, frame.data, frame.t_ns, is_extended=frame.is_extended)
            if decoder.lines:
                self._window.see(frame.t_ns / 1e9, path)
        if due is not None:
            yield due, due, decoder.latest_scene(due)

    def _from_bus(self) -> Generator[Found, None, None]:
        with ExitStack() as stack:
            link = ObservedLink(self._decoder, **bus_settings(self._arguments))
            self._link = stack.enter_context(link)
            receiver = Receiver(link, self._decoder, on_line=lambda _: None, can_ids=None)
            self._receiver = stack.enter_context(receiver)
            if not self._arguments.json:
                note(f"listening on {link.name}; stop with Ctrl-C")
            due = time.monotonic()
            while True:
                yield time.monotonic_ns(), receiver.now_ns(), receiver.latest_scene()
                due = max(due + PERIOD, time.monotonic())
                receiver.wait(max(0.0, due - time.monotonic()))


def scene_codec(arguments: argparse.Namespace) -> LineCodec:
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


def table_rows(path: str, wanted: Container[str], most: int) -> Iterator[dict[str, Any]]:
    """Yield the rows of a table with a header, .parquet or CSV, with the columns that are wanted.

    Raises:
        ValueError: the file is no such table, or has more than ``most`` rows.
        OSError: it cannot be read.
        MissingExtraError: .parquet without pyarrow.
    """
    rows = _parquet_rows if Path(path).suffix.lower() == ".parquet" else _csv_rows
    for count, row in enumerate(rows(path, wanted)):
        if count == most:
            raise ValueError(f"{path}: has more than {most} rows; divide it into several")
        yield row


def _parquet_rows(path: str, wanted: Container[str]) -> Iterator[dict[str, Any]]:
    from ..simulation.parquet_files import parquet_batches

    def choose(names: list[str]) -> list[str]:
        return [name for name in names if name in wanted]

    for batch in parquet_batches(Path(path), choose, BATCH, ValueError):
        columns = [c if isinstance(c, list) else c.tolist() for c in batch.values()]
        for row in zip(*columns, strict=True):
            yield dict(zip(batch, row, strict=True))


def _csv_rows(path: str, wanted: Container[str]) -> Iterator[dict[str, Any]]:
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            for row in csv.DictReader(lines_of(file, path, ValueError)):
                yield {name: value for name, value in row.items() if name in wanted}
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: is not a CSV file: {error}") from error


#: Standard deviations of a known motion [m/s, rad/s].
MOTION_SIGMA = (0.1, 0.005)

#: Quantities of a motion.
QUANTITIES = ("speed", "yaw_rate")
_MOTION = {name for name, (quantity, _) in COLUMNS.items() if quantity in QUANTITIES}
#: Most records of a table; an hour at 100 Hz has 360 000.
MAX_RECORDS = 2_000_000
#: Oldest signal of a bus that counts [s].
OLDEST = 0.5
#: Time of a signal that does not count [ns].
NEVER_NS = -(10**18)
#: How long to wait for a further frame [s], and most frames that are read in a cycle.
POLL, MOST = 0.001, 50

Series = tuple[NDArray[np.float64], NDArray[np.float64]]
#: Returns the motion at the time now on the clock of the map lines [ns]; None if it is unknown.
MotionAt = Callable[[int], Motion | None]


def add_motion(parser: argparse.ArgumentParser) -> None:
    """Add the options of the motion."""
    add = option_group(parser, "scenario").add_argument
    add(
        "--motion",
        metavar="FILE",
        help="table of the motion, .csv or .parquet, with columns time [s], on the clock of the "
        "log, speed [m/s] and yaw_rate [rad/s], such as the truth of maplines drive; or, with "
        "--signals, a bus log of the car",
    )
    add(
        "--signals",
        metavar="FILE",
        help="table of the signals of the motion in the bus log --motion, by default in LOG, or, "
        "without LOG, on the bus, whose channel is opened a second time for them; in TOML, such as "
        'speed_kmh = "ESP.VehicleSpeed" and yaw_rate_deg_s = "ESP.YawRate", or in CSV with the '
        "header column,signal",
    )
    add("--signals-dbc", metavar="FILE", help="DBC of these signals: that of the car")
    add(
        "--signals-channel",
        metavar="NAME",
        help="channel of the bus with these signals (default: that of the map lines)",
    )
    add("--speed", type=number(float, -100, 100), metavar="M/S", help="constant speed [m/s]")


@contextmanager
def motion_of(arguments: argparse.Namespace, default: Motion) -> Iterator[MotionAt]:
    """Yield a function from the time now [ns] to the motion.

    It returns ``default`` if no option says the motion, and None if it should, but is unknown.

    Raises:
        ValueError: options do not fit together, or a table is wrong.
        MaplinesError: signals cannot be read, or the interface cannot be opened.
    """
    if (arguments.signals is None) != (arguments.signals_dbc is None):
        raise ValueError("--signals and --signals-dbc go together: the names, and their DBC")
    if arguments.speed is not None and (arguments.motion or arguments.signals):
        raise ValueError("--speed is that of a car without --motion and --signals; leave it out")
    if arguments.signals_channel and (arguments.log or not arguments.signals):
        raise ValueError("--signals-channel is that of --signals on a bus, without LOG")
    if arguments.motion and not arguments.log:
        raise ValueError("--motion needs LOG, the map lines of the same clock")
    if arguments.signals and not arguments.log:
        with _live(arguments) as motion:
            yield motion
    elif arguments.motion or arguments.signals:
        yield _recorded(_signals(arguments) if arguments.signals else _table(arguments.motion))
    else:
        if arguments.speed is not None:
            sigma = (MOTION_SIGMA[0], math.sqrt(default.cov[1, 1]))
            default = Motion.with_sigma(arguments.speed, 0.0, sigma)
        yield lambda _: default


@contextmanager
def _live(arguments: argparse.Namespace) -> Iterator[MotionAt]:
    """Yield the motion of the newest signals on a bus; unknown if they are too old."""
    source = f"--signals {arguments.signals}"
    decoder = SignalDecoder(arguments.signals_dbc, arguments.signals, encoding=arguments.encoding)
    units = {name: COLUMNS.get(name, (name, 1.0)) for name in decoder.names}
    _check_quantities({quantity for quantity, _ in units.values()}, source)
    settings = bus_settings(arguments)
    settings |= {"channel": arguments.signals_channel or settings.get("channel")}
    newest: dict[str, tuple[int, float]] = {}  # time [ns] and value by quantity
    last_ns: int | None = None

    with Link(**settings) as link:
        link.accept_only(decoder.can_ids)

        def motion(now_ns: int) -> Motion | None:
            nonlocal last_ns
            # After a pause, what arrives may have waited for all of it.
            is_late = last_ns is None or abs(now_ns - last_ns) > 1e9 * OLDEST
            last_ns = now_ns
            for name, value in _arrived(link, decoder):
                quantity, factor = units[name]
                newest[quantity] = NEVER_NS if is_late else now_ns, factor * value
            known = [newest.get(quantity, (NEVER_NS, 0.0)) for quantity in QUANTITIES]
            if any(abs(now_ns - t_ns) > 1e9 * OLDEST for t_ns, _ in known):
                return None
            return Motion.with_sigma(known[0][1], known[1][1], MOTION_SIGMA)

        yield motion
    if missing := [quantity for quantity in QUANTITIES if quantity not in newest]:
        note(f"{source}: no {' and no '.join(missing)} has arrived; check --signals-channel")
    if damage := decoder.damage():
        note(f"{source}: skipped: {counts_text(damage)}")
    for mixture in decoder.mixtures():
        note(f"{source}: {mixture}")


def _arrived(link: Link, decoder: SignalDecoder) -> Iterator[tuple[str, float]]:
    """Yield names and values of the signals that have arrived."""
    for _ in range(MOST):
        message = link.recv(POLL)
        if message is None:
            return
        if not (message.is_error_frame or message.is_remote_frame):
            can_id, data = message.arbitration_id, bytes(message.data)
            found = decoder.decode(can_id, data, is_extended=message.is_extended_id)
            yield from ((name, value) for name, value in found.items() if math.isfinite(value))


def _recorded(table: Mapping[str, Series]) -> MotionAt:
    speed, yaw_rate = (table[quantity] for quantity in QUANTITIES)

    def motion(now_ns: int) -> Motion:
        at_speed, at_rate = (float(np.interp(now_ns / 1e9, *one)) for one in (speed, yaw_rate))
        return Motion.with_sigma(at_speed, at_rate, MOTION_SIGMA)

    return motion


def _table(path: str) -> dict[str, Series]:
    """Return the series of a table."""
    values: dict[str, array[float]] = {}
    try:
        for row in table_rows(path, {"time", *_MOTION}, MAX_RECORDS):
            for name, value in row.items():
                values.setdefault(name, array("d")).append(float(value))
        t = np.array(values.pop("time") if values else ())
        found = {name: (t, np.array(series)) for name, series in values.items()}
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"--motion {path} must have numbers in the columns time, speed and yaw_rate; the first "
            f"problem: {error}"
        ) from error
    return _in_si_units(found, f"--motion {path}")


def _signals(arguments: argparse.Namespace) -> dict[str, Series]:
    """Return the series of signals in a log."""
    log = arguments.motion or arguments.log
    found = read_signals(
        log,
        arguments.signals_dbc,
        arguments.signals,
        encoding=arguments.encoding,
        times=arguments.times,
    )
    if log != arguments.log:
        note_log(log, found.log)
    if found.skipped:
        note(f"{log}: skipped: {counts_text(found.skipped)}")
    return _in_si_units(found, f"--signals {arguments.signals}")


def _in_si_units(found: Mapping[str, Series], source: str) -> dict[str, Series]:
    """Return speed and yaw rate of series by column names such as ``speed_kmh``.

    Raises:
        ValueError: one of them is missing, or its times do not increase.
    """
    table: dict[str, Series] = {}
    for name, (t, values) in found.items():
        quantity, factor = COLUMNS.get(name, (name, 1.0))
        if quantity not in QUANTITIES:
            continue
        if not len(t) or not (np.diff(t) > 0).all() or not np.isfinite(values).all():
            raise ValueError(f"{source}: {name} must have finite values with increasing time")
        table[quantity] = t, factor * values
    _check_quantities(table, source)
    return table


def _check_quantities(found: Container[str], source: str) -> None:
    """Raise ValueError if there is no speed or no yaw rate."""
    for quantity in QUANTITIES:
        if quantity not in found:
            names = " or ".join(name for name, (of, _) in COLUMNS.items() if of == quantity)
            raise ValueError(f"{source} must have values, with increasing times, of {names}")
