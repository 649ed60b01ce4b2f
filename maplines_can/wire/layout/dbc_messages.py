"""Messages of a DBC: frame format, attributes, signals, and the trailer of authenticated ones."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Mapping
from dataclasses import replace
from enum import Enum

from ...dbc_files.dbc_tables import Attribute, DbcMessage, DbcSignal
from ...values.errors import LayoutError
from .record_layout import pages_of
from .record_signals import PAGE, PAGE_BYTES, TRAILER, Signal
from .signal import all_raw
from .slot_messages import FD_LENGTHS, MAX_MS, RecordMessages, SecuredLayout


class FrameFormat(Enum):
    """Frame format of a message."""

    CLASSIC, FD, SECURED = range(3)


def format_of(message: DbcMessage) -> FrameFormat:
    """Return the frame format of a message."""
    if message.secoc_data_id is not None:
        return FrameFormat.SECURED
    return FrameFormat.FD if message.is_fd else FrameFormat.CLASSIC


def check_frame(message: DbcMessage, kind: FrameFormat, source: str) -> None:
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


def record_messages(
    owner: str, messages: Mapping[FrameFormat, DbcMessage], source: str
) -> RecordMessages:
    """Return the messages of a record, which belong to ``owner``, as errors name it."""
    classic, fd, secured = (messages.get(kind) for kind in FrameFormat)
    data_ids = {message.e2e_data_id for message in messages.values()}
    data_id = data_ids.pop()
    if data_ids or data_id is None:
        raise LayoutError(f"{source}: {owner}: its messages need the same attribute E2EDataId")
    secured_data_id = 0
    if secured:
        what = f"{source}: message {secured.name}: SecOCDataId"
        secured_data_id = integer(secured.secoc_data_id, what, 0xFFFF)
    message = next(m for m in (classic, fd, secured) if m is not None)
    where = f"{source}: message {message.name}"
    return RecordMessages(
        name=message.name,
        can_id=classic.can_id if classic else None,
        fd_can_id=fd.can_id if fd else None,
        is_extended=bool(classic and classic.is_extended),
        fd_is_extended=bool(fd and fd.is_extended),
        fd_length=fd.length if fd else 0,
        data_id=integer(data_id, f"{where}: E2EDataId", 0xFFFF),
        cycle_ms=integer(message.cycle or 0, f"{where}: GenMsgCycleTime", MAX_MS),
        secured_can_id=secured.can_id if secured else None,
        secured_is_extended=bool(secured and secured.is_extended),
        secured_data_id=secured_data_id,
    )


def secured_layout(message: DbcMessage, source: str) -> SecuredLayout:
    """Return the layout of an authenticated message, which must be that of AUTOSAR SecOC."""
    where = f"{source}: message {message.name}"
    signals = {signal.name: to_signal(signal) for signal in message.signals}
    end, sizes = message.length, {}
    for name, bounds in reversed([*TRAILER.items()]):
        least, most = (bits // 8 for bits in bounds.bits)
        signal = signals.get(name)
        size, odd_bits = divmod(signal.length if signal else 0, 8)
        end -= size
        is_one_order = signal is not None and (signal.big_endian or size == 1)
        first = 8 * end + (7 if signal is None or signal.big_endian else 0)
        if signal is None or odd_bits or size > most or signal.start != first or not is_one_order:
            size_text = "1 byte" if most == 1 else f"{least} to {most} bytes"
            raise LayoutError(
                f"{where}: must end with {', '.join(TRAILER)}, in Motorola byte order and "
                f"of whole bytes; {name} must have {size_text}, and end in byte {end + size - 1}"
            )
        sizes[name] = size
    for name, bounds in TRAILER.items():
        bounds.check(signals[name], where)
    return SecuredLayout(message.length, sizes["Freshness"], sizes["Mac"])


def secured_layout_of(
    messages: Iterable[Mapping[FrameFormat, DbcMessage]], source: str
) -> SecuredLayout | None:
    """Return the layout that all authenticated messages have; None if there is none."""
    secured = [own[FrameFormat.SECURED] for own in messages if FrameFormat.SECURED in own]
    layouts = {message.name: secured_layout(message, source) for message in secured}
    if len(set(layouts.values())) > 1:
        raise LayoutError(f"{source}: messages {', '.join(layouts)} must have the same lengths")
    return next(iter(layouts.values()), None)


def shared_signals(records: Mapping[str, Mapping[str, Signal]], source: str) -> dict[str, Signal]:
    """Return the signals that all messages have; others do not belong to the record."""
    (first, signals), *others = records.items()
    for name, other in others:
        both = signals.keys() & other.keys()
        differing = sorted(signals[s].dbc_name for s in both if signals[s] != other[s])
        differing += [f"{PAGE}{n}" for n in {*pages_of(signals)} ^ {*pages_of(other)}]
        if differing:
            raise LayoutError(
                f"{source}: messages {first} and {name} must hold the same signals at the same "
                f"places, but {', '.join(differing)} differ"
            )
    shared = set(signals).intersection(*(other for _, other in others))
    return {name: signal for name, signal in signals.items() if name in shared}


def check_choices(signal: DbcSignal, names: Mapping[str, int], where: str) -> None:
    """Check that VAL_ gives no name to the value of another one; new names are allowed.

    Args:
        signal: of the DBC.
        names: values by their names.
        where: name of the DBC and of the message.
    """
    for number, text in signal.names:
        if names.get(text, number) != number:
            raise LayoutError(
                f"{where}: signal {signal.name}: VAL_ gives the value {number} the name {text}, "
                f"which belongs to the value {int(names[text])}; correct VAL_"
            )


def integer(value: Attribute, what: str, most: int) -> int:
    """Return the value of an attribute as an integer from 0 to ``most``."""
    try:
        number = -1 if value is None else int(value)
        valid = (isinstance(value, str) or number == value) and 0 <= number <= most
    except (ValueError, OverflowError):
        valid = False
    if not valid:
        raise LayoutError(f"{what} must be a whole number from 0 to {most}, got {value!r}")
    return number


def low_bits(signal: Signal, name: str, length: int) -> Signal:
    """Return the low bits of an unsigned signal, as a signal."""
    start = signal.start
    if signal.big_endian:  # bits count downwards within a byte, upwards from byte to byte
        place = start // 8 * 8 + 7 - start % 8 + signal.length - length
        start = place // 8 * 8 + 7 - place % 8
    return replace(signal, name=name, start=start, length=length, raw_min=0, raw_max=2**length - 1)


def to_signal(signal: DbcSignal) -> Signal:
    """Convert a signal of a DBC; ``Bounds`` checks those of the record."""
    factor, offset = signal.factor, signal.offset
    signed = signal.signed and not signal.is_float
    low, high = all_raw(signal.length, signed)
    bounds = [bound for bound in (signal.minimum, signal.maximum) if bound is not None]
    if len(bounds) == 2 and factor != 0 and not signal.is_float:  # the DBC's range, if narrower
        ends = [_finite((bound - offset) / factor) for bound in bounds]
        first, last = ends if factor > 0 else ends[::-1]
        low, high = max(low, round(first)), min(high, round(last))  # bounds are rounded to decimals
    return Signal(
        name=signal.name,
        start=signal.start,
        length=signal.length,
        big_endian=signal.big_endian,
        signed=signed,
        factor=factor,
        offset=offset,
        unit=signal.unit,
        raw_min=low,
        raw_max=high,
        is_float=signal.is_float,
    )


def _finite(value: float) -> float:
    """Return the finite number nearest to a value; 0 for NaN."""
    most = sys.float_info.max
    return 0.0 if math.isnan(value) else max(-most, min(value, most))
