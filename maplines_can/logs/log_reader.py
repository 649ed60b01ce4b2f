"""Read log files of other tools, frame by frame."""

from __future__ import annotations

import contextlib
import gzip
import io
import re
import sqlite3
import struct
import zlib
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from os import PathLike
from pathlib import Path
from typing import IO, Any, NamedTuple, cast, get_args

from ..values.arrays import count_text
from ..values.errors import LogError, missing_extra
from ..values.input_files import checked_path
from .asc_log import AscFormat
from .blf_log import BLFParseError, BlfReader, BlfRunReader
from .busmaster_log import BusmasterFormat
from .candump_log import CandumpFormat
from .crtd_log import CrtdFormat
from .frame_block import FrameBlock, LogFrame, frames_of
from .log_summary import LogReader, LogSummary, Times
from .log_times import LogTimes
from .mf4_log import Mf4Reader
from .pcap_log import PcapError, PcapReader, is_capture
from .sqlite_log import SqliteReader
from .table_log import CsvFormat, SavvyCanFormat, TrcFormat
from .text_lines import Lines, text_of
from .text_rows import RowReader

#: What readers yield.
Records = Iterator[LogFrame | FrameBlock]

# Exceptions that python-can's readers raise on damaged files.
_DAMAGE = (
    *(ValueError, TypeError, KeyError, IndexError, AttributeError, AssertionError),
    *(OSError, EOFError, OverflowError, struct.error, zlib.error, sqlite3.Error),
    *(BLFParseError, PcapError, NotImplementedError),
)

_SUFFIXES = (
    *(".asc", ".blf", ".crtd", ".csv", ".db", ".log", ".mf4", ".pcap", ".pcapng", ".trc", ".txt"),
)
#: Suffixes without a known format. The first bytes tell it; if none matches, it is candump's.
_ANY_FORMAT = ("", ".log", ".txt")
_FIRST_BYTES = {b"LOGG": ".blf", b"MDF ": ".mf4", b"UnFinMF ": ".mf4", b"SQLite format 3": ".db"}
#: First line of the text formats, in lower case.
_FIRST_LINES = {
    ".trc": re.compile(r";"),
    "busmaster": re.compile(r"\*\*\*\s*busmaster"),
    "savvycan": re.compile(r"time stamp,id,"),
    ".crtd": re.compile(r"\d+(\.\d*)?\s+\d*(c[a-z]{2}|[rt](11|29))\s"),
    ".csv": re.compile(r"timestamp,|[\d.]+,0x"),
    ".asc": re.compile(
        r"date\s|base\s|//|begin\s+triggerblock|(no\s+)?internal\s+events"
        r"|\d+\.\d+\s+(\d+\s|canfd\s|can\s|start\s+of\s)"
    ),
}
_BINARY = (".blf", ".db", ".mf4")
#: Either one may have both formats; they are read from streams, too.
_CAPTURES = (".pcap", ".pcapng")
_GZIP = b"\x1f\x8b"

_TEXT: dict[str, Any] = {
    "": CandumpFormat,
    ".asc": AscFormat,
    ".crtd": CrtdFormat,
    ".csv": CsvFormat,
    ".trc": TrcFormat,
    "busmaster": BusmasterFormat,
    "savvycan": SavvyCanFormat,
}
#: Formats whose time stamps may be of several kinds.
_ANY_TIMES = ("", ".asc", ".crtd", ".csv", "busmaster", "savvycan")


def read_log(
    source: str | PathLike[str] | IO[bytes], *, times: Times = "auto"
) -> LogReader[LogFrame]:
    """Return an iterator over the data frames of a log, in the order of the file.

    The suffix determines the format: .asc, .blf, .crtd, .csv, .db, .mf4, .pcap, .pcapng or .trc.
    The content determines it if the suffix is .log or .txt, or if there is none, as in a stream. It
    may then also be that of BUSMASTER, or the output of candump, with or without ``-L``, ``-t``,
    ``-x`` and ``-a``. A .csv is of python-can or of SavvyCAN. The text formats, .blf and captures
    may be compressed (.gz). Other records, such as error and remote frames, are skipped and
    counted in ``summary.skipped`` of the iterator. The log is not loaded into memory
    at once; a frame of a pipe is returned as soon as its line has arrived.

    The kind of the time stamps of candump, and of an .asc log that does not state it, is found from
    the first 100 rows, once and for all. Stamps of 1e8 s or more are absolute at once. Of a pipe,
    the rows of 2 s at most wait for that, but on Windows all 100: ``times`` states the kind.
    Where stamps from the start of the log begin again, as in two logs one after the other, so do
    the times. ``candump -t A`` writes local time. What was assumed is in ``summary.notices``.

    A damaged record of a text log or a capture is skipped, such as a line of more than ``MAX_LINE``
    characters; one of more than ``MAX_DAMAGE`` ends the reading. Another damaged binary log is read
    up to the damage; an object of more than 16 MB is damage, and so is a row of more than 64 kB.
    In both cases the error is raised once, after the last good frame.

    Args:
        source: path of a file, or a binary stream with ``peek``, such as ``sys.stdin.buffer``.
        times: kind of the time stamps of a text log: "absolute", "zero" for those from the start of
            the log, "delta" for those from the frame before, or "auto" to find the kind.

    Raises:
        LogError: the file does not exist, its format is unknown, or ``times`` states a kind for a
            format that has its own (raised by the call), or it is damaged (raised after the last
            good frame).
        ValueError: ``times`` is none of these.
        TypeError: the source is neither a path nor such a stream.
        MissingExtraError: .mf4 without the package asammdf.
    """
    return cast("LogReader[LogFrame]", _reader(source, times, runs=False))


def read_runs(
    source: str | PathLike[str] | IO[bytes], *, times: Times = "auto"
) -> LogReader[LogFrame | FrameBlock]:
    """Return what `read_log` does, with runs of ordinary records as blocks.

    The channels of a block have the numbers of its reader.
    """
    return _reader(source, times, runs=True)


class _Reading(NamedTuple):
    """How a log is read, and its summary."""

    summary: LogSummary
    times: Times
    runs: bool


def _reader(
    source: str | PathLike[str] | IO[bytes], times: Times, *, runs: bool
) -> LogReader[LogFrame | FrameBlock]:
    if times not in get_args(Times):
        known = ", ".join(get_args(Times))
        raise ValueError(f"times must be one of {known}, got {times!r}")
    summary = LogSummary()
    return LogReader(_open(source, _Reading(summary, times, runs)), summary)


def _open(source: str | PathLike[str] | IO[bytes], how: _Reading) -> Records:
    if not isinstance(source, str | PathLike):
        if not hasattr(source, "peek"):
            raise TypeError(
                "source must be a path, or a stream of bytes with peek, such as "
                f"sys.stdin.buffer, got a {type(source).__name__}"
            )
        name = str(getattr(source, "name", "stream"))
        return _read_any(cast(io.BufferedReader, source), name, how)
    path = checked_path(source, LogError)
    suffix, compressed = path.suffix.lower(), False
    if suffix == ".gz":
        suffix, compressed = path.with_suffix("").suffix.lower(), True
    if suffix and suffix not in _SUFFIXES:
        raise LogError(f"{path}: the format {suffix!r} is unknown; use {', '.join(_SUFFIXES)}")
    if compressed and suffix in {".db", ".mf4"}:
        raise LogError(f"{path}: {suffix} cannot be read while compressed; use gunzip first")
    if not path.is_file():  # sqlite would create the file
        raise LogError(
            f"{path}: " + ("is not a file" if path.exists() else "there is no such file")
        )
    if suffix not in _ANY_FORMAT:
        _check_times(path, suffix, how)
    if suffix in _BINARY:
        _check_reader(path, suffix)
        return _read_binary(path, suffix, compressed, how)
    return _read_path(path, "" if suffix in _ANY_FORMAT else suffix, how)


def _check_times(name: object, suffix: str, how: _Reading) -> None:
    if how.times != "auto" and suffix not in _ANY_TIMES:
        raise LogError(
            f"{name}: times is {how.times!r}, but the format {suffix} has one kind of time stamps; "
            "use 'auto'"
        )


def _check_reader(path: Path, suffix: str) -> None:
    if suffix == ".mf4" and not find_spec("asammdf"):
        raise missing_extra(f"{path}: reading .mf4 needs asammdf", "mf4")


def _read_path(path: Path, suffix: str, how: _Reading) -> Records:
    with path.open("rb") as file:
        yield from _read_any(file, str(path), how, suffix, path)


def _read_any(
    file: io.BufferedReader,
    name: str,
    how: _Reading,
    suffix: str = "",
    path: Path | None = None,
) -> Records:
    """Yield the frames of an open log; without a suffix, the first bytes determine the format."""
    try:
        compressed = file.peek(2)[:2] == _GZIP
        if compressed:
            file = io.BufferedReader(cast(io.RawIOBase, gzip.GzipFile(fileobj=file)))
        head = file.peek(16)
    except _DAMAGE as error:
        raise LogError(f"{name}: not a valid log ({text_of(error)})") from error
    suffix = suffix or next((s for first, s in _FIRST_BYTES.items() if head.startswith(first)), "")
    if suffix in _CAPTURES or (not suffix and is_capture(head)):
        _check_times(name, _CAPTURES[0], how)
        reader = PcapReader(file, how.summary, runs=how.runs, is_packed=compressed)
        yield from _read_records(lambda _: reader, name, _CAPTURES[0], how)
        return
    if suffix not in _BINARY:
        if _is_utf_16(head):
            raise LogError(
                f"{name}: the text is UTF-16; convert it, as with iconv -f UTF-16 -t UTF-8"
            )
        lines = Lines(file, is_packed=compressed)
        suffix = _text_format(lines, suffix)
        _check_times(name, suffix, how)
        yield from _read_text(lines, name, suffix, how)
        return
    _check_times(name, suffix, how)
    if path is None or compressed:
        raise LogError(
            f"{name}: a log in the format {suffix} is read from a file only, not compressed"
        )
    _check_reader(path, suffix)
    yield from _read_binary(path, suffix, False, how)


def _is_utf_16(head: bytes) -> bool:
    """Whether a text begins with a byte order mark of UTF-16, or two of its ASCII characters."""
    is_zero = [byte == 0 for byte in head[:4]]
    marks = b"\xff\xfe", b"\xfe\xff"
    return head.startswith(marks) or is_zero in ([False, True] * 2, [True, False] * 2)


def _text_format(lines: Lines, suffix: str) -> str:
    """Return the text format by the first line, where the suffix leaves it open.

    It is empty for candump. A table has the format of python-can or of SavvyCAN.
    """
    if suffix not in ("", ".csv"):
        return suffix
    first = "".join(lines.ahead(1)).lower()
    wanted = ("savvycan",) if suffix else _FIRST_LINES
    return next((name for name in wanted if _FIRST_LINES[name].match(first)), suffix)


def _read_binary(path: Path, suffix: str, compressed: bool, how: _Reading) -> Records:
    def opened(stack: contextlib.ExitStack) -> Any:
        source: Any = path
        if suffix == ".blf":
            source = stack.enter_context((gzip.open if compressed else open)(path, "rb"))
        readers: Any = _RUN_READERS if how.runs and suffix in _RUN_READERS else _READERS
        return stack.enter_context(readers[suffix](source, how.summary))

    yield from _read_records(opened, str(path), suffix, how)


def _read_records(
    opened: Callable[[contextlib.ExitStack], Any], name: str, suffix: str, how: _Reading
) -> Records:
    """Yield the records of a binary log, whose reader may count damaged ones."""
    how.summary.format = suffix
    good, missing, damaged, first = 0, 0, 0, ""

    def records() -> int:
        return good + how.summary.skipped.total()

    with contextlib.ExitStack() as stack:
        try:
            reader = opened(stack)
            for record in reader:
                yield from [record] if how.runs else _frames(record)
                good += len(record) if isinstance(record, FrameBlock) else 1
            missing = getattr(reader, "missing", 0)
            damaged, first = getattr(reader, "damage", (0, ""))
        except _DAMAGE as error:
            what = f"not a valid {how.summary.format} file"
            if records():
                what = f"damaged after {records()} good records"
            raise LogError(f"{name}: {what} ({text_of(error)}); the rest is not read") from error
    texts = []
    if damaged:
        total = records() + damaged
        texts.append(f"{damaged} of {total} records are damaged (the first: {first})")
    if missing > 0:
        texts.append(f"truncated after {records()} good records, {missing} bytes are missing")
    if texts:
        raise LogError(f"{name}: {'; '.join(texts)}")


def _frames(record: LogFrame | FrameBlock) -> Iterator[LogFrame]:
    return iter([record]) if isinstance(record, LogFrame) else frames_of(record)


def _read_text(lines: Lines, name: str, suffix: str, how: _Reading) -> Records:
    how.summary.format = suffix or "candump"
    good, bad, first, last = 0, 0, "", -1
    row_format = _TEXT[suffix](LogTimes(how.times, how.summary), how.summary)
    reader = RowReader(lines, row_format, runs=how.runs)
    while lines.number > last:  # else the reader fails again without reading a line
        last = lines.number
        try:
            for record in reader:
                yield record
                good += len(record) if isinstance(record, FrameBlock) else 1
            break
        except _DAMAGE as error:
            bad += 1
            first = first or f"line {lines.number}: {text_of(error)}"
    good += how.summary.skipped.total()
    end = ""
    if lines.end:
        what, why = lines.end
        end = f"{what} after {count_text(good, 'good record')} ({why})"
    if bad and not good:
        hint = "" if suffix else "; the content is no format that is known, such as candump's"
        end = end and f"; {end}"
        raise LogError(
            f"{name}: none of {count_text(bad, 'record')} can be read ({first}){end}{hint}"
        )
    if bad:
        end = end and f"; {end}"
        raise LogError(
            f"{name}: {bad} of {good + bad} records are damaged (the first: {first}){end}"
        )
    if end:
        raise LogError(f"{name}: {end}")


_READERS: dict[str, Any] = {".blf": BlfReader, ".db": SqliteReader, ".mf4": Mf4Reader}
#: Readers that yield runs.
_RUN_READERS: dict[str, Any] = {".blf": BlfRunReader}
