"""Layout of a record of a whole scene: the pose error and its lines in one frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import ClassVar

from ...values.line import Slot
from .pose_layout import SCENE, SceneOwner
from .record_layout import RecordLayout, check_record
from .record_signals import SCENE_RECORD, Signal
from .slot_messages import RecordMessages, SecuredLayout

#: Most lines of a record.
MAX_PLACES = 8


class NoLine(IntEnum):
    """Values of Kind of a place without a line. Those of a line are of ``Kind``; no others are
    sent.
    """

    NONE = 8
    LEFT_OUT_ACROSS = 9
    LEFT_OUT_RANGE = 10
    LEFT_OUT_MEAN = 11
    LEFT_OUT_COVARIANCE = 12


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneLayout(RecordLayout):
    """Layout of a record of a whole scene and its messages, as a DBC describes them.

    Args:
        signals: of the record, named as in Scene. In Scene2 a line whose slot is fixed has another
            name.
        line: signals of the line at the first place, without the start of their names.
        messages: Scene, and Scene2 if there is one.
        fixed: slot of each place; None: the record names it.
        stride_bytes: from a place to the next one.
        secured: layout of the authenticated messages; None if there are none.
        secured_places: places of an authenticated record, which is shorter.

    Raises:
        LayoutError: a signal is missing or is not within its ``Bounds``.
    """

    needed_by: ClassVar[str] = "each message of a whole scene (MapLineScene) needs it"

    line: Mapping[str, Signal]
    messages: Mapping[SceneOwner, RecordMessages]
    fixed: Mapping[SceneOwner, tuple[Slot | None, ...]]
    stride_bytes: int
    secured: SecuredLayout | None = None
    secured_places: int = 0

    def __post_init__(self) -> None:
        self.check(SCENE_RECORD)
        if self.secured is not None:
            signals, where = self._secured_signals, f"{self.source}: authenticated"
            check_record(signals, SCENE_RECORD, where, self.secured_bytes)

    @property
    def _secured_signals(self) -> Mapping[str, Signal]:
        """Signals of an authenticated record."""
        later = range(self.secured_places, self.places)
        starts = {signal.start for place in later for signal in self.at(place).values()}
        return {name: own for name, own in self.signals.items() if own.start not in starts}

    @property
    def content(self) -> tuple[object, ...]:
        """What two layouts of the same content have in common."""
        return self.signals, self.line, self.messages, self.fixed, self.secured, self.secured_places

    @property
    def places(self) -> int:
        """Lines of a record."""
        return len(self.fixed[SCENE])

    def at(self, place: int) -> Mapping[str, Signal]:
        """Return the signals of the line at a place, from 0, without the start of their names."""
        return self._at[place]

    @cached_property
    def _at(self) -> list[dict[str, Signal]]:
        own = self.line.items()
        return [
            {name: self.moved(signal, place) for name, signal in own}
            for place in range(self.places)
        ]

    def moved(self, signal: Signal, place: int) -> Signal:
        """Return a signal of the first place at another one."""
        return replace(signal, start=signal.start + 8 * self.stride_bytes * place)

    @property
    def record_bytes(self) -> int:
        """Length of a record: the payload of a CAN FD message."""
        messages = self.messages[SCENE]
        return self.secured_bytes if messages.fd_can_id is None else messages.fd_length

    @property
    def secured_bytes(self) -> int:
        """Length of an authenticated record, after which the number of the key follows."""
        return self.secured.authentic_bytes - 1 if self.secured else 0

    @cached_property
    def slots(self) -> tuple[Slot, ...]:
        """Slots of lines that records may have."""
        fixed = {slot for slots in self.fixed.values() for slot in slots}
        return tuple(Slot) if None in fixed else tuple(slot for slot in Slot if slot in fixed)
