"""Readers of binary logs whose memory is bounded, whatever the file claims."""

from __future__ import annotations

import sqlite3
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import can
import numpy as np
from can.io.blf import (
    CAN_ERROR_EXT,
    CAN_ERROR_EXT_STRUCT,
    CAN_FD_MESSAGE,
    CAN_FD_MESSAGE_64,
    CAN_FD_MSG_64_STRUCT,
    CAN_FD_MSG_STRUCT,
    CAN_MESSAGE,
    CAN_MESSAGE2,
    CAN_MSG_STRUCT,
    FILE_HEADER_STRUCT,
    LOG_CONTAINER,
    LOG_CONTAINER_STRUCT,
    NO_COMPRESSION,
    OBJ_HEADER_BASE_STRUCT,
    ZLIB_DEFLATE,
    BLFParseError,
)
from numpy.typing import NDArray

from ..native import core
from .frame_block import BLOCK_FRAMES, MAX_DATA, FrameArrays, FrameBlock
from .log_summary import LogSummary

#: Most bytes of an object of a BLF file, packed and unpacked; writers make containers of 128 kB.
MAX_OBJECT = 1 << 24
#: Bytes of the content of an object, by its kind.
_CONTENT = {
    CAN_MESSAGE: CAN_MSG_STRUCT.size,
    CAN_MESSAGE2: CAN_MSG_STRUCT.size,
    CAN_ERROR_EXT: CAN_ERROR_EXT_STRUCT.size,
    CAN_FD_MESSAGE: CAN_FD_MSG_STRUCT.size,
    CAN_FD_MESSAGE_64: CAN_FD_MSG_64_STRUCT.size,
}
#: Most bytes of a row of an SQL table; that of a frame has some 100.
MAX_ROW = 1 << 16
#: Head of a compressed block of an MF4 file, with the lengths of its data unpacked and packed.
_DZ_MARK, _DZ = b"##DZ\0\0\0\0", struct.Struct("<32xQQ")


class BlfReader(can.BLFReader):
    """BLF reader that refuses objects of more than ``MAX_OBJECT`` bytes.

    It also stops at an object of length 0; python-can's never ends (its issue 1584).

    Args:
        file: open for reading, and able to seek to its start.
        summary: of the log.

    Raises:
        BLFParseError: the header or an object is too short, too long, or not known.
    """

    def __init__(self, file: BinaryIO, summary: LogSummary) -> None:
        length = int.from_bytes(file.read(8)[4:], "little")
        file.seek(0)
        if not FILE_HEADER_STRUCT.size <= length <= MAX_OBJECT:  # python-can would read all of it
            raise BLFParseError(f"its header has {length} bytes")
        super().__init__(file)
        self._summary = summary

    def __iter__(self) -> Iterator[can.Message]:  # type: ignore[override]
        head = OBJ_HEADER_BASE_STRUCT
        while start := self.file.read(head.size):
            signature, _, _, size, kind = head.unpack(start)
            if signature != b"LOBJ":
                raise BLFParseError("an object does not begin with LOBJ")
            if not head.size <= size <= MAX_OBJECT:
                raise BLFParseError(
                    f"an object has {size} bytes, and must have {head.size} to {MAX_OBJECT}"
                )
            content = self.file.read(size - head.size)
            self.file.read(size % 4)  # padding
            if kind == LOG_CONTAINER:
                yield from self._parse_container(_unpacked(content))
        self.stop()

    def _parse_container(self, data: bytes) -> Iterator[can.Message]:
        yield from super()._parse_container(data)
        if len(self._tail) > MAX_OBJECT:
            raise BLFParseError(f"an object in containers has more than {MAX_OBJECT} bytes")

    def _parse_data(self, data: bytes) -> Iterator[can.Message]:
        end = _first_too_short(data)
        yield from super()._parse_data(data[:end])
        if end is not None:
            raise BLFParseError("an object is shorter than its own header")


class BlfRunReader(BlfReader):
    """BLF reader that yields runs of data frames as blocks; python-can reads all other objects.

    Args:
        file: as for `BlfReader`.
        summary: of the log.
    """

    def __init__(self, file: BinaryIO, summary: LogSummary) -> None:
        super().__init__(file, summary)
        self._arrays = FrameArrays()

    def _parse_data(self, data: bytes) -> Iterator[Any]:
        arrays, place = self._arrays, 0
        while True:
            frames, place = core.parse_blf(
                data, place, self.start_timestamp, arrays.names, arrays.arrays
            )
            if frames:
                self._pos = place
                yield arrays.block(frames)
            if frames < BLOCK_FRAMES:
                end = _end_of_object(data, place)
                try:
                    yield from super()._parse_data(data[place:end])
                finally:
                    self._pos += place
                if end is None:
                    return
                place = end


def _end_of_object(data: bytes, place: int) -> int | None:
    """Return the place after the next object; None if it is not whole.

    An object that is shorter than its content is not, since the reader goes on behind it.
    """
    head = OBJ_HEADER_BASE_STRUCT
    place = data.find(b"LOBJ", place, place + 8)
    if place < 0 or place + head.size > len(data):
        return None
    _, _, version, size, kind = head.unpack_from(data, place)
    least = head.size + (16 if version == 1 else 24) + _CONTENT.get(kind, 0)
    return place + size if least <= size <= len(data) - place else None


def _unpacked(container: bytes) -> bytes:
    """Return the content of a container."""
    method, _ = LOG_CONTAINER_STRUCT.unpack_from(container)
    data = container[LOG_CONTAINER_STRUCT.size :]
    if method == ZLIB_DEFLATE:
        data = zlib.decompressobj().decompress(data, MAX_OBJECT + 1)
    elif method != NO_COMPRESSION:
        raise BLFParseError(f"the compression method {method} of a container is unknown")
    if len(data) > MAX_OBJECT:
        raise BLFParseError(f"a container has more than {MAX_OBJECT} bytes when it is unpacked")
    return data


def _first_too_short(data: bytes) -> int | None:
    """Return the place of the first object whose length field is less than its header."""
    head, place = OBJ_HEADER_BASE_STRUCT, 0
    while (place := data.find(b"LOBJ", place, place + 8)) >= 0 and place + head.size <= len(data):
        size = head.unpack_from(data, place)[3]
        if size < head.size:
            return place
        place += size
    return None


class Mf4Reader(can.MF4Reader):
    """MF4 reader that refuses compressed blocks of more than ``MAX_OBJECT`` bytes.

    asammdf unpacks a block as a whole; the standard recommends blocks of 4 MB at most.

    Args:
        path: of the file.
        summary: of the log.

    Raises:
        ValueError: a block is larger.
    """

    def __init__(self, path: Path, summary: LogSummary) -> None:
        check_mf4_blocks(path)
        super().__init__(path)
        self._summary = summary


class Mf4RunReader(Mf4Reader):
    """MF4 reader that yields the data frames of a file as blocks, if they are in one group.

    Those of several groups, which are merged by their times, are read by python-can.

    Args:
        path: of the file.
        summary: of the log.
    """

    def __iter__(self) -> Iterator[Any]:
        groups = [number for number, group in enumerate(self._mdf.groups) if _has_frames(group)]
        if len(groups) == 1:
            return self._runs(groups[0])
        return super().__iter__()

    def _runs(self, group: int) -> Iterator[FrameBlock]:
        numbers: dict[int, int] = {}
        for offset in range(0, self._mdf.groups[group].channel_group.cycles_nr, BLOCK_FRAMES):
            found = self._mdf.get(
                "CAN_DataFrame", group, record_offset=offset, record_count=BLOCK_FRAMES, raw=False
            )
            fields = {
                name.removeprefix("CAN_DataFrame."): found[name]
                for name in found.samples.dtype.names
            }
            yield _mf4_block(fields, found.timestamps + self._start_timestamp, numbers)


def _has_frames(group: Any) -> bool:
    """Return whether a group has data frames of CAN, as python-can decides it."""
    from asammdf.blocks.v4_constants import BUS_TYPE_CAN, FLAG_CG_BUS_EVENT, SOURCE_BUS

    about = group.channel_group
    return bool(
        about.flags & FLAG_CG_BUS_EVENT
        and about.cycles_nr > 0
        and about.acq_source is not None
        and about.acq_source.source_type & SOURCE_BUS
        and about.acq_source.bus_type == BUS_TYPE_CAN
        and any(channel.name == "CAN_DataFrame" for channel in group.channels)
    )


def _mf4_block(
    fields: Mapping[str, NDArray[Any]], seconds: NDArray[np.float64], numbers: dict[int, int]
) -> FrameBlock:
    """Return the data frames of a group.

    Args:
        fields: of the frames, by the names of the standard.
        seconds: times.
        numbers: of the channels so far; new ones are added.
    """
    n = len(seconds)
    t_ns = np.rint(seconds * 1e9)
    if n and not np.abs(t_ns).max() < 2**63:
        raise ValueError("the time stamp is beyond 64 bits of nanoseconds")
    given = fields["DataBytes"][:, :MAX_DATA]
    length = np.minimum(fields["DataLength"], given.shape[1]).astype(np.uint8)
    if n and (fields["DataLength"] > MAX_DATA).any():
        raise ValueError(f"a frame has at most {MAX_DATA} bytes of data")
    width = 8 if n == 0 or length.max() <= 8 else MAX_DATA
    data = np.zeros((n, width), np.uint8)
    known = min(width, given.shape[1])
    data[:, :known] = np.where(np.arange(known) < length[:, None], given[:, :known], 0)
    channel = np.zeros(n, np.uint16)
    if "BusChannel" in fields:
        of_frame = fields["BusChannel"].astype(np.int64)
        values, first, place = np.unique(of_frame, return_index=True, return_inverse=True)
        for value in values[np.argsort(first)].tolist():
            numbers.setdefault(value, len(numbers))
        channel = np.array([numbers[value] for value in values.tolist()], np.uint16)[place]
    return FrameBlock(
        can_id=(fields["ID"].astype(np.uint32) & np.uint32(0x1FFFFFFF)),
        is_extended=fields["IDE"].astype(bool) if "IDE" in fields else np.ones(n, bool),
        t_ns=t_ns.astype(np.int64),
        has_time=np.ones(n, bool),
        channel=channel,
        length=length,
        data=data,
        channels=tuple(map(str, numbers)) or ("",),
    )


def check_mf4_blocks(path: Path) -> None:
    """Raise ValueError if a block ##DZ is too large, by the lengths that it states."""
    with path.open("rb") as file:
        data = b""
        while chunk := file.read(MAX_OBJECT):
            data = data[-_DZ.size :] + chunk  # a block may begin in the chunk before
            place = -1
            while 0 <= (place := data.find(_DZ_MARK, place + 1)) <= len(data) - _DZ.size:
                largest = max(_DZ.unpack_from(data, place))
                if largest > MAX_OBJECT:
                    raise ValueError(
                        f"a compressed block has {largest} bytes, more than {MAX_OBJECT}"
                    )


class SqliteReader:
    """Reader of the table ``messages`` of an SQLite file, as python-can writes it.

    python-can's also runs a view or an expression in place of the table, which may never end.

    Args:
        path: of the file; it is not written to.
        summary: of the log.

    Raises:
        sqlite3.Error: the file is damaged, or a row has more than ``MAX_ROW`` bytes.
        ValueError: there is no such table, or a row of it is no frame.
    """

    def __init__(self, path: Path, summary: LogSummary) -> None:
        self._summary = summary
        self._connection = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)
        self._connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_ROW)

    def __enter__(self) -> SqliteReader:
        return self

    def __exit__(self, *exception: object) -> None:
        self._connection.close()

    def __iter__(self) -> Iterator[can.Message]:
        kinds = "SELECT type FROM sqlite_master WHERE name = 'messages'"
        if (kind := self._connection.execute(kinds).fetchone()) != ("table",):
            raise ValueError(f"it has {'a view' if kind else 'no table'} named messages")
        self._connection.set_authorizer(_reads_messages)
        for row in self._connection.execute("SELECT * FROM messages"):
            yield _message(row)


def _reads_messages(action: int, table: str | None, *_: Any) -> int:
    """Allow to read the table, and nothing that an expression of the schema may do."""
    allowed = action == sqlite3.SQLITE_SELECT or (
        action == sqlite3.SQLITE_READ and table == "messages"
    )
    return sqlite3.SQLITE_OK if allowed else sqlite3.SQLITE_DENY


def _message(row: tuple[Any, ...]) -> can.Message:
    if len(row) != 7:
        raise ValueError(f"a row of messages has 7 columns, got {len(row)}")
    timestamp, can_id, is_extended, is_remote, is_error, dlc, data = row
    if not isinstance(can_id, int) or not isinstance(data, bytes | None):
        raise ValueError("a row of messages has an integer as CAN ID and a blob as data")  # noqa: TRY004
    return can.Message(
        timestamp=timestamp,
        arbitration_id=can_id,
        is_extended_id=bool(is_extended),
        is_remote_frame=bool(is_remote),
        is_error_frame=bool(is_error),
        dlc=dlc,
        data=data,
    )
