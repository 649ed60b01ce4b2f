"""Readers of text logs, line by line and, where there is C, in runs of ordinary rows."""

from __future__ import annotations

import io
import re
import zlib
from collections.abc import Iterator
from datetime import datetime
from typing import Any

import can

from ..native import core
from ..values.input_files import MAX_LINE
from .frame_block import BLOCK_FRAMES, MAX_DATA, FrameArrays, FrameBlock, LogFrame
from .log_summary import LogSummary, Skipped, Times

#: Characters after which the end of a damaged line is no longer sought.
MAX_DAMAGE = 1 << 24
#: Greatest magnitude of a time stamp, as of a 64-bit integer; it is in the year 2262 [ns].
_MAX_NS = 2**63 - 1
#: Most characters of a reason in a message.
_MAX_REASON = 200
#: Smaller time stamps are relative to the start of the log or to the previous frame [s].
_MIN_ABSOLUTE = 10**8
_ERROR_FLAG = 1  #: of an error frame, above the 29 bits of the CAN ID that candump prints

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


class Lines:
    """Lines of a text log, for readers that take a file; it counts them and can insert one.

    A line of more than ``MAX_LINE`` bytes raises a ValueError, once it has been skipped. A byte
    that is not UTF-8 costs its own line only.

    Args:
        file: open for reading, with ``read1``.
        chunk: bytes that are read at once. An error of the file costs as many.
    """

    def __init__(self, file: io.BufferedReader, chunk: int = 1 << 20) -> None:
        self._file, self._chunk = file, chunk
        self._inserted: list[str] = []
        self._is_at_end = self._skips_feed = False
        #: What was read, and the place of the next line in it.
        self.buffer, self.place = b"", 0
        self.number = 0
        self.first = ""
        #: What ended the file before its end, and why; None if nothing did.
        self.end: tuple[str, str] | None = None

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        if self._inserted:
            return self._inserted.pop()
        end = self._end_of_line()
        is_whole = end >= 0
        if not is_whole:
            self._skip_line()
        if self.end or (is_whole and end == self.place):
            raise StopIteration
        self.number += 1
        if not is_whole:
            self.first = self.first or " "
            raise ValueError(f"has more than {MAX_LINE} characters")
        line = self.buffer[self.place : end].decode(errors="replace")
        self.place = end
        self.first = self.first or line
        return line.rstrip("\r\n") + "\n" if line[-1] in "\r\n" else line

    @property
    def has_line(self) -> bool:
        """Whether the next line has been read, or more bytes than a line may have."""
        rest = len(self.buffer) - self.place
        return rest > MAX_LINE or self.buffer.find(b"\n", self.place) >= 0

    def fill(self) -> bool:
        """Read what there is, waiting for it if it is a stream; return False at the end."""
        if self._is_at_end:
            return False
        try:
            data = self._file.read1(self._chunk)
        except (OSError, EOFError, zlib.error) as error:  # the compressed file is truncated
            data = b""
            self.end = "truncated", text_of(error)
        self._is_at_end = not data
        self.buffer, self.place = self.buffer[self.place :] + data, 0
        if self._skips_feed and self.buffer:
            self.place = int(self.buffer.startswith(b"\n"))
            self._skips_feed = False
        return bool(data)

    def _end_of_line(self) -> int:
        """Return the place after the next line: its begin at the end, -1 if it is too long."""
        while True:
            limit = self.place + MAX_LINE
            end = self.buffer.find(b"\n", self.place, limit)
            feed = self.buffer.find(b"\r", self.place, limit if end < 0 else end)
            if feed >= 0 and feed + 1 != end:  # a line may end with this alone
                self._skips_feed = feed + 1 == len(self.buffer)
                return feed + 1
            if end >= 0:
                return end + 1
            if len(self.buffer) >= limit:
                return -1
            if not self.fill():
                return self.place if self.end else len(self.buffer)

    def _skip_line(self) -> None:
        """Skip a line, which may be all of the file."""
        skipped = 0
        while skipped <= MAX_DAMAGE:
            ends = [self.buffer.find(end, self.place) for end in (b"\n", b"\r")]
            if any(end >= 0 for end in ends):
                self.place = min(end for end in ends if end >= 0) + 1
                return
            skipped += len(self.buffer) - self.place
            self.place = len(self.buffer)
            if not self.fill():
                return
        self.end = (
            "not read further",
            f"line {self.number + 1} has more than {MAX_DAMAGE} characters",
        )

    def insert(self, line: str) -> None:
        """Let this be the next line."""
        self._inserted.append(line)

    def close(self) -> None:
        """Do nothing: the file belongs to the caller."""


class TrcReader(can.TRCReader):
    """TRC reader that raises at a record that is too short; python-can's only logs it.

    It also ignores the last line of the header, which python-can's takes for a record if the
    file has none.

    Args:
        lines: of the log.
        summary: of the log.
        times: kind of the time stamps.
    """

    def __init__(self, lines: Lines, summary: LogSummary, times: Times) -> None:
        super().__init__(lines)  # type: ignore[arg-type]
        self._summary, self._times = summary, times

    def _parse_line(self, line: str) -> can.Message | None:
        if not line or line.startswith(";"):
            return None
        return self._parse_cols(tuple(line.split(maxsplit=self._num_columns)))


class CandumpReader:
    """Reader of the output of candump, with and without ``-L``; yields data frames.

    Args:
        lines: of the log.
        summary: of the log.
        times: kind of the time stamps.
        runs: whether to yield runs of rows as blocks.
    """

    def __init__(
        self, lines: Lines, summary: LogSummary, times: Times, *, runs: bool = False
    ) -> None:
        self._lines, self._summary, self._times = lines, summary, times
        self._stamp = self._time = 0
        self._is_difference = False
        self._arrays = FrameArrays() if runs and core is not None else None

    def __iter__(self) -> Iterator[LogFrame | FrameBlock]:
        while True:
            if self._arrays is not None:
                yield from _runs(self._lines, self._arrays, self._parse)
            line = next(self._lines, None)
            if line is None:
                return
            if (frame := self._frame(line)) is not None:
                yield frame

    def _parse(self, arrays: FrameArrays) -> tuple[int, int, int]:
        time = self._stamp, self._time, self._is_difference
        lines: Any = self._lines
        if max(self._stamp, self._time) > _MAX_NS:  # C has no such number
            return 0, lines.place, 0
        *found, time = core.parse_candump(
            lines.buffer, lines.place, time, arrays.names, arrays.arrays
        )
        self._stamp, self._time, self._is_difference = time
        frames, place, rows = found
        return frames, place, rows

    def _frame(self, line: str) -> LogFrame | None:
        """Return the frame of a row; None if it is no data frame."""
        if line.isspace() or line.startswith("\t"):  # candump -e explains an error frame
            return None
        row = _CANDUMP_LOG_ROW.fullmatch(line) or _CANDUMP_ROW.fullmatch(line)
        if row is None:
            raise ValueError(f"not a row of candump: {line.strip()[:60]!r}")
        can_id, is_extended = int(row["id"], 16), len(row["id"]) > 3
        t_ns = 0 if row["time"] is None else self._t_ns(row["time"])
        if row["remote"] or can_id >> 29 == _ERROR_FLAG:
            self._summary.skipped[Skipped.REMOTE if row["remote"] else Skipped.ERROR] += 1
            return None
        data = bytes.fromhex(row["data"])
        length = int(row.groupdict().get("length") or len(data))
        if len(data) != length:
            raise ValueError(f"{len(data)} bytes of data, but a length of {length}")
        check_frame(can_id, data, t_ns)
        return LogFrame(
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


class AscReader(can.ASCReader):
    """ASC reader that yields runs of rows as blocks; python-can reads all other rows.

    Args:
        lines: of the log.
        summary: of the log.
        times: kind of the time stamps.
    """

    def __init__(self, lines: Lines, summary: LogSummary, times: Times) -> None:
        super().__init__(lines)  # type: ignore[arg-type]
        self._summary, self._times = summary, times
        self._lines, self._arrays = lines, FrameArrays()
        self._has_header = False

    def __iter__(self) -> Iterator[Any]:  # type: ignore[override]
        if not self._has_header:
            super()._extract_header()
            self._has_header = True
        while True:
            if self._converted_base == 16:
                yield from _runs(self._lines, self._arrays, self._parse)
            line = next(self._lines, None)
            if line is None:
                return
            self.file = io.StringIO(line)
            yield from super().__iter__()

    def _extract_header(self) -> None:
        """Do nothing: the header was read before."""

    def _parse(self, arrays: FrameArrays) -> tuple[int, int, int]:
        lines = self._lines
        found: tuple[int, int, int] = core.parse_asc(
            lines.buffer, lines.place, arrays.names, arrays.arrays
        )
        return found


def _runs(lines: Lines, arrays: FrameArrays, parse: Any) -> Iterator[FrameBlock]:
    """Yield the ordinary rows before a row of another form, or before the end."""
    while True:
        frames, lines.place, rows = parse(arrays)
        lines.number += rows
        if frames:
            yield arrays.block(frames)
        if frames < BLOCK_FRAMES and (lines.has_line or not lines.fill()):
            return


def _nanoseconds(text: str) -> int:
    """Return a time stamp of candump: seconds, or date and time of day in local time."""
    if "-" in text:
        return round(datetime.fromisoformat(text).timestamp() * 1e6) * 1000
    seconds, _, fraction = text.partition(".")
    return int(seconds) * 10**9 + int(fraction[:9].ljust(9, "0"))


def check_frame(can_id: int, data: bytes, t_ns: int) -> None:
    """Raise ValueError if a frame cannot be one of CAN."""
    if not 0 <= can_id < 2**29:
        raise ValueError(f"CAN ID must be in [0, 0x1fffffff], got {can_id:#x}")
    if len(data) > MAX_DATA:
        raise ValueError(f"a frame has at most {MAX_DATA} bytes of data, got {len(data)}")
    if not -_MAX_NS <= t_ns <= _MAX_NS:
        raise ValueError("the time stamp is beyond 64 bits of nanoseconds")


def text_of(error: Exception) -> str:
    """Return an error as a short text, with its type unless this is ValueError."""
    text = " ".join(str(error).split())
    text = text if len(text) <= _MAX_REASON else f"{text[:_MAX_REASON]}..."
    if text and type(error) is ValueError:
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
