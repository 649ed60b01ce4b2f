"""Decoder of received frames: frames in, map lines and scenes out, everything else counted."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from ...values.line import MapLine, Slot
from ..layout.message_layout import Layout
from ..layout.pose_layout import POSE, Owner
from ..protection.secoc import Verifier
from ..reasons import Reason
from .check import Check
from .scenes import ReceivedScene
from .sequence import SlotStats
from .settings import RecordSettings
from .times import limited_ns
from .views import STALE_CYCLES, SceneView, SlotView

#: Message of the error of a question about scenes if there are none.
NO_POSE = (
    "the DBC has no message of the pose error (MapLinePose), so there are no scenes; "
    "take maplines.dbc or maplines-pose.dbc"
)


class ReceivedFrame(NamedTuple):
    """A frame of the bus, as arguments of ``Decoder.feed``."""

    can_id: int
    data: bytes
    t_ns: int  #: time of reception [ns]
    is_extended: bool = False  #: the ID has 29 bits


class Decoder(ABC):
    """Decoder of the frames of a bus: the state of a receiver, and views of it.

    Every record passes the same stations, those of a slot and those of the pose error. Each may
    drop it, with a counted reason::

        frame          protection/secoc.py    with a key: MAC and freshness, before all others
          |            reassembly.py          all pages of one transfer, or none; time-outs
        record         records/packer.py      length, page numbers, transfer IDs, CRC
          |            records/*_format.py    values that no sender sends
          |            sequence.py            counter: duplicate, late or new; E2E status and state
        new record     mixtures.py            a line of all its components, or none
          |            scenes.py              lines of one pose error; records that wait for theirs
        lines, scene   views.py               may they be used: E2E state, age, second sender

    ``Codec.decoder`` makes one. At any time
    ``frames == line_frames + pose_frames + sum(counts.values()) + pending``.

    Each record is checked by its counter according to AUTOSAR E2E, and ``checks`` gives the state
    of each owner. Of good records, only duplicates and late ones are dropped. What to do with a
    line whose slot is not VALID is the consumer's decision; `latest` tells it. A step
    of more than ``max_delta_counter`` is a sequence break, but the record is new: how far a new one
    may be ahead follows from the time that has passed, see the table of ``SequenceCheck``.

    With a verifier the MAC is checked first, and a frame that is not authentic changes nothing:
    no line, no transfer, no check.

    Time is an argument. `latest` and `latest_scene` return the newest line of a slot and the newest
    scene at any time; a ``Receiver`` does the same on a bus. Several threads may use a decoder: one
    call waits for another.

    >>> from maplines_can import Codec, Slot, MapLine
    >>> codec = Codec.from_dbc()
    >>> decoder = codec.decoder()
    >>> line = MapLine.mean_only(Slot.ROUTE, [1.75, 0, 0, 0], age=0.02)
    >>> for frame in codec.encoder().encode(line):
    ...     _ = decoder.feed(frame.can_id, frame.data, t_ns=0)
    >>> view = decoder.latest(Slot.ROUTE, now_ns=60_000_000)
    >>> view.state.name, round(view.age, 3), view.stale
    ('INIT', 0.084, False)
    >>> decoder.latest(Slot.ROUTE, now_ns=160_000_000).stale
    True
    """

    def __init__(
        self,
        layout: Layout,
        verifiers: Mapping[Owner, Verifier],
        settings: Mapping[Owner, RecordSettings],
    ) -> None:
        #: CAN IDs of all messages, for filters.
        self.can_ids = layout.can_ids
        #: Check whether frames are authentic, by owner; empty without authentication.
        self.verifiers = verifiers
        #: Whether lines are conditional on the pose error.
        self.is_conditional = layout.is_conditional
        self._slots = [owner for owner in settings if owner != POSE]

    def __reduce__(self) -> str:
        raise TypeError(
            "a Decoder cannot be pickled or copied, since it holds the state of a receiver; pickle "
            "the Codec, and make another with its decoder()"
        )

    @property
    @abstractmethod
    def checks(self) -> Mapping[Owner, Check]:
        """Checks of the records of each slot of the DBC, and of the pose error if it has that."""

    @property
    @abstractmethod
    def counts(self) -> Counter[Reason]:
        """Dropped frames by reason."""

    @property
    @abstractmethod
    def frames(self) -> int:
        """Frames received."""

    @property
    @abstractmethod
    def lines(self) -> int:
        """Lines delivered."""

    @property
    @abstractmethod
    def line_frames(self) -> int:
        """Frames of the lines delivered."""

    @property
    @abstractmethod
    def pose_errors(self) -> int:
        """Pose errors received."""

    @property
    @abstractmethod
    def pose_frames(self) -> int:
        """Frames of the pose errors received."""

    @property
    @abstractmethod
    def lost(self) -> int:
        """Records of lines missing between those received, by their counters."""

    @property
    @abstractmethod
    def pending(self) -> int:
        """Frames of transfers, mixtures and scenes that are not complete yet."""

    @abstractmethod
    def feed(
        self, can_id: int, data: bytes, t_ns: int, *, is_extended: bool = False
    ) -> Sequence[MapLine] | Reason:
        """Decode a frame; return the lines that it completes, or the reason why none.

        Args:
            can_id: its CAN ID.
            data: its payload.
            t_ns: time of reception, on any clock that runs steadily [ns]. Times are limited to
                +-4e18 ns.
            is_extended: the ID has 29 bits.

        Returns:
            One line, or several if a pose error completes those that waited for it; or the reason
            why there is none (PENDING: not yet). No frame raises.

        Raises:
            ValueError: ``t_ns`` is not a whole number.
        """

    @abstractmethod
    def feed_all(self, frames: Iterable[ReceivedFrame]) -> list[Sequence[MapLine] | Reason]:
        """Decode frames that have arrived, the first one first; return what ``feed`` does of each.

        Lines that are conditional on the same pose error are decoded together, which takes a
        fraction of the time. So a receiver that is late catches up.
        """

    @abstractmethod
    def expire(self, t_ns: int) -> None:
        """Drop the transfers, mixtures and waiting lines that have timed out at ``t_ns`` [ns]."""

    @abstractmethod
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
            ValueError: the DBC has no such slot, ``now_ns`` is not a whole number, or
                ``stale_cycles`` is less than 0 or NaN.
        """

    @abstractmethod
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
            ValueError: the DBC has no message of the pose error; or as ``latest``.
        """

    @abstractmethod
    def scene(self) -> ReceivedScene | None:
        """Return the newest scene, see `latest_scene`; None before the first."""

    def slots(self, now_ns: int) -> dict[Slot, SlotStats]:
        """Return the E2E statistics of each slot on which anything was received."""
        stats = {slot: self._stats(slot, now_ns) for slot in self._slots}
        return {slot: known for slot, known in stats.items() if known is not None}

    def pose_error(self, now_ns: int) -> SlotStats | None:
        """Return the E2E statistics of the pose error; None if none was received."""
        return self._stats(POSE, now_ns) if POSE in self.checks else None

    def _check_slot(self, slot: Slot) -> None:
        if slot not in self._slots:
            names = ", ".join(known.name for known in self._slots)
            raise ValueError(f"slot must be one of the DBC's, {names}, got {slot!r}")

    @abstractmethod
    def _check_of(self, owner: Owner) -> Check:
        """Return the check of an owner of the DBC."""

    def _stats(self, owner: Owner, now_ns: int) -> SlotStats | None:
        check = self._check_of(owner)
        check.elapse(limited_ns(now_ns, "now_ns"))
        return None if check.status is None else check.stats()
