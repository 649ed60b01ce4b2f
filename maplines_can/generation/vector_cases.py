"""Cases of the test vectors that records of lines and of whole scenes share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping

from ..values.line import Kind
from ..wire.frames import Frame
from ..wire.layout.message_layout import Layout
from ..wire.layout.pose_layout import Owner
from .c_build import Features
from .vector_sender import KEY, MS, START_NS, VectorSender
from .vectors import Case, VectorKey

#: Greatest CAN ID of 11 bits.
MAX_BASE_ID = 0x7FF
#: Records of random bits.
RANDOM_RECORDS = 24


class Cases(ABC):
    """Makers of cases, which share the ordinary messages of a DBC.

    Args:
        layout: of the DBC.
        features: of the receiver.
        others: owners of records beside that of the first line, which are damaged, too.
    """

    def __init__(self, layout: Layout, features: Features, others: Mapping[Owner, str]) -> None:
        self.layout, self.features = layout, features
        self.sender = VectorSender(layout, features.slots)
        #: The first line, and the owner of its records.
        self.slot, self.owner = self.sender.slots[0], self.sender.first
        self.messages = layout.messages_of[self.owner]
        self.others = others
        #: One frame a record is enough where the frames do not matter.
        self.is_fd = None if self.messages.fd_can_id is None else True
        self.counters = 2 ** self.sender.signals(self.owner)["Counter"].length
        self.cycle = (self.messages.cycle_ms or 100) * MS

    def all(self) -> Iterator[Case]:
        """Yield all cases, always the same ones."""
        yield from self.values()
        yield from self.reception()
        yield from self.states()
        if self.layout.pose is not None and self.features.scenes:
            yield from self.scenes()
        if self.layout.secured is not None and self.features.secoc:
            yield from self.authentication()

    @abstractmethod
    def values(self) -> Iterator[Case]:
        """Yield cases of one record each: all ends of all signals, and random bits."""

    @abstractmethod
    def damaged(self) -> Iterator[Case]:
        """Yield records whose frames are damaged otherwise than in their checksum."""

    @abstractmethod
    def refused(self) -> Iterator[Case]:
        """Yield records that have what no sender sends."""

    @abstractmethod
    def scenes(self) -> Iterator[Case]:
        """Yield scenes of several records, also of such that do not belong together."""

    @abstractmethod
    def of_line(self, raw: Mapping[str, int]) -> dict[str, int]:
        """Return raw values of the first line by their names in its record."""

    @abstractmethod
    def send_cycle(
        self, case: Case, counter: int, cycle: int, raw: Mapping[str, int] | None = None
    ) -> None:
        """Send the first line in a cycle, with all that it needs; raw values are of its record."""

    # ---- reception ------------------------------------------------------------------------

    def reception(self) -> Iterator[Case]:
        """Yield cases of one reason each."""
        yield from self._foreign_and_damaged()
        yield from self.damaged()
        yield self._late()
        yield from self.refused()

    def _foreign_and_damaged(self) -> Iterator[Case]:
        """Yield frames that belong to no record, and records that are damaged."""
        first, *_ = self._frames(self.owner, 0)
        case = self._case("foreign", "A CAN ID of no line, and one of a line with another length.")
        known = self.layout.can_ids
        foreign = next(can_id for can_id in range(MAX_BASE_ID) if can_id not in known)
        case.frame(foreign, first.data, START_NS)
        if first.can_id <= MAX_BASE_ID:  # else there is no such frame
            case.frame(first.can_id, first.data, START_NS, is_extended=not first.is_extended)
        case.counts()
        yield case
        case = self._case("length", "Payloads that are too short, and an empty one.")
        for length in (len(first.data) - 1, 0):
            case.frame(first.can_id, first.data[:length], START_NS, is_extended=first.is_extended)
        case.stats(self.owner, START_NS)
        case.counts()
        yield case
        for owner, title in {self.owner: "line", **self.others}.items():
            case = self._case(f"crc-{title}", "A bit of a record is wrong.", owner=owner)
            frames = self._frames(owner, 0)
            data = bytearray(frames[-1].data)
            data[self.sender.of(owner).crc_offset if len(frames) == 1 else 0] ^= 1
            for i, frame in enumerate(frames):
                last = bytes(data) if i == len(frames) - 1 else frame.data
                case.frame(frame.can_id, last, START_NS + i, is_extended=frame.is_extended)
            case.stats(owner, START_NS + MS)
            case.counts()
            yield case

    def _late(self) -> Case:
        """Return records that come after newer ones."""
        case = self._case("late", "Records come late: lost ones, and one with another content.")
        for i, counter in enumerate((0, 1, 4, 2, 5)):
            self.send_cycle(case, counter, i)
        raw = self.of_line({"Kind": Kind.KERB})
        self.sender.send(case, self.owner, 1, START_NS + 5 * self.cycle, raw)
        case.stats(self.owner, START_NS + 5 * self.cycle)
        case.counts()
        return case

    # ---- states ---------------------------------------------------------------------------

    def states(self) -> Iterator[Case]:
        """Yield cases of the E2E states, and of whether a line may be used."""
        case = self._case("states", "NODATA, INIT, VALID; silence; INVALID; VALID again.")
        case.view(self.slot, START_NS)
        for i in range(9):
            self.send_cycle(case, i, i)
            case.view(self.slot, START_NS + i * self.cycle + 10 * MS)
        for i in (9, 10, 11, 12, 14, 18):
            case.view(self.slot, START_NS + i * self.cycle)
        for i in range(20, 30):
            self.send_cycle(case, i - 11, i)
            case.view(self.slot, START_NS + i * self.cycle + 10 * MS)
        self._end(case, 30)
        yield case
        yield self._lost_records()
        yield self._errors()
        yield self._restart()
        yield self._two_senders()
        yield self._clock()
        if "Age" in self.sender.signals(self.owner):
            yield self._too_old()

    def _lost_records(self) -> Case:
        """Return records of which some are lost: few, and too many."""
        case = self._case("lost", "Records are lost: OKSOMELOST, then WRONGSEQUENCE.")
        counter = 0
        for i, ahead in enumerate((1, 1, 1, 1, 1, 1, 1, 3, 1, 2, 1, 1)):
            counter += ahead
            self.send_cycle(case, counter, i)
            case.view(self.slot, START_NS + i * self.cycle + 10 * MS)
        self.send_cycle(case, counter + self.counters // 4 + 1, 12 + self.counters // 4)
        self._end(case, 13 + self.counters // 4)
        return case

    def _errors(self) -> Case:
        """Return damaged records among good ones, until the state is INVALID."""
        case = self._case("errors", "Damaged records: the state becomes INVALID.")
        for i in range(14):
            if i not in (9, 10, 12):
                self.send_cycle(case, i, i)
                continue
            frames = self._frames(self.owner, i, START_NS + i * self.cycle, fd=self.is_fd)
            for j, frame in enumerate(frames):
                data = bytearray(frame.data)
                data[self.sender.of(self.owner).crc_offset % len(data)] ^= j == 0
                t_ns = START_NS + i * self.cycle + j
                case.frame(frame.can_id, bytes(data), t_ns, is_extended=frame.is_extended)
            case.view(self.slot, START_NS + i * self.cycle + 10 * MS)
        self._end(case, 14)
        return case

    def _restart(self) -> Case:
        case = self._case("restart", "The sender restarts, with other lines.")
        for i in range(10):
            self.send_cycle(case, i, i)
        for i in range(10):
            self.send_cycle(case, i, i + 10, self.of_line({"Kind": Kind.KERB}))
            case.view(self.slot, START_NS + (i + 10) * self.cycle + 10 * MS)
        self._end(case, 20)
        return case

    def _two_senders(self) -> Case:
        case = self._case("two-senders", "A second sender with other counters.")
        for i in range(12):
            self.send_cycle(case, i, i)
            if i >= 8:
                t_ns = START_NS + i * self.cycle + 20 * MS
                self.sender.send(case, self.owner, i + self.counters // 2, t_ns)
            case.view(self.slot, START_NS + i * self.cycle + 30 * MS)
        self._end(case, 12)
        return case

    def _clock(self) -> Case:
        case = self._case("clock", "The clock of the receiver is set back, and far ahead.")
        for i in range(9):
            self.send_cycle(case, i, i)
        for t_ns in (START_NS + 8 * self.cycle - MS, START_NS, START_NS + 3600_000 * MS):
            case.view(self.slot, t_ns)
        self.send_cycle(case, 9, -1000)
        case.view(self.slot, START_NS - 1000 * self.cycle + 10 * MS)
        self._end(case, -999)
        return case

    def _too_old(self) -> Case:
        case = self._case("too-old", "The sender states that its lines are too old.")
        too_old = self.sender.signals(self.owner)["Age"].raw_max
        for i in range(9):
            self.send_cycle(case, i, i, {"Age": too_old})
        case.view(self.slot, START_NS + 8 * self.cycle + 10 * MS)
        self._end(case, 9)
        return case

    # ---- authentication -------------------------------------------------------------------

    def authentication(self) -> Iterator[Case]:
        """Yield authenticated frames, and those that are not."""
        (frame,) = self._secured(0, START_NS)
        can_id, is_extended = frame.can_id, frame.is_extended

        def fed(
            name: str, about: str, *data: bytes, key: VectorKey | None = KEY, late: int = 0
        ) -> Case:
            case = self._case(f"secoc-{name}", about, key=key)
            for i, payload in enumerate(data):
                case.frame(can_id, payload, START_NS + late + i * MS, is_extended=is_extended)
            case.stats(self.owner, START_NS + late + 10 * MS)
            case.counts()
            return case

        yield fed("accepted", "An authentic line.", frame.data)
        yield fed("replay", "An authentic line twice: the second is a replay.", *[frame.data] * 2)
        yield fed(
            "old", "An authentic line that is older than the window.", frame.data, late=2000 * MS
        )
        yield fed(
            "ahead", "Its freshness value is ahead of the clock.", frame.data, late=-2000 * MS
        )
        yield fed("length", "An authenticated frame that is too short.", frame.data[:-1])
        last = bytes([*frame.data[:-1], frame.data[-1] ^ 1])
        first = bytes([frame.data[0] ^ 1, *frame.data[1:]])
        yield fed("mac", "The MAC or the content is wrong.", last, first)
        other = VectorKey(KEY.secret, KEY.key_id + 1)
        yield fed("key", "The receiver does not have the key.", frame.data, key=other)
        if self.sender.key_of() is None:
            yield fed("no-key", "The receiver has no key.", frame.data, key=None)
            case = self._case("secoc-unauthenticated", "A line without a MAC.", key=KEY)
            self.sender.send(case, self.owner, 0, START_NS)
            case.counts()
            yield case
        case = self._case("secoc-states", "Authentic lines until the state is VALID.", key=KEY)
        for i in range(9):
            t_ns = START_NS + i * self.cycle
            (one,) = self._secured(i, t_ns)
            case.frame(one.can_id, one.data, t_ns, is_extended=one.is_extended)
            case.view(self.slot, t_ns + 10 * MS)
        self._end(case, 9)
        yield case

    # ---- common ---------------------------------------------------------------------------

    def _case(
        self,
        name: str,
        about: str,
        *,
        key: VectorKey | None = None,
        owner: Owner | None = None,
        detailed: bool = False,
    ) -> Case:
        return Case(
            self.layout, name, about, key=key or self.sender.key_of(owner), detailed=detailed
        )

    def _frames(
        self, owner: Owner, counter: int, t_ns: int = START_NS, *, fd: bool | None = None
    ) -> list[Frame]:
        return self.sender.frames(owner, self.sender.record(owner, counter), t_ns, fd=fd)

    def _secured(self, counter: int, t_ns: int) -> list[Frame]:
        record = self.sender.record(self.owner, counter, is_secured=True)
        return self.sender.secured_frames(self.owner, record, t_ns)

    def _end(self, case: Case, cycle: int) -> None:
        """Ask for what was counted."""
        case.stats(self.owner, START_NS + cycle * self.cycle)
        if self.layout.is_conditional:
            for owner in self.others:
                case.stats(owner, START_NS + cycle * self.cycle)
        case.counts()
