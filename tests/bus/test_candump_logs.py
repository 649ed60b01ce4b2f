"""Output of candump, with and without -L, from files and pipes; cantools is the witness."""

import io
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from cantools.logreader import Parser

from maplines_can.bus import Skipped, read_log
from maplines_can.values.errors import LogError

T0 = 1_700_000_000.123456
#: Time [s], CAN ID as printed, data, and whether the frame is CAN FD.
FRAMES = [
    (0.0, "340", bytes(range(8)), False),
    (0.000106, "341", b"", False),
    (0.05, "1ABCDEF0", b"\xff", False),
    (0.0503, "348", bytes(range(32)), True),
]


def column(frame: Any, *, extra: str = "", ascii_column: str = "") -> str:
    """Return a row as candump prints it without -L."""
    _, can_id, data, fd = frame
    length = f"{len(data):02d}" if fd else f"{len(data)}"
    row = f"  vcan0{extra}  {can_id:>8}{'  ' if fd else '   '}[{length}]"
    return row + (f"  {data.hex(' ').upper()}" if data else "") + ascii_column


def log_row(frame: Any, *, direction: str = "") -> str:
    """Return a row as candump -L prints it."""
    t, can_id, data, fd = frame
    mark = "##1" if fd else "#"
    return f"({T0 + t:017.6f}) vcan0 {can_id}{mark}{data.hex().upper()}{direction}"


def stamped(stamps: Any) -> list[str]:
    """Return rows of columns with time stamps."""
    return [f" ({stamp}){column(frame)}" for stamp, frame in zip(stamps, FRAMES, strict=True)]


TIMES = [t for t, *_ in FRAMES]
#: Rows by the options of candump, and the times they stand for [s]; None if there are none.
OUTPUTS: dict[str, tuple[list[str], list[float] | None]] = {
    "none": ([column(frame) for frame in FRAMES], None),
    "-a": ([column(frame, ascii_column="   '..@.'") for frame in FRAMES], None),
    "-t a": (stamped([f"{T0 + t:017.6f}" for t in TIMES]), [T0 + t for t in TIMES]),
    "-t z": (stamped([f"{t:010.6f}" for t in TIMES]), TIMES),
    "-t A": (
        stamped([datetime.fromtimestamp(T0 + t).isoformat(" ", "microseconds") for t in TIMES]),
        [T0 + t for t in TIMES],
    ),
    "-L": ([log_row(frame) for frame in FRAMES], [T0 + t for t in TIMES]),
    "-L -x": ([log_row(frame, direction=" R") for frame in FRAMES], [T0 + t for t in TIMES]),
    "-x": ([column(frame, extra="  RX - -") for frame in FRAMES], None),
    "-x, sent": ([column(frame, extra="  TX B E") for frame in FRAMES], None),
}


@pytest.mark.parametrize("suffix", [".log", ".txt", "", "stream"])
@pytest.mark.parametrize("options", OUTPUTS)
def test_item_11_every_output_of_candump_is_read(tmp_path: Path, options: str, suffix: str) -> None:
    """IDs, data, channel and times, whatever the suffix, and from a stream."""
    rows, times = OUTPUTS[options]
    content = "\n".join(rows) + "\n"
    if suffix == "stream":
        frames = list(read_log(io.BufferedReader(io.BytesIO(content.encode()))))
    else:
        path = tmp_path / f"drive{suffix}"
        path.write_text(content)
        frames = list(read_log(path))

    assert [(f.can_id, f.data) for f in frames] == [(int(i, 16), d) for _, i, d, _ in FRAMES]
    assert [f.is_extended for f in frames] == [False, False, True, False]
    assert {f.channel for f in frames} == {"vcan0"}
    if times is None:
        assert {(f.t_ns, f.has_time) for f in frames} == {(0, False)}
    else:
        assert [f.t_ns / 1e9 for f in frames] == pytest.approx(times, abs=1e-6)
    if not options.startswith("-x"):  # of which cantools knows none without -L
        assert [(w.frame_id, w.data, w.is_extended_frame, w.channel) for w in Parser(
            io.StringIO(content)
        )] == [(f.can_id, f.data, f.is_extended, f.channel) for f in frames]  # fmt: skip


#: Rows of what is no data frame, by the tool that writes them.
OTHER_ROWS = {
    "  can0  20000004   [8]  00 04 00 00 00 00 00 00   ERRORFRAME": Skipped.ERROR,
    "  can0  RX - -  20000088   [8]  00 00 80 19 00 00 00 00   ERRORFRAME": Skipped.ERROR,
    "  can0  20000004   [8]  00 04 00 00 00 00 00 00   '........'": Skipped.ERROR,
    "(1.5) can0 20000004#0004000000000000": Skipped.ERROR,
    "(1.5) can0 20000080#": Skipped.ERROR,  # python-can's writer, whatever the class was
    "  can0  123   [4]  remote request": Skipped.REMOTE,
    "  can0  TX - -  00000123   [4]  remote request": Skipped.REMOTE,
    "(1.5) can0 123#R": Skipped.REMOTE,
    "(1.5) can0 123#r8": Skipped.REMOTE,
    "(1.5) can0 00000123#R8_E": Skipped.REMOTE,
    "(1.5) can0 123#81:00:12345678#11223344": Skipped.OTHER,  # CAN XL
    "DROPCOUNT: dropped 2 CAN frames on 'can0' socket (total drops 2)": Skipped.OTHER,
    "\tcontroller-problem{tx-error-warning}": None,
    "": None,
}


@pytest.mark.parametrize("row", OTHER_ROWS)
def test_what_is_no_data_frame_is_counted_by_kind(tmp_path: Path, row: str) -> None:
    """The explanations of candump -e and empty lines are no records."""
    path = tmp_path / "drive.log"
    path.write_text(f"{row}\n  can0  340   [1]  2A\n")
    log = read_log(path)
    kind = OTHER_ROWS[row]

    assert [f.data for f in log] == [b"*"]
    assert log.summary.skipped == ({} if kind is None else {kind: 1})


@pytest.mark.parametrize("row", ["(1.5) can0 340#11", "  can0  340   [1]  11", *OTHER_ROWS])
def test_a_byte_order_mark_costs_no_row(tmp_path: Path, row: str) -> None:
    """Neither at the begin nor where another log was added."""
    path = tmp_path / "drive.log"
    path.write_text(f"\ufeff{row}\n\ufeff{row}\n", encoding="utf-8")
    log = read_log(path)
    kind = OTHER_ROWS.get(row, Skipped.STATE)

    assert len([*log]) + log.summary.skipped.total() == (0 if kind is None else 2)


@pytest.mark.parametrize(
    ("row", "is_certain"),
    [
        ("(1.5) can0 340#11", False),
        ("(1.5) can0 340##011", False),
        ("(1.5) can0 340#11 R", True),
        ("(1.5) can0 340#11\n", True),
        ("(1.5) can0 340#11\r", True),
        ("(1.5) can0 340#11\r\n", True),
        ("  can0  340   [1]  11", True),
    ],
)
def test_a_last_row_that_may_be_cut_is_said(tmp_path: Path, row: str, is_certain: bool) -> None:
    """The rows of candump -L do not have a length."""
    path = tmp_path / "drive.log"
    path.write_bytes(row.encode())
    log = read_log(path)

    assert [f.data for f in log] == [b"\x11"]
    assert bool(log.summary.notices) != is_certain


@pytest.mark.parametrize(
    ("fraction", "ns"),
    [("", 0), (".", 0), (".5", 500_000_000), (".0000000019", 1), (".854775807", 854_775_807)],
)
def test_the_fraction_of_a_stamp_may_have_any_length(
    tmp_path: Path, fraction: str, ns: int
) -> None:
    """More digits than nanoseconds are cut off; the last of these times is that of 64 bits."""
    path = tmp_path / "drive.log"
    path.write_text(f"(9223372036{fraction}) can0 340#00\n")
    (frame,) = read_log(path)
    assert frame.t_ns == 9_223_372_036 * 10**9 + ns


def test_a_binary_log_in_a_stream_is_one_clear_error() -> None:
    stream: Any = io.BufferedReader(io.BytesIO(b"LOGG" + bytes(100)))
    with pytest.raises(LogError, match=r"a log in the format \.blf is read from a file"):
        list(read_log(stream))


class Terminal(io.RawIOBase):
    """A stream that has more to read after its end, such as a terminal after Ctrl-D."""

    def __init__(self, *chunks: bytes) -> None:
        self.chunks = list(chunks)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        chunk = self.chunks.pop(0)
        buffer[: len(chunk)] = chunk
        return len(chunk)


@pytest.mark.parametrize("size", range(1, 30, 4))
@pytest.mark.parametrize(
    "row",
    [
        "(1.5) can0 340#2A\n",
        " 0.5 1 340 Rx d 1 2A\n",
        "1.5,0x340,0,0,0,1,Kg==\n",
        " \r\n(1.5) c 340#2A\r",
    ],
)
def test_a_stream_in_small_parts_is_the_same(row: str, size: int) -> None:
    """The format is known by whole lines, whatever arrives first."""
    data = row.encode() * 3
    parts = [data[place : place + size] for place in range(0, len(data), size)]
    stream: Any = io.BufferedReader(Terminal(*parts, b""))
    assert [(f.can_id, f.data) for f in read_log(stream)] == [(0x340, b"*")] * 3


def test_standard_input_stays_open(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever opened a stream closes it."""
    stream: Any = io.BufferedReader(io.BytesIO(b"  can0  340   [1]  2A\n"))
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(stream))
    assert len(list(read_log(sys.stdin.buffer))) == 1
    assert not stream.closed
