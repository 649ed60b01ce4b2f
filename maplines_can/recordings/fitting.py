"""Which DBC fits a log: the one whose records have intact checksums; and why one does not."""

from __future__ import annotations

import contextlib
import math
from binascii import crc_hqx
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..logs.first_frames import CanId, FirstFrames, ids_text, keys_of
from ..logs.log_summary import LogSummary, Times, skipped_text
from ..values.arrays import count_text
from ..values.errors import LayoutError, LogError
from ..wire import SHIPPED, Codec, LineCodec, default_dbc_path
from ..wire.layout.message_layout import Layout
from ..wire.layout.pose_layout import PoseLayout
from ..wire.layout.scene_layout import SceneLayout
from ..wire.layout.slot_messages import RecordMessages, SecuredLayout
from ..wire.protection.secoc import WHOLE_FRESHNESS
from ..wire.reception.check import Reason
from .block_reception import REASONS, LogReceiver
from .blocks import FrameBlock, read_blocks

#: Frames after which no more are read, if a DBC fits; they have some thousand lines.
MOST_FRAMES = 1 << 18
#: Greatest probability that a DBC fits by chance, log10.
MAX_CHANCE = -3.0
_FOREIGN = REASONS.index(Reason.FOREIGN)
#: What tells that the checksum of a record is right, though no line follows from it.
_INTACT = (Reason.DUPLICATE, Reason.STALE, Reason.POSE, Reason.REPLACED)
#: Shifts of the CAN IDs that are tried for a DBC, those first that most of its IDs have; fewer with
#: many channels.
MAX_SHIFTS = 32


@dataclass(frozen=True, eq=False)
class Fit:
    """How well a DBC fits a log.

    Args:
        codec: of the DBC.
        frames: that have CAN IDs of it.
        intact: of these, in records with a right checksum.
        records: such records. One of a whole scene has the pose error and several lines.
        received: of these, those that need no other record that is missing.
        chance: bound on the probability that so many checksums are right by chance, log10.
    """

    codec: LineCodec
    frames: int
    intact: int
    records: int
    received: int
    chance: float

    @classmethod
    def of(cls, receiver: LogReceiver, codec: LineCodec, frames: int) -> Fit:
        """Return how well the DBC of a receiver fits what it has received.

        Args:
            receiver: of the frames.
            codec: of the receiver.
            frames: that have CAN IDs of it.
        """
        decoders, counts = receiver.decoders.values(), receiver.counts
        layout = codec.layout
        lines = 0 if layout.scene is not None else sum(one.lines for one in decoders)
        received = lines + sum(one.pose_errors for one in decoders)
        # A record of classic CAN has as many frames as pages, one of CAN FD has fewer.
        records = received + math.ceil(counts[Reason.POSE] / (layout.pages or 1))
        intact = sum(one.line_frames + one.pose_frames for one in decoders)
        intact += sum(counts[reason] for reason in _INTACT)
        chance = _chance(frames, records, (layout.scene or layout)["Crc"].length)
        return cls(codec, frames, intact, records, received, chance)

    @property
    def name(self) -> str:
        """Name of the DBC."""
        return Path(self.codec.layout.source).name

    @property
    def is_sure(self) -> bool:
        """Whether so many records are hardly intact by chance."""
        return self.chance <= MAX_CHANCE

    def __str__(self) -> str:
        frames = f"{count_text(self.frames, 'frame')} with its CAN IDs"
        if not self.records:
            return f"{self.name}: no intact record in {frames}"
        return (
            f"{self.name}: {count_text(self.records, 'intact record')}, with {self.intact} of "
            f"{frames}; by chance with a probability of less than "
            f"1e{max(math.ceil(self.chance), -99)}"
        )


def fits(
    log: str | PathLike[str],
    dbcs: Sequence[str | Path] = SHIPPED,
    encoding: str | None = None,
    *,
    times: Times = "auto",
) -> list[Fit]:
    """Return how well DBCs fit the begin of a log, the best one first.

    Of DBCs that fit alike, that with fewer messages is better.

    Args:
        log: path of the log.
        dbcs: paths, or names of those of the package.
        encoding: of the DBCs; None to find it.
        times: as for `read_log`.

    Raises:
        LogError: the log cannot be opened, or has no frame.
        LayoutError: none of the files is a DBC of lines.

    >>> [fit.name for fit in fits("drive.log")]  # doctest: +SKIP
    ['maplines.dbc', 'maplines-secoc.dbc', 'maplines-pose.dbc']
    """
    codecs, problem = [], None
    for dbc in dbcs:
        try:
            is_shipped = dbc in SHIPPED and not Path(dbc).exists()
            path = default_dbc_path(str(dbc)) if is_shipped else dbc
            codecs.append(Codec.from_dbc(path, encoding=encoding))
        except LayoutError as error:
            problem = problem or error
    if not codecs:
        raise problem or LayoutError("there is no DBC to choose from")
    receivers = [LogReceiver(codec) for codec in codecs]
    known, found, frames = [0] * len(codecs), list[Fit](), 0
    blocks = read_blocks(log, times=times)
    try:
        for block in blocks:
            for i, receiver in enumerate(receivers):
                known[i] += int((receiver.feed(block).reasons != _FOREIGN).sum())
            frames += len(block)
            found = [*map(Fit.of, receivers, codecs, known)]
            if frames >= MOST_FRAMES and any(fit.is_sure for fit in found):
                break
    except LogError:
        if not frames:
            raise
    if not frames:
        raise LogError(f"{log}: {misfit(FirstFrames(), codecs, blocks.summary).text}")
    return sorted(found, key=lambda fit: (-fit.intact, fit.frames))


def best_fit(found: Sequence[Fit], log: str | PathLike[str], *, times: Times = "auto") -> Fit:
    """Return the best one of what `fits` returned for a log with the same times.

    Raises:
        LogError: no DBC fits: whole records of each may be chance.
    """
    sure = [fit for fit in found if fit.is_sure]
    if sure:
        return sure[0]
    first, blocks = FirstFrames(), read_blocks(log, times=times)
    with contextlib.suppress(LogError):  # what is damaged was read before
        for block in blocks:
            first.add_block(block)
    why = misfit(first, [fit.codec for fit in found], blocks.summary)
    raise LogError(f"{log}: no DBC fits: {why.text}")


def check_fit(log: str | PathLike[str], codec: LineCodec, *, times: Times = "auto") -> None:
    """Read a log as far as its first line or pose error.

    Raises:
        LogError: it has none, or is damaged before.
    """
    receiver, blocks = LogReceiver(codec), read_blocks(log, times=times)
    for block in blocks:
        receiver.feed(block)
        if not receiver.is_empty:
            return
    raise LogError(f"{log}: {misfit(receiver.first, [codec], blocks.summary).text}")


class Misfit(NamedTuple):
    """Why nothing was received of a log.

    Args:
        text: the end of a sentence that begins with the name of the log.
        is_left_out: whether there are whole records, which the times of the receiver leave out.
    """

    text: str
    is_left_out: bool = False


def misfit(
    first: FirstFrames, codecs: Sequence[LineCodec], summary: LogSummary | None = None
) -> Misfit:
    """Return why receivers have found neither a line nor a pose error, and what would fit.

    The DBCs of the package are tried on the frames, then all of them without authentication, and
    with other CAN IDs. What fits is known by the checksums of whole records, as in `fits`.

    Args:
        first: frames that were received.
        codecs: of the receivers.
        summary: of their log; None for a bus.
    """
    if not first.frames:
        return Misfit("has no frame" + _read_as(summary))
    known = {can_id for codec in codecs for can_id in _can_ids(codec.layout)}
    there = {can_id: n for can_id, n in first.counts.items() if can_id in known}
    names = " or ".join(Path(codec.layout.source).name for codec in codecs)
    its = "its" if len(codecs) == 1 else "their"
    which = f"{sum(there.values())} with {its} CAN IDs: {ids_text(there)}"
    if not there:
        which = f"none with {its} CAN IDs, but {ids_text(first.counts)}"
    text = f"no record of {names} is whole in {count_text(first.frames, 'frame')} ({which}); "
    sure = [trial for trial in _trials(first, codecs) if trial.fit.is_sure]
    if sure:
        best = max(sure, key=lambda trial: trial.fit.intact)
        least = "at least " * (first.kept < first.frames)
        return Misfit(
            f"{text}{least}{count_text(best.fit.records, 'record')} {best.text}", best.is_left_out
        )
    damage = ", if the frames are not damaged" if there else ""
    return Misfit(f"{text}no DBC of this package fits; take the --dbc of the sender{damage}")


def _read_as(summary: LogSummary | None) -> str:
    """Return how a log without a frame was read."""
    if summary is None or not summary.format:
        return ""
    skipped = skipped_text(summary.skipped)
    return f", read as {summary.format}" + (f"; skipped: {skipped}" if skipped else "")


class _Trial(NamedTuple):
    """How well a DBC fits frames, and what that says."""

    fit: Fit
    text: str  #: follows the number of records
    is_left_out: bool = False


def _trials(first: FirstFrames, codecs: Sequence[LineCodec]) -> Iterator[_Trial]:
    """Yield the trials, the simplest explanation first."""
    tried = {codec.layout.sha256 for codec in codecs}
    others = [one for one in _shipped() if one.layout.sha256 not in tried]
    blocks = [*first.blocks()]
    # Each channel needs a decoder for each trial, and no car has so many.
    most = MAX_SHIFTS // max(len(block.channels) for block in blocks) + 1
    keyless = [codec.of_layout(codec.layout) for codec in codecs]
    for codec, own in zip(codecs, keyless, strict=True):
        yield _own(_fit(blocks, own), codec)
        yield _Trial(
            _fit(blocks, own, is_timed=False),
            "are whole but for their time stamps; check --times, or take the log again",
        )
    for codec in others:
        fit = _fit(blocks, codec)
        yield _Trial(fit, f"of {fit.name} are whole; take --dbc {fit.name}")
    for codec in (*keyless, *others):
        if codec.layout.secured is not None:
            fit = _authentic_fit(blocks, codec)
            what = f"--dbc {fit.name} and the key" if codec in others else "the key"
            short = codec.layout.secured.freshness_bytes < WHOLE_FRESHNESS
            stamps = ", and a log with absolute time stamps" * short
            yield _Trial(
                fit,
                f"of {fit.name} are whole, but authenticated; take {what} of the sender{stamps}",
            )
    for codec in (*keyless, *others):
        for moves in islice(_shifts(first, codec.layout), most):
            fit = _fit(blocks, codec, moves)
            yield _Trial(
                fit,
                f"of {fit.name} are whole if {ids_text(moves)} stand for its CAN IDs "
                f"{ids_text(moves.values())}; take the --dbc of the sender, with these IDs",
            )


def _own(fit: Fit, codec: LineCodec) -> _Trial:
    """Return why a receiver leaves out records of its own DBC."""
    if codec.authenticator is not None:
        return _Trial(
            fit, "are whole, but not authenticated; leave out the key, if that is intended"
        )
    if not fit.received:
        return _Trial(fit, "of lines are whole, but the pose errors that they need are not there")
    return _Trial(fit, "are whole with the default cycle and transfer time-out", is_left_out=True)


def _fit(
    blocks: Sequence[FrameBlock],
    codec: LineCodec,
    moves: Mapping[CanId, CanId] | None = None,
    *,
    is_timed: bool = True,
) -> Fit:
    """Return how well a DBC fits frames, whose CAN IDs are replaced by others of the DBC.

    Args:
        blocks: the frames.
        codec: of the DBC.
        moves: CAN IDs of the DBC by those of the frames; by default, all have their own.
        is_timed: whether their time stamps count; otherwise they follow each other at once.
    """
    receiver = LogReceiver(codec)
    moves = {one: one for one in _can_ids(codec.layout)} if moves is None else moves
    old = np.array(sorted(one.key for one in moves), np.uint32)
    new = [moves[one] for one in sorted(moves, key=lambda one: one.key)]
    number = np.array([one.number for one in new], np.uint32)
    is_extended = np.array([one.is_extended for one in new])
    for block in blocks:
        of_block = keys_of(block)
        place = np.searchsorted(old, of_block).clip(max=len(old) - 1)
        here = np.flatnonzero(old[place] == of_block)
        t_ns = block.t_ns[here] if is_timed else np.arange(len(here)) * 10**5
        changed = {
            "t_ns": t_ns,
            "can_id": number[place[here]],
            "is_extended": is_extended[place[here]],
        }
        receiver.feed(replace(block.where(here), **changed))
    receiver.finish()
    return Fit.of(receiver, codec, receiver.frames)


def _shifts(first: FirstFrames, layout: Layout) -> Iterator[dict[CanId, CanId]]:
    """Yield CAN IDs of a DBC by those of frames that differ by a number, or in their length."""
    own, there = _can_ids(layout), first.counts
    by_number = {one.number: one for one in own}
    shifts = Counter(one.number - number for one in there for number in by_number)
    for shift, _ in sorted(shifts.items(), key=lambda item: (-item[1], abs(item[0]))):
        yield {
            one: by_number[one.number - shift] for one in there if one.number - shift in by_number
        }


@cache
def _shipped() -> tuple[Codec, ...]:
    """Return the codecs of the package; reading a DBC takes as long as thousands of frames."""
    return tuple(Codec.from_dbc(default_dbc_path(name)) for name in SHIPPED)


def _authentic_fit(blocks: Sequence[FrameBlock], codec: LineCodec) -> Fit:
    """Return how well a DBC fits frames whose records are authenticated, without a key."""
    scene = codec.layout.scene
    if scene is None:
        return _fit(blocks, codec.of_layout(_authentic(codec.layout)))
    data_ids = {
        CanId(*key).key: own.data_id for own in scene.messages.values() for key in own.secured_ids
    }
    verdicts = [
        _is_intact(scene, data.tobytes()[:length], data_ids[key])
        for block in blocks
        for key, data, length in zip(keys_of(block).tolist(), block.data, block.length, strict=True)
        if key in data_ids
    ]
    frames, intact = len(verdicts), sum(verdicts)
    return Fit(codec, frames, intact, intact, intact, _chance(frames, intact, scene["Crc"].length))


def _is_intact(scene: SceneLayout, data: bytes, data_id: int) -> bool:
    """Return whether the checksum of an authenticated scene is right; its record is shorter."""
    crc, end = scene.crc_offset, scene.secured_bytes
    covered = data[:crc] + data[crc + 2 : end] + data_id.to_bytes(2, "little")
    sent = int.from_bytes(data[crc : crc + 2], "big" if scene["Crc"].big_endian else "little")
    return len(data) >= end and sent == crc_hqx(covered, 0xFFFF)


def _authentic(layout: Layout) -> Layout:
    """Return a layout whose CAN FD messages are the authenticated ones, without their MAC.

    A record stands at the begin of both.
    """

    def moved(messages: RecordMessages, secured: SecuredLayout | None) -> RecordMessages:
        return replace(
            messages,
            can_id=None,
            fd_can_id=messages.secured_can_id,
            fd_is_extended=messages.secured_is_extended,
            fd_length=0 if secured is None else secured.length,
            secured_can_id=None,
        )

    pose = layout.pose
    if isinstance(pose, PoseLayout):
        pose = replace(pose, messages=moved(pose.messages, pose.secured), secured=None)
    messages = {slot: moved(own, layout.secured) for slot, own in layout.messages.items()}
    return replace(layout, messages=messages, pose=pose, secured=None)


def _can_ids(layout: Layout) -> list[CanId]:
    """Return the CAN IDs of a layout that a receiver without a key reads."""
    return [CanId(*key) for messages in layout.messages_of.values() for key in messages.ids]


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
