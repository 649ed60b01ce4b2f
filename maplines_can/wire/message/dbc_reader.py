"""Reader of DBC files; the only module of `wire` that imports cantools."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from enum import Enum
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import cantools
import numpy as np
from cantools.database.can import Database, Message
from cantools.database.can import Signal as DbcSignal

from ...errors import LayoutError
from ...line import Kind, Slot, Status
from .dbc_limits import LARGEST_DBC, check_numbers
from .requirements import LEAST_FRESHNESS_BYTES, REQUIREMENTS, bits_of, check, pages_of
from .signals import PAGE, PAGE_BYTES, SECURED_SIGNALS, TRANSFER_ID, Signal
from .slot_messages import FD_LENGTHS, LONGEST_MS, SecuredLayout, SlotMessages

__all__ = [
    "Database",
    "DbcContent",
    "content_of",
    "default_dbc_path",
    "parse_database",
    "parse_dbc",
    "read_text",
]

#: Covariance code of a DBC without the attribute CovarianceCode.
DEFAULT_CODE = "Cholesky"


class DbcContent(NamedTuple):
    """Content of a DBC that matters to map lines; see ``Layout``."""

    signals: Mapping[str, Signal]
    messages: Mapping[Slot, SlotMessages]
    covariance_code: str
    secured: SecuredLayout | None


class FrameFormat(Enum):
    """Frame format of a message."""

    CLASSIC, FD, SECURED = range(3)


def default_dbc_path(name: str = "maplines.dbc") -> Path:
    """Return the path of one of the project's DBCs: in the installed package, or the checkout.

    Raises:
        LayoutError: it is in neither place.
    """
    packaged = resources.files(__package__.partition(".")[0]) / "dbc" / name
    checkout = Path(__file__).parents[3] / "dbc" / name
    for path in (Path(str(packaged)), checkout):
        if path.is_file():
            return path
    raise LayoutError(f"{name} is neither at {packaged} nor at {checkout}; reinstall")


def read_text(path: Path) -> str:
    """Return the text of a DBC file; raises LayoutError as ``Layout.from_dbc``."""
    try:
        with path.open("rb") as file:  # a pipe or device may never end
            data = file.read(LARGEST_DBC + 1)
    except OSError as error:
        raise LayoutError(f"{path}: cannot be read: {error.strerror or error}") from error
    if len(data) > LARGEST_DBC:
        raise LayoutError(f"{path}: is too large: a DBC must have {LARGEST_DBC:,} bytes at most")
    try:
        return data.decode("cp1252")  # the encoding that DBC tools write
    except UnicodeDecodeError as error:
        raise LayoutError(f"{path}: is not a valid DBC: {error}") from error


def parse_dbc(text: str, source: str) -> DbcContent:
    """Read the record and its messages from the text of a DBC.

    Raises:
        LayoutError: the text is not a DBC, or does not describe a map line.
    """
    return content_of(parse_database(text, source), source)


def parse_database(text: str, source: str, *, strict: bool = True) -> Database:
    """Return the database of the text of a DBC.

    Args:
        text: of the DBC.
        source: its name, for messages.
        strict: whether signals that overlap, or do not fit into their message, are an error.

    Raises:
        LayoutError: the text is not a DBC.
    """
    check_numbers(text, source)
    try:
        database = cantools.database.load_string(text, database_format="dbc", strict=strict)
    except Exception as error:  # the parser raises many types, all for a text that is not a DBC
        reason = " ".join(str(error).split()) or type(error).__name__
        raise LayoutError(f"{source}: is not a valid DBC: {reason}") from error
    if not isinstance(database, Database):
        raise LayoutError(f"{source}: is not a DBC of CAN messages")
    return database


def content_of(database: Database, source: str) -> DbcContent:
    """Read the record and its messages from a loaded database.

    Raises:
        LayoutError: it does not describe a map line.
    """
    records: dict[str, dict[str, Signal]] = {}
    messages: dict[Slot, dict[FrameFormat, Message]] = {}
    layouts: dict[str, SecuredLayout] = {}
    for message in database.messages:
        number = _attribute(message, "MapLineSlot")
        if number is None:
            continue
        where = f"{source}: message {message.name}: MapLineSlot"
        slot = Slot(_integer(number, where, len(Slot) - 1))
        kind = FrameFormat.FD if message.is_fd else FrameFormat.CLASSIC
        if _attribute(message, "SecOCDataId") is not None:
            layouts[message.name], kind = _secured_layout(message, source), FrameFormat.SECURED
        if messages.setdefault(slot, {}).setdefault(kind, message) is not message:
            raise LayoutError(f"{source}: slot {slot.name} has two messages in one frame format")
        _check_frame(message, kind, source)
        for signal in message.signals:
            _check_choices(signal, f"{source}: message {message.name}")
        records[message.name] = _record(message, source)
    if not records:
        raise LayoutError(
            f"{source}: no message has the attribute MapLineSlot, so none carries a map line"
        )
    _check_can_ids(database, records, source)
    signals = _shared_signals(records, source)
    if len(set(layouts.values())) > 1:
        raise LayoutError(f"{source}: messages {', '.join(layouts)} must have the same lengths")
    code = database.dbc.attributes.get("CovarianceCode") if database.dbc else None
    return DbcContent(
        signals=signals,
        messages={slot: _slot_messages(slot, messages[slot], source) for slot in sorted(messages)},
        covariance_code=DEFAULT_CODE if code is None else str(code.value),
        secured=next(iter(layouts.values()), None),
    )


def _shared_signals(records: Mapping[str, Mapping[str, Signal]], source: str) -> dict[str, Signal]:
    """Return the signals that all messages have; others do not belong to the record."""
    (first, signals), *others = records.items()
    for name, other in others:
        differing = sorted(s for s in signals.keys() & other.keys() if signals[s] != other[s])
        differing += [f"{PAGE}{n}" for n in {*pages_of(signals)} ^ {*pages_of(other)}]
        if differing:
            raise LayoutError(
                f"{source}: messages {first} and {name} must hold the same signals at the same "
                f"places, but {', '.join(differing)} differ"
            )
    shared = set(signals).intersection(*(other for _, other in others))
    return {name: signal for name, signal in signals.items() if name in shared}


def _check_frame(message: Message, kind: FrameFormat, source: str) -> None:
    """Check the length and the multiplexer of a message against its frame format."""
    where = f"{source}: message {message.name}"
    if kind is FrameFormat.CLASSIC and message.length != PAGE_BYTES:
        raise LayoutError(
            f"{where}: a page must have 8 bytes, got {message.length}; for a whole record in one "
            "frame, make it a CAN FD message (VFrameFormat)"
        )
    if kind is FrameFormat.CLASSIC:
        return
    if message.length not in FD_LENGTHS or not message.is_fd:
        raise LayoutError(
            f"{where}: must be a CAN FD message (VFrameFormat) with a valid CAN FD payload length, "
            f"got {message.length} bytes"
        )
    if any(signal.is_multiplexer for signal in message.signals):
        raise LayoutError(
            f"{where}: a CAN FD message holds all pages, so it must not have a multiplexer"
        )


def _check_choices(signal: DbcSignal, where: str) -> None:
    """Check that VAL_ gives no name of a Status or Kind to another value; new names are allowed."""
    enumeration = {"Status": Status, "Kind": Kind}.get(signal.name)
    names = enumeration.__members__ if enumeration else {}
    for number, text in (signal.choices or {}).items():
        if names.get(str(text), number) != number:
            raise LayoutError(
                f"{where}: signal {signal.name}: VAL_ gives the value {number} the name {text}, "
                f"which belongs to the value {names[str(text)].value}; correct VAL_"
            )


def _check_can_ids(database: Database, own: Iterable[str], source: str) -> None:
    """Check that no message has the same CAN ID as a message of a map line."""
    names: dict[tuple[int, bool], str] = {}
    for message in database.messages:
        first = names.setdefault((message.frame_id, message.is_extended_frame), message.name)
        if first != message.name and not {first, message.name}.isdisjoint(own):
            raise LayoutError(
                f"{source}: messages {first} and {message.name} have the same CAN ID, "
                f"{message.frame_id}; give each its own"
            )


def _slot_messages(slot: Slot, messages: dict[FrameFormat, Message], source: str) -> SlotMessages:
    classic, fd, secured = (messages.get(kind) for kind in FrameFormat)
    data_ids = {_attribute(message, "E2EDataId") for message in messages.values()}
    data_id = data_ids.pop()
    if data_ids or data_id is None:
        raise LayoutError(
            f"{source}: slot {slot.name}: its messages need the same attribute E2EDataId"
        )
    secured_data_id = 0
    if secured:
        what = f"{source}: message {secured.name}: SecOCDataId"
        secured_data_id = _integer(_attribute(secured, "SecOCDataId"), what, 0xFFFF)
    message = next(m for m in (classic, fd, secured) if m is not None)
    where = f"{source}: message {message.name}"
    return SlotMessages(
        slot=slot,
        name=message.name,
        can_id=classic.frame_id if classic else None,
        fd_can_id=fd.frame_id if fd else None,
        is_extended=bool(classic and classic.is_extended_frame),
        fd_is_extended=bool(fd and fd.is_extended_frame),
        fd_length=fd.length if fd else 0,
        data_id=_integer(data_id, f"{where}: E2EDataId", 0xFFFF),
        cycle_ms=_integer(message.cycle_time or 0, f"{where}: GenMsgCycleTime", LONGEST_MS),
        secured_can_id=secured.frame_id if secured else None,
        secured_is_extended=bool(secured and secured.is_extended_frame),
        secured_data_id=secured_data_id,
    )


def _attribute(message: Message, name: str) -> Any:
    """Return the value of an attribute of a message; None if it has none."""
    attributes = message.dbc.attributes if message.dbc else {}
    return attributes[name].value if name in attributes else None


def _secured_layout(message: Message, source: str) -> SecuredLayout:
    """Return the layout of an authenticated message, which must be that of AUTOSAR SecOC."""
    where = f"{source}: message {message.name}"
    signals = {signal.name: signal for signal in message.signals}
    end, sizes = message.length, {}
    for name, most in reversed(SECURED_SIGNALS.items()):
        least = LEAST_FRESHNESS_BYTES if name == "Freshness" else 1
        signal = signals.get(name)
        size, odd_bits = divmod(signal.length if signal else 0, 8)
        end -= size
        motorola = signal is not None and signal.byte_order == "big_endian"
        if (
            signal is None
            or odd_bits
            or not 1 <= size <= most
            or signal.start != 8 * end + (7 if motorola else 0)
            or not (motorola or size == 1)
        ):
            size_text = "1 byte" if most == 1 else f"{least} to {most} bytes"
            raise LayoutError(
                f"{where}: must end with {', '.join(SECURED_SIGNALS)}, in Motorola byte order and "
                f"of whole bytes; {name} must have {size_text}, and end in byte {end + size - 1}"
            )
        sizes[name] = size
    for name in SECURED_SIGNALS:
        check(_signal(signals[name]), REQUIREMENTS[name], where)
    return SecuredLayout(message.length, sizes["Freshness"], sizes["Mac"])


def _integer(value: Any, what: str, most: int) -> int:
    """Return the value of an attribute as an integer from 0 to ``most``."""
    try:
        number = int(value)
        number = number if isinstance(value, str) or number == value else -1
    except (ValueError, TypeError, OverflowError):
        number = -1
    if not 0 <= number <= most:
        raise LayoutError(f"{what} must be a whole number from 0 to {most}, got {value!r}")
    return number


def _record(message: Message, source: str) -> dict[str, Signal]:
    """Return the signals with bit positions in the record, independent of the frame format."""
    where = f"{source}: message {message.name}"
    multiplexers = [signal for signal in message.signals if signal.is_multiplexer]
    if multiplexers:
        signals = _paged_signals(message, multiplexers, where)
    else:
        own = [signal for signal in message.signals if signal.name not in SECURED_SIGNALS]
        signals = [_signal(signal) for signal in own]
    record = {signal.name: signal for signal in sorted(signals, key=lambda signal: signal.start)}
    if f"{TRANSFER_ID}0" not in record and {"Counter", f"{TRANSFER_ID}1"} <= set(record):
        record[f"{TRANSFER_ID}0"] = _low_bits(
            record["Counter"], f"{TRANSFER_ID}0", record[f"{TRANSFER_ID}1"].length
        )
    pages = pages_of(record)
    if not pages or (not multiplexers and message.length < len(pages) * PAGE_BYTES):
        raise LayoutError(
            f"{where}: must have pages of 8 bytes, each with {PAGE} and {TRANSFER_ID}"
        )
    # The padding of a CAN FD message may hold other signals.
    end = 8 * PAGE_BYTES * len(pages)
    return {name: signal for name, signal in record.items() if min(bits_of(signal)) < end}


def _paged_signals(message: Message, multiplexers: list[DbcSignal], where: str) -> list[Signal]:
    """Return the signals of a multiplexed message, its pages concatenated."""
    if len(multiplexers) > 1 or multiplexers[0].name != PAGE:
        raise LayoutError(f"{where}: must have one multiplexer, named {PAGE}")
    pages = sorted({i for s in message.signals for i in s.multiplexer_ids or ()})
    if pages != list(range(len(pages))):
        raise LayoutError(f"{where}: pages must be numbered 0, 1, ..., got {pages}")
    signals = []
    for dbc_signal in message.signals:
        signal = _signal(dbc_signal)
        if dbc_signal.multiplexer_ids is None:  # repeated in every page
            for page in pages:
                start = signal.start + 8 * PAGE_BYTES * page
                signals.append(replace(signal, name=f"{signal.name}{page}", start=start))
        elif len(dbc_signal.multiplexer_ids) == 1:
            start = signal.start + 8 * PAGE_BYTES * dbc_signal.multiplexer_ids[0]
            signals.append(replace(signal, start=start))
        else:
            raise LayoutError(f"{where}: signal {signal.name} must be in one page or in all")
    return signals


def _low_bits(signal: Signal, name: str, length: int) -> Signal:
    """Return the low bits of an unsigned signal, as a signal."""
    start = signal.start
    if signal.big_endian:  # bits count downwards within a byte, upwards from byte to byte
        place = start // 8 * 8 + 7 - start % 8 + signal.length - length
        start = place // 8 * 8 + 7 - place % 8
    return replace(signal, name=name, start=start, length=length, raw_min=0, raw_max=2**length - 1)


def _signal(signal: DbcSignal) -> Signal:
    """Convert a cantools signal to a `Signal`; ``requirements`` checks those of the record."""
    factor, offset = float(signal.scale), float(signal.offset)
    converted = Signal(
        name=signal.name,
        start=signal.start,
        length=signal.length,
        big_endian=signal.byte_order == "big_endian",
        signed=bool(signal.is_signed and not signal.is_float),
        factor=factor,
        offset=offset,
        unit=signal.unit or "",
        raw_min=0,
        raw_max=0,
        is_float=bool(signal.is_float),
    )
    low, high = converted.all_raw
    bounds = (signal.minimum, signal.maximum)
    if None not in bounds and factor and not signal.is_float:  # the DBC's range, if it is narrower
        with np.errstate(all="ignore"):
            ends = (np.array(bounds, dtype=float) - offset) / factor
        ends = np.nan_to_num(ends[:: 1 if factor > 0 else -1]).clip(-(2.0**65), 2.0**65)
        slack = 1e-6  # a bound that was rounded to decimals still admits its raw value
        low, high = max(low, math.ceil(ends[0] - slack)), min(high, math.floor(ends[1] + slack))
    return replace(converted, raw_min=low, raw_max=high)
