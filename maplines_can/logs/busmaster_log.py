"""Logs of BUSMASTER: frames of CAN and CAN FD, after a header.

The header and the rows are those of LogObjectCAN.cpp and FormatMsgCommon.cpp of rbei-etas/busmaster
and of the logs among its tests; the types of CAN FD and of errors are those that Wireshark reads
(wiretap/busmaster_scanner.l). SavvyCAN writes the format with three decimals instead of four.
"""

from __future__ import annotations

import re
from datetime import UTC, datetime

from ..wire.layout.slot_messages import FD_LENGTHS
from .frame_block import LogFrame
from .log_summary import LogSummary, Skipped
from .log_times import LogTimes
from .text_rows import check_frame, shown

#: Row such as "11:49:12:9420 Rx 1 0x023 s 2 40 41".
_ROW = re.compile(
    r"\s*(?P<time>\d+:\d+:\d+:\d+)\s+[RT]x\s+(?P<channel>\d+)\s+(?P<id>\S+)\s+"
    r"(?:(?P<error>ERR.*)|(?P<type>[sx](?:r|-fd)?)\s+(?P<length>\d+)(?P<data>(?:\s+\S+)*)\s*)",
    re.ASCII | re.IGNORECASE | re.DOTALL,
)
_ID = {16: re.compile(r"(?:0[xX])?([0-9A-Fa-f]+)"), 10: re.compile("([0-9]+)")}
#: Bytes of data by the radix. BUSMASTER writes 2 and 3 digits; a row that is cut has fewer.
_BYTE = {16: re.compile(r"[0-9A-Fa-f]{2}"), 10: re.compile("[0-9]{3}")}
#: Kinds of the stamps without a date. That of the header belongs to the time of day; BUSMASTER
#: counts absolute times from when it was connected, which it does not write.
_TIMES = {"ABSOLUTE MODE": "zero", "RELATIVE MODE": "delta", "SYSTEM MODE": "zero"}
_RADIX = {"HEX": 16, "DEC": 10}
_DAY_NS = 86_400 * 10**9


class BusmasterFormat:
    """Rows of BUSMASTER, of one or more sessions.

    Times of day are taken as UTC, as the log has no zone. Each is of the day in which it is next to
    the one before, or to the start of the session.

    Args:
        times: of the rows; the header states their kind.
        summary: of the log.
    """

    run = None

    def __init__(self, times: LogTimes, summary: LogSummary) -> None:
        self.times, self._summary = times, summary
        self._radix, self._protocol = 16, "CAN"
        # Of times of day: time of the last row, or of the start of the session.
        self._last_ns: int | None = None
        self._is_time_of_day = False
        self._is_open = False

    def row(self, line: str, number: int) -> LogFrame | None:
        """Return the frame of a row; None if it is no data frame."""
        text = line.strip()
        if text.startswith("***"):
            self._read_header(text.strip("*").strip().upper())
        if not text or text.startswith("***"):
            return None
        if self._protocol != "CAN":
            raise ValueError(f"the protocol {self._protocol!r} of BUSMASTER is not read, only CAN")
        row = _ROW.fullmatch(line)
        if row is None:
            raise ValueError(f"not a row of BUSMASTER: {shown(line)}")
        t_ns = self._t_ns(row["time"], number)
        kind = (row["type"] or "").lower()
        if row["error"] or kind.endswith("r"):
            self._summary.skipped[Skipped.ERROR if row["error"] else Skipped.REMOTE] += 1
            return None
        can_id = _ID[self._radix].fullmatch(row["id"])
        if can_id is None:
            raise ValueError(f"{row['id']!r} is not a CAN ID")
        data = self._data(row["data"].split(), int(row["length"]), is_fd=kind.endswith("fd"))
        number_of_id = int(can_id[1], self._radix)
        check_frame(number_of_id, data, t_ns)
        is_extended = kind.startswith("x")
        return LogFrame(number_of_id, data, t_ns, is_extended, row["channel"], has_time=True)

    def stamp(self, line: str) -> int | None:
        """Return None: the header states the kind of the stamps, or the first one decides."""

    def end(self) -> None:
        """Note that the log is not closed."""
        if self._is_open:
            self._summary.notices.append(
                "the log has no STOP LOGGING SESSION: its recording was not closed, or it is cut"
            )
        self._is_open = False

    def _read_header(self, text: str) -> None:
        if text.startswith("BUSMASTER"):
            self._radix, self._protocol = 16, "CAN"
            self._last_ns, self._is_time_of_day = None, False
        elif text.startswith("PROTOCOL "):
            self._protocol = text.removeprefix("PROTOCOL ")
        elif text.startswith("START DATE AND TIME"):
            self._last_ns = _start_ns(text)
        elif text in _RADIX:
            self._radix = _RADIX[text]
        elif text in _TIMES:
            self._is_time_of_day = text == "SYSTEM MODE" and self._last_ns is not None
            self.times.state("absolute" if self._is_time_of_day else _TIMES[text])
        elif text.endswith("LOGGING SESSION]"):
            self._is_open = text.startswith("[START")

    def _t_ns(self, text: str, number: int) -> int:
        hours, minutes, seconds, fraction = text.split(":")
        whole = 3600 * int(hours) + 60 * int(minutes) + int(seconds)
        stamp = whole * 10**9 + int(fraction[:9].ljust(9, "0"))
        self.times.state_by(stamp)
        if self._is_time_of_day and self.times.kind == "absolute" and self._last_ns is not None:
            stamp += _DAY_NS * round((self._last_ns - stamp) / _DAY_NS)
            self._last_ns = stamp
        return self.times.t_ns(stamp, number)

    def _data(self, texts: list[str], length: int, *, is_fd: bool) -> bytes:
        if is_fd and len(texts) != length and length in range(16):
            length = FD_LENGTHS[length]
        if len(texts) != length:
            raise ValueError(f"{len(texts)} bytes of data, but a length of {length}")
        if not all(_BYTE[self._radix].fullmatch(text) for text in texts):
            raise ValueError(f"the data are not bytes: {shown(' '.join(texts))}")
        return bytes(int(text, self._radix) for text in texts)


def _start_ns(text: str) -> int | None:
    """Return the time of "... 29:6:2012 11:39:49:141" [ns]; None if it is none."""
    numbers = [int(number) for number in re.findall(r"\d{1,4}", text)]
    try:
        day, month, year, hour, minute, second, milliseconds = numbers
        date = datetime(year, month, day, hour, minute, second, 1000 * milliseconds, UTC)
    except ValueError:
        return None
    return round(date.timestamp() * 1000) * 10**6
