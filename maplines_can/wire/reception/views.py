"""Views of the newest line of a slot and of the newest scene, and whether they may be used."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from ...values.line import LeftOut, MapLine, Slot
from ...values.scene import Scene
from ..protection.e2e_state import E2EState, ProfileStatus

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
    #: of the messages that brought the line: of its slot or whole scene; if it is conditional on a
    #: message of the pose error, VALID only if that is, too
    state: E2EState
    status: ProfileStatus | None  #: of the last check of its slot or whole scene; None: none yet
    #: two senders were detected in the last 256 cycles, or are suspected, on these messages
    two_senders: bool
    #: the newest whole scene that names the slot has no line of it, for this reason
    left_out: LeftOut | None = None

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


class ReceivedScene(NamedTuple):
    """A scene as received."""

    scene: Scene
    #: of the pose error or of Scene, which with ``t_ns`` tells a scene from the one before
    counter: int
    t_ns: int  #: time of the first frame of the pose error [ns]
    age: float  #: from the pose to the sending of the pose error [s]; infinite if it is too old


class SceneView(NamedTuple):
    """The newest scene at the consumer's call."""

    scene: Scene | None  #: None before the first
    #: from the time of the pose to now [s]; infinite if too old, unknown, or without a scene
    age: float
    stale: bool  #: its pose error came some cycle times ago, or comes after now
    state: E2EState  #: of the pose error, or of Scene
    status: ProfileStatus | None  #: of their last check; None before the first
    received: ReceivedScene | None = None  #: with its time of reception, and its age then
    #: of each of its lines: of its slot, or of Scene or Scene2 that brought it
    slot_states: Mapping[Slot, E2EState] = MappingProxyType({})
    #: two senders were detected in the last 256 cycles, or are suspected, on the messages of the
    #: pose error or of a line
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


def check_stale_cycles(stale_cycles: float) -> None:
    """Check that a number of cycles is 0 or more; infinite is never.

    Raises:
        ValueError: it is less than 0, or NaN.
        TypeError: it is no number.
    """
    if math.isnan(stale_cycles) or stale_cycles < 0:
        raise ValueError(
            f"stale_cycles must be 0 or more, or infinite for never, got {stale_cycles!r}"
        )
