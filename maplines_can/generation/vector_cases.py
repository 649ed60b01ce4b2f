"""Cases of the test vectors of a DBC: each value, each reason, each state."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping

from ..values.line import Kind, Slot, Status
from ..wire.layout.message_layout import Layout
from ..wire.layout.pose_layout import POSE, Owner
from ..wire.layout.record_layout import bits_of
from ..wire.layout.signals import PAGE, PAGE_BYTES, PARAMETER_SIGNALS, slot_title
from ..wire.records.frames import Frame
from .c_build import ALL, Features
from .vector_sender import KEY, MS, START_NS, VectorSender
from .vectors import Case, VectorKey

#: Records of random bits.
RANDOM_RECORDS = 24


def cases_of(layout: Layout, features: Features = ALL) -> list[Case]:
    """Return the cases of a DBC for a receiver with these features, always the same ones.

    Raises:
        MissingExtraError: the DBC has authenticated messages, and cryptography is not installed.
    """
    cases = _Cases(layout, features)
    found = [*cases.values(), *cases.reception(), *cases.states()]
    if layout.pose is not None and features.scenes:
        found += cases.scenes()
    if layout.secured is not None and features.secoc:
        found += cases.authentication()
    return found


class _Cases:
    """Makers of cases, which share the ordinary messages of a DBC."""

    def __init__(self, layout: Layout, features: Features) -> None:
        self.layout, self.sender = layout, VectorSender(layout, features.slots)
        self.has_mixtures = features.mixtures
        self.slot = self.sender.slots[0]
        self.messages = layout.messages[self.slot]
        has_pose = layout.pose is not None and features.scenes
        #: Owners whose records are damaged.
        self.owners: list[Owner] = [self.slot, POSE] if has_pose else [self.slot]
        self.is_conditional = layout.is_conditional
        #: One frame a record is enough where the frames do not matter.
        self.is_fd = None if self.messages.fd_can_id is None else True
        self.transfer_ids = 2 ** layout["TransferId0"].length
        self.counters = 2 ** layout["Counter"].length
        self.cycle = (self.messages.cycle_ms or 100) * MS

    # ---- values ---------------------------------------------------------------------------

    def values(self) -> Iterator[Case]:
        """Yield cases of one line each: all ends of all signals, and random bits."""
        for slot in self.sender.slots:
            yield self._one(f"slot-{slot.name}", f"A line of the slot {slot.name}.", {}, slot=slot)
        if self.messages.can_id is not None and self.messages.fd_can_id is not None:
            yield self._one("fd", "A line in one CAN FD frame.", {}, fd=True)
        for name in self._signals_with_ends():
            signal = self.layout[name]
            for end, value in zip(("least", "greatest"), signal.all_raw, strict=True):
                full = {"HasCovariance": 1} if self._is_of_covariance(name) else {}
                about = f"The {end} value of {name}."
                yield self._one(f"{name}-{end}", about, {**full, name: value})
        for kind in Kind:
            yield self._one(f"kind-{kind.name}", f"The kind {kind.name}.", {"Kind": kind})
        if not self.is_conditional:
            for status in Status:
                about = f"The status {status.name}."
                yield self._one(f"status-{status.name}", about, {"Status": status})
            if self.has_mixtures:
                yield from self._mixtures()
        rng = random.Random(1)  # noqa: S311 - the same ones each time
        for i in range(RANDOM_RECORDS):
            raw = self.sender.random_raw(self.slot, rng, is_ordinary=self.is_conditional)
            pose = self.sender.random_raw(POSE, rng) if self.is_conditional else None
            yield self._one(f"random-{i}", "A record of random bits.", raw, pose)

    def _signals_with_ends(self) -> list[str]:
        """Return the signals of a line of which both ends are tried."""
        others = ("Component", "Kind", "Status", "HasCovariance", "XMin", "XMax")
        return [name for name in self.sender.ordinary(self.slot) if not name.startswith(others)]

    def _is_of_covariance(self, name: str) -> bool:
        endings = ("Fine", "Inflation")
        return self.is_conditional and (
            name.startswith(("Pivot", "Ratio")) or name.endswith(endings)
        )

    def _one(
        self,
        name: str,
        about: str,
        raw: Mapping[str, int],
        pose: Mapping[str, int] | None = None,
        *,
        slot: Slot | None = None,
        fd: bool | None = None,
    ) -> Case:
        """Return the case of one line; if it is conditional on a pose error, with that."""
        slot = self.slot if slot is None else slot
        case = self._case(f"value-{name}", about, detailed=True)
        if raw.get("HasCovariance"):
            raw = {"OwnLateral": 0, "OwnPoints": 0, "OwnShape": 0, **raw}
        if self.is_conditional:
            counters = {f"{slot_title(slot)}Counter": 0}
            self.sender.send(case, POSE, 0, START_NS, {**(pose or {}), **counters}, fd=fd)
        self.sender.send(case, slot, 0, START_NS + MS, raw, fd=fd)
        return case

    def _mixtures(self) -> Iterator[Case]:
        """Yield mixtures of two and of the most components."""
        count, weight = self.layout["ComponentCount"], self.layout["ComponentWeight"]
        shares, side = 2**weight.length, self.layout["YOff"]
        for n in sorted({2, 2**count.length}):
            case = self._case(f"value-mixture-{n}", f"A line of {n} components.", detailed=True)
            sizes = [shares // n] * (n - 1)
            for i, size in enumerate([*sizes, shares - sum(sizes)]):
                raw = {
                    "ComponentCount": n - 1,
                    "ComponentIndex": i,
                    "ComponentWeight": size - 1,
                    "YOff": int(side.limited(side.raw(0.5 * i))),
                    "Status": Status.SATURATED if i == 1 else Status.FULL,
                }
                self.sender.send(case, self.slot, i, START_NS + i * MS, raw)
            case.counts()
            yield case

    # ---- reception ------------------------------------------------------------------------

    def reception(self) -> Iterator[Case]:
        """Yield cases of one reason each."""
        yield from self._foreign_and_damaged()
        if self.messages.can_id is not None:
            yield from self._transfers()
        yield self._late()
        if self.is_conditional:
            yield self._without_pose()
        yield self._not_valid()

    def _foreign_and_damaged(self) -> Iterator[Case]:
        """Yield frames that belong to no record, and records that are damaged."""
        first, *_ = self._frames(self.slot, 0)
        case = self._case("foreign", "A CAN ID of no line, and one of a line with another length.")
        known = self.layout.can_ids
        foreign = next(can_id for can_id in range(0x7FF) if can_id not in known)
        case.frame(foreign, first.data, START_NS)
        case.frame(first.can_id, first.data, START_NS, is_extended=not first.is_extended)
        case.counts()
        yield case
        case = self._case("length", "Payloads that are too short, and an empty one.")
        for length in (len(first.data) - 1, 0):
            case.frame(first.can_id, first.data[:length], START_NS, is_extended=first.is_extended)
        case.stats(self.slot, START_NS)
        case.counts()
        yield case
        for owner in self.owners:
            title = "line" if owner == self.slot else "pose"
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
        yield from self._mixed()
        yield from self._strange_pages()

    def _mixed(self) -> Iterator[Case]:
        """Yield a record in one frame whose pages have different transfer IDs."""
        if self.messages.fd_can_id is None or self.layout.pages < 2:
            return
        case = self._case("mixed", "The pages of a record belong to different transfers.")
        frame, *_ = self._frames(self.slot, 0, fd=True)
        data = bytearray(frame.data)
        bit = min(bits_of(self.layout["TransferId1"]))
        data[bit // 8] ^= 1 << bit % 8
        case.frame(frame.can_id, bytes(data), START_NS, is_extended=frame.is_extended)
        case.stats(self.slot, START_NS)
        case.counts()
        yield case

    def _strange_pages(self) -> Iterator[Case]:
        """Yield pages whose number is not in the DBC."""
        for owner in self.owners:
            layout = self.sender.of(owner)
            page = layout[f"{PAGE}0"]
            has_pages = self.layout.messages_of[owner].can_id is not None
            if layout.pages == 2**page.length or not has_pages:
                continue
            title = "line" if owner == self.slot else "pose"
            case = self._case(f"page-{title}", "A page number is not in the DBC.")
            first, *_ = self._frames(owner, 0)
            data = bytearray(first.data)
            for bit in bits_of(page):
                data[bit // 8] |= 1 << bit % 8
            case.frame(first.can_id, bytes(data), START_NS, is_extended=first.is_extended)
            case.stats(owner, START_NS)
            case.counts()
            yield case

    def _transfers(self) -> Iterator[Case]:
        """Yield transfers whose pages are lost, swapped, repeated or of another one."""
        if len(self._frames(self.slot, 0)) < 2:
            return
        case = self._case("swapped-pages", "The pages of a record in the reverse order.")
        for i, frame in enumerate(reversed(self._frames(self.slot, 0))):
            case.frame(frame.can_id, frame.data, START_NS + i, is_extended=frame.is_extended)
        case.counts()
        yield case
        case = self._case("duplicate", "Each page twice; then the record once more.")
        for frame in (*self._frames(self.slot, 0) * 2,):
            for _ in range(2):
                case.frame(frame.can_id, frame.data, START_NS, is_extended=frame.is_extended)
        case.stats(self.slot, START_NS)
        case.counts()
        yield case
        case = self._case("timeout", "A page is lost; then time passes.")
        for frame in self._frames(self.slot, 0)[1:]:
            case.frame(frame.can_id, frame.data, START_NS, is_extended=frame.is_extended)
        case.counts()
        case.expire(START_NS + 10 * self.cycle)
        case.counts()
        yield case
        case = self._case("incomplete", "A page of a record that a later record overtakes.")
        first, *_ = self._frames(self.slot, 0)
        case.frame(first.can_id, first.data, START_NS, is_extended=first.is_extended)
        self.sender.send(case, self.slot, self.transfer_ids // 2, START_NS + MS)
        case.counts()
        yield case
        if self.counters > self.transfer_ids:
            yield self._replaced()

    def _replaced(self) -> Case:
        """Return a transfer of which the next one with the same ID takes the place."""
        case = self._case("replaced", "Pages of two records with the same transfer ID.")
        page = min(bits_of(self.layout["Counter"])) // (8 * PAGE_BYTES)
        for i, counter in enumerate((0, self.transfer_ids, 0)):
            frame = self._frames(self.slot, counter)[page]
            case.frame(frame.can_id, frame.data, START_NS + i, is_extended=frame.is_extended)
        case.counts()
        return case

    def _late(self) -> Case:
        """Return records that come after newer ones."""
        case = self._case("late", "Records come late: lost ones, and one with another content.")
        for i, counter in enumerate((0, 1, 4, 2, 5)):
            self._cycle(case, counter, i)
        self.sender.send(case, self.slot, 1, START_NS + 5 * self.cycle, {"Kind": Kind.KERB})
        case.stats(self.slot, START_NS + 5 * self.cycle)
        case.counts()
        return case

    def _without_pose(self) -> Case:
        case = self._case("no-pose", "A line whose pose error does not come.")
        self.sender.send(case, self.slot, 0, START_NS)
        case.counts()
        case.expire(START_NS + 20 * self.cycle)
        case.counts()
        return case

    def _not_valid(self) -> Case:
        """Return records with values that no sender sends."""
        case = self._case("content", "Records of values that no sender sends.")
        if self.is_conditional:
            x_min, x_max = self.layout["XMin"], self.layout["XMax"]
            wrong = [
                {"XMin": x_min.raw_max, "XMax": x_max.raw_min},
                {"HasCovariance": 1, "OwnLateral": 1},
            ]
        else:
            wrong = [{"Status": 7}, {"Status": 6}, {"ComponentIndex": 1}]
            low, high = self.layout["XMin"], self.layout["XMax"]
            if low.physical_one(low.raw_max) > high.physical_one(high.raw_min):
                wrong.append({"XMin": low.raw_max, "XMax": high.raw_min})
        for i, raw in enumerate(wrong):
            self.sender.send(case, self.slot, i, START_NS + i * self.cycle, raw)
        case.stats(self.slot, START_NS + len(wrong) * self.cycle)
        case.counts()
        return case

    # ---- states ---------------------------------------------------------------------------

    def states(self) -> Iterator[Case]:
        """Yield cases of the E2E states, and of whether a line may be used."""
        case = self._case("states", "NODATA, INIT, VALID; silence; INVALID; VALID again.")
        case.view(self.slot, START_NS)
        for i in range(9):
            self._cycle(case, i, i)
            case.view(self.slot, START_NS + i * self.cycle + 10 * MS)
        for i in (9, 10, 11, 12, 14, 18):
            case.view(self.slot, START_NS + i * self.cycle)
        for i in range(20, 30):
            self._cycle(case, i - 11, i)
            case.view(self.slot, START_NS + i * self.cycle + 10 * MS)
        self._end(case, 30)
        yield case
        yield self._lost_records()
        yield self._errors()
        yield self._restart()
        yield self._two_senders()
        yield self._clock()
        if not self.is_conditional:
            yield self._too_old()

    def _lost_records(self) -> Case:
        """Return records of which some are lost: few, and too many."""
        case = self._case("lost", "Records are lost: OKSOMELOST, then WRONGSEQUENCE.")
        counter = 0
        for i, ahead in enumerate((1, 1, 1, 1, 1, 1, 1, 3, 1, 2, 1, 1)):
            counter += ahead
            self._cycle(case, counter, i)
            case.view(self.slot, START_NS + i * self.cycle + 10 * MS)
        self._cycle(case, counter + self.counters // 4 + 1, 12 + self.counters // 4)
        self._end(case, 13 + self.counters // 4)
        return case

    def _errors(self) -> Case:
        """Return damaged records among good ones, until the state is INVALID."""
        case = self._case("errors", "Damaged records: the state becomes INVALID.")
        for i in range(14):
            if i not in (9, 10, 12):
                self._cycle(case, i, i)
                continue
            frames = self._frames(self.slot, i, START_NS + i * self.cycle, fd=self.is_fd)
            for j, frame in enumerate(frames):
                data = bytearray(frame.data)
                data[self.layout.crc_offset % len(data)] ^= j == 0
                t_ns = START_NS + i * self.cycle + j
                case.frame(frame.can_id, bytes(data), t_ns, is_extended=frame.is_extended)
            case.view(self.slot, START_NS + i * self.cycle + 10 * MS)
        self._end(case, 14)
        return case

    def _restart(self) -> Case:
        case = self._case("restart", "The sender restarts, with other lines.")
        for i in range(10):
            self._cycle(case, i, i)
        for i in range(10):
            self._cycle(case, i, i + 10, {"Kind": Kind.KERB})
            case.view(self.slot, START_NS + (i + 10) * self.cycle + 10 * MS)
        self._end(case, 20)
        return case

    def _two_senders(self) -> Case:
        case = self._case("two-senders", "A second sender with other counters.")
        for i in range(12):
            self._cycle(case, i, i)
            if i >= 8:
                t_ns = START_NS + i * self.cycle + 20 * MS
                self.sender.send(case, self.slot, i + self.counters // 2, t_ns)
            case.view(self.slot, START_NS + i * self.cycle + 30 * MS)
        self._end(case, 12)
        return case

    def _clock(self) -> Case:
        case = self._case("clock", "The clock of the receiver is set back, and far ahead.")
        for i in range(9):
            self._cycle(case, i, i)
        for t_ns in (START_NS + 8 * self.cycle - MS, START_NS, START_NS + 3600_000 * MS):
            case.view(self.slot, t_ns)
        self._cycle(case, 9, -1000)
        case.view(self.slot, START_NS - 1000 * self.cycle + 10 * MS)
        self._end(case, -999)
        return case

    def _too_old(self) -> Case:
        case = self._case("too-old", "The sender states that its lines are too old.")
        for i in range(9):
            self._cycle(case, i, i, {"Age": self.layout["Age"].raw_max})
        case.view(self.slot, START_NS + 8 * self.cycle + 10 * MS)
        self._end(case, 9)
        return case

    # ---- scenes ---------------------------------------------------------------------------

    def scenes(self) -> Iterator[Case]:
        """Yield scenes of one to all lines, and poses that come late or not at all."""
        slots = self.sender.slots
        for count in sorted({1, min(2, len(slots)), min(3, len(slots))}):
            case = self._case(f"scene-{count}", f"Scenes of {count} lines.", owner=POSE)
            case.scene(START_NS)
            for cycle in range(9):
                self._scene(case, cycle, slots[:count])
            self._scene_end(case, 8)
            yield case
        rng = random.Random(2)  # noqa: S311
        for i in range(6):
            case = self._case(f"scene-random-{i}", "A scene of random bits.", owner=POSE)
            raw = {slot: self.sender.random_raw(slot, rng, is_ordinary=True) for slot in slots[:2]}
            self._scene(case, 0, slots[:2], self.sender.random_raw(POSE, rng), raw)
            self._scene_end(case, 0)
            yield case
        case = self._case("scene-lost-pose", "A pose error of nine is lost.", owner=POSE)
        for cycle in range(9):
            self._scene(case, cycle, slots[:2], has_pose=cycle != 4)
        self._scene_end(case, 8)
        yield case
        case = self._case(
            "scene-too-old", "The sender states that its pose is too old.", owner=POSE
        )
        for cycle in range(9):
            self._scene(case, cycle, slots[:1], {"Age": self.sender.of(POSE)["Age"].raw_max})
        self._scene_end(case, 8)
        yield case

    def _scene(
        self,
        case: Case,
        cycle: int,
        slots: list[Slot],
        pose: Mapping[str, int] | None = None,
        raw: Mapping[Slot, Mapping[str, int]] | None = None,
        *,
        has_pose: bool = True,
    ) -> None:
        """Send the pose error and the lines of a cycle."""
        t_ns = START_NS + cycle * self.cycle
        signals = self.sender.of(POSE).signals
        if has_pose:
            counters = {
                name: cycle % 2 ** signals[name].length
                for name in (f"{slot_title(slot)}Counter" for slot in self.sender.slots)
            }
            self.sender.send(case, POSE, cycle, t_ns, {**(pose or {}), **counters})
        for i, slot in enumerate(slots):
            shift = {"YOff": self._shifted(i)} if raw is None else raw[slot]
            self.sender.send(case, slot, cycle, t_ns + (i + 1) * 2 * MS, shift)

    def _shifted(self, i: int) -> int:
        """Return the raw lateral offset of line i of a scene."""
        side = self.layout[PARAMETER_SIGNALS[0]]
        return int(side.limited(side.raw(1.75 - 3.5 * i)))

    def _scene_end(self, case: Case, cycle: int) -> None:
        t_ns = START_NS + cycle * self.cycle
        case.scene(t_ns + 20 * MS)
        case.scene(t_ns + 4 * self.cycle)
        case.view(self.slot, t_ns + 4 * self.cycle)
        case.stats(POSE, t_ns + 4 * self.cycle)
        case.counts()

    # ---- authentication -------------------------------------------------------------------

    def authentication(self) -> Iterator[Case]:
        """Yield authenticated frames, and those that are not."""
        record = self.sender.record(self.slot, 0)
        (frame,) = self.sender.secured_frames(self.slot, record, START_NS)
        can_id, is_extended = frame.can_id, frame.is_extended

        def fed(
            name: str, about: str, *data: bytes, key: VectorKey | None = KEY, late: int = 0
        ) -> Case:
            case = self._case(f"secoc-{name}", about, key=key)
            for i, payload in enumerate(data):
                case.frame(can_id, payload, START_NS + late + i * MS, is_extended=is_extended)
            case.stats(self.slot, START_NS + late + 10 * MS)
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
            self.sender.send(case, self.slot, 0, START_NS)
            case.counts()
            yield case
        case = self._case("secoc-states", "Authentic lines until the state is VALID.", key=KEY)
        for i in range(9):
            t_ns = START_NS + i * self.cycle
            record = self.sender.record(self.slot, i)
            (one,) = self.sender.secured_frames(self.slot, record, t_ns)
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

    def _cycle(
        self, case: Case, counter: int, cycle: int, raw: Mapping[str, int] | None = None
    ) -> None:
        """Send the line of a cycle, with its pose error if it is conditional on that."""
        t_ns = START_NS + cycle * self.cycle
        if self.is_conditional:
            name = f"{slot_title(self.slot)}Counter"
            bits = self.sender.of(POSE)[name].length
            pose = {name: counter % 2**bits}
            self.sender.send(case, POSE, counter, t_ns, pose, fd=self.is_fd)
        self.sender.send(case, self.slot, counter, t_ns + MS, raw, fd=self.is_fd)

    def _end(self, case: Case, cycle: int) -> None:
        """Ask for what was counted."""
        case.stats(self.slot, START_NS + cycle * self.cycle)
        if self.is_conditional:
            case.stats(POSE, START_NS + cycle * self.cycle)
        case.counts()
