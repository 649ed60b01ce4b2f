"""Configuration of a restbus simulation: a TOML file, checked before anything is sent."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..dbc_files.parser import parse_database, read_text
from ..logs.j1939 import ANY_SOURCE, j1939_messages, source_of
from ..values.errors import LayoutError, RestbusError
from ..values.input_files import toml_of
from ..wire import Codec
from .fields import with_exact_starts
from .line_sources import Lines, codec_of, lines_of
from .messages import MAX_MS, DbcMessage
from .toml_tables import Table, listed, nearest

if TYPE_CHECKING:
    from cantools.database.can import Database, Message

#: Largest configuration [bytes], and latest event [s].
MAX_CONFIG, MAX_S = 10**6, 1e7
#: Configuration that shows all there is, and the DBC of its messages.
EXAMPLE, EXAMPLE_DBC = Path(__file__).with_name("example.toml"), "example-car.dbc"


@dataclass
class LinesConfig:
    """Lines that are sent."""

    codec: Codec
    lines: Lines
    period: float  #: [s]
    start: float  #: of the first transfer [s]
    fd: bool


@dataclass(frozen=True)
class Event:
    """Command that is executed at a time."""

    at: float  #: since the start [s]
    command: str


@dataclass
class Config:
    """Configuration of a restbus simulation.

    It has state, such as counters of messages: load it again for another run.

    Args:
        lines: the lines; None for none.
        messages: by name.
        events: in order of time.
        faults: at the start, as for ``Faults.parse``; empty for none.
        seconds: how long to run [s]; None for no end.
        seed: of faults, and of the pose errors of a drive.
        bus: settings of python-can, such as interface and channel.
    """

    lines: LinesConfig | None = None
    messages: dict[str, DbcMessage] = field(default_factory=dict)
    events: list[Event] = field(default_factory=list)
    faults: str = ""
    seconds: float | None = None
    seed: int = 0
    bus: dict[str, Any] = field(default_factory=dict)

    @property
    def notices(self) -> list[str]:
        """What is sent otherwise than the DBC says, or is not sent, and of which messages."""
        names: dict[str, list[str]] = {}
        for message in self.messages.values():
            for text in message.notices:
                names.setdefault(text, []).append(message.name)
        return [f"{listed(own)}: {text}" for text, own in names.items()]

    @classmethod
    def load(
        cls, path: str | PathLike[str], *, seed: int | None = None, encoding: str | None = None
    ) -> Config:
        """Read a file; paths in it are relative to its folder.

        Args:
            path: of the file.
            seed: instead of that of the file.
            encoding: of the DBCs, instead of that of the file.

        Raises:
            RestbusError: the file cannot be read, or its content is wrong.
            MaplinesError: a file that it names cannot be used.
        """
        try:
            with Path(path).open("rb") as file:
                data = file.read(MAX_CONFIG + 1)
        except OSError as error:
            raise RestbusError(f"{fspath(path)}: cannot be read: {error.strerror}") from error
        if len(data) > MAX_CONFIG:
            raise RestbusError(f"{fspath(path)}: must have {MAX_CONFIG:,} bytes at most")
        try:
            text = data.decode()
        except UnicodeDecodeError as error:
            raise RestbusError(f"{fspath(path)}: is not valid TOML: {error}") from error
        values = toml_of(text, fspath(path), RestbusError)
        try:
            return cls.from_dict(values, Path(path).parent, seed=seed, encoding=encoding)
        except RestbusError as error:
            raise RestbusError(f"{fspath(path)}: {error}") from error

    @classmethod
    def from_dict(
        cls,
        values: Mapping[str, Any],
        folder: Path = Path(),
        *,
        seed: int | None = None,
        encoding: str | None = None,
    ) -> Config:
        """Return the configuration of the values of a TOML file.

        Raises:
            RestbusError: a value is wrong.
            MaplinesError: a file that it names cannot be used.
        """
        table = Table(values, "")
        own_seed = int(table.number("seed", 0, 2**32, "", 0, whole=True))
        config = cls(seed=own_seed if seed is None else seed)
        if "seconds" in table:
            config.seconds = table.number("seconds", 1e-3, MAX_S, "s")
        config.faults = table.text("faults") if "faults" in table else ""
        bus, lines = table.table("bus"), table.table("lines")
        if bus is not None:
            config.bus = _bus(bus)
        databases: dict[str, Database] = {}
        default = table.take("dbc")
        own_encoding = table.text("encoding") if "encoding" in table else None
        encoding = encoding or own_encoding
        for number_, entry in enumerate(table.tables("message"), 1):
            message = _message(entry, number_, default, folder, databases, encoding)
            if message.name in (*config.messages, "lines"):
                raise RestbusError(
                    f"message {message.name}: stands twice; count and gap_ms make bursts"
                )
            config.messages[message.name] = message
        if lines is not None:
            config.lines = _lines(lines, config, folder, encoding)
        config.events = sorted(
            (_event(entry, n) for n, entry in enumerate(table.tables("event"), 1)),
            key=lambda event: event.at,
        )
        table.end("seconds", "faults", "encoding")
        if config.lines is None and not config.messages:
            raise RestbusError("there is nothing to send; add [lines] or [[message]]")
        return config


def _bus(table: Table) -> dict[str, Any]:
    settings: dict[str, Any] = {
        key: table.text(key) for key in ("interface", "channel") if key in table
    }
    for key in ("bitrate", "data_bitrate"):
        if key in table:
            settings[key] = int(table.number(key, 1000, 1e8, "bit/s", whole=True))
    if table.flag("fd"):
        settings["fd"] = True
    table.end("interface", "channel", "bitrate", "data_bitrate")
    return settings


def _message(
    entry: object,
    number: int,
    default: object,
    folder: Path,
    databases: dict[str, Database],
    encoding: str | None,
) -> DbcMessage:
    table = Table(entry, f"message {number}")
    name = table.text("name")
    table.name = f"message {name}"
    path = table.text("dbc", default if isinstance(default, str) else None)
    if path not in databases:
        try:
            text = with_exact_starts(read_text(_dbc(path, folder), encoding))
            databases[path] = parse_database(text, path, strict=False)
        except LayoutError as error:
            raise RestbusError(f"{table.name}: dbc: {error}") from error
    database = databases[path]
    found = [message for message in database.messages if message.name == name]
    if not found:
        hint = nearest(name, (message.name for message in database.messages), "its messages are")
        raise RestbusError(f"{table.name}: {path} has no such message{hint}")
    if len(found) > 1:
        raise RestbusError(f"{table.name}: {path} has {len(found)} messages of this name")
    address = _address(database, found[0]) if found[0] in j1939_messages(database) else None
    return DbcMessage(table, found[0], folder, address)


def _address(database: Database, message: Message) -> int:
    """Return the address of the sender in J1939: of the identifier, else of the node."""
    address = source_of(message.frame_id)
    if address != ANY_SOURCE:
        return address
    senders = [node for node in database.nodes if node.name in message.senders and node.dbc]
    stated = [node.dbc.attributes.get("NmStationAddress") for node in senders]
    return next((int(each.value) for each in stated if each is not None), address)


def _dbc(name: str, folder: Path) -> Path:
    """Return the path of a DBC; that of the example is in this package."""
    path = folder / name
    return EXAMPLE.with_name(name) if name == EXAMPLE_DBC and not path.exists() else path


def _lines(table: Table, config: Config, folder: Path, encoding: str | None) -> LinesConfig:
    codec = codec_of(table.text("dbc", "maplines.dbc"), folder, encoding)
    period = table.number("period_ms", 1, MAX_MS, "ms", 50) / 1000
    start = table.number("start_ms", 0, MAX_MS, "ms", 0) / 1000
    fd = table.flag("fd") or not codec.layout.has_classic
    lines = lines_of(table, codec, period, config.seed, folder)
    table.end()
    return LinesConfig(codec, lines, period, start, fd)


def _event(entry: object, number: int) -> Event:
    table = Table(entry, f"event {number}")
    event = Event(table.number("at_s", 0, MAX_S, "s"), table.text("command"))
    table.end()
    return event
