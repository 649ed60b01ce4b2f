"""The lane filter against textbook Kalman filters and Monte Carlo."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from maplines_can import lateral, lateral_jacobian, transform_line
from maplines_can.consumers.lane_filter import (
    CHANGE,
    GATE,
    NOISE_SHARE,
    UNKNOWN,
    Handling,
    LaneFilter,
    N,
    move_lines,
    road_noise,
    roots,
)

LANE = np.array([1.75, 0.01, 1e-3, 1e-5, -1.75, 0.01, 1e-3, 1e-5])
WINDOWS = np.tile([-20.0, 60.0], (2, 1))
OWN = np.diag(np.tile([0.05, 1e-3, 1e-5, 1e-6], 2)) ** 2
ALL = np.ones(N, dtype=bool)


def loading(sigma: float = 0.2) -> Any:
    """Loading of a lateral pose error."""
    A = np.zeros((N, 3))
    A[[0, 4], 1] = -sigma
    return A


def lateral_sigma(lane_filter: LaneFilter) -> float:
    return float(np.sqrt(lane_filter.cov[:N, :N][[0, 4]][:, [0, 4]].mean()))


@settings(max_examples=20)
@given(st.floats(-1, 3), st.floats(-0.1, 0.1), st.floats(-0.02, 0.02), st.floats(-0.005, 0.005))
def test_the_derivatives_of_a_moved_line(x: float, y: float, turn: float, c0: float) -> None:
    """Against differences, as lateral positions; and the line is that of transform_line."""
    lines = LANE.reshape(2, 4) + np.array([0, 0, c0, 0])
    at, places = np.array([x, y, turn]), np.array([0.0, 20.0, 40.0])
    moved, J, G = move_lines(lines, at, WINDOWS)
    assert moved[0] == pytest.approx(transform_line(lines[0], at, (-20, 60), 8), abs=1e-12)
    here = lateral_jacobian(moved[:, None], places)  # (2, 3, 4)

    def positions(lines: Any, at: Any) -> Any:
        return lateral(move_lines(lines, at, WINDOWS)[0][:, None], places)

    for i, step in enumerate((0.01, 1e-3, 1e-5, 1e-7)):
        d = np.eye(4)[i] * step
        change = (positions(lines + d, at) - positions(lines - d, at)) / (2 * step)
        expected = (here @ J[..., i, None])[..., 0]
        assert change == pytest.approx(expected, abs=0.05 * np.abs(expected).max())
    for i, step in enumerate((0.01, 0.01, 1e-4)):
        d = np.eye(3)[i] * step
        change = (positions(lines, at + d) - positions(lines, at - d)) / (2 * step)
        expected = (here @ G[..., i, None])[..., 0]
        assert change == pytest.approx(expected, abs=0.05 * np.abs(expected).max() + 0.01)


def test_equal_scenes_with_a_constant_pose_error_say_nothing_new() -> None:
    """After many scenes the lane is as uncertain as after the first one."""
    lane_filter = LaneFilter()
    sigmas = []
    for _ in range(50):
        lane_filter.update_map(LANE, loading(), OWN, None, ALL)
        sigmas.append(lateral_sigma(lane_filter))
    assert sigmas[0] == pytest.approx(np.hypot(0.2, 0.05 / np.sqrt(2)), rel=0.15)
    assert sigmas[-1] == pytest.approx(sigmas[0], rel=0.06)
    assert sigmas[-1] > 0.2


def test_scenes_with_new_pose_errors_average() -> None:
    """If the pose error is another one each time, 50 scenes are better than one."""
    lane_filter = LaneFilter(bias_sigma=(0, 0, 0, 0))
    still = np.zeros(3)
    for _ in range(50):
        lane_filter.update_map(LANE, loading(), OWN, None, ALL)
        lane_filter.predict(still, np.zeros((3, 3)), 1.0, WINDOWS, 1e-3)
    assert lateral_sigma(lane_filter) == pytest.approx(
        np.hypot(0.2 / np.sqrt(50), 0.05 / np.sqrt(2)), rel=0.1
    )


def test_the_update_is_that_of_the_joint_gaussian() -> None:
    """With the pose error as a state; a Schmidt filter gives the same lane for one scene."""
    prior = np.diag(UNKNOWN**2)
    R = loading() @ loading().T + roots(OWN) @ roots(OWN).T + NOISE_SHARE * OWN
    expected = prior - prior @ np.linalg.solve(prior + R, prior)
    handlings: tuple[Handling, ...] = ("state", "consider")
    for handling in handlings:
        lane_filter = LaneFilter(handling=handling)
        lane_filter.update_map(LANE, loading(), OWN, None, ALL)
        assert lane_filter.cov[:N, :N] == pytest.approx(expected, rel=1e-5, abs=1e-12)
        assert lane_filter.mean[:N] == pytest.approx(LANE, rel=1e-3, abs=1e-4)


def test_a_schmidt_filter_estimates_no_pose_error_but_keeps_its_covariance() -> None:
    lane_filter = LaneFilter(handling="consider")
    lane_filter.update_map(LANE, loading(), OWN, None, ALL)
    camera = LANE.reshape(2, 4)
    lane_filter.update_camera(camera, np.tile(OWN[:4, :4], (2, 1, 1)), np.ones(2, dtype=bool))
    lane_filter.update_map(LANE + 0.1, loading(), OWN, None, ALL)
    assert not lane_filter.mean[lane_filter.u].any()
    assert lane_filter.cov[lane_filter.u, lane_filter.u] == pytest.approx(np.eye(3))
    assert np.abs(lane_filter.cov[:N, lane_filter.u]).max() > 0.01


def test_the_corrections_of_a_localisation_do_not_show_its_error() -> None:
    """A car stands, and its localisation averages what it measures: the pose jumps as it converges.

    The error of a Kalman filter is uncorrelated with its corrections, so the newest scene has all
    that the scenes say. The bound is that of the mean NEES of as many cars (97.5 %).
    """
    cars, cycles, sigma, dt = 150, 60, 0.5, 0.1
    rng = np.random.default_rng(1)
    count = np.arange(1, cycles + 1)
    errors = np.cumsum(sigma * rng.standard_normal((cars, cycles)), axis=1) / count
    lane_filter = LaneFilter(bias_sigma=(0, 0, 0, 0), shape=(cars,))
    own = np.broadcast_to(OWN / 625, (cars, N, N))
    used = np.ones((cars, N), dtype=bool)
    for error, n in zip(errors.T, count, strict=True):
        # The autocorrelation of a mean is sqrt(s / t), which is 1/e at s = t / e^2.
        time = (1 - np.exp(-2)) * n * dt
        lane_filter.predict(np.zeros(3), np.zeros((3, 3)), dt, WINDOWS, time)
        lines = LANE - error[:, None] * np.tile([1.0, 0, 0, 0], 2)
        root = np.broadcast_to(loading(sigma / np.sqrt(n)), (cars, N, 3))
        lane_filter.update_map(lines, root, own, None, used)
    found = (lane_filter.mean - np.pad(LANE, (0, lane_filter.mean.shape[1] - N)))[:, [0, 4]]
    centre = found.mean(axis=1)
    variance = lane_filter.cov[:, [0, 4]][:, :, [0, 4]].mean(axis=(1, 2))
    assert (centre**2 / variance).mean() < chi2.ppf(0.975, cars) / cars
    assert np.sqrt((centre**2).mean()) < 1.1 * np.sqrt((errors[:, -1] ** 2).mean())
    assert not lane_filter.mean[:, lane_filter.u].any()


def test_a_camera_improves_the_pose_error_and_so_the_next_scene() -> None:
    lane_filter = LaneFilter(bias_sigma=(0.01, 0.001, 0, 0))
    shifted = LANE - [0.3, 0, 0, 0, 0.3, 0, 0, 0]  # the car believes to be 0.3 m to the left
    camera, cov = LANE.reshape(2, 4), np.tile(OWN[:4, :4], (2, 1, 1))
    for _ in range(30):
        lane_filter.update_map(shifted, loading(), OWN, None, ALL)
        lane_filter.update_camera(camera, cov, np.ones(2, dtype=bool))
    assert 0.2 * lane_filter.mean[lane_filter.u][1] == pytest.approx(0.3, abs=0.06)
    assert lane_filter.mean[0] == pytest.approx(1.75, abs=0.05)


def test_a_false_camera_line_is_not_used_and_changes_nothing() -> None:
    lane_filter = LaneFilter()
    lane_filter.update_map(LANE, loading(), OWN, None, ALL)
    mean, cov = lane_filter.mean.copy(), lane_filter.cov.copy()
    camera = LANE.reshape(2, 4) + np.array([[2.0], [0.0]])
    used = lane_filter.update_camera(
        camera, np.tile(OWN[:4, :4], (2, 1, 1)), np.array([True, False])
    )
    assert not used.any()
    assert np.array_equal(mean, lane_filter.mean)
    assert lane_filter.cov == pytest.approx(cov)
    assert pytest.approx(18.467, abs=0.01) == GATE
    assert pytest.approx(15.507, abs=0.01) == CHANGE


def test_a_change_of_the_lane_is_followed_at_once() -> None:
    lane_filter = LaneFilter()
    for _ in range(20):
        lane_filter.update_map(LANE, loading(), OWN, None, ALL)
    new = LANE - np.tile([3.5, 0, 0, 0], 2)
    for _ in range(3):
        lane_filter.update_map(new, loading(), OWN, None, ALL)
    assert lane_filter.mean[[0, 4]] == pytest.approx(new[[0, 4]], abs=0.3)


def test_many_cars_at_once_are_the_same_as_one_by_one() -> None:
    rng = np.random.default_rng(1)
    offsets = rng.normal(0, 0.1, (3, N)) * np.tile([1, 0.01, 0, 0], 2)
    together = LaneFilter(shape=(3,))
    moved = np.tile([1.0, 0.0, 0.01], (3, 1))
    for _ in range(3):
        many = np.tile(loading(), (3, 1, 1)), np.tile(OWN, (3, 1, 1))
        together.update_map(LANE + offsets, many[0], many[1], None, np.ones((3, N), dtype=bool))
        together.predict(moved, np.zeros((3, 3, 3)), 0.05, np.tile(WINDOWS, (3, 1, 1)), 5.0)
    for i in range(3):
        alone = LaneFilter()
        for _ in range(3):
            alone.update_map(LANE + offsets[i], loading(), OWN, None, ALL)
            alone.predict(moved[i], np.zeros((3, 3)), 0.05, WINDOWS, 5.0)
        assert together.mean[i] == pytest.approx(alone.mean, abs=1e-9)
        assert together.cov[i] == pytest.approx(alone.cov, rel=1e-6, abs=1e-9)


def test_the_road_changes_less_for_a_fast_car() -> None:
    slow, fast = (road_noise(np.array(v * 0.05), 0.05)[3, 3] for v in (10.0, 30.0))
    assert slow / fast == pytest.approx(3**6 / 3)
    assert not road_noise(np.array(0.0), 0.05).any()


@given(st.floats(-3, 3))
def test_turned_errors_keep_their_distribution(angle: float) -> None:
    lane_filter = LaneFilter()
    lane_filter.update_map(LANE, loading(), OWN, None, ALL)
    c, s = np.cos(angle), np.sin(angle)
    Q = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
    before = lane_filter.cov[lane_filter.u, lane_filter.u]
    lane_filter.turn_errors(Q)
    after = lane_filter.cov[lane_filter.u, lane_filter.u]
    assert after == pytest.approx(Q @ before @ Q.T, abs=1e-9)
