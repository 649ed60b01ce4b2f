"""Kinds of faults, and a fault of given frames: one line of a script."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import NamedTuple, Self

#: Payload lengths of CAN FD [bytes]; those of classic CAN end at 8.
LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
LAST_ID, LAST_EXTENDED_ID = 0x7FF, 0x1FFFFFFF
#: Largest script file [bytes].
MAX_SCRIPT = 1_000_000


class FaultKind(Enum):
    """Kind of fault. The values are the words of a script; ``FaultInjector`` counts each kind."""

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


#: Kinds that damage a frame. A frame gets one of them at most; ``corrupt`` is the first four.
DAMAGES = (
    *(FaultKind.FLIPPED, FaultKind.TRUNCATED, FaultKind.WRONG_DLC, FaultKind.WRONG_ID),
    FaultKind.GARBAGE,
)


class Limits(NamedTuple):
    """Limits of a number."""

    least: float
    most: float
    unit: str = ""
    whole: bool = False

    def check(self, name: str, value: float) -> None:
        """Check a value.

        Raises:
            TypeError, ValueError: it is no number, or out of the limits.
        """
        whole = "a whole number " if self.whole else ""
        allowed = f"{whole}in [{self.least:g}, {self.most:g}] {self.unit}".rstrip()
        try:
            valid = self.least <= value <= self.most and not (self.whole and value != int(value))
        except TypeError:
            raise TypeError(f"{name} must be {allowed}, got {value!r}") from None
        if not valid:
            raise ValueError(f"{name} must be {allowed}, got {shown(value)}")


#: Limits of numbers that a scripted fault has in common with the fields of ``Faults``.
DEPTH, DELAY = Limits(1, 10_000, "frames", whole=True), Limits(0, 3600, "s")
FLIP_BITS = Limits(1, 512, "bits", whole=True)
#: Limits of the value of a scripted fault; the other kinds take none.
_VALUES = {
    FaultKind.REORDERED: DEPTH,
    FaultKind.DELAYED: DELAY,
    FaultKind.FLIPPED: FLIP_BITS,
    FaultKind.TRUNCATED: Limits(0, 48, "bytes", whole=True),
    FaultKind.WRONG_DLC: Limits(0, 64, "bytes", whole=True),
    FaultKind.WRONG_ID: Limits(0, LAST_EXTENDED_ID, whole=True),
}
ALIASES = {"dup": "duplicate"}
_WORDS = {kind.value: kind for kind in FaultKind if kind is not FaultKind.FLOODED}


@dataclass(frozen=True, slots=True)
class ScriptedFault:
    """A fault of given frames: one line of a script.

    Raises:
        ValueError: the frames or the value are out of range.

    >>> ScriptedFault.parse("flip 20-29 3")  # three bits of ten frames; they are counted from 1
    ScriptedFault(kind=<FaultKind.FLIPPED: 'flip'>, first=20, last=29, value=3.0)
    >>> ScriptedFault.parse("loss")
    Traceback (most recent call last):
    ...
    ValueError: must be WORD FRAME [VALUE], such as 'flip 20-29 3', got 'loss'
    """

    kind: FaultKind
    first: int  #: frame, counted from 1
    last: int  #: frame
    #: Bits to flip, frames or seconds to hold back, payload length, or CAN ID; None: random.
    value: float | None = None

    def __post_init__(self) -> None:
        if self.kind is FaultKind.FLOODED:
            raise ValueError("a flood belongs to no frame; set its rate instead, flood=1000")
        if not 1 <= self.first <= self.last:
            raise ValueError(f"frames must be N or N-M from 1 on, got {self.first}-{self.last}")
        if self.value is None:
            return
        if self.kind not in _VALUES:
            raise ValueError(f"{self.kind.value!r} takes no value, got {shown(self.value)}")
        name = f"the value of {self.kind.value!r}"
        _VALUES[self.kind].check(name, self.value)
        if self.kind in (FaultKind.TRUNCATED, FaultKind.WRONG_DLC) and self.value not in LENGTHS:
            lengths = ", ".join(map(str, LENGTHS))
            raise ValueError(f"{name} must be a length of CAN: {lengths}, got {self.value:g}")

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the fault of a line ``WORD FRAME [VALUE]`` or ``WORD FIRST-LAST [VALUE]``.

        Raises:
            ValueError: the line is wrong.
        """
        words = text.split()
        if not 2 <= len(words) <= 3:
            raise ValueError(f"must be WORD FRAME [VALUE], such as 'flip 20-29 3', got {text!r}")
        word, frames = words[:2]
        kind = _WORDS.get(ALIASES.get(word, word))
        if kind is None:
            raise ValueError(f"{word!r} is unknown; use {', '.join(_WORDS)}")
        match = re.fullmatch(r"([0-9]{1,18})(?:-([0-9]{1,18}))?", frames)
        if match is None:
            raise ValueError(f"frames must be N or N-M from 1 on, got {frames!r}")
        value = None if len(words) == 2 else number(f"the value of {word!r}", words[2])
        return cls(kind, int(match[1]), int(match[2] or match[1]), value)


def read_script(path: Path) -> tuple[ScriptedFault, ...]:
    """Return the faults of a script, one in each line."""
    try:
        with path.open("rb") as file:  # read no more: a pipe or a device may be endless
            data = file.read(MAX_SCRIPT + 1)
        if len(data) > MAX_SCRIPT:
            raise ValueError(f"faults: the script {path} must have {MAX_SCRIPT:,} bytes at most")
        text = data.decode()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not text"
        raise ValueError(f"faults: the script {path} cannot be read: {reason}") from error
    script = []
    for row, line in enumerate(text.splitlines(), start=1):
        if words := line.partition("#")[0].strip():
            try:
                script.append(ScriptedFault.parse(words))
            except ValueError as error:
                raise ValueError(f"faults: {path}, line {row}: {error}") from error
    return tuple(script)


def number(name: str, text: str) -> float:
    """Return a number in a text, which may be hexadecimal."""
    try:
        return int(text, 0) if text[:2].lower() == "0x" else float(text)
    except ValueError:
        raise ValueError(f"{name} must be a number, got {text!r}") from None


def shown(number: float) -> str:
    """Return a number as text."""
    try:
        return f"{number:g}"
    except OverflowError:  # an int that is too large for a float
        return "more than 1e308" if number > 0 else "less than -1e308"
