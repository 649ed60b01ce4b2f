"""Scenes to frames in C: the same bytes, reasons and counters as in Python."""

import struct
from collections.abc import Iterator
from typing import Any, NamedTuple

import c_core
import numpy as np
import pytest
from evidence.roads import SHAPES, random_scene
from evidence.witness import POSES, Poses
from scene_layouts import layout_of
from scene_streams import road_scene

from maplines_can import (
    Codec,
    Gaussian,
    Kind,
    MapError,
    MapLine,
    Polyline,
    PoseError,
    Scene,
    Slot,
    Status,
    map_scene,
)
from maplines_can.values.errors import EncodeError, IllPosedError
from maplines_can.values.line import LeftOut
from maplines_can.wire import POSE

CONDITIONAL, COMPLETE = "maplines-pose.dbc", "maplines.dbc"
OWNERS = (*Slot, POSE)
#: Numbers of maplines_left_out_t and of maplines_refusal_t.
LEFT_OUT = {LeftOut.ACROSS: 1, LeftOut.RANGE: 2, LeftOut.MEAN: 3, LeftOut.COVARIANCE: 4}
BAD_POSE, UNSEEN = 16, 17
ERRORS = (None, MapError(0.05, 0.05), MapError(0.05, 0.05, 0.001), MapError(offset_sigma=0.3))
AGES = (0.0, 0.004, 0.0205, np.inf)


class Case(NamedTuple):
    """A scene that a sender with these counters sends."""

    scene: Scene
    counters: dict[Any, int]
    age: float
    is_fd: bool


class Sent(NamedTuple):
    """What is sent of a scene."""

    refusal: int
    left_out: list[int]  #: by line; 0 if it is in the scene
    is_sent: list[bool]  #: by line
    counters: list[int]  #: by owner
    frames: list[tuple[int, bool, bool, bytes]]  #: CAN ID, extended, CAN FD, data


def input_of(case: Case) -> bytes:
    """A case as c/tests/scene_encode_harness.c reads it."""
    scene, error = case.scene, case.scene.map_error
    n, specific = len(scene.lines), scene.specific_covs
    parts = [struct.pack("<B9I", case.is_fd, *(case.counters[owner] for owner in OWNERS))]
    parts.append(struct.pack("<B", n))
    for line, fit_range, quartic in zip(scene.lines, scene.fit_ranges, scene.quartics, strict=True):
        values = (line.x_min, line.x_max, case.age, *line.gaussian.mean, *fit_range, quartic)
        parts.append(struct.pack("<3B10d", line.slot, line.kind, line.status, *values))
    parts.append(struct.pack("<B", specific is not None))
    for array in (() if specific is None else specific, scene.cov, scene.pose_error.cov):
        parts.append(np.asarray(array, dtype="<f8").tobytes())
    of_map = (error.offset_sigma, error.heading_sigma) if error else (0.0, 0.0)
    parts.append(struct.pack("<4d", case.age, scene.pose_error.correlation_time, *of_map))
    return b"".join(parts)


def in_c(dbc: str, cases: list[Case], **how: Any) -> list[Sent]:
    """What the C core sends."""
    output = c_core.run(
        c_core.harness("scene_encode", layout_of(dbc), **how), b"".join(map(input_of, cases))
    )
    view, at = memoryview(output), 0

    def read(form: str) -> tuple[Any, ...]:
        nonlocal at
        values = struct.unpack_from(form, view, at)
        at += struct.calcsize(form)
        return values

    sent = []
    for case in cases:
        (refusal,) = read("<B")
        lines = [read("<3B") for _ in case.scene.lines]
        counters = list(read("<9I"))
        frames = []
        for _ in range(read("<H")[0]):
            can_id, is_extended, is_fd, length = read("<I3B")
            frames.append((can_id, bool(is_extended), bool(is_fd), bytes(view[at : at + length])))
            at += length
        left_out, is_sent = [line[0] for line in lines], [bool(line[1]) for line in lines]
        sent.append(Sent(refusal, left_out, is_sent, counters, frames))
    assert at == len(output)
    return sent


def in_python(codec: Codec, case: Case) -> Sent:
    """What the Python package sends."""
    encoder, lines = codec.encoder(), case.scene.lines
    try:
        prepared = encoder.prepare_scene(case.scene, fd=case.is_fd)
    except (EncodeError, IllPosedError) as error:
        refusal = BAD_POSE if isinstance(error, EncodeError) else UNSEEN
        nothing = [0] * len(lines)
        return Sent(refusal, nothing, [False] * len(lines), [*case.counters.values()], [])
    frames = encoder.encode_scene(prepared, age=case.age, fd=case.is_fd, counters=case.counters)
    left_out = [0] * len(lines)
    for place, reason in prepared.encoded.left_out.items():
        left_out[place] = LEFT_OUT[reason]
    modulus = 2 ** codec.layout["Counter"].length
    pose_modulus = 2 ** codec.layout.pose["Counter"].length if codec.layout.pose else 1
    counters = [
        (n + (owner in frames)) % (pose_modulus if owner == POSE else modulus)
        if owner in frames
        else n
        for owner, n in case.counters.items()
    ]
    of_lines = [line.slot in prepared.sent_slots for line in lines]
    flat = [(f.can_id, f.is_extended, f.is_fd, f.data) for own in frames.values() for f in own]
    return Sent(0, left_out, of_lines, counters, flat)


def case_of(scene: Scene, rng: Any, dbc: str) -> Case:
    """A case with random counters and ages."""
    layout = layout_of(dbc)
    bits = {owner: layout["Counter"].length for owner in Slot} | {
        POSE: layout.pose["Counter"].length if layout.pose else 0
    }
    counters = {owner: int(rng.integers(2 ** bits[owner])) for owner in OWNERS}
    return Case(scene, counters, float(rng.choice(AGES)), bool(rng.integers(2)))


def on_roads(numbers: range) -> Iterator[Scene]:
    """Scenes of random roads, seen from production poses and from poor ones."""
    for number in numbers:
        rng = np.random.default_rng(number)
        road = random_scene(list(SHAPES)[number % len(SHAPES)], rng, int(rng.integers(1, 9)))
        sigma = POSES[list(POSES)[number // len(SHAPES) % 2]]
        poses = Poses.about(road.pose, sigma, 0, rng)
        yield map_scene(
            {slot: Polyline(points) for slot, points in road.lines.items()},
            Gaussian(road.pose, poses.cov),
            map_error=ERRORS[rng.integers(len(ERRORS))],
            correlation_time=float(rng.choice([0.3, 4.0, np.inf])),
        )


def gaussians(numbers: range) -> Iterator[Scene]:
    """Scenes of random Gaussians, from tiny to huge; lines across the axis or out of range."""
    for number in numbers:
        rng = np.random.default_rng(number)
        n = int(rng.integers(0, 9))
        size, wide = 10 ** rng.uniform(-2, 1.2), 10 ** rng.uniform(-3, 1.5)
        means = size * rng.standard_normal((n, 4)) * [5, 0.2, 5e-3, 2e-5]
        sigma = np.tile([0.3, 5e-3, 2e-4, 5e-6], n)
        A = wide * sigma[:, None] * rng.standard_normal((4 * n, int(rng.integers(1, 8))))
        own = (0.3 * wide * sigma * 10 ** rng.uniform(-3, 1, 4 * n)) ** 2
        cov = A @ A.T + np.diag(own)
        cov = (cov + cov.T) / 2
        rank = int(rng.integers(1, 4))
        B = 10 ** rng.uniform(-2, 1) * np.array([[0.1], [0.2], [0.004]])
        B = B * rng.standard_normal((3, rank))
        low = rng.uniform(-150, 120, n)
        ends = np.column_stack([low, low + 10 ** rng.uniform(0, 2.3, n)])
        specific = None
        if rng.integers(2):
            specific = np.array([np.diag(own[4 * i : 4 * i + 4]) for i in range(n)]).reshape(
                -1, 4, 4
            )
        lines = tuple(
            MapLine(
                slot,
                Gaussian(means[i], cov[4 * i : 4 * i + 4, 4 * i : 4 * i + 4]),
                Kind(int(rng.integers(8))),
                x_min=float(ends[i, 0]),
                x_max=float(ends[i].mean() if rng.integers(2) else ends[i, 1]),
                status=Status(int(rng.choice([0, 1, 1, 1, 2, 3, 4]))),
            )
            for i, slot in enumerate(rng.permutation(list(Slot))[:n])
        )
        yield Scene(
            lines,
            cov,
            PoseError(B @ B.T, float(rng.choice([0.01, 1.0, 1e9, np.inf]))),
            ends,
            ERRORS[rng.integers(len(ERRORS))],
            quartics=np.where(rng.integers(0, 2, n), rng.uniform(-0.5, 0.5, n), 0.0),
            specific_covs=specific,
        )


def awkward() -> Iterator[Scene]:
    """Scenes at the limits: no lines, no pose error, bends, pose errors without limit."""
    yield Scene((), np.zeros((0, 0)), PoseError(np.zeros((3, 3))), np.zeros((0, 2)))
    for sigma in ((0.3, 0.2, 0.005), (0, 0, 0), (0, 0.2, 0), (5, 8, 0.3), (1e-6, 1e-6, 1e-9)):
        for radius in (60.0, 1e5):
            yield road_scene(Slot, sigma=np.array(sigma), radius=radius)
            yield road_scene([Slot.ROUTE], sigma=np.array(sigma), radius=radius, map_error=None)
    for size in (1e3, 1e9, 1e60):
        P = size * np.eye(3)
        yield Scene((), np.zeros((0, 0)), PoseError(P), np.zeros((0, 2)))


def check(dbc: str, scenes: Iterator[Scene], seed: int = 0, **how: Any) -> list[Sent]:
    """Compare what both send of scenes, and return it."""
    rng, codec = np.random.default_rng(seed), Codec(layout_of(dbc))
    cases = [case_of(scene, rng, dbc) for scene in scenes]
    expected = [in_python(codec, case) for case in cases]
    for got, wanted in zip(in_c(dbc, cases, **how), expected, strict=True):
        assert got == wanted
    return expected


@pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])
def test_scenes_of_roads(dbc: str) -> None:
    """Frames, reasons and counters of scenes of all shapes of roads."""
    sent = check(dbc, on_roads(range(2 * len(SHAPES))))
    assert sum(len(one.frames) for one in sent) > 100


@pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])
def test_scenes_of_random_gaussians(dbc: str) -> None:
    """Whatever a caller may give, with lines left out for every reason."""
    sent = check(dbc, gaussians(range(150)))
    reasons = {reason for one in sent for reason in one.left_out}
    assert reasons >= ({0, 1, 2, 3, 4} if dbc == CONDITIONAL else {0, 1, 2, 4})


@pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])
def test_awkward_scenes(dbc: str) -> None:
    """Also those whose pose error does not fit."""
    sent = check(dbc, awkward())
    assert {one.refusal for one in sent} == {0, BAD_POSE}
