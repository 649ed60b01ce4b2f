"""Records of lines and of the pose error, and their messages, as the tables of a DBC have them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, TypeAlias

from ...dbc_files.dbc_tables import DbcMessage, DbcSignal, DbcTables
from ...values.errors import LayoutError
from ...values.line import Kind, Slot, Status
from .dbc_messages import (
    FrameFormat,
    check_choices,
    check_frame,
    format_of,
    integer,
    low_bits,
    record_messages,
    secured_layout_of,
    shared_signals,
    to_signal,
)
from .pose_layout import POSE, SCENES, Owner, PoseLayout, owner_name
from .record_layout import bits_of, pages_of
from .record_signals import PAGE, PAGE_BYTES, POSE_PREFIX, SECURED_SIGNALS, TRANSFER_ID, Signal
from .scene_reader import scene_layout

#: Covariance code of a DBC without the attribute CovarianceCode.
DEFAULT_CODE = "Cholesky"
#: Values of signals by their names.
_NAMES: Mapping[str, Mapping[str, int]] = {
    "Status": Status.__members__,
    "Kind": Kind.__members__,
}

Content: TypeAlias = dict[str, Any]


def content_of(tables: DbcTables, source: str) -> Content:
    """Return the records and their messages that the tables of a DBC describe; see ``Layout``.

    Raises:
        LayoutError: it does not describe a map line.
    """
    messages: dict[Owner, dict[FrameFormat, DbcMessage]] = {}
    for message in tables.messages:
        if (owner := _owner(message, source)) is None:
            continue
        kind = format_of(message)
        if messages.setdefault(owner, {}).setdefault(kind, message) is not message:
            raise LayoutError(f"{source}: {owner_name(owner)} has two messages in one frame format")
        check_frame(message, kind, source)
    if not messages.keys() - {POSE}:
        raise LayoutError(
            f"{source}: no message has the attribute MapLineSlot or MapLineScene, so none carries "
            "a map line"
        )
    own = [message.name for formats in messages.values() for message in formats.values()]
    _check_can_ids(tables.messages, own, source)
    code = tables.covariance_code
    return {
        "covariance_code": DEFAULT_CODE if code is None else str(code),
        **(_scene if messages.keys() & {*SCENES} else _lines)(messages, source),
    }


def _scene(messages: Mapping[Owner, Mapping[FrameFormat, DbcMessage]], source: str) -> Content:
    """Return what `content_of` does of messages of whole scenes."""
    if others := [owner_name(owner) for owner in messages if owner not in SCENES]:
        raise LayoutError(
            f"{source}: has messages of whole scenes (MapLineScene), and of {', '.join(others)}; "
            "give the others a DBC of their own"
        )
    scene = scene_layout({owner: messages[owner] for owner in SCENES if owner in messages}, source)
    return {"signals": scene.line, "messages": {}, "secured": scene.secured, "pose": scene}


def _lines(messages: Mapping[Owner, Mapping[FrameFormat, DbcMessage]], source: str) -> Content:
    """Return what `content_of` does of messages of lines and of the pose error."""
    records: dict[Owner, dict[str, dict[str, Signal]]] = {}
    known: dict[object, dict[str, Signal]] = {}  # slots have the same signals
    for owner, own in messages.items():
        for message in own.values():
            for signal in message.signals:
                names = _NAMES.get(signal.name, {})
                check_choices(signal, names, f"{source}: message {message.name}")
            like = owner == POSE, message.length, message.signals
            if like not in known:
                known[like] = _record(message, owner, source)
            records.setdefault(owner, {})[message.name] = known[like]
    slots = sorted(owner for owner in messages if isinstance(owner, Slot))
    lines = {name: record for slot in slots for name, record in records[slot].items()}
    pose = None
    if POSE in records:
        pose = PoseLayout(
            signals=shared_signals(records[POSE], source),
            source=f"{source}: {owner_name(POSE)}",
            messages=record_messages(owner_name(POSE), messages[POSE], source),
            secured=secured_layout_of([messages[POSE]], source),
        )
    return {
        "signals": shared_signals(lines, source),
        "messages": {s: record_messages(owner_name(s), messages[s], source) for s in slots},
        "secured": secured_layout_of([messages[slot] for slot in slots], source),
        "pose": pose,
    }


def _owner(message: DbcMessage, source: str) -> Owner | None:
    """Return the owner of the record that a message has; None if it has none."""
    where = f"{source}: message {message.name}"
    owners: dict[str, Owner] = {}
    if message.slot is not None:
        slot = integer(message.slot, f"{where}: MapLineSlot", len(Slot) - 1)
        owners["MapLineSlot"] = Slot(slot)
    if message.pose is not None and integer(message.pose, f"{where}: MapLinePose", 1):
        owners["MapLinePose"] = POSE
    if message.scene is not None:
        number = integer(message.scene, f"{where}: MapLineScene", len(SCENES))
        owners |= {"MapLineScene": SCENES[number - 1]} if number else {}
    if len(owners) > 1:
        raise LayoutError(
            f"{where}: has the attributes {' and '.join(owners)}, but it carries a line, the pose "
            "error or a whole scene; remove one of them"
        )
    return next(iter(owners.values()), None)


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
