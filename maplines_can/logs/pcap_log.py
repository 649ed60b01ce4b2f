"""Reader of pcap and pcapng: captures of Wireshark, dumpcap and tcpdump on CAN interfaces.

The files are described in draft-ietf-opsawg-pcap and -pcapng, the packets in the list of link types
of tcpdump.org (LINKTYPE_CAN_SOCKETCAN, LINUX_SLL, LINUX_SLL2). The CAN ID of SocketCAN is
big-endian there, but in Linux cooked packets it has the byte order of the file (libpcap,
pcap-util.c). libpcap and its bindings are no parsers for this: they need the library installed, and
give packet by packet to Python, as dpkt and python-pcapng do.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from typing import NamedTuple

from ..core import lib
from ..core.memory import structure
from .frame_block import MAX_DATA, MAX_OBJECT, FrameBlock, LogCore, LogFrame
from .log_summary import LogSummary, Skipped
from .text_rows import check_frame

#: First bytes of pcap: their byte order, and the units of a time stamp in a second.
_MAGICS = {
    b"\xd4\xc3\xb2\xa1": ("<", 10**6),
    b"\xa1\xb2\xc3\xd4": (">", 10**6),
    b"\x4d\x3c\xb2\xa1": ("<", 10**9),
    b"\xa1\xb2\x3c\x4d": (">", 10**9),
}
#: Type of the first block of pcapng, the same in both orders, and the order of a section.
_SECTION = b"\n\r\r\n"
_ORDERS = {b"\x4d\x3c\x2b\x1a": "<", b"\x1a\x2b\x3c\x4d": ">"}
#: Bytes of the header of a file of pcap, and of a record.
_FILE_HEADER, _RECORD_HEADER = 24, 16
#: Bytes that a block of pcapng has at least: type, length, the latter again.
_BLOCK = 12
_INTERFACE, _OLD_PACKET, _SIMPLE_PACKET, _ENHANCED_PACKET = 1, 2, 3, 6
#: Options of an interface: name, resolution and offset of its time stamps.
_NAME, _RESOLUTION, _OFFSET = 2, 9, 14
#: Most interfaces of a section, as `maplines_capture_t` has, and characters of their names there.
MAX_INTERFACES, _MAX_NAME = 256, 64
#: Greatest offset of the time stamps for C [ns].
_MAX_OFFSET_NS = 2**62

_LINUX_SLL, _CAN_SOCKETCAN, _LINUX_SLL2 = 113, 227, 276
_LINK_TYPES = (_LINUX_SLL, _CAN_SOCKETCAN, _LINUX_SLL2)
#: Bytes of the header of a cooked packet, and the place of its protocol.
_COOKED = {_LINUX_SLL: (16, 14), _LINUX_SLL2: (20, 0)}
_CAN, _CAN_FD = 0x000C, 0x000D
_EXTENDED, _REMOTE, _ERROR = 1 << 31, 1 << 30, 1 << 29
_FD_FLAG, _XL_FLAG = 0x04, 0x80
#: Bytes of the header of a frame, and most bytes of data of classic CAN.
_CAN_HEADER, _CLASSIC_DATA = 8, 8


class PcapError(Exception):
    """The file is no capture, or where its next record begins is not known."""


def is_capture(head: bytes) -> bool:
    """Return whether a file begins as pcap or pcapng; 12 bytes tell."""
    return head[:4] in _MAGICS or (head[:4] == _SECTION and head[8:12] in _ORDERS)


class _Interface(NamedTuple):
    """Interface of a capture."""

    link_type: int
    name: str
    units: int  #: of a time stamp, in a second
    offset_ns: int  #: of the time stamps
    snap_length: int  #: most bytes of a packet that are kept; 0 for all


class PcapReader:
    """Iterator over the data frames of a capture, which may be a pipe.

    The channel is the name of the interface, or its number if it has none; of Linux cooked packets
    of version 2 the number that the system gave it, and of pcap there is none. A packet that is
    damaged, or that the snap length has cut, costs only itself.

    Args:
        file: open for reading, with ``read1``.
        summary: of the log.
        runs: whether to yield runs of frames as blocks.
        is_packed: whether the file is unpacked while it is read.

    Raises:
        PcapError: it is no capture, a packet is longer than ``MAX_OBJECT``, or a block has no
            valid length.
    """

    #: Bytes that the file lacks at its end.
    missing = 0

    def __init__(
        self, file: io.BufferedReader, summary: LogSummary, *, runs: bool, is_packed: bool
    ) -> None:
        self._file, self._summary = file, summary
        # An error of gzip costs what has been unpacked in one reading.
        self._chunk = io.DEFAULT_BUFFER_SIZE if is_packed else 1 << 20
        self._buffer, self._place = b"", 0
        self._core = LogCore() if runs else None
        self._capture = structure("maplines_capture_t", {})
        self._interfaces: list[_Interface] = []
        self._foreign: set[int] = set()  # link types that are not of CAN
        self._has_can = False
        self._order = "<"
        self._is_ng = False
        #: Number of damaged packets, and the reason of the first one.
        self.damage: tuple[int, str] = 0, ""
        summary.times = "absolute"

    def __iter__(self) -> Iterator[LogFrame | FrameBlock]:
        self._read_head()
        while True:
            if self._core is not None:
                yield from self._runs(self._core)
            read = self._buffer
            size = self._next_size()
            if not size:
                break
            if self._core is not None and self._buffer is not read:
                continue  # what had not been read yet is ordinary, perhaps
            try:
                found = (self._block if self._is_ng else self._record)(size)
            except ValueError as error:
                found, (count, first) = None, self.damage
                self.damage = count + 1, first or str(error)
            self._place += size
            if isinstance(found, LogFrame):
                yield found
            elif found is not None:
                self._summary.skipped[found] += 1
        if self._foreign and not self._has_can:
            types = ", ".join(map(str, sorted(self._foreign)))
            self._summary.notices.append(f"it has packets of link type {types}, and none of CAN")

    def _runs(self, core: LogCore) -> Iterator[FrameBlock]:
        """Yield the ordinary packets that have been read, before one of another form."""
        while True:
            self._place = core.read(
                lib.maplines_parse_pcap, self._buffer, self._place, self._capture
            )
            for kind, count in zip(Skipped, core.state.skipped, strict=True):
                if count:
                    self._summary.skipped[kind] += count
            if core.state.frames:
                yield core.block()
            if not core.is_full:
                return

    def _has(self, count: int) -> bool:
        """Return whether the file has so many more bytes; they are then in the buffer."""
        lack = count - (len(self._buffer) - self._place)
        if lack <= 0:
            return True
        parts = [self._buffer[self._place :]]
        while lack > 0 and (data := self._file.read1(self._chunk)):
            parts.append(data)
            lack -= len(data)
        self._buffer, self._place = b"".join(parts), 0
        return lack <= 0

    def _read_head(self) -> None:
        """Read the header of the file."""
        self._has(_FILE_HEADER)
        magic = self._buffer[:4]
        if not is_capture(self._buffer):
            raise PcapError("it begins neither as pcap nor as pcapng")
        self._is_ng = magic == _SECTION
        self._capture.is_ng = self._is_ng
        self._summary.format = ".pcapng" if self._is_ng else ".pcap"
        if self._is_ng:
            return
        if not self._has(_FILE_HEADER):
            raise PcapError("its header is cut")
        self._order, units = _MAGICS[magic]
        snap_length, link_type = struct.unpack_from(self._order + "LL", self._buffer, 16)
        link_type &= 0x03FFFFFF  # the others are the length of a checksum, and reserved
        if link_type not in _LINK_TYPES:
            known = ", ".join(map(str, _LINK_TYPES))
            raise PcapError(f"its link type is {link_type}, and those of CAN are {known}")
        self._capture.is_big_endian = self._order == ">"
        self._add_interface(_Interface(link_type, "", units, 0, snap_length))
        self._place = _FILE_HEADER

    def _next_size(self) -> int:
        """Return the number of bytes of the next record, which is then read; 0 at the end."""
        head = _BLOCK if self._is_ng else _RECORD_HEADER
        if not self._has(head):
            left = len(self._buffer) - self._place
            self.missing = head - left if left else 0
            return 0
        size = self._block_size() if self._is_ng else head + self._fields("L", 8)[0]
        if size > MAX_OBJECT:
            raise PcapError(f"a record has {size} bytes, more than {MAX_OBJECT}")
        if not self._has(size):
            self.missing = size - (len(self._buffer) - self._place)
            return 0
        return size

    def _block_size(self) -> int:
        if self._buffer.startswith(_SECTION, self._place):
            order = self._buffer[self._place + 8 : self._place + 12]
            if order not in _ORDERS:
                raise PcapError(f"a section has no byte order, but {order.hex()}")
            self._order = _ORDERS[order]
            self._capture.is_big_endian = self._order == ">"
        size: int = self._fields("L", 4)[0]
        if size < _BLOCK or size % 4:
            raise PcapError(f"a block has {size} bytes")
        return size

    def _fields(self, form: str, place: int) -> tuple[int, ...]:
        """Return numbers of a record, from a place on.

        Raises:
            ValueError: the record ends before them.
        """
        try:
            return struct.unpack_from(self._order + form, self._buffer, self._place + place)
        except struct.error:
            raise ValueError("a record is shorter than its own fields") from None

    def _record(self, size: int) -> LogFrame | Skipped:
        """Return the frame of a record of pcap, or what else it is."""
        seconds, fraction, _, original = self._fields("LLLL", 0)
        interface = self._interfaces[0]
        t_ns = seconds * 10**9 + fraction * 10**9 // interface.units
        return self._frame(interface, _RECORD_HEADER, size - _RECORD_HEADER, original, t_ns)

    def _block(self, size: int) -> LogFrame | Skipped | None:
        """Return the frame of a block of pcapng, or what else it is; None if it is no packet."""
        if self._fields("L", size - 4)[0] != size:
            raise PcapError("the two lengths of a block differ")
        if self._buffer.startswith(_SECTION, self._place):
            self._begin_section(size)
            return None
        (kind,) = self._fields("L", 0)
        if kind == _INTERFACE:
            self._add_interface(self._interface(size))
        if kind == _SIMPLE_PACKET:
            if size < 16:
                raise ValueError("a packet is shorter than its own fields")
            interface, (original,) = self._interface_of(0), self._fields("L", 8)
            captured = min(original, interface.snap_length or original, size - 16)
            return self._frame(interface, 12, captured, original, None)
        if kind not in (_ENHANCED_PACKET, _OLD_PACKET):
            return None
        if size < 32:
            raise ValueError("a packet is shorter than its own fields")
        form = "LLLLL" if kind == _ENHANCED_PACKET else "HxxLLLL"
        number, high, low, captured, original = self._fields(form, 8)
        interface = self._interface_of(number)
        if captured > size - 32:
            raise ValueError(f"a packet has {captured} bytes, and a block for {size - 32}")
        ticks = high << 32 | low
        t_ns = ticks * 10**9 // interface.units + interface.offset_ns
        return self._frame(interface, 28, captured, original, t_ns)

    def _begin_section(self, size: int) -> None:
        if size < 28:
            raise PcapError("a section is shorter than its own header")
        if (version := self._fields("H", 12)[0]) != 1:
            raise PcapError(f"the version {version} of pcapng is unknown")
        self._interfaces = []
        self._capture.count = 0

    def _interface(self, size: int) -> _Interface:
        """Return the interface that a block describes."""
        if size < 20:
            raise PcapError("an interface is shorter than its own fields")
        link_type, snap_length = self._fields("HxxL", 8)
        name, units, offset = str(len(self._interfaces)), 10**6, 0
        place, end = self._place + 16, self._place + size - 4
        while place + 4 <= end:
            code, length = struct.unpack_from(self._order + "HH", self._buffer, place)
            value = self._buffer[place + 4 : min(place + 4 + length, end)]
            place += 4 + length + -length % 4
            if code == 0 or place > end:
                break
            if code == _NAME:
                name = value.decode(errors="replace").partition("\0")[0] or name
            elif code == _RESOLUTION and length == 1:
                units = 2 ** (value[0] & 0x7F) if value[0] & 0x80 else 10 ** value[0]
            elif code == _OFFSET and length == 8:
                (offset,) = struct.unpack(self._order + "q", value)
        return _Interface(link_type, name, units, offset * 10**9, snap_length)

    def _add_interface(self, interface: _Interface) -> None:
        number = len(self._interfaces)
        if number == MAX_INTERFACES:
            raise PcapError(f"it has more than {MAX_INTERFACES} interfaces")
        self._interfaces.append(interface)
        if interface.link_type in _LINK_TYPES:
            self._has_can = True
        else:
            self._foreign.add(interface.link_type)
        name, tick_ns = interface.name.encode(), 10**9 // interface.units
        is_plain = tick_ns * interface.units == 10**9 and abs(interface.offset_ns) < _MAX_OFFSET_NS
        given = self._capture.interfaces[number]
        given.link_type, given.tick_ns = interface.link_type, tick_ns if is_plain else 0
        given.offset_ns = interface.offset_ns if is_plain else 0
        given.name, given.name_length = name[:_MAX_NAME], len(name)
        self._capture.count = number + 1

    def _interface_of(self, number: int) -> _Interface:
        if number >= len(self._interfaces):
            raise ValueError(f"the interface {number} of a packet is not described")
        return self._interfaces[number]

    def _frame(
        self, interface: _Interface, place: int, size: int, original: int, t_ns: int | None
    ) -> LogFrame | Skipped:
        """Return the frame of a packet, or what else it is.

        Args:
            interface: of the packet.
            place: in the record.
            size: of what was captured [byte].
            original: length on the bus [byte].
            t_ns: time; None if it has none.

        Raises:
            ValueError: it is damaged, or cut.
        """
        link_type, begin = interface.link_type, self._place + place
        if link_type not in _LINK_TYPES:
            return Skipped.OTHER
        packet = self._buffer[begin : begin + size]
        header, at = _COOKED.get(link_type, (0, 0))
        if min(size, original) < header:
            raise ValueError(_cut(size, original))
        if header and int.from_bytes(packet[at : at + 2]) not in (_CAN, _CAN_FD):
            return Skipped.OTHER
        if size < header + _CAN_HEADER:
            raise ValueError(_cut(size, original))
        order = ">" if link_type == _CAN_SOCKETCAN else self._order
        found = _socketcan(packet[header:], original - header, order)
        if isinstance(found, Skipped):
            return found
        flagged_id, data = found
        if data is None:
            raise ValueError(_cut(size, original))
        can_id = flagged_id & 0x1FFFFFFF
        check_frame(can_id, data, t_ns or 0)
        is_numbered = link_type == _LINUX_SLL2
        channel = str(int.from_bytes(packet[4:8])) if is_numbered else interface.name
        is_extended = bool(flagged_id & _EXTENDED)
        return LogFrame(can_id, data, t_ns or 0, is_extended, channel, has_time=t_ns is not None)


def _socketcan(packet: bytes, original: int, order: str) -> tuple[int, bytes | None] | Skipped:
    """Return the CAN ID with its flags, and the data, which are None if they are cut.

    Raises:
        ValueError: the frame is longer than its format allows.
    """
    flagged_id, length, flags = struct.unpack_from(f"{order}LBB", packet)
    if length & _XL_FLAG:
        return Skipped.OTHER
    if flagged_id & (_ERROR | _REMOTE):
        return Skipped.ERROR if flagged_id & _ERROR else Skipped.REMOTE
    # Older writers leave the flag of CAN FD 0; then the size tells the frame.
    is_fd = flags & _FD_FLAG or original > _CAN_HEADER + _CLASSIC_DATA
    if length > (MAX_DATA if is_fd else _CLASSIC_DATA):
        raise ValueError(f"a frame of {'CAN FD' if is_fd else 'classic CAN'} has {length} bytes")
    data = packet[_CAN_HEADER : _CAN_HEADER + length]
    return flagged_id, data if len(data) == length else None


def _cut(size: int, original: int) -> str:
    """Return why a packet is not whole."""
    if size < original:
        return f"{size} of {original} bytes of a packet are there: its snap length has cut it"
    return f"a packet of {size} bytes is shorter than its own frame"
