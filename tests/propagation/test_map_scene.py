"""Joint Gaussian of the lines of a map, against samples of the pose and against ``map_lines``."""

from typing import Any

import numpy as np
import pytest
from evidence.roads import SHAPES, random_scene
from evidence.witness import POSES, Poses

from maplines_can import (
    Gaussian,
    LeftOut,
    Linear,
    MapError,
    Polyline,
    Quadrature,
    Refit,
    Slot,
    map_lines,
)
from maplines_can.propagation import map_scene
from maplines_can.values.line import lateral, lateral_jacobian

LEFT, RIGHT = Slot.EGO_LEFT, Slot.EGO_RIGHT
ROADS = {
    LEFT: Polyline([[-100, 1.75], [200, 1.75]]),
    RIGHT: Polyline([[-100, -1.75], [200, -1.75]]),
}
EGO = Gaussian([0, 0, 0], np.diag([0.1, 0.2, 0.003]) ** 2)
DRAWS = 100_000
#: Shapes of road that are functions of x from all of the drawn poses.
CURVES = ("motorway", "exit", "rural", "s-bend")


def drawn_scene(shape: str, pose: str, seed: int, **settings: Any) -> tuple[Any, Gaussian, Any]:
    """Lines of a random road, the Gaussian over the pose, and their scene."""
    case = random_scene(shape, np.random.default_rng([list(SHAPES).index(shape), seed]), 4)
    poses = Poses.about(case.pose, POSES[pose], 0, np.random.default_rng())
    ego = Gaussian(case.pose, poses.cov)
    lines = {slot: Polyline(points) for slot, points in case.lines.items()}
    return lines, ego, map_scene(lines, ego, **settings)


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("shape", CURVES)
def test_the_joint_is_that_of_drawn_poses(shape: str, pose: str) -> None:
    """10^5 poses through a refit of the same ranges; 5 standard errors, and 1 % for sigma points.

    The lateral positions of all lines at three places are compared, and the own covariances of
    the lines are taken off the joint.
    """
    lines, ego, scene = drawn_scene(shape, pose, 1)
    refits = refits_of(lines, ego, scene, None)
    poses = ego.sample(DRAWS, seed=4)
    places = np.linspace(0.1, 0.9, 3)
    x = scene.fit_ranges @ [1 - places, places]  # (L, X)
    drawn = seen_by(refits, poses)[:, [*lines].index(LEFT) :]
    y = lateral(drawn[:, :, None], x).reshape(DRAWS, -1)
    k = x.shape[1]
    J = np.zeros((y.shape[1], len(scene.cov)))
    for i, mean in enumerate(scene.means):
        J[k * i : k * i + k, 4 * i : 4 * i + 4] = lateral_jacobian(mean, x[i])
    own = np.zeros_like(scene.cov)
    for i, noise in enumerate(scene.specific_covs):
        own[4 * i : 4 * i + 4, 4 * i : 4 * i + 4] = noise
    cov, sampled = J @ (scene.cov - own) @ J.T, np.cov(y.T)
    scale = np.sqrt(sampled.diagonal())
    error = np.abs(cov - sampled) / np.outer(scale, scale)
    assert error.max() <= 5 * (2 / DRAWS) ** 0.5 + (0.01 if pose == "production" else 0.04)
    values = lateral(scene.means[:, None], x).ravel()
    assert np.abs(values - y.mean(axis=0)).max() <= 5 * scale.max() / DRAWS**0.5 + 2e-3


def refits_of(lines: Any, ego: Gaussian, scene: Any, error: MapError | None) -> list[Refit]:
    """The refits of a scene of which no line is left out, each in the fit range of its line."""
    assert not scene.left_out
    ranges = map(tuple, scene.fit_ranges.tolist())
    refits = [
        Refit(line, ego.mean, window, error)
        for line, window in zip(lines.values(), ranges, strict=True)
    ]
    for refit, fit_range, own in zip(refits, scene.fit_ranges, scene.specific_covs, strict=True):
        assert refit.x_range == pytest.approx(fit_range, abs=1e-9)
        scale = np.sqrt(own.diagonal())  # long lines are sampled, in another window at other points
        assert (np.abs(own - refit.noise_cov) <= 5e-3 * scale[:, None] * scale).all()
    return refits


def seen_by(refits: list[Refit], poses: Any) -> Any:
    """The (N, L, 4) lines of refits from poses."""
    return np.stack([refit(poses) for refit in refits], axis=1)


@pytest.mark.parametrize("transform", [None, Linear(), Quadrature()], ids=repr)
@pytest.mark.parametrize("error", [None, MapError(0.05, 0.1, 0.001)], ids=["exact", "map error"])
def test_each_line_is_that_of_map_lines(transform: Any, error: Any) -> None:
    """On roads where the whole metres of the ranges do not matter: straight to the window's end."""
    arguments: Any = {"transform": transform, "map_error": error}
    scene = map_scene(ROADS, EGO, **arguments)
    for line, expected in zip(scene.lines, map_lines(ROADS, EGO, **arguments), strict=True):
        assert line.slot is expected.slot
        assert np.allclose(line.gaussian.mean, expected.gaussian.mean, rtol=0, atol=1e-9)
        x = np.linspace(-18.5, 78.5, 9)
        assert np.allclose(line.y_sigma(x), expected.y_sigma(x), rtol=2e-3)
        assert line.x_min == pytest.approx(expected.x_min, abs=1.5)
        assert line.x_max == pytest.approx(expected.x_max, abs=1.5)


@pytest.mark.parametrize("shape", SHAPES)
def test_fit_ranges_are_whole_metres_that_contain_the_valid_ones(shape: str) -> None:
    for seed in range(2):
        scene = drawn_scene(shape, "production", seed)[2]
        assert (scene.fit_ranges % 1 == 0).all()
        for line, (low, high) in zip(scene.lines, scene.fit_ranges, strict=True):
            assert low < line.x_min < line.x_max < high
            assert line.x_max - line.x_min >= 1.0
        assert len(scene.lines) + len(scene.left_out) == len(set(scene.index) | set(scene.left_out))


def test_the_pose_error_is_in_the_frame_of_the_car() -> None:
    """Of a car that heads north, what is along is the variance of y of the map."""
    ego = Gaussian([5.0, 7.0, np.pi / 2], np.diag([0.2, 0.1, 0.003]) ** 2)
    roads = {LEFT: Polyline([[3.25, -100], [3.25, 200]])}
    scene = map_scene(roads, ego, correlation_time=3.0)
    assert np.allclose(scene.pose_error.cov, np.diag([0.1, 0.2, 0.003]) ** 2, atol=1e-12)
    assert scene.pose_error.correlation_time == 3.0
    assert scene.line(LEFT).gaussian.mean[0] == pytest.approx(1.75, abs=1e-4)
    assert scene.line(LEFT).gaussian.sigma[0] == pytest.approx(0.2, rel=1e-2)


def test_lines_that_cannot_be_given_have_reasons_and_do_not_affect_others() -> None:
    unfit = {
        Slot.NEXT_LEFT: [[500.0, 0.0], [600.0, 0.0]],
        Slot.NEXT_RIGHT: [[3.0, -50.0], [3.0, 50.0]],
        Slot.CENTRE: [[0.0, 0.0], [0.5, 0.0]],
    }
    more = ROADS | {slot: Polyline(points) for slot, points in unfit.items()}
    scene, alone = map_scene(more, EGO), map_scene(ROADS, EGO)
    assert scene.left_out == {
        Slot.NEXT_LEFT: LeftOut.NOT_IN_WINDOW,
        Slot.NEXT_RIGHT: LeftOut.ACROSS,
        Slot.CENTRE: LeftOut.TOO_SHORT,
    }
    assert np.array_equal(scene.cov, alone.cov)
    assert np.array_equal(scene.means, alone.means)
    for lines in ({}, {Slot.ROUTE: Polyline([[500, 0], [600, 0]])}):
        assert map_scene(lines, EGO).lines == ()
