"""Read log files of other tools, frame by frame."""

from __future__ import annotations

import contextlib
import gzip
import io
import re
import sqlite3
import struct
import zlib
from collections.abc import Iterator
from datetime import datetime
from importlib.util import find_spec
from os import PathLike
from pathlib import Path
from typing import IO, Any, NamedTuple, cast

import can
from can.io.blf import BLFParseError
from can.io.player import MESSAGE_READERS

from ..values.errors import LogError, missing_extra
from ..values.input_files import MAX_LINE, checked_path
from .binary_logs import BlfReader, Mf4Reader, SqliteReader

# Exceptions that python-can's readers raise on damaged files.
_DAMAGE = (
    *(ValueError, TypeError, KeyError, IndexError, AttributeError, AssertionError),
    *(OSError, EOFError, OverflowError, struct.error, zlib.error, sqlite3.Error),
    *(BLFParseError, NotImplementedError),
)

_SUFFIXES = (".asc", ".blf", ".csv", ".db", ".log", ".mf4", ".trc", ".txt")
#: Suffixes without a known format. The first bytes tell it; if none matches, it is candump's.
_ANY_FORMAT = ("", ".log", ".txt")
_FIRST_BYTES = {
    b"LOGG": ".blf",
    b"MDF ": ".mf4",
    b"SQLite format 3": ".db",
    b";": ".trc",
    b"timestamp,": ".csv",
    b"date": ".asc",
    b"base": ".asc",
    b"//": ".asc",
}
_BINARY = (".blf", ".db", ".mf4")
_GZIP = b"\x1f\x8b"

#: First words of an .asc file.
_ASC_HEADS = ("date", "base", "//")
# A text reader that is restarted takes the next line for a header. This line is
# inserted before it, so that no record is lost.
_HEADER_AGAIN = {".csv": "\n", ".asc": "internal events logged\n"}


#: Row of candump, such as "(1.5)  can0  340   [8]  11 22 33 44 55 66 77 88": with -t a time stamp,
#: with -x the direction and the flags of CAN FD, with -a the data as ASCII.
#: Its quantifiers are possessive, so that no line makes it search for long.
_CANDUMP_ROW = re.compile(
    r"\s*+(?:\((?P<time>[^)]*)\)\s++)?(?P<channel>\S++)\s++(?:[RT]X\s++[B-]\s[E-]\s++)?"
    r"(?P<id>[0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})\s++\[(?P<length>\d{1,2})\]"
    r"(?P<data>(?:\s++[0-9A-Fa-f]{2}(?!\S))*)\s*+(?P<remote>remote request)?"
    r"(?:ERRORFRAME|'.*)?\s*+"
)
#: Row of candump -L, such as "(1.5) can0 340#1122334455667788", with "##" and flags for CAN FD.
_CANDUMP_LOG_ROW = re.compile(
    r"\s*\((?P<time>[^)]*)\)\s+(?P<channel>\S+)\s+(?P<id>[0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})#"
    r"(?:(?P<remote>R\d?)|(?:#[0-9A-Fa-f])?(?P<data>(?:[0-9A-Fa-f]{2})*))(?:_[0-9A-Fa-f])?"
    r"(?:\s+[RT])?\s*"
)
_ERROR_FLAG = 1  #: of an error frame, above the 29 bits of the CAN ID that candump prints
#: Characters after which the end of a damaged line is no longer sought.
MAX_DAMAGE = 1 << 24
#: Greatest magnitude of a time stamp, as of a 64-bit integer; it is in the year 2262 [ns].
_MAX_NS = 2**63 - 1
#: Most bytes of data of a frame, those of CAN FD.
_MAX_DATA = 64
#: Most characters of a reason in a message.
_MAX_REASON = 200
#: Smaller time stamps are relative to the start of the log or to the previous frame [s].
_MIN_ABSOLUTE = 10**8


class LogFrame(NamedTuple):
    """Data frame of a log."""

    can_id: int
    data: bytes
    t_ns: int  #: time of reception as logged [ns]: absolute, or from the start of the log
    is_extended: bool
    channel: str  #: of the interface; empty if the log has none
    has_time: bool  #: False if the log has no time stamps (candump without -L and -t)


def read_log(source: str | PathLike[str] | IO[bytes]) -> Iterator[LogFrame]:
    """Return an iterator over the data frames of a log, in the order of the file.

    The suffix determines the format: .asc, .blf, .csv, .db, .mf4 or .trc. The content determines it
    if the suffix is .log or .txt, or if there is none, as in a stream. It may then also be the
    output of candump, with or without ``-L``, ``-t``, ``-x`` and ``-a``. The text formats and .blf
    may be compressed (.gz). Error and remote frames are skipped. The log is not loaded into memory
    at once; a frame of a pipe is returned as soon as its line has arrived.

    The time stamps of ``candump -t d`` are differences. They are recognised and added up from the
    first one that is less than half of the previous one. ``candump -t A`` writes local time.

    A damaged record of a text log is skipped, such as a line of more than ``MAX_LINE`` characters;
    one of more than ``MAX_DAMAGE`` ends the reading. A damaged binary log is read up to the damage;
    an object of more than 16 MB is damage, and so is a row of more than 64 kB.
    In both cases the error is raised once, after the last good frame.

    Args:
        source: path of a file, or a binary stream with ``peek``, such as ``sys.stdin.buffer``.

    Raises:
        LogError: the file does not exist or its format is unknown (raised by the call), or it is
            damaged (raised after the last good frame).
        TypeError: the source is neither a path nor such a stream.
        MissingExtraError: .mf4 without the package asammdf.
    """
    if not isinstance(source, str | PathLike):
        if not hasattr(source, "peek"):
            raise TypeError(
                "source must be a path, or a stream of bytes with peek, such as "
                f"sys.stdin.buffer, got a {type(source).__name__}"
            )
        return _read_any(cast(io.BufferedReader, source), str(getattr(source, "name", "stream")))
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
    if suffix in _BINARY:
        _check_reader(path, suffix)
        return _read_binary(path, suffix, compressed)
    return _read_path(path, "" if suffix in _ANY_FORMAT else suffix)


def _check_reader(path: Path, suffix: str) -> None:
    if suffix == ".mf4" and not find_spec("asammdf"):
        raise missing_extra(f"{path}: reading .mf4 needs asammdf", "mf4")


def _read_path(path: Path, suffix: str = "") -> Iterator[LogFrame]:
    with path.open("rb") as file:
        yield from _read_any(file, str(path), suffix, path)


def _read_any(
    file: io.BufferedReader, name: str, suffix: str = "", path: Path | None = None
) -> Iterator[LogFrame]:
    """Yield the frames of an open log; without a suffix, the first bytes determine the format."""
    try:
        compressed = file.peek(2)[:2] == _GZIP
        if compressed:
            file = io.BufferedReader(cast(io.RawIOBase, gzip.GzipFile(fileobj=file)))
        head = file.peek(16)
    except _DAMAGE as error:
        raise LogError(f"{name}: not a valid log ({_text(error)})") from error
    suffix = suffix or next((s for first, s in _FIRST_BYTES.items() if head.startswith(first)), "")
    if suffix not in _BINARY:
        yield from _read_text(file, name, suffix)
    elif path is None or compressed:
        raise LogError(
            f"{name}: a log in the format {suffix} is read from a file only, not compressed"
        )
    else:
        _check_reader(path, suffix)
        yield from _read_binary(path, suffix, compressed=False)


def _read_binary(path: Path, suffix: str, compressed: bool) -> Iterator[LogFrame]:
    good, missing = 0, 0
    with contextlib.ExitStack() as stack:
        try:
            source: Any = path
            if suffix == ".blf":  # python-can leaves the file open if it is not a BLF file
                source = stack.enter_context((gzip.open if compressed else open)(path, "rb"))
            open_reader: Any = _BINARY_READERS[suffix]
            reader = stack.enter_context(open_reader(source))
            for message in reader:
                yield from _data_frames(message)
                good += 1
            if isinstance(reader, can.BLFReader) and not compressed:
                # python-can does not report a truncated BLF file.
                missing = reader.file_size - path.stat().st_size
        except _DAMAGE as error:
            what = f"damaged after {good} good records" if good else f"not a valid {suffix} file"
            raise LogError(f"{path}: {what} ({_text(error)}); the rest is not read") from error
    if missing > 0:
        raise LogError(f"{path}: truncated after {good} good records, {missing} bytes are missing")


class _TrcReader(can.TRCReader):
    """TRC reader that raises at a record that is too short; python-can's only logs it.

    It also ignores the last line of the header, which python-can's takes for a record if the
    file has none.
    """

    def _parse_line(self, line: str) -> can.Message | None:
        if not line or line.startswith(";"):
            return None
        return self._parse_cols(tuple(line.split(maxsplit=self._num_columns)))


class _Lines:
    """Text file for python-can's readers that counts the lines and can insert one.

    A line of more than ``MAX_LINE`` characters raises a ValueError, once it has been skipped.
    """

    def __init__(self, file: IO[str]) -> None:
        self._file = file
        self._inserted: list[str] = []
        self.number = 0
        self.first = ""
        #: What ended the file before its end, and why; None if nothing did.
        self.end: tuple[str, str] | None = None

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        if self._inserted:
            return self._inserted.pop()
        line, is_whole = "", True
        try:
            line = self._file.readline(MAX_LINE)
            is_whole = len(line) < MAX_LINE or line.endswith("\n")
            if not is_whole:
                self._skip_rest()
        except (OSError, EOFError, zlib.error) as error:  # the compressed file is truncated
            self.end = "truncated", _text(error)
        if not line or self.end:
            raise StopIteration
        self.number += 1
        self.first = self.first or line
        if not is_whole:
            raise ValueError(f"has more than {MAX_LINE} characters")
        return line

    def _skip_rest(self) -> None:
        """Skip the rest of a line, which may be all of the file."""
        for _ in range(MAX_DAMAGE // MAX_LINE):
            part = self._file.readline(MAX_LINE)
            if not part or part.endswith("\n"):
                return
        self.end = (
            "not read further",
            f"line {self.number + 1} has more than {MAX_DAMAGE} characters",
        )

    def insert(self, line: str) -> None:
        self._inserted.append(line)

    def close(self) -> None:
        """Do nothing: the file belongs to the caller."""


class _CandumpReader:
    """Reader of the output of candump, with and without ``-L``; yields data frames."""

    def __init__(self, lines: Iterator[str]) -> None:
        self._lines = lines
        self._stamp = self._time = 0
        self._is_difference = False

    def __iter__(self) -> Iterator[LogFrame]:
        for line in self._lines:
            if line.isspace() or line.startswith("\t"):  # candump -e explains an error frame
                continue
            row = _CANDUMP_LOG_ROW.fullmatch(line) or _CANDUMP_ROW.fullmatch(line)
            if row is None:
                raise ValueError(f"not a row of candump: {line.strip()[:60]!r}")
            can_id, is_extended = int(row["id"], 16), len(row["id"]) > 3
            t_ns = 0 if row["time"] is None else self._t_ns(row["time"])
            if row["remote"] or can_id >> 29 == _ERROR_FLAG:
                continue
            data = bytes.fromhex(row["data"])
            length = int(row.groupdict().get("length") or len(data))
            if len(data) != length:
                raise ValueError(f"{len(data)} bytes of data, but a length of {length}")
            _check(can_id, data, t_ns)
            yield LogFrame(
                can_id, data, t_ns, is_extended, row["channel"], has_time=row["time"] is not None
            )

    def _t_ns(self, text: str) -> int:
        """Return the time of a row [ns]; differences are added up."""
        stamp = _nanoseconds(text)
        if 2 * stamp < self._stamp < _MIN_ABSOLUTE * 10**9:
            self._is_difference = True
        self._stamp = stamp
        self._time = self._time + stamp if self._is_difference else stamp
        return self._time


def _nanoseconds(text: str) -> int:
    """Return a time stamp of candump: seconds, or date and time of day in local time."""
    if "-" in text:
        return round(datetime.fromisoformat(text).timestamp() * 1e6) * 1000
    seconds, _, fraction = text.partition(".")
    return int(seconds) * 10**9 + int(fraction[:9].ljust(9, "0"))


def _read_text(file: io.BufferedReader, name: str, suffix: str) -> Iterator[LogFrame]:
    good, bad, first, last = 0, 0, "", -1
    # With errors="replace" an invalid byte costs its own line only.
    text = io.TextIOWrapper(file, encoding="utf-8", errors="replace")
    try:
        lines = _Lines(text)
        open_reader: Any = _READERS.get(suffix) or MESSAGE_READERS[suffix]
        reader = open_reader(cast(Any, lines))
        while lines.number > last:  # else the reader fails again without reading a line
            last = lines.number
            try:
                for record in reader:
                    yield from [record] if isinstance(record, LogFrame) else _data_frames(record)
                    good += 1
                break
            except _DAMAGE as error:
                bad += 1
                first = first or f"line {lines.number}: {_text(error)}"
                if suffix in _HEADER_AGAIN:
                    lines.insert(_HEADER_AGAIN[suffix])
    finally:
        text.detach()  # else it closes the file, which may be standard input
    # python-can skips what it cannot read in an .asc file.
    if suffix == ".asc" and lines.first and not (good or lines.first.startswith(_ASC_HEADS)):
        raise LogError(f"{name}: not a valid .asc file: it has neither a header nor frames")
    end = ""
    if lines.end:
        what, why = lines.end
        end = f"{what} after {good} good records ({why})"
    if bad and not good:
        hint = "" if suffix else "; the content is no format that is known, such as candump's"
        end = end and f"; {end}"
        raise LogError(f"{name}: none of {bad} records can be read ({first}){end}{hint}")
    if bad:
        end = end and f"; {end}"
        raise LogError(
            f"{name}: {bad} of {good + bad} records are damaged (the first: {first}){end}"
        )
    if end:
        raise LogError(f"{name}: {end}")


def _data_frames(message: can.Message) -> Iterator[LogFrame]:
    if not (message.is_error_frame or message.is_remote_frame):
        data, t_ns = bytes(message.data), round(message.timestamp * 1e9)
        _check(message.arbitration_id, data, t_ns)
        yield LogFrame(
            message.arbitration_id,
            data,
            t_ns,
            message.is_extended_id,
            "" if message.channel is None else str(message.channel),
            has_time=True,
        )


def _check(can_id: int, data: bytes, t_ns: int) -> None:
    """Raise ValueError if a frame cannot be one of CAN."""
    if not 0 <= can_id < 2**29:
        raise ValueError(f"CAN ID must be in [0, 0x1fffffff], got {can_id:#x}")
    if len(data) > _MAX_DATA:
        raise ValueError(f"a frame has at most {_MAX_DATA} bytes of data, got {len(data)}")
    if not -_MAX_NS <= t_ns <= _MAX_NS:
        raise ValueError("the time stamp is beyond 64 bits of nanoseconds")


def _text(error: Exception) -> str:
    text = " ".join(str(error).split())
    text = text if len(text) <= _MAX_REASON else f"{text[:_MAX_REASON]}..."
    if text and type(error) is ValueError:
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


#: Readers that are not python-can's own.
_READERS = {"": _CandumpReader, ".trc": _TrcReader}
_BINARY_READERS = {".blf": BlfReader, ".db": SqliteReader, ".mf4": Mf4Reader}
