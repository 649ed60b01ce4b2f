"""Reader of text logs, row by row and, where there is C, in runs of ordinary rows."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Protocol

from .frame_block import MAX_DATA, FrameBlock, LogCore, LogFrame
from .log_times import MAX_WAIT, LogTimes
from .text_lines import Lines

#: Greatest magnitude of a time stamp, as of a 64-bit integer; it is in the year 2262 [ns].
MAX_NS = 2**63 - 1
#: Most characters of a row in a message.
MAX_SHOWN = 60


class RowFormat(Protocol):
    """Format of the rows of a text log."""

    times: LogTimes

    def row(self, line: str, number: int) -> LogFrame | None:
        """Return the frame of a row; None if it is no data frame.

        Args:
            line: with its line feed, which only the last one of a file may lack.
            number: of the line.

        Raises:
            ValueError: the row is damaged.
        """

    def stamp(self, line: str) -> int | None:
        """Return the time stamp of a row [ns]; None if it has none."""

    def end(self) -> None:
        """Note what is missing at the end of the log.

        Raises:
            ValueError: the log is none of this format.
        """

    @property
    def run(self) -> tuple[Any, ...] | None:
        """Function of the core for ordinary rows, and its last arguments; None if there is none."""


class RowReader:
    """Iterator over the data frames of a text log; an error costs one row.

    Args:
        lines: of the log.
        format: of its rows.
        runs: whether to yield runs of rows as blocks.
    """

    def __init__(self, lines: Lines, format: RowFormat, *, runs: bool) -> None:  # noqa: A002
        self._lines, self._format = lines, format
        self._core = LogCore() if runs else None

    def __iter__(self) -> Iterator[LogFrame | FrameBlock]:
        lines, times = self._lines, self._format.times
        while True:
            if self._core is not None:
                yield from self._runs(self._core)
            if times.rows_to_see:
                ahead = lines.ahead(times.rows_to_see, MAX_WAIT)
                stamps = [self._format.stamp(line) for line in ahead]
                times.find([stamp for stamp in stamps if stamp is not None])
                continue
            line = next(lines, None)
            if line is None:
                self._format.end()
                return
            if (frame := self._format.row(line, lines.number)) is not None:
                yield frame

    def _runs(self, core: LogCore) -> Iterator[FrameBlock]:
        """Yield the ordinary rows before a row of another form, or before the end."""
        lines, times = self._lines, self._format.times
        run = self._format.run
        while run is not None and times.kind and max(times.in_c) <= MAX_NS:
            parse, *other = run
            state = core.state
            state.times, state.sum, state.high = times.in_c
            lines.place = core.read(parse, lines.buffer, lines.place, *other)
            times.in_c = state.times, state.sum, state.high
            lines.number += state.rows
            if state.frames:
                yield core.block()
            if not core.is_full and (lines.has_line or not lines.fill()):
                return


def nanoseconds(text: str) -> int:
    """Return a decimal number of seconds as nanoseconds; further digits are cut off."""
    seconds, _, fraction = text.partition(".")
    return int(seconds) * 10**9 + int(fraction[:9].ljust(9, "0"))


def shown(line: str) -> str:
    """Return the begin of a row for a message."""
    return repr(line.strip()[:MAX_SHOWN])


def check_frame(can_id: int, data: bytes, t_ns: int) -> None:
    """Raise ValueError if a frame cannot be one of CAN."""
    if not 0 <= can_id < 2**29:
        raise ValueError(f"CAN ID must be in [0, 0x1fffffff], got {can_id:#x}")
    if len(data) > MAX_DATA:
        raise ValueError(f"a frame has at most {MAX_DATA} bytes of data, got {len(data)}")
    if not -MAX_NS <= t_ns <= MAX_NS:
        raise ValueError("the time stamp is beyond 64 bits of nanoseconds")
