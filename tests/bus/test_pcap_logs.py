"""Captures in pcap and pcapng: what is written is read, in both byte orders, of any link type."""

import gzip
import io
import struct
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.captures import (
    COOKED,
    COOKED2,
    FDF,
    SOCKETCAN,
    Packet,
    Style,
    block,
    capture,
    interface,
    others,
    packet_block,
    packet_of,
    pcap,
    section,
    socketcan,
)
from support.log_files import frames
from support.recordings import frames_of

from maplines_can.bus import LogFrame, Skipped, read_log
from maplines_can.recordings.blocks import read_blocks
from maplines_can.values.errors import LogError

LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
FRAMES = [
    LogFrame(0x123, b"\x10\x20\x30", 1_700_000_000_000_001_000, False, "can0", True),
    LogFrame(0x1ABCDE0, bytes(range(64)), 1_700_000_001_000_000_000, True, "can0", True),
    LogFrame(0x7, b"", 1_700_000_001_000_000_000, False, "can0", True),
]


def read(source: Any, **options: Any) -> tuple[list[LogFrame], str, Counter[Skipped], list[str]]:
    """Return the frames, the error, what is counted and the notices: all the same in blocks."""
    answers = []
    for log in (read_log(source()), read_blocks(source(), **options)):
        found: list[LogFrame] = []
        error = ""
        try:
            for one in log:
                found += [one] if isinstance(one, LogFrame) else frames_of(one)
        except LogError as raised:
            error = str(raised)
        answers.append((found, error, log.summary.skipped, log.summary.notices))
    assert answers[0] == answers[1]
    return answers[0]


def read_bytes(content: bytes, **options: Any) -> Any:
    return read(lambda: io.BufferedReader(io.BytesIO(content)), **options)


STYLES = st.builds(
    Style,
    is_ng=st.booleans(),
    order=st.sampled_from("<>"),
    link_type=st.sampled_from([SOCKETCAN, COOKED, COOKED2]),
    has_fd_flag=st.booleans(),
    is_padded=st.booleans(),
    units=st.sampled_from([10**6, 10**9]),
    block=st.sampled_from([6, 6, 2]),
)


@given(style=STYLES, data=st.data())
def test_what_is_written_is_read(style: Style, data: st.DataObject) -> None:
    """Among error and remote frames, frames of CAN XL and packets of other protocols."""
    drawn = data.draw(frames(10**9 // style.units, "37", lengths=LENGTHS, start=1.7e9))
    rest = others(style)
    packets, counts = [], Counter[Skipped]()
    for one in drawn:
        for packet, kind in data.draw(st.lists(st.sampled_from(rest), max_size=2)):
            packets.append(packet._replace(t_ns=one.t_ns))
            counts[kind] += 1
        packets.append(packet_of(one, style))
    content = capture(packets, style, ["can0"])
    found, error, skipped, notices = read_bytes(content, block_frames=3)
    if style.link_type != COOKED2:  # the others have the channel of their interface
        channel = "can0" if style.is_ng else ""
        drawn = [one._replace(channel=channel) for one in drawn]
    assert (found, error, skipped, notices) == (drawn, "", counts, [])


@pytest.mark.parametrize("is_ng", [False, True])
@pytest.mark.parametrize("suffix", [".pcap", ".pcapng", "", ".log", ".pcap.gz", ".log.gz"])
def test_the_content_tells_the_format(tmp_path: Path, suffix: str, is_ng: bool) -> None:
    """pcap is often named pcapng, and so on; a compressed one is read, too."""
    style = Style(is_ng=is_ng)
    content = capture([packet_of(one, style) for one in FRAMES], style, ["can0"])
    path = tmp_path / f"a{suffix}"
    path.write_bytes(gzip.compress(content) if suffix.endswith(".gz") else content)
    log = read_log(path)
    assert [f._replace(channel="can0") for f in log] == FRAMES
    assert log.summary.format == (".pcapng" if is_ng else ".pcap")
    assert log.summary.times == "absolute"


def test_interfaces_are_channels_by_their_names() -> None:
    """Each with its own resolution and offset; without a name the number, also in a new section."""
    style, big = Style(is_ng=True), Style(is_ng=True, order=">")
    names = "can0", "vcan", "", "x" * 100
    described = [
        interface(style, names[0]),
        interface(style, names[1], offset=-1_000_000_000, resolution=9),
        interface(style, names[2], resolution=0x80 | 10),  # 1/1024 s
        interface(style, names[3], resolution=10),
    ]
    units = [10**6, 10**9, 2**10, 10**10]
    parts = [section(), *described]
    for k in range(4):
        one = packet_of(FRAMES[0], style, k)
        shifted = one._replace(t_ns=one.t_ns + 10**18 * (k == 1))
        parts.append(packet_block(shifted, style._replace(units=units[k])))
    parts += [section(">"), interface(big, "can9"), packet_block(packet_of(FRAMES[2], big), big)]
    found, error, *_ = read_bytes(b"".join(parts))
    assert error == ""
    assert [f.channel for f in found] == ["can0", "vcan", "2", "x" * 100, "can9"]
    t_ns = FRAMES[0].t_ns
    rough = t_ns * 1024 // 10**9 * 10**9 // 1024
    assert [f.t_ns for f in found] == [t_ns, t_ns, rough, t_ns, FRAMES[2].t_ns]


def test_simple_packets_have_no_times() -> None:
    style = Style(is_ng=True, block=3)
    found, error, *_ = read_bytes(capture([packet_of(one, style) for one in FRAMES], style))
    assert error == ""
    assert found == [one._replace(t_ns=0, has_time=False, channel="0") for one in FRAMES]


@pytest.mark.parametrize("is_ng", [False, True])
@pytest.mark.parametrize("link_type", [SOCKETCAN, COOKED, COOKED2])
def test_every_cut_of_a_capture_is_read_up_to_the_cut(link_type: int, is_ng: bool) -> None:
    """Also of one that is compressed; missing bytes are said, but at the end of a record."""
    style = Style(is_ng=is_ng, link_type=link_type)
    packets = [packet_of(one._replace(channel="3"), style) for one in FRAMES]
    content = capture(packets, style)
    ends = {len(capture(packets[:k], style)) for k in range(4)}
    if is_ng:  # the blocks between them
        ends |= {len(section()), *(end - 24 for end in ends)}
    whole, *_ = read_bytes(content)
    for end in range(12, len(content) + 1):
        found, error, *_ = read_bytes(content[:end])
        assert found == whole[: len(found)]
        assert bool(error) or end in ends
        assert len(found) >= sum(end >= one for one in sorted(ends)[1:]) * (not is_ng)
    packed = gzip.compress(content)
    for end in range(20, len(packed)):
        found, error, *_ = read_bytes(packed[:end])
        assert found == whole[: len(found)]
        assert error
    assert len(whole) == 3


#: Packets that are damaged, and why.
SOCKETCAN_HEAD = struct.Struct(">LBBxx")
DAMAGED = {
    "shorter than a head": (Packet(bytes(7), 0), "shorter than its own frame"),
    "cut by the snap length": (
        Packet(socketcan(1, bytes(8), Style())[:12], 0, original=16),
        "12 of 16 bytes of a packet are there: its snap length has cut it",
    ),
    "head that is cut": (Packet(bytes(3), 0, original=16), "3 of 16 bytes"),
    "classic, of 9 bytes": (
        Packet(SOCKETCAN_HEAD.pack(1, 9, 0) + bytes(8), 0),
        "a frame of classic CAN has 9 bytes",
    ),
    "FD, of 65 bytes": (
        Packet(SOCKETCAN_HEAD.pack(1, 65, FDF) + bytes(65), 0),
        "a frame of CAN FD has 65 bytes",
    ),
    "fewer bytes than it says": (
        Packet(SOCKETCAN_HEAD.pack(1, 20, FDF) + bytes(12), 0),
        "a packet of 20 bytes is shorter",
    ),
}


@pytest.mark.parametrize("is_ng", [False, True])
@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_packet_costs_only_itself(name: str, is_ng: bool) -> None:
    packet, why = DAMAGED[name]
    style = Style(is_ng=is_ng)
    good = [packet_of(one, style) for one in FRAMES]
    found, error, *_ = read_bytes(capture([good[0], packet, *good[1:], packet], style, ["can0"]))
    assert [f._replace(channel="can0") for f in found] == FRAMES
    assert error.startswith("stream: 2 of 5 records are damaged (the first: ")
    assert why in error


NG = Style(is_ng=True)
PACKET = packet_block(packet_of(FRAMES[0], NG), NG)
HEAD = section() + interface(NG)
#: Blocks that are wrong after a whole packet, and the error; the rest is not read.
WRONG_BLOCKS = {
    "two lengths": (block(6, bytes(40))[:-4] + bytes(4), "the two lengths of a block differ"),
    "no length": (struct.pack("<LLL", 6, 0, 0), "a block has 0 bytes"),
    "odd length": (struct.pack("<LLL", 6, 33, 33), "a block has 33 bytes"),
    "great length": (struct.pack("<LLL", 6, 1 << 30, 0), "a record has 1073741824 bytes, more th"),
    "no order": (block(0x0A0D0D0A, bytes(16)), "a section has no byte order, but 00000000"),
    "version": (section(version=2), "the version 2 of pcapng is unknown"),
    "short section": (block(0x0A0D0D0A, section()[8:20]), "shorter than its own header"),
    "short interface": (block(1, bytes(4)), "an interface is shorter"),
    "many interfaces": (interface(NG) * 256, "it has more than 256 interfaces"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG_BLOCKS)
def test_a_wrong_block_ends_the_capture(name: str) -> None:
    wrong, why = WRONG_BLOCKS[name]
    found, error, *_ = read_bytes(HEAD + PACKET + wrong + PACKET)
    assert [f.can_id for f in found] == [0x123]
    assert "damaged after 1 good records" in error
    assert why in error


#: Blocks that are wrong, of which only themselves are lost.
LOST_BLOCKS = {
    "interface that is not there": packet_block(packet_of(FRAMES[0], NG, 7), NG),
    "shorter than its fields": block(6, bytes(8)),
    "simple, shorter than its fields": block(3, b""),
    "more than there is": block(6, struct.pack("<LLLLL", 0, 0, 0, 17, 17) + bytes(16)),
    "time beyond 64 bits": block(
        6, struct.pack("<LLLLL", 0, 2**32 - 1, 0, 16, 16) + socketcan(1, b"", NG)
    ),
}


@pytest.mark.parametrize("name", LOST_BLOCKS)
def test_a_lost_block_costs_only_itself(name: str) -> None:
    found, error, *_ = read_bytes(HEAD + PACKET + LOST_BLOCKS[name] + PACKET)
    assert [f.can_id for f in found] == [0x123] * 2
    assert "1 of 3 records are damaged" in error


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (pcap([], Style(link_type=1)), "its link type is 1, and those of CAN are 113, 227, 276"),
        (pcap([], Style())[:20], "its header is cut"),
        (pcap([], Style()) + struct.pack("<LLLL", 0, 0, 1 << 30, 1), "a record has 1073741840 byt"),
    ],
)
def test_a_file_without_captures_of_can_is_one_clear_error(content: bytes, why: str) -> None:
    found, error, *_ = read_bytes(content)
    assert found == []
    assert error.startswith("stream: not a valid .pcap file (")
    assert why in error


def test_a_file_that_is_said_to_be_a_capture(tmp_path: Path) -> None:
    path = tmp_path / "a.pcapng"
    path.write_text("(1.5) can0 123#00\n")
    with pytest.raises(LogError, match="begins neither as pcap nor as pcapng"):
        list(read_log(path))
    with pytest.raises(LogError, match="has one kind of time stamps"):
        read_log(path, times="zero")


def test_packets_of_other_link_types_are_counted_and_said() -> None:
    ethernet = Style(is_ng=True, link_type=1)
    packet = packet_block(Packet(bytes(60), 0), ethernet)
    *_, skipped, notices = read_bytes(section() + interface(ethernet) + packet * 3)
    assert skipped == Counter({Skipped.OTHER: 3})
    assert notices == ["it has packets of link type 1, and none of CAN"]
    *_, skipped, notices = read_bytes(section() + interface(ethernet) + interface(NG) + packet)
    assert skipped == Counter({Skipped.OTHER: 1})
    assert notices == []


@given(
    st.sampled_from([False, True]), st.sampled_from([SOCKETCAN, COOKED2]),
    st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), max_size=6),
)  # fmt: skip
def test_changed_bytes_raise_log_error_at_worst(
    is_ng: bool, link_type: int, changes: list[tuple[int, int]]
) -> None:
    """C and Python read the same of them."""
    style = Style(is_ng=is_ng, link_type=link_type)
    packets = [packet_of(one._replace(channel="3"), style) for one in FRAMES * 3]
    content = bytearray(capture(packets, style))
    for place, value in changes:
        content[place % len(content)] = value
    read_bytes(bytes(content[:4]) + bytes(content[4:]), block_frames=2)


def test_a_pipe_gives_what_has_arrived() -> None:
    """No packet waits for one that has not been captured, also after a part of one."""
    content = pcap([packet_of(one, Style()) for one in FRAMES], Style())
    parts = [content[:60], content[60:70], content[70:]]

    class Pipe(io.BufferedReader):
        def peek(self, _size: int = 0) -> bytes:
            return parts[0] if parts else b""

        def read1(self, _size: int = -1) -> bytes:
            return parts.pop(0) if parts else b""

    seen = [(len(one), len(parts)) for one in read_blocks(Pipe(io.BytesIO()))]
    assert seen == [(1, 2), (2, 0)]
