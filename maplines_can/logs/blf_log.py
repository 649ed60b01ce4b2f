"""Readers of BLF logs whose memory is bounded, whatever the file claims."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any, BinaryIO, NamedTuple

from ..core import lib
from .frame_block import MAX_DATA, MAX_OBJECT, FrameBlock, LogCore, LogFrame
from .log_summary import LogSummary, Skipped
from .text_rows import check_frame

#: Signature, length, application (4), version of the format (4), length of the file, length when
#: it is unpacked, numbers of objects, and when the recording starts and stops, 8 fields each.
_FILE_HEADER = struct.Struct("<4sLBBBBBBBBQQLL8H8H")
#: Signature, length of the header, its version, length and kind of an object.
_OBJECT_HEADER = struct.Struct("<4sHHLL")
#: Compression method of a container, and its length when it is unpacked.
_CONTAINER = struct.Struct("<H6xL4x")
_NO_COMPRESSION, _ZLIB_DEFLATE = 0, 2
#: Flags of a CAN ID, of a classic frame, and of a stamp in units of 10 microseconds.
_EXTENDED, _REMOTE, _TEN_MICROSECONDS = 1 << 31, 0x80, 1

_SIGNATURE = b"LOBJ"
#: Most bytes between two objects. Writers align them to 4 or 8 bytes, or add ``size % 4``.
_MAX_PADDING = 7
#: Bytes of the whole header of an object, by its version.
_HEADER_SIZES = {1: 32, 2: 40}
#: Flags and time stamp of an object; both versions have them at the same places.
_STAMP = struct.Struct("<L4xQ")
#: Least time [ns] of a header that is not taken; one frame is up to 90 years later.
_MAX_START_NS = 2**62
#: Objects beside containers are read together, up to this many bytes.
_LOOSE_BYTES = 1 << 17
#: Kinds of objects.
_CAN_MESSAGE, _CAN_MESSAGE2, _CAN_FD_MESSAGE, _CAN_FD_MESSAGE_64 = 1, 86, 100, 101
_LOG_CONTAINER = 10
_CAN_ERROR, _CAN_ERROR_EXT, _CAN_FD_ERROR_64, _CAN_STATISTIC = 2, 73, 104, 4
_CAN_DRIVER_ERROR, _CAN_DRIVER_ERROR_EXT = 31, 74
#: Objects that are no frames, by kind; all others are events of another kind.
_SKIPPED = {
    _CAN_ERROR: Skipped.ERROR,
    _CAN_ERROR_EXT: Skipped.ERROR,
    _CAN_FD_ERROR_64: Skipped.ERROR,
    _CAN_STATISTIC: Skipped.STATE,
    _CAN_DRIVER_ERROR: Skipped.STATE,
    _CAN_DRIVER_ERROR_EXT: Skipped.STATE,
}
#: Fields before the data: channel, flags, DLC and CAN ID; a direction is in the lowest four bits
#: of the flags.
_CLASSIC, _DIRECTION, _REQUEST = struct.Struct("<HBBL"), 0x0F, 2
#: The same, with the number of bytes of data.
_FD = struct.Struct("<HBBL6xB5x")
#: Channel, number of bytes of data, CAN ID, flags, direction, place of the bytes behind the data.
_FD_64 = struct.Struct("<BxBxL4xL18xBB4x")
_REMOTE_64, _REQUEST_64, _ACKNOWLEDGED_64 = 0x10, 0x80, 0x40


class BLFParseError(Exception):
    """The file is no valid BLF file."""


class _Object(NamedTuple):
    """Object of a BLF file, and its place in the data: [begin, end)."""

    begin: int
    end: int
    version: int  #: of the header
    kind: int


class BlfReader:
    """BLF reader that refuses objects of more than ``MAX_OBJECT`` bytes.

    Objects stand in containers, where one may begin in a container and end in the next, or beside
    them. python-can reads those in containers only, takes a transmit request for a frame, and does
    not end at an object of length 0 (its issue 1584).

    Args:
        file: open for reading.
        summary: of the log.

    Raises:
        BLFParseError: the header or an object is too short, too long, or not known.
    """

    #: Bytes that the file lacks at its end, as far as that is known.
    missing = 0

    def __init__(self, file: BinaryIO, summary: LogSummary) -> None:
        head = file.read(_FILE_HEADER.size)
        if not head.startswith(b"LOGG"):
            raise BLFParseError("it does not begin with LOGG")
        fields = _FILE_HEADER.unpack(head)
        length = fields[1]
        if not len(head) <= length <= MAX_OBJECT:
            raise BLFParseError(f"its header has {length} bytes")
        file.read(length - len(head))
        self._file, self._summary, self._place = file, summary, 0
        self._compression_level, self._file_size = fields[7], fields[10]
        start = _seconds_of(fields[14:22])
        self._start_ns = round(start * 1000) * 10**6
        if abs(self._start_ns) >= _MAX_START_NS:
            raise BLFParseError(f"its recording begins in the year {fields[14]}")
        summary.times = "absolute" if start else "zero"

    def __enter__(self) -> BlfReader:
        return self

    def __exit__(self, *exception: object) -> None:
        self._file.close()

    def __iter__(self) -> Iterator[LogFrame | FrameBlock]:
        tail = b""
        for data, is_container in self._pieces():
            whole = tail + data if is_container else data
            yield from self._parse(whole)
            if is_container:
                tail = whole[self._place :]
                if len(tail) > MAX_OBJECT:
                    raise BLFParseError(f"an object in containers has more than {MAX_OBJECT} bytes")
        self.missing = max(self.missing, self._file_size - self._file.tell())
        if self.missing <= 0 and len(tail) > _MAX_PADDING:
            raise BLFParseError("the last object is not whole")

    def _pieces(self) -> Iterator[tuple[bytes, bool]]:
        """Yield what the containers have, and the objects beside them."""
        loose = bytearray()
        try:
            for kind, whole in self._outer_objects():
                if kind != _LOG_CONTAINER:
                    loose += whole
                if loose and (kind == _LOG_CONTAINER or len(loose) > _LOOSE_BYTES):
                    yield bytes(loose), False
                    loose.clear()
                if kind == _LOG_CONTAINER:
                    yield self._unpacked(whole[_OBJECT_HEADER.size :]), True
        except (BLFParseError, OSError, EOFError, zlib.error):  # the last three by gzip
            yield bytes(loose), False
            raise
        yield bytes(loose), False

    def _outer_objects(self) -> Iterator[tuple[int, bytes]]:
        """Yield the kinds and the bytes of the objects of the file; the last may be truncated."""
        head = _OBJECT_HEADER
        while start := self._file.read(head.size):
            padding = start.find(_SIGNATURE, 0, _MAX_PADDING + len(_SIGNATURE))
            if padding < 0:
                if len(start) <= _MAX_PADDING:
                    return
                raise BLFParseError("an object does not begin with LOBJ")
            start = start[padding:] + self._file.read(padding)
            if len(start) < head.size:
                self.missing = head.size - len(start)
                return
            _, _, _, size, kind = head.unpack(start)
            if not head.size <= size <= MAX_OBJECT:
                raise BLFParseError(
                    f"an object has {size} bytes, and must have {head.size} to {MAX_OBJECT}"
                )
            whole = start + self._file.read(size - head.size)
            self.missing = size - len(whole)
            yield kind, whole

    def _unpacked(self, container: bytes) -> bytes:
        """Return the content of a container, which may be truncated."""
        if len(container) < _CONTAINER.size:
            raise BLFParseError("a container is shorter than its own header")
        method, _ = _CONTAINER.unpack_from(container)
        data = container[_CONTAINER.size :]
        if method == _ZLIB_DEFLATE:
            try:
                data = zlib.decompressobj().decompress(data, MAX_OBJECT + 1)
            except zlib.error:
                # vblf states this method in every container; its file states that none is packed.
                if self._compression_level != 0:
                    raise
        elif method != _NO_COMPRESSION:
            raise BLFParseError(f"the compression method {method} of a container is unknown")
        if len(data) > MAX_OBJECT:
            raise BLFParseError(f"a container has more than {MAX_OBJECT} bytes when it is unpacked")
        return data

    def _parse(self, data: bytes) -> Iterator[LogFrame | FrameBlock]:
        """Yield the frames of whole objects; ``_place`` is behind the last of them."""
        self._place = 0
        while found := _next_object(data, self._place):
            self._place = found.end
            yield from self._frames(data, found)

    def _frames(self, data: bytes, found: _Object) -> Iterator[LogFrame]:
        """Yield the frame of an object, or count it."""
        read = _READERS.get(found.kind)
        if read is None:
            if found.kind == _LOG_CONTAINER:
                raise BLFParseError("a container is in another one")
            self._summary.skipped[_SKIPPED.get(found.kind, Skipped.OTHER)] += 1
            return
        header_size = _HEADER_SIZES.get(found.version)
        if header_size is None:
            raise BLFParseError(f"the version {found.version} of the header of a frame is unknown")
        body = data[found.begin + header_size : found.end]
        try:
            flags, ticks = _STAMP.unpack_from(data, found.begin + _OBJECT_HEADER.size)
            channel, can_id, payload, skipped = read(body, header_size)
        except struct.error:
            raise BLFParseError("a frame is shorter than its own fields") from None
        if skipped is not None:
            self._summary.skipped[skipped] += 1
            return
        t_ns = self._start_ns + ticks * (10_000 if flags == _TEN_MICROSECONDS else 1)
        is_extended, can_id = bool(can_id & _EXTENDED), can_id & 0x1FFFFFFF
        check_frame(can_id, payload, t_ns)
        yield LogFrame(can_id, payload, t_ns, is_extended, str(channel - 1), has_time=True)


class BlfRunReader(BlfReader):
    """BLF reader that yields runs of frames as blocks; C leaves what is unusual to `BlfReader`.

    Args:
        file: as for `BlfReader`.
        summary: of the log.
    """

    def __init__(self, file: BinaryIO, summary: LogSummary) -> None:
        super().__init__(file, summary)
        self._core = LogCore()

    def _parse(self, data: bytes) -> Iterator[Any]:
        core, self._place = self._core, 0
        while True:
            self._place = core.read(lib.maplines_parse_blf, data, self._place, self._start_ns)
            for kind, count in zip(Skipped, core.state.skipped, strict=True):
                if count:
                    self._summary.skipped[kind] += count
            if core.state.frames:
                yield core.block()
            if core.is_full:
                continue
            found = _next_object(data, self._place)
            if found is None:
                return
            self._place = found.end
            yield from self._frames(data, found)


def _seconds_of(systemtime: Sequence[int]) -> float:
    """Return a time as a Unix time [s]; 0 if it is none, such as one without a date."""
    year, month, _, day, hour, minute, second, milliseconds = systemtime
    with suppress(ValueError):
        date = datetime(year, month, day, hour, minute, second, 1000 * milliseconds, UTC)
        return date.timestamp()
    return 0


def _next_object(data: bytes, place: int) -> _Object | None:
    """Return the next object from a place on; None if the data end before its end.

    Raises:
        BLFParseError: there is none, or it is shorter than its own header.
    """
    head = _OBJECT_HEADER
    begin = data.find(_SIGNATURE, place, place + _MAX_PADDING + len(_SIGNATURE))
    if begin < 0:
        if len(data) - place < _MAX_PADDING + len(_SIGNATURE):
            return None
        raise BLFParseError("an object does not begin with LOBJ")
    if begin + head.size > len(data):
        return None
    _, _, version, size, kind = head.unpack_from(data, begin)
    if size < head.size:
        raise BLFParseError("an object is shorter than its own header")
    end = begin + size
    return _Object(begin, end, version, kind) if end <= len(data) else None


#: Channel, CAN ID, data, and what the object is if it is no frame.
_Fields = tuple[int, int, bytes, Skipped | None]


def _kind(*, is_request: bool, is_remote: bool) -> Skipped | None:
    """Return what an object is if it is no data frame on the bus."""
    if is_request:
        return Skipped.REQUEST
    return Skipped.REMOTE if is_remote else None


def _kind_of(flags: int) -> Skipped | None:
    return _kind(is_request=flags & _DIRECTION == _REQUEST, is_remote=bool(flags & _REMOTE))


def _bytes(body: bytes, begin: int, count: int) -> bytes:
    if begin + count > len(body):
        raise struct.error
    return body[begin : begin + count]


def _classic(body: bytes, _header_size: int) -> _Fields:
    channel, flags, dlc, can_id = _CLASSIC.unpack_from(body)
    skipped = _kind_of(flags)
    count = 0 if skipped else min(dlc, 8)
    return channel, can_id, _bytes(body, _CLASSIC.size, count), skipped


def _fd(body: bytes, _header_size: int) -> _Fields:
    channel, flags, _, can_id, count = _FD.unpack_from(body)
    skipped = _kind_of(flags)
    count = 0 if skipped else min(count, MAX_DATA)
    return channel, can_id, _bytes(body, _FD.size, count), skipped


def _fd_64(body: bytes, header_size: int) -> _Fields:
    """Read an object whose data may be shorter than it says: the others are zero."""
    channel, count, can_id, flags, direction, behind = _FD_64.unpack_from(body)
    end = behind - header_size if behind else len(body)
    if end < _FD_64.size:
        raise struct.error
    data = body[_FD_64.size : min(end, _FD_64.size + count)].ljust(count, b"\0")
    skipped = _kind(
        is_request=direction == _REQUEST or flags & (_REQUEST_64 | _ACKNOWLEDGED_64) == _REQUEST_64,
        is_remote=bool(flags & _REMOTE_64),
    )
    return channel, can_id, data, skipped


_READERS = {
    _CAN_MESSAGE: _classic,
    _CAN_MESSAGE2: _classic,
    _CAN_FD_MESSAGE: _fd,
    _CAN_FD_MESSAGE_64: _fd_64,
}
