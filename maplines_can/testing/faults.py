"""Which faults a bus shall have: rates with a seed, and scripts; as values and as text."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, fields
from enum import Enum
from pathlib import Path
from typing import Any, Self

__all__ = [
    "DAMAGES",
    "LAST_EXTENDED_ID",
    "LAST_ID",
    "LENGTHS",
    "Action",
    "FaultKind",
    "Faults",
    "range_of",
]

#: Payloads that a frame can have [bytes]; classic CAN ends at 8.
LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
LAST_ID, LAST_EXTENDED_ID = 0x7FF, 0x1FFFFFFF


class FaultKind(Enum):
    """What is done to a frame. Counted by ``FaultInjector``; the values are the words of a script."""

    LOST = "loss"
    DUPLICATED = "duplicate"
    REORDERED = "reorder"
    DELAYED = "delay"
    FLIPPED = "flip"
    TRUNCATED = "truncate"
    WRONG_DLC = "wrong_dlc"
    WRONG_ID = "wrong_id"
    GARBAGE = "garbage"
    FLOODED = "flood"


#: What ends in a damaged frame; a frame suffers one of them, and ``corrupt`` is the first four.
DAMAGES = (
    *(FaultKind.FLIPPED, FaultKind.TRUNCATED, FaultKind.WRONG_DLC, FaultKind.WRONG_ID),
    FaultKind.GARBAGE,
)
_CORRUPT = tuple(what.value for what in DAMAGES[:-1])
_SHORT = {"dup": "duplicate"}
_WORDS = {what.value: what for what in FaultKind if what is not FaultKind.FLOODED}
#: Least and most value of an action, and its unit; the actions that are not here have none.
_VALUES = {
    FaultKind.REORDERED: (1, 10_000, "frames"),
    FaultKind.DELAYED: (0, 3600, "s"),
    FaultKind.FLIPPED: (1, 512, "bits"),
    FaultKind.TRUNCATED: (0, 48, "bytes"),
    FaultKind.WRONG_DLC: (0, 64, "bytes"),
    FaultKind.WRONG_ID: (0, LAST_EXTENDED_ID, ""),
}
_RATE = (0, 1, "")
#: Least and most value of a field of ``Faults``, and its unit.
_RANGES = {
    **dict.fromkeys(("loss", "duplicate", "reorder", "late"), _RATE),
    **dict.fromkeys((what.value for what in DAMAGES), _RATE),
    "depth": (1, 10_000, "frames"),
    "delay": (0, 3600, "s"),
    "jitter": (0, 3600, "s"),
    "flip_bits": (1, 512, "bits"),
    "flood": (0, 10**6, "1/s"),
    "seed": (0, 2**64, ""),
}
_WHOLE = {"depth", "flip_bits", "seed"}
_DIRECTIONS = ("both", "send", "receive")
#: Frames of a script, N or N-M.
_FRAMES = re.compile(r"([0-9]{1,18})(?:-([0-9]{1,18}))?")
#: Most bytes of a script; ten thousands of lines.
LARGEST_SCRIPT = 1_000_000


@dataclass(frozen=True, slots=True)
class Action:
    """One line of a script: what is done to which frames.

    Raises:
        ValueError: the frames or the value are out of their range.

    >>> Action.parse("flip 20-29 3")  # three bits of ten frames; they are counted from 1
    Action(what=<FaultKind.FLIPPED: 'flip'>, first=20, last=29, value=3.0)
    >>> Action.parse("loss")
    Traceback (most recent call last):
    ...
    ValueError: must be WORD FRAME [VALUE], such as 'flip 20-29 3', got 'loss'
    """

    what: FaultKind
    first: int  #: frame, counted from 1
    last: int  #: frame
    #: Bits to flip, frames or seconds to hold back, bytes that are left, CAN ID; None: drawn.
    value: float | None = None

    def __post_init__(self) -> None:
        word, value = self.what.value, self.value
        if self.what is FaultKind.FLOODED:
            raise ValueError("a flood belongs to no frame; ask for it by its rate, flood=1000")
        if not 1 <= self.first <= self.last:
            raise ValueError(f"frames must be N or N-M from 1 on, got {self.first}-{self.last}")
        if value is None:
            return
        if self.what not in _VALUES:
            raise ValueError(f"{word!r} takes no value, got {_shown(value)}")
        if self.what is not FaultKind.DELAYED and value != value // 1:  # true for NaN too
            raise ValueError(f"the value of {word!r} must be a whole number, got {_shown(value)}")
        lengths = self.what in (FaultKind.TRUNCATED, FaultKind.WRONG_DLC)
        least, most, unit = _VALUES[self.what]
        if not least <= value <= most or (lengths and value not in LENGTHS):
            allowed = f"in [{least:g}, {most:g}] {unit}".rstrip()
            allowed += f", a length of CAN: {', '.join(map(str, LENGTHS))}" if lengths else ""
            raise ValueError(f"the value of {word!r} must be {allowed}, got {_shown(value)}")

    @classmethod
    def parse(cls, text: str) -> Self:
        """An action from its line: word, frame or frames, and a value where it has one.

        Raises:
            ValueError: what is wrong with the line.
        """
        words = text.split()
        if not 2 <= len(words) <= 3:
            raise ValueError(f"must be WORD FRAME [VALUE], such as 'flip 20-29 3', got {text!r}")
        what = _WORDS.get(_SHORT.get(words[0], words[0]))
        if what is None:
            raise ValueError(f"{words[0]!r} is unknown; use {', '.join(_WORDS)}")
        frames = _FRAMES.fullmatch(words[1])
        if frames is None:
            raise ValueError(f"frames must be N or N-M from 1 on, got {words[1]!r}")
        value = None if len(words) == 2 else _number(f"the value of {words[0]!r}", words[2])
        return cls(what, int(frames[1]), int(frames[2] or frames[1]), value)


@dataclass(frozen=True, slots=True)
class Faults:
    """How often which fault happens, from a seed; by default none does.

    A frame is lost, or it goes on; what goes on may be doubled.  Each copy may then be
    damaged in one way, and may be held back, behind later frames or for a time.
    A rate is a share of the frames that come so far.

    A script says what happens to single frames.  A frame that it names suffers
    all that it says of it and nothing else; of one that is doubled too, the second
    copy is the one that is held back.

    Raises:
        ValueError: a value is out of its range, or the rates of damage exceed 1 together.
        TypeError: a value is of another kind.

    >>> faults = Faults.parse("loss=0.1,dup=0.05,reorder=0.05,corrupt=0.02,seed=7")
    >>> faults.duplicate, faults.flip, faults.wrong_id
    (0.05, 0.005, 0.005)
    >>> Faults.parse("loss=10")
    Traceback (most recent call last):
    ...
    ValueError: faults: loss must be in [0, 1], got 10
    >>> Faults(script=[Action.parse("loss 3"), Action.parse("dup 5")]).script[1].what.name
    'DUPLICATED'
    """

    loss: float = 0.0  #: rate of frames that never come
    duplicate: float = 0.0  #: rate of frames that come twice
    reorder: float = 0.0  #: rate of frames that are held back behind later ones
    depth: int = 8  #: by how many frames at most
    late: float = 1.0  #: rate of frames that are delayed, where ``delay`` or ``jitter`` is given
    delay: float = 0.0  #: by how much [s]
    jitter: float = 0.0  #: and up to so much more, each its own [s]
    flip: float = 0.0  #: rate of frames with flipped bits
    flip_bits: int = 3  #: how many at most, in one frame
    truncate: float = 0.0  #: rate of frames that are cut short
    wrong_dlc: float = 0.0  #: rate of frames of another length, cut or filled with zeros
    wrong_id: float = 0.0  #: rate of frames with one flipped bit in their CAN ID
    garbage: float = 0.0  #: rate of frames whose payload is replaced by random bytes
    flood: float = 0.0  #: frames of random bytes that come besides [1/s]
    #: Their CAN IDs and ranges of such, drawn; 0 goes before all others.
    flood_ids: tuple[int | range, ...] = (0,)
    direction: str = "both"  #: of a bus's frames: "send", "receive" or "both"
    seed: int = 0
    script: tuple[Action, ...] = ()  #: what is done to single frames

    def __post_init__(self) -> None:
        one = isinstance(self.flood_ids, range)
        object.__setattr__(self, "flood_ids", (self.flood_ids,) if one else _all(self, "flood_ids"))
        object.__setattr__(self, "script", _all(self, "script"))
        for action in self.script:
            if not isinstance(action, Action):
                raise TypeError(f"faults: script must be of Action.parse, got {action!r}")
        for name, (least, most, unit) in _RANGES.items():
            value = getattr(self, name)
            whole = name in _WHOLE
            kind = "a whole number " if whole else ""
            allowed = f"{kind}in [{least:g}, {most:g}] {unit}".rstrip()
            try:
                fits = least <= value <= most and not (whole and value != int(value))
            except TypeError:
                raise TypeError(f"faults: {name} must be {allowed}, got {value!r}") from None
            if not fits:
                raise ValueError(f"faults: {name} must be {allowed}, got {_shown(value)}")
        damage = sum(getattr(self, what.value) for what in DAMAGES)
        if damage > 1 + 1e-9:
            names = ", ".join(what.value for what in DAMAGES)
            raise ValueError(f"faults: {names} must be 1 together at most, got {damage:g}")
        allowed = f"CAN IDs in [0, {LAST_EXTENDED_ID:#x}]"
        if not self.flood_ids:
            raise ValueError(f"faults: flood_ids must be {allowed}, got none")
        for ids in self.flood_ids:
            try:
                part = range_of(ids)
            except TypeError:
                wrong = f"faults: flood_ids must be {allowed} or ranges of them, got {ids!r}"
                raise TypeError(wrong) from None
            if not part or not all(0 <= end <= LAST_EXTENDED_ID for end in (part[0], part[-1])):
                got = ids if isinstance(ids, range) else f"{ids:#x}"
                raise ValueError(f"faults: flood_ids must be {allowed}, got {got}")
        if self.direction not in _DIRECTIONS:
            raise ValueError(
                f"faults: direction must be {', '.join(_DIRECTIONS)}, got {self.direction!r}"
            )

    @classmethod
    def parse(cls, text: str) -> Self:
        """Faults from text: ``KEY=VALUE,KEY=VALUE``, the keys being the fields.

        Besides, ``dup`` is ``duplicate``; ``corrupt`` shares its rate out equally to flip,
        truncate, wrong_dlc and wrong_id; ``flood_ids`` are joined by plus signs, and may be
        ranges (``0x340-0x347+0x400``); ``script`` is a file with an action a line, such as::

            # what    frames  value
            loss      3               # the third frame never comes
            dup       5
            reorder   7       2       # behind two later frames
            delay     8       0.02    # by 20 ms
            flip      20-29   3       # three bits of each; without a value as the rates say
            truncate  31      4       # to 4 bytes
            wrong_dlc 32      6
            wrong_id  33      0x123
            garbage   34

        Raises:
            ValueError: which key or value is wrong, and what is allowed.
        """
        values: dict[str, Any] = {}
        for item in text.split(","):
            key, equals, value = (part.strip() for part in item.partition("="))
            if not (key and equals and value):
                raise ValueError(f"faults: must be KEY=VALUE,KEY=VALUE, got {item!r}")
            name = _SHORT.get(key, key)
            if name in values:
                raise ValueError(f"faults: {name} is given twice")
            values[name] = _value(name, value)
        corrupt = values.pop("corrupt", None)
        if corrupt is not None:
            if given := sorted(values.keys() & set(_CORRUPT)):
                raise ValueError(f"faults: corrupt stands for {given[0]} too; give one of them")
            if not 0 <= corrupt <= 1:
                raise ValueError(f"faults: corrupt must be in [0, 1], got {_shown(corrupt)}")
            values |= dict.fromkeys(_CORRUPT, corrupt / len(_CORRUPT))
        return cls(**values)


def range_of(ids: int | range) -> range:
    """A CAN ID as a range; a range as it is."""
    return ids if isinstance(ids, range) else range(ids, ids + 1)


def _value(name: str, text: str) -> Any:
    known = [field.name for field in fields(Faults)]
    if name not in (*known, "corrupt"):
        short = {word: key for key, word in _SHORT.items()}
        words = ", ".join(f"{k} ({short[k]})" if k in short else k for k in known)
        raise ValueError(f"faults: {name!r} is unknown; use {words}, corrupt")
    if name == "direction":
        return text
    if name == "script":
        return _read_script(Path(text))
    if name == "flood_ids":
        return tuple(_ids(part) for part in text.split("+"))
    number = _number(f"faults: {name}", text)
    return int(number) if name in _WHOLE and number == number // 1 else number


def _number(what: str, text: str) -> float:
    try:
        return int(text, 0) if text[:2].lower() == "0x" else float(text)
    except ValueError:
        raise ValueError(f"{what} must be a number, got {text!r}") from None


def _shown(number: float) -> str:
    """A number for a message, however many digits it has."""
    try:
        return f"{number:g}"
    except OverflowError:  # of a whole number
        return "more than 1e308" if number > 0 else "less than -1e308"


def _all(faults: Faults, name: str) -> tuple[Any, ...]:
    values = getattr(faults, name)
    if not isinstance(values, Iterable):
        raise TypeError(f"faults: {name} must be a tuple, got {values!r}")
    return tuple(values)


def _ids(text: str) -> int | range:
    try:
        first, *more = (int(part, 0) for part in text.split("-"))
        (last,) = more or (first,)
    except ValueError:
        raise ValueError(f"faults: flood_ids must be such as 0x340-0x347+0, got {text!r}") from None
    if not 0 <= first <= last <= LAST_EXTENDED_ID:
        raise ValueError(
            f"faults: flood_ids must be CAN IDs in [0, {LAST_EXTENDED_ID:#x}], got {text!r}"
        )
    return range(first, last + 1) if more else first


def _read_script(path: Path) -> tuple[Action, ...]:
    try:
        with path.open("rb") as file:  # a pipe or device may never end
            data = file.read(LARGEST_SCRIPT + 1)
        if len(data) > LARGEST_SCRIPT:
            most = f"{LARGEST_SCRIPT:,} bytes"
            raise ValueError(f"faults: the script {path} must have {most} at most")
        text = data.decode()
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is not text"
        raise ValueError(f"faults: the script {path} cannot be read: {why}") from error
    actions = []
    for number, line in enumerate(text.splitlines(), start=1):
        if words := line.partition("#")[0].strip():
            try:
                actions.append(Action.parse(words))
            except ValueError as error:
                raise ValueError(f"faults: {path}, line {number}: {error}") from error
    return tuple(actions)
