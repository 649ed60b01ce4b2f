"""Read log files of other tools, frame by frame."""

from __future__ import annotations

import contextlib
import gzip
import sqlite3
import struct
import zlib
from collections.abc import Iterator
from importlib.util import find_spec
from os import PathLike
from pathlib import Path
from typing import IO, Any, NamedTuple, cast

import can
from can.io.blf import OBJ_HEADER_BASE_STRUCT, BLFParseError
from can.io.generic import TextIOMessageReader
from can.io.player import MESSAGE_READERS

from ..errors import LogError, MissingExtraError

# Exceptions that python-can's readers raise on damaged files.
_DAMAGE = (
    *(ValueError, TypeError, KeyError, IndexError, AttributeError, AssertionError),
    *(OSError, EOFError, OverflowError, struct.error, zlib.error, sqlite3.Error),
    *(BLFParseError, NotImplementedError),
)

_SUFFIXES = (".asc", ".blf", ".csv", ".db", ".log", ".mf4", ".trc")

#: First words of an .asc file.
_ASC_HEADS = ("date", "base", "//")
# A text reader that is restarted takes the next line for a header. This line is
# inserted before it, so that no record is lost.
_HEADER_AGAIN = {".csv": "\n", ".asc": "internal events logged\n"}


class LogFrame(NamedTuple):
    """Data frame of a log."""

    can_id: int
    data: bytes
    t_ns: int  #: time of reception as logged [ns]: absolute, or from the log's start (.asc)
    is_extended: bool
    channel: str  #: of the interface; empty if the log has none


def read_log(path: str | PathLike[str]) -> Iterator[LogFrame]:
    """Return an iterator over the data frames of a log, in the order of the file.

    The suffix determines the format: .asc, .blf, .csv, .db, .log (``candump -L``), .mf4 or .trc.
    The text formats and .blf may be compressed (.gz). Error and remote frames are skipped.
    The log is not loaded into memory at once.

    A damaged record of a text log is skipped. A damaged binary log is read up to the damage.
    In both cases the error is raised once, after the last good frame.

    Raises:
        LogError: the file does not exist or its format is unknown (raised by the call), or it is
            damaged (raised after the last good frame).
        MissingExtraError: .mf4 without the package asammdf.
    """
    path = Path(path)
    suffix, compressed = path.suffix.lower(), False
    if suffix == ".gz":
        suffix, compressed = path.with_suffix("").suffix.lower(), True
    if suffix not in _SUFFIXES:
        raise LogError(f"{path}: the format {suffix!r} is unknown; use {', '.join(_SUFFIXES)}")
    if compressed and suffix in {".db", ".mf4"}:
        raise LogError(f"{path}: {suffix} cannot be read while compressed; use gunzip first")
    if not path.is_file():  # sqlite would create the file
        raise LogError(f"{path}: there is no such file")
    if suffix == ".mf4" and not find_spec("asammdf"):
        raise MissingExtraError(
            f'{path}: reading .mf4 needs asammdf; pip install "maplines_can[mf4]"'
        )
    text = issubclass(MESSAGE_READERS[suffix], TextIOMessageReader)
    return _read_text(path, suffix, compressed) if text else _read_binary(path, suffix, compressed)


def _read_binary(path: Path, suffix: str, compressed: bool) -> Iterator[LogFrame]:
    good, missing = 0, 0
    with contextlib.ExitStack() as stack:
        try:
            source: Any = path
            if suffix == ".blf":  # python-can leaves the file open if it is not a BLF file
                source = stack.enter_context((gzip.open if compressed else open)(path, "rb"))
            open_reader = _BlfReader if suffix == ".blf" else MESSAGE_READERS[suffix]
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


class _BlfReader(can.BLFReader):
    """BLF reader that stops at an object of length 0; python-can's never ends (its issue 1584)."""

    def _parse_data(self, data: bytes) -> Iterator[can.Message]:
        end = _first_too_short(data)
        yield from super()._parse_data(data[:end])
        if end is not None:
            raise BLFParseError("an object is shorter than its own header")


def _first_too_short(data: bytes) -> int | None:
    """Return the place of the first object whose length field is less than its header."""
    head, place = OBJ_HEADER_BASE_STRUCT, 0
    while (place := data.find(b"LOBJ", place, place + 8)) >= 0 and place + head.size <= len(data):
        size = head.unpack_from(data, place)[3]
        if size < head.size:
            return place
        place += size
    return None


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
    """Text file for python-can's readers that counts the lines and can insert one."""

    def __init__(self, file: IO[str]) -> None:
        self._file = file
        self._inserted: list[str] = []
        self.number = 0
        self.first = ""
        self.truncation: Exception | None = None

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        if self._inserted:
            return self._inserted.pop()
        try:
            line = next(self._file)
        except (OSError, EOFError, zlib.error) as error:  # the compressed file is truncated
            self.truncation = error
            raise StopIteration from None
        self.number += 1
        self.first = self.first or line
        return line

    def insert(self, line: str) -> None:
        self._inserted.append(line)

    def close(self) -> None:
        self._file.close()


def _read_text(path: Path, suffix: str, compressed: bool) -> Iterator[LogFrame]:
    good, bad, first, last = 0, 0, "", -1
    # With errors="replace" an invalid byte costs its own line only.
    with (gzip.open if compressed else open)(
        path, "rt", encoding="utf-8", errors="replace"
    ) as file:
        lines = _Lines(cast(IO[str], file))
        open_reader = _TrcReader if suffix == ".trc" else MESSAGE_READERS[suffix]
        reader = open_reader(cast(Any, lines))
        while lines.number > last:  # else the reader fails again without reading a line
            last = lines.number
            try:
                for message in reader:
                    yield from _data_frames(message)
                    good += 1
                break
            except _DAMAGE as error:
                bad += 1
                first = first or f"line {lines.number}: {_text(error)}"
                if suffix in _HEADER_AGAIN:
                    lines.insert(_HEADER_AGAIN[suffix])
    # python-can skips what it cannot read in an .asc file.
    if suffix == ".asc" and lines.first and not (good or lines.first.startswith(_ASC_HEADS)):
        raise LogError(f"{path}: not a valid .asc file: it has neither a header nor frames")
    if bad and not good:
        hint = "; a .log file must be written by candump -L" if suffix == ".log" else ""
        raise LogError(f"{path}: none of {bad} records can be read ({first}){hint}")
    if bad:
        raise LogError(f"{path}: {bad} of {good + bad} records are damaged (the first: {first})")
    if lines.truncation:
        raise LogError(f"{path}: truncated after {good} good records ({_text(lines.truncation)})")


def _data_frames(message: can.Message) -> Iterator[LogFrame]:
    if not (message.is_error_frame or message.is_remote_frame):
        if not 0 <= message.arbitration_id < 2**29:
            raise ValueError(f"CAN ID must be in [0, 0x1fffffff], got {message.arbitration_id:#x}")
        yield LogFrame(
            message.arbitration_id,
            bytes(message.data),
            round(message.timestamp * 1e9),
            message.is_extended_id,
            "" if message.channel is None else str(message.channel),
        )


def _text(error: Exception) -> str:
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
