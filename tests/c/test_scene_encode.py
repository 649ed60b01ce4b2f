"""Scenes to frames on an ECU: the bytes of the package, whatever the compiler and processor."""

import struct
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import pytest
from scene_layouts import layout_of
from support import c_core
from support.c_core import scene_input
from support.scene_streams import random_scenes, road_scene

from maplines_can import Codec, PoseError, Scene, Slot
from maplines_can.values.errors import EncodeError
from maplines_can.values.line import LEFT_OUT
from maplines_can.wire import Authenticator, Encoder, Key, Layout
from maplines_can.wire.layout.pose_layout import OWNERS

DBCS = pytest.mark.parametrize("dbc", ["maplines-pose.dbc", "maplines.dbc", "maplines-scene.dbc"])
KEY = Key(bytes(range(16)), key_id=1)


class Case(NamedTuple):
    """A scene that a sender with these counters sends; None: with those after the last scene."""

    scene: Scene
    counters: dict[Any, int] | None
    age: float
    is_fd: bool
    has_key: bool = False


def input_of(case: Case) -> bytes:
    """A case as c/tests/scene_encode_harness.c reads it."""
    parts = [bytes([case.is_fd + 2 * case.has_key + 4 * (case.counters is None)])]
    if case.counters is not None:
        parts.append(struct.pack("<11I", *(case.counters.get(owner, 0) for owner in OWNERS)))
    return b"".join([*parts, scene_input(case.scene, case.age)])


def frames_of(encoder: Encoder, case: Case) -> bytes:
    """The frames of the package, as the harness writes them; none of a scene that is refused."""
    try:
        sent = encoder.encode_scene(
            case.scene, age=case.age, fd=case.is_fd, counters=case.counters or None
        )
    except EncodeError:
        return struct.pack("<H", 0)
    frames = [frame for own in sent.values() for frame in own]
    heads = [struct.pack("<I3B", f.can_id, f.is_extended, f.is_fd, len(f.data)) for f in frames]
    rows = b"".join(head + frame.data for head, frame in zip(heads, frames, strict=True))
    left_out = encoder.left_out(case.scene, fd=case.is_fd)
    reasons = bytes(LEFT_OUT.index(left_out.get(line.slot)) for line in case.scene.lines)
    return struct.pack("<H", len(frames)) + rows + reasons


def scenes() -> Iterator[Scene]:
    """Scenes of random bends, and some at the limits."""
    yield from random_scenes(30, seed=1)
    for sigma in ((0, 0, 0), (5, 8, 0.3), (1e-6, 1e-6, 1e-9)):
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
    check(layout, cases)


def check(layout: Layout, cases: Sequence[Case]) -> None:
    """Check that the frames of cases are those of the package."""
    out = c_core.run(c_core.harness("scene_encode", layout), b"".join(map(input_of, cases)))
    encoder = None
    for case in cases:
        if case.counters is not None:
            authenticator = Authenticator(KEY, clock=lambda: 10**18) if case.has_key else None
            encoder = Codec(layout, authenticator).encoder()
        assert encoder is not None
        expected = frames_of(encoder, case)
        assert out[: len(expected)] == expected
        out = out[len(expected) :]
    assert out == b""


@pytest.mark.parametrize("has_key", [False, True])
def test_a_sender_of_whole_scenes_keeps_its_places(has_key: bool) -> None:
    """Cycle by cycle, as roads change; with a key there are fewer, and lines are left out."""
    rng, all_scenes = np.random.default_rng(2), [*scenes()]
    some = [all_scenes[i] for i in rng.integers(len(all_scenes), size=40)]
    cases = [Case(scene, None, 0.01, True, has_key) for scene in some]
    check(layout_of("maplines-scene.dbc"), [cases[0]._replace(counters={}), *cases[1:]])
