"""CRTD logs of the Open Vehicle Monitoring System (OVMS), of the versions 1 to 3.

The format is described in docs/source/crtd of openvehicles/Open-Vehicle-Monitoring-System-3.
SavvyCAN writes it, too, and reads stamps without a decimal point as microseconds.
"""

from __future__ import annotations

import re

from .frame_block import LogFrame
from .log_summary import LogSummary, Skipped
from .log_times import LogTimes
from .text_rows import check_frame, nanoseconds, shown

#: Row such as "1320745424.000002 1R11 7DF 02 01 0C"; without a bus it is of the first.
_ROW = re.compile(
    r"\s*(?P<time>\d+(?:\.\d*)?)\s+(?P<bus>\d*)(?:(?P<bits>[RT](?:11|29))"
    r"\s+(?P<id>[0-9A-Fa-f]++)(?P<data>(?:\s+[0-9A-Fa-f]{1,2}(?!\S))*+)|(?P<other>[A-Z]+)(?!\S).*)"
    r"\s*",
    re.ASCII,
)
_COMMENTS = ("CXX", "CVR")
#: Records of other kinds; what is not known is another event, as the description says.
_SKIPPED = {"CER": Skipped.ERROR, "CST": Skipped.STATE}
_MAX_STANDARD = 0x7FF


class CrtdFormat:
    """Rows of CRTD.

    Args:
        times: of the rows: Unix times, or from the start of the device.
        summary: of the log.
    """

    run = None

    def __init__(self, times: LogTimes, summary: LogSummary) -> None:
        self.times, self._summary = times, summary

    def row(self, line: str, number: int) -> LogFrame | None:
        """Return the frame of a row; None if it is no data frame."""
        if line.isspace():
            return None
        row, is_whole = _ROW.fullmatch(line), line.endswith("\n")
        if row is None or (row["other"] and not is_whole):
            raise ValueError(f"not a row of CRTD: {shown(line)}")
        if row["other"]:
            if row["other"] not in _COMMENTS:
                self._summary.skipped[_SKIPPED.get(row["other"], Skipped.OTHER)] += 1
            return None
        stamp, texts = row["time"], row["data"].split()
        stamp_ns = nanoseconds(stamp) if "." in stamp else 1000 * int(stamp)
        self.times.state_by(stamp_ns)
        t_ns = self.times.t_ns(stamp_ns, number)
        if not is_whole:
            self._summary.notices.append(
                "the last line has no line feed; if the file is cut, its data are too"
            )
        can_id, data = int(row["id"], 16), bytes(int(text, 16) for text in texts)
        is_extended = row["bits"].endswith("29")
        check_frame(can_id, data, t_ns)
        if can_id > _MAX_STANDARD and not is_extended:
            raise ValueError(f"the CAN ID {can_id:#x} has more than 11 bits")
        return LogFrame(can_id, data, t_ns, is_extended, row["bus"] or "1", has_time=True)

    def stamp(self, line: str) -> int | None:
        """Return None: the first stamp decides."""

    def end(self) -> None:
        """Note nothing: the format has no mark of the end."""
