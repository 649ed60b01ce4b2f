"""What is in a log: its span, its messages with their periods and gaps, and what is received."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..bus.replay import Choice
from ..logs.first_frames import CanId, FirstFrames, keys_of
from ..logs.log_part import ALL, Time, of_channel
from ..logs.log_summary import LogSummary, Times
from ..logs.spacings import MAX_IDS, Spacing, Spacings
from ..values.errors import LogError
from ..values.line import Slot
from ..wire import Decoder, E2EState, LineCodec, Owner, Reason
from ..wire.layout.message_layout import Layout
from ..wire.layout.slot_messages import RecordMessages
from .block_reception import LineBlock, LogReceiver
from .blocks import FrameBlock, read_blocks
from .fitting import Fit, misfit
from .read_lines import Log, name_of


@dataclass(frozen=True)
class MessageName:
    """Whose message a CAN ID is.

    Args:
        dbc: name of the DBC.
        name: of the message of its owner.
        owner: of its records.
        frame: "classic", "FD" or "authenticated".
    """

    dbc: str
    name: str
    owner: Owner
    frame: str


class LogMessage(NamedTuple):
    """Frames of a CAN ID on a channel."""

    channel: str
    can_id: CanId
    name: MessageName | None  #: None: no DBC has it
    spacing: Spacing
    lengths: tuple[int, int]  #: shortest and longest payload [byte]


@dataclass
class Reception:
    """What is received of a log by one DBC.

    Args:
        codec: of the DBC.
        receiver: of all frames of the log.
        frames: with CAN IDs of the DBC.
    """

    codec: LineCodec
    receiver: LogReceiver
    frames: int = 0
    lines: Spacings = field(default_factory=Spacings)
    states: Counter[tuple[int, int]] = field(default_factory=Counter)
    two_senders: Counter[int] = field(default_factory=Counter)

    def add(self, lines: LineBlock) -> None:
        """Count the lines of a block."""
        rows = lines.lines
        keys = lines.channel.astype(np.int64) * len(Slot) + rows["slot"]
        self.lines.add(keys, rows["t_ns"])
        both = keys << 8 | rows["state"]
        for key, n in zip(*np.unique(both, return_counts=True), strict=True):
            self.states[int(key) >> 8, int(key) & 0xFF] += int(n)
        for key, n in zip(*np.unique(keys[rows["two_senders"]], return_counts=True), strict=True):
            self.two_senders[int(key)] += int(n)

    @property
    def fit(self) -> Fit:
        """How well the DBC fits the log."""
        return Fit.of(self.receiver, self.codec, self.frames)

    def as_dict(self, channels: Sequence[str], begin_ns: int) -> dict[str, Any]:
        """Return it for JSON."""
        fit, decoders = self.fit, self.receiver.decoders
        lines = []
        for key in self.lines.keys:
            channel, slot = divmod(key, len(Slot))
            states = {E2EState(state).name: n for (own, state), n in self.states.items()
                      if own == key}  # fmt: skip
            lines.append(
                {"channel": channels[channel], "slot": Slot(slot).name}
                | self.lines.of(key).as_dict(begin_ns)
                | {"states": states, "two_senders": self.two_senders[key]}
            )
        return {
            "dbc": fit.name,
            "frames": fit.frames,
            "intact_records": fit.records,
            "intact_frames": fit.intact,
            "chance_log10": fit.chance,
            "lines": lines,
            "pose_errors": sum(one.pose_errors for one in decoders.values()),
            "lost": sum(one.lost for one in decoders.values()),
            "left_out": sum(one.left_out for one in decoders.values()),
            "rejects": {
                reason.name: n
                for reason, n in self.receiver.counts.items()
                if reason is not Reason.FOREIGN
            },
            "messages": [
                {"channel": channel} | _stats_dict(decoder, owner)
                for channel, decoder in decoders.items()
                for owner in decoder.messages(self.receiver.last_ns)
            ],
        }


def _stats_dict(decoder: Decoder, owner: Owner) -> dict[str, Any]:
    stats = decoder.checks[owner].stats()
    status = None if stats.status is None else stats.status.name
    name = owner.name if isinstance(owner, Slot) else owner
    return {"owner": name} | stats._asdict() | {"state": stats.state.name, "status": status}


@dataclass(frozen=True, eq=False)
class LogContents:
    """What is in a log; see `contents_of`.

    Args:
        log: its name.
        summary: format, kind of times, and what is no data frame.
        channels: spacing of all frames of a channel, by its name.
        messages: by channel and CAN ID.
        beyond: frames of more CAN IDs than are told apart.
        receptions: by the DBCs whose CAN IDs there are; if one fits, those with intact records.
        has_time: whether the log has times.
        misfit: why no DBC fits; empty if one does.
        damage: why the rest was not read; empty if all was.
    """

    log: str
    summary: LogSummary
    channels: dict[str, Spacing]
    messages: list[LogMessage]
    beyond: int
    receptions: list[Reception]
    has_time: bool
    misfit: str
    damage: str

    @property
    def frames(self) -> int:
        """Data frames of the log."""
        return sum(one.n for one in self.channels.values())

    @property
    def begin_ns(self) -> int:
        """Time of the first frame [ns]."""
        return min((one.first_ns for one in self.channels.values()), default=0)

    @property
    def end_ns(self) -> int:
        """Time of the last frame [ns]."""
        return max((one.last_ns for one in self.channels.values()), default=0)

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON; times of gaps are from the first frame on [s]."""
        begin = self.begin_ns
        names = [*self.channels]
        return {
            "log": self.log,
            **self.summary.as_dict(),
            "damage": self.damage or None,
            "begin": begin / 1e9 if self.has_time else None,
            "span": (self.end_ns - begin) / 1e9 if self.has_time else None,
            "frames": self.frames,
            "channels": [
                {"channel": name} | one.as_dict(begin) for name, one in self.channels.items()
            ],
            "ids": [_message_dict(one, begin) for one in self.messages],
            "beyond": self.beyond,
            "dbcs": [one.as_dict(names, begin) for one in self.receptions],
            "misfit": self.misfit or None,
        }


def _message_dict(message: LogMessage, begin_ns: int) -> dict[str, Any]:
    name = message.name
    known: dict[str, Any] = {"dbc": None, "name": None, "owner": None, "frame": None}
    if name is not None:
        owner = name.owner.name if isinstance(name.owner, Slot) else name.owner
        known = {"dbc": name.dbc, "name": name.name, "owner": owner, "frame": name.frame}
    can_id = {"id": message.can_id.number, "extended": message.can_id.is_extended}
    length = {"length": [*message.lengths]}
    spacing = message.spacing.as_dict(begin_ns)
    return {"channel": message.channel} | can_id | known | length | spacing


def contents_of(
    log: Log,
    codecs: Sequence[LineCodec],
    *,
    naming: Sequence[Layout] = (),
    times: Times = "auto",
    time: Time = ALL,
    channel: str | None = None,
) -> LogContents:
    """Return what is in a log; it is read once, and not kept.

    Args:
        log: path or stream.
        codecs: receive the lines; those whose CAN IDs the log has not receive nothing.
        naming: layouts that name further CAN IDs.
        times: kind of the time stamps, see `read_log`.
        time: first and last time of the frames [s], from the first one on, or of the clock if they
            are more than 1e8.
        channel: frames of this one only.

    Raises:
        LogError: the log cannot be opened, has no such channel, or no times for ``time``.

    >>> contents = contents_of("drive.log", [Codec.from_dbc()])  # doctest: +SKIP
    >>> contents.frames, [one.fit.name for one in contents.receptions]  # doctest: +SKIP
    (2400, ['maplines.dbc'])
    """
    names = names_of([*(codec.layout for codec in codecs), *naming])
    blocks = of_channel(read_blocks(log, times=times), channel, name_of(log))
    reading = _Reading(codecs)
    damage = ""
    try:
        for block in Choice(time=time).of(blocks):
            reading.add(block)
    except LogError as error:
        damage = str(error)
        if not reading.channels:
            raise
    return reading.contents(name_of(log), blocks.summary, names, damage)


class _Reading:
    """What is in a log so far."""

    def __init__(self, codecs: Sequence[LineCodec]) -> None:
        self.channels: tuple[str, ...] = ()
        self._receptions = [Reception(codec, LogReceiver(codec)) for codec in codecs]
        self._keys = [
            np.array([CanId(*key).key for key in codec.layout.message_of_id]) for codec in codecs
        ]
        self._ids, self._of_channel = Spacings(), Spacings(1 << 16)
        self._shortest: Counter[int] = Counter()
        self._longest: Counter[int] = Counter()
        self._first, self._has_time = FirstFrames(), False

    def add(self, block: FrameBlock) -> None:
        """Add the frames of a block."""
        if not len(block):
            return
        self.channels = block.channels
        self._has_time = bool(block.has_time.any())
        self._of_channel.add(block.channel, block.t_ns)
        keys = block.channel.astype(np.int64) << 32 | keys_of(block)
        place = self._ids.add(keys, block.t_ns)
        self._add_lengths(place, block.length)
        if not any(one.frames for one in self._receptions):
            self._first.add_block(block)
        here = np.array([key & 0xFFFFFFFF for key in self._ids.keys], np.int64)
        for reception, own in zip(self._receptions, self._keys, strict=True):
            is_own = np.isin(here, own)
            if reception.frames or is_own.any() or len(here) == MAX_IDS:
                reception.frames += int(is_own[place[place >= 0]].sum())
                reception.add(reception.receiver.feed(block))

    def _add_lengths(self, place: NDArray[np.int64], length: NDArray[np.uint8]) -> None:
        both = place[place >= 0] << 7 | length[place >= 0]
        keys = self._ids.keys
        for one in np.flatnonzero(np.bincount(both)).tolist():
            key, n = keys[one >> 7], one & 0x7F
            self._shortest[key] = min(self._shortest.get(key, n), n)
            self._longest[key] = max(self._longest[key], n)

    def contents(
        self, log: str, summary: LogSummary, names: dict[CanId, MessageName], damage: str
    ) -> LogContents:
        """Return the result."""
        messages = []
        for key in self._ids.keys:
            can_id = CanId.of_key(key & 0xFFFFFFFF)
            lengths = self._shortest[key], self._longest[key]
            channel, spacing = self.channels[key >> 32], self._ids.of(key)
            messages.append(LogMessage(channel, can_id, names.get(can_id), spacing, lengths))
        for one in self._receptions:
            one.receiver.finish()
        receptions = [one for one in self._receptions if one.frames]
        why = ""
        if any(one.fit.is_sure for one in receptions):
            receptions = [one for one in receptions if one.fit.records]
        else:
            codecs = [one.codec for one in self._receptions]
            why = misfit(self._first, codecs, summary).text
        channels = {self.channels[key]: self._of_channel.of(key) for key in self._of_channel.keys}
        return LogContents(
            log, summary, channels, messages, self._ids.beyond, receptions, self._has_time, why,
            damage,
        )  # fmt: skip


def names_of(layouts: Sequence[Layout]) -> dict[CanId, MessageName]:
    """Return the names of the messages of DBCs by CAN ID; the first DBC that has an ID counts.

    >>> from maplines_can.wire import Codec
    >>> names_of([Codec.from_dbc().layout])[CanId(0x348, False)]
    MessageName(dbc='maplines.dbc', name='EgoLeft', owner=<Slot.EGO_LEFT: 0>, frame='FD')
    """
    names: dict[CanId, MessageName] = {}
    for layout in layouts:
        for owner, own in layout.messages_of.items():
            for key in own.ids:
                name = MessageName(_file_name(layout), own.name, owner, _frame_of(own, key))
                names.setdefault(CanId(*key), name)
    return names


def _file_name(layout: Layout) -> str:
    return layout.source.replace("\\", "/").rpartition("/")[2]


def _frame_of(own: RecordMessages, key: tuple[int, bool]) -> str:
    if key in own.secured_ids:
        return "authenticated"
    return "FD" if own.ids[key] else "classic"
