"""Logs of SavvyCAN, OVMS and BUSMASTER: what is written is read, among rows of other kinds."""

import gzip
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.log_files import DAY, START, Other, Rows, busmaster, crtd, frames, savvycan
from support.recordings import frames_of

from maplines_can.bus import LogFrame, Skipped, read_log
from maplines_can.recordings.blocks import read_blocks
from maplines_can.values.errors import LogError

FD = (0, 1, 8, 12, 24, 64)


class Format(NamedTuple):
    """Format of a log: its suffixes, writer, frames and other rows."""

    suffixes: Sequence[str]
    write: Callable[[Rows], str]
    frames: st.SearchStrategy[list[LogFrame]]
    times: str = "zero"
    others: Sequence[Other] = ()


#: Rows of errors as Wireshark reads them, and as BUSMASTER writes remote frames.
BUSMASTER_ROWS = [
    Other("00:00:01:0000 Rx 1 0x123 sr 8 ", Skipped.REMOTE),
    Other("00:00:01:0000 Tx 2 291 xr 0", Skipped.REMOTE),
    Other("00:00:01:0000 Rx 1 0 ERR Stuff error", Skipped.ERROR),
    Other("***END DATABASE FILES (DBF/DBC)***", None),
    Other("", None),
]
CRTD_ROWS = [
    Other("19292.299819 CEV vehicle.alert this is a textual vehicle alert", Skipped.OTHER),
    Other("198923.283738 2CST intr=0 rxpkt=0 txpkt=0 errflags=0", Skipped.STATE),
    Other("2783.384726 1CER TX_Fail T11 123 00", Skipped.ERROR),
    Other("2783.3 ABC of a later version", Skipped.OTHER),
    Other("169.971289 CXX Info Type:crtd; Path:'/sd/can3.crtd'", None),
    Other(" ", None),
]
FORMATS = {
    "savvycan": Format((".csv", ".txt"), savvycan, frames(1000, "013"), others=[Other("", None)]),
    "savvycan-absolute": Format(
        (".csv",), lambda rows: savvycan(rows, directions=False), frames(1000, "0", start=1.7e9),
        "absolute",
    ),
    "crtd": Format((".crtd", ".log", ""), crtd, frames(1000, "123"), others=CRTD_ROWS),
    "crtd-absolute": Format((".crtd",), crtd, frames(1000, "12", start=1.5e9), "absolute"),
    "busmaster": Format((".log", ".txt"), busmaster("ABSOLUTE"), frames(100_000, "12", lengths=FD)),
    "busmaster-relative": Format((".log",), busmaster("RELATIVE"), frames(100_000, "1"), "delta"),
    "busmaster-decimal": Format(
        (".log",), busmaster("SYSTEM", is_decimal=True), frames(100_000, "12", start=START),
        "absolute",
    ),
    "busmaster-remote": Format(
        (".log",), busmaster("ABSOLUTE"), frames(100_000, "1"), others=BUSMASTER_ROWS
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FORMATS)
@given(data=st.data())
def test_what_is_written_is_read(
    tmp_path_factory: pytest.TempPathFactory, name: str, data: st.DataObject
) -> None:
    """Frame by frame and in blocks, packed and not; other rows are counted by kind."""
    form = FORMATS[name]
    expected = data.draw(form.frames)
    rows: list[LogFrame | Other] = []
    for one in expected:
        rows += (
            [*data.draw(st.lists(st.sampled_from(form.others), max_size=2)), one]
            if form.others
            else [one]
        )
    text = form.write(rows).replace("\n", data.draw(st.sampled_from(["\n", "\r\n"]))).encode()
    for suffix in [*form.suffixes, f"{form.suffixes[0]}.gz"]:
        path = tmp_path_factory.getbasetemp() / f"written{suffix}"
        path.write_bytes(gzip.compress(text) if suffix.endswith(".gz") else text)
        log, blocks = read_log(path), read_blocks(path, block_frames=3)
        assert [*log] == expected
        assert [f for block in blocks for f in frames_of(block)] == expected
        assert log.summary == blocks.summary
        assert log.summary.times == form.times
        assert log.summary.skipped == Counter(
            row.kind for row in rows if isinstance(row, Other) and row.kind
        )


FRAMES = [
    LogFrame(0x123, b"\x10\x20\x30", 1_500_000_000, False, "1", True),
    LogFrame(0x1ABCDE0, b"", 2_000_000_000, True, "2", True),
    LogFrame(0x7, bytes(range(0x81, 0x89)), 2_100_000_000, False, "1", True),
]


@pytest.mark.parametrize("name", ["savvycan", "crtd", "busmaster", "busmaster-relative"])
def test_every_cut_of_a_log_is_read_up_to_the_cut(tmp_path: Path, name: str) -> None:
    """The frames are those before; what cannot be told from a whole row is noticed."""
    form = FORMATS[name]
    text = form.write(FRAMES)
    path = tmp_path / f"cut{form.suffixes[0]}"
    for end in range(len(text) + 1):
        path.write_text(text[:end])
        log, found = read_log(path), list[LogFrame]()
        try:
            found.extend(log)
        except LogError:
            assert not text[:end].endswith("\n")
        if log.summary.notices and name == "crtd":
            last = found.pop()
            assert FRAMES[len(found)].data.startswith(last.data[:-1])
        assert found == FRAMES[: len(found)]
    assert len(found) == 3


DAMAGE = {
    "savvycan": [
        "1,123,false,Rx,0,9,00,00,00,00,00,00,00,00,", "1,123,false,Rx,0,2,00,", "1,123,false,Rx",
        "1,123,false,Rx,0,-1,", "1,12G,false,Rx,0,0,", "x,123,false,Rx,0,0,", "1,123,yes,Rx,0,0,",
        "1,123,false,Rx,,0,", "1,3FFFFFFF,true,Rx,0,0,", "1,123,false,Rx,0,1,100,",
        "1,123,false,Rx,0,1,+1,", "9" * 20 + ",123,false,Rx,0,0,",
    ],
    "crtd": [
        "1.5 1R11", "1.5 1R11 800", "1.5 1R29 20000000", "1.5 1R11 123 100", "1.5 1R11 12G 00",
        "1.5 1R11 123 0g", "1.5 r11 123 00", "x 1R11 123 00", "1.5 1R11 123" + " 00" * 65,
    ],
    "busmaster": [
        "00:00:01:0000 Rx 1 0x123 s 2 00", "00:00:01:0000 Rx 1 0x123 s 1 0",
        "00:00:01:0000 Rx 1 0x123 s 1 00 00", "00:00:01:0000 Rx 1 0x123 q 1 00",
        "00:00:01:0000 Rx 1 0x3FFFFFFF x 0", "00:00:01:0000 Rx 1 xyz s 0", "00:00:01 Rx 1 1 s 0",
        "00:00:01:0000 Rx 1 0x123 s-fd 15 00", "00:00:01:0000 R 1 0x123 s 0", "* 1",
    ],
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "row"), [(name, row) for name, rows in DAMAGE.items() for row in rows]
)
def test_a_damaged_row_costs_only_itself(tmp_path: Path, name: str, row: str) -> None:
    path = tmp_path / f"a{FORMATS[name].suffixes[0]}"
    path.write_text(FORMATS[name].write([FRAMES[0], Other(row, None), *FRAMES[1:]]))
    found: list[LogFrame] = []
    with pytest.raises(LogError, match="1 of 4 records are damaged"):
        found.extend(read_log(path))
    assert found == FRAMES


#: Rows of logs among the tests of BUSMASTER (Tests/AutoIt/Format Converter/testcocoon_testdata of
#: rbei-etas/busmaster: systemtime_decimal and relative-hex), their times [s], and what is in them.
BUSMASTER_LOGS: dict[str, tuple[str, list[tuple[float, int, bytes]]]] = {
    "decimal, time of day": (
        "***START DATE AND TIME 29:6:2012 11:37:39:842***\n***DEC***\n***SYSTEM MODE***\n"
        "11:37:12:0485 Tx 1 1750 s 8 000 000 000 000 000 000 000 000\n"
        "11:37:12:0503 Tx 1 0018 s 7 000 000 000 000 000 000 000\n",
        [(DAY + 41832.0485, 1750, bytes(8)), (DAY + 41832.0503, 18, bytes(7))],
    ),
    "hexadecimal, differences": (
        "***START DATE AND TIME 29:6:2012 11:39:49:141***\n***HEX***\n***RELATIVE MODE***\n"
        "00:00:00:0000 Tx 1 0x715 s 8 00 00 00 00 00 00 00 00 \n"
        "00:00:00:0980 Tx 1 0x67A s 8 00 00 00 00 00 00 00 00 \n"
        "00:00:00:1000 Tx 1 0x679 s 8 00 00 00 00 00 00 00 00 \n",
        [(0.0, 0x715, bytes(8)), (0.098, 0x67A, bytes(8)), (0.198, 0x679, bytes(8))],
    ),
    "of SavvyCAN, with three decimals and without a date": (
        "***START DATE AND TIME ***\n***HEX***\n***SYSTEM MODE***\n"
        "01:00:12:942 Rx 1 0x12345678 x 1 AA \n01:00:13:002 Rx 2 0x023 s 1 40 \n",
        [(3612.942, 0x12345678, b"\xaa"), (3613.002, 0x23, b"\x40")],
    ),
    "day before the start, and past midnight": (
        "***START DATE AND TIME 29:6:2012 0:0:1:0***\n***HEX***\n***SYSTEM MODE***\n"
        "23:59:58:0000 Rx 1 0x1 s 0 \n00:00:02:0000 Rx 1 0x1 s 0 \n12:00:00:0000 Rx 1 0x1 s 0\n",
        [(DAY - 2, 1, b""), (DAY + 2, 1, b""), (DAY + 43_200, 1, b"")],
    ),
}


@pytest.mark.parametrize("name", BUSMASTER_LOGS)
def test_logs_of_busmaster(tmp_path: Path, name: str) -> None:
    text, rows = BUSMASTER_LOGS[name]
    path = tmp_path / "a.log"
    path.write_text(f"***BUSMASTER Ver 1.6.4***\n***PROTOCOL CAN***\n{text}")
    assert [(f.t_ns, f.can_id, f.data) for f in read_log(path)] == [
        (round(t * 1e4) * 10**5, can_id, data) for t, can_id, data in rows
    ]


@pytest.mark.parametrize("protocol", ["J1939", "LIN"])
def test_other_protocols_of_busmaster_are_named(tmp_path: Path, protocol: str) -> None:
    path = tmp_path / "a.log"
    path.write_text(f"***BUSMASTER Ver 3.2.2***\n***PROTOCOL {protocol}***\n00:00:00:0001 Rx 1\n")
    with pytest.raises(LogError, match=f"the protocol '{protocol}' of BUSMASTER is not read"):
        list(read_log(path))


def test_examples_of_the_description_of_crtd(tmp_path: Path) -> None:
    """Of OVMS; the last row as SavvyCAN reads it, in microseconds."""
    path = tmp_path / "a.txt"
    path.write_text(
        "1542473901.020305 1R11 213 00 00 00 00 c0 01 00 00\n1542473901.036694 3T11 41C 10\n"
        "1542473901.040 R11 428 00 30\n1542473901050000 2R29 0000041C 1\n"
    )
    found = [(f.t_ns, f.channel, f.can_id, f.data.hex(), f.is_extended) for f in read_log(path)]
    assert found == [
        (1542473901_020305000, "1", 0x213, "00000000c0010000", False),
        (1542473901_036694000, "3", 0x41C, "10", False),
        (1542473901_040000000, "1", 0x428, "0030", False),
        (1542473901_050000000, "2", 0x41C, "01", True),
    ]


def test_an_example_of_savvycan(tmp_path: Path) -> None:
    """The row in its framefileio.cpp; and an ID that says that it is extended, as it reads it."""
    path = tmp_path / "a.csv"
    path.write_text(
        "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n"
        "39747828,000005EB,false,Rx,0,8,E8,45,85,4B,4A,28,36,69,\n-5,18ebff00,FALSE,Tx,1,0,\n"
    )
    assert [*read_log(path, times="absolute")] == [
        LogFrame(0x5EB, bytes.fromhex("E845854B4A283669"), 39_747_828_000, False, "0", True),
        LogFrame(0x18EBFF00, b"", -5000, True, "1", True),
    ]


def test_a_header_without_a_column_names_it(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("Time Stamp,ID,Extended,Dir,LEN,D1\n1,123,false,Rx,1,00\n")
    with pytest.raises(LogError, match="the row has no column 'bus'"):
        list(read_log(path))


@pytest.mark.parametrize("times", ["absolute", "zero", "delta"])
def test_the_kind_of_stamps_can_be_stated(tmp_path: Path, times: Any) -> None:
    for name in ("savvycan", "crtd", "busmaster"):
        path = tmp_path / f"a{FORMATS[name].suffixes[0]}"
        path.write_text(FORMATS[name].write(FRAMES))
        log = read_log(path, times=times)
        expected = [1.5, 3.5, 5.6] if times == "delta" else [1.5, 2.0, 2.1]
        assert [f.t_ns / 1e9 for f in log] == expected
        assert log.summary.times == times
