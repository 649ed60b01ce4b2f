"""Altered DBCs: each signal with each alteration, and alterations of messages.

The original is ``dbc/maplines-secoc.dbc`` with two slots and a fifth page for longer signals.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

from maplines_can.study.dbc.pose_spec import CONDITIONAL, POSE_WITH_LEVELS
from maplines_can.study.dbc.record_spec import DEFAULT, SECURED
from maplines_can.values.line import Slot
from maplines_can.wire.layout.signals import FINE_SIGNALS, SECURED_SIGNALS, slot_title

#: Slots of the original.
SLOTS = (Slot.EGO_LEFT, Slot.EGO_RIGHT)
#: Fifth page, and its first free bit at a byte boundary; 41 bits are free from there.
ROOM_PAGE, ROOM = 4, 16

_SIGNAL = re.compile(
    r" SG_ (?P<name>\w+) (?P<mux>m\d+ |M )?: (?P<start>\d+)\|(?P<length>\d+)@(?P<order>[01])"
    r"(?P<sign>[+-]) \((?P<factor>[^,]*),(?P<offset>[^)]*)\) \[(?P<low>[^|]*)\|(?P<high>[^\]]*)\] "
    r'"(?P<unit>[^"]*)"(?P<rest>.*)'
)


class Alteration(NamedTuple):
    """A DBC with one thing altered."""

    field: str  #: signal, or "messages"
    name: str  #: what is altered
    text: str  #: of the DBC


@dataclass(frozen=True)
class SignalLine:
    """A line ``SG_`` of a DBC."""

    name: str
    mux: str  #: "m0 " to "m4 " in a page, "M " for the multiplexer, "" in a CAN FD message
    start: int
    length: int
    order: str  #: "1" is Intel
    sign: str
    factor: str
    offset: str
    low: str
    high: str
    unit: str
    rest: str

    @classmethod
    @cache
    def parse(cls, line: str) -> SignalLine | None:
        """Return the signal of a line of a DBC; None if it has none."""
        found = _SIGNAL.fullmatch(line)
        if not found:
            return None
        values = {name: text or "" for name, text in found.groupdict().items()}
        start, length = int(values.pop("start")), int(values.pop("length"))
        return cls(**values, start=start, length=length)

    def __str__(self) -> str:
        return (
            f" SG_ {self.name} {self.mux}: {self.start}|{self.length}@{self.order}{self.sign} "
            f'({self.factor},{self.offset}) [{self.low}|{self.high}] "{self.unit}"{self.rest}'
        )

    def moved(self, length: int, order: str = "1") -> SignalLine:
        """Return the signal with another length in the free bits, and the range of all its bits."""
        start = ROOM + (7 if order == "0" else 0)
        mux = f"m{ROOM_PAGE} " if self.mux.startswith("m") else self.mux
        start += 0 if self.mux else 64 * ROOM_PAGE
        ends = {"low": "0", "high": "0"}
        return replace(self, mux=mux, start=start, length=length, order=order, **ends)

    def scaled(self, by: float) -> SignalLine:
        """Return the signal with factor, offset and range multiplied by a number."""
        ends = sorted((float(self.low) * by, float(self.high) * by))
        return replace(
            self,
            factor=repr(float(self.factor) * by),
            offset=repr(float(self.offset) * by),
            low=repr(ends[0]),
            high=repr(ends[1]),
        )

    def shifted(self, by: float) -> SignalLine:
        """Return the signal with a number added to its offset and range."""
        low, high = (repr(float(end) + by) for end in (self.low, self.high))
        return replace(self, offset=repr(float(self.offset) + by), low=low, high=high)

    def narrowed(self, share: float) -> SignalLine:
        """Return the signal with this share of its range, from the least value."""
        low, high = float(self.low), float(self.high)
        return replace(self, high=repr(low + share * (high - low)))


Change = Callable[[SignalLine], SignalLine | None]


def _width(bits: int) -> Change:
    return lambda line: replace(line, length=bits)


def _float_type(line: SignalLine) -> SignalLine:
    return replace(line.moved(32), sign="-", factor="1", offset="0")


def _with_sign(line: SignalLine) -> SignalLine:
    return replace(line, sign="+" if line.sign == "-" else "-", low="0", high="0")


def _unit(text: str) -> Change:
    return lambda line: replace(line, unit=text)


#: Alterations of one signal; None removes it.
CHANGES: dict[str, Change] = {
    "1 bit": _width(1),
    "2 bits": _width(2),
    "3 bits": _width(3),
    "1 bit less": lambda line: replace(line, length=line.length - 1),
    "1 bit more": lambda line: line.moved(line.length + 1),
    "8 bits more": lambda line: line.moved(line.length + 8),
    "other sign": _with_sign,
    "other sign, 1 bit more": lambda line: _with_sign(line.moved(line.length + 1)),
    "moved": lambda line: line.moved(line.length),
    "Motorola": lambda line: line.moved(line.length, "0"),
    "float32": _float_type,
    "float64": _float_type,
    "factor x 2": lambda line: line.scaled(2.0),
    "factor x 2, same range": lambda line: replace(line, factor=repr(2 * float(line.factor))),
    "factor x 0.5": lambda line: line.scaled(0.5),
    "factor x 0.3": lambda line: line.scaled(0.3),
    "factor negated": lambda line: line.scaled(-1.0),
    "factor x 1.0000001": lambda line: line.scaled(1.0000001),
    "factor 0": lambda line: replace(line, factor="0"),
    "factor 1e-30": lambda line: replace(line, factor="1e-30", low="0", high="0"),
    "factor 1e+30": lambda line: replace(line, factor="1e30", low="0", high="0"),
    "factor beyond doubles": lambda line: replace(line, factor="1e999"),
    "offset + 1": lambda line: line.shifted(1.0),
    "offset + 0.3": lambda line: line.shifted(0.3),
    "offset - 1": lambda line: line.shifted(-1.0),
    "offset + 1e20": lambda line: line.shifted(1e20),
    "half the range": lambda line: line.narrowed(0.5),
    "range without its last value": lambda line: line.narrowed(1 - 2.0**-line.length),
    "range of one value": lambda line: line.narrowed(0.0),
    "range 0 to 0": lambda line: replace(line, low="0", high="0"),
    "range from max to min": lambda line: replace(line, low=line.high, high=line.low),
    "range beyond the bits": lambda line: replace(line, low="1e6", high="1e7"),
    "unit deg": _unit("deg"),
    "unit cm": _unit("cm"),
    "no unit": _unit(""),
    "renamed": lambda line: replace(line, name=f"{line.name}X"),
    "removed": lambda _: None,
    "in another page": lambda line: replace(line, mux="m2 ") if line.mux else line,
}  # fmt: skip


@cache
def original(*slots: Slot) -> str:
    """Return the text of the original, with these slots."""
    first, second, third, fourth = DEFAULT.pages
    specs = {spec.name: spec for page in DEFAULT.pages for spec in page}
    last = tuple(specs[name] for name in ("Kind", "Age", "ComponentIndex", "Inflation"))
    pages = tuple(
        tuple(spec for spec in page if spec not in last) for page in (first, second, third, fourth)
    )
    text = replace(SECURED, pages=(*pages, last), slots=slots or SLOTS, pose=None).dbc()
    return _without_comments(text)


@cache
def pose_original() -> str:
    """Return the text of a DBC with complete lines and the pose error, with free pages."""
    first, second, levels, *_ = POSE_WITH_LEVELS.pages
    others = {f"{slot_title(slot)}Counter" for slot in Slot if slot not in SLOTS}
    second = tuple(spec for spec in second if spec.name not in others)
    pose = replace(POSE_WITH_LEVELS, pages=(first, second, levels, (), ()))
    return _without_comments(replace(DEFAULT, slots=SLOTS, pose=pose).dbc())


@cache
def conditional_original() -> str:
    """Return the text of a DBC with a line that is conditional on the pose, with room in pages."""
    first, second, third, fourth = CONDITIONAL.pages
    moved, fine = (first[-1], second[-1]), third[-len(FINE_SIGNALS) :]
    pages = (first[:-1], second[:-1], (*third[: -len(fine)], *moved), fourth, fine)
    text = replace(CONDITIONAL, slots=SLOTS[:1], pages=pages, first_secured_can_id=None).dbc()
    return _without_comments(text)


def fields_of(text: str, message: str) -> list[str]:
    """Return the names of the signals of a message; ``Page`` without the number of the page."""
    found = re.search(rf"^BO_ \d+ {message}:.*\n((?: SG_ .*\n)+)", text, flags=re.M)
    lines = [SignalLine.parse(line) for line in found[1].splitlines()] if found else []
    return list(dict.fromkeys(field_of(line) for line in lines if line))


def of_field_in(text: str, field: str, message: str) -> Iterator[Alteration]:
    """Yield the alterations of a signal in the messages whose names match."""
    for name, change in CHANGES.items():
        altered = changed(text, field, change, message)
        if name.startswith("float"):
            altered += "".join(
                f"SIG_VALTYPE_ {can_id} {signal} : {1 if name == 'float32' else 2};\n"
                for can_id, signal in _places(altered, field, message)
            )
        yield Alteration(field, name, altered)


def fields() -> list[str]:
    """Return the names of the signals of the original; ``Page`` without the number of the page."""
    lines = map(SignalLine.parse, original().splitlines())
    return list(dict.fromkeys(field_of(line) for line in lines if line))


def field_of(line: SignalLine) -> str:
    """Return the name of a signal; ``Page`` without the number of the page."""
    return re.sub(r"^Page\d$", "Page", line.name)


def of_field(field: str) -> Iterator[Alteration]:
    """Yield the alterations of a signal, each in all messages at once."""
    text = original(SLOTS[0])
    if field not in SECURED_SIGNALS:
        text = _without(text, r"\w+SecOc")  # of_messages has the authenticated message
    yield from of_field_in(text, field, r"\w+")


def changed(text: str, field: str, change: Change, message: str = r"\w+") -> str:
    """Return the text with a signal changed, in each message whose name matches.

    If the signal is renamed or removed, its value names are removed.
    """
    out: list[str] = []
    gone: set[str] = set()
    inside = False
    for line in text.splitlines():
        if head := re.match(r"BO_ \d+ (\w+):", line):
            inside = bool(re.fullmatch(message, head[1]))
        old = SignalLine.parse(line)
        if old is None or not inside or not re.fullmatch(field, field_of(old)):
            out.append(line)
            continue
        new = change(old)
        if new is None or new.name != old.name:
            gone.add(old.name)
        if new is not None:
            out.append(str(new))
    texts = "|".join(gone) or "-"
    return re.sub(rf"^VAL_ \d+ ({texts}) [^;]*;\n", "", "\n".join(out) + "\n", flags=re.M)


def _places(text: str, field: str, message: str) -> Iterator[tuple[int, str]]:
    """Yield the CAN ID and the name of each signal of a field, in messages whose names match."""
    can_id, inside = 0, False
    for line in text.splitlines():
        if head := re.match(r"BO_ (\d+) (\w+):", line):
            can_id, inside = int(head[1]), bool(re.fullmatch(message, head[2]))
        signal = SignalLine.parse(line)
        if signal and inside and field_of(signal) == field:
            yield can_id, signal.name


def _motorola(line: SignalLine) -> SignalLine:
    """Return a signal in Motorola order, mirrored within its bytes so that none overlap."""
    if line.name in ("Crc", "KeyId", "Freshness", "Mac"):
        return line
    return replace(line, start=line.start // 8 * 8 + 7 - line.start % 8, order="0")


def _without(text: str, message: str) -> str:
    """Return the text without the messages whose names match."""
    for can_id in re.findall(rf"^BO_ (\d+) (?:{message}):", text, flags=re.M):
        text = re.sub(rf"^BO_ {can_id} .*?\n\n", "", text, flags=re.M | re.S)
        text = re.sub(rf"^(?:BA_|VAL_)[^\n]* {can_id} [^;]*;\n", "", text, flags=re.M)
    return text


def part(text: str, message: str) -> str:
    """Return the text with only those messages whose names match."""
    return _without(text, rf"(?!(?:{message}):)\w+")


def _without_comments(text: str) -> str:
    """Return the text without comments, which take half of the time of a parser."""
    return re.sub(r'^CM_ [^"]*"[^"]*";\n', "", text, flags=re.M)


def _foreign(text: str, message: str, classic: str, fd: str) -> str:
    """Return the text with a signal ``Foreign`` in the messages whose names match."""

    def add(found: re.Match[str]) -> str:
        place = fd if re.search("(Fd|SecOc):", found[0]) else classic
        return f'{found[0]}\n SG_ Foreign {place} (0,0) [9|-9] ""  AdasEcu'

    return re.sub(rf"^BO_ \d+ (?:{message}): .*$", add, text, flags=re.M)


def of_messages() -> Iterator[Alteration]:
    """Yield the alterations of messages, of their attributes, and of all signals together."""
    text = original()

    def attribute(name: str, of: str, value: str) -> str:
        altered, found = re.subn(rf'^(BA_ "{name}" {of}) \S+;', rf"\1 {value};", text, flags=re.M)
        return _found(altered, found, name)

    def removed(name: str, of: str) -> str:
        return re.sub(rf'^BA_ "{name}" {of} .*\n', "", text, flags=re.M)

    def replaced(old: str, new: str) -> str:
        altered, found = re.subn(old, new, text, flags=re.M)
        return _found(altered, found, old)

    variants = {
        "unaltered": text,
        "maplines.dbc": replace(DEFAULT, slots=SLOTS).dbc(),
        "maplines-secoc.dbc": replace(SECURED, slots=SLOTS).dbc(),
        "without the pose error": replace(DEFAULT, slots=SLOTS, pose=None).dbc(),
        "all Motorola but Crc": changed(text, r"\w+", _motorola),
        "signals in another order": _reordered(text),
        "messages renamed": replaced(r"\bEgo(Left|Right)", r"Line\1"),
        "classic only": _without(text, r"\w+(?:Fd|SecOc)"),
        "CAN FD only": _without(text, r"EgoLeft|EgoRight|\w+SecOc"),
        "authenticated only": _without(text, r"EgoLeft|EgoRight|\w+Fd"),
        "one slot": _without(text, r"EgoRight\w*"),
        "equal E2EDataId": attribute("E2EDataId", r"BO_ \d+", "7"),
        "E2EDataId differs within a slot": attribute("E2EDataId", "BO_ 832", "7"),
        "E2EDataId 70000": attribute("E2EDataId", "BO_ (?:832|840|848)", "70000"),
        "E2EDataId missing in one message": removed("E2EDataId", "BO_ 832"),
        "E2EDataId missing": removed("E2EDataId", r"BO_ \d+"),
        "E2EDataId swapped": attribute("E2EDataId", "BO_ (?:832|840|848)", "1"),
        "equal SecOCDataId": attribute("SecOCDataId", r"BO_ \d+", "7"),
        "SecOCDataId missing in one message": removed("SecOCDataId", "BO_ 848"),
        "SecOCDataId missing": removed("SecOCDataId", r"BO_ \d+"),
        "MapLineSlot twice": attribute("MapLineSlot", "BO_ (?:833|841|849)", "0"),
        "MapLineSlot of one message twice": attribute("MapLineSlot", "BO_ 833", "0"),
        "MapLineSlot 9": attribute("MapLineSlot", "BO_ (?:833|841|849)", "9"),
        "MapLineSlot 1.5": replaced(
            r'^(BA_DEF_ BO_  "MapLineSlot") INT 0 7;', r"\1 FLOAT 0 7;"
        ).replace('BA_ "MapLineSlot" BO_ 833 1;', 'BA_ "MapLineSlot" BO_ 833 1.5;'),
        "MapLineSlot missing in CAN FD": removed("MapLineSlot", "BO_ 840"),
        "MapLineSlot missing": removed("MapLineSlot", r"BO_ \d+"),
        "slots swapped": attribute("MapLineSlot", "BO_ (?:832|840|848)", "5"),
        "equal CAN IDs, classic and CAN FD": replaced(r"\b840\b", "832"),
        "equal CAN IDs of two slots": replaced(r"\b841\b", "840"),
        "CAN ID of another message": replaced(
            "^(?=BO_ 832 )",
            'BO_ 840 Other: 8 PositionEcu\n SG_ A : 0|8@1+ (1,0) [0|0] ""  AdasEcu\n\n',
        ),
        "extended CAN ID": replaced(r"\b832\b", str(2**31 + 0x18FF0040)),
        "extended CAN ID of the same number": replaced(r"\b840\b", str(2**31 + 832)),
        "GenMsgCycleTime 0": attribute("GenMsgCycleTime", r"BO_ \d+", "0"),
        "GenMsgCycleTime 20": attribute("GenMsgCycleTime", r"BO_ \d+", "20"),
        "GenMsgCycleTime -5": attribute("GenMsgCycleTime", r"BO_ \d+", "-5"),
        "GenMsgCycleTime missing": removed("GenMsgCycleTime", r"BO_ \d+"),
        "GenMsgCycleTime of a day": attribute("GenMsgCycleTime", r"BO_ \d+", "86400000"),
        "VFrameFormat CAN FD of the classic": attribute("VFrameFormat", "BO_ 83[23]", "14"),
        "VFrameFormat classic of CAN FD": attribute("VFrameFormat", "BO_ 84[01]", "0"),
        "VFrameFormat classic of CAN FD only": _without(
            attribute("VFrameFormat", "BO_ 84[01]", "0"), r"EgoLeft|EgoRight|\w+SecOc"
        ),
        "VFrameFormat CAN FD of the classic only": _without(
            attribute("VFrameFormat", "BO_ 83[23]", "14"), r"\w+(?:Fd|SecOc)"
        ),
        "VFrameFormat classic of the authenticated": attribute("VFrameFormat", "BO_ 84[89]", "0"),
        "VFrameFormat missing": removed("VFrameFormat", r"BO_ \d+"),
        "CovarianceCode of another": replaced(
            '"CovarianceCode" "Cholesky";', '"CovarianceCode" "Linear";'
        ),
        "CovarianceCode missing": replaced(r'^BA_ "CovarianceCode" .*\n', ""),
        "no multiplexer": replaced("Page M :", "Page :"),
        "multiplexer renamed": replaced("Page M :", "Leaf M :"),
        "signal of page 0 in page 7": replaced("YOff m0", "YOff m7"),
        "a signal in every page": replaced("Kind m4 ", "Kind "),
        "two multiplexers": replaced("Kind m4 ", "Kind m4M "),
        "foreign signal": _foreign(text, r"\w+", "m4 : 16|8@1+", ": 272|8@1+"),
        "foreign signal in one message": _foreign(text, "EgoLeft", "m4 : 16|8@1+", ": 272|8@1+"),
        "foreign signal over another": _foreign(text, r"\w+", "m0 : 30|8@1+", ": 30|8@1+"),
        "foreign signal in the padding": _foreign(
            text, r"\w+Fd", "m4 : 16|8@1+", ": 320|64@1+"
        ),
        "foreign signal named as a page": _foreign(
            text, r"\w+", "m4 : 16|8@1+", ": 272|8@1+"
        ).replace("Foreign", "Pages"),
        "values of Status swapped": replaced('0 "UNKNOWN" 1 "FULL"', '0 "FULL" 1 "UNKNOWN"'),
        "values of Kind translated": replaced('"DASHED"', '"GESTRICHELT"'),
    }  # fmt: skip
    for length, messages in {
        6: "EgoLeft|EgoRight", 7: "EgoLeft|EgoRight", 40: r"\w+Fd", 41: r"\w+Fd",
        47: r"\w+Fd", 64: r"\w+Fd", 65: r"\w+Fd", 32: r"\w+Fd", 48: r"\w+SecOc",
        60: r"\w+SecOc",
    }.items():  # fmt: skip
        variants[f"{length} bytes in {messages}"] = replaced(
            rf"^(BO_ \d+ (?:{messages})): \d+", rf"\1: {length}"
        )
    for name, altered in variants.items():
        yield Alteration("messages", name, altered)


def _found(text: str, found: int, what: str) -> str:
    if not found:
        raise ValueError(f"the original has no {what}")
    return text


def _reordered(text: str) -> str:
    """Return the text with the signals of each message in reverse order."""
    return re.sub(
        r"(?: SG_ .*\n)+",
        lambda found: "".join(reversed(found[0].splitlines(keepends=True))),
        text,
    )


def alterations() -> Iterator[Alteration]:
    """Yield all alterations."""
    yield from of_messages()
    for field in fields():
        yield from of_field(field)
