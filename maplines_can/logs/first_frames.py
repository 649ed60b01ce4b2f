"""The first frames of a log or of a bus, as long as nothing is known of their DBC."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .frame_block import FrameBlock, LogFrame, block_of

#: Most CAN IDs that are counted; more than the classic ones.
MAX_IDS = 4096
#: Most frames that are kept, and of them those of a CAN ID: so a rare message has its frames, too.
MAX_FRAMES, MAX_EACH = 1 << 16, 1 << 8
#: Most groups of CAN IDs in a text.
MAX_GROUPS = 6
_EXTENDED_BIT = 29  #: of a key, above those of a CAN ID


class CanId(NamedTuple):
    """CAN ID of a frame."""

    number: int
    is_extended: bool

    @property
    def key(self) -> int:
        """A number that differs for each CAN ID."""
        return self.number | self.is_extended << _EXTENDED_BIT

    @classmethod
    def of_key(cls, key: int) -> CanId:
        """Return the CAN ID of a key."""
        return cls(key & (1 << _EXTENDED_BIT) - 1, key >> _EXTENDED_BIT > 0)


def keys_of(block: FrameBlock) -> NDArray[np.uint32]:
    """Return the keys of the CAN IDs of frames."""
    return block.can_id | block.is_extended * np.uint32(1 << _EXTENDED_BIT)


def ids_text(can_ids: Collection[CanId]) -> str:
    """Return CAN IDs as text.

    >>> ids_text([CanId(0x340, False), CanId(0x341, False), CanId(0x340, True)])
    '0x340..0x341, extended 0x340'
    """
    groups: list[tuple[CanId, CanId]] = []
    for one in sorted(can_ids, key=lambda one: one.key):
        if groups and groups[-1][1].key == one.key - 1:
            groups[-1] = groups[-1][0], one
        else:
            groups.append((one, one))
    texts = [
        "extended " * low.is_extended
        + f"{low.number:#x}"
        + (f"..{high.number:#x}" if high != low else "")
        for low, high in groups[:MAX_GROUPS]
    ]
    return ", ".join(texts) + ", ..." * (len(groups) > MAX_GROUPS)


class FirstFrames:
    """The first frames of each CAN ID, and how many frames each has; its memory is bounded.

    >>> first = FirstFrames()
    >>> first.add(LogFrame(0x340, b"", 0, False, "can0", True))
    >>> first.frames, [*first.counts]
    (1, [CanId(number=832, is_extended=False)])
    """

    def __init__(self) -> None:
        self.frames = 0  #: all that were added
        self.kept = 0  #: of these, those that are kept
        self._counts: Counter[int] = Counter()
        self._single: list[LogFrame] = []
        self._blocks: list[FrameBlock] = []

    @property
    def counts(self) -> dict[CanId, int]:
        """Frames of each of the first ``MAX_IDS`` CAN IDs."""
        return {CanId.of_key(key): n for key, n in sorted(self._counts.items())}

    def add(self, frame: LogFrame) -> None:
        """Add a frame."""
        self.frames += 1
        if self._taken(CanId(frame.can_id, frame.is_extended).key, 1):
            self._single.append(frame)

    def add_block(self, block: FrameBlock) -> None:
        """Add the frames of a block."""
        self.frames += len(block)
        keys = keys_of(block)
        kept = np.zeros(len(block), bool)
        for key, frames in zip(*np.unique(keys, return_counts=True), strict=True):
            if taken := self._taken(int(key), int(frames)):
                kept[np.flatnonzero(keys == key)[:taken]] = True
        if kept.any():
            self._blocks.append(block.where(kept))

    def _taken(self, key: int, frames: int) -> int:
        """Count frames of a CAN ID; return how many of them are kept."""
        before = self._counts[key]
        if not before and len(self._counts) == MAX_IDS:
            return 0
        self._counts[key] = before + frames
        taken = max(0, min(frames, MAX_EACH - before, MAX_FRAMES - self.kept))
        self.kept += taken
        return taken

    def blocks(self) -> Iterator[FrameBlock]:
        """Yield the frames that are kept: those of blocks, and single ones."""
        yield from self._blocks
        if self._single:
            yield block_of(self._single, {})
