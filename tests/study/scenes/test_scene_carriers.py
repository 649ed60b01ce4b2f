"""Codes on scenes: what they send, and whether the joint covariance is covered."""

import math
from typing import Any

import numpy as np
import pytest

from maplines_can import Gaussian, MapLine, PoseError, Scene, Slot
from maplines_can.study.scenes.carriers import WITH_POSE, codec_of, compare, evaluations
from maplines_can.study.scenes.random_scenes import random_scene

SEPARATE = ("Cholesky", "Sigmas")
NOTHING = np.zeros((8, 8))


@pytest.fixture(scope="module")
def scenes() -> Any:
    rng = np.random.default_rng(7)
    return [random_scene(lines, rng).scene for lines in (2, 3, 4)]


@pytest.fixture(scope="module")
def figures(scenes: Any) -> Any:
    return {code: list(evaluations(code, scenes)) for code in (*SEPARATE, *WITH_POSE)}


def test_joints_with_the_pose_error_cover_and_others_do_not(figures: Any) -> None:
    """Lines that are taken as independent are too certain together, whatever their code."""
    for code, rows in figures.items():
        assert not any(row["not_positive_definite"] for row in rows)
        assert all(row["overconfident"] == (code not in WITH_POSE) for row in rows), code


def test_bits_and_frames_are_those_of_the_dbcs(figures: Any) -> None:
    """77 bits of the mean and 105 of the covariance of a line today, and the pose error once."""
    for lines, row in zip((2, 3, 4), figures["Cholesky"], strict=True):
        counts = row["frames"], row["mean_bits"], row["joint_bits"]
        assert counts == (4 * lines, 77 * lines, 105 * lines)
    for lines, row in zip((2, 3, 4), figures["Cholesky and Pose"], strict=True):
        pose = codec_of("Cholesky and Pose").layout.pose
        assert pose is not None
        names = ("OwnLateral", "OwnPoints", "OwnShape", "Quartic")
        levels = sum(pose[f"EgoLeft{name}"].length for name in names)
        own = sum(
            signal.length
            for name, signal in pose.signals.items()
            if name.startswith(("Pivot", "Ratio", "Inflation", "Map"))
        )
        assert row["frames"] == 4 * lines + pose.pages
        assert row["joint_bits"] == own + (105 + levels) * lines


def test_a_conditional_record_with_levels_takes_fewer_bits(figures: Any) -> None:
    """One with all entries takes those of a covariance more."""
    layout = codec_of("PoseConditional").layout
    names = ("HasCovariance", "OwnLateral", "OwnPoints", "OwnShape", "Quartic")
    levels = sum(layout[name].length for name in names)
    assert layout.pose is not None
    pose = sum(
        signal.length
        for name, signal in layout.pose.signals.items()
        if name.startswith(("Pivot", "Ratio", "Inflation", "Map"))
    )
    for lines, row in zip((2, 3, 4), figures["PoseConditional"], strict=True):
        full = row["all_entries"]
        assert row["joint_bits"] == pose + lines * levels + full * 105
        assert row["frames"] == 2 + 2 * lines + 2 * full
        assert row["left_out"] == 0


def test_a_whole_scene_is_one_frame_of_levels(figures: Any) -> None:
    """Its covariance takes the bits of the pose error and of the levels; no entries."""
    layout = codec_of("Scene, FD").layout
    assert layout.scene is not None
    starts = ("Pivot", "Ratio", "Inflation", "Map")
    pose = sum(signal.length for k, signal in layout.scene.signals.items() if k.startswith(starts))
    own = sum(layout[f"Own{name}"].length for name in ("Lateral", "Tilt", "Points", "Shape"))
    mean = sum(layout[name].length for name in ("YOff", "Beta", "C0", "C1"))
    for lines, row in zip((2, 3, 4), figures["Scene, FD"], strict=True):
        assert (row["frames"], row["all_entries"], row["left_out"]) == (1, 0, 0)
        assert (row["mean_bits"], row["joint_bits"]) == (lines * mean, pose + lines * own)
        assert len(row["far"]) == lines
        assert all(1 <= ratio < 1.1 for ratio in row["far"])
    for row in figures["PoseConditional, FD"]:
        assert row["all_entries"] == len(row["kl_lines"]) == row["frames"] - 1


def scene_of(pose_sigma: float, own_sigma: float) -> Scene:
    """Two straight lines that share the error across the road."""
    own = np.diag([own_sigma, 1e-3, 1e-5, 1e-7]) ** 2
    shift = np.zeros((8, 8))
    shift[np.ix_([0, 4], [0, 4])] = pose_sigma**2
    cov = shift + np.kron(np.eye(2), own)
    lines = [
        MapLine(slot, Gaussian([y, 0, 0, 0], cov[:4, :4]), x_min=0.0, x_max=60.0)
        for slot, y in ((Slot.EGO_LEFT, 1.75), (Slot.EGO_RIGHT, -1.75))
    ]
    error = PoseError(np.diag([0.1, pose_sigma, 1e-3]) ** 2)
    return Scene(tuple(lines), cov, error, np.array([[0, 60], [0, 60]]))


def test_the_same_covariance_has_no_divergence() -> None:
    """Its sigmas have the ratio 1."""
    scene = scene_of(0.2, 0.05)
    row = compare(scene, np.arange(2), scene.means, scene.cov * (1 + 1e-9), NOTHING)

    assert row["kl_joint"] == pytest.approx(0, abs=1e-12)
    assert not row["overconfident"]
    assert (row["width"], row["centre"]) == (pytest.approx(1), pytest.approx(1))
    assert row["far"] == [pytest.approx(1)] * 2


def test_independent_lines_have_the_divergence_of_their_correlation() -> None:
    """-1/2 ln(1 - r^2), as of two Gaussian variables; the width seems too uncertain."""
    pose, own = 0.2, 0.05
    scene = scene_of(pose, own)
    apart = scene.cov.copy()
    apart[:4, 4:] = apart[4:, :4] = 0
    row = compare(scene, np.arange(2), scene.means, apart, NOTHING)
    r = pose**2 / (pose**2 + own**2)

    assert row["kl_joint"] == pytest.approx(-math.log(1 - r**2) / 2)
    assert row["kl_lines"] == pytest.approx([0, 0], abs=1e-12)
    assert row["overconfident"]
    assert row["width"] > 2
    assert row["centre"] < 1


def test_errors_of_means_must_be_covered() -> None:
    """A decoded covariance without them is overconfident."""
    scene = scene_of(0.2, 0.05)
    means = scene.means + np.array([0.03, 0, 0, 0])

    assert compare(scene, np.arange(2), means, scene.cov * 1.001, NOTHING)["overconfident"]


def test_an_indefinite_covariance_is_none() -> None:
    """Its divergence is infinite."""
    scene = scene_of(0.2, 0.05)
    cov = scene.cov.copy()
    cov[0, 4] = cov[4, 0] = 2 * cov[0, 0]
    row = compare(scene, np.arange(2), scene.means, cov, NOTHING)

    assert row["not_positive_definite"]
    assert row["overconfident"]
    assert math.isinf(row["kl_joint"])
