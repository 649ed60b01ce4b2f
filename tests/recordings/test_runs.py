"""Runs of records, read by the parsers in C: the frames, and the error, of frame by frame."""

from __future__ import annotations

import gzip
import io
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest
from support.recordings import frames_of

from maplines_can.bus import LogFrame, read_log
from maplines_can.recordings.blocks import read_blocks
from maplines_can.values.errors import LogError

LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
#: Rows of candump that are not of the strict form, and rows that are wrong.
OTHER_ROWS = [
    "", "\t", "(12.5) can0 123#R", "(12.5) can0 123#R4", "(12.5) can0 20000004#0000000000000000",
    "(1) can0 12#00", " (1700000003.5)  can0  123#00", "(1700000003.25) can0 123#0",
    "(1700000003.25) can0 123##", "(1700000003.25) can0 123##1" + "00" * 65,
    "(1700000003.25) can0 3FFFFFFF#", "(1700000003.25) c\xe4n0 123#00 R", "(x) can0 123#00",
    "(1700000003.123456789123) can0 123#00", "(99999999999.0) can0 123#00", "\x00", "garbage",
    "(1700000003.25) can0 123#00_4", "(1700000003.25) can0 123#00 X", "(.5) can0 123#00",
    "(1700000003.) can0 123#00", "can0  123   [2]  11 22", " (001.000000)  can0  123   [1]  11",
    "(1700000003.25)\tcan0 123#00", "(1700000003.25) can0 123#00\r(1700000004.0) can0 7ff#aA",
    "(0000000003.25) can0 123#00", "(1700000003.25) " + "n" * 70 + " 123#00", "y" * 70_000,
]  # fmt: skip
#: The same for ASC.
OTHER_ASC_ROWS = [
    "", "   12.500000 1  ErrorFrame", "   12.500000 1  123             Rx   r 8",
    "   12.5 1 Statistic: D 1", "// comment", "Begin TriggerBlock Mon Sep 30 15:06:13.191 2017",
    "   12.5 1 123 Rx d 9 00", "   12.5 1 123 Rx d 2 00", "   12.5 1 123 Rx d 2 0 1",
    "   12.5 1 123 Rx d 0", "   12.5 0 123 Rx d 1 00", "   12.5 1 123 Rx d 1 00 Length = 22 x",
    "   12.5 1 FFFFFFFFx Rx d 1 00", "   12.5 1 zz Rx d 1 00", "  x 1 123 Rx d 1 00",
    "   12.5 CANFD 1 Rx 123 name 1 0 a 16 " + "00 " * 16, "   12.5 CANFD 1 Rx 123 1 0 a 15 00",
    "   12.5 CANFD 1 Rx 123 1 0 1 0 ", "   12.5 CANFD 1 Tx 123x 0 0 2 2 11 22 130000 130 0 0",
    "   12.5 1 123 Rx d 1 00\r   12.6 1 123 Rx d 1 11", "   12345678.5 1 123 Rx d 1 00",
    "   0.123456789 1 123 Rx d 1 \xff", "12.5 1 123 Rx D 1 00", "12.5 2 123 rx d 1 00",
    "12.000000 1  123  Rx   d 8 00 01 02 03 04 05 06 07 " + "y" * 5000,
]  # fmt: skip


def read(frames: Iterator[Any]) -> tuple[list[LogFrame], str]:
    """Return all frames and the text of the error at their end."""
    found: list[LogFrame] = []
    try:
        for one in frames:
            found += [one] if isinstance(one, LogFrame) else frames_of(one)
    except LogError as error:
        return found, str(error)
    return found, ""


def check_same(source: Path, *, has_error: bool | None = None) -> int:
    blocks, one = read_blocks(source), read_log(source)
    expected = read(one)
    assert read(blocks) == expected
    if source.suffix in (".log", ".asc", ".gz"):
        assert blocks.summary == one.summary
    assert read(read_blocks(source, block_frames=7)) == expected
    if has_error is not None:
        assert bool(expected[1]) == has_error
    return len(expected[0])


def frame(rng: random.Random, t: float) -> can.Message:
    length = rng.choice(LENGTHS)
    is_extended = rng.random() < 0.3
    return can.Message(
        timestamp=t,
        arbitration_id=rng.randrange(2**29 if is_extended else 2**11),
        is_extended_id=is_extended,
        data=rng.randbytes(length),
        is_fd=length > 8 or rng.random() < 0.2,
        bitrate_switch=False,
        channel=rng.randrange(3),
        is_rx=rng.random() < 0.5,
        is_remote_frame=False,
    )


def messages(seed: int, n: int = 300) -> list[can.Message]:
    """Data frames in random order of kinds, with some error and remote frames among them."""
    rng, found, t = random.Random(seed), [], [0.0, 1.7e9, 12.5][seed % 3]  # noqa: S311
    for _ in range(n):
        t += rng.choice([1e-4, 1e-3, 0.5])
        found.append(frame(rng, t))
        if rng.random() < 0.02:
            kind = rng.choice(["is_error_frame", "is_remote_frame"])
            found.append(can.Message(timestamp=t, arbitration_id=1, channel=0, **{kind: True}))
    return found


def written(path: Path, frames: list[can.Message]) -> Path:
    with can.Logger(str(path)) as log:
        for one in frames:
            log.on_message_received(one)
    return path


@pytest.mark.parametrize("suffix", ["log", "asc", "blf", "mf4"])
@pytest.mark.parametrize("seed", range(3))
def test_ordinary_logs(tmp_path: Path, suffix: str, seed: int) -> None:
    if suffix == "mf4":
        pytest.importorskip("asammdf", reason="asammdf is an optional dependency")
    assert check_same(written(tmp_path / f"a.{suffix}", messages(seed)), has_error=False) >= 290


@pytest.mark.parametrize("suffix", ["log", "asc", "blf"])
def test_damaged_logs(tmp_path: Path, suffix: str) -> None:
    """Bytes of a log that are changed, left out or repeated, and a log that ends early."""
    rng = random.Random(7)  # noqa: S311
    content = written(tmp_path / f"whole.{suffix}", messages(1, 120)).read_bytes()
    errors = 0
    for case in range(60):
        damaged = bytearray(content)
        for _ in range(rng.choice([1, 1, 5])):
            place = rng.randrange(0 if case % 4 else min(144, len(damaged)), len(damaged))
            match rng.randrange(4):
                case 0:
                    damaged[place] ^= 1 << rng.randrange(8)
                case 1:
                    del damaged[place : place + rng.randrange(1, 20)]
                case 2:
                    damaged[place:place] = damaged[place : place + rng.randrange(1, 20)]
                case _:
                    damaged[place] = rng.randrange(256)
        if case % 5 == 0:
            del damaged[rng.randrange(len(damaged)) :]
        path = tmp_path / f"damaged{case}.{suffix}"
        path.write_bytes(damaged)
        check_same(path)
        errors += bool(read(read_log(path))[1])
    assert errors > 5


def test_objects_of_an_unpacked_blf(tmp_path: Path) -> None:
    """Every byte of the heads and frames of a container, changed."""
    path = tmp_path / "plain.blf"
    with can.BLFWriter(path, compression_level=0) as log:
        for one in messages(2, 6):
            log.on_message_received(one)
    content = path.read_bytes()
    for place in range(144, len(content), 3):
        path.write_bytes(content[:place] + bytes([content[place] ^ 0x41]) + content[place + 1 :])
        check_same(path)


@pytest.mark.parametrize(("suffix", "others"), [("log", OTHER_ROWS), ("asc", OTHER_ASC_ROWS)])
def test_rows_of_other_forms(tmp_path: Path, suffix: str, others: list[str]) -> None:
    """Each alone among ordinary ones, and all of them."""
    text = written(tmp_path / f"whole.{suffix}", messages(1, 12)).read_text()
    rows = text.splitlines()
    half = len(rows) - 6
    for number, other in enumerate([*others, "\n".join(others)]):
        path = tmp_path / f"{number}.{suffix}"
        for end in ("\n", "\r\n"):
            path.write_bytes(end.join([*rows[:half], other, *rows[half:]]).encode("latin-1"))
            check_same(path)


#: Stamps [s], and the kind that they are found to have.
STAMPS = {
    "delta": ([5.0, 4.9, 1.0, 0.2, 9.0, 0.1, 0.1], "delta"),
    "delta, beyond 64 bits later": ([0.0, 0.1, 0.05, 0.1, 8e9, 8e9, 0.1], "absolute"),
    "zero, two recordings": ([*range(40), *range(30), 40, 39.95, 39.8, 41], "zero"),
    "absolute": ([1.7e9, 1.6e9, 0.5], "absolute"),
    "zero, then absolute": ([0.0, 0.0, 0.0, 1.7e9, 1.7e9], "absolute"),
}


@pytest.mark.parametrize("times", ["auto", "absolute", "zero", "delta"])
@pytest.mark.parametrize("case", STAMPS)
@pytest.mark.parametrize("suffix", ["log", "asc"])
def test_kinds_of_time_stamps(tmp_path: Path, suffix: str, case: str, times: Any) -> None:
    """C and Python have the same times, notices and errors, of each kind."""
    stamps, kind = STAMPS[case]
    path = tmp_path / f"a.{suffix}"
    row = "({:.6f}) can0 123#00\n" if suffix == "log" else " {:.6f} 1  123  Rx  d 1 00\n"
    path.write_text("".join(row.format(stamp) for stamp in stamps))
    one, blocks = read_log(path, times=times), read_blocks(path, times=times)
    assert read(blocks) == read(one)
    assert blocks.summary == one.summary
    assert one.summary.times == (kind if times == "auto" else times)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r", ""])
def test_ends_of_lines(tmp_path: Path, end: str) -> None:
    path = tmp_path / "a.log"
    path.write_bytes(end.join(f"({k}.5) can0 123#00" for k in range(9)).encode())
    assert check_same(path, has_error=not end) == 9 * bool(end)


@pytest.mark.parametrize("suffix", ["log", "asc", "blf"])
def test_compressed_and_truncated(tmp_path: Path, suffix: str) -> None:
    content = gzip.compress(written(tmp_path / f"a.{suffix}", messages(0, 2000)).read_bytes())
    path = tmp_path / f"a.{suffix}.gz"
    for end in (len(content), len(content) // 2):
        path.write_bytes(content[:end])
        check_same(path, has_error=end < len(content))


class Pipe(io.BufferedReader):
    """Stream that gives what has arrived, and notes what was asked for too early."""

    def __init__(self, parts: list[bytes]) -> None:
        super().__init__(io.BytesIO(b"".join(parts)))
        self._parts = parts

    def peek(self, _size: int = 0) -> bytes:
        return self._parts[0] if self._parts else b""

    def read1(self, _size: int = -1) -> bytes:
        return self._parts.pop(0) if self._parts else b""

    @property
    def left(self) -> int:
        return len(self._parts)


def test_a_block_of_a_pipe_has_what_has_arrived() -> None:
    """No frame waits for one that has not been sent, also after a part of a row."""
    parts = [b"(1.0) can0 1", b"23#00\n(2.0) can0 123#01\n(3.0) ", b"can0 123#02\n"]
    pipe: Any = Pipe([*parts])
    seen = [(len(block), pipe.left) for block in read_blocks(pipe, times="zero")]
    assert seen == [(2, 1), (1, 0)]


def test_blocks_have_one_numbering_of_channels(tmp_path: Path) -> None:
    """Channels of runs and of single rows, first seen in either."""
    path = tmp_path / "a.log"
    rows = ["(1.0) b 123#00", " (1.0) a 123#00", "(1.0) c 123#00", "(1.0) a 123#00", " (1.0) c 1#"]
    path.write_text("\n".join(rows) + "\n(1.0) d 123#00\n")
    check_same(path)
    *_, last = _blocks(path)
    assert last.channels == ("b", "a", "c", "d")


@pytest.mark.parametrize("suffix", ["log", "asc", "blf"])
def test_more_channels_than_the_core_knows(tmp_path: Path, suffix: str) -> None:
    """The frames of the others are read one by one; the log goes on as before."""
    numbers = [*range(300), *range(250, 280), 0]
    frames = [
        can.Message(timestamp=1.7e9 + 1e-3 * k, arbitration_id=1, data=[k % 256], channel=number)
        for k, number in enumerate(numbers)
    ]
    assert check_same(written(tmp_path / f"a.{suffix}", frames), has_error=False) == len(frames)


def _blocks(path: Path) -> Iterator[Any]:
    try:
        yield from read_blocks(path, block_frames=1)
    except LogError:
        return


def test_a_block_has_a_frame_at_least(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="block_frames must be 1 frame or more"):
        read_blocks(tmp_path / "drive.log", block_frames=0)
