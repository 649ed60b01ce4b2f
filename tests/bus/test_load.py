"""Bits of a frame are the published bounds."""

import contextlib
import re
from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.scene_streams import COMPLETE, CONDITIONAL, codec_of, new_codec, road_scene

from maplines_can import Slot
from maplines_can.bus import (
    bus_load,
    frame_bits,
    frame_time,
    transfers_within,
)
from maplines_can.wire import Frame


@pytest.mark.parametrize("length", range(9))
def test_bits_of_classic_frames_are_the_published_ones(length: Any) -> None:
    """Davis et al. 2007, equation 1: stuff bits for each 4 bits after the first up to the CRC."""
    for is_extended, g in ((False, 34), (True, 54)):
        bits = g + 8 * length + 13 + (g + 8 * length - 1) // 4
        assert frame_bits(length, is_extended=is_extended) == (bits, 0)


@pytest.mark.parametrize(
    ("length", "is_extended", "bits"),
    [
        pytest.param(0, False, (34, 5 + 1 + 27), id="empty"),
        pytest.param(8, False, (34, 69 + 17 + 27), id="8-bytes"),
        pytest.param(16, False, (34, 133 + 33 + 27), id="last-with-crc-17"),
        pytest.param(20, False, (34, 165 + 41 + 32), id="first-with-crc-21"),
        pytest.param(32, True, (57, 261 + 66 + 32), id="32-bytes-29-bit"),
        pytest.param(64, False, (34, 517 + 129 + 32), id="64-bytes"),
    ],
)
def test_bits_of_can_fd_frames(length: int, is_extended: bool, bits: Any) -> None:
    """Counted by hand: fields + stuff bits + CRC field."""
    assert frame_bits(length, is_extended=is_extended, is_fd=True) == bits


def test_bus_load_of_lines() -> None:
    """Eight lines every 50 ms at 500 kbit/s: four classic frames or one of CAN FD each."""
    classic = [Frame(0x100, bytes(8))] * 32
    fd = [Frame(0x100, bytes(32), is_fd=True)] * 8

    assert bus_load(classic, 0.05, 500e3) == pytest.approx(32 * 135 / 500e3 / 0.05)
    assert bus_load(fd, 0.05, 500e3, 2e6) == pytest.approx(8 * (34 / 500e3 + 358 / 2e6) / 0.05)
    assert frame_time(fd[0], 500e3) == pytest.approx(392 / 500e3)


def test_can_fd_has_exactly_the_lengths_of_its_dlcs() -> None:
    """ISO 11898-1: DLC 9 to 15 are 12, 16, 20, 24, 32, 48 and 64 bytes."""
    known = []
    for length in range(66):
        with contextlib.suppress(ValueError):
            frame_bits(length, is_fd=True)
            known.append(length)
    assert known == [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64]


def test_bus_time_of_scenes_as_the_page_says() -> None:
    """Of lines one by one, with a message of the pose error, and as whole scenes."""
    page = (Path(__file__).parents[2] / "docs" / "joint.md").read_text()
    rows = re.findall(r"^\| (\d) \| " + r"([\d.]+) ms \| " * 5 + r"([\d.]+) \|$", page, re.M)
    assert [row[0] for row in rows] == ["2", "4", "8"]
    for lines, *texts in rows:
        scene = road_scene(list(Slot)[: int(lines)])
        found = [
            time_of(chain(*codec_of(COMPLETE).encoder().encode_lines(scene.lines, fd=fd)))
            for fd in (False, True)
        ]
        for dbc, fd in ((CONDITIONAL, False), (CONDITIONAL, True), ("maplines-scene.dbc", True)):
            frames = new_codec(dbc).encoder().encode_scene(scene, fd=fd)
            found.append(time_of(chain(*frames.values())))
        found.append(found[-1] / found[-2])
        assert [f"{value:.2f}" for value in found] == texts
    assert float(rows[1][-1]) < 0.4


def time_of(frames: Iterable[Frame]) -> float:
    """Return how long frames take on a bus of 500 kbit/s and 2 Mbit/s [ms]."""
    return 1e3 * sum(frame_time(frame, 500_000, 2_000_000) for frame in frames)


@given(st.floats(1e-4, 1), st.floats(1e-3, 1), st.sampled_from([125e3, 500e3, 1e6]), st.booleans())
def test_transfers_within_a_share(share: float, period: float, bitrate: Any, fd: bool) -> None:
    """They fit, and one more does not."""
    transfer = [Frame(0x100, bytes(32), is_fd=True)] if fd else [Frame(0x100, bytes(8))] * 4
    n = transfers_within(share, transfer, period, bitrate)
    assert bus_load(transfer * n, period, bitrate) <= share * (1 + 1e-9)
    assert bus_load(transfer * (n + 1), period, bitrate) > share


@pytest.mark.parametrize("n", [1, 3, 13, 64])
def test_a_share_filled_to_the_last_bit(n: int) -> None:
    """Rounding does not remove a transfer."""
    transfer = [Frame(0x100, bytes(8))] * 4
    assert transfers_within(bus_load(transfer * n, 0.1, 5e5), transfer, 0.1, 5e5) == n


def test_all_of_the_bus_time_may_be_used() -> None:
    """A classic frame of no data has 55 bits."""
    assert transfers_within(1.0, [Frame(0x100, b"")], 1.0, 110) == 2
    assert transfers_within(1.0, [Frame(0x100, b"")], 1.0, 109) == 1
