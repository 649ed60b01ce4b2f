"""ASC logs: headers of any shape, both bases, and what is no data frame."""

from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from maplines_can.bus import LogFrame, Skipped, read_log
from maplines_can.recordings.blocks import read_blocks
from maplines_can.values.errors import LogError

DATE = "date Mon Jun 10 10:00:00.000 am 2024"
HEADERS = {
    "usual": f"{DATE}\nbase dec  timestamps absolute\ninternal events logged\n",
    "french": "date lun. juin 10 10:00:00.000 2024\nbase dec timestamps absolute\n",
    "iso": "date 2024-06-10T10:00:00+02:00\nbase dec timestamps absolute\n",
    "japanese": "date 月 6 10 10:00:00.000 2024\nbase dec timestamps absolute\n",
    "right-to-left": "date \u200f\u0627\u0644 10\nbase dec timestamps absolute\n",
    "byte-order-mark": f"\ufeff{DATE}\nbase dec timestamps absolute\n",
    "empty-lines": f"\n \n{DATE}\n\nbase dec timestamps absolute\n\n",
    "upper-case-tabs": f"{DATE.upper()}\nBASE\tDEC\t\tTIMESTAMPS  ABSOLUTE\n",
    "base-first": f"base dec timestamps absolute\n{DATE}\n",
    "one-row": f"{DATE} base dec timestamps absolute\n",
    "other-words": "Recorded by a tool\nbase dec  no internal events logged\n// version 7.1.0\n",
    "comment": f"// base hex\n{DATE}\nbase dec timestamps absolute\n// version 9\n",
    "trigger": f"{DATE}\nbase dec timestamps absolute\nBegin Triggerblock lun. juin 10\n"
    "; time can ident\n   0.000000 Start of measurement\n",
    "windows": f"{DATE}\r\nbase dec timestamps absolute\r\n",
}
ROWS = """\
   0.010000 1  832             Tx   d 8  85  84   0 255   6  44 251  17
   0.020000 2  418119424x      Rx   d 2  16  14  Length = 228000 BitCount = 117 ID = 418119424x
"""
FRAMES = [
    LogFrame(832, bytes([85, 84, 0, 255, 6, 44, 251, 17]), 10_000_000, False, "0", True),
    LogFrame(0x18EBFF00, bytes([16, 14]), 20_000_000, True, "1", True),
]


def in_both(path: Path) -> tuple[list[LogFrame], Any]:
    """Return frames, and the summary; those of the blocks are the same."""
    log, blocks = read_log(path), read_blocks(path)
    frames, found = [*log], [*blocks]
    assert sum(map(len, found)) == len(frames)
    assert [t for block in found for t in block.t_ns] == [f.t_ns for f in frames]
    assert [one for block in found for one in block.can_id] == [f.can_id for f in frames]
    assert blocks.summary == log.summary
    return frames, log.summary


@pytest.mark.parametrize("suffix", ["asc", "txt"])
@pytest.mark.parametrize("header", HEADERS)
def test_the_base_is_found_in_any_header(tmp_path: Path, header: str, suffix: str) -> None:
    """Whatever stands before the first frame; the frame itself is no header."""
    if suffix == "txt" and header == "other-words":
        pytest.skip("nothing tells the format by then")
    path = tmp_path / f"a.{suffix}"
    path.write_bytes((HEADERS[header] + ROWS).encode())
    assert in_both(path)[0] == FRAMES


@pytest.mark.parametrize("suffix", ["asc", "txt"])
def test_without_a_header_the_first_row_is_a_frame(tmp_path: Path, suffix: str) -> None:
    """Its numbers are hexadecimal."""
    path = tmp_path / f"a.{suffix}"
    path.write_text("0.010000 1  340 Tx d 2 55 54\n0.020000 1  341x Tx d 1 FF")
    frames, summary = in_both(path)
    assert [(f.can_id, f.is_extended, f.data) for f in frames] == [
        (0x340, False, b"\x55\x54"),
        (0x341, True, b"\xff"),
    ]
    assert (summary.format, summary.times, summary.notices) == (".asc", "zero", [])


@pytest.mark.parametrize("base", ["hex", "dec"])
@pytest.mark.parametrize("words", ["timestamps relative", "TIMESTAMPS\tRelative"])
def test_relative_stamps_are_added_up(tmp_path: Path, base: str, words: str) -> None:
    """Those of events, requests and error frames, too."""
    path = tmp_path / "a.asc"
    path.write_text(
        f"{DATE}\nbase {base} {words}\n   0.100000 Start of measurement\n"
        "   0.100000 1  100  Rx   d 1 11\n   0.100000 1  ErrorFrame\n"
        "   0.200000 1  100  TxRq d 1 11\n   0.000100 1  100  Tx   d 1 12\n"
    )
    frames, summary = in_both(path)
    assert [f.t_ns for f in frames] == [200_000_000, 500_100_000]
    assert summary.times == "delta"
    assert [f.t_ns for f in read_log(path, times="zero")] == [100_000_000, 100_000]


def test_a_second_header_states_base_and_times_again(tmp_path: Path) -> None:
    """As in two logs, one after the other."""
    path = tmp_path / "a.asc"
    path.write_text(
        f"{DATE}\nbase dec timestamps relative\n 0.5 1 256 Rx d 1 16\n 0.5 1 256 Rx d 1 16\n"
        f"End TriggerBlock\n{DATE}\nbase hex timestamps absolute\n 0.5 1 100 Rx d 1 10\n"
    )
    frames, _ = in_both(path)
    assert {(f.can_id, f.data) for f in frames} == {(256, b"\x10")}
    assert [f.t_ns for f in frames] == [500_000_000, 1_000_000_000, 500_000_000]


EVENTS = {
    "1 340 TxRq d 8 00 01 02 03 04 05 06 07": Skipped.REQUEST,
    "CANFD 1 TxRq 340  1 0 1 1 00": Skipped.REQUEST,
    "1 340 Rx r": Skipped.REMOTE,
    "CANFD 1 Rx 340  0 0 8 0 130000 130 10 0": Skipped.REMOTE,
    "1 ErrorFrame": Skipped.ERROR,
    "CANFD 1 Rx ErrorFrame Not Acknowledge error, dominant error flag fffe": Skipped.ERROR,
    "CAN 1 Status:chip status error active": Skipped.STATE,
    "CAN 2 Status:chip status error passive - TxErr: 132 RxErr: 0": Skipped.STATE,
    "1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%": Skipped.OTHER,
    "1  J1939TP FEE3p 6 0 0 - Rx d 23 A0 0F A6 60 3B D1 40": Skipped.OTHER,
    "SV: 3 0 1 ::CANoe::UnknownSysVar = 5": Skipped.OTHER,
    "log trigger event": Skipped.OTHER,
}


@pytest.mark.parametrize("event", EVENTS)
def test_what_is_no_frame_on_the_bus_is_counted_by_kind(tmp_path: Path, event: str) -> None:
    path = tmp_path / "a.asc"
    path.write_text(f"{DATE}\nbase hex timestamps absolute\n 0.1 1 340 Tx d 1 2A\n 0.2 {event}\n")
    frames, summary = in_both(path)
    assert [f.data for f in frames] == [b"*"]
    assert summary.skipped == Counter({EVENTS[event]: 1})


ROWS_OF_FRAMES = {
    "1 340 Rx d 0": (0x340, b""),
    "1 340 rx D 2 01 02": (0x340, b"\1\2"),
    "1\t340\tRx\td\t2\t01\t02": (0x340, b"\1\2"),
    "1 340 Rx d f 00 01 02 03 04 05 06 07": (0x340, bytes(range(8))),
    "1 EngineData Rx d 1 01 Length = 228000 BitCount = 117 ID = 832": (0x340, b"\1"),
    "CANFD 1 Rx 340  1 0 1 1 01 0 0 3000 0": (0x340, b"\1"),
    "CANFD 1 Tx 340 Name 1 0 9 12 " + "0a " * 12: (0x340, b"\n" * 12),
    "CANFD 1 Tx 340 - 1 0 f 64 " + "0a " * 64: (0x340, b"\n" * 64),
    "CANFD 1 Tx 340  1 0 0  0  0 0 3000 0": (0x340, b""),
    "CANFD 1 Tx 340  1 0 0  0": (0x340, b""),
    "CANFD 1 Tx 340 Name 1 0 0  0": (0x340, b""),
    "1 7FF Rx d 1 01 ID = 5": (0x7FF, b"\1"),
    "1 1FFFFFFFX Rx d 1 01": (0x1FFFFFFF, b"\1"),
}


@pytest.mark.parametrize("row", ROWS_OF_FRAMES)
def test_rows_of_frames(tmp_path: Path, row: str) -> None:
    path = tmp_path / "a.asc"
    path.write_text(f"base hex timestamps absolute\n 0.1 {row}\n")
    frames, summary = in_both(path)
    assert [(f.can_id, f.data) for f in frames] == [ROWS_OF_FRAMES[row]]
    assert not summary.skipped


@pytest.mark.parametrize(
    ("row", "is_certain"),
    [("1 832 Rx d 2 1 25", False), ("1 832 Rx d 2 1 255", True), ("1 832 Rx d 2 1 25 ID", True)],
)
@pytest.mark.parametrize("end", ["", "\n"])
def test_a_last_decimal_byte_that_may_be_cut_is_said(
    tmp_path: Path, row: str, is_certain: bool, end: str
) -> None:
    """It has one to three digits, and no line feed behind it."""
    path = tmp_path / "a.asc"
    path.write_text(f"base dec timestamps absolute\n 0.1 {row}{end}")
    log = read_log(path)
    assert [len(f.data) for f in log] == [2]
    assert bool(log.summary.notices) == (not is_certain and not end)


def test_every_cut_of_a_log_is_said(tmp_path: Path) -> None:
    """By an error, or by a notice if each of its rows is whole."""
    text = f"{DATE}\nbase hex  timestamps absolute\nBegin Triggerblock {DATE[5:]}\n"
    path, begin = tmp_path / "a.asc", len(text)
    text += "".join(f"   {k / 10:.6f} 1  340  Tx   d 2 {k:02X} 2A\n" for k in range(3))
    for length in range(begin + 1, len(text) + 1):
        path.write_text(text[:length])
        log, found = read_log(path), []
        try:
            found = [*log]
        except LogError:
            continue
        assert {f.data[1:] for f in found} <= {b"*"}, text[:length]
        assert "the log has no End TriggerBlock" in log.summary.notices[0], text[:length]
    path.write_text(text + "End TriggerBlock")
    log = read_log(path)
    assert (len([*log]), log.summary.notices) == (3, [])


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be"])
def test_utf_16_is_refused_with_the_cure(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "a.asc"
    path.write_bytes((HEADERS["usual"] + ROWS).encode(encoding))
    with pytest.raises(LogError, match="the text is UTF-16; convert it, as with iconv"):
        list(read_log(path))
