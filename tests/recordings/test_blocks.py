"""Blocks of a log: the frames of the reader frame by frame, whatever the size of a block."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.recordings import frames_of

from maplines_can.bus import read_log
from maplines_can.recordings.blocks import read_blocks
from maplines_can.values.errors import LogError

CANDUMP = """\
(1.000000) can0 340#0102030405060708
(1.000100) can1 18FEF100#11
(1.000200) can0 123##1000102030405060708090A0B0C0D0E0F
(1.000300) can0 7FF#
"""


@pytest.mark.parametrize("block_frames", [1, 2, 3, 1000])
def test_the_frames_are_those_of_read_log(tmp_path: Path, block_frames: int) -> None:
    path = tmp_path / "drive.log"
    path.write_text(CANDUMP)
    found = [f for b in read_blocks(path, block_frames=block_frames) for f in frames_of(b)]
    assert found == list(read_log(path))


def test_an_error_comes_after_the_last_good_frame(tmp_path: Path) -> None:
    path = tmp_path / "drive.log"
    path.write_text(CANDUMP + "(2.0) can0 340#0\n(2.1) can0 340#\n")
    blocks = read_blocks(path, block_frames=2)
    assert [len(next(blocks)) for _ in range(3)] == [2, 2, 1]
    with pytest.raises(LogError, match="1 of 6 records are damaged"):
        next(blocks)


def test_a_block_has_a_frame_at_least(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="block_frames must be 1 frame or more"):
        read_blocks(tmp_path / "drive.log", block_frames=0)
