"""Layout of a record of the pose error, and the messages that carry it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import ClassVar, Literal, TypeAlias

from ...values.line import Slot
from .record_layout import RecordLayout
from .record_signals import POSE_PREFIX, POSE_RECORD, Signal, of_slot, slot_title
from .slot_messages import RecordMessages, SecuredLayout

#: Owner of the records of the pose error, as a slot is that of its lines.
POSE: Literal["pose"] = "pose"
#: Owners of records of whole scenes: the first message, and the second one with more lines.
SCENE: Literal["scene"] = "scene"
SCENE2: Literal["scene2"] = "scene2"
SceneOwner: TypeAlias = Literal["scene", "scene2"]
#: The same by the attribute MapLineScene, from 1.
SCENES: tuple[SceneOwner, ...] = (SCENE, SCENE2)
#: Owner of a record: a slot, the pose error, or a message of whole scenes.
Owner: TypeAlias = Slot | Literal["pose", "scene", "scene2"]
#: Owners by their numbers in the core: ``maplines_owner_t``.
OWNERS: tuple[Owner, ...] = (*Slot, POSE, *SCENES)


class OwnerNumber(IntEnum):
    """Owners in C that are no slots: they follow them."""

    POSE, SCENE, SCENE2 = range(len(Slot), len(Slot) + 3)


def number_of(owner: Owner) -> Slot | OwnerNumber:
    """Return the number of an owner in C: ``maplines_owner_t``."""
    number = OWNERS.index(owner)
    return Slot(number) if number < len(Slot) else OwnerNumber(number)


def slot_of(owner: Owner) -> Slot:
    """Return the slot that is the owner of a line.

    Raises:
        ValueError: the owner is none.
    """
    if owner in (POSE, SCENE, SCENE2):
        raise ValueError(f"{owner_name(owner)} has no slot")
    return owner


def owner_name(owner: Owner) -> str:
    """Return the name of an owner as errors have it."""
    if isinstance(owner, str):
        return {POSE: "the pose error", SCENE: "Scene", SCENE2: "Scene2"}[owner]
    return f"slot {owner.name if isinstance(owner, Slot) else owner}"


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseLayout(RecordLayout):
    """Layout of a record of the pose error and its messages, as a DBC describes them.

    Args:
        messages: of the record.
        secured: layout of the authenticated message; None if there is none.

    Raises:
        LayoutError: a signal is missing or is not within its ``Bounds``.
    """

    needed_by: ClassVar[str] = (
        "each message of the pose error (MapLinePose) needs it, within the pages of 8 bytes"
    )
    prefix: ClassVar[str] = POSE_PREFIX

    messages: RecordMessages
    secured: SecuredLayout | None = None

    def __post_init__(self) -> None:
        of_slots = {name: bounds for slot in Slot for name, bounds in of_slot(slot).items()}
        self.check(
            {**POSE_RECORD, **{name: of_slots[name] for name in of_slots if name in self.signals}}
        )

    @cached_property
    def counters(self) -> dict[Slot, Signal]:
        """Signals with the low bits of the counter of the record that belongs to the pose."""
        names = {slot: f"{slot_title(slot)}Counter" for slot in Slot}
        return {slot: self[name] for slot, name in names.items() if name in self.signals}

    @property
    def content(self) -> tuple[object, ...]:
        """What two layouts of the same content have in common."""
        return self.signals, self.messages, self.secured

    @property
    def short_pages(self) -> int:
        """Number of pages: all records have all of them."""
        return self.pages

    def check_slots(self, slots: Mapping[Slot, Signal], *, levels: bool) -> None:
        """Check the signals of slots: a slot has all of them, or none if it has no messages.

        Args:
            slots: counter of the record of each slot that has messages.
            levels: whether the pose error has the levels of each slot.

        Raises:
            LayoutError: a signal is missing, is longer than the counter of the slot, or is a level
                of a slot whose records have it.
        """
        for slot in Slot:
            title, (counter, *own) = slot_title(slot), of_slot(slot)
            if not levels and (twice := self.signals.keys() & own):
                raise self.error(
                    self[min(twice)],
                    f"to be in the records of {title}, which are conditional on the pose error",
                    "remove it here",
                )
            if slot not in slots and self.signals.keys().isdisjoint([counter, *own]):
                continue
            for name in [counter, *own] if levels else [counter]:
                self[name]
            most = slots[slot].length if slot in slots else self[counter].length
            if self[counter].length > most:
                raise self.error(
                    self[counter], f"at most {most} bits, as the Counter of {title}", "shorten it"
                )
