"""Output of candump, with and without -L."""

from __future__ import annotations

import re
from datetime import datetime
from typing import Any

from ..core import lib
from .frame_block import LogFrame
from .log_summary import LogSummary, Skipped
from .log_times import LogTimes
from .text_rows import check_frame, nanoseconds, shown

_ERROR_FLAG = 1  #: of an error frame, above the 29 bits of the CAN ID that candump prints

#: Row of candump, such as "(1.5)  can0  340   [8]  11 22 33 44 55 66 77 88": with -t a time stamp,
#: with -x the direction and the flags of CAN FD, with -a the data as ASCII, with -8 "{8}".
#: Its quantifiers are possessive, so that no line makes it search for long.
_ROW = re.compile(
    r"\s*+(?:\((?P<time>[^)]*)\)\s++)?(?P<channel>\S++)\s++(?:[RT]X\s++[B-]\s[E-]\s++)?"
    r"(?P<id>[0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})\s++(?:\[(?P<length>\d{1,2})\]|\{(?P<dlc>[0-9A-F])\})"
    r"(?P<data>(?:\s++[0-9A-Fa-f]{2}(?!\S))*)\s*+(?P<remote>remote request)?"
    r"(?:ERRORFRAME|'.*)?\s*+"
)
#: Row of candump -L, such as "(1.5) can0 340#1122334455667788", with "##" and flags for CAN FD.
_LOG_ROW = re.compile(
    r"\s*\((?P<time>[^)]*)\)\s+(?P<channel>\S+)\s+(?P<id>[0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})#"
    r"(?:(?P<remote>[Rr]\d?)|(?:#[0-9A-Fa-f])?(?P<data>(?:[0-9A-Fa-f]{2})*))(?:_[0-9A-Fa-f])?"
    r"(?P<direction>\s+[RT])?\s*"
)
#: Frame of CAN XL in such a row: its identifiers, type and flags stand before the data.
_XL_ROW = re.compile(r"\s*\([^)]*\)\s+\S+\s+[0-9A-Fa-f]+#[0-9A-Fa-f]{2}:[0-9A-Fa-f]{2}:.*\s*")
_STAMP = re.compile(r"\s*\(([^)]*)\)")


class CandumpFormat:
    """Rows of candump.

    Args:
        times: of the rows.
        summary: of the log.
    """

    run: tuple[Any, ...] | None = (lib.maplines_parse_candump,)

    def __init__(self, times: LogTimes, summary: LogSummary) -> None:
        self.times, self._summary = times, summary

    def row(self, line: str, number: int) -> LogFrame | None:
        """Return the frame of a row; None if it is no data frame."""
        if line.isspace() or line.startswith("\t"):  # candump -e explains an error frame
            return None
        row = _LOG_ROW.fullmatch(line) or _ROW.fullmatch(line)
        if row is None:
            self._count_other(line, number)
            return None
        is_log = row.re is _LOG_ROW
        can_id, is_extended = int(row["id"], 16), len(row["id"]) > 3
        t_ns = 0 if row["time"] is None else self.times.t_ns(self._stamp_of(row["time"]), number)
        if row["remote"] or can_id >> 29 == _ERROR_FLAG:
            self._summary.skipped[Skipped.REMOTE if row["remote"] else Skipped.ERROR] += 1
            return None
        data = bytes.fromhex(row["data"])
        if not is_log:  # candump -8: codes of more than 8 are those of 8 bytes
            length = int(row["length"]) if row["length"] else min(8, int(row["dlc"], 16))
            if len(data) != length:
                raise ValueError(f"{len(data)} bytes of data, but a length of {length}")
        check_frame(can_id, data, t_ns)
        if is_log and not (line[-1] == "\n" or row["direction"]):
            self._summary.notices.append(
                "the last line has no line feed; if the file is cut, its data are too"
            )
        return LogFrame(
            can_id, data, t_ns, is_extended, row["channel"], has_time=row["time"] is not None
        )

    def stamp(self, line: str) -> int | None:
        """Return the time stamp of a row [ns]; None if it has none."""
        row = _STAMP.match(line)
        try:
            return None if row is None else self._stamp_of(row[1])
        except ValueError:
            return None

    def end(self) -> None:
        """Note nothing: a log of candump has no end of its own."""

    def _count_other(self, line: str, number: int) -> None:
        """Count a row that is no frame of CAN; raise ValueError if it is damaged."""
        if (stamp := self.stamp(line)) is not None:
            self.times.t_ns(stamp, number)
        if not (_XL_ROW.fullmatch(line) or line.startswith("DROPCOUNT:")):
            raise ValueError(f"not a row of candump: {shown(line)}")
        self._summary.skipped[Skipped.OTHER] += 1

    def _stamp_of(self, text: str) -> int:
        """Return a time stamp [ns]: seconds, or date and time of day in local time."""
        if "-" not in text:
            return nanoseconds(text)
        if self.times.kind == "delta":
            raise ValueError(f"the time stamp {text!r} is a date, not a difference")
        return round(datetime.fromisoformat(text).timestamp() * 1e6) * 1000
