"""Which DBC fits a log: the one whose records have intact checksums."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..values.errors import LayoutError, LogError
from ..wire import SHIPPED, Codec, default_dbc_path
from ..wire.reasons import Reason
from .blocks import read_blocks
from .line_block import REASONS
from .receive import LogReceiver

#: Frames that are read; they have some thousand lines.
MOST_FRAMES = 1 << 18
#: Fewer intact records may be chance.
LEAST_RECORDS = 3
#: What tells that the checksum of a record is right, though no line follows from it.
_INTACT = (Reason.DUPLICATE, Reason.STALE, Reason.POSE, Reason.REPLACED)


@dataclass(frozen=True, eq=False)
class Fit:
    """How well a DBC fits a log.

    Args:
        codec: of the DBC.
        frames: that have CAN IDs of it.
        intact: of these, in records with a right checksum.
        records: such records.
        chance: bound on the probability that so many checksums are right by chance, log10.
    """

    codec: Codec
    frames: int
    intact: int
    records: int
    chance: float

    @property
    def name(self) -> str:
        """Name of the DBC."""
        return Path(self.codec.layout.source).name

    def __str__(self) -> str:
        if not self.records:
            return f"{self.name}: no intact record in {self.frames} frames with its CAN IDs"
        return (
            f"{self.name}: {self.records} records are intact, which have {self.intact} of "
            f"{self.frames} frames with its CAN IDs; by chance with a probability of less than "
            f"1e{max(math.ceil(self.chance), -99)}"
        )


def fits(
    log: str | Path, dbcs: Sequence[str | Path] = SHIPPED, encoding: str | None = None
) -> list[Fit]:
    """Return how well DBCs fit the begin of a log, the best one first.

    Of DBCs that fit alike, that with fewer messages is better.

    Args:
        log: path of the log.
        dbcs: paths, or names of those of the package.
        encoding: of the DBCs; None to find it.

    Raises:
        LogError: the log cannot be opened, or has no frame.
        LayoutError: none of the files is a DBC of lines.

    >>> [fit.name for fit in fits("drive.log")]  # doctest: +SKIP
    ['maplines.dbc', 'maplines-secoc.dbc', 'maplines-pose.dbc']
    """
    codecs, problem = [], None
    for dbc in dbcs:
        path = default_dbc_path(str(dbc)) if dbc in SHIPPED and not Path(dbc).exists() else dbc
        try:
            codecs.append(Codec.from_dbc(path, encoding=encoding))
        except LayoutError as error:
            problem = problem or error
    if not codecs:
        raise problem or LayoutError("there is no DBC to choose from")
    receivers = [LogReceiver(codec) for codec in codecs]
    known, frames = [0] * len(codecs), 0
    try:
        for block in read_blocks(log):
            for i, receiver in enumerate(receivers):
                reasons = receiver.feed(block).reasons
                known[i] += int((reasons != REASONS.index(Reason.FOREIGN)).sum())
            frames += len(block)
            if frames >= MOST_FRAMES:
                break
    except LogError:
        if not frames:
            raise
    found = []
    for i, (codec, receiver) in enumerate(zip(codecs, receivers, strict=True)):
        decoders = receiver.decoders.values()
        records = sum(one.lines + one.pose_errors for one in decoders)
        intact = sum(one.line_frames + one.pose_frames for one in decoders)
        intact += sum(receiver.counts[reason] for reason in _INTACT)
        chance = _chance(known[i], records, codec.layout["Crc"].length)
        found.append(Fit(codec, known[i], intact, records, chance))
    if not frames:
        raise LogError(f"{log}: has no frame")
    return sorted(found, key=lambda fit: (-fit.intact, fit.frames))


def best_fit(found: Sequence[Fit], log: str | Path) -> Fit:
    """Return the best one of what `fits` returned for a log.

    Raises:
        LogError: no DBC fits: none has `LEAST_RECORDS` intact records.
    """
    if found[0].records < LEAST_RECORDS:
        each = "; ".join(map(str, found))
        raise LogError(f"{log}: no DBC fits. {each}. Take the --dbc of the sender")
    return found[0]


def _chance(frames: int, records: int, bits: int) -> float:
    """Return log10 of a bound on the probability of so many right checksums among random ones.

    Union bound over the choices of records: (n e / k)^k 2^(-bits k).

    >>> _chance(1000, 10, 16) < -20
    True
    """
    if not records:
        return 0.0
    each = math.log10(max(frames, records) * math.e / records) - bits * math.log10(2)
    return min(records * each, 0.0)
