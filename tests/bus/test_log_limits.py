"""No log fills the memory, whatever it contains or claims; what is good in it is read."""

import gzip
import io
import sqlite3
import struct
import zlib
from pathlib import Path

import can
import pytest
from support.bombs import MB, MOST, SIZE, deflated, gzipped, read_in_little_memory
from support.captures import Style, interface, pcap, section

from maplines_can.bus import LogFrame, read_log
from maplines_can.logs.frame_block import MAX_OBJECT
from maplines_can.logs.mf4_log import check_mf4_blocks
from maplines_can.logs.text_lines import MAX_DAMAGE
from maplines_can.values.errors import LogError
from maplines_can.values.input_files import MAX_LINE

HEADERS = {
    "log": "",
    "crtd": "0.000001 CXX OVMS CRTD\n",
    "asc": "date Fri Nov 21 2025\nbase hex  timestamps absolute\nno internal events logged\n",
    "csv": "timestamp,arbitration_id,extended,remote,error,dlc,data\n",
    "trc": ";$FILEVERSION=1.1\n;$STARTTIME=40000.0\n",
}
ROWS = {
    "log": "(1.5) can0 340#0001\n",
    "crtd": "1.5 1R11 340 00 01\n",
    "asc": " 1.5 1  340  Rx  d 2 00 01\n",
    "csv": "1.5,0x340,0,0,0,2,AAE=\n",
    "trc": "  1)  1500.0  Rx  0340  2  00 01\n",
}
COLUMNS = "ts REAL, arbitration_id INTEGER, extended, remote, error, dlc INTEGER, data BLOB"
#: Tables and views that are no tables of frames, and the reason.
SCHEMAS = {
    "blob": (
        f"CREATE TABLE messages({COLUMNS});"
        f"INSERT INTO messages VALUES(1.5, 832, 0, 0, 0, 2, zeroblob({32 * MB}))",
        "too big",
    ),
    "bytes-by-their-number": (
        f"CREATE TABLE messages({COLUMNS});"
        f"INSERT INTO messages VALUES(1.5, 832, 0, 0, 0, 2, {SIZE * MB})",
        "a blob as data",
    ),
    "expression": (
        f"CREATE TABLE messages({COLUMNS} AS (zeroblob(({SIZE * MB}))));"
        "INSERT INTO messages VALUES(1.5, 832, 0, 0, 0, 2)",
        "too big",
    ),
    "endless-view": (
        "CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
        "SELECT i, 832, 0, 0, 0, 2, x'0000' FROM n",
        "it has a view named messages",
    ),
    "long-statement": (
        f"CREATE TABLE messages({COLUMNS}); CREATE VIEW other AS SELECT '{'a' * MB}'",
        "too big",
    ),
    "other-columns": ("CREATE TABLE messages(a); INSERT INTO messages VALUES(1)", "7 columns"),
    "no-table": ("CREATE TABLE other(a)", "it has no table named messages"),
}


def blf_head(folder: Path) -> bytes:
    """The header of a BLF file."""
    with can.BLFWriter(folder / "silent.blf"):
        pass
    return (folder / "silent.blf").read_bytes()[:144]


def blf_object(size: int, kind: int = 10) -> bytes:
    """The head of an object of a BLF file."""
    return struct.pack("<4sHHLL", b"LOBJ", 16, 1, size, kind)


def blf_container(packed: bytes) -> bytes:
    """An object of packed objects."""
    size = 32 + len(packed)
    return blf_object(size) + struct.pack("<H14x", 2) + packed + bytes(size % 4)


def write_bombs(folder: Path) -> dict[str, str]:
    """Write the files; return the reasons for which they are not read, by name."""
    reasons = {}
    for suffix, header in HEADERS.items():
        data = gzipped((header + ROWS[suffix]).encode(), b"a")
        (folder / f"endless.{suffix}.gz").write_bytes(data)
        reasons[f"endless.{suffix}.gz"] = f"has more than {MAX_DAMAGE} characters"
    for name, (script, reason) in SCHEMAS.items():
        database = sqlite3.connect(folder / f"{name}.db")
        database.executescript(script)
        database.close()
        reasons[f"{name}.db"] = reason
    head, huge = blf_head(folder), 2**32 - 16
    many = blf_container(zlib.compress(bytes(MB), 9)) * SIZE
    long = gzip.compress(bytes(MB)) * SIZE
    blfs = {
        "unpacked.blf": (head + blf_container(deflated()), "when it is unpacked"),
        "object-in-many-containers.blf": (
            head + blf_container(zlib.compress(blf_object(huge, 65))) + many,
            "an object in containers has more than",
        ),
        "object.blf.gz": (gzip.compress(head + blf_object(huge)) + long, f"has {huge} bytes"),
        "object-of-0.blf.gz": (gzip.compress(head + blf_object(0)) + long, "has 0 bytes"),
        "header.blf.gz": (
            gzip.compress(head[:4] + struct.pack("<L", huge) + head[8:]) + long,
            f"its header has {huge} bytes",
        ),
        "header-of-0.blf.gz": (
            gzip.compress(head[:4] + bytes(4) + head[8:]) + long,
            "its header has 0 bytes",
        ),
    }
    ng = Style(is_ng=True)
    captures = {
        "packet.pcap.gz": (
            pcap([], Style()) + struct.pack("<4L", 0, 0, huge, huge),
            "a record has",
        ),
        "block.pcapng.gz": (section() + struct.pack("<2L", 6, huge), f"a record has {huge} bytes"),
        "interfaces.pcapng.gz": (section() + interface(ng) * 300, "it has more than 256 interfac"),
    }
    blfs |= {name: (gzip.compress(data) + long, why) for name, (data, why) in captures.items()}
    for name, (data, reason) in blfs.items():
        (folder / name).write_bytes(data)
        reasons[name] = reason
    return reasons


def test_no_log_fills_the_memory(tmp_path: Path) -> None:
    """A process of 300 MB reads what is good, and says in one line why the rest is not read."""
    reasons = write_bombs(tmp_path)
    rows = ROWS["log"].encode() * 50_000
    (tmp_path / "drive.log.gz").write_bytes(gzip.compress(rows, 1) * 3)
    read = "from maplines_can.bus import read_log as read\n"
    names = [*reasons, "drive.log.gz"]
    outcomes = read_in_little_memory(read, [tmp_path / name for name in names])
    assert outcomes.pop("drive.log.gz")[:2] == (150_000, "")
    assert max(outcome.peak for outcome in outcomes.values()) < MOST
    for name, reason in reasons.items():
        count, text, _ = outcomes[name]
        assert text.startswith(f"LogError: {tmp_path / name}: "), name
        assert reason in text, name
        assert len(text) < len(str(tmp_path)) + 300
        assert "\n" not in text
        assert count == name.startswith("endless."), name


@pytest.mark.parametrize("suffix", HEADERS)
@pytest.mark.parametrize("beyond", [-2, -1, 0, 1, 10 * MAX_LINE])
def test_a_line_that_is_too_long_costs_only_itself(
    tmp_path: Path, suffix: str, beyond: int
) -> None:
    """As other damage: the lines before and after it are read, and it is counted."""
    row = ROWS[suffix]
    long = row.rstrip("\n") + " " * (MAX_LINE + beyond - len(row)) + "\n"
    path = tmp_path / f"drive.{suffix}"
    path.write_text(HEADERS[suffix] + row + long + row)
    frames: list[LogFrame] = []
    if beyond <= 0:
        assert len([*read_log(path)]) == 3
        return
    with pytest.raises(LogError) as caught:
        frames.extend(read_log(path))
    assert len(frames) == 2
    reason = f"line {HEADERS[suffix].count(chr(10)) + 2}: has more than {MAX_LINE} characters"
    assert str(caught.value).endswith(f": 1 of 3 records are damaged (the first: {reason})")


class Endless(io.RawIOBase):
    """Input without an end and without a line break, such as /dev/zero."""

    def __init__(self) -> None:
        self.given = 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        buffer[:] = bytes(len(buffer))
        self.given += len(buffer)
        return len(buffer)


def test_a_pipe_without_a_line_break_is_not_read_for_ever() -> None:
    stream = Endless()
    with pytest.raises(LogError, match=f"not read further .*line 1 has more than {MAX_DAMAGE} ch"):
        list(read_log(io.BufferedReader(stream)))
    assert stream.given < 2 * MAX_DAMAGE


@pytest.mark.parametrize("place", [64, MAX_OBJECT - 40, MAX_OBJECT - 4])
@pytest.mark.parametrize("field", [32, 40])
def test_a_large_block_of_an_mf4_log_is_refused(tmp_path: Path, place: int, field: int) -> None:
    """Unpacked or packed; asammdf would unpack it as a whole."""
    path = tmp_path / "drive.mf4"
    block = bytearray(struct.pack("<4s4x5Q", b"##DZ", 48, 0, 0, MAX_OBJECT, MAX_OBJECT))
    path.write_bytes(bytes(place) + block + bytes(64))
    check_mf4_blocks(path)
    struct.pack_into("<Q", block, field, MAX_OBJECT + 1)
    path.write_bytes(bytes(place) + block + bytes(64))
    with pytest.raises(ValueError, match=f"a compressed block has {MAX_OBJECT + 1} bytes"):
        check_mf4_blocks(path)
