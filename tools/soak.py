#!/usr/bin/env python3
"""Send lines for hours on a faulty bus: each delivered line was sent, bit for bit, and comes once.

    soak.py             1e6 lines as classic CAN and 1e6 as CAN FD with 10 % of the frames lost,
                        5 % duplicated, 5 % reordered and 2 % damaged; a tenth of the lines over
                        python-can's virtual bus, and some in real time through Transmitter and
                        Receiver; then the checksum on 4e6 records of each kind of damage
    soak.py --lines N   another number of lines
    soak.py --only classic fd bus threads checksum

There are eight lines at 20 Hz; the time on the bus is computed, not waited for. A quarter of the
damaged frames each has one to three flipped bits, a truncated payload, a wrong length, or a flipped
bit in the CAN ID. On a real bus the controllers drop nearly all of these by the checksum of the
frame; here the damage is done behind the controllers, as by a gateway or a driver.

Run it in the project's environment: python3 tools/run.py python tools/soak.py

The exit status is nonzero if a promise is broken.
"""

import resource
import sys
import time
import uuid
from collections import Counter
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import can
import numpy as np
from reporting import bar, parser_of, progress, report

from maplines_can.bus import Link, Receiver, Transmitter
from maplines_can.study import road
from maplines_can.testing import FaultInjector, FaultKind, Faults, FaultyBus, FaultyOpener
from maplines_can.values.line import Kind, MapLine, Slot, Status
from maplines_can.wire import Codec
from maplines_can.wire.layout.message_layout import PAGE_BYTES
from maplines_can.wire.protection.e2e import CRC_BYTES, record_crc

FAULTS = "loss=0.1,dup=0.05,reorder=0.05,corrupt=0.02"
CHUNK = 8192
#: Time between two lines, of one slot after the other, and between two pages of a line.
STEP_NS, PAGE_NS = 50_000_000 // len(Slot), 250_000
#: Limits of the means that are drawn [m, rad, 1/m, 1/m^2]; number of covariances of road lines.
MAX_MEANS, COVS = (30, 0.4, 0.1, 0.02), 512
#: Growth of the process that counts as none, and chunks before it is measured. One byte kept of
#: each frame would be 4 MiB.
FLAT_MIB, WARM_UP = 4.0, 8


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

    @property
    def intact(self) -> Any:
        """Whether it arrived as it was sent."""
        return self.data == self.sent and self.can_id == self.sent_id


class Chunk:
    """Lines that are sent one after the other, and the outcome of each."""

    def __init__(self, codec: Any, start: Any, n: Any, seed: Any) -> None:
        rng = np.random.default_rng([seed, start])
        means = rng.uniform(-1, 1, (n, 4)) * MAX_MEANS
        covs = road_covs(seed)[rng.integers(COVS, size=n)] * rng.uniform(0.5, 2, (n, 1, 1))
        self.start = start
        numbers = np.arange(start, start + n)
        self.slots = numbers % len(Slot)
        self.payloads = codec.encode_batch(
            means,
            covs,
            slot=self.slots,
            counter=numbers // len(Slot) % 256,
            kind=rng.integers(len(Kind), size=n),
            x_min=8.0 * rng.integers(-4, 0, n),
            x_max=8.0 * rng.integers(0, 32, n),
            age=0.008 * rng.integers(0, 31, n),
        )
        self.batch = codec.decode_batch(self.payloads, slot=self.slots)
        self.arrived, self.damaged, self.delivered = (bytearray(n) for _ in range(3))

    def expected(self, line: Any) -> Any:
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

    def outcomes(self, pages: Any) -> Any:
        """Return the number of lines by outcome."""
        whole, outcomes = 2**pages - 1, Counter[Any]()
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
def road_covs(seed: Any) -> Any:
    return road(COVS, seed)[1]


def values_of(line: Any) -> Any:
    """Return the values of a received line in the form of ``Chunk.expected``."""
    return (
        *(line.slot, line.kind, line.status, line.x_min, line.x_max, line.age),
        line.gaussian.mean.tobytes(),
        line.gaussian.cov.tobytes(),
    )


def stream(n: Any, seed: Any, fd: Any, faults: Any) -> Any:
    """Send lines through a fault injector into a decoder; return the figures."""
    codec = Codec.from_dbc()
    decoder, injector = codec.decoder(), FaultInjector[Any](replace(faults, seed=seed))
    pages = 1 if fd else codec.layout.pages
    chunks, outcomes, wrong, examples = list[Any](), Counter[Any](), Counter[Any](), list[Any]()
    first, last = dict[Any, Any](), dict[Any, Any]()
    memory = []

    def receive(frame: Any, t_ns: Any) -> None:
        result = decoder.feed(frame.can_id, frame.data, t_ns, is_extended=frame.is_extended)
        chunk = chunks[-1] if frame.line >= chunks[-1].start else chunks[0]
        i = frame.line - chunk.start
        if frame.intact:
            chunk.arrived[i] |= 1 << frame.page
        else:
            chunk.damaged[i] |= 1 << frame.page
        if not isinstance(result, MapLine):
            return
        if values_of(result) != chunk.expected(frame.line):
            wrong["lines that were not sent"] += 1
            examples.append(f"line {frame.line} of {result.slot.name}, completed by {frame}")
            return
        wrong["lines delivered twice"] += chunk.delivered[i]
        wrong["lines delivered out of order"] += frame.line < last.get(result.slot, 0)
        chunk.delivered[i] = 1
        first.setdefault(result.slot, frame.line)
        last[result.slot] = max(frame.line, last.get(result.slot, 0))

    for start in progress(range(0, n, CHUNK), "CAN FD" if fd else "classic CAN"):
        chunks.append(Chunk(codec, start, min(CHUNK, n - start), seed))
        for i, payload in enumerate(chunks[-1].payloads):
            line, t_ns = start + i, (start + i) * STEP_NS
            for page, frame in enumerate(codec.frames(payload, Slot(line % len(Slot)), fd=fd)):
                sent = Page(*frame, line, page, frame.can_id, frame.data)
                for out in injector.apply(sent, 1e-9 * t_ns):
                    receive(out, t_ns)
                t_ns += PAGE_NS
        if len(chunks) > 1:
            outcomes += chunks.pop(0).outcomes(pages)
        memory.append(memory_mib())
    for out in injector.flush():
        receive(out, n * STEP_NS)
    decoder.expire(2 * n * STEP_NS)
    for chunk in chunks:
        outcomes += chunk.outcomes(pages)

    done = injector.counts
    ends = sum(
        len(range(slot, first[slot], len(Slot))) + len(range(last[slot] + 8, n, len(Slot)))
        for slot in first
    )
    sums = {
        "lines sent, less delivered and lost": n - sum(outcomes.values()),
        "lines delivered, less those of the decoder": outcomes["delivered"] - decoder.lines,
        "lines lost, less those missing by their counters": sum(
            count for outcome, count in outcomes.items() if outcome != "delivered"
        )
        - decoder.lost
        - ends,
        "frames sent and doubled, less lost and received": injector.frames
        + done[FaultKind.DUPLICATED]
        - done[FaultKind.LOST]
        - decoder.frames,
        "frames received, less those of lines and dropped": decoder.frames
        - decoder.line_frames
        - sum(decoder.counts.values()),
    }
    seen_twice = sum(check.two_senders for check in decoder.checks.values())
    grown = max(memory[WARM_UP:], default=0.0) - max(memory[:WARM_UP])
    return {
        "bus time [h]": n * STEP_NS / 3.6e12,
        "lines sent": n,
        **dict(sorted(outcomes.items())),
        "share delivered": outcomes["delivered"] / n,
        "share of which a good copy of each frame came, expected": good_copy(faults) ** pages,
        "frames": {"sent": injector.frames} | {what.name.lower(): done[what] for what in FaultKind},
        "dropped by the decoder": {r.name.lower(): c for r, c in decoder.counts.items()},
        **{key: wrong[key] for key in WRONGS},
        "slots on which two senders are seen": seen_twice,
        **({"examples": examples[:5]} if examples else {}),
        "sums that must be 0": sums,
        "wraps of the 8-bit counters": wraps(n, 256),
        "wraps of the 4-bit transfer numbers": wraps(n, 16),
        "memory [MiB]": memory[-1],
        "memory grown by [MiB]": max(0.0, grown),
        "met": not any(wrong.values())
        and not any(sums.values())
        and not seen_twice
        and grown < FLAT_MIB,
    }


def good_copy(faults: Any) -> Any:
    """Return the probability that a frame arrives undamaged, once or twice."""
    good = 1 - faults.flip - faults.truncate - faults.wrong_dlc - faults.wrong_id - faults.garbage
    return (1 - faults.loss) * (1 - (1 - good) * (1 - faults.duplicate * good))


def wraps(n: Any, modulus: Any) -> Any:
    """Return how often the counters of all slots together have wrapped."""
    return sum((len(range(slot, n, len(Slot))) - 1) // modulus for slot in Slot)


WRONGS = ("lines that were not sent", "lines delivered twice", "lines delivered out of order")


def classic(n: Any, seed: Any, faults: Any) -> Any:
    """Send each line in four frames of classic CAN."""
    return stream(n, seed, False, faults)


def fd(n: Any, seed: Any, faults: Any) -> Any:
    """Send each line in one frame of CAN FD."""
    return stream(n, seed, True, faults)


def bus(n: Any, seed: Any, faults: Any) -> Any:
    """Send a tenth of the lines over python-can's virtual bus, in computed time."""
    n = max(1, n // 10)
    codec, now = Codec.from_dbc(), 0.0
    decoder, channel = codec.decoder(), f"soak-{uuid.uuid4()}"
    known, delivered, wrong = dict[Any, Any](), set[Any](), Counter[Any]()
    faults = replace(faults, late=0.01, delay=0.002, jitter=0.003, seed=seed)
    sent = received = 0
    with (
        can.Bus(interface="virtual", channel=channel, preserve_timestamps=True) as sender,
        FaultyBus(
            can.Bus(interface="virtual", channel=channel), faults, clock=lambda: now
        ) as receiver,
    ):

        def receive() -> None:
            nonlocal received
            while (message := receiver.recv(0)) is not None:
                received += 1
                result = decoder.feed(
                    message.arbitration_id, bytes(message.data), round(message.timestamp * 1e9)
                )
                if isinstance(result, MapLine):
                    line = known.get(values_of(result))
                    wrong["lines that were not sent"] += line is None
                    wrong["lines delivered twice"] += line in delivered
                    delivered.add(line)

        for start in progress(range(0, n, CHUNK), "virtual bus"):
            chunk = Chunk(codec, start, min(CHUNK, n - start), seed)
            known |= {chunk.expected(start + i): start + i for i in range(len(chunk.payloads))}
            for i, payload in enumerate(chunk.payloads):
                now = (start + i) * STEP_NS * 1e-9
                for frame in codec.frames(payload, Slot((start + i) % len(Slot))):
                    sender.send(message_of(frame, now))
                    sent += 1
                    receive()
                    now += PAGE_NS * 1e-9
        now += 1.0
        receive()
        done = receiver.as_dict()
    accounted = decoder.line_frames + sum(decoder.counts.values()) + decoder.pending
    sums = {
        "frames sent and doubled, less lost, held and received": sent
        + done["duplicated"]
        - done["lost"]
        - done["held"]
        - received,
        "frames received, less those accounted for": received - accounted,
    }
    return {
        "bus time [h]": n * STEP_NS / 3.6e12,
        "lines sent": n,
        "delivered": len(delivered),
        "missing by their counters": decoder.lost,
        "frames": done,
        "dropped by the decoder": {r.name.lower(): c for r, c in decoder.counts.items()},
        **{key: wrong[key] for key in WRONGS[:2]},
        "sums that must be 0": sums,
        "met": not any(wrong.values()) and not any(sums.values()),
    }


def threads(n: Any, seed: Any, faults: Any) -> Any:
    """Send 3000 lines at most in real time: Transmitter, a link with faults, Receiver."""
    codec, channel, received = Codec.from_dbc(), f"soak-{uuid.uuid4()}", list[Any]()
    chunk = Chunk(codec, 0, len(Slot), seed)
    lines = [codec.decode_one(chunk.payloads[slot].tobytes(), slot) for slot in Slot]
    expected = {
        line.slot: values_of(codec.decode_one(b"".join(f.data for f in frames), line.slot))[-2:]  # type: ignore[union-attr]
        for line, frames in zip(lines, Codec.from_dbc().encode_lines(lines), strict=True)  # type: ignore[arg-type]
    }
    count = max(1, min(3000, n) // len(Slot))
    opener = FaultyOpener(replace(faults, seed=seed))
    with (
        Link(interface="virtual", channel=channel) as out,
        Link(opener, interface="virtual", channel=channel) as back,
        Receiver(back, codec.decoder(), on_line=received.append, can_ids=None) as receiver,
    ):
        with (
            Transmitter(out, codec, period=0.01, count=count) as transmitter,
            bar(count, "in real time") as cycles,
        ):
            transmitter.publish(lines)  # type: ignore[arg-type]
            while not transmitter.wait(0.1):
                cycles.update(transmitter.stats().lines // len(Slot) - cycles.n)
        sent, end = transmitter.stats(), time.monotonic() + 60

        def complete() -> Any:
            done = opener.as_dict()
            return done["frames"] >= sent.frames and receiver.stats().frames >= done["passed"]

        while not complete() and time.monotonic() < end:
            time.sleep(0.01)
        receiver.stop()
        stats, done = receiver.stats(), opener.as_dict()
    wrong = sum(values_of(line)[-2:] != expected[line.slot] for line in received)
    sums = {
        "frames sent, less those that came": sent.frames - done["frames"],
        "frames sent and doubled, less lost, held and received": sent.frames
        + done["duplicated"]
        - done["lost"]
        - done["held"]
        - stats.frames,
    }
    return {
        "lines sent": sent.lines,
        "delivered": stats.lines,
        "missing by their counters": stats.lost,
        "frames": done,
        "dropped by the decoder": {r.name.lower(): c for r, c in stats.counts.items()},
        WRONGS[0]: wrong,
        "sums that must be 0": sums,
        "met": not (wrong or any(sums.values())) and 0 < stats.lines <= sent.lines,
    }


def checksum(n: Any, seed: Any, faults: Any) -> Any:  # noqa: ARG001
    """Count the damaged records that CRC-16 does not detect, among four times as many as lines.

    It detects all flips of up to three bits, by the Hamming distance of the code, and all error
    bursts of up to 16 bits (Koopman and Chakravarty, Cyclic Redundancy Code (CRC) Polynomial
    Selection For Embedded Networks, DSN 2004: 0x1021 has distance 4 up to 32751 bits). The checksum
    is at the head of the record, low byte first. An error burst over its end is therefore not a
    burst in the order of the polynomial: at most 2^-16 of these pass, as of random pages.
    """
    n, codec, rng = 4 * n, Codec.from_dbc(), np.random.default_rng([seed, 16])
    size, offset = codec.layout.record_bytes, codec.layout.crc_offset
    pool = Chunk(codec, 0, CHUNK, seed).payloads
    ids = np.array([codec.layout.messages[slot].data_id for slot in Slot])
    checked, passed = Counter[Any](), Counter[Any]()

    def check(what: Any, damaged: Any, good: Any, data_ids: Any) -> None:
        stored = damaged[:, offset] + 256 * damaged[:, offset + 1].astype(int)
        changed = (damaged != good).any(axis=1)
        checked[what] += int(changed.sum())
        passed[what] += int((changed & (stored == record_crc(damaged, data_ids, offset))).sum())

    for start in progress(range(0, n, CHUNK), "checksum"):
        count = min(CHUNK, n - start)
        which = rng.integers(len(pool), size=count)
        good, data_ids = pool[which], ids[which % len(Slot)]
        rows = np.arange(count)
        damaged = good.copy()
        for k in range(3):
            bit = rng.integers(8 * size, size=count)
            hit = rng.integers(3, size=count) >= k
            damaged[rows, bit // 8] ^= (hit << bit % 8).astype(np.uint8)
        check(FLIPS, damaged, good, data_ids)
        bits = np.unpackbits(good, axis=1)
        end = 8 * (offset + CRC_BYTES)  # of the checksum
        over = rng.integers(16, size=count) == 0
        first = np.where(
            over,
            rng.integers(end - 15, end, size=count),
            rng.integers(end, 8 * size - 15, size=count),
        )
        pattern = rng.integers(2, size=(count, 16)).astype(np.uint8)
        for k in range(16):
            bits[rows, first + k] ^= pattern[:, k]
        damaged = np.packbits(bits, axis=1)
        for what, some in ((BURSTS, ~over), (OVER_THE_END, over)):
            check(what, damaged[some], good[some], data_ids[some])
        damaged = good.copy()
        page = rng.integers(size // PAGE_BYTES, size=count)
        places = page[:, None] * PAGE_BYTES + np.arange(PAGE_BYTES)
        damaged[rows[:, None], places] = rng.integers(256, size=places.shape)
        check(GARBAGE, damaged, good, data_ids)
    promised = {what: checked[what] / 2**16 for what in (GARBAGE, OVER_THE_END)}
    most = {what: expected + 5 * max(1, expected) ** 0.5 for what, expected in promised.items()}
    return {
        "records damaged": dict(checked),
        "of good checksum": dict(passed),
        "promised, at most": promised,
        "met": not passed[FLIPS]
        and not passed[BURSTS]
        and all(passed[what] <= most[what] for what in most),
    }


FLIPS, BURSTS = "1 to 3 flipped bits", "bursts of up to 16 bits beside the checksum"
OVER_THE_END, GARBAGE = "bursts over the checksum's end", "a page of random bytes"


def message_of(frame: Any, t: Any) -> Any:
    return can.Message(
        t, frame.can_id, is_extended_id=frame.is_extended, is_fd=frame.is_fd, data=frame.data
    )


def memory_mib() -> Any:
    """Return the memory of the process [MiB]: the present one on Linux, else the maximum."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * resource.getpagesize() / 2**20
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> Any:
    parser = parser_of(__doc__)
    parts = {part.__name__: part for part in (classic, fd, bus, threads, checksum)}
    parser.add_argument("--lines", type=int, default=10**6, help="number of lines; 1e6 by default")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--faults", default=FAULTS, metavar="SPEC", help=f"{FAULTS} by default")
    parser.add_argument("--only", nargs="+", choices=parts, default=list(parts), metavar="PART")
    parser.add_argument("--json", action="store_true", help="print JSON")
    arguments = parser.parse_args()
    if arguments.lines < len(Slot):
        parser.error(f"--lines must be {len(Slot)} or more")
    try:
        faults = Faults.parse(arguments.faults)
    except ValueError as error:
        parser.error(str(error))
    if faults.flood or faults.delay or faults.jitter or faults.depth > CHUNK // 2:
        parser.error(f"--faults must not flood or delay, and depth must be {CHUNK // 2} at most")
    result = {"faults": arguments.faults}
    for name in arguments.only:
        started = time.perf_counter()
        result[name] = parts[name](arguments.lines, arguments.seed, faults)
        result[name]["seconds"] = time.perf_counter() - started
    result["met"] = all(result[name]["met"] for name in arguments.only)
    return report(result, arguments.json, 60)


if __name__ == "__main__":
    sys.exit(main())
