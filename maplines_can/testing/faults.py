"""Faults to inject: random rates and scripts of single faults, as values and as text."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple, Self

from .scripted_fault import (
    ALIASES,
    DAMAGES,
    DELAY,
    DEPTH,
    FLIP_BITS,
    LAST_EXTENDED_ID,
    Limits,
    ScriptedFault,
    number,
    read_script,
    shown,
)

_CORRUPT = tuple(kind.value for kind in DAMAGES[:-1])
_RATES = ("loss", "duplicate", "reorder", "late", *(kind.value for kind in DAMAGES))
#: Limits of the numbers among the fields of ``Faults``.
_LIMITS = {
    **dict.fromkeys(_RATES, Limits(0, 1)),
    "depth": DEPTH,
    "delay": DELAY,
    "jitter": DELAY,
    "flip_bits": FLIP_BITS,
    "flood": Limits(0, 10**6, "1/s"),
    "seed": Limits(0, 2**64, whole=True),
}
_DIRECTIONS = ("both", "send", "receive")
#: Fields that can have intervals. Outside of them, they are 0.
_TIMED = (*_RATES, "delay", "jitter", "flood")
#: Time in an interval [s].
_TIME = r"((?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE]-?[0-9]+)?)"


class Interval(NamedTuple):
    """Time in which a fault is active, from the start of the injection on.

    >>> Faults(loss=1.0, schedule=[Interval("loss", 2.0, 2.6)]).at(2.5).loss
    1.0
    """

    field: str  #: of ``Faults``: a rate, delay, jitter or flood
    begin: float  #: [s]
    end: float  #: from which it is not active any more, may be infinite [s]


@dataclass(frozen=True, slots=True)
class Faults:
    """Rates of the faults to inject, a seed, and a script; by default there are no faults.

    A frame is lost, or passed on and perhaps duplicated.  Each copy may then be
    damaged in one way, and may be held back, behind later frames or for a time.
    Each rate is the share of the frames that reach its step.

    A script names faults of single frames.  A frame that it names gets exactly these faults,
    whatever the rates.  If it is duplicated and held back, the second copy is held back.

    A schedule has the times in which rates, delays and floods are active; those that it does not
    name are active all the time.

    Raises:
        ValueError: a value is out of range, or the sum of the rates of damage exceeds 1.
        TypeError: a value has a wrong type.

    >>> faults = Faults.parse("loss=0.1,dup=0.05,reorder=0.05,corrupt=0.02,seed=7")
    >>> faults.duplicate, faults.flip, faults.wrong_id
    (0.05, 0.005, 0.005)
    >>> Faults.parse("loss=10")
    Traceback (most recent call last):
    ...
    ValueError: faults: loss must be in [0, 1], got 10
    >>> Faults(script=[ScriptedFault.parse("loss 3")]).script[0].kind.name
    'LOST'
    >>> faults = Faults.parse("dup=0.1,loss=1@2.0-2.6+5-")  # a short outage, and one that lasts
    >>> [faults.at(t).loss for t in (1.9, 2.0, 2.6, 5.0)]
    [0.0, 1.0, 0.0, 1.0]
    """

    loss: float = 0.0  #: rate of frames that are lost
    duplicate: float = 0.0  #: rate of frames that are passed on twice
    reorder: float = 0.0  #: rate of frames that are held back behind later ones
    depth: int = 8  #: most frames by which a frame is held back
    late: float = 1.0  #: rate of frames that are delayed, if ``delay`` or ``jitter`` is given
    delay: float = 0.0  #: delay of these frames [s]
    jitter: float = 0.0  #: largest random delay in addition, drawn for each frame [s]
    flip: float = 0.0  #: rate of frames with flipped bits
    flip_bits: int = 3  #: most flipped bits in one frame
    truncate: float = 0.0  #: rate of frames that are cut short
    wrong_dlc: float = 0.0  #: rate of frames of another length, cut short or padded with zeros
    wrong_id: float = 0.0  #: rate of frames with one flipped bit in their CAN ID
    garbage: float = 0.0  #: rate of frames whose payload is replaced by random bytes
    flood: float = 0.0  #: additional frames of random bytes [1/s]
    #: CAN IDs of the flood, and ranges of them; 0 has priority over all others.
    flood_ids: tuple[int | range, ...] = (0,)
    direction: str = "both"  #: which frames of a bus get faults: "send", "receive" or "both"
    seed: int = 0
    script: tuple[ScriptedFault, ...] = ()  #: faults of single frames
    schedule: tuple[Interval, ...] = ()  #: times in which rates, delays and floods are active

    def __post_init__(self) -> None:
        if isinstance(self.flood_ids, range):
            object.__setattr__(self, "flood_ids", (self.flood_ids,))
        for name in ("flood_ids", "script", "schedule"):
            values = getattr(self, name)
            if not isinstance(values, Iterable):
                raise TypeError(f"faults: {name} must be a tuple, got {values!r}")
            object.__setattr__(self, name, tuple(values))
        for fault in self.script:
            if not isinstance(fault, ScriptedFault):
                raise TypeError(f"faults: script must contain ScriptedFault objects, got {fault!r}")
        for name, limits in _LIMITS.items():
            limits.check(f"faults: {name}", getattr(self, name))
        object.__setattr__(self, "schedule", tuple(map(self._interval, self.schedule)))
        names = [kind.value for kind in DAMAGES]
        damage = max(sum(getattr(self.at(t), name) for name in names) for t in self.changes)
        if damage > 1 + 1e-9:
            allowed = f"the sum of {', '.join(names)} must be 1 at most"
            raise ValueError(f"faults: {allowed}, got {damage:g}")
        allowed = f"faults: flood_ids must be CAN IDs in [0, {LAST_EXTENDED_ID:#x}]"
        if not self.flood_ids:
            raise ValueError(f"{allowed}, got none")
        for ids in self.flood_ids:
            try:
                span = id_range(ids)
            except TypeError:
                raise TypeError(f"{allowed} or ranges of them, got {ids!r}") from None
            if not span or not all(0 <= end <= LAST_EXTENDED_ID for end in (span[0], span[-1])):
                last = f"-{ids.stop - 1:#x}" if isinstance(ids, range) else ""
                first = ids.start if isinstance(ids, range) else ids
                raise ValueError(f"{allowed}, got {first:#x}{last}")
        if self.direction not in _DIRECTIONS:
            allowed = ", ".join(_DIRECTIONS)
            raise ValueError(f"faults: direction must be {allowed}, got {self.direction!r}")

    def _interval(self, interval: Interval) -> Interval:
        """Return an interval of the schedule if it is valid."""
        try:
            name, begin, end = interval
            valid = 0 <= begin < end
        except (TypeError, ValueError):
            raise TypeError(
                "faults: schedule must contain (field, begin [s], end [s]), such as "
                f"('loss', 2.0, 2.6), got {interval!r}"
            ) from None
        if name not in _TIMED:
            raise ValueError(
                f"faults: {name} cannot have an interval; {', '.join(_TIMED)} and corrupt can"
            )
        if not valid:
            raise ValueError(
                f"faults: the interval of {name} must have 0 <= begin < end [s], "
                f"got {shown(begin)} to {shown(end)}"
            )
        if getattr(self, name) == 0:
            raise ValueError(f"faults: {name} has an interval but is 0; give its value, too")
        return Interval(name, float(begin), float(end))

    @property
    def changes(self) -> list[float]:
        """Times from the start of the injection on at which `at` changes [s], 0 the first."""
        times = {time for interval in self.schedule for time in interval[1:]}
        return sorted({0.0, *times} - {math.inf})

    def at(self, time: float) -> Self:
        """Return the faults that are active at a time [s] after the start, without a schedule."""
        if not self.schedule:
            return self
        names = {interval.field for interval in self.schedule}
        active = {i.field for i in self.schedule if i.begin <= time < i.end}
        inactive: dict[str, Any] = dict.fromkeys(names - active, 0.0)
        return replace(self, schedule=(), **inactive)

    def intervals(self, field: str) -> list[tuple[float, float]]:
        """Return the begins and ends of the times in which a field is active [s], in order."""
        own = sorted(interval[1:] for interval in self.schedule if interval.field == field)
        merged: list[tuple[float, float]] = []
        for begin, end in own or [(0.0, math.inf)]:
            if merged and begin <= merged[-1][1]:
                merged[-1] = merged[-1][0], max(end, merged[-1][1])
            else:
                merged.append((begin, end))
        return merged

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the faults of a text ``KEY=VALUE,KEY=VALUE``.

        The keys are the fields, and ``dup`` for ``duplicate``; ``corrupt`` divides its rate
        equally among flip, truncate, wrong_dlc and wrong_id.  ``flood_ids`` are CAN IDs and
        ranges of them, joined by plus signs (``0x340-0x347+0x400``).  ``script`` is a file with
        one scripted fault a line, such as::

            # kind    frames  value
            loss      3               # the third frame
            dup       5
            reorder   7       2       # behind two later frames
            delay     8       0.02    # by 20 ms
            flip      20-29   3       # three bits of each; default: random, up to flip_bits
            truncate  31      4       # to 4 bytes
            wrong_dlc 32      6
            wrong_id  33      0x123
            garbage   34

        ``@FROM-TO`` after the value of a rate, a delay or a flood is the time in which it is active
        [s]: ``loss=1@2.0-2.6``, without ``TO`` to the end; several are joined by plus signs.

        Raises:
            ValueError: a key or a value is wrong; the message has what is allowed.
        """
        values: dict[str, Any] = {}
        schedule: list[Interval] = []
        for item in text.split(","):
            key, equals, value = (word.strip() for word in item.partition("="))
            if not (key and equals and value):
                raise ValueError(f"faults: must be KEY=VALUE,KEY=VALUE, got {item!r}")
            name = ALIASES.get(key, key)
            if name in values:
                raise ValueError(f"faults: {name} is given twice")
            number, at, times = value.partition("@" if name != "script" else "\0")
            values[name] = _parse_value(name, number)
            for span in _parse_times(value, times) if at else ():
                timed = _CORRUPT if name == "corrupt" else (name,)
                schedule += (Interval(field, *span) for field in timed)
        if "corrupt" in values:
            rate = values.pop("corrupt")
            if given := sorted(values.keys() & set(_CORRUPT)):
                raise ValueError(f"faults: corrupt includes {given[0]}; give one of them only")
            Limits(0, 1).check("faults: corrupt", rate)
            values |= dict.fromkeys(_CORRUPT, rate / len(_CORRUPT))
        return cls(**values, schedule=tuple(schedule))


def id_range(ids: int | range) -> range:
    """Return a CAN ID as a range of one; a range as it is."""
    return ids if isinstance(ids, range) else range(ids, ids + 1)


def _parse_value(name: str, text: str) -> Any:
    known = [field.name for field in fields(Faults) if field.name != "schedule"]
    if name not in (*known, "corrupt"):
        aliases = {full: f"{full} ({short})" for short, full in ALIASES.items()}
        words = ", ".join(aliases.get(key, key) for key in known)
        raise ValueError(f"faults: {name!r} is unknown; use {words}, corrupt")
    if name == "direction":
        return text
    if name == "script":
        return read_script(Path(text))
    if name == "flood_ids":
        return tuple(map(_parse_ids, text.split("+")))
    value = number(f"faults: {name}", text)
    whole = name in _LIMITS and _LIMITS[name].whole
    return int(value) if whole and value == value // 1 else value


def _parse_times(value: str, text: str) -> Iterable[tuple[float, float]]:
    for part in text.split("+"):
        match = re.fullmatch(rf"{_TIME}-{_TIME}?", part.strip())
        if match is None:
            raise ValueError(
                "faults: an interval must be @FROM-TO or @FROM- [s], such as loss=1@2.0-2.6, "
                f"got {value!r}"
            )
        yield float(match[1]), float(match[2] or math.inf)


def _parse_ids(text: str) -> int | range:
    try:
        first, *rest = (int(end, 0) for end in text.split("-"))
        if not rest:
            return first
        (last,) = rest
    except ValueError:
        raise ValueError(f"faults: flood_ids must look like 0x340-0x347+0, got {text!r}") from None
    return range(first, last + 1)
