"""Reader of DBC files; the only module of `wire` that imports cantools."""

from __future__ import annotations

from collections.abc import Mapping
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
from ...line import Slot
from .dbc_limits import LARGEST_DBC, check_numbers
from .signals import PAGE, PAGE_BYTES, SECURED_SIGNALS, TRANSFER_ID, Signal
from .slot_messages import LONGEST_MS, SecuredLayout, SlotMessages, fd_length

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
    check_numbers(text, source)
    try:
        database = cantools.database.load_string(text, database_format="dbc", strict=True)
    except Exception as error:  # the parser raises many types, all for a text that is not a DBC
        reason = " ".join(str(error).split()) or type(error).__name__
        raise LayoutError(f"{source}: is not a valid DBC: {reason}") from error
    if not isinstance(database, Database):
        raise LayoutError(f"{source}: is not a DBC of CAN messages")
    return _content(database, source)


def _content(database: Database, source: str) -> DbcContent:
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
        records[message.name] = _record(message, source)
    if not records:
        raise LayoutError(
            f"{source}: no message has the attribute MapLineSlot, so none carries a map line"
        )
    (first, signals), *others = records.items()
    for name, other in others:
        if other != signals:
            differing = sorted({s for s in {*signals, *other} if signals.get(s) != other.get(s)})
            raise LayoutError(
                f"{source}: messages {first} and {name} must hold the same signals at the same "
                f"places, but {', '.join(differing)} differ"
            )
    if len(set(layouts.values())) > 1:
        raise LayoutError(f"{source}: messages {', '.join(layouts)} must have the same lengths")
    code = database.dbc.attributes.get("CovarianceCode") if database.dbc else None
    return DbcContent(
        signals=signals,
        messages={slot: _slot_messages(slot, messages[slot], source) for slot in sorted(messages)},
        covariance_code=DEFAULT_CODE if code is None else str(code.value),
        secured=next(iter(layouts.values()), None),
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
        fd_length=fd_length(fd.length) if fd else 0,
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
            raise LayoutError(
                f"{where}: must end with {', '.join(SECURED_SIGNALS)}, in Motorola byte order and "
                f"of whole bytes; {name} must have 1 to {most} bytes"
            )
        sizes[name] = size
    if not message.is_fd or message.length != fd_length(message.length):
        raise LayoutError(f"{where}: must be a CAN FD message with a valid CAN FD payload length")
    return SecuredLayout(message.length, sizes["Freshness"], sizes["Mac"])


def _integer(value: Any, what: str, most: int) -> int:
    """Return the value of an attribute as an integer from 0 to ``most``."""
    try:
        number = int(value)
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
        signals = [_signal(signal, where) for signal in own]
    record = {signal.name: signal for signal in sorted(signals, key=lambda signal: signal.start)}
    if f"{TRANSFER_ID}0" not in record and {"Counter", f"{TRANSFER_ID}1"} <= set(record):
        record[f"{TRANSFER_ID}0"] = _low_bits(
            record["Counter"], f"{TRANSFER_ID}0", record[f"{TRANSFER_ID}1"].length
        )
    pages = sum(name.startswith(PAGE) for name in record)
    for page in range(pages):
        for name in (f"{PAGE}{page}", f"{TRANSFER_ID}{page}"):
            if name not in record:
                raise LayoutError(f"{where}: signal {name} is missing")
    for signal in record.values():
        if signal.start >= 8 * PAGE_BYTES * pages:
            raise LayoutError(f"{where}: signal {signal.name} lies beyond the {pages} pages")
    if not pages or (not multiplexers and message.length < pages * PAGE_BYTES):
        raise LayoutError(
            f"{where}: must have pages of 8 bytes, each with {PAGE} and {TRANSFER_ID}"
        )
    return record


def _paged_signals(message: Message, multiplexers: list[DbcSignal], where: str) -> list[Signal]:
    """Return the signals of a multiplexed message, its pages concatenated."""
    if len(multiplexers) > 1 or multiplexers[0].name != PAGE:
        raise LayoutError(f"{where}: must have one multiplexer, named {PAGE}")
    if message.length != PAGE_BYTES:
        raise LayoutError(f"{where}: a page must have 8 bytes, got {message.length}")
    pages = sorted({i for s in message.signals for i in s.multiplexer_ids or ()})
    if pages != list(range(len(pages))):
        raise LayoutError(f"{where}: pages must be numbered 0, 1, ..., got {pages}")
    signals = []
    for dbc_signal in message.signals:
        signal = _signal(dbc_signal, where)
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


def _signal(signal: DbcSignal, where: str) -> Signal:
    """Convert a cantools signal to a `Signal`."""
    numbers = (signal.scale, signal.offset, signal.minimum, signal.maximum)
    if not all(number is None or abs(number) < 1e300 for number in numbers):  # or NaN
        raise LayoutError(f"{where}: signal {signal.name} needs a finite factor, offset and range")
    factor, offset = float(signal.scale), float(signal.offset)
    if signal.is_float and (signal.length, factor, offset) != (32, 1, 0):
        raise LayoutError(
            f"{where}: signal {signal.name} is a float; it needs 32 bits, factor 1 and offset 0, "
            "or an integer type"
        )
    low, high = (-(2 ** (signal.length - 1)), 2 ** (signal.length - 1) - 1)
    signed = signal.is_signed and not signal.is_float
    if not signed:
        low, high = 0, 2**signal.length - 1
    if signal.length > (64 if signed else 63):
        raise LayoutError(f"{where}: signal {signal.name} has more than 63 bits; make it narrower")
    if not factor:
        raise LayoutError(f"{where}: signal {signal.name} needs a finite factor other than 0")
    bounds = sorted(
        (bound - offset) / factor for bound in (signal.minimum, signal.maximum) if bound is not None
    )
    if len(bounds) == 2 and not signal.is_float:  # the DBC's range, if it is narrower
        bounds = np.clip(bounds, -(2.0**65), 2.0**65).tolist()  # beyond all raw values
        slack = 1e-6  # a bound that was rounded to decimals still admits its raw value
        low = max(low, int(np.ceil(bounds[0] - slack)))
        high = max(low, min(high, int(np.floor(bounds[1] + slack))))
    return Signal(
        name=signal.name,
        start=signal.start,
        length=signal.length,
        big_endian=signal.byte_order == "big_endian",
        signed=signed,
        factor=factor,
        offset=offset,
        unit=signal.unit or "",
        raw_min=low,
        raw_max=high,
        is_float=bool(signal.is_float),
    )
