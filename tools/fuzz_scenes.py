"""Targets of the fuzzer for the pose error and the lines that belong to it; see fuzz.py."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from fuzz_targets import (
    MS,
    STEPS,
    TARGETS,
    Bytes,
    check_line,
    outcome_of,
    require,
    valid_record,
)
from scene_layouts import pose_layout_of, raw_record

from maplines_can.generation.vector_sender import VectorSender
from maplines_can.values.line import Slot
from maplines_can.wire import POSE, Codec, Decoder, Frame, Reason, default_dbc_path
from maplines_can.wire.frames import FrameWriter
from maplines_can.wire.layout.packing import Packing
from maplines_can.wire.layout.pose_layout import SCENE, SCENE2, PoseLayout
from maplines_can.wire.layout.record_layout import RecordLayout
from maplines_can.wire.layout.record_signals import LINE, OWN_SIGNALS

#: DBCs with records that are conditional on the pose error, and with complete records.
DBCS = ("maplines-pose.dbc", "maplines.dbc")


class Parts(NamedTuple):
    """Codec of a DBC, and what makes its records."""

    codec: Codec
    packing: Packing
    pose: PoseLayout
    frames: FrameWriter


@cache
def parts_of(dbc: str) -> Parts:
    """Return the codec of a DBC, and what makes its records."""
    codec = Codec.from_dbc(default_dbc_path(dbc))
    layout = codec.layout
    packing = Packing(list(layout.signals.values()), layout.record_bytes)
    return Parts(codec, packing, pose_layout_of(dbc), FrameWriter(layout, None))


def drawn(layout: RecordLayout, content: bytes) -> dict[str, int]:
    """Return raw values in the ranges of all signals, from any bytes."""
    bits = int.from_bytes(content * 2, "little")
    raw = {}
    for name, signal in layout.signals.items():
        bits, value = divmod(bits, signal.raw_max - signal.raw_min + 1)
        raw[name] = signal.raw_min + value
    return raw


def pose_frames(parts: Parts, content: bytes, counters: dict[Any, int], fd: bool) -> list[Frame]:
    """Return the frames of a pose error with any content that states these counters."""
    raw = drawn(parts.pose, content)
    for slot, signal in parts.pose.counters.items():
        raw[signal.name] = counters.get(slot, 0) % 2**signal.length
    record = raw_record(parts.pose, POSE, counters.get(POSE, 0) % 256, raw)
    return parts.frames.write(record, POSE, fd=fd)


def line_frames(parts: Parts, content: bytes, slot: Slot, counter: int, fd: bool) -> list[Frame]:
    """Return the frames of a line with any content that passes all checks of the protection."""
    layout = parts.codec.layout
    if not layout.is_conditional:
        signals = {"ComponentIndex": 0, "ComponentCount": 0, "ComponentWeight": 31}
        record = valid_record(parts.codec, parts.packing, content, slot, counter, **signals)
        return parts.frames.write(record, slot, fd)
    raw = drawn(layout, content)
    if raw["HasCovariance"]:
        raw |= dict.fromkeys(OWN_SIGNALS, 0)
    low, high = (layout[name].physical_one(raw[name]) for name in ("XMin", "XMax"))
    if low >= high:  # an empty range is not written
        raw["XMin"], raw["XMax"] = layout["XMin"].raw_min, layout["XMax"].raw_max
    return parts.frames.write(raw_record(layout, slot, counter, raw), slot, fd)


def scenes(data: bytes) -> Counter[str]:
    """Feed pose errors and lines of any content to a receiver, in order and not.

    Invariants: nothing raises. All frames are counted. Lines and joint covariances are finite and
    positive definite. The lines of a scene are of different slots.
    """
    take = Bytes(data)
    parts = parts_of(DBCS[take.byte() % len(DBCS)])
    counters = Counter[Any]()

    def frames_of(what: int, fd: bool) -> list[Frame]:
        if what <= 2:  # a cycle: the pose error, and the lines whose counters it states
            slots = [slot for slot in Slot if take.byte() & 1 or slot == Slot(what)][:3]
            frames = pose_frames(parts, take.take(32), counters, fd)
            for slot in slots:
                frames += line_frames(parts, take.take(32), slot, counters[slot] % 256, fd)
            counters.update([*slots, POSE])
            return mixed(take, frames)
        if what == 3:  # a pose error alone, with any counters
            wrong = {owner: take.byte() for owner in (POSE, *Slot)}
            return pose_frames(parts, take.take(32), wrong, fd)
        slot, counter = Slot(take.byte() % 8), take.byte()  # a line alone, with any counter
        return line_frames(parts, take.take(32), slot, counter, fd)

    return fed_with(take, parts.codec.decoder(timeout_ms=20.0), frames_of)


@cache
def whole_sender() -> VectorSender:
    """Return what makes records of whole scenes of any content that is not refused."""
    return VectorSender(whole_codec().layout, len(Slot))


@cache
def whole_codec() -> Codec:
    """Return the codec of whole scenes."""
    return Codec.from_dbc(default_dbc_path("maplines-scene.dbc"))


def whole_scenes(data: bytes) -> Counter[str]:
    """Feed whole scenes of any content to a receiver; the same invariants as of ``scenes``."""
    take, sender = Bytes(data), whole_sender()
    counters = Counter[Any]()

    def frame_of(owner: Any, counter: int, raw: dict[str, int] | None = None) -> list[Frame]:
        drawn = random.Random(take.take(8))  # noqa: S311 - no secret
        record = sender.record(
            owner, counter % 256, sender.random_scene(owner, drawn) | (raw or {})
        )
        return sender.frames(owner, record, 0)

    def frames_of(what: int, both: bool) -> list[Frame]:
        if what <= 2:  # a cycle, of one pose error or of two
            pose = sender.ordinary(SCENE) if what else {}
            shared = {name: value for name, value in pose.items() if not name.startswith(LINE)}
            owners = (SCENE2, SCENE) if both else (SCENE,)
            frames = [one for o in owners for one in frame_of(o, counters[SCENE], shared)]
            counters.update([SCENE])
            return mixed(take, frames)
        return frame_of(SCENE if what == 3 else SCENE2, take.byte())

    return fed_with(take, whole_codec().decoder(), frames_of)


def mixed(take: Bytes, frames: list[Frame]) -> list[Frame]:
    """Return the frames of a cycle of which one may be lost, and some come late."""
    order = take.byte()
    lost = order % 16
    frames = frames[order >> 4 :] + frames[: order >> 4]
    return [*frames[:lost], *frames[lost + 1 :]]


def fed_with(
    take: Bytes, state: Decoder, frames_of: Callable[[int, bool], list[Frame]]
) -> Counter[str]:
    """Feed a receiver with the frames of a cycle (0 to 2), or others (3, 4), until no byte is left.

    Between them are steps in time, and frames that come again or damaged.
    """
    t_ns, outcomes = 0, Counter[str]()
    fed: list[tuple[int, bytes]] = []

    def feed(can_id: int, payload: bytes) -> None:
        answer = state.feed(can_id, payload, t_ns)
        fed.append((can_id, payload))
        check_counts(state, len(fed))
        for line in () if isinstance(answer, Reason) else answer:
            check_line(line)
        outcomes[outcome_of(answer)] += 1

    while take.left > 0:
        op = take.byte()
        t_ns += STEPS[op >> 4 & 3]
        what, fd = op & 7, bool(op & 8)
        if what <= 4:
            for frame in frames_of(what, fd):
                feed(frame.can_id, frame.data)
        elif what == 5:  # a step in time, forward or backward
            t_ns += int.from_bytes(take.take(2), "little", signed=True) * MS
        elif what == 6 and fed:  # an earlier frame, unchanged or with a flipped bit
            can_id, payload = fed[-1 - take.byte() % len(fed)]
            if op & 8 and payload:
                bit = take.byte() % (8 * len(payload))
                flipped = bytearray(payload)
                flipped[bit // 8] ^= 1 << bit % 8
                payload = bytes(flipped)
            feed(can_id, payload)
        elif what == 7:
            state.expire(t_ns)
            check_counts(state, len(fed))
        outcomes["scene"] += check_scene(state, t_ns)
    state.expire(t_ns + 10**18)
    check_counts(state, len(fed))
    require(state.pending == 0, f"{state.pending} frames stay pending")
    return outcomes


def check_counts(state: Decoder, frames: int) -> None:
    """Check that each frame is part of a line or pose error, dropped with a reason, or pending."""
    total = state.line_frames + state.pose_frames + sum(state.counts.values()) + state.pending
    require(state.frames == frames == total, f"{frames} frames fed, {total} accounted for")
    require(min(state.counts.values(), default=0) >= 0, "a count is negative")


def check_scene(state: Decoder, t_ns: int) -> bool:
    """Check the newest scene; return whether there is one with lines."""
    scene = state.latest_scene(t_ns).scene
    if scene is None or not scene.lines:
        return False
    require(len(scene.index) == len(scene.lines), "a slot is twice in a scene")
    require(np.isfinite(scene.cov).all(), "the joint covariance is not finite")
    sigma = np.sqrt(scene.cov.diagonal())
    require((sigma > 0).all(), f"the sigmas of the joint are {sigma}")
    least = np.linalg.eigvalsh(scene.cov / sigma / sigma[:, None])[0]
    require(least > -1e-12, f"the joint covariance is not positive definite: {least:g}")
    for line in scene.lines:
        check_line(line)
    return True


#: All targets of the fuzzer.
ALL_TARGETS: dict[str, Callable[[bytes], Counter[str]]] = {
    **TARGETS,
    "scenes": scenes,
    "whole-scenes": whole_scenes,
}
