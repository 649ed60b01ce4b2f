"""Write log files that other tools read, frame by frame."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..values.errors import LogError, missing_extra
from ..values.input_files import checked_path
from ..values.output_files import writing
from ..wire import Frame

if TYPE_CHECKING:
    import can

#: Suffixes of the formats: candump -L, Vector ASC and BLF, ASAM MDF 4.
SUFFIXES = (".log", ".asc", ".blf", ".mf4")


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
        from .frame_writers import WRITERS

        try:
            self._writer: Any = WRITERS[self.path.suffix.lower()](self.path, start)
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
    import can

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
