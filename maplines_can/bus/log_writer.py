"""Write log files that other tools read, frame by frame."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from importlib.util import find_spec
from os import PathLike
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

from ..values.errors import LogError, missing_extra
from ..values.input_files import checked_path
from ..values.output_files import writing
from ..wire import Frame
from .frame_block import stamp_ns

#: Suffixes of the formats: candump -L, Vector ASC and BLF, ASAM MDF 4.
SUFFIXES = (".log", ".asc", ".blf", ".mf4")
#: Flag of an error frame in the ID of candump.
_ERROR_FLAG = 1 << 29


class LogWriter:
    """Log file of sent frames, in the format of its suffix.

    ``.log`` is the format of ``candump -L``. An existing file is replaced. ``read_log`` reads the
    file. The time stamps in an ``.asc`` file are relative to the start; in the others they are
    absolute.

    Args:
        path: of the file.
        start: time at which the log starts [s]; no frame is earlier.

    Raises:
        LogError: the suffix is another one, or the file cannot be written. `write` and `close`
            raise it, too, and go on to do so: what was written before is then in a file of the
            same name with ``.part`` behind it.
        MissingExtraError: .mf4 without the package asammdf.

    >>> with LogWriter(tmp / "drive.log", start=1.0) as log:  # doctest: +SKIP
    ...     log.write(frame, 1.05)
    """

    def __init__(self, path: str | PathLike[str], start: float) -> None:
        self.path = checked_path(path, LogError)
        check_log_path(self.path)
        self.frames = 0
        self._error: LogError | None = None
        try:
            self._writer: Any = _WRITERS[self.path.suffix.lower()](self.path, start)
        except OSError as error:
            raise LogError(f"{path}: cannot be written: {error.strerror or error}") from error

    def write(self, frame: Frame, t: float, **flags: Any) -> None:
        """Write a frame sent at a time [s]; with other flags of ``can.Message``, such as remote."""
        with self._writing():
            self._writer.on_message_received(message_of(frame, t, **flags))
        self.frames += 1

    def close(self) -> None:
        """Write what is left and close the file; any number of times."""
        with self._writing():
            self._stop()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        if self._error is not None:
            raise self._error
        try:
            with writing(self.path, LogError, self._stop):
                yield
        except LogError as error:
            self._error = error
            raise

    def _stop(self) -> None:
        writer, self._writer = self._writer, None
        try:
            if writer is not None:
                writer.stop()
        except OSError:
            with suppress(OSError):
                writer.file.close()  # which that of BLF leaves open
            raise

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


class _CandumpWriter(can.CanutilsLogWriter):
    """Writer of the rows of ``candump -L``.

    python-can's loses the class of an error frame, and the length that a remote frame asks for.
    """

    def __init__(self, path: Path, _start: float) -> None:
        super().__init__(path)

    def on_message_received(self, msg: can.Message) -> None:
        if not (msg.is_error_frame or msg.is_remote_frame):
            super().on_message_received(msg)
            return
        if msg.is_error_frame:
            row = f"{_ERROR_FLAG | msg.arbitration_id:08X}#{msg.data.hex().upper()}"
        else:
            digits = 8 if msg.is_extended_id else 3
            row = f"{msg.arbitration_id:0{digits}X}#R{msg.dlc or ''} T"
        self.file.write(f"({msg.timestamp:f}) {self.channel} {row}\n")


class _AscWriter(can.ASCWriter):
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


class _BlfWriter(can.BLFWriter):
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


class _Mf4Writer(can.MF4Writer):
    """MF4 writer whose time begins at the start; python-can's begins when it is made."""

    def __init__(self, path: Path, start: float) -> None:
        super().__init__(path)
        self._start_ns = stamp_ns(start)
        self._start_time = 0.0  # messages have their time from the start
        self._mdf.header.start_time = datetime.fromtimestamp(start, UTC)
        self._mdf.header.abs_time = self._start_ns  # which asammdf has rounded

    def on_message_received(self, msg: can.Message) -> None:
        msg.timestamp = (stamp_ns(msg.timestamp) - self._start_ns) / 1e9
        super().on_message_received(msg)


_WRITERS: dict[str, Any] = {
    ".log": _CandumpWriter,
    ".asc": _AscWriter,
    ".blf": _BlfWriter,
    ".mf4": _Mf4Writer,
}


def check_log_path(path: Path) -> None:
    """Raise an error if a log cannot have this suffix; the file is not touched.

    Raises:
        LogError: the suffix is none of ``SUFFIXES``.
        MissingExtraError: .mf4 without the package asammdf.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        known = ", ".join(SUFFIXES)
        raise LogError(f"{path}: cannot be written in the format {suffix!r}; use {known}")
    if suffix == ".mf4" and not find_spec("asammdf"):
        raise missing_extra(f"{path}: writing .mf4 needs asammdf", "mf4")


def message_of(frame: Frame, t: float = 0.0, **flags: Any) -> can.Message:
    """Return a frame as a message of python-can, with its time stamp [s] and other flags of it."""
    return can.Message(
        timestamp=t,
        arbitration_id=frame.can_id,
        is_extended_id=frame.is_extended,
        is_rx=False,
        is_fd=frame.is_fd,
        data=frame.data,
        check=False,
        **{"bitrate_switch": frame.is_fd, **flags},
    )
