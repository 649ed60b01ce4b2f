"""Streams of frames and questions of a faulty, hostile bus, for any DBC, from a seed.

A `Traffic` is what a sender sends in 256 cycles, so that its counters wrap around where it begins
again. Its records have random covariances and levels, and lines that a road may have. A `Profile`
says what happens to the frames on the way, and to the clock.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from ..model.records import sealed, written
from ..model.signals import nearest_limited, of_slot
from ..model.whole_scenes import NONE, REASONS, joint_bits, scene_of_dbc, shared, write_whole
from ..values.line import Slot
from ..wire import POSE, E2EConfig, Layout, Owner
from ..wire.layout.message_layout import AnyLayout
from ..wire.layout.pose_layout import SCENE, SCENE2, SceneOwner
from ..wire.layout.record_signals import OWN_SIGNALS, PAGE_BYTES, PARAMETER_SIGNALS
from ..wire.layout.scene_layout import SceneLayout

CYCLES = 256
#: Time between most cycles, and between two frames of one [ns].
PERIOD_NS, APART_NS = 50_000_000, 200_000
#: Slots whose lines are mixtures in every third cycle.
MIXED_SLOTS = (Slot.ROUTE, Slot.CENTRE)
#: Standard deviations of the means of lines [m, rad, 1/m, 1/m^2].
SPREAD = (4.0, 0.1, 2e-3, 2e-5)
#: Exponents of the standard deviations of most pose errors.
PIVOTS = {"PivotAlong": (-4, 1), "PivotAcross": (-4, 0), "PivotHeading": (-11, -5)}
#: Bounds of times [ns].
FIRST_NS, LAST_NS = -(2**63), 2**63 - 1


class FrameStep(NamedTuple):
    """A frame arrives."""

    can_id: int
    data: bytes
    is_extended: bool
    t_ns: int
    now_us: int  #: time of the clock of freshness values


class Question(NamedTuple):
    """A receiver is asked: for the newest line of a slot, a scene, all numbers, or to expire."""

    kind: str  #: latest, scene, statistics or expire
    slot: Slot
    t_ns: int


Step = FrameStep | Question


@dataclass(frozen=True)
class Profile:
    """What happens on the way, as probabilities of a frame unless it says otherwise."""

    name: str
    loss: float = 0.0
    duplicate: float = 0.0
    swap: float = 0.0  #: with the next frame
    late: float = 0.0  #: held back for up to 40 cycles
    damage: float = 0.0
    hostile: float = 0.0  #: another frame is inserted
    sealed: float = 0.0  #: a record of any content with a correct checksum is inserted
    fd: float = 0.0  #: of a record: it is sent as one frame
    silence: float = 0.0  #: of a cycle: nothing is sent in it
    outage: float = 0.0  #: of a cycle: that of up to 120 cycles, whose counters go on, is lost
    pause: float = 0.0  #: of a cycle: a sender pauses for up to 15 cycles
    restart: float = 0.0  #: of a cycle: the sender begins again
    jump: float = 0.0  #: of a cycle: the clock jumps, or stands still
    hasty: float = 0.0  #: of a cycle: the clock is slower by 1000 for up to 40 cycles
    refuses: bool = False  #: the receiver refuses short spacings
    senders: int = 1
    is_same: bool = False  #: two senders have the same counters
    ask: float = 0.05
    settings: Mapping[str, Any] = field(default_factory=dict)  #: of the receiver
    stale_cycles: float = 3.0
    has_keys: bool = False  #: the receiver requires authenticated frames
    has_clock: bool = True  #: of freshness values
    is_signed: bool = False  #: the frames are authenticated
    forged: float = 0.0  #: of an authenticated frame


_FAULTS: dict[str, Any] = {
    "loss": 0.02, "duplicate": 0.02, "swap": 0.02, "late": 0.01, "damage": 0.02,
}  # fmt: skip
PROFILES = (
    Profile("clean"),
    Profile("CAN FD", fd=1.0),
    Profile("classic and CAN FD", fd=0.5, loss=0.05),
    Profile("faults", **_FAULTS, fd=0.2, silence=0.02, restart=0.005, outage=0.01),
    Profile("many faults", loss=0.2, duplicate=0.2, swap=0.2, late=0.1, damage=0.1),
    Profile("late", late=0.3, duplicate=0.1),
    Profile("hostile", hostile=0.5, sealed=0.1, loss=0.05),
    Profile("any content", sealed=0.5, fd=0.5),
    Profile("clock", jump=0.1, loss=0.05, duplicate=0.05, silence=0.02),
    Profile("clock of another unit", hasty=0.05, fd=0.5, loss=0.02, refuses=True),
    Profile("clock of another unit, faults", **_FAULTS, hasty=0.1, jump=0.02, silence=0.02),
    Profile("two senders", senders=2, loss=0.02, pause=0.05, fd=0.8),
    Profile("two senders, same counters", senders=2, is_same=True, restart=0.01, jump=0.02,
            pause=0.02),
    Profile("everything twice", duplicate=1.0),
    Profile("most twice", duplicate=0.92, fd=1.0),
    Profile("restarts", restart=0.05, silence=0.05, fd=0.9),
    Profile("everything", **_FAULTS, hostile=0.1, sealed=0.05, fd=0.3, silence=0.02, restart=0.01,
            jump=0.02, senders=2),
    Profile("long time-outs", **_FAULTS, settings={"timeout_ms": 900.0, "cycle_ms": 20.0}),
    Profile("fast sender", **_FAULTS, fd=0.8, outage=0.05, settings={"cycle_ms": 500.0}),
    Profile("very fast sender", fd=1.0, outage=0.05, settings={"cycle_ms": 1000.0}),
    Profile("narrow windows", **_FAULTS, silence=0.1, stale_cycles=1.5,
            settings={"e2e": E2EConfig(3, 3, 5, 4, 2, 2, 3, 1, 1, 0, clear_to_invalid=False)}),
    Profile("wide windows", **_FAULTS,
            settings={"e2e": E2EConfig(100, 100, 255, 33, 30, 20, 31, 5, 100, 2)}),
)  # fmt: skip
#: Those of DBCs with authenticated messages.
SECURED_PROFILES = (
    Profile("authenticated", has_keys=True, is_signed=True),
    Profile("authenticated, faults", has_keys=True, is_signed=True, **_FAULTS, forged=0.2,
            silence=0.02, restart=0.01, hostile=0.1, jump=0.02),
    Profile("authenticated, replayed", has_keys=True, is_signed=True, duplicate=0.3, late=0.3,
            forged=0.1),
    Profile("authenticated, no clock", has_keys=True, has_clock=False, is_signed=True, **_FAULTS,
            forged=0.1, silence=0.1),
    Profile("authenticated, without a key", is_signed=True, loss=0.1),
    Profile("not authenticated", has_keys=True, **_FAULTS, fd=0.5, hostile=0.2),
)  # fmt: skip

#: Function that returns the authenticated payload of a record at a time [us].
Sign = Callable[[Owner, bytes, int], bytes]


class Traffic:
    """Records of a sender, cycle by cycle, and any others that one can send with its DBC."""

    def __init__(self, layout: Layout, seed: int = 0) -> None:
        self.layout = layout
        self._random = random.Random(seed)  # noqa: S311 - no secret
        self._counters = dict.fromkeys(layout.messages_of, 0)
        self._silent: SceneOwner | None = None  # the one of two messages that is not sent
        self._cycles: list[list[tuple[Owner, bytes]]] = []

    def cycle(self, k: int) -> list[tuple[Owner, bytes]]:
        """Return the records of a cycle: a pose error, and lines with one record or more.

        Or whole scenes. Some cycles have their records in another order.
        """
        is_whole = self.layout.scene is not None
        while len(self._cycles) <= k:
            records = [*(self._whole_scenes() if is_whole else self._records())]
            if self._random.random() < 0.1:
                self._random.shuffle(records)
            self._cycles.append(records)
        return self._cycles[k]

    def any_record(self, rng: random.Random, counter: int) -> tuple[Owner, bytes]:
        """Return a record of any content that most receivers accept, with a correct checksum."""
        owner = rng.choice([*self.layout.messages_of])
        layout = self.of(owner)
        if not isinstance(owner, Slot) and owner != POSE:
            joint = counter + (rng.random() < 0.1)
            return owner, self._whole(rng, owner, self._whole_pose(rng), counter, joint)
        assert not isinstance(layout, SceneLayout)  # noqa: S101 - no other records are in a DBC
        raw = {name: rng.randint(s.raw_min, s.raw_max) for name, s in layout.signals.items()}
        for name, most in (("Kind", 7), ("Status", 5), ("ComponentIndex", 3)):
            if name in raw and rng.random() < 0.9:
                raw[name] %= most + 1
        if "ComponentCount" in raw and rng.random() < 0.7:
            raw |= {"ComponentIndex": 0, "ComponentCount": 0}
        if raw.get("HasCovariance") and rng.random() < 0.8:
            raw |= dict.fromkeys(OWN_SIGNALS, 0)
        raw["Counter"] = counter % 2 ** layout["Counter"].length
        return owner, written(layout, raw, self.layout.messages_of[owner].data_id)

    def of(self, owner: Owner) -> AnyLayout:
        """Return the layout of the records of an owner."""
        return self.layout.record_of(owner)

    def _records(self) -> Iterator[tuple[Owner, bytes]]:
        lines: list[tuple[Owner, dict[str, int]]] = []
        stated = dict[Slot, int]()  # counters of the lines of one record
        for slot in self.layout.messages:
            records = [*self._line(slot)]
            if len(records) == 1:
                stated[slot] = self._counters[slot]
            lines += [(slot, raw | {"Counter": self._next(slot)}) for raw in records]
        if self.layout.pose is not None:
            yield POSE, self._written(POSE, self._pose(stated) | {"Counter": self._next(POSE)})
        for owner, raw in lines:
            yield owner, self._written(owner, raw)

    def _written(self, owner: Owner, raw: dict[str, int]) -> bytes:
        layout = self.of(owner)
        assert not isinstance(layout, SceneLayout)  # noqa: S101 - it has no records of lines
        return written(layout, raw, self.layout.messages_of[owner].data_id)

    def _next(self, owner: Owner) -> int:
        counter = self._counters[owner]
        self._counters[owner] = (counter + 1) % 2 ** self.of(owner)["Counter"].length
        return counter

    def _line(self, slot: Slot) -> Iterator[dict[str, int]]:
        """Yield the raw values of the records of a line: one, or several components."""
        rng, layout = self._random, self.layout
        if layout.is_conditional:
            raw = self._values(rng)
            if raw["HasCovariance"]:
                raw |= dict.fromkeys(OWN_SIGNALS, 0)
            elif rng.random() < 0.4:
                raw["OwnPoints"] = 0
            yield raw
            return
        count, weights = layout["ComponentCount"], 2 ** layout["ComponentWeight"].length
        size = rng.randint(2, 1 + count.raw_max) if slot in MIXED_SLOTS and count.raw_max else 1
        size = size if len(self._cycles) % 3 == 0 else 1
        ends = [0, *sorted(rng.sample(range(1, weights), size - 1)), weights]
        if size > 1 and rng.random() < 0.1:
            ends[-1] -= 1  # the sum of the weights is less than 1
        common = self._values(rng)
        status = rng.choices(range(6), (1, 20, 1, 1, 1, 1))[0]
        for place in range(size):
            yield self._values(rng) | {
                **{name: common[name] for name in ("Kind", "XMin", "XMax", "Age")},
                "Status": status if rng.random() < 0.9 else 1,
                "ComponentIndex": place,
                "ComponentCount": size - 1,
                "ComponentWeight": max(ends[place + 1] - ends[place] - 1, 0),
            }

    def _values(self, rng: random.Random) -> dict[str, int]:
        """Return any raw values of a line, but a mean that a road may have."""
        layout = self.layout
        raw = {name: rng.randint(s.raw_min, s.raw_max) for name, s in layout.signals.items()}
        for name, sigma in zip(PARAMETER_SIGNALS, SPREAD, strict=True):
            raw[name] = nearest_limited(layout[name], rng.gauss(0, sigma))
        raw["Kind"] %= 8
        raw["XMin"] = nearest_limited(layout["XMin"], rng.uniform(-20, 5))
        raw["XMax"] = nearest_limited(layout["XMax"], rng.uniform(15, 110))
        return raw

    def _any_pose(self, rng: random.Random) -> dict[str, int]:
        """Return any raw values of a record with a pose error, but one that a car may have."""
        layout = self.of(POSE)
        raw = {name: rng.randint(s.raw_min, s.raw_max) for name, s in layout.signals.items()}
        if rng.random() < 0.9:
            for name, (low, high) in PIVOTS.items():
                raw[name] = nearest_limited(layout[name], rng.uniform(low, high))
        for name in ("MapOffset", "MapHeading"):
            raw[name] = rng.choice([0, raw[name], raw[name], layout[name].raw_max])
        return raw

    def _pose(self, stated: Mapping[Slot, int]) -> dict[str, int]:
        rng, layout = self._random, self.of(POSE)
        raw = self._any_pose(rng)
        for slot in self.layout.messages:
            name = of_slot(slot, "Counter")
            following = self._counters[slot]
            raw[name] = stated.get(slot, following + 4) % 2 ** layout[name].length
            if of_slot(slot, "OwnPoints") in raw and rng.random() < 0.4:
                raw[of_slot(slot, "OwnPoints")] = 0
        return raw

    # ---- whole scenes ---------------------------------------------------------------------

    def _whole_scenes(self) -> Iterator[tuple[Owner, bytes]]:
        """Yield the records of ``Scene2`` and ``Scene``; one of them is silent in some cycles.

        Some are not of one scene, since their pose errors differ in one signal.
        """
        rng, owners = self._random, [*scene_of_dbc(self.layout).messages][::-1]
        if rng.random() < 0.1:
            self._silent = rng.choice([None, None, SCENE, SCENE2])
        pose, joint = self._whole_pose(rng), self._counters[SCENE]
        for owner in owners:
            if owner != self._silent:
                own, other = dict(pose), self._whole_pose(rng)
                if rng.random() < 0.1:
                    name = rng.choice([*other])
                    own[name] = other[name]
                yield owner, self._whole(rng, owner, own, self._next(owner), joint)

    def _whole_pose(self, rng: random.Random) -> dict[str, int]:
        """Return raw values of the pose error of a whole scene."""
        raw, names = self._any_pose(rng), shared(scene_of_dbc(self.layout))
        return {name: raw[name] for name in names if name != "SceneCounter"}

    def _whole(
        self,
        rng: random.Random,
        owner: SceneOwner,
        pose: Mapping[str, int],
        counter: int,
        joint: int,
    ) -> bytes:
        """Return a record of a whole scene; where it has no line, its bits mean nothing."""
        layout, lines = scene_of_dbc(self.layout), list[dict[str, int]]()
        others = [slot for slot in Slot if slot not in layout.fixed[owner]]
        slots = iter(rng.sample(others, len(others)) if rng.random() < 0.98 else [Slot.ROUTE] * 8)
        no_line = (NONE, NONE, *range(NONE + 1, NONE + 1 + len(REASONS)))
        for fixed in layout.fixed[owner]:
            raw = self._values(rng)
            if fixed is not None:
                raw.pop("Slot", None)
            else:
                raw["Slot"] = next(slots, Slot.ROUTE)
            if rng.random() < 0.4:
                raw["OwnPoints"] = 0
            if rng.random() < 0.3:
                raw["Kind"] = rng.choice(no_line)
            if rng.random() < 0.004:
                raw["Kind"] = self.layout["Kind"].raw_max
            lines.append(raw)
        age, modulus = layout["Age"], 2 ** layout["Counter"].length
        raw = {
            **pose,
            "Age": rng.randint(age.raw_min, age.raw_max),
            "Counter": counter % modulus,
            "SceneCounter": joint_bits(layout, joint),
        }
        data_id = layout.messages[owner].data_id
        return write_whole(layout, raw, lines, layout.record_bytes, data_id)


def traffics_of(layout: Layout, seed: int) -> tuple[Traffic, ...]:
    """Return what some senders send, with the same counters and other contents."""
    return tuple(Traffic(layout, 10 * seed + i) for i in range(3))


class _Sent(NamedTuple):
    """A frame on its way."""

    can_id: int
    data: bytes
    is_extended: bool


class Stream:
    """Steps of one stream.

    Args:
        traffics: what senders send; each begins, and restarts, with one of these.
        profile: what happens to it.
        seed: of all that is drawn here.
        sign: authenticates records; None if the profile has no authenticated frames.
        start_us: first time of the clock of freshness values.
    """

    def __init__(
        self,
        traffics: Sequence[Traffic],
        profile: Profile,
        seed: int,
        sign: Sign | None = None,
        start_us: int = 0,
    ) -> None:
        self._traffics, self._profile, self._sign = traffics, profile, sign
        self._random = random.Random(seed)  # noqa: S311 - no secret
        self._at = [self._random.randrange(CYCLES) for _ in range(profile.senders)]
        if profile.is_same:
            self._at = [self._at[0]] * profile.senders
        self._traffic = traffics[0]
        self._sent_by = [self._random.choice(traffics) for _ in self._at]
        self._paused = [0] * profile.senders  # cycles
        start = [0, 0, 10**18, -4 * 10**18, 4 * 10**18 - 3 * 10**11, 2**53 - 10**9]
        self._t_ns, self._now_us = self._random.choice(start), start_us
        self._hasty = 0  # cycles with a slow clock
        self._still = 0  # frames for which the clock stands still
        self._held: list[tuple[int, _Sent]] = []  # until this cycle
        self._cycle = 0
        self._slots = [*self._traffic.layout.slots]
        of_id = self._traffic.layout.message_of_id
        self._owner_of = {key: owner for key, (owner, _) in of_id.items()}

    def steps(self) -> Iterator[Step]:
        """Yield frames and questions without end."""
        rng = self._random
        while True:
            begin_ns, apart_ns = self._t_ns, APART_NS * rng.choice([1, 1, 1, 1, 1, 1, 10, 20])
            slow = self._slowness()
            apart_ns //= slow
            for sent in self._frames_of_cycle():
                if self._still > 0:
                    self._still -= 1
                else:
                    self._t_ns += rng.randrange(2 * apart_ns)
                yield FrameStep(*sent, self._t_ns, self._now_us)
                if rng.random() < self._profile.ask:
                    yield self._question(sent)
            if self._still == 0:
                cycles = 1.0 if rng.random() < 0.7 else rng.uniform(0.5, 3.5)
                self._t_ns = max(self._t_ns, begin_ns + round(cycles * PERIOD_NS / slow))
            self._now_us += PERIOD_NS // 1000
            self._cycle += 1
            if rng.random() < self._profile.outage:
                self._lose_cycles()
            self._jump()

    def _slowness(self) -> int:
        """Return the factor by which the clock is slower in this cycle."""
        if self._profile.hasty and self._random.random() < self._profile.hasty:
            self._hasty = self._random.randrange(40)
        self._hasty -= 1
        return 1000 if self._hasty >= 0 else 1

    def _lose_cycles(self) -> None:
        """Lose some cycles; the counters may go on faster or slower than the time."""
        cycles = self._random.randrange(120)
        self._at = [(at + cycles) % CYCLES for at in self._at]
        self._t_ns += round(cycles * self._random.uniform(0.3, 2.5) * PERIOD_NS)

    def _question(self, sent: _Sent) -> Question:
        rng = self._random
        later = rng.choice([0, 0, 1, 60, -1, -1.5, -2, -10, 500])
        later = round(later * 10**6)
        now_ns = max(FIRST_NS, min(self._t_ns + later, LAST_NS))
        kind = rng.choice(["latest", "latest", "scene", "statistics", "expire"])
        owner = self._owner_of.get((sent.can_id, sent.is_extended), POSE)
        if isinstance(owner, Slot) and rng.random() >= 0.5:
            return Question(kind, owner, now_ns)
        return Question(kind, rng.choice(self._slots), now_ns)

    def _frames_of_cycle(self) -> list[_Sent]:
        rng, profile, frames = self._random, self._profile, list[_Sent]()
        for i in range(profile.senders):
            if rng.random() < profile.restart:
                self._at[i], self._sent_by[i] = 0, rng.choice(self._traffics)
            if rng.random() < profile.pause:
                self._paused[i] = rng.randrange(15)
            self._paused[i] -= 1
            if rng.random() < profile.silence or self._paused[i] >= 0:
                continue
            cycle = self._sent_by[i].cycle(self._at[i])
            own = [frame for record in cycle for frame in self._sent(*record)]
            self._at[i] = (self._at[i] + 1) % CYCLES
            places = sorted(rng.randrange(len(frames) + 1) for _ in own)
            for place, frame in zip(reversed(places), reversed(own), strict=True):
                frames.insert(place, frame)
        return self._on_the_way(frames)

    def _sent(self, owner: Owner, record: bytes) -> list[_Sent]:
        """Return the frames of a record."""
        messages, rng = self._traffic.layout.messages_of[owner], self._random
        layout, sign = self._traffic.of(owner), self._sign
        if sign is not None and layout.secured and messages.secured_can_id is not None:
            if isinstance(layout, SceneLayout):  # it has fewer lines
                length = layout.secured_bytes
                record = sealed(layout, record[:length].ljust(length, b"\0"), messages.data_id)
            can_id, is_extended = messages.secured_can_id, messages.secured_is_extended
            self._now_us += 1  # freshness values increase
            if rng.random() >= self._profile.forged:
                return [_Sent(can_id, sign(owner, record, self._now_us), is_extended)]
            return [_Sent(can_id, self._forged(sign, owner, record), is_extended)]
        is_fd = rng.random() < self._profile.fd
        if messages.fd_can_id is not None and (is_fd or messages.can_id is None):
            data = record.ljust(messages.fd_length, b"\0")
            return [_Sent(messages.fd_can_id, data, messages.fd_is_extended)]
        if messages.can_id is None:
            return []
        pages = (record[i : i + PAGE_BYTES] for i in range(0, len(record), PAGE_BYTES))
        return [_Sent(messages.can_id, page, messages.is_extended) for page in pages]

    def _on_the_way(self, frames: list[_Sent]) -> list[_Sent]:
        rng, profile = self._random, self._profile
        out = [frame for due, frame in self._held if due <= self._cycle]
        self._held = [held for held in self._held if held[0] > self._cycle]
        for frame in frames:
            if rng.random() < profile.hostile:
                out.append(self._hostile(frame))
            if rng.random() < profile.sealed:
                counter = self._at[0] + rng.choice([0, 1, 1, 1, 2, 5, 40, 128, 250])
                pages = self._sent(*self._traffic.any_record(rng, counter))
                out += pages if rng.random() < 0.9 else pages[:-1]
            if rng.random() < profile.loss:
                continue
            if rng.random() < profile.late:
                self._held.append((self._cycle + rng.randrange(40), frame))
                continue
            out.append(self._damaged(frame) if rng.random() < profile.damage else frame)
            if rng.random() < profile.duplicate:
                out.append(frame)
            if len(out) > 1 and rng.random() < profile.swap:
                out[-1], out[-2] = out[-2], out[-1]
        return out

    def _damaged(self, frame: _Sent) -> _Sent:
        rng, data = self._random, bytearray(frame.data)
        if not data or rng.random() < 0.1:
            return frame._replace(data=frame.data[: rng.randrange(len(data) + 1)])
        for _ in range(rng.randrange(1, 4)):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        return frame._replace(data=bytes(data))

    def _hostile(self, frame: _Sent) -> _Sent:
        rng = self._random
        match rng.randrange(5):
            case 0:
                return _Sent(rng.randrange(0x800), rng.randbytes(8), False)
            case 1:
                return frame._replace(is_extended=not frame.is_extended)
            case 2:
                return frame._replace(data=rng.randbytes(rng.randrange(65)))
            case 3:
                return frame._replace(data=rng.randbytes(len(frame.data)))
            case _:
                return self._damaged(frame)

    def _forged(self, sign: Sign, owner: Owner, record: bytes) -> bytes:
        """Return an authenticated payload that is not authentic, or of another time."""
        rng, secured = self._random, self._traffic.of(owner).secured
        data = bytearray(sign(owner, record, self._now_us))
        match rng.randrange(4):
            case 0 if secured is not None:
                data[secured.authentic_bytes - 1] = rng.randrange(4)  # another key
            case 1:
                data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
            case 2:
                return rng.randbytes(len(data))
            case _:
                away = rng.choice([-(2**24), -3_000_000, -1_000_001, 1_000_001, 2**24, 2**40])
                return sign(owner, record, self._now_us + away)
        return bytes(data)

    def _jump(self) -> None:
        """Set the clock, or let it stand still."""
        rng = self._random
        if rng.random() >= self._profile.jump:
            return
        match rng.randrange(8):
            case 0:
                self._still = rng.randrange(1000)
            case 1:
                self._t_ns = rng.randint(FIRST_NS, LAST_NS)
            case 2:
                self._t_ns = rng.choice([FIRST_NS, LAST_NS, 4 * 10**18, -4 * 10**18, 0])
            case 3:
                self._t_ns += rng.randint(-(10**15), 10**15)
            case _:
                self._t_ns += round(rng.uniform(-1, 1) * 10 ** rng.uniform(0, 3) * PERIOD_NS)
        self._t_ns = max(FIRST_NS, min(self._t_ns, LAST_NS - 10**15))
