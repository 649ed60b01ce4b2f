"""Which place of the records of whole scenes each line has.

Some places have a fixed slot. The others are free, and name the slot of their line: those of
``Scene`` go to the nearest lines without a fixed place, those of ``Scene2`` to the next ones. A
line that had a place there, or in the message before, counts as nearer, and keeps it as long as its
message has it. So slots do not go to and fro when two lines are about as far away::

    distance of ROUTE [m]         3.9     4.1     4.6     5.0
    distance of NEXT_RIGHT [m]    4.2     4.0     3.9     3.8
    the free place of Scene      ROUTE   ROUTE   ROUTE   NEXT_RIGHT
    ------------------------------------------------------------------> cycles
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple, TypeAlias

from ..values.line import Slot
from .elementary import tan
from .lines import Curve, y_of

#: By how much a line counts as nearer that had a place in the last cycle [m].
NEARER = 1.0

#: Slots by place; None: of the places of a message, a free one; of those of a cycle, an empty one.
Slots: TypeAlias = tuple[Slot | None, ...]


class Candidate(NamedTuple):
    """A line of the scene."""

    slot: Slot
    curve: Curve
    is_left_out: bool = False  #: the message cannot state it


class Places(NamedTuple):
    """Slots in the places of a cycle; those of the sender before the first one."""

    scene: Slots = ()
    scene2: Slots | None = None  #: None: it is not sent


def chosen(messages: Sequence[Slots], lines: Sequence[Candidate], last: Places) -> Places:
    """Return the places of lines.

    ``Scene2`` is sent if there is such a message, and the lines without a fixed place in ``Scene``
    are more than its free places, or once were: a cyclic message does not come and go.

    Args:
        messages: fixed slots of ``Scene``, and of ``Scene2`` if it can be sent.
        lines: of the scene.
        last: places of the last cycle.
    """
    first, slots = messages[0], {line.slot for line in lines}
    is_needed = len(slots - {*first}) > first.count(None)
    sent = messages if last.scene2 is not None or is_needed else messages[:1]
    fixed = {slot for message in sent for slot in message}
    free = [line for line in lines if line.slot not in fixed]
    found, had = list[Slots](), set[Slot | None]()
    for message, before in zip(sent, (last.scene, last.scene2 or ()), strict=False):
        had |= {*before}
        free.sort(key=lambda line: rank(line, had_place=line.slot in had))
        best = [line.slot for line in free[: message.count(None)]]
        free = free[len(best) :]
        found.append(placed(message, slots, best, before))
    return Places(*found)


def rank(line: Candidate, *, had_place: bool) -> tuple[int, float, Slot]:
    """Return what orders lines for the free places of a message; the least is the first.

    The distance is that of the mean line at the x of its range that is nearest to the car. The
    centre follows from both ego lines, so it comes after all others; and a line that is left out
    after all that go, by its slot alone.
    """
    if line.is_left_out:
        return 2, 0.0, line.slot
    mean, begin, end, _ = line.curve
    distance = abs(y_of(mean, tan(mean[1]), min(max(0.0, begin), end)))
    if had_place:
        distance -= NEARER
    return int(line.slot == Slot.CENTRE), distance, line.slot


def placed(message: Slots, slots: Collection[Slot], best: Sequence[Slot], before: Slots) -> Slots:
    """Return the places of a message: of fixed slots, and of the best lines for the free ones.

    These keep their place of the last cycle; new ones take the first that is left, the best first.
    """
    found = [slot if slot in slots else None for slot in message]
    free = [place for place, slot in enumerate(message) if slot is None]
    for place in free:
        if place < len(before) and before[place] in best:
            found[place] = before[place]
    new = iter([slot for slot in best if slot not in found])
    for place in free:
        if found[place] is None:
            found[place] = next(new, None)
    return (*found,)
