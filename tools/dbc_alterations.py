"""Altered DBCs: each signal of each record with each alteration, and alterations of messages.

The originals have two slots, and a page with room for longer signals.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

from cantools.database.can import Database, Message, Signal
from cantools.database.conversion import BaseConversion
from cantools.database.utils import start_bit

from maplines_can.generation.dbc.dbc_writer import DbcWriter
from maplines_can.generation.dbc.record_pages import SignalSpec
from maplines_can.generation.dbc.record_spec import (
    CONDITIONAL,
    DEFAULT,
    POSE_WITH_LEVELS,
    SCENES,
    SECURED,
    WHOLE_SCENES,
)
from maplines_can.values.line import Slot
from maplines_can.wire.layout.pose_layout import SCENE, SCENE2
from maplines_can.wire.layout.record_signals import FINE_SIGNALS, TRAILER, slot_title

#: Slots of the originals.
SLOTS = (Slot.EGO_LEFT, Slot.EGO_RIGHT)
#: Page with room, and its first free bit at a byte boundary; 41 bits are free from there.
ROOM_PAGE, ROOM = 4, 16
#: Name of a signal of others.
FOREIGN = "Foreign"

# ---- originals -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Original:
    """A DBC whose signals are altered."""

    writer: DbcWriter
    messages: str  #: those whose signals are altered, as a regular expression
    names: tuple[str, ...] = ()  #: of the signals that are altered; by default all
    #: Names of forms of the messages, and ends of the names of such messages.
    forms: Mapping[str, str] = field(
        default_factory=lambda: {"classic": "(?<!Fd)(?<!SecOc)", "CAN FD": "Fd"}
    )

    @cached_property
    def database(self) -> Database:
        """The database, which an alteration changes for a time."""
        return self.writer.database()

    @property
    def own_messages(self) -> list[Message]:
        """The messages whose signals are altered."""
        return [m for m in self.database.messages if re.fullmatch(self.messages, m.name)]

    @property
    def fields(self) -> list[str]:
        """Names of the signals that are altered; ``Page`` without the number of the page."""
        names = (field_of(s) for message in self.own_messages for s in message.signals)
        return list(dict.fromkeys(name for name in names if not self.names or name in self.names))


def _line_pages() -> tuple[Any, ...]:
    specs = {spec.name: spec for page in DEFAULT.pages for spec in page}
    last = tuple(specs[name] for name in ("Kind", "Age", "ComponentIndex", "Inflation"))
    return (*(tuple(spec for spec in page if spec not in last) for page in DEFAULT.pages), last)


def _pose() -> DbcWriter:
    """Return the writer of complete lines and the pose error, with free pages."""
    first, second, levels, *_ = POSE_WITH_LEVELS.pages
    others = {f"{slot_title(slot)}Counter" for slot in Slot if slot not in SLOTS}
    second = tuple(spec for spec in second if spec.name not in others)
    pose = replace(POSE_WITH_LEVELS, pages=(first, second, levels, (), ()))
    return replace(DEFAULT, slots=SLOTS, pose=pose)


def _conditional() -> DbcWriter:
    """Return the writer of a line that is conditional on the pose, with room in its pages."""
    first, second, third, fourth = CONDITIONAL.pages
    moved, fine = (first[-1], second[-1]), third[-len(FINE_SIGNALS) :]
    pages = (first[:-1], second[:-1], (*third[: -len(fine)], *moved), fourth, fine)
    return replace(CONDITIONAL, slots=SLOTS[:1], pages=pages, first_secured_can_id=None)


def _scene() -> DbcWriter:
    """Return the writer of whole scenes of a line, whose signals no other line must have, too.

    Its room is that of the others, before which a foreign signal ends.
    """
    filler = SignalSpec(name=FOREIGN, bits=56, about="", why="")
    scene = replace(
        SCENES, head=(*SCENES.head, *SCENES.tails, filler), tails=(), places=1, secured_places=1,
        fixed={SCENE: (), SCENE2: ()},
    )  # fmt: skip
    return replace(WHOLE_SCENES, scene=scene, first_secured_can_id=None)


def _names(writer: DbcWriter) -> tuple[str, ...]:
    """Return the names of the signals of the first message that are not foreign."""
    signals = writer.database().messages[0].signals
    return tuple(signal.name for signal in signals if signal.name != FOREIGN)


#: Lines with authenticated messages, of which ``MESSAGES`` has the alterations of messages.
LINES = replace(SECURED, pages=_line_pages(), slots=SLOTS, pose=None)
ORIGINALS = {
    "Line": Original(replace(LINES, slots=SLOTS[:1], first_secured_can_id=None), r"\w+"),
    "Secured": Original(replace(LINES, slots=SLOTS[:1]), r"\w+SecOc", tuple(TRAILER)),
    "Pose": Original(_pose(), "Pose(?:Fd)?"),
    "Conditional": Original(_conditional(), r"Ego\w+"),
    "Scene": Original(
        _scene(), "Scene2?", _names(_scene()), {"Scene2": "Scene2", "Scene": "Scene"}
    ),
}


@cache
def original() -> str:
    """Return the text of ``LINES``."""
    return _without_comments(LINES.dbc())


@cache
def pose_original() -> str:
    """Return the text of a DBC with complete lines and the pose error."""
    return _without_comments(_pose().dbc())


def _without_comments(text: str) -> str:
    """Return the text without comments, which take half of the time of a parser."""
    return re.sub(r'^CM_ [^"]*"[^"]*";\n', "", text, flags=re.M)


# ---- alterations of a signal -----------------------------------------------------------------

Change = Callable[[Signal], None]


def field_of(signal: Signal) -> str:
    """Return the name of a signal; ``Page`` without the number of the page."""
    return re.sub(r"Page\d$", "Page", signal.name)


def _set(**values: Any) -> Change:
    return lambda signal: vars(signal).update(values)


def _range(low: float | None, high: float | None) -> Change:
    return _set(minimum=low, maximum=high)


def _law(factor: float, offset: float, is_float: bool = False) -> Change:
    return _set(conversion=BaseConversion.factory(factor, offset, None, is_float))


def _longer(bits: int, big_endian: bool = False) -> Change:
    """Return the change to another length in the free bits, with the range of all its bits."""

    def change(signal: Signal) -> None:
        signal.length += bits
        signal.start = ROOM + (7 if big_endian else 0)
        if signal.multiplexer_ids:
            signal.multiplexer_ids = [ROOM_PAGE]
        elif not signal.is_multiplexer:  # of a CAN FD message
            signal.start += 64 * ROOM_PAGE
        signal.byte_order = "big_endian" if big_endian else "little_endian"
        _range(None, None)(signal)

    return change


def _scaled(by: float) -> Change:
    def change(signal: Signal) -> None:
        _law(signal.scale * by, signal.offset * by)(signal)
        if signal.minimum is not None and signal.maximum is not None:
            _range(*sorted((signal.minimum * by, signal.maximum * by)))(signal)

    return change


def _shifted(by: float) -> Change:
    def change(signal: Signal) -> None:
        _law(signal.scale, signal.offset + by)(signal)
        if signal.minimum is not None and signal.maximum is not None:
            _range(signal.minimum + by, signal.maximum + by)(signal)

    return change


def _float(signal: Signal) -> None:
    _longer(32 - signal.length)(signal)
    _law(1, 0, is_float=True)(signal)


def _halved(signal: Signal) -> None:
    low, high = float(signal.minimum or 0), float(signal.maximum or 0)
    _range(low, low + (high - low) / 2)(signal)


def _in_page_2(signal: Signal) -> None:
    signal.multiplexer_ids = [2] if signal.multiplexer_ids else None


#: Alterations of one signal, but that it is removed.
CHANGES: dict[str, Change] = {
    "1 bit": _set(length=1),
    "1 bit less": lambda s: vars(s).update(length=max(1, s.length - 1), minimum=None, maximum=None),
    "1 bit more": _longer(1),
    "8 bits more": _longer(8),
    "other sign": lambda s: vars(s).update(is_signed=not s.is_signed, minimum=None, maximum=None),
    "moved": _longer(0),
    "Motorola": _longer(0, big_endian=True),
    "float32": _float,
    "factor x 2": _scaled(2.0),
    "factor x 2, same range": lambda s: _law(2 * s.scale, s.offset)(s),
    "factor x 0.3": _scaled(0.3),
    "factor negated": _scaled(-1.0),
    "factor 0": lambda s: _law(0, s.offset)(s),
    "factor 1e-30": lambda s: _law(1e-30, s.offset)(s),
    "factor beyond doubles": lambda s: _law(float("inf"), s.offset)(s),
    "offset + 1": _shifted(1.0),
    "offset + 0.3": _shifted(0.3),
    "offset + 1e20": _shifted(1e20),
    "half the range": _halved,
    "range 0 to 0": _range(None, None),
    "range from max to min": lambda s: _range(s.maximum, s.minimum)(s),
    "unit deg": _set(unit="deg"),
    "no unit": _set(unit=None),
    "renamed": lambda s: vars(s).update(name=f"{s.name}X"),
    "in another page": _in_page_2,
}
REMOVED = "removed"
#: Names of all alterations of a signal.
ALTERATIONS = (*CHANGES, REMOVED)


@contextmanager
def altered(original: Original, field: str, alteration: str, format_: str = "") -> Iterator[None]:
    """Alter a signal in the database of an original, which takes no parsing of its text.

    Args:
        original: whose database changes.
        field: one of its ``fields``.
        alteration: one of ``ALTERATIONS``.
        format_: end of the names of the only messages that change, as a regular expression.
    """
    messages = [m for m in original.own_messages if re.search(f"{format_}$", m.name)]
    before = {message.name: [*message.signals] for message in messages}
    try:
        for message in messages:
            changed = _changed(before[message.name], field, alteration)
            message.signals[:] = sorted(changed, key=start_bit)  # as cantools needs them
            message.refresh(strict=False)
        yield
    finally:
        for message in messages:
            message.signals[:] = before[message.name]
            message.refresh(strict=False)


def _changed(signals: list[Signal], field: str, alteration: str) -> Iterator[Signal]:
    for signal in signals:
        if field_of(signal) != field:
            yield signal
        elif alteration != REMOVED:
            new = copy(signal)
            CHANGES[alteration](new)
            yield new


# ---- alterations of messages, and of all signals together ------------------------------------

#: A regular expression in ``original()``, and its replacement.
Edit = tuple[str, str | Callable[[re.Match[str]], str]]
#: CAN IDs of the messages of the original, as regular expressions.
CLASSIC, FD, SECOC = "83[23]", "84[01]", "84[89]"
#: CAN IDs of the first and of the second slot.
LEFT, RIGHT = "(?:832|840|848)", "(?:833|841|849)"


def _value(attribute: str, of: str, value: str) -> Edit:
    return rf'^(BA_ "{attribute}" BO_ {of}) \S+;', rf"\1 {value};"


def _no_value(attribute: str, of: str = r"\d+") -> Edit:
    return rf'^BA_ "{attribute}" BO_ {of} .*\n', ""


def _without(can_ids: str) -> tuple[Edit, ...]:
    """Return the edits that remove messages."""
    messages = rf"^BO_ (?:{can_ids}) .*\n(?: SG_ .*\n)+\n"
    return (messages, ""), (rf"^(?:BA_|VAL_)[^\n]* (?:{can_ids}) [^;]*;\n", "")


def _length(can_ids: str, length: int) -> tuple[Edit]:
    return ((rf"^(BO_ {can_ids} \w+): \d+", rf"\1: {length}"),)


def _foreign(can_ids: str, place: str, name: str = FOREIGN) -> Edit:
    signal = rf'\1\n SG_ {name} {place} (0,0) [9|-9] ""  AdasEcu'
    return rf"^(BO_ {can_ids} .*)$", signal


def _mirrored(found: re.Match[str]) -> str:
    """Return a signal in Motorola order, mirrored in its bytes so that it overlaps no other."""
    start = int(found[2])
    return f"{found[1]}{start // 8 * 8 + 7 - start % 8}|{found[3]}@0"


def _reversed(found: re.Match[str]) -> str:
    return "".join(reversed(found[0].splitlines(keepends=True)))


#: Edits of the original, by name.
EDITS: dict[str, tuple[Edit, ...]] = {
    "unaltered": (),
    "all Motorola but Crc": (
        (r"( SG_ (?!Crc|KeyId|Freshness|Mac).*: )(\d+)\|(\d+)@1", _mirrored),
    ),
    "signals in another order": ((r"(?: SG_ .*\n)+", _reversed),),
    "messages renamed": ((r"\bEgo(Left|Right)", r"Line\1"),),
    "classic only": _without(f"{FD}|{SECOC}"),
    "CAN FD only": _without(f"{CLASSIC}|{SECOC}"),
    "authenticated only": _without(f"{CLASSIC}|{FD}"),
    "one slot": _without(RIGHT),
    "equal E2EDataId": (_value("E2EDataId", r"\d+", "7"),),
    "E2EDataId differs within a slot": (_value("E2EDataId", "832", "7"),),
    "E2EDataId 70000": (_value("E2EDataId", LEFT, "70000"),),
    "E2EDataId missing in one message": (_no_value("E2EDataId", "832"),),
    "E2EDataId missing": (_no_value("E2EDataId"),),
    "E2EDataId swapped": (_value("E2EDataId", LEFT, "1"),),
    "equal SecOCDataId": (_value("SecOCDataId", r"\d+", "7"),),
    "SecOCDataId missing in one message": (_no_value("SecOCDataId", "848"),),
    "SecOCDataId missing": (_no_value("SecOCDataId"),),
    "MapLineSlot twice": (_value("MapLineSlot", RIGHT, "0"),),
    "MapLineSlot of one message twice": (_value("MapLineSlot", "833", "0"),),
    "MapLineSlot 9": (_value("MapLineSlot", RIGHT, "9"),),
    "MapLineSlot 1.5": (
        (r'^(BA_DEF_ BO_  "MapLineSlot") INT 0 7;', r"\1 FLOAT 0 7;"),
        _value("MapLineSlot", "833", "1.5"),
    ),
    "MapLineSlot missing in CAN FD": (_no_value("MapLineSlot", "840"),),
    "MapLineSlot missing": (_no_value("MapLineSlot"),),
    "slots swapped": (_value("MapLineSlot", LEFT, "5"),),
    "equal CAN IDs, classic and CAN FD": ((r"\b840\b", "832"),),
    "equal CAN IDs of two slots": ((r"\b841\b", "840"),),
    "CAN ID of another message": (
        (
            "^(?=BO_ 832 )",
            'BO_ 840 Other: 8 PositionEcu\n SG_ A : 0|8@1+ (1,0) [0|0] ""  AdasEcu\n\n',
        ),
    ),
    "extended CAN ID": ((r"\b832\b", str(2**31 + 0x18FF0040)),),
    "extended CAN ID of the same number": ((r"\b840\b", str(2**31 + 832)),),
    "GenMsgCycleTime 0": (_value("GenMsgCycleTime", r"\d+", "0"),),
    "GenMsgCycleTime 20": (_value("GenMsgCycleTime", r"\d+", "20"),),
    "GenMsgCycleTime -5": (_value("GenMsgCycleTime", r"\d+", "-5"),),
    "GenMsgCycleTime missing": (_no_value("GenMsgCycleTime"),),
    "GenMsgCycleTime of a day": (_value("GenMsgCycleTime", r"\d+", "86400000"),),
    "VFrameFormat CAN FD of the classic": (_value("VFrameFormat", CLASSIC, "14"),),
    "VFrameFormat classic of CAN FD": (_value("VFrameFormat", FD, "0"),),
    "VFrameFormat classic of CAN FD only": (
        _value("VFrameFormat", FD, "0"), *_without(f"{CLASSIC}|{SECOC}"),
    ),
    "VFrameFormat CAN FD of the classic only": (
        _value("VFrameFormat", CLASSIC, "14"), *_without(f"{FD}|{SECOC}"),
    ),
    "VFrameFormat classic of the authenticated": (_value("VFrameFormat", SECOC, "0"),),
    "VFrameFormat missing": (_no_value("VFrameFormat"),),
    "CovarianceCode of another": (('"CovarianceCode" "Cholesky";', '"CovarianceCode" "Linear";'),),
    "CovarianceCode missing": ((r'^BA_ "CovarianceCode" .*\n', ""),),
    "no multiplexer": (("Page M :", "Page :"),),
    "multiplexer renamed": (("Page M :", "Leaf M :"),),
    "signal of page 0 in page 7": (("YOff m0", "YOff m7"),),
    "a signal in every page": (("Kind m4 ", "Kind "),),
    "two multiplexers": (("Kind m4 ", "Kind m4M "),),
    "foreign signal": (_foreign(CLASSIC, "m4 : 16|8@1+"), _foreign(r"84\d", ": 272|8@1+")),
    "foreign signal in one message": (_foreign("832", "m4 : 16|8@1+"),),
    "foreign signal over another": (
        _foreign(CLASSIC, "m0 : 30|8@1+"), _foreign(r"84\d", ": 30|8@1+"),
    ),
    "foreign signal in the padding": (_foreign(FD, ": 320|64@1+"),),
    "foreign signal named as a page": (
        _foreign(CLASSIC, "m4 : 16|8@1+", "Pages"), _foreign(r"84\d", ": 272|8@1+", "Pages"),
    ),
    "values of Status swapped": (('0 "UNKNOWN" 1 "FULL"', '0 "FULL" 1 "UNKNOWN"'),),
    "values of Kind translated": (('"DASHED"', '"GESTRICHELT"'),),
    **{f"{n} bytes in classic": _length(CLASSIC, n) for n in (6, 7)},
    **{f"{n} bytes in CAN FD": _length(FD, n) for n in (32, 40, 41, 47, 64, 65)},
    **{f"{n} bytes in authenticated": _length(SECOC, n) for n in (48, 60)},
}  # fmt: skip


def edited(name: str) -> str:
    """Return the text of the original with the ``EDITS`` of this name; each finds its place."""
    text = original()
    for pattern, replacement in EDITS[name]:
        text, found = re.subn(pattern, replacement, text, flags=re.M)
        if not found:
            raise ValueError(f"the original has no {pattern}")
    return text
