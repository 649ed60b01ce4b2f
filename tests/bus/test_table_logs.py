"""TRC, CSV and SQLite logs: versions, columns, and what is no data frame."""

import sqlite3
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from maplines_can.bus import LogFrame, Skipped, read_log
from maplines_can.values.errors import LogError

#: 2009-03-06 16:15:12.317 UTC, in days and in seconds.
DAYS, START = "39878.6772258947", 1_236_356_112.317
HEADER = f";$FILEVERSION={{}} \n;$STARTTIME={DAYS}; \n;   C:\\TraceFile.trc \n"
FRAMES = [(0x300, b"\0\0\0\0\4\0\0", 1.0599), (0x400, b"\1\2", 1.298945), (0x18EFC034, b"\7", 1.5)]
SKIPPED = Counter({Skipped.STATE: 1, Skipped.ERROR: 1, Skipped.REMOTE: 1})
#: Versions of TRC with the rows of PEAK's description: frames, a warning, an error, a request.
LOGS = {
    "1.0": "; no version\n 1) 1059.9 0300 7 00 00 00 00 04 00 00\n 2) 1298.945 0400 2 01 02\n"
    " 3) 1346 FFFFFFFF 4 00 00 00 04 BUSLIGHT\n 4) 1349 0008 4 ERROR 00 19 08 08\n"
    " 5) 1352 0100 3 RTR\n 6) 1500 18EFC034 1 07\n",
    "1.1": HEADER.format("1.1") + " 1) 1059.9  Rx 0300  7  00 00 00 00 04 00 00  \n"
    " 2) 1298.945 Tx 0400  2  01 02\n 3) 1346.8 Warng FFFFFFFF 4 00 00 00 04  BUSLIGHT \n"
    " 4) 1349.2 Error 0008 4 00 19 08 08\n 5) 1352 Rx 0100 3 RTR\n 6) 1500 Rx 18EFC034 1 07\n",
    "1.2": HEADER.format("1.2") + " 1) 1059.900 1 Rx 0300  7  00 00 00 00 04 00 00 \n"
    " 2) 1298.945 2 Tx 0400 2 01 02\n 3) 1346.834 1 Warng FFFFFFFF 4 00 00 00 04 BUSLIGHT\n"
    " 4) 1349.2 1 Error 0008 4 00 19 08 08\n 5) 1352 1 Rx 0100 3 RTR\n"
    " 6) 1500 1 Rx 18EFC034 1 07\n",
    "1.3": HEADER.format("1.3") + " 1) 1059.900 1 Rx 0300 - 7 00 00 00 00 04 00 00 \n"
    " 2) 1298.945 2 Tx 0400 - 2 01 02\n 3) 1346.834 1 Warng FFFFFFFF - 4 00 00 00 04 BUSLIGHT\n"
    " 4) 1349.2 1 Error 0008 - 4 00 19 08 08\n 5) 1352 1 Rx 0100 - 3 RTR\n"
    " 6) 1500 1 Rx 18EFC034 - 1 07\n",
    "2.0": HEADER.format("2.0") + ";$COLUMNS=N,O,T,I,d,l,D \n"
    " 1 1059.900 DT 0300 Rx 7 00 00 00 00 04 00 00 \n 2 1298.945 DT 0400 Tx 2 01 02\n"
    " 3 1334.531 ST          Rx    00 00 00 08 \n 4 1334.522 ER          Rx    04 00 02 00 00 \n"
    " 5 1336.543 RR     0100 Rx 3\n 6 1500 DT 18EFC034 Tx 1 07\n",
    "2.1": HEADER.format("2.1") + ";$COLUMNS=N,O,T,B,I,d,R,L,D \n"
    " 1 1059.900 DT 1 0300 Rx - 7 00 00 00 00 04 00 00 \n 2 1298.945 DT 2 0400 Tx - 2 01 02\n"
    " 3 1334.231 ST 1 - Rx - 4 00 00 00 08\n 4 1334.222 ER 1 - Rx - 5 04 00 02 00 00\n"
    " 5 1336.543 RR 1 0100 Rx - 3\n 6 1500 DT 1 18EFC034 Tx - 1 07\n",
}


@pytest.mark.parametrize("version", LOGS)
@pytest.mark.parametrize("suffix", ["trc", "txt"])
def test_each_version_of_trc(tmp_path: Path, version: str, suffix: str) -> None:
    """Frames, buses, times in UTC, and what is counted."""
    path = tmp_path / f"a.{suffix}"
    path.write_text(LOGS[version])
    log = read_log(path)
    frames = [*log]
    start = 0.0 if version == "1.0" else START
    assert [(f.can_id, f.data) for f in frames] == [frame[:2] for frame in FRAMES]
    assert [f.t_ns / 1e9 for f in frames] == pytest.approx(
        [start + t for *_, t in FRAMES], abs=2e-3
    )
    gaps = [frames[k].t_ns - frames[0].t_ns for k in (1, 2)]
    assert gaps == [239_045_000, 440_100_000]
    assert [f.is_extended for f in frames] == [False, False, True]
    has_bus = version in ("1.2", "1.3", "2.1")
    assert [f.channel for f in frames] == (["1", "2", "1"] if has_bus else ["1"] * 3)
    assert log.summary.skipped == SKIPPED
    assert log.summary.times == ("zero" if version == "1.0" else "absolute")


@pytest.mark.parametrize(("column", "value"), [("l", "12"), ("L", "9")])
@pytest.mark.parametrize("kind", ["FD", "FB", "FE", "BI"])
def test_can_fd_of_trc(tmp_path: Path, column: str, value: str, kind: str) -> None:
    """ "l" is the number of bytes, "L" the data length code."""
    path = tmp_path / "a.trc"
    columns = f";$COLUMNS=N,O,T,B,I,d,R,{column},D\n"
    row = f" 1 1.5 {kind} 1 0500 Tx - {value} {'0A ' * 12}\n 2 2 EV 1 User-defined event\n"
    path.write_text(HEADER.format("2.1") + columns + row)
    log = read_log(path)
    assert [(f.can_id, f.data) for f in log] == [(0x500, b"\n" * 12)]
    assert log.summary.skipped == Counter({Skipped.OTHER: 1})


def test_a_message_of_j1939_is_no_frame(tmp_path: Path) -> None:
    """More than 8 bytes, put together by the recorder; codes of more than 8 are 8 bytes."""
    path = tmp_path / "a.trc"
    path.write_text(
        HEADER.format("1.3") + f" 1) 1.0 1 Rx 10062123 - 9 {'D2 ' * 9}\n"
        f" 2) 2.0 1 Rx 0123 - 9 {'AA ' * 8}\n 3) 3.0 1 Rx 0123 - 8 {'AA ' * 8}\n"
    )
    log = read_log(path)
    assert [f.data for f in log] == [b"\xaa" * 8] * 2
    assert log.summary.skipped == Counter({Skipped.OTHER: 1})


@pytest.mark.parametrize("version", LOGS)
def test_every_cut_of_the_last_row_of_trc_is_said(tmp_path: Path, version: str) -> None:
    """Before the last digit of its data: by an error, as no other frame comes of it."""
    path, text = tmp_path / "a.trc", LOGS[version].rstrip()
    for length in range(text.rindex("\n") + 8, len(text)):
        path.write_text(text[:length])
        found: list[LogFrame] = []
        with pytest.raises(LogError, match="1 of 6 records are damaged"):
            found.extend(read_log(path))
        assert len(found) == 2
    path.write_text(text)
    assert len([*read_log(path)]) == 3


CSV = "timestamp,arbitration_id,extended,remote,error,dlc,data\n"
CSV_ROWS = "1.5,0x340,0,0,0,2,AAE=\n2.5,0x18ebff00,1,0,0,1,Kg==\n"
CSV_FRAMES = [
    LogFrame(0x340, b"\0\1", 1_500_000_000, False, "", True),
    LogFrame(0x18EBFF00, b"*", 2_500_000_000, True, "", True),
]


@pytest.mark.parametrize("header", ["", "\ufeff", CSV, "\ufeff" + CSV, "\n" + CSV, CSV.upper()])
@pytest.mark.parametrize("suffix", ["csv", "txt"])
def test_csv_with_and_without_a_header(tmp_path: Path, suffix: str, header: str) -> None:
    """The first row is a header only if it is none of a frame."""
    path = tmp_path / f"a.{suffix}"
    path.write_bytes((header + CSV_ROWS).encode())
    log = read_log(path)
    assert [*log] == CSV_FRAMES
    assert (log.summary.format, log.summary.times) == (".csv", "zero")


def test_csv_of_two_recordings_and_of_other_columns(tmp_path: Path) -> None:
    """A second header is none of a frame; a column of the channel is kept."""
    path = tmp_path / "a.csv"
    path.write_text(
        CSV + CSV_ROWS + "channel,data,dlc,error,remote,extended,arbitration_id,timestamp\n"
        "can1,Kg==,1,0,0,0,0x7ff,1700000000.123456789\n"
    )
    last = LogFrame(0x7FF, b"*", 1_700_000_000_123_456_789, False, "can1", True)
    assert [*read_log(path)] == [*CSV_FRAMES, last]


def test_csv_of_something_else_names_the_column(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("t,slot\n1.5,EGO_LEFT\n")
    with pytest.raises(LogError, match=r"none of 1 .* \(line 2: the header has no column timest"):
        list(read_log(path))


SQL_NAMES = "ts, arbitration_id, extended, remote, error, dlc, data"
SQL_ROWS: list[tuple[Any, ...]] = [
    (1_700_000_000.25, 0x340, 0, 0, 0, 2, b"\1\2"),
    (1_700_000_000.5, 0x12345, 1, 0, 0, 0, None),
    (1_700_000_000.5, 0x340, 0, 1, 0, 4, None),
    (1_700_000_000.75, 4, 0, 0, 1, 8, bytes(8)),
    (1_700_000_001.0, 0x340, 0, 1, 1, 8, bytes(8)),
]
SQL_DATA = [(0x340, b"\1\2", False), (0x12345, b"", True)]


def written(path: Path, names: str, rows: list[tuple[Any, ...]]) -> Path:
    with sqlite3.connect(path) as database:
        database.execute(f"CREATE TABLE messages({names})")
        places = ", ".join("?" * len(rows[0]))
        database.executemany(f"INSERT INTO messages VALUES({places})", rows)
    database.close()
    return path


def read(path: Path) -> tuple[list[LogFrame], Any]:
    log = read_log(path)
    return list(log), log.summary


def test_rows_without_a_channel(tmp_path: Path) -> None:
    """As python-can writes them; the summary says what is lost, and counts what is no frame."""
    frames, summary = read(written(tmp_path / "a.db", SQL_NAMES, SQL_ROWS))
    assert [(f.can_id, f.data, f.is_extended) for f in frames] == SQL_DATA
    assert [frame.t_ns for frame in frames] == [
        1_700_000_000_250_000_000,
        1_700_000_000_500_000_000,
    ]
    assert {frame.channel for frame in frames} == {""}
    assert summary.skipped == {Skipped.REMOTE: 1, Skipped.ERROR: 2}
    assert (summary.format, summary.times) == (".db", "absolute")
    assert [note for note in summary.notices if "no column channel" in note] == summary.notices


@pytest.mark.parametrize(
    ("channel", "name"), [("can1", "can1"), (7, "7"), (None, "")], ids=["text", "number", "none"]
)
def test_rows_with_a_channel(tmp_path: Path, channel: object, name: str) -> None:
    """In any place, and in capital letters."""
    rows = [(row[0], channel, "other", *row[1:]) for row in SQL_ROWS]
    names = SQL_NAMES.replace("ts,", "TS, Channel, more,")
    frames, summary = read(written(tmp_path / "a.db", names, rows))
    assert [(f.can_id, f.data, f.is_extended) for f in frames] == SQL_DATA
    assert [frame.channel for frame in frames] == [name, name]
    assert summary.notices == []


@pytest.mark.parametrize(
    ("first", "times"), [(0.0, "zero"), (631_151_999.0, "zero"), (631_152_000.0, "absolute")]
)
def test_kind_of_times(tmp_path: Path, first: float, times: str) -> None:
    """Dates begin in 1990, as for python-can."""
    path = written(
        tmp_path / "a.db", SQL_NAMES, [(first, *SQL_ROWS[0][1:]), (2e9, *SQL_ROWS[0][1:])]
    )
    assert read(path)[1].times == times


@pytest.mark.parametrize("missing", SQL_NAMES.split(", "))
def test_a_table_without_a_column_of_a_frame(tmp_path: Path, missing: str) -> None:
    names = SQL_NAMES.replace(missing, "other")
    with pytest.raises(LogError, match=r"must have the 7 columns ts, .*, got .*other"):
        read(written(tmp_path / "a.db", names, SQL_ROWS))


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ((1.5, "340", 0, 0, 0, 2, b"\1\2"), "an integer as CAN ID"),
        ((1.5, 0x340, 0, 0, 0, 2, "ab"), "a blob as data"),
        ((1.5, 1 << 29, 1, 0, 0, 2, b"\1\2"), "CAN ID must be in"),
        ((1e10, 0x340, 0, 0, 0, 2, b"\1\2"), "beyond 64 bits"),
        ((1.5, 0x340, 0, 0, 0, 65, bytes(65)), "at most 64 bytes"),
    ],
)
def test_a_row_that_is_no_frame_ends_the_reading(
    tmp_path: Path, row: tuple[Any, ...], words: str
) -> None:
    frames = list[LogFrame]()
    with pytest.raises(LogError, match=f"damaged after 1 good records .*{words}"):
        frames.extend(read_log(written(tmp_path / "a.db", SQL_NAMES, [SQL_ROWS[0], row])))
