"""Read signals of any DBC: from frames, and from log files as time series."""

from __future__ import annotations

import csv
import warnings
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike, fspath
from pathlib import Path
from types import MappingProxyType
from typing import IO, TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..dbc_files.parser import parse_database, read_text
from ..values.arrays import count_text
from ..values.errors import DriveFileError, LogError
from ..values.input_files import checked_path, toml_of
from .first_frames import FirstFrames, ids_text
from .j1939 import Reassembler, j1939_messages, nearest, pgn_of, source_of
from .log_reader import read_log
from .log_summary import LogSummary, Times

if TYPE_CHECKING:
    from ..dbc_files.parser import Database, Message

#: Largest table of signal names [B].
MAX_TABLE = 10**6

#: Greatest address in J1939.
MAX_ADDRESS = 0xFF

#: CAN ID of a message, and whether it is extended.
Key = tuple[int, bool]
Series = tuple[NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class SignalLog(Mapping[str, Series]):
    """Time series of signals: (n,) times [s] and (n,) physical values, by name.

    Args:
        series: by name.
        skipped: numbers of frames that are not used, and of damage of the log, by reason.
        log: summary of the log: its format and times, and what is no data frame, by kind.
    """

    series: Mapping[str, Series]
    skipped: Mapping[str, int] = field(default_factory=dict)
    log: LogSummary = field(default_factory=LogSummary)

    def __post_init__(self) -> None:
        for name in ("series", "skipped"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    def __getitem__(self, name: str) -> Series:
        return self.series[name]

    def __iter__(self) -> Any:
        return iter(self.series)

    def __len__(self) -> int:
        return len(self.series)


class _Wanted(NamedTuple):
    column: str
    signal: str
    sender: int | None  #: address in J1939; None for any


class SignalDecoder:
    """Decoder of signals of any DBC, frame by frame.

    Args:
        dbc: of the messages.
        signals: see ``read_signals``.
        encoding: of the DBC; None to find it.

    Raises:
        LayoutError: the DBC cannot be read.
        DriveFileError: the table cannot be read, or a signal is not in the DBC.
    """

    def __init__(
        self,
        dbc: str | PathLike[str],
        signals: Mapping[str, str] | str | PathLike[str],
        *,
        encoding: str | None = None,
    ) -> None:
        source = "signals" if isinstance(signals, Mapping) else fspath(signals)
        #: Names of the signals by the names of their series.
        self.names = dict(signals if isinstance(signals, Mapping) else read_table(signals))
        #: Numbers of frames that are not used, or only in part, by reason.
        self.skipped: Counter[str] = Counter()
        #: Numbers of values by the address of the sender in J1939, by the names of their series.
        self.senders: dict[str, Counter[int]] = {}
        database = parse_database(read_text(Path(dbc), encoding), fspath(dbc), strict=False)
        groups = j1939_messages(database)
        self._groups: dict[int, list[Message]] = {}
        for group in groups:
            self._groups.setdefault(pgn_of(group.frame_id), []).append(group)
        self._wanted: dict[Key, list[_Wanted]] = {}
        for column, name in self.names.items():
            wanted, message = _find(database, column, name, source, fspath(dbc))
            if wanted.sender is not None and message not in groups:
                raise DriveFileError(
                    f"{source}: {column} = {name!r}: has the address of a sender of J1939, but "
                    f"{message.name} is no parameter group in {fspath(dbc)}; leave it out"
                )
            self._wanted.setdefault(_key(message), []).append(wanted)
        self._messages = {_key(m): m for m in database.messages if m not in groups}
        self._transport = Reassembler(
            pgn_of(group.frame_id) for group in groups if _key(group) in self._wanted
        )

    @property
    def can_ids(self) -> frozenset[int] | None:
        """CAN IDs of the messages of the signals; None if any, as one is a group of J1939."""
        if not self._wanted.keys() <= self._messages.keys():
            return None
        return frozenset(can_id for can_id, _ in self._wanted)

    def decode(
        self, can_id: int, data: bytes, *, is_extended: bool = False, channel: str = ""
    ) -> dict[str, float]:
        """Return the physical values in a frame by the names of their series; none in others.

        A frame that completes a message of J1939's transport protocol has all its values. Of a
        frame that is shorter than its message, the signals that are in it are read.
        """
        message = self._messages.get((can_id, is_extended))
        is_group = message is None and is_extended
        if is_group:
            can_id, data = self._transport.feed(can_id, data, channel) or (can_id, data)
            message = self._group(can_id)
        if message is None or _key(message) not in self._wanted:
            return {}
        try:
            decoded: Any = message.decode(data, decode_choices=False, allow_truncated=True)
        except Exception:  # noqa: BLE001 - cantools raises many types, all for data that do not fit
            self.skipped[f"the data do not fit the message {message.name}"] += 1
            return {}
        found: dict[str, float] = {}
        sender, is_short = source_of(can_id), False
        for column, signal, wanted in self._wanted[_key(message)]:
            # A signal that is missing is multiplexed and not in this frame, or beyond its end.
            if signal in decoded and wanted in (None, sender):
                found[column] = float(decoded[signal])
                if is_group:
                    self.senders.setdefault(column, Counter())[sender] += 1
            is_short = is_short or end_of(message.get_signal_by_name(signal)) > len(data)
        if is_short:
            what = "end before a signal of" if found else "do not fit"
            self.skipped[f"the data {what} the message {message.name}"] += 1
        return found

    def _group(self, can_id: int) -> Message | None:
        """Return the message of the parameter group of a frame."""
        groups = self._groups.get(pgn_of(can_id), ())
        group = nearest(can_id, groups)
        if group is None and any(_key(one) in self._wanted for one in groups):
            names = ", ".join(one.name for one in groups)
            self.skipped[
                f"address {source_of(can_id):#04x} is of none of {names}, which have one PGN"
            ] += 1
        return group

    def damage(self) -> dict[str, int]:
        """Return `skipped`, and the transfers of J1939 that are not complete."""
        transfers = {
            f"incomplete transfers of the parameter group {pgn:#06x}": count
            for pgn, count in self._transport.incomplete.items()
            if count
        }
        return {**self.skipped, **transfers}

    def mixtures(self) -> list[str]:
        """Return which series have values of several senders in J1939, and what to do."""
        return [
            f"{column} = {self.names[column]} has values of several senders: "
            + ", ".join(f"{sender:#04x} ({count})" for sender, count in sorted(senders.items()))
            + f"; for one of them, write {self.names[column]}@{min(senders):#04x}"
            for column, senders in self.senders.items()
            if len(senders) > 1
        ]


def read_signals(
    log: str | PathLike[str] | IO[bytes],
    dbc: str | PathLike[str],
    signals: Mapping[str, str] | str | PathLike[str],
    channel: str | None = None,
    *,
    encoding: str | None = None,
    times: Times = "auto",
) -> SignalLog:
    """Return signals of a log as time series, such as those of a drive for ``RecordedDrive``.

    A frame that its message does not fit is skipped and counted; of one that is too short, the
    signals that are in it are read. Messages of J1939, by ProtocolType or VFrameFormat of the DBC,
    are known by their parameter group, from any sender; those of more than 8 bytes are put
    together by its transport protocol. The good part of a damaged log is used, and the damage is
    listed in ``skipped``.

    Args:
        log: see ``read_log``.
        dbc: of the messages in the log.
        signals: name of the signal by the name of its series, as "Message.Signal", or as "Signal"
            if only one message has it; in J1939 followed by the address of the sender, as in
            "CCVS1.WheelBasedVehicleSpeed@0x27", if there are several; or the path of such a table.
            A table in TOML has lines such as ``speed_kmh = "ESP.VehicleSpeed"``; one in CSV has the
            header ``column,signal``.
        channel: of the interface, if the log has frames of several; None for all.
        encoding: of the DBC, such as ``cp936``; None to find it.
        times: kind of the time stamps, see ``read_log``.

    Warns:
        UserWarning: a series has values of several senders of J1939; or see ``Layout.from_dbc``.

    Raises:
        LogError: the log cannot be read, or has none of the frames of a signal.
        LayoutError: the DBC cannot be read.
        DriveFileError: the table cannot be read, or a signal is not in the DBC.
    """
    decoder = SignalDecoder(dbc, signals, encoding=encoding)
    stamps: dict[str, list[float]] = {column: [] for column in decoder.names}
    values: dict[str, list[float]] = {column: [] for column in decoder.names}
    frames, first, channels = read_log(log, times=times), FirstFrames(), set[str]()
    try:
        for frame in frames:
            if channel is not None and frame.channel != channel:
                channels.add(frame.channel)
                continue
            found = decoder.decode(
                frame.can_id,
                frame.data,
                is_extended=frame.is_extended,
                channel=frame.channel,
            )
            if not found:
                first.add(frame)
            for column, value in found.items():
                stamps[column].append(frame.t_ns * 1e-9)
                values[column].append(value)
    except LogError as error:
        if not all(stamps.values()):
            raise
        decoder.skipped[str(error)] += 1
    for column, name in decoder.names.items():
        if not stamps[column]:
            why = [f"{count_text(count, 'time')}: {why}" for why, count in decoder.damage().items()]
            if first.frames and not why:
                why.append(f"the CAN IDs of the other frames are {ids_text(first.counts)}")
            elif channels and not first.frames:
                why.append(f"the channels are {', '.join(sorted(channels))}")
            raise LogError(
                f"{log}: has no value of {column} = {name}; correct the name, the DBC or the "
                f"channel ({'; '.join(why) or 'there is no frame'})"
            )
    for mixture in decoder.mixtures():
        warnings.warn(f"{log}: {mixture}", stacklevel=2)
    return SignalLog(
        {column: (np.array(stamps[column]), np.array(values[column])) for column in stamps},
        decoder.damage(),
        frames.summary,
    )


def read_table(path: str | PathLike[str]) -> dict[str, str]:
    """Return the names of signals by the names of their series, from a file in TOML or CSV.

    Raises:
        DriveFileError: the file cannot be read, or is not such a table.
    """
    source = checked_path(path, DriveFileError)
    try:
        with source.open("rb") as file:
            data = file.read(MAX_TABLE + 1)
        text = data.decode("utf-8-sig")
    except OSError as error:
        raise DriveFileError(f"{source}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise DriveFileError(f"{source}: is not a text in UTF-8: {error}") from error
    if len(data) > MAX_TABLE:
        raise DriveFileError(f"{source}: is too large for a table of signals")
    if source.suffix.lower() == ".csv":
        rows = [[cell.strip() for cell in row] for row in csv.reader(text.splitlines()) if row]
        if not rows or rows[0] != ["column", "signal"]:
            raise DriveFileError(f"{source}: line 1: the header must be column,signal")
        table: dict[Any, Any] = {}
        for row in rows[1:]:
            if len(row) != 2 or row[0] in table:
                raise DriveFileError(
                    f"{source}: {','.join(row)!r} must be a column and a signal, each column once"
                )
            table[row[0]] = row[1]
    else:
        table = toml_of(text, str(source), DriveFileError)
    for column, name in table.items():
        if not isinstance(name, str) or not name:
            raise DriveFileError(
                f'{source}: {column} must be the name of a signal, such as "ESP.VehicleSpeed", '
                f"got {name!r}"
            )
    if not table:
        raise DriveFileError(f"{source}: has no signal; see read_signals for the format")
    return table


def _find(
    database: Database, column: str, name: str, source: str, dbc: str
) -> tuple[_Wanted, Message]:
    """Return the signal of a series, and its message."""
    path, _, address = name.partition("@")
    message_name, _, signal = path.rpartition(".")
    found = [
        message
        for message in database.messages
        if message_name in {"", message.name} and signal in {s.name for s in message.signals}
    ]
    if len(found) != 1:
        which = ", ".join(f"{message.name}.{signal}" for message in found)
        raise DriveFileError(
            f"{source}: {column} = {name!r}: "
            + (f"is ambiguous in {dbc}; use one of {which}" if found else f"is not in {dbc}")
        )
    try:
        sender = int(address, 0) if "@" in name else None
    except ValueError:
        sender = -1
    if sender is not None and not 0 <= sender <= MAX_ADDRESS:
        raise DriveFileError(
            f"{source}: {column} = {name!r}: {address!r} must be the address of a sender, 0 to "
            f"{MAX_ADDRESS}, such as 0x27"
        )
    return _Wanted(column, signal, sender), found[0]


def _key(message: Message) -> Key:
    return message.frame_id, message.is_extended_frame


def end_of(signal: Any) -> int:
    """Return the number of bytes that a message must have for a signal."""
    bit = signal.start if signal.byte_order == "little_endian" else signal.start ^ 7
    return -(-(bit + signal.length) // 8)
