"""Monitor of the newest line of each slot, and of whether it may be used."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import NamedTuple

from ...values.line import MapLine, Slot
from ...values.scene import Scene
from ..protection.e2e_state import E2EState, ProfileStatus
from ..reasons import Reason
from .decoder import Decoder
from .scenes import ReceivedScene
from .sequence import SequenceCheck, SlotStats

#: A line is stale when nothing newer has come for this many cycle times: two consecutive lines
#: may be lost. At 20 Hz the last one is then 150 ms old. The E2E state follows at 275 ms.
STALE_CYCLES = 3.0
#: The time of the caller may be before a reception by this much [ns]: the clocks of CAN adapters
#: and of hosts that are synchronised (IEEE 802.1AS, NTP in a car) differ by less. By more, the
#: clock of the caller was set back, and no age is known.
CLOCK_JITTER_NS = 1_000_000


class SlotView(NamedTuple):
    """State of a slot at the consumer's call."""

    slot: Slot
    line: MapLine | None  #: the newest; None before the first
    #: from the time of the line's pose to now [s]; infinite if too old, unknown, or without a line
    age: float
    #: nothing newer came for some cycle times, there is no line, or it comes after now
    stale: bool
    #: of the slot; if the line is conditional on the pose error, VALID only if that is, too
    state: E2EState
    status: ProfileStatus | None  #: of the last check; None before the first
    #: two senders were detected in the last 256 cycles, or are suspected: on the slot or, if the
    #: line is conditional on the pose error, on that
    two_senders: bool

    @property
    def usable(self) -> bool:
        """Whether a controller may use the line.

        This is so if the E2E state is VALID, the line is not stale, the slot has one sender, the
        status of the line is not OUT_OF_RANGE, and its age is finite.

        The ``age`` of a usable line is at least 0, and at most the greatest age that the DBC can
        state plus ``stale_cycles`` cycle times: 240 ms + 150 ms with the project's DBC. It is not
        less than the true age, except for the time that the first frame of the line spent in the
        transmit queue of the interface and on the bus, and for ``CLOCK_JITTER_NS``. If the producer
        of the lines hangs, no line is therefore usable later than 390 ms after its pose, plus these
        times.
        """
        line = self.line
        vouched = line is not None and line.is_usable
        return vouched and self.state is E2EState.VALID and not self.stale and not self.two_senders


class SceneView(NamedTuple):
    """The newest scene at the consumer's call."""

    scene: Scene | None  #: None before the first
    #: from the time of the pose to now [s]; infinite if too old, unknown, or without a scene
    age: float
    stale: bool  #: its pose error came some cycle times ago, or comes after now
    state: E2EState  #: of the pose error
    status: ProfileStatus | None  #: of the last check of a pose error; None before the first
    received: ReceivedScene | None = None  #: with its time of reception, and its age then
    #: states of the slots of its lines
    slot_states: Mapping[Slot, E2EState] = MappingProxyType({})
    #: two senders were detected in the last 256 cycles, or are suspected, on the pose error or on
    #: the slot of a line
    two_senders: bool = False

    @property
    def usable(self) -> bool:
        """Whether a controller may use the scene.

        This is so if the E2E states of the pose error and of the slots of all its lines are VALID,
        none of them has two senders, the scene is not stale, and its age is finite. The age of a
        usable scene is bounded as that of a line, see ``SlotView.usable``.
        """
        states = {self.state, *self.slot_states.values()}
        vouched = math.isfinite(self.age) and states == {E2EState.VALID}
        return vouched and not self.stale and not self.two_senders


class Monitor:
    """Decoder that keeps the newest line of each slot; time is an argument.

    ``Receiver.latest`` uses one. It can also be used without a bus, as in a simulator.
    It is not thread-safe.

    >>> from maplines_can import Codec, Slot, MapLine
    >>> codec = Codec.from_dbc()
    >>> monitor = Monitor(codec.decoder())
    >>> encoder = codec.encoder()
    >>> for frame in encoder.encode(MapLine.mean_only(Slot.ROUTE, [1.75, 0, 0, 0], age=0.02)):
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
        received = self._decoder.scene()
        if received is None:
            return SceneView(None, math.inf, True, check.elapse(now_ns), check.status)
        slots = {line.slot: self._decoder.checks[line.slot] for line in received.scene.lines}
        waited, stale = _waited(received.t_ns, now_ns, stale_cycles * check.cycle_ns)
        return SceneView(
            received.scene,
            math.inf if self._decoder.pose_is_too_old else received.age + waited,
            stale,
            _state(check, now_ns, waited),
            check.status,
            received,
            {slot: _state(of_slot, now_ns, waited) for slot, of_slot in slots.items()},
            _two_senders((check, *slots.values()), now_ns),
        )

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
            now_ns: current time on the clock of the frames' time stamps [ns]. If it is before the
                reception of the line by more than ``CLOCK_JITTER_NS``, this clock was set back: the
                line is stale, and its age is infinite.
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
        checks = self._decoder.checks_of(Slot(slot))
        line = self._lines.get(slot)
        age, stale, waited = math.inf, True, 0.0
        if line is not None and line.t_ns is not None:
            waited, stale = _waited(line.t_ns, now_ns, stale_cycles * check.cycle_ns)
            age = line.age + waited
        states = [_state(one, now_ns, waited) for one in checks]
        state = next((one for one in states if one is not E2EState.VALID), E2EState.VALID)
        two_senders = _two_senders(checks, now_ns)
        return SlotView(Slot(slot), line, age, stale, state, check.status, two_senders)

    def slots(self, now_ns: int) -> dict[Slot, SlotStats]:
        """Return the E2E statistics of each slot on which anything was received."""
        for check in self._decoder.checks.values():
            check.elapse(now_ns)
        stats = {slot: check.stats() for slot, check in self._decoder.checks.items()}
        return {slot: known for slot, known in stats.items() if known.status is not None}


def _waited(t_ns: int, now_ns: int, longest_ns: float) -> tuple[float, bool]:
    """Return the time since a reception [s], infinite if unknown, and whether it is too long."""
    waited_ns = now_ns - t_ns
    if waited_ns < -CLOCK_JITTER_NS:
        return math.inf, True
    return max(waited_ns, 0) / 1e9, waited_ns > longest_ns


def _state(check: SequenceCheck, now_ns: int, waited: float) -> E2EState:
    """Return the state at ``now_ns`` [ns]; if this clock was set back, no cycles have passed."""
    return check.state if math.isinf(waited) else check.elapse(now_ns)


def _two_senders(checks: Iterable[SequenceCheck], now_ns: int) -> bool:
    return not all(check.has_one_sender(now_ns) for check in checks)
