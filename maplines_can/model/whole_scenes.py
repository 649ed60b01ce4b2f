"""Records of whole scenes: what they say, how one is written, and which are of one scene.

A record has the pose error and some lines, so it means something alone. ``Scene2`` has more lines
of the scene of a ``Scene``: it joins the newest one if both have the same low bits of its counter
and the same pose error, and were received within a cycle::

    Scene          5                6                7            low bits of its counter
    Scene2       5                6                         7
    newest scene   5 + 5            6 + 6            7      7 + 7
    -------------------------------------------------------------> time

What comes before its ``Scene`` waits for it. So a sender sends ``Scene2`` first, and a scene is
whole when it becomes the newest one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from ..values.line import Kind, Slot
from ..wire.layout.message_layout import Layout
from ..wire.layout.pose_layout import SCENE, SCENE2, Owner, SceneOwner
from ..wire.layout.record_signals import POSE_ROWS
from ..wire.layout.scene_layout import SceneLayout
from .covariance import code_of
from .lines import is_line
from .records import RawRecord, sealed, signals_of
from .scenes import Member, Pose, curve_of, pose_of, signals_of_slot
from .signals import Raw, packed, read

#: Value of ``Kind`` of a place without a line, and the reasons of those that follow it: for these,
#: the line of the slot is left out.
NONE, REASONS = len(Kind), ("ACROSS", "RANGE", "MEAN", "COVARIANCE")
#: Levels of the pose error besides its covariance.
LEVELS = ("CorrelationTime", "MapOffset", "MapHeading")


class WholeRecord(NamedTuple):
    """Content of a record of a whole scene."""

    owner: SceneOwner
    counter: int
    pose: Pose
    members: dict[Slot, Member]  #: its lines, in the order of places
    left_out: dict[Slot, str]  #: why it has no lines of these slots
    size: int = 1  #: such a record has no mixture

    def of_slots(self, count: int) -> WholeRecord:
        """Return the content without what is of other slots than the first ones."""
        members = {slot: member for slot, member in self.members.items() if slot < count}
        left_out = {slot: why for slot, why in self.left_out.items() if slot < count}
        return self._replace(members=members, left_out=left_out)


def whole(
    layout: Layout, owner: Owner, record: bytes, raw: Raw, t_ns: int, *, is_secured: bool
) -> WholeRecord | str:
    """Return the content of an intact record, or CONTENT.

    No sender sends unknown kinds, an empty range, a line that is no function of x, a slot twice, or
    in ``Scene`` other bits of its own counter.
    """
    scene = scene_of_dbc(layout)
    assert owner == SCENE or owner == SCENE2  # noqa: S101 - others have no such record
    slots = scene.fixed[owner][: scene.secured_places if is_secured else scene.places]
    pose, members = pose_of(scene, RawRecord(raw["Counter"], raw), t_ns), dict[Slot, Member]()
    left_out = dict[Slot, str]()
    if owner == SCENE and raw["SceneCounter"] != joint_bits(scene, raw["Counter"]):
        return "CONTENT"
    for place, fixed in enumerate(slots):
        own = {name: read(signal, record) for name, signal in scene.at(place).items()}
        kind = own["Kind"]
        if kind == NONE:
            continue
        slot = Slot(own["Slot"]) if fixed is None else fixed
        if slot in members or slot in left_out or kind > NONE + len(REASONS):
            return "CONTENT"
        if kind > NONE:
            left_out[slot] = REASONS[kind - NONE - 1]
            continue
        members[slot] = Member(slot, raw["Counter"], RawRecord(raw["Counter"], own), t_ns, 0)
        if not is_line(curve_of(layout, signals_of_slot(layout, slot), own)):
            return "CONTENT"
    return WholeRecord(owner, raw["Counter"], pose, members, left_out)


def write_whole(
    layout: SceneLayout, raw: Raw, lines: Sequence[Raw], length: int, data_id: int
) -> bytes:
    """Return the record of raw values: of the pose error, and of each place."""
    record = int.from_bytes(packed(signals_of(layout, length), raw, length), "big")
    for place, line in enumerate(lines):
        record |= int.from_bytes(packed(layout.at(place).values(), line, length), "big")
    return sealed(layout, record.to_bytes(length, "big"), data_id)


def scene_of_dbc(layout: Layout) -> SceneLayout:
    """Return the layout of whole scenes."""
    assert layout.scene is not None  # noqa: S101 - only such a DBC has their records
    return layout.scene


def joint_bits(layout: SceneLayout, counter: int) -> int:
    """Return the low bits of the counter of ``Scene``, which both messages have."""
    return counter % 2 ** layout["SceneCounter"].length


def shared(layout: SceneLayout) -> list[str]:
    """Return the names of the signals that are equal in both records of a scene.

    The age is not among them: each record has its own time of sending.
    """
    code = code_of(layout, POSE_ROWS)
    of_rows = [one.name for _, pivot, ratios in code.rows for one in (pivot, *ratios)]
    return [*of_rows, code.inflation.name, *LEVELS, "SceneCounter"]


class SceneContent(NamedTuple):
    """What the records of a scene say."""

    pose: Pose
    members: list[Member]  #: lines in the order of slots
    owners: dict[Slot, Owner]  #: whose records have the lines
    left_out: dict[Slot, str]  #: why there are no lines of these slots


class WholeScenes:
    """The newest scene of a receiver."""

    def __init__(self, layout: SceneLayout, cycle_ns: int) -> None:
        self._shared, self._cycle_ns = shared(layout), cycle_ns
        self.scene: WholeRecord | None = None  #: the newest ``Scene``
        self.joined: WholeRecord | None = None  #: the ``Scene2`` of the same scene
        self._early: WholeRecord | None = None  # a ``Scene2`` that has joined none
        self._newest: dict[SceneOwner, WholeRecord] = {}  # the last one at the end

    def add(self, record: WholeRecord, *, is_break: bool) -> None:
        """Add a new record; after a break, what came before is of another sequence."""
        self._newest.pop(record.owner, None)
        self._newest[record.owner] = record
        if record.owner == SCENE:
            early = None if is_break else self._early
            self.scene, self._early = record, None
            self.joined = early if early is not None and self._agree(record, early) else None
        elif (
            self.scene is not None
            and self.joined is None
            and not is_break
            and self._agree(self.scene, record)
        ):
            self.joined = record
        else:
            self._early = record

    @property
    def content(self) -> SceneContent | None:
        """The newest scene; of a slot that both records have, what ``Scene`` says."""
        if self.scene is None:
            return None
        members, owners, left_out = dict[Slot, Member](), dict[Slot, Owner](), dict[Slot, str]()
        for record in (self.joined, self.scene):
            if record is not None:
                members |= record.members
                owners |= dict.fromkeys(record.members, record.owner)
                left_out |= record.left_out
        ordered = [members[slot] for slot in sorted(members)]
        reasons = {slot: why for slot, why in left_out.items() if slot not in members}
        return SceneContent(self.scene.pose, ordered, owners, reasons)

    def newest_with(self, slot: Slot) -> WholeRecord | None:
        """Return the newest record that has a line of a slot."""
        records = reversed(self._newest.values())
        return next((record for record in records if slot in record.members), None)

    def left_out_of(self, slot: Slot) -> str | None:
        """Return why there is no line of a slot; None if the newest record that names it has one.

        Of the newest records of both messages, that is the one that has come last.
        """
        found = None
        for record in self._newest.values():
            if slot in record.members or slot in record.left_out:
                found = record.left_out.get(slot)
        return found

    def _agree(self, scene: WholeRecord, scene2: WholeRecord) -> bool:
        one, other = scene.pose, scene2.pose
        is_same = all(one.raw[name] == other.raw[name] for name in self._shared)
        return is_same and abs(one.t_ns - other.t_ns) <= self._cycle_ns
