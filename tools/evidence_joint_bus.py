#!/usr/bin/env python3
"""Count wrong joints of scenes that pass a faulty bus: lines of one cycle, pose error of another.

    evidence_joint_bus.py epochs -n 1000000    frames, counters and epochs, with numbered records
    evidence_joint_bus.py chain -n 10000       the whole chain, each joint covariance checked
    evidence_joint_bus.py limits -n 100000     as epochs, with delays of 2 to 12 cycles

Run it in the environment of the project: python3 tools/run.py python tools/evidence_joint_bus.py

Frames are lost, duplicated, swapped, delayed and damaged. Whole pose errors and whole lines are
lost or delayed, slots come and go, the sender is silent at times and restarts from 0. In each
record is the number of its cycle, so that the receiver's scenes can be checked: all lines of a
scene must have the number of its pose error. The exit status is 1 if one has not, or if a joint
covariance does not cover that of the scene as sent. ``limits`` only reports: beyond the delay that
``EpochAssembler`` states, wrong joints are possible.
"""

from __future__ import annotations

import heapq
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from fuzz_targets import valid_record
from reporting import bar, parser_of, report

from maplines_can import Codec, Gaussian, Kind, MapError, MapLine, Polyline, Scene, Slot, map_scene
from maplines_can.testing import FaultInjector, Faults
from maplines_can.wire import POSE, Decoder, Frame, Owner, default_dbc_path
from maplines_can.wire.layout.packing import Packing
from maplines_can.wire.layout.signals import SLOT_SIGNALS, slot_title
from maplines_can.wire.records.frames import FrameWriter
from maplines_can.wire.records.pose_records import (
    ConditionalRecord,
    ConditionalRecords,
    PoseRecord,
    PoseRecords,
    absent_counter,
)

PERIOD, FRAME = 0.05, 0.00025  #: [s]
SLOTS = (Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.ROUTE)
#: Cycles of one run: with one kind of faults and one receiver.
RUN = 2000
#: Numbers of cycles in a record, and different scenes of ``chain``.
NUMBERS, SCENES = 2**15, 24
CONDITIONAL, COMPLETE = "maplines-pose.dbc", "maplines.dbc"
CARRIERS = {"conditional": CONDITIONAL, "full records": COMPLETE}


class Disturbance(NamedTuple):
    """Kind of faults."""

    name: str
    frames: str  #: faults of frames
    lost: float = 0.0  #: share of records that are lost
    late: float = 0.0  #: share of records that are late
    delay: tuple[float, float] = (0.0, 0.0)  #: of a late record [cycles]
    restarts: bool = False


DISTURBANCES = (
    Disturbance("undisturbed", "seed=1"),
    Disturbance("frames lost", "loss=0.05"),
    Disturbance("frames lost, duplicated and swapped", "loss=0.02,dup=0.05,reorder=0.05,depth=6"),
    Disturbance("frames damaged", "flip=0.03,garbage=0.02,wrong_id=0.03,truncate=0.02"),
    Disturbance("frames late", "loss=0.02,late=0.1,delay=0.001,jitter=0.04"),
    Disturbance("records lost", "loss=0.001", lost=0.3),
    Disturbance(
        "records late by up to 0.9 cycles", "loss=0.01", lost=0.1, late=0.3, delay=(0, 0.9)
    ),
    Disturbance(
        "records late by up to 1.8 cycles", "loss=0.01", lost=0.1, late=0.2, delay=(0, 1.8)
    ),
    Disturbance("restarts", "loss=0.02,dup=0.02", lost=0.1, late=0.1, delay=(0, 1), restarts=True),
)
LIMITS = tuple(
    Disturbance(f"records late by {low} to {high} cycles", "seed=1", 0.2, 0.2, (low, high))
    for low, high in ((2, 4), (4, 8), (8, 12))
)


@dataclass
class Source:
    """Sender of cycles with the number of the cycle in each record."""

    #: Frames of the records of a cycle, by number, slots and counters.
    write: Callable[[int, Sequence[Slot], Counter[Owner]], dict[Owner, list[Frame]]]
    rng: np.random.Generator
    disturbance: Disturbance
    sent: int = 0

    def arrivals(self, first: int, cycles: int) -> Iterator[tuple[float, Frame]]:
        """Yield times [s] and frames of so many cycles as they arrive."""
        counters: Counter[Owner] = Counter()
        one, rng = self.disturbance, self.rng
        seeded = f"{one.frames},seed={int(rng.integers(2**31))}"
        injector = FaultInjector[Any](Faults.parse(seeded.replace("seed=1,", "")))
        waiting: list[tuple[float, int, Frame]] = []
        slots, silent_until, order = list(SLOTS), 0, 0
        for cycle in range(cycles):
            at = cycle * PERIOD
            if rng.random() < 0.05:  # slots come and go
                slots = [slot for slot in SLOTS if rng.random() < 0.7]
            if rng.random() < 0.005:
                silent_until = cycle + int(rng.integers(1, 30))
            if one.restarts and rng.random() < 0.01:
                counters.clear()
                silent_until = cycle + int(rng.choice([0, 0, 2, 25]))
            if cycle < silent_until:
                continue
            self.sent += 1
            for own in self.write(first + cycle, slots, counters).values():
                late = rng.uniform(*one.delay) * PERIOD if rng.random() < one.late else 0.0
                if rng.random() >= one.lost:
                    for frame in own:
                        order += 1
                        heapq.heappush(waiting, (at + late, order, frame))
                        at += FRAME
            while waiting and waiting[0][0] < (cycle + 1) * PERIOD:
                now, _, frame = heapq.heappop(waiting)
                for out in injector.apply(frame, now):
                    yield now, out


class NumberedRecords:
    """Records that are made once, with the number of the cycle in place of some raw values."""

    def __init__(self, dbc: str = CONDITIONAL) -> None:
        codec = codec_of(dbc)
        pose = codec.layout.pose
        if pose is None:
            raise ValueError(f"{dbc} has no message of the pose error")
        scene = road_scene(0)
        prepared = codec.prepare_scene(scene)
        self._pose_raw = {**prepared.encoded.pose, "Age": 1}
        self._poses, self._frames = PoseRecords(pose), FrameWriter(codec.layout, None)
        self._codec, self._c0 = codec, codec.layout["C0"]
        self._line_raw = dict(prepared.encoded.lines[0])
        self._lines: ConditionalRecords | None = None
        self._template: tuple[Packing, bytes] | None = None  # of complete records
        if codec.layout.is_conditional:
            self._lines = ConditionalRecords(codec.layout)
        else:
            levels = (f"{slot_title(slot)}{name}" for slot in Slot for name in SLOT_SIGNALS)
            self._pose_raw |= dict.fromkeys(levels, 0)
            packing = Packing(list(codec.layout.signals.values()), codec.layout.record_bytes)
            (frame,) = codec.encode(scene.lines[0], fd=True)
            self._template = packing, frame.data

    def write(
        self, number: int, slots: Sequence[Slot], counters: Counter[Owner]
    ) -> dict[Owner, list[Frame]]:
        """Return the frames of a cycle, and advance the counters."""
        number %= NUMBERS
        stated = {
            slot: counters[slot] % 8
            if slot in slots
            else absent_counter(counters[slot] - 1, counters[slot], 3)
            for slot in Slot
        }
        raw = self._pose_raw | {"PivotAlong": number % 512, "PivotAcross": number // 512}
        pose = self._poses.write(PoseRecord(raw, counters[POSE] % 256, stated))
        frames: dict[Owner, list[Frame]] = {POSE: self._frames.write_pose(pose, False)}
        for slot in slots:
            record = self._record(slot, counters[slot] % 256, number - NUMBERS // 2)
            frames[slot] = self._frames.write(record, slot, False)
        for owner in frames:
            counters[owner] += 1
        return frames

    def _record(self, slot: Slot, counter: int, c0: int) -> bytes:
        """Return the record of a line with a raw value of C0."""
        if self._lines is not None:
            line = ConditionalRecord(self._line_raw | {"C0": c0}, counter, Kind.SOLID, slot)
            return self._lines.write(line)
        if self._template is None:
            raise ValueError("the records are neither conditional nor complete")
        packing, template = self._template
        return valid_record(self._codec, packing, template, slot, counter, C0=c0)

    def _number(self, content: Any) -> int:
        """Return the number in a line: a conditional record, or a line of a complete one."""
        if isinstance(content, MapLine):
            c0 = int(self._c0.raw(content.gaussian.mean[2]))
        else:
            c0 = content.raw["C0"]
        return c0 + NUMBERS // 2

    def decoder(self) -> Any:
        """Return a decoder whose scenes are the numbers of their records."""
        decoder: Any = self._codec.decoder()
        decoder._scenes._reader = self  # noqa: SLF001 - no arithmetic
        return decoder

    def scene(self, pose: PoseRecord, t_ns: int, members: Sequence[Any]) -> Any:
        """Return the numbers of a scene; called by the receiver of scenes."""
        number = pose.raw["PivotAlong"] + 512 * pose.raw["PivotAcross"]
        numbers = [self._number(one.content) for one in members]
        lines = [SimpleNamespace(slot=one.content.slot) for one in members]
        return SimpleNamespace(number=number, numbers=numbers, lines=lines, t_ns=t_ns)

    def age(self, pose: PoseRecord) -> float:
        """Return the age of a pose error; called by the receiver of scenes."""
        return float(pose.raw["Age"])

    def check(self, scene: Any) -> Counter[str]:
        """Return the faults of a scene."""
        return Counter(wrong_joints=any(one != scene.number for one in scene.numbers))


class WholeChain:
    """Scenes that differ in pose error and lines, encoded and decoded as on any bus."""

    def __init__(self, dbc: str, *, fd: bool) -> None:
        self._codec, self._fd = codec_of(dbc), fd
        self._scenes: list[dict[tuple[Slot, ...], tuple[Scene, Any]]] = [{} for _ in range(SCENES)]

    def write(
        self, number: int, slots: Sequence[Slot], counters: Counter[Owner]
    ) -> dict[Owner, list[Frame]]:
        """Return the frames of a cycle, and advance the counters."""
        known, key = self._scenes[number % SCENES], tuple(slots)
        if key not in known:
            scene = road_scene(number % SCENES, key)
            known[key] = scene, self._codec.prepare_scene(scene, fd=self._fd)
        frames = self._codec.encode_scene(known[key][1], fd=self._fd, counters=counters)
        for owner in frames:
            counters[owner] += 1
        return frames

    def decoder(self) -> Decoder:
        """Return a decoder."""
        return self._codec.decoder()

    def check(self, scene: Scene) -> Counter[str]:
        """Return the faults of a scene: the cycle that it comes from is that of its pose error."""
        number = scene_number(float(scene.pose_error.cov[0, 0]) ** 0.5)
        if any(
            round((line.gaussian.mean[0] - offset(line.slot)) / STEP) != number
            for line in scene.lines
        ):
            return Counter(wrong_joints=1)
        slots = tuple(scene.index)
        sent = next(one for key, (one, _) in self._scenes[number].items() if {*slots} <= {*key})
        true, found = sent.joint(slots), scene.joint()
        d = found.mean - true.mean
        scale = 1 / np.sqrt(found.cov.diagonal())
        margin = (found.cov - true.cov - np.outer(d, d)) * np.outer(scale, scale)
        definite = np.linalg.eigvalsh(found.cov * np.outer(scale, scale))[0] > 0
        return Counter(overconfident=np.linalg.eigvalsh(margin)[0] < -1e-9, indefinite=not definite)


#: Shift of the lines from cycle to cycle [m], ratio of the pose errors, and the least of them [m].
STEP, RATIO, LEAST = 0.02, 1.06, 0.1


def offset(slot: int) -> float:
    """Return the lateral offset of a slot [m]."""
    return {Slot.EGO_LEFT: 1.75, Slot.EGO_RIGHT: -1.75, Slot.ROUTE: 0.0}[Slot(slot)]


def scene_number(sigma_along: float) -> int:
    """Return the number of a scene by its pose error; codes round this up by less than a step."""
    return round(np.log(sigma_along / LEAST) / np.log(RATIO) - 0.25)


def road_scene(number: int, slots: Sequence[Slot] = SLOTS) -> Scene:
    """Return the scene of a number, which shows in its pose error and in its lines."""
    x = np.arange(-100.0, 200.0, 10.0)
    shift = number * STEP
    lines = {
        slot: Polyline(np.column_stack([x, np.full_like(x, offset(slot) + shift)]))
        for slot in slots
    }
    pose = Gaussian([0, 0, 0], np.diag([LEAST * RATIO**number, 0.2, 0.004]) ** 2)
    error = MapError(point_sigma=0.05, offset_sigma=0.05, heading_sigma=0.001)
    if not lines:
        known = map_scene({SLOTS[0]: Polyline([[-100, 0], [200, 0]])}, pose)
        return Scene((), np.zeros((0, 0)), known.pose_error, np.zeros((0, 2)))
    return map_scene(lines, pose, map_error=error)


def codec_of(dbc: str) -> Codec:
    """Return the codec of one of the project's DBCs."""
    return Codec.from_dbc(default_dbc_path(dbc))


def over_the_bus(
    chain: Any, disturbance: Disturbance, cycles: int, seed: Sequence[int], counts: Counter[str]
) -> None:
    """Send cycles over a faulty bus, and add what came of them to the counts."""
    source = Source(chain.write, np.random.default_rng(seed), disturbance)
    decoder, last = chain.decoder(), None
    checked: tuple[int, int] | None = None
    for at, frame in source.arrivals(int(seed[-1]) * 977, cycles):
        decoder.feed(frame.can_id, frame.data, round(at * 1e9), is_extended=frame.is_extended)
        received = decoder.scene()
        key = None if received is None else (received.t_ns, len(received.scene.lines))
        if received is not None and key != checked and received.scene.lines:
            counts["joints"] += 1
            counts["scenes"] += received.t_ns != last
            counts.update(chain.check(received.scene))
            last, checked = received.t_ns, key
    counts["cycles sent"] += source.sent
    counts["frames"] += decoder.frames
    counts["lines"] += decoder.lines
    known = decoder.line_frames + decoder.pose_frames + sum(decoder.counts.values())
    counts["frames not accounted for"] += decoder.frames - known - decoder.pending
    counts["lines dropped without pose error"] += sum(
        n for reason, n in decoder.counts.items() if reason.name == "POSE"
    )


def measure(
    chains: dict[str, Any], disturbances: Sequence[Disturbance], n: int, seed: int
) -> dict[str, Any]:
    """Return the counts of n cycles, by kind of faults."""
    result: dict[str, Any] = {}
    run = min(RUN, max(1, n // (len(disturbances) * len(chains))))
    total: Counter[str] = Counter()
    groups = [(name, one) for name in chains for one in disturbances]
    counts = [Counter[str]() for _ in groups]
    number = 0
    with bar(n) as shown:
        while total["cycles"] < n:
            group = number % len(groups)
            name, one = groups[group]
            over_the_bus(chains[name], one, run, [seed, number], counts[group])
            number += 1
            total["cycles"] += run
            shown.update(run)
    for (name, one), found in zip(groups, counts, strict=True):
        result[f"{name}: {one.name}"] = dict(found)
        total.update(found)
    bad = ("wrong_joints", "overconfident", "indefinite", "frames not accounted for")
    sums = {name: total[name] for name in ("cycles", "cycles sent", "scenes", "joints", *bad)}
    return result | {"sum": sums, "met": not any(total[name] for name in bad)}


def main() -> int:
    """Run the command and return its exit status."""
    parser = parser_of(__doc__)
    parser.add_argument("what", choices=("epochs", "chain", "limits"))
    parser.add_argument("-n", type=int, help="number of cycles; by default 1e6, 1e4 and 1e5")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="print JSON")
    arguments = parser.parse_args()
    n = arguments.n or {"epochs": 10**6, "chain": 10**4, "limits": 10**5}[arguments.what]
    started = time.perf_counter()
    if arguments.what == "chain":
        chains: dict[str, Any] = {
            name: WholeChain(dbc, fd=dbc == COMPLETE) for name, dbc in CARRIERS.items()
        }
    else:
        chains = {name: NumberedRecords(dbc) for name, dbc in CARRIERS.items()}
    disturbances = LIMITS if arguments.what == "limits" else DISTURBANCES
    result = measure(chains, disturbances, n, arguments.seed)
    if arguments.what == "limits":
        result["met"] = True
    result["seconds"] = time.perf_counter() - started
    return report(result, arguments.json, 44)


if __name__ == "__main__":
    sys.exit(main())
