"""The table of docs/recordings.md: what is kept of a log, and what is counted, by format."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import can
import pytest

from maplines_can.bus import LogFrame, Skipped, read_log

PAGE = Path(__file__).parents[2] / "docs" / "recordings.md"
FD_DATA = bytes(range(48))
COLUMNS = ("channel", "CAN FD", "time stamps", "remote frames", "error frames")
#: A log in PEAK's format 2.1, whose lengths are DLCs: two channels, a remote and an error frame.
TRC = f""";$FILEVERSION=2.1
;$STARTTIME=45000.5
;$COLUMNS=N,O,T,B,I,d,R,L,D
      1         0.000 DT 1      0123 Rx -  2    01 02
      2       500.000 DT 2  00000123 Rx -  1    03
      3      1000.000 RR 1      0124 Rx -  4
      4      1500.000 ER 1         - Rx -  5    04 00 02 00 00
      5      2000.000 FB 1      0125 Rx - 14    {FD_DATA.hex(" ")}
"""


def table() -> dict[str, dict[str, str]]:
    """Return the rows of the table by the suffix of the format."""
    page = PAGE.read_text().partition("## Logs of others")[2].partition("\n## ")[0]
    head, _, *rows = [
        [cell.strip() for cell in row.strip("|").split("|")]
        for row in page.splitlines()
        if row.startswith("|")
    ]
    assert head == ["format", *COLUMNS]
    suffixes = {row[0]: row[0].partition("`")[2].partition("`")[0] for row in rows}
    return {
        suffixes[row[0]].replace("-L", ".log"): dict(zip(COLUMNS, row[1:], strict=True))
        for row in rows
    }


def write_by_python_can(path: Path) -> None:
    """Write data frames of two channels, one of CAN FD, a remote frame and an error frame."""
    kinds: list[dict[str, Any]] = [
        {"arbitration_id": 0x123, "data": b"\1\2", "channel": 1},
        {"arbitration_id": 0x123, "data": b"\3", "channel": 2, "is_extended_id": True},
        {"arbitration_id": 0x124, "is_remote_frame": True, "dlc": 4, "channel": 1},
        {"is_error_frame": True, "data": bytes(8), "channel": 1},
        {"arbitration_id": 0x125, "is_fd": True, "bitrate_switch": True, "data": FD_DATA},
    ]
    with can.Logger(path) as writer:
        for k, kind in enumerate(kinds):
            common = {"timestamp": 1.7e9 + 0.5 * k, "is_extended_id": False, "channel": 1}
            writer(can.Message(**common | kind))


def row_of(path: Path) -> tuple[dict[str, str], list[LogFrame]]:
    """Return the row of the table that reading a log gives, and the frames."""
    reader = read_log(path)
    frames = [*reader]
    skipped = reader.summary.skipped
    channels = {frame.channel for frame in frames}
    row = {
        "channel": "of a column `channel`" if channels == {""} else "kept",
        "CAN FD": "kept" if frames[-1].data == FD_DATA else "lost",
        "time stamps": reader.summary.times,
        "remote frames": "counted" if skipped[Skipped.REMOTE] == 1 else "lost",
        "error frames": "counted" if skipped[Skipped.ERROR] == 1 else "lost",
    }
    return row, frames


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf", ".mf4", ".trc", ".csv", ".db"])
def test_the_table_is_what_is_read(suffix: str, tmp_path: Path) -> None:
    """Of the frames of python-can's writers, and of PEAK's format as its page describes it."""
    if suffix == ".mf4":
        pytest.importorskip("asammdf")
    path = tmp_path / f"a{suffix}"
    if suffix == ".trc":
        path.write_text(TRC)
    else:
        write_by_python_can(path)
    row, frames = row_of(path)
    assert row == table()[suffix]
    assert [(one.can_id, one.is_extended, one.data) for one in frames] == [
        (0x123, False, b"\1\2"), (0x123, True, b"\3"), (0x125, False, FD_DATA),
    ]  # fmt: skip
    if row["channel"] == "kept":
        assert frames[0].channel == frames[2].channel != frames[1].channel
