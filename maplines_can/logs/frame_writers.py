"""Writers of log files of python-can, each with what its format needs."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import can
from can.io.blf import (
    CAN_FD_MESSAGE,
    OBJ_HEADER_BASE_STRUCT,
    OBJ_HEADER_V1_STRUCT,
    TIME_ONE_NANS,
    timestamp_to_systemtime,
)

from .frame_block import stamp_ns

#: Flag of an error frame in the ID of candump.
_ERROR_FLAG = 1 << 29


class CandumpWriter(can.CanutilsLogWriter):
    """Writer of the rows of ``candump -L``.

    python-can's loses the class of an error frame, and the length that a remote frame asks for.
    """

    def __init__(self, path: Path, _start: float) -> None:
        super().__init__(path)

    def on_message_received(self, msg: can.Message) -> None:
        """Write the row of a frame."""
        if not (msg.is_error_frame or msg.is_remote_frame):
            super().on_message_received(msg)
            return
        if msg.is_error_frame:
            row = f"{_ERROR_FLAG | msg.arbitration_id:08X}#{msg.data.hex().upper()}"
        else:
            digits = 8 if msg.is_extended_id else 3
            row = f"{msg.arbitration_id:0{digits}X}#R{msg.dlc or ''} T"
        self.file.write(f"({msg.timestamp:f}) {self.channel} {row}\n")


class AscWriter(can.ASCWriter):
    """ASC writer whose dates are that of the start; python-can's header has that of today.

    python-can also writes the milliseconds of a date without leading zeros.
    """

    FORMAT_DATE = can.ASCWriter.FORMAT_DATE.replace("{}", "{:03d}")

    def __init__(self, path: Path, start: float) -> None:
        self._start = datetime.fromtimestamp(start)
        super().__init__(path)
        self.log_event("Start of drive", start)  # else the first frame is at 0

    def _format_header_datetime(self, _dt: datetime) -> str:
        return super()._format_header_datetime(self._start)


class BlfWriter(can.BLFWriter):
    """BLF writer with the date of the start, exact times, and objects of their whole size.

    python-can leaves out the last four bytes of a frame of CAN FD; other readers need them.
    """

    def __init__(self, path: Path, start: float) -> None:
        super().__init__(path)
        is_date = any(timestamp_to_systemtime(start))  # in milliseconds
        self._start_ns = stamp_ns(start) // 10**6 * 10**6 if is_date else 0
        self.start_timestamp = self._start_ns / 1e9

    def _add_object(self, obj_type: int, data: bytes, timestamp: float | None = None) -> None:
        self.stop_timestamp = timestamp or 0.0
        data += bytes(4 if obj_type == CAN_FD_MESSAGE else 0)
        head, start = OBJ_HEADER_BASE_STRUCT.size, OBJ_HEADER_V1_STRUCT.size
        size = head + start + len(data)
        ticks = max(stamp_ns(self.stop_timestamp) - self._start_ns, 0)
        self._buffer += [
            OBJ_HEADER_BASE_STRUCT.pack(b"LOBJ", head + start, 1, size, obj_type),
            OBJ_HEADER_V1_STRUCT.pack(TIME_ONE_NANS, 0, 0, ticks),
            data,
        ]
        self._buffer_size += size
        self.object_count += 1
        if self._buffer_size >= self.max_container_size:
            self._flush()


class Mf4Writer(can.MF4Writer):
    """MF4 writer whose time begins at the start; python-can's begins when it is made."""

    def __init__(self, path: Path, start: float) -> None:
        super().__init__(path)
        self._start_ns = stamp_ns(start)
        self._start_time = 0.0  # messages have their time from the start
        self._mdf.header.start_time = datetime.fromtimestamp(start, UTC)
        self._mdf.header.abs_time = self._start_ns  # which asammdf has rounded

    def on_message_received(self, msg: can.Message) -> None:
        """Write a frame with its time from the start."""
        msg.timestamp = (stamp_ns(msg.timestamp) - self._start_ns) / 1e9
        super().on_message_received(msg)


#: Writers by the suffixes of their files; each is made of the path, and the start [s].
WRITERS: dict[str, Any] = {
    ".log": CandumpWriter,
    ".asc": AscWriter,
    ".blf": BlfWriter,
    ".mf4": Mf4Writer,
}
