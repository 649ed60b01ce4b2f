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


def bits_of(signals: Any, *starts: str) -> int:
    return sum(signal.length for name, signal in signals.items() if name.startswith(starts))


OF_POSE = ("Pivot", "Ratio", "Inflation", "Map")
LEVELS = ("HasCovariance", "OwnLateral", "OwnTilt", "OwnPoints", "OwnShape", "Quartic")


def test_bits_and_frames_are_those_of_the_dbcs(figures: Any) -> None:
    """The mean and the covariance of each line, its levels, and the pose error once."""
    both, apart, whole = (
        codec_of(name).layout for name in ("Cholesky and Pose", "PoseConditional", "Scene, FD")
    )
    assert both.pose is not None
    assert apart.pose is not None
    assert whole.scene is not None
    one = sum(both.pose[f"EgoLeft{name}"].length for name in LEVELS[1:] if name != "OwnTilt")
    for k, lines in enumerate((2, 3, 4)):
        row = figures["Cholesky"][k]
        counts = row["frames"], row["mean_bits"], row["joint_bits"]
        assert counts == (4 * lines, 77 * lines, 105 * lines)
        row = figures["Cholesky and Pose"][k]
        assert row["frames"] == 4 * lines + both.pose.pages
        assert row["joint_bits"] == bits_of(both.pose.signals, *OF_POSE) + (105 + one) * lines
        row = figures["PoseConditional"][k]
        full, levels = row["all_entries"], bits_of(apart.signals, *LEVELS)
        pose = bits_of(apart.pose.signals, *OF_POSE)
        assert row["joint_bits"] == pose + lines * levels + full * 105
        assert (row["frames"], row["left_out"]) == (2 + 2 * lines + 2 * full, 0)
        row = figures["Scene, FD"][k]
        assert (row["frames"], row["all_entries"], row["left_out"]) == (1, 0, 0)
        assert row["mean_bits"] == lines * sum(
            whole[x].length for x in ("YOff", "Beta", "C0", "C1")
        )
        pose = bits_of(whole.scene.signals, *OF_POSE)
        assert row["joint_bits"] == pose + lines * bits_of(whole.signals, *LEVELS)
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


def test_divergences_of_joints_are_those_of_closed_forms() -> None:
    """None of the same; of independent lines that of their correlation; none if indefinite."""
    pose, own = 0.2, 0.05
    scene = scene_of(pose, own)

    def figures(cov: Any, shift: float = 0.0) -> Any:
        means = scene.means + np.array([shift, 0, 0, 0])
        return compare(scene, np.arange(2), means, cov, NOTHING)

    same = figures(scene.cov * (1 + 1e-9))
    assert same["kl_joint"] == pytest.approx(0, abs=1e-12)
    assert not same["overconfident"]
    assert [same["width"], same["centre"], *same["far"]] == pytest.approx([1] * 4)
    apart = scene.cov.copy()
    apart[:4, 4:] = apart[4:, :4] = 0
    row, r = figures(apart), pose**2 / (pose**2 + own**2)
    assert row["kl_joint"] == pytest.approx(-math.log(1 - r**2) / 2)  # of two Gaussian variables
    assert row["kl_lines"] == pytest.approx([0, 0], abs=1e-12)
    assert row["overconfident"]
    assert row["centre"] < 1 < 2 < row["width"]
    assert figures(scene.cov * 1.001, 0.03)["overconfident"]  # errors of means must be covered
    bad = scene.cov.copy()
    bad[0, 4] = bad[4, 0] = 2 * bad[0, 0]
    row = figures(bad)
    assert row["not_positive_definite"]
    assert row["overconfident"]
    assert math.isinf(row["kl_joint"])
