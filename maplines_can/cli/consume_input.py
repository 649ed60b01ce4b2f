"""Input of ``maplines consume``: scenes from a bus or from a log, at even times."""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Container, Generator, Iterator
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

from ..bus import LogSummary, Receiver, read_log
from ..logs.first_frames import FirstFrames
from ..values.input_files import lines_of
from ..wire import LineCodec, SceneView
from .log_input import add_times, note_log
from .observed_link import ObservedLink, why_silent
from .options import (
    add_bus,
    add_codec,
    add_cycle,
    add_transfer_timeout,
    bus_settings,
    decoder_of,
    keyed_codec,
)
from .parsing import add_json, number, option_group, seconds
from .stderr import note, with_progress

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
        help="log file, as of 'decode' (default: receive from the bus)",
    )
    add_bus(parser)
    add_codec(parser)
    add_cycle(parser)
    add_transfer_timeout(parser)
    add_times(parser)
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
        ValueError: the DBC has no message of the pose error.
    """

    def __init__(self, arguments: argparse.Namespace) -> None:
        codec = scene_codec(arguments)
        self._arguments, self._decoder = arguments, decoder_of(codec, arguments)
        self._codec, self._first, self._is_cut = codec, FirstFrames(), False
        self.summary = LogSummary()  #: of the log
        self._link: ObservedLink | None = None

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
    def skipped(self) -> dict[str, int]:
        """Records of the log so far that are no data frames, by kind, for JSON."""
        return {str(kind): n for kind, n in self.summary.skipped.items()}

    def report_nothing(self, what: str) -> int:
        """Print that there was nothing to use, and what to check; return the exit status.

        It is 0 if --seconds leaves out what there may be. Call it after the cycles.

        Args:
            what: that was not there.
        """
        decoder, log = self._decoder, self._arguments.log
        counts = f"{decoder.lines} lines and {decoder.pose_errors} pose errors"
        if not (decoder.lines or decoder.pose_errors):
            why = self._why_silent()
        elif self._is_cut:
            note(f"{what} in --seconds {self._arguments.seconds:g}, with {counts}")
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
            if most is not None and mono_ns - first >= most * 1e9:
                found.close()
                self._is_cut = bool(self._arguments.log)
                return
            yield ConsumerCycle(mono_ns - first, now_ns, view)

    def _from_log(self) -> Generator[Found, None, None]:
        path, decoder = self._arguments.log, self._decoder
        step = round(PERIOD * 1e9)
        due: int | None = None
        frames = read_log(path, times=self._arguments.times)
        self.summary = frames.summary
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
        if due is not None:
            yield due, due, decoder.latest_scene(due)

    def _from_bus(self) -> Generator[Found, None, None]:
        with ExitStack() as stack:
            link = ObservedLink(self._decoder, **bus_settings(self._arguments))
            self._link = stack.enter_context(link)
            receiver = Receiver(link, self._decoder, on_line=lambda _: None, can_ids=None)
            stack.enter_context(receiver)
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
