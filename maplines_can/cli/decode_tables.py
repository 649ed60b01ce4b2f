"""The command ``maplines decode`` with ``-o``: tables of lines in files."""

from __future__ import annotations

import argparse
import os
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..values.line import Slot
from ..wire import SCENE, SHIPPED, Decoder, default_dbc_path
from .log_input import check_received, note_log
from .options import check_scenes, keyed_codec
from .output import check_text, counts_text, lost_text, owner_text, pose_errors_text
from .overwriting import add_force, check_new
from .parsing import number, option_group
from .stderr import note, progress_bar

#: No log of a car has more channels. Each one needs a decoder, some 16 kB.
MAX_CHANNELS = 256


def add_tables(parser: argparse.ArgumentParser) -> None:
    """Add the options of tables."""
    add = option_group(parser, "output").add_argument
    add(
        "--at",
        type=distances,
        default=(),
        metavar="X,...",
        help="give the lateral position and its standard deviation at these distances ahead of "
        "the car, too [m], such as 0,20,40",
    )
    add("--slots", type=slots, metavar="NAME,...", help="lines of these slots only: ego-left,...")
    add(
        "-o",
        "--out",
        metavar="FILE|FOLDER",
        help="write a table to FILE (.parquet .csv .jsonl .mf4 .mcap), or for many logs a data set "
        "to FOLDER",
    )
    add(
        "--format",
        choices=("parquet", "csv", "jsonl", "mf4", "mcap"),
        default="parquet",
        help="format of the files in FOLDER (default: parquet)",
    )
    add_force(parser)
    scenario = option_group(parser, "output").add_argument
    scenario(
        "--jobs",
        type=number(int, 1, 1024),
        metavar="N",
        help="processes for many logs (default: one for each processor)",
    )
    scenario("--scheduler", metavar="ADDRESS", help="decode on the workers of this Dask scheduler")


def check_tables(arguments: argparse.Namespace) -> None:
    """Raise ValueError if the options contradict each other."""
    if arguments.out is None:
        if len(arguments.logs) > 1:
            raise ValueError(
                f"{len(arguments.logs)} logs: give -o FOLDER, for a data set with a file for each"
            )
        if (arguments.jobs, arguments.scheduler) != (None, None):
            raise ValueError("--jobs and --scheduler are for many logs; give -o FOLDER")


def write_files(arguments: argparse.Namespace) -> int:
    """Write the tables of one log, or of many; return the exit status."""
    from ..recordings.formats import SUFFIXES

    out = Path(arguments.out)
    if out.suffix in SUFFIXES:
        if len(arguments.logs) > 1:
            raise ValueError(f"-o {out}: many logs are a data set; give a folder, without a suffix")
        return _write_file(arguments, out)
    if out.suffix:
        raise ValueError(f"-o {out}: a table has the suffix {', '.join(SUFFIXES)}")
    return _write_folder(arguments, out)


def _write_file(arguments: argparse.Namespace, out: Path) -> int:
    from ..recordings.block_reception import LogReceiver
    from ..recordings.data_set import write_tables
    from ..recordings.formats import About, beside, open_tables

    codec = keyed_codec(arguments, clock=None)
    check_scenes(codec, arguments)
    parts = ["lines", "rejects", *["scenes"] * arguments.scenes]
    path_of = beside(out)
    check_new(arguments, *map(path_of, parts))
    if not out.parent.is_dir():
        raise ValueError(f"-o {out}: there is no folder {out.parent}")
    (log,) = arguments.logs
    receiver = LogReceiver(codec, scenes=arguments.scenes, **_timing(arguments))
    writer = open_tables(path_of, About.of(codec, log, arguments.at), out.suffix)
    tables = _tables(arguments)
    done = 0
    with progress_bar(" frames", unit_scale=True) as progress:

        def count(frames: int) -> None:
            nonlocal done
            done += frames
            progress(done, done)

        source: Any = sys.stdin.buffer if log == "-" else log
        written = write_tables(receiver, source, writer, tables, count)
    status = 0
    if written.damage:
        note(f"error: {written.damage}")
        status = 1
    if receiver.beyond:
        note(beyond_text(log, receiver.beyond))
        status = 1
    if not receiver.has_time:
        note(
            "the log has no time stamps, so nothing that depends on time is checked; use candump -L"
        )
    note_log(log, written.summary)
    note_decoders(receiver.decoders, receiver.last_ns)
    note_slots(arguments, sum(one.lines for one in receiver.decoders.values()), written.lines)
    note(f"written: {' '.join(map(str, written.files))}")
    if receiver.is_empty and (receiver.frames or not status):
        check_received(log, receiver.first, codec, written.summary, has_failed=bool(status))
    return status


def _write_folder(arguments: argparse.Namespace, folder: Path) -> int:
    from ..recordings.data_set import dropped_of, logs_of, write_data_set

    if arguments.keys:
        raise ValueError("a key is for one log: give -o FILE, once for each log")
    check_scenes(keyed_codec(arguments), arguments)
    logs = logs_of(arguments.logs)
    with progress_bar(" logs") as progress:
        results = write_data_set(
            logs,
            folder,
            f".{arguments.format}",
            _tables(arguments),
            jobs=arguments.jobs or os.cpu_count() or 1,
            scheduler=arguments.scheduler,
            progress=lambda done, total, _: progress(done, total),
        )
    bad = [result for result in results if result["error"]]
    for result in bad:
        note(f"error: {result['error']}")
    note(
        f"{sum(result['lines'] for result in results)} lines from "
        f"{sum(result['frames'] for result in results)} frames; logs: {len(results)}, "
        f"{len(bad)} of them with an error; dropped frames: {counts_text(dropped_of(results))}"
    )
    note_slots(arguments, *(sum(result[key] for result in results) for key in ("lines", "rows")))
    note(f"written: {folder}; {folder / 'manifest.jsonl'} has the result of each log")
    return 1 if bad else 0


def _tables(arguments: argparse.Namespace) -> Any:
    from ..recordings.data_set import Tables

    dbc = arguments.dbc
    if dbc in SHIPPED and not Path(dbc).exists():
        dbc = str(default_dbc_path(dbc))
    return Tables(
        at=arguments.at,
        dbc=None if dbc is None else str(Path(dbc).absolute()),
        encoding=arguments.encoding,
        slots=arguments.slots,
        scenes=arguments.scenes,
        times=arguments.times,
        **_timing(arguments),
    )


def _timing(arguments: argparse.Namespace) -> dict[str, float | None]:
    return {"cycle_ms": arguments.cycle_ms, "timeout_ms": arguments.transfer_timeout}


def distances(text: str) -> tuple[float, ...]:
    """Return the distances of ``--at``.

    >>> distances("0,20,-5.5")
    (0.0, 20.0, -5.5)
    """
    from ..recordings.line_tables import checked_at

    try:
        return checked_at([float(part) for part in text.split(",")])
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"must be numbers such as 0,20,40: {error}") from None


def slots(text: str) -> tuple[Slot, ...]:
    """Return the slots of ``--slots``.

    >>> slots("ego-left,route")
    (<Slot.EGO_LEFT: 0>, <Slot.ROUTE: 7>)
    """
    try:
        return tuple(Slot[part.strip().upper().replace("-", "_")] for part in text.split(","))
    except KeyError as error:
        names = ", ".join(slot.name.lower().replace("_", "-") for slot in Slot)
        raise argparse.ArgumentTypeError(f"{error} is no slot; they are {names}") from None


def beyond_text(log: str, frames: int) -> str:
    """Return the error of frames of too many channels."""
    return (
        f"error: {log}: {frames} frames are not read, they are of "
        f"channels beyond the first {MAX_CHANNELS}; split the log by channel"
    )


def note_slots(arguments: argparse.Namespace, received: int, kept: int) -> None:
    """Say that ``--slots`` leaves out all lines, if it does."""
    if received and not kept:
        names = ",".join(slot.name.lower().replace("_", "-") for slot in arguments.slots or ())
        note(f"none of the {received} lines is of --slots {names}")


def note_decoders(decoders: Mapping[str, Decoder], last_ns: int) -> None:
    """Print the counters of all frames, and the state of each owner at the end of the log."""
    each: Sequence[Decoder] = [*decoders.values()]
    total = sum((one.counts for one in each), Counter())
    has_scenes = any(SCENE in one.checks for one in each)
    left_out = sum(one.left_out for one in each)
    note(
        f"{sum(one.lines for one in each)} lines"
        f"{pose_errors_text(sum(one.pose_errors for one in each))} from "
        f"{sum(one.frames for one in each)} frames; "
        f"{lost_text(sum(one.lost for one in each), scenes=has_scenes)}; "
        f"{f'{left_out} lines left out by the sender; ' * bool(left_out)}"
        f"dropped frames: {counts_text({reason.name: n for reason, n in total.items()})}"
    )
    for channel, decoder in decoders.items():
        where = f"{channel} " if len(each) > 1 else ""
        for owner, stats in decoder.messages(last_ns).items():
            note(f"{where}{owner_text(owner)}: {check_text(stats)}")
