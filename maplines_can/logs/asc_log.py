"""ASC logs of Vector's tools: frames, events and headers."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from ..core import lib
from .frame_block import LogFrame
from .log_summary import LogSummary, Skipped
from .log_times import LogTimes
from .text_rows import check_frame, nanoseconds, shown

_BASE = re.compile(r"\bbase\s+(hex|dec)\b", re.IGNORECASE)
_TIMESTAMPS = re.compile(r"\btimestamps\s+(absolute|relative)\b", re.IGNORECASE)
#: First words of the rows that have no time stamp, besides comments.
_WORDS = ("date", "base", "timestamps", "internal", "no", "begin", "end")
_COMMENTS = ("//", ";")
_STAMP = re.compile(r"\s*(\d+\.\d*)(?!\S)", re.ASCII)
_DIRECTIONS = ("rx", "tx")
_IDS = {16: re.compile(r"[0-9A-Fa-f]+[xX]?"), 10: re.compile(r"[0-9]+[xX]?")}
_FRAME = "frame"
#: CAN ID, whether it is extended, texts of the data bytes and what follows, number of bytes.
_Fields = tuple[int, bool, list[str], int]


class AscFormat:
    """Rows of ASC.

    The header is whatever stands before the first row with a time stamp; its rows may have any
    order. Without one, numbers are hexadecimal.

    Args:
        times: of the rows; the header may state their kind.
        summary: of the log.
    """

    def __init__(self, times: LogTimes, summary: LogSummary) -> None:
        self.times, self._summary = times, summary
        self._radix = 16
        self._is_header, self._is_asc = True, False
        self._is_block_open = False
        self._unknown = ""  # first row that nothing is known of

    @property
    def run(self) -> tuple[Any, ...] | None:
        """Function of the core for frames, and the radix of their numbers."""
        return None if self._is_header else (lib.maplines_parse_asc, self._radix)

    def row(self, line: str, number: int) -> LogFrame | None:
        """Return the frame of a row; None if it is no data frame."""
        stamp = self.stamp(line)
        if stamp is None:
            self._read_header(line)
            return None
        self._is_header, self._is_asc = False, True
        t_ns = self.times.t_ns(stamp, number)
        words = line.split()
        kind = _kind_of(words)
        if isinstance(kind, Skipped):
            self._summary.skipped[kind] += 1
        if kind is not _FRAME:
            return None
        is_fd = not words[1].isdecimal()
        channel, rest = (words[2], words[4:]) if is_fd else (words[1], [words[2], *words[4:]])
        fields = self._fd_fields(rest) if is_fd else self._classic_fields(rest)
        if fields is None:
            self._summary.skipped[Skipped.REMOTE] += 1
            return None
        can_id, is_extended, texts, length = fields
        if self._radix == 16:
            data = bytes.fromhex(" ".join(texts[:length]))
        else:
            data = bytes(_number(text, 10, 255, "a byte") for text in texts[:length])
        if len(data) != length:
            raise ValueError(f"{len(data)} bytes of data, but a length of {length}")
        if self._radix == 10 and line[-1] != "\n" and len(texts) == length and len(words[-1]) < 3:
            self._summary.notices.append(
                "the last line has no line feed; if the file is cut, its last byte is too"
            )
        check_frame(can_id, data, t_ns)
        return LogFrame(can_id, data, t_ns, is_extended, str(int(channel) - 1), has_time=True)

    def stamp(self, line: str) -> int | None:
        """Return the time stamp of a row [ns]; None if it has none."""
        row = _STAMP.match(line)
        return None if row is None else nanoseconds(row[1])

    def end(self) -> None:
        """Note that the log is not closed; raise ValueError if it is none."""
        unknown, self._unknown = self._unknown, ""
        is_open, self._is_block_open = self._is_block_open, False
        if unknown and not self._is_asc:
            raise ValueError(f"it has neither a header nor frames: {unknown}")
        if is_open:
            self._summary.notices.append(
                "the log has no End TriggerBlock: its recording was not closed, or the file is cut"
            )

    def _read_header(self, line: str) -> None:
        """Read a row of a header; raise ValueError if there is none here and the row is unknown."""
        words = line.lower().split()
        if not words or words[0].startswith(_COMMENTS):
            self._is_asc |= bool(words)
            return
        is_known = words[0] in _WORDS
        self._is_asc |= is_known
        if not (self._is_header or is_known):
            raise ValueError(f"not a row of ASC: {shown(line)}")
        if not is_known:
            self._unknown = self._unknown or shown(line)
        if words[0] in ("begin", "end"):
            self._is_block_open = words[0] == "begin"
            self._is_header = True
        if base := _BASE.search(line):
            self._is_asc, self._radix = True, {"hex": 16, "dec": 10}[base[1].lower()]
        if kind := _TIMESTAMPS.search(line):
            self.times.state({"absolute": "zero", "relative": "delta"}[kind[1].lower()])

    def _classic_fields(self, words: list[str]) -> _Fields | None:
        """Return the fields of "340 d 2 11 22 ..."; None if it is a remote frame."""
        if words[1:2] in (["r"], ["R"]):
            return None
        if len(words) < 3 or words[1] not in ("d", "D"):
            raise ValueError(f"not a frame of ASC: {shown(' '.join(words))}")
        length = min(8, _number(words[2], self._radix, 15, "a data length code"))
        return *self._can_id(words), words[3:], length

    def _fd_fields(self, words: list[str]) -> _Fields | None:
        """Return the fields of "340 name 1 0 9 12 11 22 ...", with or without a name."""
        flags = 1 if words[1:2] in (["0"], ["1"]) else 2
        if len(words) < flags + 4:
            raise ValueError(f"not a frame of ASC: {shown(' '.join(words))}")
        dlc, length = words[flags + 2], _number(words[flags + 3], 10, 64, "a length")
        if length == 0 and dlc.strip("0"):
            return None
        return *self._can_id(words), words[flags + 4 :], length

    def _can_id(self, words: list[str]) -> tuple[int, bool]:
        """Return the CAN ID, and whether it is extended; symbolic rows have it at their end."""
        text, radix = words[0], self._radix
        if not _IDS[radix].fullmatch(text) and "ID" in words[:-2]:
            text, radix = words[words.index("ID") + 2], 10
        is_extended = text[-1] in "xX"
        number = text[:-1] if is_extended else text
        return _number(number, radix, 2**29 - 1, "a CAN ID"), is_extended


def _kind_of(words: Sequence[str]) -> Skipped | str:
    """Return what a row is; an empty text if it is nothing on the bus.

    Raises:
        ValueError: the row is damaged.
    """
    if len(words) > 4 and words[3] in ("Rx", "Tx") and words[1].isdecimal():
        return _FRAME
    head = [word.casefold() for word in words[1:5]]
    is_fd, is_classic = head[:1] == ["canfd"], head[:1] != [] and head[0].isdecimal()
    if head[:2] == ["start", "of"]:
        return ""
    if any(word.startswith("errorframe") for word in head[1:]):
        return Skipped.ERROR
    if head[:1] == ["can"] and head[2:3] != [] and head[2].startswith("status:"):
        return Skipped.STATE
    if (is_fd or is_classic) and len(head) > 2:
        if head[2] == "txrq":
            return Skipped.REQUEST
        if head[2] in _DIRECTIONS:
            return _FRAME
    if not head or is_fd or (is_classic and (len(head) < 2 or _IDS[16].fullmatch(head[1]))):
        raise ValueError(f"not a row of ASC: {shown(' '.join(words))}")
    return Skipped.OTHER


def _number(text: str, radix: int, most: int, what: str) -> int:
    """Return a number of a row; raise ValueError if it is none or too great."""
    value = int(text, radix) if text.isascii() and text.isalnum() else -1
    if not 0 <= value <= most:
        raise ValueError(f"{text!r} is not {what}")
    return value
