"""Lines on a faulty bus: each that is delivered was sent, and comes once.

The time on the bus is computed, not waited for. On a real bus the controllers drop nearly all
damaged frames by their checksum; here the damage is done behind the controllers, as by a gateway.
"""

from __future__ import annotations

import resource
from collections import Counter
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from answers import one

from maplines_can.study import road
from maplines_can.testing import FaultInjector, FaultKind, Faults
from maplines_can.values.line import Kind, MapLine, Slot, Status
from maplines_can.wire import Codec

from .harness import evidence, progress

#: A quarter of the damaged frames each has one to three flipped bits, a truncated payload, a wrong
#: length, or a flipped bit in the CAN ID.
FAULTS = "loss=0.1,dup=0.05,reorder=0.05,corrupt=0.02"
CHUNK = 8192
#: Time between two lines, of one slot after the other at 20 Hz, and between two pages of a line.
STEP_NS, PAGE_NS = 50_000_000 // len(Slot), 250_000
#: Limits of the means that are drawn [m, rad, 1/m, 1/m^2]; number of covariances of road lines.
MAX_MEANS, COVS = (30, 0.4, 0.1, 0.02), 512
#: Chunks before the growth of the process is measured.
WARM_UP = 8
WRONGS = ("lines that were not sent", "lines delivered twice", "lines delivered out of order")


@evidence
def bus(n: int = 10**6, seed: int = 0, faults: str = FAULTS) -> dict[str, Any]:
    """Send lines for hours over a faulty bus: each delivered line was sent, bit for bit, once."""
    parts = {"classic CAN": False, "CAN FD": True}
    wanted = replace(Faults.parse(faults), seed=seed)
    return {name: Stream(wanted, n, seed, fd=fd).run(name) for name, fd in parts.items()}


class Page(NamedTuple):
    """A frame with its origin: line, page, and CAN ID and payload as sent."""

    can_id: int
    data: bytes
    is_fd: bool
    is_extended: bool
    line: int
    page: int
    sent_id: int
    sent: bytes


class Chunk:
    """Lines that are sent one after the other, and the outcome of each."""

    def __init__(self, codec: Codec, start: int, n: int, seed: int) -> None:
        rng = np.random.default_rng([seed, start])
        means = rng.uniform(-1, 1, (n, 4)) * MAX_MEANS
        covs = road_covs(seed)[rng.integers(COVS, size=n)] * rng.uniform(0.5, 2, (n, 1, 1))
        self.start = start
        numbers = np.arange(start, start + n)
        self.slots = numbers % len(Slot)
        self.payloads = codec.batch.encode(
            means,
            covs,
            slot=self.slots,
            counter=numbers // len(Slot) % 256,
            kind=rng.integers(len(Kind), size=n),
            x_min=8.0 * rng.integers(-4, 0, n),
            x_max=8.0 * rng.integers(0, 32, n),
            age=0.008 * rng.integers(0, 31, n),
        )
        self.batch = codec.batch.decode(self.payloads, slot=self.slots)
        self.arrived, self.damaged, self.delivered = (bytearray(n) for _ in range(3))

    def expected(self, line: int) -> tuple[Any, ...]:
        """Return the values that must be received of a line, to the last bit."""
        i, batch = line - self.start, self.batch
        return (
            Slot(self.slots[i]),
            Kind(batch.kind[i]),
            Status(batch.status[i]),
            *(float(values[i]) for values in (batch.x_min, batch.x_max, batch.age)),
            batch.mean[i].tobytes(),
            batch.cov[i].tobytes(),
        )

    def outcomes(self, pages: int) -> Counter[str]:
        """Return the number of lines by outcome."""
        whole, outcomes = 2**pages - 1, Counter[str]()
        for arrived, damaged, delivered in zip(
            self.arrived, self.damaged, self.delivered, strict=True
        ):
            missing = whole & ~arrived
            if delivered:
                outcomes["delivered"] += 1
            elif missing & ~damaged:
                outcomes["lost: a frame was lost"] += 1
            elif missing:
                outcomes["lost: a frame was damaged"] += 1
            else:
                outcomes["lost: all frames came, one too late or damaged as well"] += 1
        return outcomes


@cache
def road_covs(seed: int) -> Any:
    """Return covariances of road lines."""
    return road(COVS, seed)[1]


def values_of(line: MapLine) -> tuple[Any, ...]:
    """Return what must be equal of a line that is sent and received."""
    return (
        *(line.slot, line.kind, line.status, line.x_min, line.x_max, line.age),
        line.gaussian.mean.tobytes(),
        line.gaussian.cov.tobytes(),
    )


def memory_mib() -> float:
    """Return the memory of the process [MiB]: the present one on Linux, else the maximum."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * resource.getpagesize() / 2**20
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


class Stream:
    """Lines through a fault injector into a decoder, and what becomes of them."""

    def __init__(self, faults: Faults, n: int, seed: int, *, fd: bool) -> None:
        self._n, self._seed, self._fd = n, seed, fd
        self._codec = Codec.from_dbc()
        self._decoder, self._injector = self._codec.decoder(), FaultInjector[Page](faults)
        self._chunks: list[Chunk] = []
        self._outcomes, self._wrong = Counter[str](), Counter[str]()
        self._first: dict[Slot, int] = {}
        self._last: dict[Slot, int] = {}

    def run(self, name: str) -> dict[str, Any]:
        """Send all lines, and return the figures."""
        pages, memory = 1 if self._fd else self._codec.layout.pages, [memory_mib()]
        for start in progress(range(0, self._n, CHUNK), name):
            self._chunks.append(Chunk(self._codec, start, min(CHUNK, self._n - start), self._seed))
            self._send(self._chunks[-1])
            if len(self._chunks) > 1:
                self._outcomes += self._chunks.pop(0).outcomes(pages)
            memory.append(memory_mib())
        for out in self._injector.flush():
            self._receive(out, self._n * STEP_NS)
        self._decoder.expire(2 * self._n * STEP_NS)
        for chunk in self._chunks:
            self._outcomes += chunk.outcomes(pages)
        grown = max(memory[WARM_UP:], default=0.0) - max(memory[:WARM_UP])
        return self._figures() | {"memory grown by [MiB]": max(0.0, grown)}

    def _send(self, chunk: Chunk) -> None:
        for i, payload in enumerate(chunk.payloads):
            line, t_ns = chunk.start + i, (chunk.start + i) * STEP_NS
            frames = self._codec.encoder().frames(payload, Slot(line % len(Slot)), fd=self._fd)
            for page, frame in enumerate(frames):
                sent = Page(*frame, line, page, frame.can_id, frame.data)
                for out in self._injector.apply(sent, 1e-9 * t_ns):
                    self._receive(out, t_ns)
                t_ns += PAGE_NS

    def _receive(self, frame: Page, t_ns: int) -> None:
        feed = self._decoder.feed
        result = one(feed(frame.can_id, frame.data, t_ns, is_extended=frame.is_extended))
        chunk = self._chunks[-1] if frame.line >= self._chunks[-1].start else self._chunks[0]
        i = frame.line - chunk.start
        intact = (frame.can_id, frame.data) == (frame.sent_id, frame.sent)
        (chunk.arrived if intact else chunk.damaged)[i] |= 1 << frame.page
        if not isinstance(result, MapLine):
            return
        if values_of(result) != chunk.expected(frame.line):
            self._wrong["lines that were not sent"] += 1
            return
        slot = result.slot
        self._wrong["lines delivered twice"] += chunk.delivered[i]
        self._wrong["lines delivered out of order"] += frame.line < self._last.get(slot, 0)
        chunk.delivered[i] = 1
        self._first.setdefault(slot, frame.line)
        self._last[slot] = max(frame.line, self._last.get(slot, 0))

    def _figures(self) -> dict[str, Any]:
        decoder, done, outcomes = self._decoder, self._injector.counts, self._outcomes
        n, first, last = self._n, self._first, self._last
        ends = sum(
            len(range(slot, first[slot], len(Slot))) + len(range(last[slot] + 8, n, len(Slot)))
            for slot in first
        )
        lost = outcomes.total() - outcomes["delivered"]
        frames = self._injector.frames + done[FaultKind.DUPLICATED] - done[FaultKind.LOST]
        used = decoder.line_frames + sum(decoder.counts.values())
        return {
            "lines sent": n,
            **dict(sorted(outcomes.items())),
            "dropped by the decoder": {r.name.lower(): c for r, c in decoder.counts.items()},
            "wrong": {what: self._wrong[what] for what in WRONGS},
            "slots on which two senders are seen": sum(
                check.two_senders for check in decoder.checks.values()
            ),
            "sums that must be 0": {
                "lines sent, less delivered and lost": n - outcomes.total(),
                "lines delivered, less those of the decoder": outcomes["delivered"] - decoder.lines,
                "lines lost, less those missing by their counters": lost - decoder.lost - ends,
                "frames sent and doubled, less lost and received": frames - decoder.frames,
                "frames received, less those of lines and dropped": decoder.frames - used,
            },
        }
