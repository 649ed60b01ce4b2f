"""The first frames of each CAN ID are kept, within bounds, from frames and from blocks alike."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from maplines_can.bus import LogFrame
from maplines_can.logs import first_frames
from maplines_can.logs.first_frames import CanId, FirstFrames, ids_text
from maplines_can.logs.frame_block import block_of


def frame(number: int, t_ns: int = 0, *, is_extended: bool = False) -> LogFrame:
    return LogFrame(number, t_ns.to_bytes(4, "big"), t_ns, is_extended, "can0", has_time=True)


def stream(n: int) -> list[LogFrame]:
    """Return frames of a frequent and of a rare ID, which is also there as an extended one."""
    rng = np.random.default_rng(1)
    numbers = rng.choice([0x100, 0x340], n, p=[0.9, 0.1])
    return [frame(int(k), t, is_extended=t % 7 == 0) for t, k in enumerate(numbers)]


def kept(first: FirstFrames) -> list[int]:
    """Return the times of the frames that are kept."""
    return [int(t) for block in first.blocks() for t in block.t_ns]


@pytest.mark.parametrize("size", [1, 7, 1000])
def test_the_first_frames_of_each_id_are_kept(size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many of a rare ID as of a frequent one; blocks of any size keep the same as frames do."""
    monkeypatch.setattr(first_frames, "MAX_EACH", 5)
    frames, single, blocks = stream(1000), FirstFrames(), FirstFrames()
    numbers: dict[str, int] = {}
    for one in frames:
        single.add(one)
    for k in range(0, len(frames), size):
        blocks.add_block(block_of(frames[k : k + size], numbers))
    seen: Counter[CanId] = Counter()
    expected = []
    for one in frames:
        key = CanId(one.can_id, one.is_extended)
        seen[key] += 1
        expected += [one.t_ns] * (seen[key] <= 5)
    for first in (single, blocks):
        assert kept(first) == expected
        assert (first.frames, first.kept) == (1000, len(expected))
        assert first.counts == seen


def test_all_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """The frames that are kept, and the IDs that are counted; all frames are counted."""
    monkeypatch.setattr(first_frames, "MAX_FRAMES", 6)
    monkeypatch.setattr(first_frames, "MAX_IDS", 4)
    frames = [frame(k // 2) for k in range(20)]
    single, blocks = FirstFrames(), FirstFrames()
    for one in frames:
        single.add(one)
    blocks.add_block(block_of(frames, {}))
    for first in (single, blocks):
        assert (first.frames, first.kept, len(kept(first))) == (20, 6, 6)
        assert first.counts == {CanId(k, False): 2 for k in range(4)}


@pytest.mark.parametrize(
    ("numbers", "text"),
    [
        pytest.param([], "", id="none"),
        pytest.param([0x341, 0x340, 0x343], "0x340..0x341, 0x343", id="a-gap"),
        pytest.param([*range(0, 12, 2)], "0x0, 0x2, 0x4, 0x6, 0x8, 0xa", id="six"),
        pytest.param([*range(0, 14, 2)], "0x0, 0x2, 0x4, 0x6, 0x8, 0xa, ...", id="seven"),
    ],
)
def test_ids_are_grouped(numbers: list[int], text: str) -> None:
    """Neighbours are one group, and only some groups are named."""
    assert ids_text([CanId(number, False) for number in numbers]) == text
