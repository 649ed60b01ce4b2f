#!/usr/bin/env python3
"""Show what authentication promises, with figures.

    evidence_secoc.py            attacks, the bound of shorter MACs, vectors, speed
    evidence_secoc.py --n 10000  fewer of each attack than 1e6

Run it in the project's environment: python3 tools/run.py python tools/evidence_secoc.py

Each attack goes through a whole decoder that has heard the true traffic and has no clock, so
that nothing but the MAC and the last freshness value stands in the way; afterwards the next
true lines must still be heard. A frame counts as accepted if it moves the last freshness
value or gives a line. Guesses are bound by n / 2^bits; so MACs of 8 and 16 bits are guessed
too, where as many must pass as the bound says, and no more.

Ends with a nonzero status where a bound is missed.
"""

import sys
import time
from collections import Counter
from dataclasses import replace
from functools import cache
from itertools import count

import numpy as np
from telling import bar, ended, parser_of, progress

from maplines_can import map_lines
from maplines_can.line import MapLine
from maplines_can.scenarios import scenario
from maplines_can.study.dbc.record_spec import SECURED
from maplines_can.wire import Authenticator, Codec, Key, Layout, Reason

US, MS = 1_000, 1_000_000
START = 1_750_000_000 * 10**9
#: Frames that the attacker has recorded, of eight slots, and how many of them the receiver heard.
RECORDED, HEARD = 1024, 512
#: Standard deviations by which a count may miss what the bound expects.
SIGMAS = 4
SECRET, OTHER = (np.random.default_rng(seed).bytes(16) for seed in (1, 2))

#: RFC 4493, section 4.
RFC_4493 = {
    0: "bb1d6929e95937287fa37d129b756746",
    16: "070a16b46b4d4144f79bdd9dd04a287c",
    40: "dfa66747de9ae63030ca32611497c827",
    64: "51f0bebf7e3b9d92fc49741779363cfe",
}
RFC_KEY = bytes.fromhex("2b7e151628aed2a6abf7158809cf4f3c")
RFC_MESSAGE = bytes.fromhex(
    "6bc1bee22e409f96e93d7e117393172aae2d8a571e03ac9c9eb76fac45af8e51"
    "30c81c46a35ce411e5fbc1191a0a52eff69f2445df4f9b17ad2b417be66c3710"
)


def scene_lines():
    """The eight lines of the scene "production"."""
    scene = scenario("production")
    return map_lines(scene.lines, scene.ego, scene.window)


@cache
def recorded(mac_bytes):
    """True traffic, and its layout."""
    layout = Layout.from_text(replace(SECURED, mac_bytes=mac_bytes).dbc())
    periods = count(START, 50 * MS)
    sender = Codec(layout, Authenticator(*keys(), clock=lambda: next(periods)))
    scene, frames = scene_lines(), []
    while len(frames) < RECORDED:
        frames += [frame for burst in sender.encode_lines(scene, fd=True) for frame in burst]
    return layout, frames


def keys():
    return Key(SECRET, 1), Key(OTHER, 2)


class Bus:
    """True traffic, recorded; a receiver that has heard the first part of it."""

    def __init__(self, mac_bytes=8):
        layout, self.frames = recorded(mac_bytes)
        self.form = layout.secured
        self.receiver = Codec(layout, Authenticator(*keys()))
        self.decoder = self.receiver.decoder()
        self.now = START
        self.hear(self.frames[:HEARD])

    def hear(self, frames):
        """Give true frames to the receiver, each of which must be a line."""
        before = self.decoder.lines
        for i, frame in enumerate(frames):
            self.now += i % 8 // 7 * 50 * MS
            self.decoder.feed(frame.can_id, frame.data, self.now)
        if self.decoder.lines != before + len(frames):
            raise RuntimeError("true frames are not accepted")

    def accepted(self, attacks, total, name):
        """How many frames were accepted, and the others by reason."""
        counts, moved = Counter(), 0
        last = self.decoder.verifier.last_accepted
        before = sum(last.values())
        for can_id, data in progress(attacks, name, total):
            self.now += US
            answer = self.decoder.feed(can_id, data, self.now)
            if (total_now := sum(last.values())) != before:
                before = total_now
                moved += 1
            counts["LINE" if isinstance(answer, MapLine) else answer.name] += 1
        return max(moved, counts["LINE"]), dict(counts)


# ---- attacks: (CAN ID, payload) ---------------------------------------------------------------


def forged(bus, rng, n):
    """Records of any content, of the next time, with a guessed MAC."""
    frames, form = bus.frames[:8], bus.form
    for _ in range(n):
        frame = frames[int(rng.integers(8))]
        fresh = ((bus.now + US) // US).to_bytes(8, "big")[-form.freshness_bytes :]
        record = rng.bytes(form.authentic_bytes - 1) + bytes([1 + int(rng.integers(2))])
        yield frame.can_id, record + fresh + rng.bytes(form.mac_bytes)


def replayed(bus, rng, n):
    """Anything that the receiver heard, bit for bit, in any order."""
    for i in rng.integers(HEARD, size=n):
        yield bus.frames[i].can_id, bus.frames[i].data


def flipped(bus, rng, n):
    """Frames that the receiver has not heard, with 1 to 3 bits flipped anywhere."""
    for i in rng.integers(HEARD, RECORDED, size=n):
        data = bytearray(bus.frames[i].data)
        for bit in rng.choice(8 * len(data), size=1 + int(rng.integers(3)), replace=False):
            data[bit // 8] ^= 1 << bit % 8
        yield bus.frames[i].can_id, bytes(data)


def truncated(bus, rng, n):
    """Frames that the receiver has not heard, cut off, their end spoilt, turned, or longer."""
    for i in rng.integers(HEARD, RECORDED, size=n):
        data, size = bus.frames[i].data, int(rng.integers(1, 48))
        cut = data[: len(data) - size]
        kind = int(rng.integers(4))
        spoilt = bytes(0xFF - byte for byte in data[-size:])
        shapes = cut, cut + spoilt, data[size:] + data[:size], data + bytes(size)
        yield bus.frames[i].can_id, shapes[kind]


def renewed(bus, rng, n):
    """Frames that the receiver heard, with a new time, the other key's number, or another slot."""
    form = bus.form
    for i in rng.integers(HEARD, size=n):
        frame = bus.frames[i]
        data, kind = bytearray(frame.data), int(rng.integers(3))
        fresh = ((bus.now + US) // US).to_bytes(8, "big")[-form.freshness_bytes :]
        data[form.authentic_bytes : form.authentic_bytes + form.freshness_bytes] = fresh
        if kind == 1:
            data[form.authentic_bytes - 1] ^= 3
        yield (frame.can_id ^ 1 if kind == 2 else frame.can_id), bytes(data)


def stripped(bus, rng, n):
    """True records without their proof, on the other two messages of the slot."""
    for i in rng.integers(RECORDED, size=n):
        frame = bus.frames[i]
        if rng.integers(2):
            yield frame.can_id - 8, frame.data[:32]
        else:
            page = 8 * int(rng.integers(4))
            yield frame.can_id - 16, frame.data[page : page + 8]


def reordered(rng, n):
    """True frames thrown about by up to half a second: who is overtaken is not accepted."""
    bus, wrong, counts = Bus(), 0, Counter()
    with bar(n, "reordered") as frames:
        for begin in range(0, n, RECORDED):
            decoder, newest = bus.receiver.decoder(), {}
            place = np.argsort(np.arange(RECORDED) + rng.uniform(0, 80, RECORDED))[: n - begin]
            for at, i in enumerate(place):
                frame = bus.frames[i]
                before = sum(decoder.verifier.last_accepted.values())
                answer = decoder.feed(frame.can_id, frame.data, START + at * MS * 6)
                moved = sum(decoder.verifier.last_accepted.values()) != before
                wrong += int(moved != (i > newest.get(frame.can_id, -1)))
                newest[frame.can_id] = max(i, newest.get(frame.can_id, -1))
                counts["LINE" if isinstance(answer, MapLine) else answer.name] += 1
            frames.update(len(place))
    return {"frames": n, "accepted": wrong, "reasons": dict(counts)}


ATTACKS = (forged, replayed, flipped, truncated, renewed, stripped)


# ---- what is shown -------------------------------------------------------------------------------


def attacks(n, seed):
    """Each attack on a 64-bit MAC: nothing is accepted."""
    result = {}
    for attack in ATTACKS:
        bus, rng = Bus(), np.random.default_rng(seed)
        moved, reasons = bus.accepted(attack(bus, rng, n), n, attack.__name__)
        bus.hear(bus.frames[HEARD:])
        result[attack.__name__] = {"frames": n, "accepted": moved, "reasons": reasons}
    result["reordered"] = reordered(np.random.default_rng(seed), n)
    return result


def bound(n, seed):
    """Guesses of a MAC of 8 and 16 bits: as many pass as n / 2^bits, within sampling error."""
    result = {}
    for mac_bytes in (1, 2):
        bus, rng = Bus(mac_bytes), np.random.default_rng(seed)
        moved, _ = bus.accepted(forged(bus, rng, n), n, f"{8 * mac_bytes}-bit MAC")
        p = 2.0 ** (-8 * mac_bytes)
        sigmas = (moved - n * p) / np.sqrt(n * p * (1 - p))
        result[f"{8 * mac_bytes} bits"] = {
            "guesses": n,
            "accepted": moved,
            "expected": n * p,
            "sampling errors apart": float(sigmas),
            "met": bool(abs(sigmas) < SIGMAS or n * p < 1),
        }
    return result


def vectors():
    """RFC 4493, through the key that frames are made with."""
    key = Key(RFC_KEY)
    return {
        f"{length} bytes": key.mac(RFC_MESSAGE[:length]).hex() == mac
        for length, mac in RFC_4493.items()
    }


def speed(n):
    """Lines a second on one core, with and without authentication, by turns; the best of each."""
    layout, _ = recorded(8)
    authenticator = Authenticator(Key(SECRET), clock=time.time_ns, window_ns=600 * 10**9)
    plain, secured = Codec(layout), Codec(layout, authenticator)
    lines = scene_lines()
    rates = {}
    for name, codec in (("plain", plain), ("authenticated", secured)) * 3:
        frames = []
        while len(frames) < n:
            frames += [f for burst in codec.encode_lines(lines, fd=True) for f in burst]
        decoder, t_ns = codec.decoder(), 0
        verify, begin = codec.verifier(), time.perf_counter()
        if verify is not None:  # the check alone
            ids = layout.data_id_of_secured
            good = [verify(f.data, ids[f.can_id, False]) for f in frames]
            best(rates, "checks of a MAC", len(good), begin)
            if any(isinstance(answer, Reason) for answer in good):
                raise RuntimeError("a true frame is not accepted")
        begin = time.perf_counter()
        for frame in frames:
            t_ns += 6_250_000
            decoder.feed(frame.can_id, frame.data, t_ns)
        best(rates, f"lines decoded, {name}", decoder.lines, begin)
    begin, record, form = time.perf_counter(), bytes(32), layout.secured
    for _ in range(n):
        secured.authenticator.secure(record, 0x4D50, form)
    best(rates, "records secured", n, begin)
    return {f"{name} a second": round(rate) for name, rate in rates.items()}


def best(rates, name, n, begin):
    rates[name] = max(rates.get(name, 0), n / (time.perf_counter() - begin))


def main():
    parser = parser_of(__doc__)
    parser.add_argument("--n", type=int, default=1_000_000, help="frames of each attack")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="for machines")
    arguments = parser.parse_args()
    result = {
        "vectors of RFC 4493": vectors(),
        "attacks": attacks(arguments.n, arguments.seed),
        "guesses of short MACs": bound(arguments.n, arguments.seed),
        "speed": speed(min(arguments.n, 20_000)),
    }
    result["met"] = (
        all(result["vectors of RFC 4493"].values())
        and not any(attack["accepted"] for attack in result["attacks"].values())
        and all(row["met"] for row in result["guesses of short MACs"].values())
    )
    return ended(result, arguments.json, 40)


if __name__ == "__main__":
    sys.exit(main())
