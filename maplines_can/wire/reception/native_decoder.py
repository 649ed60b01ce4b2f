"""Decoder of received frames in C, with the answers of the one in Python."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import astuple
from typing import Any

from ...native import core
from ...values.line import Slot
from ..c_tables import native_tables
from ..layout.message_layout import Layout
from ..layout.pose_layout import POSE, Owner
from ..protection.e2e_state import E2EState, ProfileStatus
from ..reasons import Reason
from .check import Check
from .decoder import NO_POSE, Decoder
from .sequence import SlotStats
from .settings import RecordSettings
from .views import STALE_CYCLES, SceneView, SlotView, check_stale_cycles

#: Base class with the stations, and ``feed``, ``feed_all``, ``expire``, ``scene`` and the numbers
#: of frames.
_Core: Any = type("_Core", (), {}) if core is None else core.Decoder

_STATES = {int(state): state for state in E2EState}
_STATUSES: dict[int | None, ProfileStatus | None] = {None: None}
_STATUSES |= {int(status): status for status in ProfileStatus}


class NativeDecoder(_Core, Decoder):  # type: ignore[misc]
    """Decoder whose stations are in C: the methods are those of ``Decoder``.

    Args:
        layout: of the records and their messages.
        tables: of the same DBC, from ``c_tables.tables_of``.
        settings: of each owner.
        numbers: of the owners in C.
    """

    def __init__(
        self,
        layout: Layout,
        tables: Any,
        settings: Mapping[Owner, RecordSettings],
        numbers: Mapping[Owner, int],
    ) -> None:
        values = {
            numbers[owner]: (own.timeout_ns, own.cycle_ns, astuple(own.e2e))
            for owner, own in settings.items()
        }
        of_id = layout.message_of_id | (layout.pose.message_of_id if layout.pose else {})
        _Core.__init__(self, native_tables(tables), values, {key: key for key in of_id})
        self.can_ids = layout.can_ids
        self.is_conditional = layout.is_conditional
        self.verifiers = {}
        self._slots = [owner for owner in settings if owner != POSE]
        self._numbers = {owner: numbers[owner] for owner in settings}
        self._cycles_ns = {owner: own.cycle_ns for owner, own in settings.items()}

    @property
    def checks(self) -> Mapping[Owner, Check]:
        """Checks of the records of each slot of the DBC, and of the pose error if it has that."""
        return {owner: self._check_of(owner) for owner in self._numbers}

    @property
    def counts(self) -> Counter[Reason]:
        """Dropped frames by reason."""
        return Counter(self._dropped_frames())

    def latest(self, slot: Slot, now_ns: int, *, stale_cycles: float = STALE_CYCLES) -> SlotView:
        """Return the newest line of a slot with its state; see ``Decoder.latest``."""
        self._check_slot(slot)
        check_stale_cycles(stale_cycles)
        line, age, stale, state, status, two_senders = self._view(slot, now_ns, stale_cycles)
        return SlotView(
            Slot(slot), line, age, stale, _STATES[state], _STATUSES[status], two_senders
        )

    def latest_scene(self, now_ns: int, *, stale_cycles: float = STALE_CYCLES) -> SceneView:
        """Return the newest scene; see ``Decoder.latest_scene``."""
        if POSE not in self._numbers:
            raise ValueError(NO_POSE)
        check_stale_cycles(stale_cycles)
        received = self.scene()
        age, stale, state, status, states, two_senders = self._scene_view(now_ns, stale_cycles)
        known = _STATES[state], _STATUSES[status]
        if received is None:
            return SceneView(None, age, stale, *known)
        slots = (line.slot for line in received.scene.lines)
        of_slots = {slot: _STATES[one] for slot, one in zip(slots, states, strict=True)}
        return SceneView(received.scene, age, stale, *known, received, of_slots, two_senders)

    def _check_of(self, owner: Owner) -> Check:
        number, cycle_ns = self._numbers[owner], self._cycles_ns[owner]
        return _NativeCheck(number, cycle_ns, self._check, self._elapse, self._senders)


class _NativeCheck:
    """Checks of the records of one owner of a decoder: as ``SequenceCheck``, but to be read.

    Args:
        number: of the owner in C.
        cycle_ns: time between records [ns].
        values, elapse, senders: methods of the decoder for the check of an owner.
    """

    def __init__(
        self,
        number: int,
        cycle_ns: int,
        values: Callable[[int], Any],
        elapse: Callable[[int, int], int],
        senders: Callable[[int, int], tuple[bool, bool]],
    ) -> None:
        self.cycle_ns = cycle_ns
        self._number, self._values_of, self._elapse, self._senders = number, values, elapse, senders

    @property
    def state(self) -> E2EState:
        return _STATES[self._values()[0]]

    @property
    def status(self) -> ProfileStatus | None:
        return _STATUSES[self._values()[1]]

    @property
    def lost(self) -> int:
        lost: int = self._values()[2]
        return lost

    @property
    def ahead(self) -> int | None:
        return self._values()[3] or None

    @property
    def counter(self) -> int | None:
        counter: int | None = self._values()[5]
        return counter

    @property
    def two_senders(self) -> bool:
        is_confirmed: bool = self._values()[4]
        return is_confirmed

    @property
    def statuses(self) -> Counter[ProfileStatus]:
        numbers = zip(ProfileStatus, self._values()[6], strict=True)
        return Counter({status: number for status, number in numbers if number})

    def has_one_sender(self, t_ns: int) -> bool:
        return self._senders(self._number, t_ns)[0]

    def counter_was_reused(self, t_ns: int) -> bool:
        return self._senders(self._number, t_ns)[1]

    def elapse(self, t_ns: int) -> E2EState:
        return _STATES[self._elapse(self._number, t_ns)]

    def stats(self) -> SlotStats:
        n = self.statuses
        return SlotStats(
            state=self.state,
            status=self.status,
            ok=n[ProfileStatus.OK] + n[ProfileStatus.OKSOMELOST],
            lost=self.lost,
            repeated=n[ProfileStatus.REPEATED],
            wrong_sequence=n[ProfileStatus.WRONGSEQUENCE],
            errors=n[ProfileStatus.ERROR],
            no_new_data=n[ProfileStatus.NONEWDATA],
            two_senders=self.two_senders,
        )

    def _values(self) -> Any:
        return self._values_of(self._number)
