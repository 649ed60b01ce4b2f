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

from ..bus import Link, Receiver, read_log
from ..values.input_files import lines_of
from ..wire import Codec, SceneView
from .fitting_dbc import MAX_IDS, dbc_hint
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
        self._codec, self._can_ids = codec, set[int]()

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
        return kind is KeyboardInterrupt

    def why_nothing(self) -> str:
        """Return what to check if no scene could be used; call it after the cycles."""
        decoder, codec = self._decoder, self._codec
        if not decoder.frames:
            if self._arguments.log:
                return "the log has no frame"
            return (
                "no frame of the messages of --dbc has arrived; check that the sender runs, on the "
                "same --interface and --channel"
                + ", and whether it sends CAN FD (--fd)"
                * (not self._arguments.fd)
            )
        if not (decoder.lines or decoder.pose_errors):
            counts = {reason.name: count for reason, count in decoder.counts.items()}
            hint = dbc_hint(self._can_ids or codec.can_ids, codec, decoder.counts)
            return (
                f"none of {decoder.frames} frames completed a line (dropped: "
                f"{counts_text(counts)}); "
                + (hint or "check whether --dbc and the keys are those of the sender")
            )
        if not decoder.pose_errors:
            return SENDER
        return (
            f"{decoder.lines} lines and {decoder.pose_errors} pose errors have been received; "
            "check whether they are too old, incomplete or not of the ego lane: 'maplines receive' "
            "and 'decode' print them"
        )

    def _counted(self) -> Generator[ConsumerCycle, None, None]:
        first, most = None, self._arguments.seconds
        found = self._from_log() if self._arguments.log else self._from_bus()
        for mono_ns, now_ns, view in found:
            first = mono_ns if first is None else first
            if most is not None and mono_ns - first >= most * 1e9:
                found.close()
                return
            yield ConsumerCycle(mono_ns - first, now_ns, view)

    def _from_log(self) -> Generator[Found, None, None]:
        path, decoder = self._arguments.log, self._decoder
        step = round(PERIOD * 1e9)
        due: int | None = None
        for frame in with_progress(read_log(path), " frames"):
            if not frame.has_time:
                raise ValueError(f"LOG: {path} has no time stamps; record it with candump -L")
            if len(self._can_ids) < MAX_IDS:
                self._can_ids.add(frame.can_id)
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
            link = stack.enter_context(Link(**bus_settings(self._arguments)))
            receiver = stack.enter_context(Receiver(link, self._decoder, on_line=lambda _: None))
            if not self._arguments.json:
                note(f"listening on {link.name}; stop with Ctrl-C")
            due = time.monotonic()
            while True:
                yield time.monotonic_ns(), receiver.now_ns(), receiver.latest_scene()
                due = max(due + PERIOD, time.monotonic())
                receiver.wait(max(0.0, due - time.monotonic()))


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
