"""Resistance of authenticated lines to attacks, and their speed.

Each attack goes through a complete decoder that has received genuine traffic. It has no clock,
so only the MAC and the last freshness value protect it. After the attack it must still accept
the next genuine lines. A frame counts as accepted if it changes the last freshness value or
gives a line.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cache
from itertools import count
from typing import Any

import numpy as np

from maplines_can import map_lines
from maplines_can.simulation.scenarios import scenario
from maplines_can.study.dbc.record_spec import SECURED
from maplines_can.values.line import MapLine
from maplines_can.wire import Authenticator, Codec, Decoder, Frame, Key, Layout, Reason
from maplines_can.wire.layout.slot_messages import SecuredLayout

from .harness import evidence, progress

US, MS = 1_000, 1_000_000
START = 1_750_000_000 * 10**9
#: Frames of eight slots that the attacker has recorded; the receiver has received the first ones.
RECORDED, RECEIVED = 1024, 512
SECRET, OTHER = (np.random.default_rng(seed).bytes(16) for seed in (1, 2))


def scenario_lines() -> list[MapLine]:
    """Return the eight lines of the scenario "production"."""
    production = scenario("production")
    return map_lines(production.lines, production.ego, window=production.window)


@cache
def recorded(mac_bytes: int) -> tuple[Layout, list[Frame]]:
    """Return a layout with MACs of this length, and genuine traffic in it."""
    layout = Layout.from_text(replace(SECURED, mac_bytes=mac_bytes).dbc())
    periods = count(START, 50 * MS)
    sender = Codec(layout, Authenticator(*keys(), clock=lambda: next(periods)))
    sender_encoder = sender.encoder()
    lines = scenario_lines()
    frames: list[Frame] = []
    while len(frames) < RECORDED:
        frames += [frame for line in sender_encoder.encode_lines(lines, fd=True) for frame in line]
    return layout, frames


def keys() -> tuple[Key, Key]:
    """Return the key that is in use, and another key of the receiver."""
    return Key(SECRET, 1), Key(OTHER, 2)


class Bus:
    """Recorded genuine traffic, and a receiver that has received the first part of it."""

    def __init__(self, mac_bytes: int = 8) -> None:
        layout, self.frames = recorded(mac_bytes)
        self.secured = secured_layout(layout)
        self.receiver = Codec(layout, Authenticator(*keys()))
        self.decoder = self.receiver.decoder()
        self.now = START
        self.receive(self.frames[:RECEIVED])

    def receive(self, frames: list[Frame]) -> None:
        """Feed genuine frames to the receiver; each must give a line."""
        before = self.decoder.lines
        for i, frame in enumerate(frames):
            self.now += i % 8 // 7 * 50 * MS
            self.decoder.feed(frame.can_id, frame.data, self.now)
        if self.decoder.lines != before + len(frames):
            raise RuntimeError("genuine frames are not accepted")

    def accepted(
        self, attacks: Iterable[tuple[int, bytes]], total: int, name: str
    ) -> tuple[int, dict[str, int]]:
        """Feed the frames of an attack; return the number accepted, and all by outcome."""
        counts, moved = Counter[str](), 0
        last = last_accepted(self.decoder)
        before = sum(last.values())
        for can_id, data in progress(attacks, name, total):
            self.now += US
            answer = self.decoder.feed(can_id, data, self.now)
            if (total_now := sum(last.values())) != before:
                before = total_now
                moved += 1
            counts[answer.name if isinstance(answer, Reason) else "LINE"] += 1
        return max(moved, counts["LINE"]), dict(counts)


def secured_layout(layout: Layout) -> SecuredLayout:
    """Return the layout of the authenticated messages of a layout, which must have some."""
    if layout.secured is None:
        raise RuntimeError("the layout has no authenticated message")
    return layout.secured


def last_accepted(decoder: Decoder) -> dict[int, int]:
    """Return the last freshness values that a decoder has accepted; it updates the mapping."""
    return next(iter(decoder.verifiers.values())).last_accepted


# ---- attacks: (CAN ID, payload) ---------------------------------------------------------------

Attack = Iterator[tuple[int, bytes]]


def forged(bus: Bus, rng: np.random.Generator, n: int) -> Attack:
    """Yield random records with the next freshness value and a guessed MAC."""
    frames, secured = bus.frames[:8], bus.secured
    for _ in range(n):
        frame = frames[int(rng.integers(8))]
        fresh = ((bus.now + US) // US).to_bytes(8, "big")[-secured.freshness_bytes :]
        record = rng.bytes(secured.authentic_bytes - 1) + bytes([1 + int(rng.integers(2))])
        yield frame.can_id, record + fresh + rng.bytes(secured.mac_bytes)


def replayed(bus: Bus, rng: np.random.Generator, n: int) -> Attack:
    """Yield frames that the receiver has received, unchanged and in random order."""
    for i in rng.integers(RECEIVED, size=n):
        yield bus.frames[i].can_id, bus.frames[i].data


def flipped(bus: Bus, rng: np.random.Generator, n: int) -> Attack:
    """Yield frames that the receiver has not received, with 1 to 3 bits flipped."""
    for i in rng.integers(RECEIVED, RECORDED, size=n):
        data = bytearray(bus.frames[i].data)
        for bit in rng.choice(8 * len(data), size=1 + int(rng.integers(3)), replace=False):
            data[bit // 8] ^= 1 << bit % 8
        yield bus.frames[i].can_id, bytes(data)


def truncated(bus: Bus, rng: np.random.Generator, n: int) -> Attack:
    """Yield frames not received before: cut, inverted at the end, rotated or extended."""
    for i in rng.integers(RECEIVED, RECORDED, size=n):
        data, size = bus.frames[i].data, int(rng.integers(1, 48))
        cut = data[: len(data) - size]
        kind = int(rng.integers(4))
        inverted_end = bytes(0xFF - byte for byte in data[-size:])
        shapes = cut, cut + inverted_end, data[size:] + data[:size], data + bytes(size)
        yield bus.frames[i].can_id, shapes[kind]


def refreshed(bus: Bus, rng: np.random.Generator, n: int) -> Attack:
    """Yield received frames with a new freshness value; some with another key ID or slot."""
    secured = bus.secured
    for i in rng.integers(RECEIVED, size=n):
        frame = bus.frames[i]
        data, kind = bytearray(frame.data), int(rng.integers(3))
        fresh = ((bus.now + US) // US).to_bytes(8, "big")[-secured.freshness_bytes :]
        data[secured.authentic_bytes : secured.authentic_bytes + secured.freshness_bytes] = fresh
        if kind == 1:
            data[secured.authentic_bytes - 1] ^= 3
        yield (frame.can_id ^ 1 if kind == 2 else frame.can_id), bytes(data)


def stripped(bus: Bus, rng: np.random.Generator, n: int) -> Attack:
    """Yield genuine records without a MAC, in the two unauthenticated messages of the slot."""
    for i in rng.integers(RECORDED, size=n):
        frame = bus.frames[i]
        if rng.integers(2):
            yield frame.can_id - 8, frame.data[:32]
        else:
            page = 8 * int(rng.integers(4))
            yield frame.can_id - 16, frame.data[page : page + 8]


@evidence(n=2000)
def attacks(n: int = 10**6, seed: int = 0) -> dict[str, Any]:
    """Attack a 64-bit MAC with n frames of each kind: nothing is accepted."""
    result = {}
    for attack in ATTACKS:
        bus, rng = Bus(), np.random.default_rng(seed)
        moved, reasons = bus.accepted(attack(bus, rng, n), n, attack.__name__)
        bus.receive(bus.frames[RECEIVED:])
        result[attack.__name__] = {"frames": n, "accepted": moved, "reasons": reasons}
    return result | {"reordered": reordered(np.random.default_rng(seed), n)}


@evidence(n=20_000)
def guesses(n: int = 10**6, seed: int = 0) -> dict[str, Any]:
    """Guess MACs of 8 and 16 bits: n / 2^bits are accepted, within the sampling error."""
    result = {}
    for mac_bytes in (1, 2):
        bus, rng = Bus(mac_bytes), np.random.default_rng(seed)
        moved, _ = bus.accepted(forged(bus, rng, n), n, f"{8 * mac_bytes}-bit MAC")
        p = 2.0 ** (-8 * mac_bytes)
        result[f"{8 * mac_bytes} bits"] = {
            "guesses": n,
            "accepted": moved,
            "expected": n * p,
            "deviation in sampling errors": float((moved - n * p) / np.sqrt(n * p * (1 - p))),
        }
    return result


def reordered(rng: np.random.Generator, n: int) -> dict[str, Any]:
    """Reorder genuine frames by up to half a second: an overtaken frame is not accepted."""
    bus, wrong, counts = Bus(), 0, Counter[str]()
    for begin in progress(range(0, n, RECORDED), "reordered"):
        decoder = bus.receiver.decoder()
        newest: dict[int, int] = {}
        last = last_accepted(decoder)
        place = np.argsort(np.arange(RECORDED) + rng.uniform(0, 80, RECORDED))[: n - begin]
        for at, i in enumerate(place):
            frame = bus.frames[i]
            before = sum(last.values())
            answer = decoder.feed(frame.can_id, frame.data, START + at * MS * 6)
            moved = sum(last.values()) != before
            wrong += int(moved != (i > newest.get(frame.can_id, -1)))
            newest[frame.can_id] = max(i, newest.get(frame.can_id, -1))
            counts[answer.name if isinstance(answer, Reason) else "LINE"] += 1
    return {"frames": n, "accepted": wrong, "reasons": dict(counts)}


ATTACKS = (forged, replayed, flipped, truncated, refreshed, stripped)


@evidence(n=200)
def speed(n: int = 20_000) -> dict[str, Any]:
    """Measure lines per second on one core, with and without authentication: best of 3 turns."""
    layout, _ = recorded(8)
    authenticator = Authenticator(Key(SECRET), clock=time.time_ns, window_ns=600 * 10**9)
    plain, secured = Codec(layout), Codec(layout, authenticator)
    lines = scenario_lines()
    rates: dict[str, float] = {}
    for name, codec in (("plain", plain), ("authenticated", secured)) * 3:
        frames: list[Frame] = []
        encoder = codec.encoder()
        while len(frames) < n:
            frames += [f for line in encoder.encode_lines(lines, fd=True) for f in line]
        decoder, t_ns = codec.decoder(), 0
        begin = time.perf_counter()
        for frame in frames:
            t_ns += 6_250_000
            decoder.feed(frame.can_id, frame.data, t_ns)
        best(rates, f"lines decoded, {name}", decoder.lines, begin)
    begin, record, secured_pdu = time.perf_counter(), bytes(32), secured_layout(layout)
    for _ in range(n):
        authenticator.secure(record, 0x4D50, secured_pdu)
    best(rates, "records secured", n, begin)
    return {f"{name}, per second": round(rate) for name, rate in rates.items()}


def best(rates: dict[str, float], name: str, n: int, begin: float) -> None:
    """Record the rate since the beginning, if it is the highest so far."""
    rates[name] = max(rates.get(name, 0), n / (time.perf_counter() - begin))
