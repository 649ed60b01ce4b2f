"""Guessed MACs of authenticated lines.

Frames go through a complete decoder that has received genuine traffic. It has no clock, so only the
MAC and the last freshness value protect it. A frame counts as accepted if it changes the last
freshness value or gives a line. What other attacks find, tests/wire/protection shows.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np

from maplines_can import map_lines
from maplines_can.generation.dbc.record_spec import SECURED
from maplines_can.simulation.scenarios import scenario
from maplines_can.values.line import MapLine
from maplines_can.wire import Authenticator, Codec, Frame, Key, Layout, Reason

from .harness import evidence, progress

US, MS = 1_000, 1_000_000
START = 1_750_000_000 * 10**9
#: Genuine frames of eight slots that the receiver has received.
RECEIVED = 512
SECRET, OTHER = (np.random.default_rng(seed).bytes(16) for seed in (1, 2))
#: The key that is in use, and another one of the receiver.
KEYS = Key(SECRET, 1), Key(OTHER, 2)


def scenario_lines() -> list[MapLine]:
    """Return the eight lines of the scenario "production"."""
    production = scenario("production")
    return map_lines(production.lines, production.ego, window=production.window)


def genuine(layout: Layout) -> list[Frame]:
    """Return genuine traffic, a period of eight lines after the other."""
    periods = count(START, 50 * MS)
    encoder = Codec(layout, Authenticator(*KEYS, clock=lambda: next(periods))).encoder()
    lines, frames = scenario_lines(), list[Frame]()
    while len(frames) < RECEIVED:
        frames += [frame for line in encoder.encode_lines(lines, fd=True) for frame in line]
    return frames


@evidence
def secoc(n: int = 10**6, seed: int = 0) -> dict[str, Any]:
    """Guess MACs of 8 and 16 bits: n / 2^bits are accepted, within the sampling error."""
    result = {}
    for mac_bytes in (1, 2):
        layout = Layout.from_text(replace(SECURED, mac_bytes=mac_bytes).dbc())
        moved = accepted(layout, n, np.random.default_rng(seed))
        p = 2.0 ** (-8 * mac_bytes)
        result[f"{8 * mac_bytes} bits"] = {
            "guesses": n,
            "accepted": moved,
            "expected": n * p,
            "deviation in sampling errors": float((moved - n * p) / np.sqrt(n * p * (1 - p))),
        }
    return result


def accepted(layout: Layout, n: int, rng: np.random.Generator) -> int:
    """Return how many random records with the next freshness value and a guessed MAC pass."""
    secured, frames = layout.secured, genuine(layout)
    if secured is None:
        raise RuntimeError("the layout has no authenticated message")
    decoder, now = Codec(layout, Authenticator(*KEYS)).decoder(), START
    for i, frame in enumerate(frames):
        now += i % 8 // 7 * 50 * MS
        decoder.feed(frame.can_id, frame.data, now)
    if decoder.lines != len(frames):
        raise RuntimeError("genuine frames are not accepted")
    last = next(iter(decoder.verifiers.values())).last_accepted
    before, moved, lines = sum(last.values()), 0, 0
    for _ in progress(range(n), f"{8 * secured.mac_bytes}-bit MAC"):
        frame = frames[int(rng.integers(8))]
        now += US
        fresh = (now // US).to_bytes(8, "big")[-secured.freshness_bytes :]
        record = rng.bytes(secured.authentic_bytes - 1) + bytes([1 + int(rng.integers(2))])
        guess = record + fresh + rng.bytes(secured.mac_bytes)
        lines += not isinstance(decoder.feed(frame.can_id, guess, now), Reason)
        if sum(last.values()) != before:
            before, moved = sum(last.values()), moved + 1
    return max(moved, lines)
