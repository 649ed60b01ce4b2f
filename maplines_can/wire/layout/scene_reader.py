"""Records of whole scenes, and their messages, as the tables of a DBC have them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import NamedTuple

from ...dbc_files.dbc_tables import DbcMessage
from ...values.errors import LayoutError
from ...values.line import Kind, Slot
from .dbc_messages import (
    FrameFormat,
    check_choices,
    format_of,
    record_messages,
    secured_layout_of,
    shared_signals,
    to_signal,
)
from .pose_layout import SCENE, SceneOwner, owner_name
from .record_signals import LINE, PAGE_BYTES, SCENE_LINE, SECURED_SIGNALS, SLOT, Signal, slot_title
from .scene_layout import MAX_PLACES, NoLine, SceneLayout
from .signal import first_bit

_SLOTS = {slot_title(slot): slot for slot in Slot}
#: Start of the names of a line, and the name of one of its signals.
_OF_LINE = re.compile(rf"({'|'.join(_SLOTS)}|{LINE}\d+)({'|'.join((*SCENE_LINE, SLOT))})")
#: Values of Kind by their names.
_KINDS = {one.name: one.value for one in (*Kind, *NoLine)}


class _Record(NamedTuple):
    """Record of a message: signals of all of it, and those of each line."""

    message: str
    length: int  #: of the message [byte]
    is_secured: bool
    shared: dict[str, Signal]
    #: By names without the start, which is their prefix, in the order of places.
    lines: list[dict[str, Signal]]

    @property
    def prefixes(self) -> list[str]:
        """Starts of the names of the lines."""
        return [own["Kind"].prefix for own in self.lines]


def scene_layout(
    owned: Mapping[SceneOwner, Mapping[FrameFormat, DbcMessage]], source: str
) -> SceneLayout:
    """Return the layout of whole scenes, given their messages.

    Raises:
        LayoutError: the messages do not describe a whole scene.
    """
    if SCENE not in owned:
        raise LayoutError(
            f"{source}: there is no message Scene beside Scene2; add one with the attribute "
            "MapLineScene 1"
        )
    if any(own.keys() != owned[SCENE].keys() for own in owned.values()):
        raise LayoutError(
            f"{source}: Scene and Scene2 must have messages in the same frame formats"
        )
    records = {
        owner: [_record(own[form], source) for form in FrameFormat if form in own]
        for owner, own in owned.items()
    }
    _check_alike(records, source)
    every = [*chain(*records.values())]
    first = records[SCENE][0]  # of the CAN FD message, if there is one
    shared = shared_signals({record.message: record.shared for record in every}, source)
    line, stride_bytes = _line(first, every, source)
    of_lines = (signal for own in first.lines for signal in own.values())
    signals = [*shared.values(), *(replace(s, name=s.dbc_name, prefix="") for s in of_lines)]
    return SceneLayout(
        signals={s.name: s for s in sorted(signals, key=lambda signal: signal.start)},
        source=f"{source}: whole scenes",
        line=line,
        messages={
            owner: record_messages(owner_name(owner), dict(own), source)
            for owner, own in owned.items()
        },
        fixed={owner: tuple(map(_SLOTS.get, own[0].prefixes)) for owner, own in records.items()},
        stride_bytes=stride_bytes,
        secured=secured_layout_of(owned.values(), source),
        secured_places=max((len(r.lines) for r in every if r.is_secured), default=0),
    )


def _record(message: DbcMessage, source: str) -> _Record:
    """Return the record of a message; each of its lines has all signals of one."""
    where, form = f"{source}: message {message.name}", format_of(message)
    if form is FrameFormat.CLASSIC or message.length % PAGE_BYTES:
        raise LayoutError(
            f"{where}: a whole scene needs a CAN FD message (VFrameFormat) of 8, 16, 24, 32, 48 or "
            f"64 bytes, got {message.length}"
        )
    shared: dict[str, Signal] = {}
    lines: dict[str, dict[str, Signal]] = {}
    for signal in message.signals:
        if found := _OF_LINE.fullmatch(signal.name):
            prefix, name = found.groups()
            own = replace(to_signal(signal), name=name, prefix=prefix)
            lines.setdefault(prefix, {})[name] = own
            check_choices(signal, _KINDS if name == "Kind" else {}, where)
        elif signal.name not in SECURED_SIGNALS:
            shared[signal.name] = to_signal(signal)
    for prefix, of_line in lines.items():
        needed = [*SCENE_LINE] if prefix in _SLOTS else [*SCENE_LINE, SLOT]
        if missing := [name for name in needed if name not in of_line]:
            raise LayoutError(
                f"{where}: there is no signal '{prefix}{missing[0]}'; each line of a whole scene "
                "needs it"
            )
    if not 1 <= len(lines) <= MAX_PLACES:
        raise LayoutError(
            f"{where}: a whole scene needs 1 to {MAX_PLACES} lines, with signals such as "
            f"EgoLeftYOff and {LINE}3YOff, got {len(lines)}"
        )
    placed = sorted(lines.values(), key=lambda of_line: first_bit(of_line["Kind"]))
    record = _Record(message.name, message.length, form is FrameFormat.SECURED, shared, placed)
    for number, prefix in enumerate(record.prefixes, start=1):
        if prefix not in _SLOTS and prefix != f"{LINE}{number}":
            raise LayoutError(
                f"{where}: the names of line {number} begin with {prefix}; write {LINE}{number}"
            )
    return record


def _check_alike(records: Mapping[SceneOwner, Sequence[_Record]], source: str) -> None:
    """Check that messages agree on their length, and on the places of lines with a fixed slot."""
    every = [*chain(*records.values())]
    for is_secured in (False, True):
        alike = [record for record in every if record.is_secured is is_secured]
        if len({(record.length, len(record.lines)) for record in alike}) > 1:
            names = ", ".join(record.message for record in alike)
            raise LayoutError(
                f"{source}: messages {names} must have the same length and as many lines"
            )
    owners: dict[str, SceneOwner] = {}
    for owner, own in records.items():
        all_lines = own[0].prefixes  # of the CAN FD message, if there is one
        for record in own:
            if record.prefixes != all_lines[: len(record.lines)]:
                raise LayoutError(
                    f"{source}: message {record.message} has the lines "
                    f"{', '.join(record.prefixes)}, but it needs the first ones of "
                    f"{', '.join(all_lines)}; rename or remove its signals"
                )
        for prefix in all_lines:
            if prefix in _SLOTS and owners.setdefault(prefix, owner) != owner:
                raise LayoutError(
                    f"{source}: Scene and Scene2 have a place for {prefix}; rename its signals in "
                    "one of them"
                )


def _line(first: _Record, records: Sequence[_Record], source: str) -> tuple[dict[str, Signal], int]:
    """Return the signals of the line at the first place, and the bytes from one place to the next.

    Raises:
        LayoutError: signals of another place, or of another message, have another width,
            conversion or byte order, or are not at equal distances of whole bytes.
    """
    line = dict(first.lines[0])
    stride_bytes = 0
    if len(first.lines) > 1:
        distance = first_bit(first.lines[1]["Kind"]) - first_bit(line["Kind"])
        stride_bytes = distance // 8
    for record in records:
        for place, own in enumerate(record.lines):
            shift = 8 * stride_bytes * place
            for name, signal in own.items():
                of_first = line.setdefault(name, replace(signal, start=signal.start - shift))
                needed = replace(of_first, start=of_first.start + shift)
                needs = ""
                if signal != needed:
                    needs = f"{needed}, since lines have the same signals at equal distances"
                elif first_bit(of_first) < 0:  # there would be no such signal of the first line
                    needs = f"to be {shift // 8} bytes or more from the start of the record"
                if needs:
                    raise LayoutError(
                        f"{source}: message {record.message}: signal {signal.dbc_name} is "
                        f"{signal}, but it needs {needs}; move or change it"
                    )
    return line, stride_bytes
