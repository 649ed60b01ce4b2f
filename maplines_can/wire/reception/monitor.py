"""Monitor of the newest line of each slot, and of whether it may be used."""

from __future__ import annotations

import math
from typing import NamedTuple

from ...line import MapLine, Slot
from ...scene import Scene
from ..protection.e2e_state import E2EState, ProfileStatus
from ..reasons import Reason
from .decoder import Decoder
from .scenes import ReceivedScene
from .sequence import SlotStats

#: A line is stale when nothing newer has come for this many cycle times: two consecutive lines
#: may be lost. At 20 Hz the last one is then 150 ms old. The E2E state follows at 275 ms.
STALE_CYCLES = 3.0


class SlotView(NamedTuple):
    """State of a slot at the consumer's call."""

    slot: Slot
    line: MapLine | None  #: the newest; None before the first
    #: from the time of the line's pose to now [s]; infinite if too old, unknown, or without a line
    age: float
    stale: bool  #: nothing newer came for some cycle times, or there is no line
    state: E2EState  #: of the slot
    status: ProfileStatus | None  #: of the last check; None before the first
    two_senders: bool  #: two senders were detected on the slot in the last 256 cycles

    @property
    def usable(self) -> bool:
        """Whether a controller may use the line.

        This is so if the E2E state is VALID, the line is not stale, the slot has one sender, the
        status of the line is not OUT_OF_RANGE, and its age is finite.

        The ``age`` of a usable line is at most the greatest age that the DBC can state plus
        ``stale_cycles`` cycle times: 240 ms + 150 ms with the project's DBC. It is not less than
        the true age, except for the time that the first frame of the line spent in the transmit
        queue of the interface and on the bus. If the producer of the lines hangs, no line is
        therefore usable later than 390 ms after its pose, plus that time.
        """
        line = self.line
        vouched = line is not None and line.is_usable
        return vouched and self.state is E2EState.VALID and not self.stale and not self.two_senders


class SceneView(NamedTuple):
    """The newest scene at the consumer's call."""

    scene: Scene | None  #: None before the first
    #: from the time of the pose to now [s]; infinite if too old, unknown, or without a scene
    age: float
    stale: bool  #: its pose error came some cycle times ago
    state: E2EState  #: of the pose error
    status: ProfileStatus | None  #: of the last check of a pose error; None before the first
    received: ReceivedScene | None = None  #: with its time of reception, and its age then

    @property
    def usable(self) -> bool:
        """Whether a controller may use the scene.

        This is so if the E2E state of the pose error is VALID, it is not stale, and its age is
        finite. Whether a slot is VALID, ``Monitor.latest`` tells.
        """
        return math.isfinite(self.age) and self.state is E2EState.VALID and not self.stale


class Monitor:
    """Decoder that keeps the newest line of each slot; time is an argument.

    ``Receiver.latest`` uses one. It can also be used without a bus, as in a simulator.
    It is not thread-safe.

    >>> from maplines_can import Codec, Slot, MapLine
    >>> codec = Codec.from_dbc()
    >>> monitor = Monitor(codec.decoder())
    >>> for frame in codec.encode(MapLine.mean_only(Slot.ROUTE, [1.75, 0, 0, 0], age=0.02)):
    ...     _ = monitor.feed(frame.can_id, frame.data, t_ns=0)
    >>> view = monitor.latest(Slot.ROUTE, now_ns=60_000_000)
    >>> view.state.name, round(view.age, 3), view.stale
    ('INIT', 0.084, False)
    >>> monitor.latest(Slot.ROUTE, now_ns=160_000_000).stale
    True
    """

    def __init__(self, decoder: Decoder) -> None:
        self._decoder = decoder
        self._lines: dict[Slot, MapLine] = {}

    def feed(
        self, can_id: int, data: bytes, t_ns: int, *, is_extended: bool = False
    ) -> MapLine | Reason:
        """Decode a frame, and keep the line that it completes as the newest of its slot."""
        answer = self._decoder.feed(can_id, data, t_ns, is_extended=is_extended)
        if isinstance(answer, MapLine):
            self._lines[answer.slot] = answer
        for line in self._decoder.further:
            self._lines[line.slot] = line
        return answer

    @property
    def further(self) -> list[MapLine]:
        """Lines that the last frame completed in addition to the one that ``feed`` returned."""
        return self._decoder.further

    def latest_scene(self, now_ns: int, *, stale_cycles: float = STALE_CYCLES) -> SceneView:
        """Return the newest scene: lines of one pose, with their joint covariance.

        The lines of a cycle arrive one after the other, in all of the cycle. The scene before
        remains the newest one until lines of all slots of the last two scenes have come, or the
        next pose error. A line that was lost is not in the scene. If the newest pose error is too
        old, the age is infinite.

        Args:
            now_ns: as in ``latest``.
            stale_cycles: number of cycle times since its pose error after which a scene is stale.

        Raises:
            ValueError: the DBC has no message of the pose error.
        """
        check = self._decoder.pose_check
        if check is None:
            raise ValueError(
                "the DBC has no message of the pose error (MapLinePose), so there are no scenes; "
                "take maplines.dbc or maplines-pose.dbc"
            )
        state = check.elapse(now_ns)
        received = self._decoder.scene()
        if received is None:
            return SceneView(None, math.inf, True, state, check.status)
        waited_ns = now_ns - received.t_ns
        stale = abs(waited_ns) > stale_cycles * check.cycle_ns
        age = math.inf if self._decoder.pose_is_too_old else received.age + waited_ns / 1e9
        return SceneView(received.scene, age, stale, state, check.status, received)

    def pose_error(self, now_ns: int) -> SlotStats | None:
        """Return the E2E statistics of the pose error; None if none was received."""
        check = self._decoder.pose_check
        if check is None:
            return None
        check.elapse(now_ns)
        stats = check.stats()
        return None if stats.status is None else stats

    def latest(self, slot: Slot, now_ns: int, *, stale_cycles: float = STALE_CYCLES) -> SlotView:
        """Return the newest line of a slot with its state.

        A line that is late by 240 to 255 records looks newer and is returned as such (see
        ``SequenceCheck``). These are 12 s of single lines, or 1.5 s of lines of 8 components.

        Args:
            slot: which line.
            now_ns: current time on the clock of the frames' time stamps [ns]. If this clock is
                set back, all lines are stale.
            stale_cycles: number of cycle times without a newer line after which a line is
                stale; see ``Codec.decoder`` for the cycle time.

        Raises:
            ValueError: the DBC has no such slot, or ``now_ns`` is not a whole number.
        """
        check = self._decoder.checks.get(slot)
        if check is None:
            names = ", ".join(known.name for known in self._decoder.checks)
            raise ValueError(f"slot must be one of the DBC's, {names}, got {slot!r}")
        if now_ns != now_ns // 1:
            raise ValueError(f"now_ns must be whole [ns], got {now_ns!r}")
        state = check.elapse(now_ns)
        line = self._lines.get(slot)
        age, stale = float("inf"), True
        if line is not None and line.t_ns is not None:
            waited_ns = now_ns - line.t_ns
            age = line.age + waited_ns / 1e9
            stale = abs(waited_ns) > stale_cycles * check.cycle_ns
        return SlotView(Slot(slot), line, age, stale, state, check.status, check.two_senders)

    def slots(self, now_ns: int) -> dict[Slot, SlotStats]:
        """Return the E2E statistics of each slot on which anything was received."""
        for check in self._decoder.checks.values():
            check.elapse(now_ns)
        stats = {slot: check.stats() for slot, check in self._decoder.checks.items()}
        return {slot: known for slot, known in stats.items() if known.status is not None}
