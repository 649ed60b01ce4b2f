"""Logs of other tools: what is kept, and reading up to and beyond the damage."""

import contextlib
import gzip
import io
import random
import re
from pathlib import Path
from typing import Any

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplines_can.bus import (
    LogFrame,
    Skipped,
    read_log,
)
from maplines_can.values.errors import LogError, MissingExtraError

LOGGED = [
    can.Message(timestamp=100.0, arbitration_id=0x123, is_extended_id=False, data=b"12345678"),
    can.Message(timestamp=100.25, arbitration_id=0x123, is_extended_id=True, data=b""),
    can.Message(timestamp=100.5, arbitration_id=0x100, is_extended_id=False, is_remote_frame=True),
    can.Message(timestamp=100.5, is_error_frame=True),
    can.Message(timestamp=101.0, arbitration_id=0x1ABCDEF0, is_extended_id=True, data=b"\xff\x00"),
]


CSV_HEADER = "timestamp,arbitration_id,extended,remote,error,dlc,data"


def written(path: Any, messages: Any) -> Any:
    """The path of a log, written by python-can."""
    if path.name.endswith(".blf.gz"):  # python-can reads these, but does not write them
        path.write_bytes(gzip.compress(written(path.with_suffix(""), messages).read_bytes()))
        return path
    for message in messages:
        message.channel = 1
    writer = can.Logger(path)
    try:
        for message in messages:
            if isinstance(writer, can.TRCWriter) and message.is_error_frame:
                continue  # the writer would write these as data frames
            writer.on_message_received(message)
        while isinstance(writer, can.SqliteWriter) and writer.num_frames < len(messages):
            assert writer._writer_thread.is_alive()  # else stop() would lose the rest
    finally:
        writer.stop()
    return path


@pytest.mark.parametrize("suffix", ["asc", "blf", "csv", "log"])
def test_a_compressed_log_is_read_as_it_is(tmp_path: Path, suffix: str) -> None:
    frames = list(read_log(written(tmp_path / f"drive.{suffix}", LOGGED)))
    assert [(f.can_id, f.data, f.has_time) for f in frames] == [
        (m.arbitration_id, bytes(m.data), True)
        for m in LOGGED
        if not (m.is_error_frame or m.is_remote_frame)
    ]
    assert list(read_log(written(tmp_path / f"drive.{suffix}.gz", LOGGED))) == frames


def read_until_error(path: Any) -> Any:
    frames: list[Any] = []
    with pytest.raises(LogError) as caught:
        frames.extend(read_log(path))
    assert "\n" not in str(caught.value)
    return frames, str(caught.value).removeprefix(str(path))


TRC = ";$FILEVERSION={}\n;$STARTTIME=40000.0\n"
#: By name: the suffix, the header and a good row of a text format, and rows that are damaged.
DAMAGED_ROWS: dict[str, tuple[str, str, str, list[str]]] = {
    "candump": ("log", "", "(1.5) can0 340#0001", [
        "  can0  340   [8]  11 22 33",
        "  can0  340   [1]  11 22",
        "  can0  340   [65] " + " 11" * 65,
        "  can0  FFFFFFFF   [1]  11",
        "  can0  34   [1]  11",
        "  can0  340   [1]  1",
        "  can0  340   [1]",
        "(one) can0 340#11",
        "(1.5) can0 340#111",
        "(2020-13-40 99:00:00.0)  can0  340   [1]  11",
        "340   [1]  11",
        "(1.5) can0 40000000#11",
        f"(1.5) can0 340##0{'11' * 65}",
        f"({'9' * 400}) can0 340#00",
        f"({'9' * 5000}) can0 340#00",
        "(9223372036.854775808) can0 340#00",  # 64 bits of nanoseconds end before
        f"(1.5) can0 340{' ' * 60_000}x",
        f"(1.5) can0 340 [1] 00{' ' * 60_000}x",
        "(1.5) can0 1\xff3#0001",
    ]),
    "asc": ("asc", "base hex timestamps absolute\n", " 0.1 1 340 Rx d 2 00 01", [
        f" 0.2 {row}"
        for row in (
            *("1", "1 34", "1 340", "1 340 R", "1 340 Rx", "1 340 Rx d", "1 340 Rx d 2"),
            *("1 340 Rx d 2 00", "1 340 Rx d 2 00 1", "1 340 Rx d 9 00", "1 340 Rx x 1 00"),
            *("CANFD 1", "CANFD 1 Rx", "CANFD 1 Rx 340  1 0 9 12 00", "CANFD 1 Rx 340  1 0 9"),
            *("1 zz Rx d 1 00", "1 3FFFFFFFx Rx d 1 00", "1 340 Rx d 1 0_0"),
            "1 123 Rx d 2 00 \xff",
        )
    ]),
    "csv": ("csv", CSV_HEADER + "\n", "1.5,0x340,0,0,0,2,AAE=", [
        *("2.5,0x18ebff00,1,0,0,1,Kg==\n"[:n] for n in range(18, 26)), "1.5,\xff,0",
    ]),
    "trc-1.0": ("trc", "; no version\n", " 1) 1298.945 0400 2 00 01", [
        "1) 1059", "1) 1059 0300",
    ]),
    "trc-1.1": ("trc", TRC.format("1.1"), "  1)  1500.0  Rx  0340  2  00 01", [
        "1) 1059 Rx", "1) 1059 Rx 0300", "1) 1059 Rx 0300 2 00", "1) 1059 Rx 0300 1 00 00",
        "1) 1059 Rx 3FFFFFFF 1 00", "1) 1059 R9 0300 1 00", "1) 1059 Rx 0123  2  00 \xff",
    ]),
    "trc-2.1": ("trc", TRC.format("2.1") + ";$COLUMNS=N,O,T,B,I,d,R,L,D \n",
                " 1 1059.900 DT 1 0300 Rx - 2 00 01", [
        "1 1059 FD 1 0300 Rx - 16 " + "00 " * 64, "1 1059 FD 1 0300 Rx - -1 " + "00 " * 64,
        "1 1059 FD 1 0300 Rx - 9 " + "00 " * 9,
    ]),
}  # fmt: skip


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(
    ("suffix", "header", "good", "bad"),
    [
        pytest.param(suffix, header, good, bad, id=f"{name}-{bad[:40]}")
        for name, (suffix, header, good, rows) in DAMAGED_ROWS.items()
        for bad in rows
    ],
)
def test_a_damaged_row_costs_only_itself(
    tmp_path: Path, suffix: str, header: str, good: str, bad: str, packed: bool
) -> None:
    """The rows before, between and after the damage are read, then the error is raised.

    The last row is damaged, too, and cut: it has no end of line.
    """
    content = (header + f"{good}\n{bad}\n" * 2 + f"{good}\n{bad}").encode("latin-1")
    path = tmp_path / (f"drive.{suffix}.gz" if packed else f"drive.{suffix}")
    path.write_bytes(gzip.compress(content) if packed else content)
    frames, text = read_until_error(path)

    assert [f.data for f in frames] == [b"\x00\x01"] * 3
    first = header.count("\n") + 2
    assert text.startswith(f": 3 of 6 records are damaged (the first: line {first}: ")
    assert len(text) < 400


@pytest.mark.parametrize("suffix", ["blf", "log.gz", "blf.gz", "db"])
def test_a_truncated_file_is_read_up_to_its_end(tmp_path: Path, suffix: str) -> None:
    rng = random.Random(1)  # noqa: S311 - not a secret
    messages = [
        can.Message(timestamp=100 + i, arbitration_id=i % 2048, data=rng.randbytes(8))
        for i in range(20_000 if suffix != "db" else 500)
    ]
    path = written(tmp_path / f"drive.{suffix}", messages)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * 0.6)])
    frames, text = read_until_error(path)

    if suffix != "db":  # sqlite does not open half a file
        assert len(messages) * 0.2 < len(frames) < len(messages) * 0.7
        assert f"after {len(frames)} good records" in text
    assert [f.can_id for f in frames] == [m.arbitration_id for m in messages[: len(frames)]]


@pytest.mark.parametrize("suffix", [".blf", ".db", ".blf.gz", ".log.gz", ".csv", ".log", ".asc"])
def test_a_file_of_something_else_is_one_clear_error(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"drive{suffix}"
    path.write_bytes(b"This is not a log.\n" * 20)
    frames, text = read_until_error(path)

    assert frames == []
    if suffix == ".asc":
        assert "line 20: it has neither a header nor frames: 'This is not a log.')" in text
    if suffix == ".log":
        assert "none of 20 records can be read (line 1: " in text
        assert text.endswith("; the content is no format that is known, such as candump's")


def test_a_file_that_is_only_said_to_be_compressed_is_one_clear_error(tmp_path: Path) -> None:
    """Its first two bytes are those of gzip."""
    path = tmp_path / "drive.log.gz"
    path.write_bytes(b"\x1f\x8b but no header of gzip")
    frames, text = read_until_error(path)
    assert frames == []
    assert text.startswith(": not a valid log (")


@pytest.mark.parametrize("name", ["drive.txt.gz", "drive.txt"])
def test_a_binary_log_with_the_suffix_of_a_text(tmp_path: Path, name: str) -> None:
    """Its content tells the format; it is read unless it is compressed."""
    content = written(tmp_path / "drive.blf", LOGGED).read_bytes()
    path = tmp_path / name
    if name.endswith(".gz"):
        path.write_bytes(gzip.compress(content))
        frames, text = read_until_error(path)
        assert frames == []
        assert text == ": a log in the format .blf is read from a file only, not compressed"
    else:
        path.write_bytes(content)
        assert len(list(read_log(path))) == 3


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("missing.log", "there is no such file"),
        ("missing.db", "there is no such file"),
        ("drive.mp4", "the format '.mp4' is unknown; use .asc, .blf, .crtd, .csv, .db, .log, .m"),
        ("drive", "there is no such file"),
        ("drive.gz", "there is no such file"),
        ("", "is not a file"),
        ("drive.db.gz", ".db cannot be read while compressed; use gunzip first"),
    ],
)
def test_what_cannot_be_read_raises_at_once(tmp_path: Path, name: str, words: str) -> None:
    with pytest.raises(LogError) as caught:
        read_log(tmp_path / name)
    assert words in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("source", [io.BytesIO(b"(1.5) can0 340#00"), b"drive.log", 7])
def test_what_is_no_log_is_refused_at_once(source: Any) -> None:
    """A stream must allow a look ahead, which tells the format."""
    with pytest.raises(TypeError, match="source must be a path, or a stream of bytes with peek"):
        read_log(source)


def test_mf4_without_its_package_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("maplines_can.logs.log_reader.find_spec", lambda _: None)
    path = tmp_path / "drive.mf4"
    path.touch()
    with pytest.raises(MissingExtraError, match=r'pip install -e "\.\[mf4\]"'):
        read_log(path)


@given(st.binary(max_size=300), st.sampled_from(["asc", "blf", "csv", "log", "trc", "log.gz"]))
def test_random_content_raises_log_error_at_worst(
    tmp_path_factory: pytest.TempPathFactory, content: bytes, suffix: Any
) -> None:
    """Whatever a file contains."""
    path = tmp_path_factory.getbasetemp() / f"any.{suffix}"
    header = {"asc": b"base hex\n", "csv": b"t\n", "trc": b";$FILEVERSION=1.1\n", "blf": b"LOGG"}
    path.write_bytes(header.get(suffix, b"") + content)
    with contextlib.suppress(LogError, MissingExtraError):  # asammdf is asked for by its magic
        list(read_log(path))


@pytest.mark.parametrize("suffix", ["asc", "blf", "csv", "log", "trc"])
def test_a_log_without_frames_is_no_error(tmp_path: Path, suffix: str) -> None:
    """A recording of a silent bus has no good and no damaged record."""
    assert list(read_log(written(tmp_path / f"silent.{suffix}", []))) == []


@pytest.mark.parametrize("version", ["2.0", "9.9"])
def test_a_trc_log_of_unknown_columns_is_one_clear_error(tmp_path: Path, version: str) -> None:
    """A version that is not known, or one whose header must have the columns and has none."""
    path = tmp_path / "drive.trc"
    path.write_text(f";$FILEVERSION={version}\n   1   1059.9 DT 0300 Rx 1 00\n")
    frames, text = read_until_error(path)

    assert frames == []
    assert f"(line 2: the columns of version '{version}' of TRC are not known)" in text


PAGE = Path(__file__).parents[2] / "docs" / "recordings.md"
FD_DATA = bytes(range(48))
COLUMNS = ("channel", "CAN FD", "time stamps", "remote frames", "error frames")
#: A log in PEAK's format 2.1, whose lengths are DLCs: two channels, a remote and an error frame.
PEAK_LOG = f""";$FILEVERSION=2.1
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
    return {
        suffix.replace("-L", ".log"): dict(zip(COLUMNS, row[1:], strict=True))
        for row in rows
        if row[0].startswith(("`", "candump"))
        for suffix in re.findall("`(.*?)`", row[0])
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
        path.write_text(PEAK_LOG)
    else:
        write_by_python_can(path)
    row, frames = row_of(path)
    assert row == table()[suffix]
    assert [(one.can_id, one.is_extended, one.data) for one in frames] == [
        (0x123, False, b"\1\2"), (0x123, True, b"\3"), (0x125, False, FD_DATA),
    ]  # fmt: skip
    if row["channel"] == "kept":
        assert frames[0].channel == frames[2].channel != frames[1].channel
