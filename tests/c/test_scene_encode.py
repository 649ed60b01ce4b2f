"""Scenes to frames on an ECU: the bytes of the package, whatever the compiler and processor."""

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

from maplines_can import Codec, Gaussian, MapError, Polyline, PoseError, Scene, Slot, map_scene
from maplines_can.values.errors import EncodeError
from maplines_can.wire import POSE

DBCS = pytest.mark.parametrize("dbc", ["maplines-pose.dbc", "maplines.dbc"])
OWNERS = (*Slot, POSE)
ERRORS = (None, MapError(0.05, 0.05), MapError(0.05, 0.05, 0.001), MapError(offset_sigma=0.3))


class Case(NamedTuple):
    """A scene that a sender with these counters sends."""

    scene: Scene
    counters: dict[Any, int]
    age: float
    is_fd: bool


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
    arrays = (() if specific is None else specific, scene.cov, scene.pose_error.cov)
    parts += [np.asarray(array, dtype="<f8").tobytes() for array in arrays]
    of_map = (error.offset_sigma, error.heading_sigma) if error else (0.0, 0.0)
    parts.append(struct.pack("<4d", case.age, scene.pose_error.correlation_time, *of_map))
    return b"".join(parts)


def frames_of(codec: Codec, case: Case) -> bytes:
    """The frames of the package, as the harness writes them; none of a scene that is refused."""
    try:
        sent = codec.encoder().encode_scene(
            case.scene, age=case.age, fd=case.is_fd, counters=case.counters
        )
    except EncodeError:
        return struct.pack("<H", 0)
    frames = [frame for own in sent.values() for frame in own]
    heads = [struct.pack("<I3B", f.can_id, f.is_extended, f.is_fd, len(f.data)) for f in frames]
    rows = b"".join(head + frame.data for head, frame in zip(heads, frames, strict=True))
    return struct.pack("<H", len(frames)) + rows


def scenes() -> Iterator[Scene]:
    """Scenes of random roads, from production poses and from poor ones, and some at the limits."""
    for number in range(40):
        rng = np.random.default_rng(number)
        road = random_scene(list(SHAPES)[number % len(SHAPES)], rng, int(rng.integers(1, 9)))
        poses = Poses.about(road.pose, POSES[list(POSES)[number // len(SHAPES) % 2]], 0, rng)
        yield map_scene(
            {slot: Polyline(points) for slot, points in road.lines.items()},
            Gaussian(road.pose, poses.cov),
            map_error=ERRORS[rng.integers(len(ERRORS))],
            correlation_time=float(rng.choice([0.3, 4.0, np.inf])),
        )
    for sigma in ((0, 0, 0), (0, 0.2, 0), (5, 8, 0.3), (1e-6, 1e-6, 1e-9)):
        yield road_scene(Slot, sigma=np.array(sigma), radius=60.0)
        yield road_scene([Slot.ROUTE], sigma=np.array(sigma), radius=1e5, map_error=None)
    yield Scene((), np.zeros((0, 0)), PoseError(1e9 * np.eye(3)), np.zeros((0, 2)))


@DBCS
def test_scenes_have_the_frames_of_the_library(dbc: str) -> None:
    """Of either kind of frame, with any counters and ages."""
    rng, layout = np.random.default_rng(1), layout_of(dbc)
    cases = [
        Case(
            scene,
            {owner: int(rng.integers(256)) for owner in OWNERS},
            float(rng.choice([0.0, 0.004, 0.0205, np.inf])),
            bool(rng.integers(2)),
        )
        for scene in scenes()
    ]
    out = c_core.run(c_core.harness("scene_encode", layout), b"".join(map(input_of, cases)))
    for case in cases:
        expected = frames_of(Codec(layout), case)
        assert out[: len(expected)] == expected
        out = out[len(expected) :]
    assert out == b""
