"""Scenes as an ECU in single precision receives them."""

import struct
from collections.abc import Iterable
from contextlib import suppress
from itertools import chain
from typing import Any

import numpy as np
import pytest
from scipy.linalg import block_diag
from support import c_core
from support.scene_streams import CONDITIONAL, OFFSETS, new_codec, random_scenes, road_scene

from maplines_can import EncodeError, Slot
from maplines_can.values.line import lateral_jacobian
from maplines_can.wire import Frame

COMPLETE, WHOLE = "maplines.dbc", "maplines-scene.dbc"
LINE = np.dtype(
    [
        ("mean", "<f8", 4),
        ("spread", "<f8", (4, 7)),
        ("specific", "<f8", (4, 4)),
        ("factor", "<f8", (4, 4)),
        ("fit_range", "<f8", 2),
    ]
)


def frames_of_scenes(dbc: str, n: int) -> list[bytes]:
    """Frames of scenes as the harness reads them."""
    codec, given = new_codec(dbc), list[bytes]()
    for k, scene in enumerate(random_scenes(n, seed=7)):
        with suppress(EncodeError):  # a pose error that the message cannot hold
            sent = codec.encoder().encode_scene(scene, fd=k % 2 > 0 or dbc == WHOLE)
            given.append(as_read(chain(*sent.values())))
    return given


def as_read(frames: Iterable[Frame]) -> bytes:
    """The frames of a scene as the harness reads them."""
    whole = [
        struct.pack("<IBB", frame.can_id, frame.is_extended, len(frame.data)) + frame.data
        for frame in frames
    ]
    return bytes([len(whole)]) + b"".join(whole)


def scenes_of(output: bytes) -> list[Any]:
    """The scenes of the harness."""
    scenes = []
    while output:
        end = 1 + output[0] * LINE.itemsize
        scenes.append(np.frombuffer(output[1:end], LINE))
        output = output[end:]
    return scenes


@pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE, WHOLE])
def test_single_precision_covers(dbc: str) -> None:
    """The joint covariance, about the rounded means, exceeds that in double precision.

    But by little: standard deviations of lateral positions are at most 0.1 % larger.
    """
    data = b"".join(frames_of_scenes(dbc, 40))
    flags = (*c_core.FLAGS, "-DMAPLINES_FLOAT")
    layout = new_codec(dbc).layout
    both = [c_core.harness("scene", layout), c_core.harness("scene", layout, flags=flags)]
    exact_scenes, rounded_scenes = (scenes_of(c_core.run(program, data)) for program in both)

    assert sum(map(len, exact_scenes)) > 100
    for exact, rounded in zip(exact_scenes, rounded_scenes, strict=True):
        assert len(exact) == len(rounded)
        if not len(exact):
            continue
        A, A_float = (lines["spread"].reshape(-1, 7) for lines in (exact, rounded))
        whitening = block_diag(*np.linalg.inv(exact["specific"]))
        e = whitening @ (rounded["mean"] - exact["mean"]).ravel()
        A, A_float = whitening @ A, whitening @ A_float
        F_float = whitening @ block_diag(*rounded["specific"])
        lacking = A @ A.T + np.eye(len(A)) + np.outer(e, e) - A_float @ A_float.T
        assert np.linalg.eigvalsh(lacking - F_float @ F_float.T)[-1] <= 1e-9 * np.abs(A).max() ** 2
        for lines, other in zip(exact, rounded, strict=True):
            low, high = lines["fit_range"].tolist()
            J = lateral_jacobian(lines["mean"], np.linspace(low, high, 5))
            before = np.linalg.norm(J @ np.hstack([lines["spread"], lines["specific"]]), axis=1)
            after = np.linalg.norm(J @ np.hstack([other["spread"], other["specific"]]), axis=1)
            own = np.linalg.norm(J @ other["factor"], axis=1)
            assert (after / before).max() < 1.001
            assert (own / before).min() >= 1 - 1e-9
            assert (own / before).max() < 1.001


def test_the_rounding_of_each_line_is_covered_alike(monkeypatch: Any) -> None:
    """Two lines of the same course have the same factors in a scene, also the first one."""
    monkeypatch.setitem(OFFSETS, Slot.NEXT_RIGHT, OFFSETS[Slot.EGO_LEFT])
    scene = road_scene(
        (Slot.EGO_LEFT, Slot.NEXT_RIGHT), radius=20_000, sigma=(1, 3, 0.02), map_error=None
    )
    codec = new_codec(WHOLE)
    frames = chain(*codec.encoder().encode_scene(scene, fd=True).values())
    program = c_core.harness("scene", codec.layout, flags=(*c_core.FLAGS, "-DMAPLINES_FLOAT"))
    (lines,) = scenes_of(c_core.run(program, as_read(frames)))

    first, second = lines
    assert np.array_equal(first["mean"], second["mean"])
    assert np.array_equal(first["spread"], second["spread"])
    assert np.array_equal(first["specific"], second["specific"])
