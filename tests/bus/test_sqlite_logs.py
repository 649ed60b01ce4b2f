"""SQLite logs: columns by name, the channel of each frame, and what is no frame."""

import sqlite3
from pathlib import Path
from typing import Any

import pytest

from maplines_can.bus import LogFrame, read_log
from maplines_can.logs.log_summary import Skipped
from maplines_can.values.errors import LogError

NAMES = "ts, arbitration_id, extended, remote, error, dlc, data"
ROWS: list[tuple[Any, ...]] = [
    (1_700_000_000.25, 0x340, 0, 0, 0, 2, b"\1\2"),
    (1_700_000_000.5, 0x12345, 1, 0, 0, 0, None),
    (1_700_000_000.5, 0x340, 0, 1, 0, 4, None),
    (1_700_000_000.75, 4, 0, 0, 1, 8, bytes(8)),
    (1_700_000_001.0, 0x340, 0, 1, 1, 8, bytes(8)),
]
DATA = [(0x340, b"\1\2", False), (0x12345, b"", True)]


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
    frames, summary = read(written(tmp_path / "a.db", NAMES, ROWS))
    assert [(f.can_id, f.data, f.is_extended) for f in frames] == DATA
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
    rows = [(row[0], channel, "other", *row[1:]) for row in ROWS]
    names = NAMES.replace("ts,", "TS, Channel, more,")
    frames, summary = read(written(tmp_path / "a.db", names, rows))
    assert [(f.can_id, f.data, f.is_extended) for f in frames] == DATA
    assert [frame.channel for frame in frames] == [name, name]
    assert summary.notices == []


@pytest.mark.parametrize(
    ("first", "times"), [(0.0, "zero"), (631_151_999.0, "zero"), (631_152_000.0, "absolute")]
)
def test_kind_of_times(tmp_path: Path, first: float, times: str) -> None:
    """Dates begin in 1990, as for python-can."""
    path = written(tmp_path / "a.db", NAMES, [(first, *ROWS[0][1:]), (2e9, *ROWS[0][1:])])
    assert read(path)[1].times == times


@pytest.mark.parametrize("missing", NAMES.split(", "))
def test_a_table_without_a_column_of_a_frame(tmp_path: Path, missing: str) -> None:
    names = NAMES.replace(missing, "other")
    with pytest.raises(LogError, match=r"must have the 7 columns ts, .*, got .*other"):
        read(written(tmp_path / "a.db", names, ROWS))


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
        frames.extend(read_log(written(tmp_path / "a.db", NAMES, [ROWS[0], row])))
