"""Logs whose columns have names: TRC of PEAK's tools, and the CSV of python-can and of SavvyCAN."""

from __future__ import annotations

import re
from base64 import b64decode

from ..wire.layout.slot_messages import FD_LENGTHS
from .frame_block import MAX_DATA, LogFrame
from .log_summary import LogSummary, Skipped
from .log_times import LogTimes
from .text_rows import check_frame, nanoseconds, shown

#: Columns of the versions of TRC before 2.0, by their letters in later ones: number, offset, bus,
#: type, CAN ID, reserved, data length code, data.
_TRC_COLUMNS = {"1.0": "NOILD", "1.1": "NOTILD", "1.2": "NOBTILD", "1.3": "NOBTIRLD"}
_TRC_2 = ("2.0", "2.1")
#: Data frames by their types.
_TRC_FRAMES = {"rx", "tx", "dt", "fd", "fb", "fe", "bi"}
_TRC_FD = {"fd", "fb", "fe", "bi"}
_TRC_SKIPPED = {
    "error": Skipped.ERROR,
    "er": Skipped.ERROR,
    "rr": Skipped.REMOTE,
    "warng": Skipped.STATE,
    "st": Skipped.STATE,
    "ec": Skipped.STATE,
}
_UNIX_DAY = 25569  #: from 1899-12-30, the day 0 of TRC

_CSV_COLUMNS: tuple[str, ...] = (
    "timestamp",
    "arbitration_id",
    "extended",
    "remote",
    "error",
    "dlc",
    "data",
)
_CSV_ROW = re.compile(r"\s*[-+.0-9]")
_DECIMAL = re.compile(r"[0-9]+\.?[0-9]*")

#: Columns of SavvyCAN, besides those of the data: "d1", "d2" ... "Dir" came later, and is not kept.
_SAVVYCAN_COLUMNS = ("time stamp", "id", "extended", "bus", "len")
_MICROSECONDS = re.compile(r"-?[0-9]+")
_HEX = re.compile(r"[0-9A-Fa-f]+")


class TrcFormat:
    """Rows of TRC, of the versions 1.0 to 1.3, 2.0 and 2.1.

    Args:
        times: of the rows: from the start of the log, which the versions after 1.0 state.
        summary: of the log.
    """

    run = None

    def __init__(self, times: LogTimes, summary: LogSummary) -> None:
        self.times, self._summary = times, summary
        self._version, self._columns = "1.0", _TRC_COLUMNS["1.0"]
        self._start_ns = 0

    def row(self, line: str, number: int) -> LogFrame | None:
        """Return the frame of a row; None if it is no data frame."""
        text = line.strip()
        if text.startswith(";"):
            self._read_header(text)
        if not text or text.startswith(";"):
            return None
        if not self._columns:
            raise ValueError(f"the columns of version {self._version!r} of TRC are not known")
        cells = dict(zip(self._columns, text.split(maxsplit=len(self._columns) - 1), strict=False))
        kind = _trc_kind(cells, is_whole=line.endswith("\n"))
        if isinstance(kind, Skipped):
            self._summary.skipped[kind] += 1
            return None
        if missing := [one for one in self._columns if one not in cells and one != "D"]:
            raise ValueError(f"the row has no column {missing[0]}: {shown(line)}")
        data = bytes.fromhex(cells.get("D", ""))
        code = int(cells["L"]) if "L" in cells else 0
        if kind in _TRC_FD and code in range(16):
            code = FD_LENGTHS[code]
        length = int(cells["l"]) if "l" in cells else code
        if len(data) == length > 8 and kind not in _TRC_FD:  # put together from frames of J1939
            self._summary.skipped[Skipped.OTHER] += 1
            return None
        length = length if kind in _TRC_FD else min(8, length)
        if len(data) != length:
            raise ValueError(f"{len(data)} bytes of data, but a length of {length}")
        self.times.state("absolute" if self._start_ns else "zero")
        t_ns = self.times.t_ns(self._start_ns + nanoseconds(cells["O"]) // 1000, number)
        can_id = int(cells["I"], 16)
        check_frame(can_id, data, t_ns)
        return LogFrame(can_id, data, t_ns, len(cells["I"]) > 4, cells.get("B", "1"), has_time=True)

    def stamp(self, line: str) -> int | None:
        """Return None: the header states the kind of the stamps."""

    def end(self) -> None:
        """Note nothing: the format has no mark of the end."""

    def _read_header(self, text: str) -> None:
        name, _, value = text.partition("=")
        value = value.strip(" ;")
        if name == ";$FILEVERSION":
            self._version, self._columns = value, _TRC_COLUMNS.get(value, "")
        elif name == ";$COLUMNS" and self._version in _TRC_2:
            self._columns = value.replace(",", "").replace(" ", "")
        elif name == ";$STARTTIME":
            self._start_ns = round((float(value) - _UNIX_DAY) * 86400e6) * 1000


def _trc_kind(cells: dict[str, str], *, is_whole: bool) -> Skipped | str:
    """Return what a row is: the type of a data frame, or the kind of another record.

    Raises:
        ValueError: the type is not known, or the row is damaged.
    """
    data = cells.get("D", "")
    if cells.get("I") == "FFFFFFFF":
        return Skipped.STATE
    if data.startswith(("RTR", "ERROR")):
        return Skipped.REMOTE if data.startswith("RTR") else Skipped.ERROR
    kind = cells.get("T", "" if len(cells) < 3 else "rx").lower()
    if kind in _TRC_FRAMES:
        return kind
    if kind in _TRC_SKIPPED:
        return _TRC_SKIPPED[kind]
    if not (kind.isalpha() and is_whole):
        raise ValueError(f"{kind!r} is not the type of a record of TRC")
    return Skipped.OTHER


class CsvFormat:
    """Rows of the CSV of python-can, with its header, with columns in another order, or without.

    Args:
        times: of the rows.
        summary: of the log.
    """

    run = None

    def __init__(self, times: LogTimes, summary: LogSummary) -> None:
        self.times, self._summary = times, summary
        self._columns = _CSV_COLUMNS
        self._is_first = True

    def row(self, line: str, number: int) -> LogFrame | None:
        """Return the frame of a row; None if it is no data frame."""
        cells = [cell.strip() for cell in line.split(",")]
        if cells == [""]:
            return None
        is_first, self._is_first = self._is_first, False
        names = tuple(cell.lower() for cell in cells)
        if "timestamp" in names or (is_first and not _CSV_ROW.match(line)):
            self._columns = names
            return None
        if missing := [name for name in _CSV_COLUMNS if name not in self._columns]:
            raise ValueError(f"the header has no column {missing[0]}")
        if len(cells) != len(self._columns):
            raise ValueError(f"{len(cells)} cells, but {len(self._columns)} columns")
        row = dict(zip(self._columns, cells, strict=True))
        stamp = _seconds(row["timestamp"])
        self.times.state_by(stamp)
        t_ns = self.times.t_ns(stamp, number)
        if "1" in (row["error"], row["remote"]):
            kind = Skipped.ERROR if row["error"] == "1" else Skipped.REMOTE
            self._summary.skipped[kind] += 1
            return None
        can_id, data = int(row["arbitration_id"], 16), b64decode(row["data"], validate=True)
        if len(data) != int(row["dlc"]):
            raise ValueError(f"{len(data)} bytes of data, but a length of {row['dlc']}")
        check_frame(can_id, data, t_ns)
        channel = row.get("channel", "")
        return LogFrame(can_id, data, t_ns, row["extended"] == "1", channel, has_time=True)

    def stamp(self, line: str) -> int | None:
        """Return None: the first stamp decides."""

    def end(self) -> None:
        """Note nothing: the format has no mark of the end."""


class SavvyCanFormat:
    """Rows of the CSV of SavvyCAN, of GVRET and other devices: the native files of framefileio.cpp.

    It has no mark of remote and error frames, and no more than 8 bytes of a frame of CAN FD. The
    times are microseconds of the device or of the system.

    Args:
        times: of the rows.
        summary: of the log.
    """

    run = None

    def __init__(self, times: LogTimes, summary: LogSummary) -> None:  # noqa: ARG002
        self.times = times
        self._columns: tuple[str, ...] = ()

    def row(self, line: str, number: int) -> LogFrame | None:
        """Return the frame of a row; None if it is no data frame."""
        cells = [cell.strip() for cell in line.split(",")]
        if cells == [""]:
            return None
        if cells[0].lower() == _SAVVYCAN_COLUMNS[0]:
            self._columns = tuple(cell.lower() for cell in cells)
            return None
        row = dict(zip(self._columns, cells, strict=False))
        if missing := [name for name in _SAVVYCAN_COLUMNS if name not in row]:
            raise ValueError(f"the row has no column {missing[0]!r}: {shown(line)}")
        data = self._data(row, is_whole=line.endswith("\n"))
        stamp, can_id, is_extended = row["time stamp"], row["id"], row["extended"].lower()
        if not (_MICROSECONDS.fullmatch(stamp) and _HEX.fullmatch(can_id) and row["bus"].isdigit()):
            raise ValueError(f"not a row of SavvyCAN: {shown(line)}")
        if is_extended not in ("true", "false"):
            raise ValueError(f"{is_extended!r} is neither true nor false")
        self.times.state_by(1000 * int(stamp))
        t_ns = self.times.t_ns(1000 * int(stamp), number)
        check_frame(int(can_id, 16), data, t_ns)
        is_long = is_extended == "true" or int(can_id, 16) > 0x7FF  # SavvyCAN reads it so, too
        return LogFrame(int(can_id, 16), data, t_ns, is_long, row["bus"], has_time=True)

    def _data(self, row: dict[str, str], *, is_whole: bool) -> bytes:
        """Return the data of a row; the last byte of a row that is cut may be half of one."""
        length = int(row["len"])
        cells = [row.get(f"d{k}", "") for k in range(1, min(length, MAX_DATA) + 1)]
        if length != len(cells) or not all(cells):
            there = sum(map(bool, cells))
            raise ValueError(f"{there} bytes of data, but a length of {length}")
        digits = {1, 2} if is_whole else {2}
        if not all(_HEX.fullmatch(cell) and len(cell) in digits for cell in cells):
            raise ValueError(f"the data are not bytes: {shown(' '.join(cells))}")
        return bytes(int(cell, 16) for cell in cells)

    def stamp(self, line: str) -> int | None:
        """Return None: the first stamp decides."""

    def end(self) -> None:
        """Note nothing: the format has no mark of the end."""


def _seconds(text: str) -> int:
    """Return a number as Python writes it, in seconds, as nanoseconds."""
    return nanoseconds(text) if _DECIMAL.fullmatch(text) else round(float(text) * 1e9)
