"""Read signals of any DBC: from frames, and from log files as time series."""

from __future__ import annotations

import csv
import tomllib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike, fspath
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ..values.errors import DriveFileError, LogError
from ..values.input_files import checked_path
from ..wire.layout.dbc_reader import Database, parse_database, read_text
from .logs import read_log

#: Largest table of signal names [B].
MAX_TABLE = 10**6

Series = tuple[NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class SignalLog(Mapping[str, Series]):
    """Time series of signals: (n,) times [s] and (n,) physical values, by name.

    Args:
        series: by name.
        skipped: numbers of frames that are not used, and of damage of the log, by reason.
    """

    series: Mapping[str, Series]
    skipped: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("series", "skipped"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    def __getitem__(self, name: str) -> Series:
        return self.series[name]

    def __iter__(self) -> Any:
        return iter(self.series)

    def __len__(self) -> int:
        return len(self.series)


class SignalDecoder:
    """Decoder of signals of any DBC, frame by frame.

    Args:
        dbc: of the messages.
        signals: see ``read_signals``.

    Raises:
        LayoutError: the DBC cannot be read.
        DriveFileError: the table cannot be read, or a signal is not in the DBC.
    """

    def __init__(
        self, dbc: str | PathLike[str], signals: Mapping[str, str] | str | PathLike[str]
    ) -> None:
        source = "signals" if isinstance(signals, Mapping) else fspath(signals)
        #: Names of the signals by the names of their series.
        self.names = dict(signals if isinstance(signals, Mapping) else read_table(signals))
        #: Numbers of frames that their message does not fit, by reason.
        self.skipped: Counter[str] = Counter()
        database = parse_database(read_text(Path(dbc)), fspath(dbc), strict=False)
        self._wanted: dict[tuple[int, bool], list[tuple[str, str]]] = {}
        for column, name in self.names.items():
            message, signal = _find(database, name, f"{source}: {column}", fspath(dbc))
            key = message.frame_id, message.is_extended_frame
            self._wanted.setdefault(key, []).append((column, signal))
        self._messages: dict[tuple[int, bool], Any] = {
            (m.frame_id, m.is_extended_frame): m for m in database.messages
        }

    @property
    def can_ids(self) -> frozenset[int]:
        """CAN IDs of the messages of the signals."""
        return frozenset(can_id for can_id, _ in self._wanted)

    def decode(self, can_id: int, data: bytes, *, is_extended: bool = False) -> dict[str, float]:
        """Return the physical values in a frame by the names of their series; none in others."""
        key = can_id, is_extended
        if key not in self._wanted:
            return {}
        message = self._messages[key]
        try:
            decoded = message.decode(data, decode_choices=False)
        except Exception:  # noqa: BLE001 - cantools raises many types, all for data that do not fit
            self.skipped[f"the data do not fit the message {message.name}"] += 1
            return {}
        # A signal that is missing is multiplexed, and not in this frame.
        return {
            column: float(decoded[signal])
            for column, signal in self._wanted[key]
            if signal in decoded
        }


def read_signals(
    log: str | PathLike[str] | IO[bytes],
    dbc: str | PathLike[str],
    signals: Mapping[str, str] | str | PathLike[str],
    channel: str | None = None,
) -> SignalLog:
    """Return signals of a log as time series, such as those of a drive for ``RecordedDrive``.

    A frame that its message does not fit is skipped and counted. The good part of a damaged log is
    used, and the damage is listed in ``skipped``.

    Args:
        log: see ``read_log``.
        dbc: of the messages in the log.
        signals: name of the signal by the name of its series, as "Message.Signal", or as "Signal"
            if only one message has it; or the path of such a table. A table in TOML has lines such
            as ``speed_kmh = "ESP.VehicleSpeed"``; one in CSV has the header ``column,signal``.
        channel: of the interface, if the log has frames of several; None for all.

    Raises:
        LogError: the log cannot be read, or has none of the frames of a signal.
        LayoutError: the DBC cannot be read.
        DriveFileError: the table cannot be read, or a signal is not in the DBC.
    """
    decoder = SignalDecoder(dbc, signals)
    times: dict[str, list[float]] = {column: [] for column in decoder.names}
    values: dict[str, list[float]] = {column: [] for column in decoder.names}
    try:
        for frame in read_log(log):
            if channel is not None and frame.channel != channel:
                continue
            found = decoder.decode(frame.can_id, frame.data, is_extended=frame.is_extended)
            for column, value in found.items():
                times[column].append(frame.t_ns * 1e-9)
                values[column].append(value)
    except LogError as error:
        if not all(times.values()):
            raise
        decoder.skipped[str(error)] += 1
    for column, name in decoder.names.items():
        if not times[column]:
            why = "; ".join(f"{count} times: {reason}" for reason, count in decoder.skipped.items())
            raise LogError(
                f"{log}: has no value of {column} = {name}; correct the name, the DBC or the "
                f"channel{f' ({why})' if why else ''}"
            )
    return SignalLog(
        {column: (np.array(times[column]), np.array(values[column])) for column in times},
        decoder.skipped,
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
        try:
            table = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise DriveFileError(f"{source}: is not valid TOML: {error}") from error
    for column, name in table.items():
        if not isinstance(name, str) or not name:
            raise DriveFileError(
                f'{source}: {column} must be the name of a signal, such as "ESP.VehicleSpeed", '
                f"got {name!r}"
            )
    if not table:
        raise DriveFileError(f"{source}: has no signal; see read_signals for the format")
    return table


def _find(database: Database, name: str, where: str, dbc: str) -> tuple[Any, str]:
    """Return the message of a signal, and the name of the signal."""
    message_name, _, signal = name.rpartition(".")
    found = [
        message
        for message in database.messages
        if message_name in {"", message.name} and signal in {s.name for s in message.signals}
    ]
    if len(found) != 1:
        which = ", ".join(f"{message.name}.{signal}" for message in found)
        raise DriveFileError(
            f"{where} = {name!r}: "
            + (f"is ambiguous in {dbc}; use one of {which}" if found else f"is not in {dbc}")
        )
    return found[0], signal
