"""Cases of the test vectors of records of a line each, and of the pose error."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping

from ..values.line import Kind, Slot, Status
from ..wire.layout.message_layout import Layout
from ..wire.layout.pose_layout import POSE
from ..wire.layout.record_layout import bits_of
from ..wire.layout.record_signals import PAGE, PAGE_BYTES, PARAMETER_SIGNALS, slot_title
from .c_build import Features
from .vector_cases import Cases
from .vector_sender import MS, START_NS
from .vectors import Case

#: Records of random bits.
RANDOM_RECORDS = 24


class LineCases(Cases):
    """Cases of a DBC with records of a line each."""

    def __init__(self, layout: Layout, features: Features) -> None:
        has_pose = layout.pose is not None and features.scenes
        super().__init__(layout, features, {POSE: "pose"} if has_pose else {})

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
        if not self.layout.is_conditional:
            for status in Status:
                about = f"The status {status.name}."
                yield self._one(f"status-{status.name}", about, {"Status": status})
            if self.features.mixtures:
                yield from self._mixtures()
        rng = random.Random(1)  # noqa: S311 - the same ones each time
        for i in range(RANDOM_RECORDS):
            raw = self.sender.random_raw(self.slot, rng, is_ordinary=self.layout.is_conditional)
            pose = self.sender.random_raw(POSE, rng) if self.layout.is_conditional else None
            yield self._one(f"random-{i}", "A record of random bits.", raw, pose)

    def _signals_with_ends(self) -> list[str]:
        """Return the signals of a line of which both ends are tried."""
        others = ("Component", "Kind", "Status", "HasCovariance", "XMin", "XMax")
        return [name for name in self.sender.ordinary(self.slot) if not name.startswith(others)]

    def _is_of_covariance(self, name: str) -> bool:
        endings = ("Fine", "Inflation")
        return self.layout.is_conditional and (
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
        if self.layout.is_conditional:
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

    def damaged(self) -> Iterator[Case]:
        """Yield records whose pages do not belong together, or are lost."""
        yield from self._mixed()
        yield from self._strange_pages()
        if self.messages.can_id is not None:
            yield from self._transfers()

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
        for owner in (self.slot, *self.others):
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
        transfer_ids = 2 ** self.layout["TransferId0"].length
        case.frame(first.can_id, first.data, START_NS, is_extended=first.is_extended)
        self.sender.send(case, self.slot, transfer_ids // 2, START_NS + MS)
        case.counts()
        yield case
        if self.counters > transfer_ids:
            yield self._replaced(transfer_ids)

    def _replaced(self, transfer_ids: int) -> Case:
        """Return a transfer of which the next one with the same ID takes the place."""
        case = self._case("replaced", "Pages of two records with the same transfer ID.")
        page = min(bits_of(self.layout["Counter"])) // (8 * PAGE_BYTES)
        for i, counter in enumerate((0, transfer_ids, 0)):
            frame = self._frames(self.slot, counter)[page]
            case.frame(frame.can_id, frame.data, START_NS + i, is_extended=frame.is_extended)
        case.counts()
        return case

    def refused(self) -> Iterator[Case]:
        """Yield lines without their pose error, and values that no sender sends."""
        if self.layout.is_conditional:
            yield self._without_pose()
        yield self._not_valid()

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
        if self.layout.is_conditional:
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

    def send_cycle(
        self, case: Case, counter: int, cycle: int, raw: Mapping[str, int] | None = None
    ) -> None:
        """Send the line of a cycle, with its pose error if it is conditional on that."""
        t_ns = START_NS + cycle * self.cycle
        if self.layout.is_conditional:
            name = f"{slot_title(self.slot)}Counter"
            bits = self.sender.of(POSE)[name].length
            pose = {name: counter % 2**bits}
            self.sender.send(case, POSE, counter, t_ns, pose, fd=self.is_fd)
        self.sender.send(case, self.slot, counter, t_ns + MS, raw, fd=self.is_fd)

    def of_line(self, raw: Mapping[str, int]) -> dict[str, int]:
        """Return raw values of the line by their names in its record: the same."""
        return {**raw}
