"""Lines of a text log, counted, whatever the file contains."""

from __future__ import annotations

import io
import math
import select
import time
import zlib
from itertools import islice
from typing import Any

from ..values.input_files import MAX_LINE

#: Characters after which the end of a damaged line is no longer sought.
MAX_DAMAGE = 1 << 24
#: Most characters of a reason in a message.
_MAX_REASON = 200
#: Usual greatest length of a line.
_AHEAD = 256
_BYTE_ORDER_MARK = "\ufeff"
_BLANKS = f" \t\r\n{_BYTE_ORDER_MARK}"


class Lines:
    """Lines of a text log, one by one with ``next``; only the last one may lack a line feed.

    A line of more than ``MAX_LINE`` bytes raises a ValueError, once it has been skipped. A byte
    that is not UTF-8 costs its own line only. Byte order marks are removed.

    Args:
        file: open for reading, with ``read1``.
        is_packed: whether the file is unpacked while it is read. An error then costs what has been
            unpacked in one reading, so that these are short.
    """

    def __init__(self, file: io.BufferedReader, *, is_packed: bool = False) -> None:
        self._file = file
        self._chunk = io.DEFAULT_BUFFER_SIZE if is_packed else 1 << 20
        self._poll = None if is_packed else _poll_of(file)
        self._is_at_end = self._skips_feed = False
        #: What was read, and the place of the next line in it.
        self.buffer, self.place = b"", 0
        self.number = 0
        #: What ended the file before its end, and why; None if nothing did.
        self.end: tuple[str, str] | None = None

    def __next__(self) -> str:
        end = self._end_of_line()
        is_whole = end >= 0
        if not is_whole:
            self._skip_line()
        if self.end or (is_whole and end == self.place):
            raise StopIteration
        self.number += 1
        if not is_whole:
            raise ValueError(f"has more than {MAX_LINE} characters")
        line = self.buffer[self.place : end].decode(errors="replace")
        line = line.removeprefix(_BYTE_ORDER_MARK) or "\n"
        self.place = end
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

    def ahead(self, count: int, seconds: float = math.inf) -> list[str]:
        """Return the next lines that are not blank, without taking them.

        Args:
            count: most lines.
            seconds: longest time that a line waits for the others. Where the system does not say
                whether a stream has data (Windows, and objects without a file descriptor), a line
                waits until they are there.
        """
        until, size = math.inf, _AHEAD * count
        while True:
            is_all = self.place + size >= len(self.buffer)
            part = self.buffer[self.place : self.place + size]
            *whole, rest = part.splitlines(keepends=True) or [b""]
            if rest.endswith((b"\n", b"\r")) or (is_all and self._is_at_end):
                whole, rest = [*whole, rest], b""
            texts = (line.decode(errors="replace").strip(_BLANKS) for line in whole)
            lines = [*islice(filter(None, texts), count)]
            if len(lines) == count or len(rest) > MAX_LINE:
                return lines
            if not is_all:
                size *= 2
                continue
            if lines and until == math.inf:
                until = time.monotonic() + seconds
            if self._is_at_end or not self._has_data(until):
                return lines
            self.fill()

    def _has_data(self, until: float) -> bool:
        """Whether the file can be read at once, or its end, before a time of the clock."""
        if self._poll is None or until == math.inf:
            return True
        return bool(self._poll.poll(max(0.0, 1000.0 * (until - time.monotonic()))))


def _poll_of(file: io.BufferedReader) -> Any:
    """Return a poll object of a file; None if the system has none for it."""
    try:
        poll: Any = select.poll()  # type: ignore[attr-defined,unused-ignore]
        poll.register(file.fileno(), select.POLLIN)  # type: ignore[attr-defined,unused-ignore]
    except (AttributeError, OSError):  # io.UnsupportedOperation is an OSError
        return None
    return poll


def text_of(error: Exception) -> str:
    """Return an error as a short text, with its type unless this is ValueError."""
    text = " ".join(str(error).split())
    text = text if len(text) <= _MAX_REASON else f"{text[:_MAX_REASON]}..."
    if text and type(error) is ValueError:
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
