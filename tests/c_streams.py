"""Streams of frames and questions for the receivers in Python and in C: a faulty, hostile bus.

A ``Traffic`` is what a sender sends in 256 cycles, so that counters wrap around where it begins
again. A ``Profile`` says what happens to its frames on the way, and to the clock.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, NamedTuple

import c_core
import numpy as np
from c_receivers import MAX_TIME, Receivers, Vault
from scene_layouts import layout_of
from scene_streams import PERIOD_NS, road_scene

from maplines_can import Gaussian, GaussianMixture, Kind, MapLine, Slot, Status
from maplines_can.wire import POSE, Codec, E2EConfig, Layout
from maplines_can.wire.layout.pose_layout import Owner
from maplines_can.wire.layout.signals import PAGE_BYTES, SLOT_SIGNALS
from maplines_can.wire.layout.slot_messages import SecuredLayout
from maplines_can.wire.protection.secoc import Authenticator

CYCLES = 256
#: Time between two frames [ns].
APART_NS = 200_000
KEY = (1, bytes.fromhex("2b7e151628aed2a6abf7158809cf4f3c"))  # of RFC 4493
OTHER_KEY = (2, bytes(range(16)))
NOW_US = 1_750_000_000_000_000
#: Means and standard deviations of lines [m, rad, 1/m, 1/m^2].
SPREAD, SIGMA = np.array([4.0, 0.1, 2e-3, 2e-5]), np.array([0.2, 0.01, 1e-3, 1e-5])
MIXED_SLOTS = (Slot.ROUTE, Slot.CENTRE)
SCENE_SLOTS = (Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.EDGE_LEFT, Slot.EDGE_RIGHT)


class Sent(NamedTuple):
    """A frame on its way."""

    can_id: int
    data: bytes
    is_extended: bool


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
    restart: float = 0.0  #: of a cycle: the sender begins again
    jump: float = 0.0  #: of a cycle: the clock jumps, or stands still
    senders: int = 1
    ask: float = 0.05
    settings: Mapping[str, Any] = field(default_factory=dict)
    has_keys: bool = False  #: the receiver requires authenticated frames
    has_clock: bool = True  #: of freshness values
    is_signed: bool = False  #: the frames are authenticated
    forged: float = 0.0  #: of an authenticated frame


_FAULTS: dict[str, Any] = {
    "loss": 0.02,
    "duplicate": 0.02,
    "swap": 0.02,
    "late": 0.01,
    "damage": 0.02,
}
PROFILES = (
    Profile("clean"),
    Profile("FD", fd=1.0),
    Profile("classic and FD", fd=0.5, loss=0.05),
    Profile("faults", **_FAULTS, fd=0.2, silence=0.02, restart=0.005),
    Profile("many faults", loss=0.2, duplicate=0.2, swap=0.2, late=0.1, damage=0.1),
    Profile("late", late=0.3, duplicate=0.1),
    Profile("hostile", hostile=0.5, sealed=0.1, loss=0.05),
    Profile("any content", sealed=0.5, fd=0.5),
    Profile("clock", jump=0.1, loss=0.05, duplicate=0.05, silence=0.02),
    Profile("two senders", senders=2, loss=0.02),
    Profile("two senders with the same counters", senders=2, restart=0.01, jump=0.02),
    Profile("everything twice", duplicate=1.0),
    Profile("restarts", restart=0.05, silence=0.1),
    Profile("everything", **_FAULTS, hostile=0.1, sealed=0.05, fd=0.3, silence=0.02, restart=0.01,
            jump=0.02, senders=2),
    Profile("long time-outs", **_FAULTS, settings={"timeout_ms": 900.0, "cycle_ms": 20.0}),
    Profile("fast sender", **_FAULTS, settings={"cycle_ms": 500.0}),
    Profile("narrow windows", **_FAULTS, silence=0.1, settings={"stale_cycles": 1.5, "e2e":
            E2EConfig(3, 3, 5, 4, 2, 2, 3, 1, 1, 0, clear_to_invalid=False)}),
    Profile("wide windows", **_FAULTS, settings={"e2e":
            E2EConfig(100, 100, 255, 33, 30, 20, 31, 5, 100, 2)}),
)  # fmt: skip
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


class Traffic:
    """Records of a sender, cycle by cycle, and what else one can send with its DBC."""

    def __init__(self, layout: Layout, seed: int = 0) -> None:
        self.layout, self.codec = layout, Codec(layout)
        self._rng, self._random = np.random.default_rng(seed), random.Random(seed)  # noqa: S311
        self._encoder = self.codec.encoder()
        has = [*layout.messages]
        self._is_fd = all(own.can_id is None for own in layout.messages.values())
        self._scene_slots = [slot for slot in SCENE_SLOTS if slot in has] or has[:2]
        self._scenes = self._prepared() if layout.pose is not None else []
        self.cycles = [[*self._cycle(k)] for k in range(CYCLES)]

    def _prepared(self) -> list[Any]:
        radii = (400.0, -200.0, 90.0)
        return [
            self._encoder.prepare_scene(road_scene(slots, radius=radius), fd=self._is_fd)
            for radius in radii
            for slots in (self._scene_slots, self._scene_slots[:2])
        ]

    def _cycle(self, k: int) -> Iterator[tuple[Owner, bytes]]:
        """Yield the records of a cycle: a scene, single lines, and a mixture now and then."""
        if self._scenes:
            scene = self._random.choice(self._scenes)
            age = self._random.choice([0.0, 0.05, 0.11, np.inf if k % 16 == 0 else 0.02])
            sent = self._encoder.encode_scene(scene, age=age, fd=self._is_fd)
            for owner, frames in sent.items():
                yield owner, b"".join(frame.data for frame in frames)
        if self.layout.is_conditional:
            return
        slots = set(self.layout.messages) - set(self._scene_slots if self._scenes else ())
        for slot in sorted(slots):
            for frames in self._encoder.encode_lines([self._line(slot, k)]):
                data = b"".join(frame.data for frame in frames)
                size = self.layout.record_bytes
                for start in range(0, len(data), size):
                    yield slot, data[start : start + size]

    def _line(self, slot: Slot, k: int) -> MapLine:
        draw, age = self._random.random(), self._random.choice([0.0, 0.02, 0.2, np.inf])
        if slot in MIXED_SLOTS and k % 3 == 0:
            n = self._random.randrange(2, 9)
            weights = np.ones(n) / n
            mixture = GaussianMixture(weights, [self._gaussian() for _ in range(n)])
            return MapLine.of_mixture(slot, mixture, age=age)
        if draw < 0.05:
            return MapLine.mean_only(slot, self._gaussian().mean, age=age)
        status = Status.DIAGONAL if draw < 0.1 else Status.FULL
        kind = self._random.choice([*Kind])
        mean = [1e6, 0, 0, 0] if draw > 0.98 else None
        gaussian = self._gaussian()
        if mean is not None:
            gaussian = Gaussian(mean, gaussian.cov)
        return MapLine(slot, gaussian, kind=kind, age=age, status=status, x_min=-10, x_max=60)

    def _gaussian(self) -> Gaussian:
        A = self._rng.normal(size=(4, 4)) * SIGMA[:, None]
        return Gaussian(self._rng.normal(size=4) * SPREAD, A @ A.T + 1e-6 * np.diag(SIGMA**2))

    def frames(self, owner: Owner, record: bytes, *, fd: bool) -> list[Sent]:
        """Return the frames of a record."""
        messages = self.layout.messages_of[owner]
        if (fd or messages.can_id is None) and messages.fd_can_id is not None:
            data = record.ljust(messages.fd_length, b"\0")
            return [Sent(messages.fd_can_id, data, messages.fd_is_extended)]
        assert messages.can_id is not None
        return [
            Sent(messages.can_id, record[start : start + PAGE_BYTES], messages.is_extended)
            for start in range(0, len(record), PAGE_BYTES)
        ]

    def secured(self, owner: Owner, record: bytes, signer: Authenticator) -> list[Sent]:
        """Return the authenticated frame of a record."""
        messages = self.layout.messages_of[owner]
        secured = self.secured_layout(owner)
        assert messages.secured_can_id is not None
        assert secured is not None
        data = signer.secure(record, messages.secured_data_id, secured)
        return [Sent(messages.secured_can_id, data, messages.secured_is_extended)]

    def secured_layout(self, owner: Owner) -> SecuredLayout | None:
        """Return the layout of the authenticated message of an owner."""
        pose = self.layout.pose
        return pose.secured if owner == POSE and pose is not None else self.layout.secured

    def sealed(self, rng: random.Random, counter: int) -> tuple[Owner, bytes]:
        """Return a record of any content with a correct checksum."""
        owner = rng.choice([*self.layout.messages_of])
        form = self.codec.reader.formats[owner]
        layout = self.layout.pose if owner == POSE else self.layout
        assert layout is not None
        raw = {name: rng.randint(s.raw_min, s.raw_max) for name, s in layout.signals.items()}
        for name, most in (("Kind", 7), ("Status", 5), ("ComponentIndex", 3)):
            if name in raw and rng.random() < 0.9:
                raw[name] %= most + 1
        if "ComponentCount" in raw and rng.random() < 0.7:
            raw |= {"ComponentIndex": 0, "ComponentCount": 0}
        if raw.get("HasCovariance") and rng.random() < 0.8:
            raw |= {name: 0 for name in SLOT_SIGNALS if name.startswith("Own")}
        raw["Counter"] = counter % 2 ** layout["Counter"].length
        return owner, form.packer.pack_one(raw, form.data_ids[owner])


@cache
def traffic_of(dbc: str, seed: int = 0) -> Traffic:
    """Return the traffic of one of the project's DBCs."""
    return Traffic(layout_of(dbc), seed)


class Stream:
    """One stream of frames and questions to a pair of receivers."""

    def __init__(self, traffic: Traffic, profile: Profile, seed: int) -> None:
        self._traffic, self._profile, self._random = traffic, profile, random.Random(seed)  # noqa: S311
        vault = None
        if profile.has_keys:
            vault = Vault([KEY, OTHER_KEY], 1_000_000 if profile.has_clock else None, now_us=NOW_US)
        self.receivers = Receivers(traffic.layout, **profile.settings, vault=vault)
        self._sender = Vault([KEY], now_us=NOW_US)
        self._signer = self._sender.authenticator() if profile.is_signed else None
        self._at = [self._random.randrange(CYCLES) for _ in range(profile.senders)]
        if "same" in profile.name:
            self._at = [self._at[0]] * profile.senders
        start = [0, 0, 10**18, -MAX_TIME, MAX_TIME - 3 * 10**11, 2**53 - 10**9]
        self._t_ns = self._random.choice(start)
        self._still = 0  # frames for which the clock stands still
        self._held: list[tuple[int, Sent]] = []  # until this cycle
        self._cycle = 0
        self._slots = [owner for owner in traffic.layout.messages_of if owner != POSE]

    def run(self, frames: int) -> Receivers:
        """Feed this many frames or more."""
        receivers = self.receivers
        while receivers.decoder.frames < frames:
            begin_ns = self._t_ns
            for sent in self._frames_of_cycle():
                self._feed(sent)
                if self._random.random() < self._profile.ask:
                    self._ask()
            if self._still == 0:
                self._t_ns = max(self._t_ns, begin_ns + PERIOD_NS)
            self._sender.now_us += PERIOD_NS // 1000
            if receivers.vault is not None:
                receivers.vault.now_us = self._sender.now_us
            self._cycle += 1
            self._jump()
        receivers.statistics(self._t_ns)
        return receivers

    def _frames_of_cycle(self) -> list[Sent]:
        rng, profile, frames = self._random, self._profile, list[Sent]()
        for i in range(profile.senders):
            if rng.random() < profile.restart:
                self._at[i] = 0
            if rng.random() < profile.silence:
                continue
            own = [f for record in self._traffic.cycles[self._at[i]] for f in self._sent(*record)]
            self._at[i] = (self._at[i] + 1) % CYCLES
            frames = own if not frames else self._interleaved(frames, own)
        return self._on_the_way(frames)

    def _sent(self, owner: Owner, record: bytes) -> list[Sent]:
        if self._signer is not None and self._traffic.secured_layout(owner) is not None:
            (frame,) = self._traffic.secured(owner, record, self._signer)
            if self._random.random() < self._profile.forged:
                frame = self._forged(frame)
            return [frame]
        fd = self._random.random() < self._profile.fd
        return self._traffic.frames(owner, record, fd=fd)

    def _interleaved(self, first: list[Sent], second: list[Sent]) -> list[Sent]:
        places = sorted(self._random.randrange(len(first) + 1) for _ in second)
        out = list(first)
        for place, frame in zip(reversed(places), reversed(second), strict=True):
            out.insert(place, frame)
        return out

    def _on_the_way(self, frames: list[Sent]) -> list[Sent]:
        rng, profile = self._random, self._profile
        out = [frame for due, frame in self._held if due <= self._cycle]
        self._held = [held for held in self._held if held[0] > self._cycle]
        for frame in frames:
            if rng.random() < profile.hostile:
                out.append(self._hostile(frame))
            if rng.random() < profile.sealed:
                counter = self._at[0] + rng.choice([0, 1, 1, 1, 2, 5, 40, 128, 250])
                record = self._traffic.sealed(rng, counter)
                pages = self._sent(*record)
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

    def _damaged(self, frame: Sent) -> Sent:
        if not frame.data or self._random.random() < 0.1:
            return frame._replace(data=frame.data[: self._random.randrange(len(frame.data) + 1)])
        data = bytearray(frame.data)
        for _ in range(self._random.randrange(1, 4)):
            data[self._random.randrange(len(data))] ^= 1 << self._random.randrange(8)
        return frame._replace(data=bytes(data))

    def _hostile(self, frame: Sent) -> Sent:
        rng = self._random
        match rng.randrange(5):
            case 0:
                return Sent(rng.randrange(0x800), rng.randbytes(8), False)
            case 1:
                return frame._replace(is_extended=not frame.is_extended)
            case 2:
                return frame._replace(data=rng.randbytes(rng.randrange(65)))
            case 3:
                return frame._replace(data=rng.randbytes(len(frame.data)))
            case _:
                return self._damaged(frame)

    def _forged(self, frame: Sent) -> Sent:
        """Return an authenticated frame that is not authentic, or of another time."""
        rng, layout = self._random, self._traffic.layout.secured
        assert layout is not None
        data = bytearray(frame.data)
        kind = rng.randrange(4)
        if kind == 0:
            data[min(len(data), layout.authentic_bytes) - 1] = rng.randrange(4)  # another key
        elif kind == 1:
            return self._damaged(frame)
        elif kind == 2:
            return frame._replace(data=rng.randbytes(layout.length))
        else:
            away = rng.choice([-(2**24), -3_000_000, -1_000_001, 1_000_001, 2**24, 2**40])
            other = Vault([KEY], now_us=self._sender.now_us + away).authenticator()
            cycle = self._traffic.cycles[rng.randrange(CYCLES)]
            owner, record = rng.choice([own for own in cycle if own[0] != POSE])
            return self._traffic.secured(owner, record, other)[0]
        return frame._replace(data=bytes(data))

    def _feed(self, frame: Sent) -> None:
        if self._still > 0:
            self._still -= 1
        else:
            self._t_ns += self._random.randrange(2 * APART_NS)
        self.receivers.frame(frame.can_id, frame.data, self._t_ns, is_extended=frame.is_extended)

    def _jump(self) -> None:
        """Set the clock, or let it stand still."""
        rng = self._random
        if rng.random() >= self._profile.jump:
            return
        match rng.randrange(8):
            case 0:
                self._still = rng.randrange(1000)
            case 1:
                self._t_ns = rng.randint(-(2**63), 2**63 - 1)
            case 2:
                self._t_ns = rng.choice([-(2**63), 2**63 - 1, MAX_TIME, -MAX_TIME, 0])
            case 3:
                self._t_ns += rng.randint(-(10**15), 10**15)
            case _:
                self._t_ns += round(rng.uniform(-1, 1) * 10 ** rng.uniform(0, 3) * PERIOD_NS)
        self._t_ns = max(-(2**63), min(self._t_ns, 2**63 - 1 - 10**15))

    def _ask(self) -> None:
        rng, receivers = self._random, self.receivers
        now_ns = self._t_ns + rng.choice([0, 0, 10**6, 60 * 10**6, -(10**6), -(10**7), 5 * 10**8])
        now_ns = max(-(2**63), min(now_ns, 2**63 - 1))
        match rng.randrange(5):
            case 0:
                receivers.statistics(now_ns)
            case 1:
                receivers.scene(now_ns)
            case 2:
                receivers.expire(now_ns)
            case _:
                receivers.latest(rng.choice(self._slots), now_ns)


def profiles_for(layout: Layout) -> int:
    """Return the number of profiles whose streams a DBC can have."""
    return len(PROFILES) + (len(SECURED_PROFILES) if layout.secured is not None else 0)


def check_streams(
    traffic: Traffic, frames: int, seed: int, *prefix: str, **compiler: Any
) -> tuple[int, Counter[str]]:
    """Compare both receivers on streams of all profiles; raise AssertionError at a difference.

    Args:
        traffic: what is sent, such as ``traffic_of("maplines.dbc")``.
        frames: of each stream, about.
        seed: of the streams.
        prefix: an emulator and its arguments.
        compiler: options of ``c_core.harness``.

    Returns:
        The number of frames, and how often each answer was met.
    """
    program = c_core.harness("reception", traffic.layout, **compiler)
    total, met = 0, Counter[str]()
    secured = SECURED_PROFILES if traffic.layout.secured is not None else ()
    for i, profile in enumerate((*PROFILES, *secured)):
        receivers = Stream(traffic, profile, 1000 * seed + i).run(frames)
        total += receivers.check(program, *prefix)
        met += receivers.met
    return total, met
