"""Many logs as one data set: a file of tables a log, written by many processes, and resumable."""

from __future__ import annotations

import glob
import json
import math
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from ..engines import Result, Task, in_processes, in_this_process, on_dask
from ..logs.log_part import ALL, Time, Window, of_channel
from ..logs.log_summary import LogSummary, Times
from ..values.arrays import count_text
from ..values.errors import LogError
from ..values.input_files import json_of
from ..values.line import Slot
from ..values.output_files import write_error
from ..wire import Codec
from .block_reception import MAX_CHANNELS, LogReceiver
from .blocks import read_blocks
from .fitting import misfit
from .formats import About, TableWriter, open_tables
from .line_tables import checked_at
from .read_lines import name_of, tables_of

#: Suffixes of logs in a directory, also compressed (.gz).
LOG_SUFFIXES = (*(".log", ".asc", ".blf", ".crtd", ".trc", ".mf4", ".db", ".pcap", ".pcapng"),)
#: Results of the logs, a JSON object a line.
MANIFEST = "manifest.jsonl"


class Tables(NamedTuple):
    """What the tables of logs have; the members but the last are those of `read_lines`."""

    at: tuple[float, ...] = ()
    dbc: str | None = None
    encoding: str | None = None
    slots: tuple[Slot, ...] | None = None
    scenes: bool = False
    cycle_ms: float | None = None
    timeout_ms: float | None = None
    times: Times = "auto"
    time: Time = ALL
    channel: str | None = None
    bands: bool = True  #: as in `open_tables`


class Written(NamedTuple):
    """What was written of a log.

    Args:
        files: of the tables.
        lines: in the table of lines.
        damage: why the log is damaged, or nothing.
        summary: of the log.
    """

    files: list[Path]
    lines: int
    damage: str
    summary: LogSummary


def logs_of(places: Iterable[str]) -> list[Path]:
    """Return the logs of files, directories and patterns, each once; those of one place sorted.

    A directory has the logs of all folders in it, known by `LOG_SUFFIXES`.

    Raises:
        LogError: a place has no log.
    """
    found: dict[Path, None] = {}
    for place in places:
        path = Path(place)
        if path.is_dir():
            here = sorted(one for one in path.rglob("*") if one.is_file() and _is_log(one))
        elif path.exists() or not glob.has_magic(place):
            here = [path]
        else:
            here = [Path(one) for one in sorted(glob.glob(place, recursive=True))]
        if not here:
            raise LogError(f"{place}: has no log ({', '.join(LOG_SUFFIXES)})")
        found |= dict.fromkeys(here)
    return [*found]


def _is_log(path: Path) -> bool:
    name = path.with_suffix("") if path.suffix == ".gz" else path
    return name.suffix.lower() in LOG_SUFFIXES and not path.name.startswith(".")


def write_tables(
    receiver: LogReceiver,
    log: Any,
    writer: TableWriter,
    tables: Tables,
    progress: Callable[[int], None] = lambda _frames: None,
) -> Written:
    """Write the tables of a log.

    Raises:
        LogError: the log cannot be opened, or has no good record.
        OSError: a file cannot be written.
    """
    checked_at(tables.at)
    damage, lines, frames, name = "", 0, 0, name_of(log)
    window = Window(tables.time)
    try:
        blocks = of_channel(read_blocks(log, times=tables.times), tables.channel, name)
        try:
            for table in tables_of(
                receiver, blocks, tables.at, tables.slots,
                scenes=tables.scenes, window=window, name=name,
            ):  # fmt: skip
                lines += len(table)
                writer.write(table)
                progress(receiver.frames - frames)
                frames = receiver.frames
        except LogError as error:
            if not receiver.frames:
                raise
            damage = str(error)
        return Written(writer.close(), lines, damage, blocks.summary)
    except OSError as error:
        writer.abort()
        raise write_error(error, writer.path) from None
    except BaseException:
        writer.abort()
        raise


def write_data_set(
    logs: Sequence[Path],
    folder: Path,
    suffix: str,
    tables: Tables,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    progress: Callable[[int, int, Result], None] = lambda _done, _total, _result: None,
) -> list[Result]:
    """Write the tables of many logs to ``folder/lines``, ``folder/rejects`` and so on.

    Each log has a file of its own in each. A log whose result is in the manifest is not read again,
    if it has not changed: so a run that was stopped goes on. A log that cannot be read is an entry
    with its error, and the others are not affected.

    Args:
        logs: their paths.
        folder: of the data set; it is made if there is none.
        suffix: of the files, such as ``.parquet``.
        tables: what they have.
        jobs: processes of this machine.
        scheduler: address of a Dask scheduler whose workers have the same files; or None.
        progress: called with the finished logs, all logs and the result of one.

    Returns:
        The results of all logs, in their order: ``log``, ``frames``, ``lines``, ``dropped``,
        ``error``, ``files``, which are relative to the folder, ``rows`` of the table of lines, and
        ``format``, ``times``, ``skipped`` and ``notices`` of the `LogSummary`.

    Raises:
        ValueError: the folder has tables of other options, or files of another format.
        EngineError: the workers fail. Finished logs are kept.
        OSError: the folder cannot be written.
    """
    names = _names(logs)
    time = [t if math.isfinite(t) else None for t in tables.time]
    options = tables._asdict() | {"time": time}
    wanted = {"suffix": suffix, "tables": json.loads(json.dumps(options))}
    results = _known(folder, wanted, dict(zip(map(str, logs), names, strict=True)))
    for left in [*folder.rglob(".*.part")]:  # of workers that were killed
        if left.is_dir():
            shutil.rmtree(left)
        else:
            left.unlink(missing_ok=True)
    total = len(logs)
    for done, known in enumerate(results.values(), 1):
        progress(done, total, known)
    work = (
        Task(str(log), partial(decode_log, str(log), str(folder), name, suffix, tables))
        for log, name in zip(logs, names, strict=True)
        if str(log) not in results
    )
    if len(results) < total:
        engine = _engine(work, jobs, scheduler)
        with closing(engine), (folder / MANIFEST).open("a") as manifest:
            for key, result in engine:
                results[key] = result
                print(json.dumps(result), file=manifest, flush=True)
                progress(len(results), total, result)
    return [results[str(log)] for log in logs]


def _engine(work: Iterator[Task], jobs: int, scheduler: str | None) -> Any:
    if scheduler is not None:
        return on_dask(work, scheduler, f"maplines-decode-{os.getpid()}")
    return in_processes(work, jobs) if jobs > 1 else in_this_process(work)


def decode_log(log: str, folder: str, name: str, suffix: str, tables: Tables) -> Result:
    """Write the tables of a log of a data set; return its result. No log raises."""
    place = Path(folder)
    result = {"log": log, "name": name, "stamp": _stamp(Path(log)), "error": "", "files": []}
    result |= LogSummary().as_dict() | {"rows": 0}
    codec = Codec.from_dbc(tables.dbc, encoding=tables.encoding)
    receiver = LogReceiver(
        codec, cycle_ms=tables.cycle_ms, timeout_ms=tables.timeout_ms, scenes=tables.scenes
    )
    about = About.of(codec, log, tables.at, tables.cycle_ms)

    def path_of(part: str) -> Path:
        (place / part).mkdir(parents=True, exist_ok=True)
        return place / part / f"{name}{suffix}"

    try:
        writer = open_tables(path_of, about, suffix, bands=tables.bands)
        written = write_tables(receiver, log, writer, tables)
        result["files"] = [str(file.relative_to(place)) for file in written.files]
        result |= written.summary.as_dict() | {"rows": written.lines}
        result["error"] = "; ".join(_problems(receiver, codec, written, log))
    except LogError as error:
        result["error"] = str(error)
    dropped = {reason.name: number for reason, number in receiver.counts.items()}
    lines = sum(one.lines for one in receiver.decoders.values())
    return result | {"frames": receiver.frames, "lines": lines, "dropped": dropped}


def _problems(receiver: LogReceiver, codec: Codec, written: Written, log: str) -> Iterator[str]:
    if written.damage:
        yield written.damage
    if receiver.beyond:
        beyond = count_text(receiver.beyond, "frame")
        yield f"{log}: {beyond} of channels beyond the first {MAX_CHANNELS}"
    if receiver.is_empty and (receiver.frames or not written.damage):
        yield f"{log}: {misfit(receiver.first, [codec], written.summary).text}"


def dropped_of(results: Iterable[Result]) -> Counter[str]:
    """Return the dropped frames of all logs by reason."""
    return sum((Counter(result["dropped"]) for result in results), Counter())


def _names(logs: Sequence[Path]) -> list[str]:
    """Return a name for each log: its path from the folder that they share."""
    paths = [log.absolute() for log in logs]
    shared = Path(os.path.commonpath([path.parent for path in paths]))
    names = ["__".join(path.relative_to(shared).parts) for path in paths]
    stems = [name.removesuffix(".gz").rpartition(".")[0] or name for name in names]
    return stems if len(set(stems)) == len(stems) else names


def _stamp(log: Path) -> list[int]:
    """Return what tells whether a log has changed: its size and its time [ns]."""
    try:
        about = log.stat()
    except OSError:
        return []
    return [about.st_size, about.st_mtime_ns]


def _known(folder: Path, wanted: dict[str, Any], names: dict[str, str]) -> dict[str, Result]:
    """Return the results of a data set that was begun; begin it if it was not."""
    manifest = folder / MANIFEST
    if not manifest.exists():
        folder.mkdir(parents=True, exist_ok=True)
        manifest.write_text(json.dumps(wanted) + "\n")
        return {}
    head, *rows = manifest.read_text().splitlines() or [""]
    if json_of(head, str(manifest), ValueError) != wanted:
        raise ValueError(
            f"{folder}: has tables of other options, {head}; give the same ones, or another folder"
        )
    known: dict[str, Result] = {}
    for row in rows:
        try:
            result = json_of(row, str(manifest), ValueError)
        except ValueError:  # the run was killed while it wrote
            continue
        if not isinstance(result, dict) or not result.keys() >= {"log", "name", "stamp", "files"}:
            continue
        log = result["log"]
        is_same = log in names and result["name"] == names[log]
        is_same = is_same and result["stamp"] == _stamp(Path(log))
        if is_same and all((folder / file).exists() for file in result["files"]):
            known[log] = result
    again = manifest.with_suffix(".new")
    again.write_text("".join(f"{json.dumps(row)}\n" for row in (wanted, *known.values())))
    again.replace(manifest)
    return known
