"""Wrong joints of scenes that pass a faulty bus: lines of one cycle, pose error of another.

Frames are lost, duplicated, swapped, delayed and damaged. Whole pose errors and whole lines are
lost or delayed, slots come and go, the sender is silent at times and restarts from 0. The pose
error and the lines of a cycle show its number, so that the receiver's scenes can be checked: all
lines of a scene must have the number of its pose error.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from maplines_can import Gaussian, MapError, Polyline, Scene, Slot, map_scene
from maplines_can.testing import FaultInjector, Faults
from maplines_can.wire import Frame, Owner

from .harness import evidence, progress
from .transfer import codec_of

PERIOD, FRAME = 0.05, 0.00025  #: [s]
#: Slots with their lateral offsets [m]; whole scenes have all, so that both messages have lines.
OFFSETS = {
    Slot.EGO_LEFT: 1.75, Slot.EGO_RIGHT: -1.75, Slot.ROUTE: 0.0,
    Slot.NEXT_LEFT: 5.25, Slot.EDGE_LEFT: 8.0, Slot.EDGE_RIGHT: -4.0,
}  # fmt: skip
MANY = tuple(OFFSETS)
SLOTS = MANY[:3]
#: Cycles of one run: with one kind of faults and one receiver.
RUN = 500
#: Different scenes. It has no common divisor with the range of a counter, so that records of equal
#: counters are of different scenes.
SCENES = 23
#: DBC by kind of records, whether it is used with CAN FD, and slots.
CARRIERS = {
    "conditional": ("maplines-pose.dbc", False, SLOTS),
    "complete": ("maplines.dbc", True, SLOTS),
    "whole": ("maplines-scene.dbc", True, MANY),
}
#: Shift of the lines from cycle to cycle [m], ratio of the pose errors, and the least of them [m].
STEP, RATIO, MIN_SIGMA = 0.02, 1.06, 0.1


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


@evidence
def epochs(n: int = 30_000, beyond: bool = False, seed: int = 0) -> dict[str, Any]:
    """Send n cycles of scenes over a faulty bus, and check each joint that is received.

    Args:
        n: number of cycles.
        beyond: delay records by more than the receiver is for, 2 to 12 cycles.
        seed: of the faults.
    """
    chains = {name: WholeChain(dbc, slots, fd=fd) for name, (dbc, fd, slots) in CARRIERS.items()}
    kinds = [*product(chains, LIMITS if beyond else DISTURBANCES)]
    run = min(RUN, max(1, n // len(kinds)))
    counts = {f"{name}: {faults.name}": Counter[str]() for name, faults in kinds}
    for number in progress(range(-(-n // run)), "runs"):
        name, faults = kinds[number % len(kinds)]
        over_the_bus(chains[name], faults, run, [seed, number], counts[f"{name}: {faults.name}"])
    every = counts | {"all": sum(counts.values(), Counter[str]())}
    return {name: {**dict.fromkeys(WRONG, 0), **of} for name, of in every.items()}


#: Faults of the receiver.
WRONG = ("wrong joints", "overconfident", "indefinite", "frames not accounted for")


def over_the_bus(
    chain: WholeChain, faults: Disturbance, cycles: int, seed: Sequence[int], counts: Counter[str]
) -> None:
    """Send cycles over a faulty bus, and add what came of them to the counts.

    A scene is checked when it is the newest one, and again when a late line joins it.
    """
    decoder, last, rng = chain.codec.decoder(), None, np.random.default_rng(seed)
    checked: tuple[int, int] | None = None
    for at, frame in arrivals(chain, faults, rng, int(seed[-1]) * 977, cycles, counts):
        decoder.feed(frame.can_id, frame.data, round(at * 1e9), is_extended=frame.is_extended)
        received = decoder.scene()
        key = None if received is None else (received.t_ns, len(received.scene.lines))
        if received is not None and key != checked and received.scene.lines:
            counts["joints"] += 1
            counts["scenes"] += received.t_ns != last
            counts.update(chain.check(received.scene))
            last, checked = received.t_ns, key
    counts["lines"] += decoder.lines
    known = decoder.line_frames + decoder.pose_frames + sum(decoder.counts.values())
    counts["frames not accounted for"] += decoder.frames - known - decoder.pending


def arrivals(
    chain: WholeChain,
    faults: Disturbance,
    rng: np.random.Generator,
    first: int,
    cycles: int,
    counts: Counter[str],
) -> Iterator[tuple[float, Frame]]:
    """Yield times [s] and frames of so many cycles as they arrive, with their number in each."""
    counters: Counter[Owner] = Counter()
    seeded = f"{faults.frames},seed={int(rng.integers(2**31))}"
    injector = FaultInjector[Any](Faults.parse(seeded.replace("seed=1,", "")))
    waiting: list[tuple[float, int, Frame]] = []
    slots, silent_until, order = list(chain.slots), 0, 0
    for cycle in range(cycles):
        at = cycle * PERIOD
        if rng.random() < 0.05:  # slots come and go
            slots = [slot for slot in chain.slots if rng.random() < 0.7]
        if rng.random() < 0.005:
            silent_until = cycle + int(rng.integers(1, 30))
        if faults.restarts and rng.random() < 0.01:
            counters.clear()
            silent_until = cycle + int(rng.choice([0, 0, 2, 25]))
        if cycle < silent_until:
            continue
        counts["cycles sent"] += 1
        for own in chain.write(first + cycle, slots, counters).values():
            late = rng.uniform(*faults.delay) * PERIOD if rng.random() < faults.late else 0.0
            if rng.random() >= faults.lost:
                for frame in own:
                    order += 1
                    heapq.heappush(waiting, (at + late, order, frame))
                    at += FRAME
        while waiting and waiting[0][0] < (cycle + 1) * PERIOD:
            now, _, frame = heapq.heappop(waiting)
            for out in injector.apply(frame, now):
                yield now, out


class WholeChain:
    """Scenes that differ in pose error and lines, encoded and decoded as on any bus."""

    def __init__(self, dbc: str, slots: Sequence[Slot], *, fd: bool) -> None:
        self.codec, self._fd = codec_of(dbc), fd
        #: Of the lines that it sends.
        self.slots = slots
        self._scenes: list[dict[tuple[Slot, ...], tuple[Scene, Any]]] = [{} for _ in range(SCENES)]

    def write(
        self, number: int, slots: Sequence[Slot], counters: Counter[Owner]
    ) -> dict[Owner, list[Frame]]:
        """Return the frames of a cycle, and advance the counters."""
        known, key = self._scenes[number % SCENES], tuple(slots)
        if key not in known:
            scene = road_scene(number % SCENES, key)
            known[key] = scene, self.codec.encoder().prepare_scene(scene, fd=self._fd)
        frames = self.codec.encoder().encode_scene(known[key][1], fd=self._fd, counters=counters)
        for owner in frames:
            counters[owner] += 1
        return frames

    def check(self, scene: Scene) -> Counter[str]:
        """Return the faults of a scene: the cycle that it comes from is that of its pose error."""
        number = scene_number(float(scene.pose_error.cov[0, 0]) ** 0.5)
        if any(
            round((line.gaussian.mean[0] - OFFSETS[Slot(line.slot)]) / STEP) != number
            for line in scene.lines
        ):
            return Counter({"wrong joints": 1})
        slots = tuple(scene.index)
        sent = next(one for key, (one, _) in self._scenes[number].items() if {*slots} <= {*key})
        true, found = sent.joint(slots), scene.joint()
        d = found.mean - true.mean
        scale = 1 / np.sqrt(found.cov.diagonal())
        margin = (found.cov - true.cov - np.outer(d, d)) * np.outer(scale, scale)
        definite = np.linalg.eigvalsh(found.cov * np.outer(scale, scale))[0] > 0
        return Counter(overconfident=np.linalg.eigvalsh(margin)[0] < -1e-9, indefinite=not definite)


def scene_number(sigma_along: float) -> int:
    """Return the number of a scene by its pose error; codes round this up by less than a step."""
    return round(np.log(sigma_along / MIN_SIGMA) / np.log(RATIO) - 0.25)


def road_scene(number: int, slots: Sequence[Slot] = SLOTS) -> Scene:
    """Return the scene of a number, which shows in its pose error and in its lines."""
    x = np.arange(-100.0, 200.0, 10.0)
    shift = number * STEP
    lines = {
        slot: Polyline(np.column_stack([x, np.full_like(x, OFFSETS[slot] + shift)]))
        for slot in slots
    }
    pose = Gaussian([0, 0, 0], np.diag([MIN_SIGMA * RATIO**number, 0.2, 0.004]) ** 2)
    error = MapError(point_sigma=0.05, offset_sigma=0.05, heading_sigma=0.001)
    if not lines:
        known = map_scene({SLOTS[0]: Polyline([[-100, 0], [200, 0]])}, pose)
        return Scene((), np.zeros((0, 0)), known.pose_error, np.zeros((0, 2)))
    return map_scene(lines, pose, map_error=error)
