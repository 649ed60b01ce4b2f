"""Reads the log files of other tools, frame by frame."""

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

__all__ = ["LogFrame", "read_log"]

# What python-can's readers raise on damaged files, each in its own way.
_DAMAGE = (
    *(ValueError, TypeError, KeyError, IndexError, AttributeError, AssertionError),
    *(OSError, EOFError, OverflowError, struct.error, zlib.error, sqlite3.Error),
    *(BLFParseError, NotImplementedError),
)

_SUFFIXES = (".asc", ".blf", ".csv", ".db", ".log", ".mf4", ".trc")

#: How an .asc file begins.
_ASC_HEADS = ("date", "base", "//")
# A text reader that is started again takes the next line for a header; this one
# is put before it, so that no record is lost.
_HEADER_AGAIN = {".csv": "\n", ".asc": "internal events logged\n"}


class LogFrame(NamedTuple):
    """One data frame of a log."""

    can_id: int
    data: bytes
    t_ns: int  #: time of reception as logged [ns]: absolute, or from the log's start (.asc)
    is_extended: bool
    channel: str  #: of the interface; empty where the log has none


def read_log(path: str | PathLike[str]) -> Iterator[LogFrame]:
    """The data frames of a log, in its order, whatever its length.

    Reads what python-can reads, known by the suffix: .asc, .blf, .csv, .db,
    .log (``candump -L``), .mf4, .trc, the text formats and .blf also with .gz.
    Error and remote frames are left out.

    A damaged record of a text log is left out as well; a damaged binary log ends
    there.  Either way all good frames come first and then the error, once.

    Raises:
        LogError: at once: the file is missing or its format is unknown; after
            the last good frame: what was damaged.
        MissingExtraError: .mf4 without the package asammdf.
    """
    path = Path(path)
    suffix, packed = path.suffix.lower(), False
    if suffix == ".gz":
        suffix, packed = path.with_suffix("").suffix.lower(), True
    if suffix not in _SUFFIXES:
        raise LogError(f"{path}: the format {suffix!r} is unknown; use {', '.join(_SUFFIXES)}")
    if packed and suffix in {".db", ".mf4"}:
        raise LogError(f"{path}: {suffix} cannot be read while packed; unpack it with gunzip")
    if not path.is_file():  # sqlite would create it
        raise LogError(f"{path}: there is no such file")
    if suffix == ".mf4" and not find_spec("asammdf"):
        raise MissingExtraError(
            f'{path}: reading .mf4 needs asammdf; pip install "maplines_can[mf4]"'
        )
    text = issubclass(MESSAGE_READERS[suffix], TextIOMessageReader)
    return _read_text(path, suffix, packed) if text else _read_binary(path, suffix, packed)


def _read_binary(path: Path, suffix: str, packed: bool) -> Iterator[LogFrame]:
    good, missing = 0, 0
    with contextlib.ExitStack() as stack:
        try:
            source: Any = path
            if suffix == ".blf":  # python-can leaves it open where it is not a BLF file
                source = stack.enter_context((gzip.open if packed else open)(path, "rb"))
            open_reader = _BlfReader if suffix == ".blf" else MESSAGE_READERS[suffix]
            reader = stack.enter_context(open_reader(source))
            for message in reader:
                yield from _data_frames(message)
                good += 1
            if isinstance(reader, can.BLFReader) and not packed:
                # python-can ends a BLF file that was cut off without a word.
                missing = reader.file_size - path.stat().st_size
        except _DAMAGE as error:
            what = f"damaged after {good} good records" if good else f"not a good {suffix} file"
            raise LogError(f"{path}: {what} ({_words(error)}); the rest is not read") from error
    if missing > 0:
        raise LogError(f"{path}: cut off after {good} good records, {missing} bytes are missing")


class _BlfReader(can.BLFReader):
    """python-can's, which reads an object of length 0 for ever (its issue 1584)."""

    def _parse_data(self, data: bytes) -> Iterator[can.Message]:
        end = _first_without_length(data)
        yield from super()._parse_data(data[:end])
        if end is not None:
            raise BLFParseError("an object is shorter than its own header")


def _first_without_length(data: bytes) -> int | None:
    """Where the first object begins that cannot be as short as it says."""
    head, place = OBJ_HEADER_BASE_STRUCT, 0
    while (place := data.find(b"LOBJ", place, place + 8)) >= 0 and place + head.size <= len(data):
        size = head.unpack_from(data, place)[3]
        if size < head.size:
            return place
        place += size
    return None


class _TrcReader(can.TRCReader):
    """python-can's, which tells only its logger of a record that is too short.

    Where there is no record it takes the last line of the header, or of an empty file, for one.
    """

    def _parse_line(self, line: str) -> can.Message | None:
        if not line or line.startswith(";"):
            return None
        return self._parse_cols(tuple(line.split(maxsplit=self._num_columns)))


class _Lines:
    """The lines of a text log, counted; stands in for python-can's text file."""

    def __init__(self, file: IO[str]) -> None:
        self._file = file
        self._before: list[str] = []
        self.number = 0
        self.first = ""
        self.torn: Exception | None = None

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        if self._before:
            return self._before.pop()
        try:
            line = next(self._file)
        except (OSError, EOFError, zlib.error) as error:  # the packed file is cut off
            self.torn = error
            raise StopIteration from None
        self.number += 1
        self.first = self.first or line
        return line

    def put_before(self, line: str) -> None:
        self._before.append(line)

    def close(self) -> None:
        self._file.close()


def _read_text(path: Path, suffix: str, packed: bool) -> Iterator[LogFrame]:
    good, bad, first, last = 0, 0, "", -1
    # A stray byte must cost its own line only, hence errors="replace".
    with (gzip.open if packed else open)(path, "rt", encoding="utf-8", errors="replace") as file:
        lines = _Lines(cast(IO[str], file))
        open_reader = _TrcReader if suffix == ".trc" else MESSAGE_READERS[suffix]
        reader = open_reader(cast(Any, lines))
        while lines.number > last:  # a reader that fails without reading on never gets further
            last = lines.number
            try:
                for message in reader:
                    yield from _data_frames(message)
                    good += 1
                break
            except _DAMAGE as error:
                bad += 1
                first = first or f"line {lines.number}: {_words(error)}"
                if suffix in _HEADER_AGAIN:
                    lines.put_before(_HEADER_AGAIN[suffix])
    # python-can passes over what it cannot read in an .asc file.
    if suffix == ".asc" and lines.first and not (good or lines.first.startswith(_ASC_HEADS)):
        raise LogError(f"{path}: not a good .asc file: it has neither a header nor frames")
    if bad and not good:
        hint = "; it should be written by candump -L" if suffix == ".log" else ""
        raise LogError(f"{path}: none of {bad} records can be read ({first}){hint}")
    if bad:
        raise LogError(f"{path}: {bad} of {good + bad} records are damaged (the first: {first})")
    if lines.torn:
        raise LogError(f"{path}: cut off after {good} good records ({_words(lines.torn)})")


def _data_frames(message: can.Message) -> Iterator[LogFrame]:
    if not (message.is_error_frame or message.is_remote_frame):
        if not 0 <= message.arbitration_id < 2**29:
            raise ValueError(f"no CAN ID is {message.arbitration_id:#x}")
        yield LogFrame(
            message.arbitration_id,
            bytes(message.data),
            round(message.timestamp * 1e9),
            message.is_extended_id,
            "" if message.channel is None else str(message.channel),
        )


def _words(error: Exception) -> str:
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
