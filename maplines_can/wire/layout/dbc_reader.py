"""Records of lines and of the pose error, and their messages, as the tables of a DBC have them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from ...dbc_files.tables import DbcMessage, DbcSignal, DbcTables
from ...values.errors import LayoutError
from ...values.line import Kind, Slot, Status
from .dbc_messages import (
    FrameFormat,
    check_frame,
    format_of,
    integer,
    low_bits,
    record_messages,
    secured_layout,
    to_signal,
)
from .pose_layout import POSE, Owner, PoseLayout, owner_name
from .record_layout import bits_of, pages_of
from .signals import PAGE, PAGE_BYTES, POSE_PREFIX, SECURED_SIGNALS, TRANSFER_ID, Signal
from .slot_messages import SecuredLayout

#: Covariance code of a DBC without the attribute CovarianceCode.
DEFAULT_CODE = "Cholesky"


def content_of(tables: DbcTables, source: str) -> dict[str, Any]:
    """Return the record and its messages that the tables of a DBC describe; see ``Layout``.

    Raises:
        LayoutError: it does not describe a map line.
    """
    records: dict[Owner, dict[str, dict[str, Signal]]] = {}
    messages: dict[Owner, dict[FrameFormat, DbcMessage]] = {}
    known: dict[object, dict[str, Signal]] = {}  # slots have the same signals
    for message in tables.messages:
        if (owner := _owner(message, source)) is None:
            continue
        kind = format_of(message)
        if messages.setdefault(owner, {}).setdefault(kind, message) is not message:
            raise LayoutError(f"{source}: {owner_name(owner)} has two messages in one frame format")
        check_frame(message, kind, source)
        for signal in message.signals:
            _check_choices(signal, f"{source}: message {message.name}")
        like = owner == POSE, message.length, message.signals
        if like not in known:
            known[like] = _record(message, owner, source)
        records.setdefault(owner, {})[message.name] = known[like]
    slots = sorted(owner for owner in messages if isinstance(owner, Slot))
    if not slots:
        raise LayoutError(
            f"{source}: no message has the attribute MapLineSlot, so none carries a map line"
        )
    _check_can_ids(tables.messages, [name for own in records.values() for name in own], source)
    lines = {name: record for slot in slots for name, record in records[slot].items()}
    code = tables.covariance_code
    pose = None
    if POSE in records:
        pose = PoseLayout(
            signals=_shared_signals(records[POSE], source),
            source=f"{source}: {owner_name(POSE)}",
            messages=record_messages(owner_name(POSE), messages[POSE], source),
            secured=_secured([messages[POSE]], source),
        )
    return {
        "signals": _shared_signals(lines, source),
        "messages": {s: record_messages(owner_name(s), messages[s], source) for s in slots},
        "covariance_code": DEFAULT_CODE if code is None else str(code),
        "secured": _secured([messages[slot] for slot in slots], source),
        "pose": pose,
    }


def _owner(message: DbcMessage, source: str) -> Owner | None:
    """Return the slot or the pose error whose record a message has; None if it has none."""
    where = f"{source}: message {message.name}"
    number, pose = message.slot, message.pose
    has_pose = pose is not None and integer(pose, f"{where}: MapLinePose", 1) == 1
    if number is None:
        return POSE if has_pose else None
    if has_pose:
        raise LayoutError(
            f"{where}: has the attributes MapLineSlot and MapLinePose, but it carries a line or "
            "the pose error; remove one of them"
        )
    return Slot(integer(number, f"{where}: MapLineSlot", len(Slot) - 1))


def _secured(
    messages: Iterable[Mapping[FrameFormat, DbcMessage]], source: str
) -> SecuredLayout | None:
    """Return the layout that all authenticated messages have; None if there is none."""
    secured = [own[FrameFormat.SECURED] for own in messages if FrameFormat.SECURED in own]
    layouts = {message.name: secured_layout(message, source) for message in secured}
    if len(set(layouts.values())) > 1:
        raise LayoutError(f"{source}: messages {', '.join(layouts)} must have the same lengths")
    return next(iter(layouts.values()), None)


def _shared_signals(records: Mapping[str, Mapping[str, Signal]], source: str) -> dict[str, Signal]:
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


def _check_choices(signal: DbcSignal, where: str) -> None:
    """Check that VAL_ gives no name of a Status or Kind to another value; new names are allowed."""
    enumeration = {"Status": Status, "Kind": Kind}.get(signal.name)
    names = enumeration.__members__ if enumeration else {}
    for number, text in signal.names:
        if names.get(text, number) != number:
            raise LayoutError(
                f"{where}: signal {signal.name}: VAL_ gives the value {number} the name {text}, "
                f"which belongs to the value {names[text].value}; correct VAL_"
            )


def _check_can_ids(messages: Iterable[DbcMessage], own: Iterable[str], source: str) -> None:
    """Check that no message has the same CAN ID as a message of a map line."""
    names: dict[tuple[int, bool], str] = {}
    for message in messages:
        first = names.setdefault((message.can_id, message.is_extended), message.name)
        if first != message.name and not {first, message.name}.isdisjoint(own):
            raise LayoutError(
                f"{source}: messages {first} and {message.name} have the same CAN ID, "
                f"{message.can_id}; give each its own"
            )


def _record(message: DbcMessage, owner: Owner, source: str) -> dict[str, Signal]:
    """Return the signals with bit positions in the record, independent of the frame format."""
    where = f"{source}: message {message.name}"
    prefix = POSE_PREFIX if owner == POSE else ""
    multiplexers = [signal for signal in message.signals if signal.is_multiplexer]
    if multiplexers:
        signals = _paged_signals(message, multiplexers, prefix, where)
    else:
        own = [signal for signal in message.signals if signal.name not in SECURED_SIGNALS]
        signals = [_unprefixed(to_signal(signal), prefix) for signal in own]
    record = {signal.name: signal for signal in sorted(signals, key=lambda signal: signal.start)}
    if f"{TRANSFER_ID}0" not in record and {"Counter", f"{TRANSFER_ID}1"} <= set(record):
        record[f"{TRANSFER_ID}0"] = low_bits(
            record["Counter"], f"{TRANSFER_ID}0", record[f"{TRANSFER_ID}1"].length
        )
    pages = pages_of(record)
    if not pages or (not multiplexers and message.length < len(pages) * PAGE_BYTES):
        raise LayoutError(
            f"{where}: must have pages of 8 bytes, each with {prefix}{PAGE} and "
            f"{prefix}{TRANSFER_ID}"
        )
    # The padding of a CAN FD message may hold other signals.
    end = 8 * PAGE_BYTES * len(pages)
    return {name: signal for name, signal in record.items() if min(bits_of(signal)) < end}


def _unprefixed(signal: Signal, prefix: str) -> Signal:
    """Return a signal; page and transfer ID without the prefix, as in records of lines."""
    name = signal.name.removeprefix(prefix)
    if name == signal.name or not name.startswith((PAGE, TRANSFER_ID)):
        return signal
    return replace(signal, name=name, prefix=prefix)


def _paged_signals(
    message: DbcMessage, multiplexers: list[DbcSignal], prefix: str, where: str
) -> list[Signal]:
    """Return the signals of a multiplexed message, its pages concatenated."""
    if len(multiplexers) > 1 or multiplexers[0].name.removeprefix(prefix) != PAGE:
        raise LayoutError(f"{where}: must have one multiplexer, named {prefix}{PAGE}")
    pages = sorted({i for s in message.signals for i in s.pages or ()})
    if pages != list(range(len(pages))):
        raise LayoutError(f"{where}: pages must be numbered 0, 1, ..., got {pages}")
    signals = []
    for dbc_signal in message.signals:
        signal = _unprefixed(to_signal(dbc_signal), prefix)
        if dbc_signal.pages is None:  # repeated in every page
            for page in pages:
                start = signal.start + 8 * PAGE_BYTES * page
                signals.append(replace(signal, name=f"{signal.name}{page}", start=start))
        elif len(dbc_signal.pages) == 1:
            start = signal.start + 8 * PAGE_BYTES * dbc_signal.pages[0]
            signals.append(replace(signal, start=start))
        else:
            raise LayoutError(f"{where}: signal {signal.name} must be in one page or in all")
    return signals
