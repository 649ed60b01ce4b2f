"""Cases of the test vectors of whole scenes: the pose error and its lines in one record."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping
from itertools import permutations

from ..values.line import Kind, Slot
from ..wire.layout.message_layout import Layout
from ..wire.layout.pose_layout import SCENE, SCENE2, Owner, SceneOwner
from ..wire.layout.record_signals import LINE, SLOT
from ..wire.layout.scene_layout import NoLine
from .c_build import Features
from .vector_cases import Cases
from .vector_sender import JOIN, KEY, MS, START_NS
from .vectors import Case

#: Records of random bits, of each message.
RANDOM_RECORDS = 12
#: Messages that are sent, with their counter and the cycle in which they come.
_OTHERS: tuple[tuple[str, str, list[tuple[SceneOwner, int, int]]], ...] = (
    ("lost-scene", "A Scene is lost.",
     [(SCENE2, 0, 0), (SCENE, 0, 0), (SCENE2, 1, 1), (SCENE2, 2, 2), (SCENE, 2, 2)]),
    ("lost-scene2", "A Scene2 is lost.",
     [(SCENE2, 0, 0), (SCENE, 0, 0), (SCENE, 1, 1), (SCENE2, 2, 2), (SCENE, 2, 2)]),
    ("doubled", "Frames come twice.",
     [(SCENE2, 0, 0), (SCENE2, 0, 0), (SCENE, 0, 0), (SCENE, 0, 0), (SCENE2, 0, 0)]),
    ("too-late", "Scene2 comes more than a cycle late.", [(SCENE, 0, 0), (SCENE2, 0, 2)]),
    ("too-early", "Scene2 comes more than a cycle early.", [(SCENE2, 0, 0), (SCENE, 0, 2)]),
    ("scene-restart", "Scene begins again, with a counter of before.",
     [(SCENE, 8, 0), (SCENE2, 0, 1), (SCENE, 0, 1), (SCENE, 8, 2), (SCENE2, 8, 2)]),
    ("scene2-restart", "Scene2 begins again, with a counter of before.",
     [(SCENE2, 100, 0), (SCENE, 0, 0), (SCENE2, 0, 1), (SCENE, 1, 1)]),
)  # fmt: skip


class SceneCases(Cases):
    """Cases of a DBC with records of whole scenes."""

    def __init__(self, layout: Layout, features: Features) -> None:
        others: dict[Owner, str] = {SCENE2: "scene2"} if SCENE2 in layout.messages_of else {}
        super().__init__(layout, features, others)
        self.owners: list[SceneOwner] = [SCENE, SCENE2] if others else [SCENE]

    def of_line(self, raw: Mapping[str, int]) -> dict[str, int]:
        """Return raw values of the first line by their names in its record."""
        return {f"{LINE}1{name}": value for name, value in raw.items()}

    def send_cycle(
        self, case: Case, counter: int, cycle: int, raw: Mapping[str, int] | None = None
    ) -> None:
        """Send the first line in a cycle."""
        self.sender.send(case, self.owner, counter, START_NS + cycle * self.cycle + MS, raw)

    # ---- values ---------------------------------------------------------------------------

    def values(self) -> Iterator[Case]:
        """Yield cases of one record each: all ends of all signals, and random bits."""
        for slot in self.sender.slots:
            owner, raw = self._alone(slot)
            yield self._one(f"slot-{slot.name}", f"A line of the slot {slot.name}.", raw, owner)
        for name, signal in self.sender.signals(self.owner).items():
            if self._has_ends(name):
                for end, value in zip(("least", "greatest"), signal.all_raw, strict=True):
                    about = f"The {end} value of {name}."
                    raw = {**self._alone(self.slot)[1], name: value}
                    yield self._one(f"{name}-{end}", about, raw)
        for kind in (*Kind, *NoLine):
            about = f"The first line has the kind {kind.name}."
            yield self._one(f"kind-{kind.name}", about, self.sender.line_at(0, self.slot, kind))
        rng = random.Random(1)  # noqa: S311 - the same ones each time
        for owner in self.owners:
            for i in range(RANDOM_RECORDS):
                raw = self.sender.random_scene(owner, rng)
                yield self._one(f"random-{owner}-{i}", "A record of random bits.", raw, owner)

    def _has_ends(self, name: str) -> bool:
        """Return whether both ends of a signal are tried: of the record, or of its first line."""
        if not name.startswith(LINE):
            return name not in ("Crc", "Counter", JOIN)
        return name.startswith(f"{LINE}1") and not name.endswith(("Kind", "XMin", "XMax", SLOT))

    def _alone(self, slot: Slot) -> tuple[SceneOwner, dict[str, int]]:
        """Return raw values of a record whose only line is that of a slot, and its message."""
        owner = next((owner for owner in self.owners if slot in self.sender.fixed(owner)), SCENE)
        fixed = self.sender.fixed(owner)
        wanted = fixed.index(slot) if slot in fixed else fixed.index(None)
        raw: dict[str, int] = {}
        for place, own in enumerate(fixed):
            raw |= self.sender.line_at(place, own, NoLine.NONE)
        return owner, raw | self.sender.line_at(wanted, slot)

    def _one(
        self, name: str, about: str, raw: Mapping[str, int], owner: SceneOwner = SCENE
    ) -> Case:
        """Return the case of one record, with the scene that it is."""
        case = self._case(f"value-{name}", about, detailed=True)
        self.sender.send(case, owner, 0, START_NS, raw)
        if owner == SCENE:
            case.scene(START_NS + MS)
        return case

    # ---- reception ------------------------------------------------------------------------

    def damaged(self) -> Iterator[Case]:
        """Yield nothing: the checksum is all that can be wrong in a frame of the right length."""
        yield from ()

    def refused(self) -> Iterator[Case]:
        """Yield records of values that no sender sends, and lines that are left out."""
        case = self._case("content", "Records of values that no sender sends.")
        low, high = f"{LINE}1XMin", f"{LINE}1XMax"
        join = self.sender.signals(SCENE)[JOIN]
        steep = {f"{LINE}1{name}": self.layout[name].raw_max for name in ("Beta", "C0", "C1")}
        wrong: list[dict[str, int]] = [
            {low: self.layout["XMin"].raw_max, high: self.layout["XMax"].raw_min},
            {**steep, low: self.layout["XMin"].raw_min, high: self.layout["XMax"].raw_max},
        ]
        kinds = range(max(NoLine) + 1, self.layout["Kind"].raw_max + 1)
        wrong += [{f"{LINE}1Kind": kind} for kind in kinds]
        fixed = self.sender.fixed(SCENE)
        free = [place for place, slot in enumerate(fixed) if slot is None]
        if free:  # the slot of another place, or of a line that is left out
            wrong.append(self.sender.line_at(free[0], fixed[0] or self.slot))
            wrong.append(self.sender.line_at(free[0], fixed[0] or self.slot, NoLine.LEFT_OUT_MEAN))
        for i, raw in enumerate(wrong):
            self.sender.send(case, SCENE, i, START_NS + i * self.cycle, raw)
        for i, owner in enumerate(self.owners):  # of Scene2 any value is right
            raw = {JOIN: join.raw_max}
            self.sender.send(case, owner, len(wrong), START_NS + (len(wrong) + i) * MS, raw)
            case.stats(owner, START_NS + len(wrong) * self.cycle)
        case.counts()
        yield case
        case = self._case("left-out", "A line is left out for each reason, then comes again.")
        for i, kind in enumerate([*NoLine, Kind.SOLID]):
            raw = self.sender.line_at(0, self.slot, kind)
            self.sender.send(case, SCENE, i, START_NS + i * self.cycle, raw)
            case.view(self.slot, START_NS + i * self.cycle + 10 * MS)
            case.scene(START_NS + i * self.cycle + 10 * MS)
        case.counts()
        yield case

    # ---- scenes ---------------------------------------------------------------------------

    def scenes(self) -> Iterator[Case]:
        """Yield scenes of one and two messages, in any order, with what does not belong to them."""
        yield self._cycles("whole-scene", "Scene in each cycle.", (SCENE,))
        if SCENE2 in self.owners:
            both = (SCENE2, SCENE)
            yield self._cycles("whole-scenes", "Scene2 and Scene in each cycle.", both)
            yield from self._orders()
            yield from self._others()
        if self.layout.secured is not None and self.features.secoc:
            yield from self._silences()

    def _cycles(self, name: str, about: str, owners: tuple[SceneOwner, ...]) -> Case:
        """Return nine cycles, after which the scene is usable, and then silence."""
        case = self._case(name, about)
        case.scene(START_NS)
        for cycle in range(9):
            for i, owner in enumerate(owners):
                self._send(case, owner, cycle, cycle, i)
            if cycle > 6:  # from here on it is usable
                case.scene(START_NS + cycle * self.cycle + 10 * MS)
        self._ask(case, 12)
        return case

    def _orders(self) -> Iterator[Case]:
        """Yield the four frames of two cycles in each order."""
        frames = [(owner, counter) for counter in (0, 1) for owner in reversed(self.owners)]
        for order in permutations(range(len(frames))):
            name = "".join(map(str, order))
            case = self._case(f"join-{name}", "Scene2 and Scene of two cycles, in an order.")
            for i, number in enumerate(order):
                owner, counter = frames[number]
                self._send(case, owner, counter, 0, i)
                case.scene(START_NS + i * MS)
            yield case

    def _others(self) -> Iterator[Case]:
        """Yield messages of which some are lost, come twice, or do not belong together."""
        for name, about, steps in _OTHERS:
            case = self._case(f"join-{name}", about)
            for i, (owner, counter, cycle) in enumerate(steps):
                self._send(case, owner, counter, cycle, i)
                case.scene(START_NS + cycle * self.cycle + i * MS)
            self._ask(case, 4)
            yield case
        yield from self._unlike()

    def _unlike(self) -> Iterator[Case]:
        """Yield a Scene2 that has another pose error, the age excepted, or lines of Scene."""
        for name, signal in self.sender.signals(SCENE).items():
            if name.startswith(LINE) or name in ("Crc", "Counter", JOIN):
                continue
            case = self._case(f"join-other-{name}", f"Scene2 has another {name} than Scene.")
            other = signal.raw_min if name == "Age" else self.sender.ordinary(SCENE2)[name] ^ 1
            self._send(case, SCENE2, 0, 0, 0, {name: other})
            self._send(case, SCENE, 0, 0, 1)
            case.scene(START_NS + 2 * MS)
            yield case
        every = [self.sender.fixed(owner) for owner in self.owners]
        free = [fixed.index(None) for fixed in every if None in fixed]
        if len(free) == len(self.owners):
            case = self._case("join-same-slot", "Both messages have a line of the same slot.")
            slot = next(slot for slot in self.sender.slots if not self._is_fixed(slot))
            for i, owner in enumerate(reversed(self.owners)):
                side = f"{LINE}{free[i] + 1}Kind"
                raw = self.sender.line_at(free[i], slot) | {side: Kind(1 + i)}
                self._send(case, owner, 0, 0, i, raw)
                case.view(slot, START_NS + (i + 1) * MS)
            case.scene(START_NS + 2 * MS)
            yield case

    def _is_fixed(self, slot: Slot) -> bool:
        return any(slot in self.sender.fixed(owner) for owner in self.owners)

    def _silences(self) -> Iterator[Case]:
        """Yield authenticated scenes after silences, also of more than Freshness can count."""
        secured = self.layout.secured
        span_ns = 1000 * 256**secured.freshness_bytes if secured else 0
        about = "Authentic scenes after silences of any length."
        case = self._case("secoc-silences", about, key=KEY)
        t_ns = START_NS
        frames = []
        for i, silence in enumerate((0, self.cycle, span_ns - 1000, span_ns, 3 * span_ns + 7000)):
            t_ns += silence
            (frame,) = self._secured(i, t_ns)
            case.frame(frame.can_id, frame.data, t_ns, is_extended=frame.is_extended)
            frames.append(frame)
        for frame in frames:  # recordings, some of which have the same low bytes
            case.frame(frame.can_id, frame.data, t_ns + MS, is_extended=frame.is_extended)
        case.stats(SCENE, t_ns)
        case.counts()
        yield case
        case = self._case("secoc-restart", "A receiver that starts, and recordings.", key=KEY)
        for late in (3 * span_ns, span_ns, 2000 * MS, 0):
            (frame,) = self._secured(0, START_NS)
            t_ns = START_NS + late
            case.frame(frame.can_id, frame.data, t_ns, is_extended=frame.is_extended)
        case.counts()
        yield case

    # ---- common ---------------------------------------------------------------------------

    def _send(
        self,
        case: Case,
        owner: SceneOwner,
        counter: int,
        cycle: int,
        i: int,
        raw: Mapping[str, int] | None = None,
    ) -> None:
        """Send a message of a cycle with its first line, i milliseconds after its beginning."""
        raw = {**self._alone(self._first(owner))[1], **(raw or {})}
        self.sender.send(case, owner, counter, START_NS + cycle * self.cycle + i * MS, raw)

    def _first(self, owner: SceneOwner) -> Slot:
        """Return the slot of the first place of a message, or a slot for it."""
        fixed = self.sender.fixed(owner)[0]
        return self.slot if fixed is None else fixed

    def _ask(self, case: Case, cycle: int) -> None:
        """Ask for what was received, some cycles later."""
        t_ns = START_NS + cycle * self.cycle
        case.scene(t_ns)
        case.view(self.slot, t_ns)
        for owner in self.owners:
            case.stats(owner, t_ns)
        case.counts()
