"""Writer of pcap and pcapng from their descriptions: independent of the reader."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from maplines_can.bus import LogFrame, Skipped

SOCKETCAN, COOKED, COOKED2 = 227, 113, 276
EXTENDED, REMOTE, ERROR, FDF = 1 << 31, 1 << 30, 1 << 29, 4


class Packet(NamedTuple):
    """Packet of a capture: bytes at a time, of an interface by its index."""

    data: bytes
    t_ns: int
    interface: int = 0
    original: int | None = None  #: length on the bus, if it was cut


class Style(NamedTuple):
    """How a capture is written."""

    is_ng: bool = False
    order: str = "<"
    link_type: int = SOCKETCAN
    has_fd_flag: bool = True
    is_padded: bool = True
    units: int = 10**6  #: of a time stamp, in a second
    block: int = 6  #: of a packet of pcapng: 6 enhanced, 2 the old one, 3 simple


def socketcan(flagged_id: int, data: bytes, style: Style, *, is_fd: bool | None = None) -> bytes:
    """Return a frame as SocketCAN has it, before the header of another link type."""
    is_fd = len(data) > 8 if is_fd is None else is_fd
    flags = FDF * (is_fd and style.has_fd_flag)
    order = ">" if style.link_type == SOCKETCAN else style.order
    head = struct.pack(f"{order}LBBxx", flagged_id, len(data), flags)
    return head + (data.ljust(64 if is_fd else 8, b"\0") if style.is_padded else data)


def canxl(style: Style) -> bytes:
    """Return a frame of CAN XL: priority, flags, type, length, acceptance field and data."""
    order = ">" if style.link_type == SOCKETCAN else style.order
    return struct.pack(f"{order}LBBHL", 0x123, 0x80, 1, 100, 0) + bytes(100)


def cooked(packet: bytes, protocol: int, style: Style, index: int = 3) -> bytes:
    """Return a packet with the header of Linux cooked packets, if that is the link type."""
    if style.link_type == COOKED:
        return struct.pack(">HHH8sH", 1, 280, 0, b"", protocol) + packet
    if style.link_type == COOKED2:
        return struct.pack(">HHLHBB8s", protocol, 0, index, 280, 1, 0, b"") + packet
    return packet


def packet_of(frame: LogFrame, style: Style, interface: int = 0) -> Packet:
    """Return the packet of a data frame; its channel is the index of a cooked one."""
    inner = socketcan(frame.can_id | EXTENDED * frame.is_extended, frame.data, style)
    protocol = 0x0D if len(frame.data) > 8 else 0x0C
    index = int(frame.channel) if style.link_type == COOKED2 else 0
    return Packet(cooked(inner, protocol, style, index), frame.t_ns, interface)


def others(style: Style) -> list[tuple[Packet, Skipped]]:
    """Return packets that are no data frames, and what they are counted as."""
    found = [
        (cooked(socketcan(ERROR | 4, bytes(8), style), 0x0C, style), Skipped.ERROR),
        (cooked(socketcan(REMOTE | 0x123, b"", style), 0x0C, style), Skipped.REMOTE),
        (cooked(canxl(style), 0x0E, style), Skipped.OTHER),
    ]
    if style.link_type != SOCKETCAN:
        found.append((cooked(b"\x45" + bytes(40), 0x0800, style), Skipped.OTHER))
    return [(Packet(data, 0), kind) for data, kind in found]


def pcap(packets: Iterable[Packet], style: Style) -> bytes:
    """Return a file of pcap."""
    order, units = style.order, style.units
    magic = {10**6: 0xA1B2C3D4, 10**9: 0xA1B23C4D}[units]
    parts = [struct.pack(f"{order}LHHlLLL", magic, 2, 4, 0, 0, 262_144, style.link_type)]
    for one in packets:
        seconds, rest = divmod(one.t_ns, 10**9)
        original = len(one.data) if one.original is None else one.original
        fraction = rest * units // 10**9
        parts.append(struct.pack(f"{order}LLLL", seconds, fraction, len(one.data), original))
        parts.append(one.data)
    return b"".join(parts)


def block(kind: int, body: bytes, order: str = "<") -> bytes:
    """Return a block of pcapng."""
    body += bytes(-len(body) % 4)
    length = struct.pack(f"{order}L", 12 + len(body))
    return struct.pack(f"{order}L", kind) + length + body + length


def section(order: str = "<", version: int = 1) -> bytes:
    """Return the head of a section."""
    return block(0x0A0D0D0A, struct.pack(f"{order}LHHq", 0x1A2B3C4D, version, 0, -1), order)


def interface(
    style: Style, name: str = "", offset: int | None = None, resolution: int | None = None
) -> bytes:
    """Return the description of an interface."""
    order = style.order
    if resolution is None and style.units != 10**6:
        resolution = len(str(style.units)) - 1
    options = [(1, b"a comment")]
    options += [(2, name.encode())] * bool(name)
    options += [] if resolution is None else [(9, bytes([resolution]))]
    options += [] if offset is None else [(14, struct.pack(f"{order}q", offset))]
    body = struct.pack(f"{order}HxxL", style.link_type, 262_144)
    for code, value in [*options, (0, b"")]:
        body += struct.pack(f"{order}HH", code, len(value)) + value + bytes(-len(value) % 4)
    return block(1, body, order)


def packet_block(one: Packet, style: Style) -> bytes:
    """Return the block of a packet."""
    order, ticks = style.order, one.t_ns * style.units // 10**9
    original = len(one.data) if one.original is None else one.original
    lengths = struct.pack(f"{order}LLLL", ticks >> 32, ticks % 2**32, len(one.data), original)
    head = {
        6: struct.pack(f"{order}L", one.interface) + lengths,
        2: struct.pack(f"{order}HH", one.interface, 0) + lengths,
        3: struct.pack(f"{order}L", original),
    }[style.block]
    return block(style.block, head + one.data, order)


def pcapng(packets: Iterable[Packet], style: Style, names: Sequence[str] = ("",)) -> bytes:
    """Return a file of pcapng of one section, with blocks that no reader needs."""
    parts = [section(style.order), *(interface(style, name) for name in names)]
    for number, one in enumerate(packets):
        parts.append(packet_block(one, style))
        if number % 3 == 1:
            parts.append(block(5 + 0x0BAD * (number % 2), bytes(12), style.order))
    return b"".join(parts)


def capture(packets: Iterable[Packet], style: Style, names: Sequence[str] = ("",)) -> bytes:
    """Return a file of the format of a style."""
    return pcapng(packets, style, names) if style.is_ng else pcap(packets, style)
