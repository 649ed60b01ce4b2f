"""Levels of whole scenes: tilts of the lateral level, by core and model side by side."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
from evidence.exact import covers
from scene_layouts import layout_of
from support.whole_scene_witness import read

from maplines_can import Codec, Gaussian, MapLine, PoseError, Scene, Slot
from maplines_can.model.levels import TILTS
from maplines_can.testing.sender_comparison import STREAMS
from maplines_can.testing.sender_streams import bits
from maplines_can.values.seen_lines import bases
from maplines_can.wire import default_dbc_path
from maplines_can.wire.layout.record_signals import TILT

DBC = "maplines-scene.dbc"
LAYOUT = layout_of(DBC)
RANGES = [(-20.0, 80.0), (-5.0, 26.0), (0.0, 12.0), (-17.0, 4.0)]
#: Standard deviations at the end of a line [m].
SIZES = [0.1, 0.7]


def tilted(size: float, tilt: float, rest: float = 0.1) -> Any:
    """Covariance of T_0 .. T_3: a position that changes along the line, and noise."""
    u = np.array([1.0, tilt, 0.0, 0.0]) / max(1.0, abs(tilt))
    return size**2 * (np.outer(u, u) + rest**2 * np.diag([0.3, 0.5, 0.7, 1.0]))


def scene_of(covs: Any) -> Scene:
    """A scene of straight lines with own covariances, seen from a pose that is known well."""
    n = len(covs)
    means = np.array([[1.75 - 3.5 * i, 0.01, 1e-4, 0.0] for i in range(n)])
    ranges = np.array(RANGES[:n])
    J = bases(means, ranges)
    own = J @ covs @ J.swapaxes(1, 2)
    own = (own + own.swapaxes(1, 2)) / 2
    joint = np.zeros((4 * n, 4 * n))
    for i in range(n):
        joint[4 * i : 4 * i + 4, 4 * i : 4 * i + 4] = own[i]
    lines = [
        MapLine(Slot(i), Gaussian(means[i], own[i]), x_min=ranges[i, 0], x_max=ranges[i, 1])
        for i in range(n)
    ]
    pose = PoseError(np.diag([0.1, 0.02, 1e-3]) ** 2)
    return Scene(tuple(lines), joint, pose, ranges, specific_covs=own)


def tilts_of(scene: Scene) -> list[float]:
    """Send a scene, which is covered in exact arithmetic as read from the DBC alone; its tilts.

    Core and model send the same bits.
    """
    owners = [*LAYOUT.messages_of]
    stream, given = (
        STREAMS["scenes"],
        (scene, dict.fromkeys(owners, 3), dict.fromkeys(owners, 0.02)),
    )
    answers = stream.core(Codec(LAYOUT), (*given, True)), stream.model(LAYOUT, (*given, True))
    assert bits(answers[0]) == bits(answers[1])
    sent = Codec(LAYOUT).encoder().encode_scene(scene, fd=True)
    found = read([frame for own in sent.values() for frame in own], default_dbc_path(DBC))
    assert found.slots == [*scene.index]
    true = scene.joint(found.slots)
    assert covers(found.cov, found.means.ravel(), true.cov, true.mean)
    raw = found.raw["Scene"]
    return [TILTS[raw[name]] for name in raw if name.endswith(TILT)]


@pytest.mark.parametrize("size", [0.01, *SIZES])
@pytest.mark.parametrize("tilt", TILTS)
def test_a_line_with_a_tilted_position_is_sent_with_this_tilt(tilt: float, size: float) -> None:
    assert tilts_of(scene_of([tilted(size, tilt)] * 4)) == [tilt] * 4


def test_own_covariances_of_any_form_are_covered_with_all_tilts() -> None:
    """Nearly singular ones of rank 1 to 4, of less than the resolution, and of up to 0.7 m."""
    met = Counter[float]()
    for seed in range(6):
        rng = np.random.default_rng(seed)
        factors = [
            10.0 ** rng.uniform(-4, 0) * rng.standard_normal((4, rng.integers(1, 5)))
            for _ in range(4)
        ]
        scale = np.diag([0.3, 0.3, 0.1, 0.03])
        covs = [scale @ F @ F.T @ scale + 1e-12 * np.eye(4) for F in factors]
        met.update(tilts_of(scene_of(covs)))
    assert {*met} == {*TILTS}
