"""Tables of a DBC: what of it matters to map lines, as plain data, and as JSON.

cantools makes them of a DBC, and everything else is made of them. They hold what the DBC states,
before any check.
"""

from __future__ import annotations

import hashlib
import json
import math
from contextlib import suppress
from functools import cache
from itertools import chain, repeat, starmap
from types import UnionType
from typing import TYPE_CHECKING, Any, NamedTuple, get_args, get_origin, get_type_hints

if TYPE_CHECKING:
    from cantools.database.can import Database, Message, Signal

#: Value of an attribute; None if the message has none.
Attribute = int | float | str | None
#: Ends of the names of signals whose values have names that matter.
NAMED = ("Status", "Kind")
#: Most bits of a message, of CAN FD.
MAX_BITS = 512


class DbcSignal(NamedTuple):
    """Signal of a message, as a DBC states it."""

    name: str
    start: int  #: first bit in the message, in the numbering of the DBC
    length: int  #: [bit]
    big_endian: bool
    signed: bool
    is_float: bool
    factor: float
    offset: float
    minimum: float | None
    maximum: float | None
    unit: str
    is_multiplexer: bool
    pages: tuple[int, ...] | None  #: values of the multiplexer with which it is sent; None: all
    names: tuple[tuple[int, str], ...]  #: of values, for those of `NAMED`


class DbcMessage(NamedTuple):
    """Message of a DBC, with the values of its attributes."""

    name: str
    can_id: int
    is_extended: bool
    is_fd: bool
    length: int  #: [byte]
    cycle: Attribute  #: [ms]
    slot: Attribute  #: MapLineSlot
    pose: Attribute  #: MapLinePose
    scene: Attribute  #: MapLineScene
    e2e_data_id: Attribute
    secoc_data_id: Attribute
    signals: tuple[DbcSignal, ...]  #: none of a message without a line and the pose error


class DbcTables(NamedTuple):
    """What of a DBC matters to map lines."""

    covariance_code: Attribute
    messages: tuple[DbcMessage, ...]
    sha256: str = ""  #: of the text of the DBC in UTF-8; empty for a database of cantools
    doubt: str = ""  #: why a unit or name is uncertain, as ``decoded`` says; empty if none is

    @property
    def is_unique(self) -> bool:
        """Whether each message has a name and a CAN ID of its own; else cantools logs a warning."""
        names = {message.name for message in self.messages}
        ids = {(message.can_id, message.is_extended) for message in self.messages}
        return len(names) == len(ids) == len(self.messages)


# ---- from cantools -------------------------------------------------------------------------


def tables_of(database: Database) -> DbcTables:
    """Return the tables of a database that cantools has loaded from a DBC."""
    code = database.dbc.attributes.get("CovarianceCode") if database.dbc else None
    messages = tuple(map(_message, database.messages))
    return DbcTables(None if code is None else _plain(code.value), messages)


def database_tables(database: object) -> DbcTables:
    """Return the tables of what a caller gives as a database.

    Raises:
        TypeError: it is none of cantools.
    """
    from cantools.database.can import Database

    if isinstance(database, Database):
        return tables_of(database)
    raise TypeError(
        "dbc must be a path, or a Database that cantools has loaded from a DBC, got a "
        f"{type(database).__name__}"
    )


def _message(message: Message) -> DbcMessage:
    attributes = message.dbc.attributes if message.dbc else {}
    slot, pose, scene, e2e, secoc = (
        _plain(attributes[name].value) if name in attributes else None
        for name in ("MapLineSlot", "MapLinePose", "MapLineScene", "E2EDataId", "SecOCDataId")
    )
    is_ours = (slot, pose, scene) != (None, None, None)
    return DbcMessage(
        name=message.name,
        can_id=message.frame_id,
        is_extended=bool(message.is_extended_frame),
        is_fd=bool(message.is_fd),
        length=message.length,
        cycle=_plain(message.cycle_time),
        slot=slot,
        pose=pose,
        scene=scene,
        e2e_data_id=e2e,
        secoc_data_id=secoc,
        signals=tuple(map(_signal, message.signals)) if is_ours else (),
    )


def _signal(signal: Signal) -> DbcSignal:
    choices: dict[Any, Any] = dict(signal.choices or {})
    ids = signal.multiplexer_ids
    return DbcSignal(
        name=signal.name,
        start=signal.start,
        length=signal.length,
        big_endian=signal.byte_order == "big_endian",
        signed=bool(signal.is_signed),
        is_float=bool(signal.is_float),
        factor=_number(signal.scale),
        offset=_number(signal.offset),
        minimum=None if signal.minimum is None else _number(signal.minimum),
        maximum=None if signal.maximum is None else _number(signal.maximum),
        unit=signal.unit or "",
        is_multiplexer=bool(signal.is_multiplexer),
        pages=None if ids is None else tuple(ids),
        names=tuple(
            (int(n), str(name)) for n, name in choices.items() if signal.name.endswith(NAMED)
        ),
    )


def _plain(value: Any) -> Attribute:
    return value if isinstance(value, Attribute) else str(value)


def _number(value: Any) -> float:
    try:
        return float(value)
    except OverflowError:  # an integer of hundreds of digits
        return math.inf if value > 0 else -math.inf


# ---- as JSON -------------------------------------------------------------------------------


def to_json(key: str, tables: DbcTables) -> str:
    """Return tables as a text in JSON, with their key and a checksum.

    A table is a list of rows with the values of its fields. Signals of several messages, such as
    those of the slots, stand there once.
    """
    signals = [*dict.fromkeys(message.signals for message in tables.messages)]
    messages = [(*message[:-1], signals.index(message.signals)) for message in tables.messages]
    content = [signals, messages, tables._replace(messages=())]
    return _text({"key": key, "checksum": _checksum(key, content), "content": content})


def from_json(key: str, text: str) -> DbcTables | None:
    """Return the tables of a text in JSON; None if it is not what `to_json` writes for the key.

    Whether they describe map lines is checked as if they came from a DBC.
    """
    try:
        found = json.loads(text)
        content = found["content"]
        if (found["key"], found["checksum"]) != (key, _checksum(key, content)):
            return None
        signals = _typed(tuple[tuple[DbcSignal, ...], ...], content[0])
        messages = tuple(
            _typed(DbcMessage, [*row[:-1], []])._replace(signals=signals[row[-1]])
            for row in content[1]
        )
        tables = _typed(DbcTables, content[2])._replace(messages=messages)
    except (ValueError, TypeError, LookupError, RecursionError):
        return None
    in_messages = (0 <= s.start < MAX_BITS and 0 < s.length <= MAX_BITS for s in chain(*signals))
    return tables if all(in_messages) else None


def _text(content: Any) -> str:
    return json.dumps(content, separators=(",", ":"))


def _checksum(key: str, content: Any) -> str:
    return hashlib.sha256(f"{key}{_text(content)}".encode()).hexdigest()


def _typed(kind: Any, value: Any) -> Any:
    """Return a value that was a list in JSON as the tuple, and the type, that it had.

    Raises:
        TypeError: it had another one.
    """
    if isinstance(kind, UnionType):
        for one in get_args(kind):
            with suppress(TypeError):
                return _typed(one, value)
    elif type(value) is kind:
        return value
    elif type(value) is list and hasattr(kind, "_fields"):
        return kind(*starmap(_typed, zip(_field_kinds(kind).values(), value, strict=True)))
    elif type(value) is list and get_origin(kind) is tuple:
        first, last = get_args(kind)
        kinds = repeat(first, len(value)) if last is ... else (first, last)
        return tuple(starmap(_typed, zip(kinds, value, strict=True)))
    raise TypeError(f"{value!r} is no {kind}")


_field_kinds = cache(get_type_hints)
