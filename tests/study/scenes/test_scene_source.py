"""Random scenes: their parameters, the information about them, and the joint limit."""

import math
from functools import partial
from typing import Any

import numpy as np
import pytest

from maplines_can import Gaussian, MapError, Polyline, Slot, map_scene
from maplines_can.study.scenes import random_scenes as source
from maplines_can.study.scenes.random_scenes import (
    RESOLUTION,
    box,
    information,
    joint_limit,
    noise_floor,
    pose_cov,
    random_scene,
    unit_point_cov,
)
from maplines_can.values.seen_lines import SeenLines

LINES = 3


@pytest.fixture(scope="module")
def drawn() -> Any:
    return random_scene(LINES, np.random.default_rng(4))


def test_a_scene_has_the_pose_error_of_its_parameters(drawn: Any) -> None:
    """In the ego frame; the car may stand anywhere and in any direction."""
    assert len(drawn.scene.lines) == LINES
    assert np.allclose(drawn.scene.pose_error.cov, pose_cov(drawn.theta), rtol=1e-9, atol=1e-12)
    error = drawn.scene.map_error
    assert (error.point_sigma, error.offset_sigma) == tuple(np.exp(drawn.theta[6:8]))
    assert (box(LINES)[:, 0] <= drawn.theta).all()
    assert (drawn.theta <= box(LINES)[:, 1]).all()


@pytest.mark.parametrize("spacing", [2.0, 7.0, 20.0])
def test_noise_of_points_is_that_of_a_scene(spacing: float) -> None:
    """On a straight road, without other errors of the map; up to the place of the points."""
    x = np.arange(-100, 200, spacing)
    line = Polyline(np.column_stack([x, np.full_like(x, 1.75)]))
    ego = Gaussian(np.zeros(3), pose_cov(box(0).mean(axis=1)))

    def scene(point_sigma: float) -> Any:
        error = MapError(point_sigma=point_sigma)
        return map_scene({Slot.EGO_LEFT: line}, ego, map_error=error)

    fine, coarse = scene(0.05), scene(0.1)
    assert np.array_equal(fine.fit_ranges, coarse.fit_ranges)
    expected = (coarse.cov - fine.cov) / (0.1**2 - 0.05**2)
    noise = unit_point_cov(fine.means[0], fine.fit_ranges[0], spacing)

    # Chords of points far apart leave out part of the bend that their errors make.
    rtol = 0.25 if spacing < 20 else 0.4
    assert np.allclose(noise.diagonal(), expected.diagonal(), rtol=rtol, atol=0)


def test_information_is_the_curvature_of_the_divergence(drawn: Any) -> None:
    """2 KL = d^T F d for small changes of the parameters of the pose error."""
    scene, theta = drawn
    seen = SeenLines(scene.means, scene.fit_ranges)
    true = scene.cov + noise_floor(scene.means, scene.fit_ranges, RESOLUTION)
    d = np.r_[0.01, -0.02, 0.015, 0.02, -0.01, 0.01]
    moved = true + seen.spread(pose_cov(theta + np.r_[d, np.zeros(2 + LINES)]))
    moved -= seen.spread(pose_cov(theta))
    ratio = np.linalg.solve(moved, true)
    kl = (np.trace(ratio) - len(true) - np.linalg.slogdet(ratio)[1]) / 2
    F = information(drawn, RESOLUTION)

    assert 2 * kl == pytest.approx(d @ F[:6, :6] @ d, rel=0.05)
    assert np.linalg.eigvalsh(F)[0] >= -1e-9 * np.linalg.eigvalsh(F)[-1]


def test_information_about_the_map_sums_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """To scale the whole covariance is to scale the pose error, and all errors of the map.

    What the cubics miss is no parameter, so it is left out here.
    """
    monkeypatch.setattr(source, "map_scene", partial(map_scene, max_misfit=math.inf))
    F = information(random_scene(LINES, np.random.default_rng(4)), 0.0)
    scale = np.r_[np.ones(3), np.zeros(3), 1, 1, np.zeros(LINES)]

    # 1/2 tr (2 I)^2 = 2 * 12 parameters
    assert scale @ F @ scale == pytest.approx(2 * 4 * LINES, rel=0.1)


def test_the_limit_of_independent_parameters_is_known() -> None:
    """The widths of the box are its entropy; F is the same in all scenes."""
    n = 8 + 2
    F = np.tile(np.diag(np.geomspace(1e4, 1e6, n)), (5, 1, 1))
    limit = joint_limit(F, 1e-3)
    entropy = np.log2(np.diff(box(2), axis=1)).sum() + np.log2(np.geomspace(1e4, 1e6, n)).sum() / 2
    bits = entropy - n / 2 * math.log2(2 * math.pi * math.e * 2e-3 / n)

    assert limit.dimension == n
    assert limit.bits(1e-3) == pytest.approx(bits)
    assert limit.entropy_se_bits == pytest.approx(0, abs=1e-12)


def test_parameters_that_cannot_be_seen_take_no_bits() -> None:
    """They would make the bound minus infinity."""
    F = np.tile(np.eye(9) * 1e5, (3, 1, 1))
    whole = joint_limit(F, 1e-3)
    F[:, 2] = F[:, :, 2] = 0
    F[:, 2, 2] = 1e-12
    less = joint_limit(F, 1e-3)

    assert (whole.dimension, less.dimension) == (9, 8)
    assert 0 < less.bits(1e-3) < whole.bits(1e-3)
