"""The lane filter against textbook Kalman filters and Monte Carlo."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import eigh

from maplines_can.consumers.lane_filter import (
    CHANGE,
    Handling,
    LaneFilter,
    N,
    move_lines,
    road_noise,
    roots,
)
from maplines_can.propagation import Motion
from maplines_can.simulation.camera import Errors, UnitGaussMarkov
from maplines_can.values.line import lateral, lateral_jacobian, transform_line_or_nan

LANE = np.array([1.75, 0.01, 1e-3, 1e-5, -1.75, 0.01, 1e-3, 1e-5])
WINDOWS = np.tile([-20.0, 60.0], (2, 1))
OWN = np.diag(np.tile([0.05, 1e-3, 1e-5, 1e-6], 2)) ** 2
ALL = np.ones(N, dtype=bool)


def loading(sigma: float = 0.2) -> Any:
    """Loading of a lateral pose error."""
    A = np.zeros((N, 3))
    A[[0, 4], 1] = -sigma
    return A


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


#: Differences of the parameters of a line and of a displacement.
STEPS, MOVES = (1e-3, 1e-5, 1e-7, 1e-9), (1e-3, 1e-3, 1e-5)
#: Of each parameter, what moves a line by 1 m at 20 m.
AT_20 = np.array([1.0, 1 / 20, 1 / 200, 6 / 8000])


def derivatives(lines: Any, at: Any) -> tuple[Any, Any]:
    """Central differences of a moved line by the line and by the displacement, in metres."""

    def moved(line: Any, place: Any) -> Any:
        return move_lines(line, place, WINDOWS[:1])[0][0]

    J, G = np.zeros((4, 4)), np.zeros((4, 3))
    for i, step in enumerate(STEPS):
        d = np.eye(4)[i] * step
        J[:, i] = (moved(lines + d, at) - moved(lines - d, at)) / (2 * step)
    for i, step in enumerate(MOVES):
        d = np.eye(3)[i] * step
        G[:, i] = (moved(lines, at + d) - moved(lines, at - d)) / (2 * step)
    return J / AT_20[:, None] * AT_20, G / AT_20[:, None]


@settings(max_examples=40)
@given(st.floats(-30, 30), st.floats(-0.05, 0.05), st.floats(-1e-3, 1e-3), st.floats(-1e-5, 1e-5))
def test_the_derivatives_are_those_of_a_bend_in_each_entry(
    x: float, beta: float, c0: float, c1: float
) -> None:
    """After any way along x; the slopes before and after differ, which the derivatives neglect."""
    line, at = np.array([[1.0, beta, c0, c1]]), np.array([x, 0, 0])
    moved, J, G = move_lines(line, at, WINDOWS[:1])
    by_line, by_move = derivatives(line, at)
    change = abs(np.cos(moved[0, 1]) ** 2 / np.cos(beta) ** 2 - 1)
    expected = by_line.copy()
    expected[1, 1] = 1.0
    assert by_line[1, 1] == pytest.approx(1.0, abs=change + 1e-6)
    assert J[0] / AT_20[:, None] * AT_20 == pytest.approx(expected, abs=1e-6)
    assert G[0, :, :2] / AT_20[:, None] == pytest.approx(by_move[:, :2], abs=1e-6)


@given(st.floats(0.1, 3), st.floats(0.02, 0.2), st.booleans())
def test_the_road_noise_of_two_ways_adds_up(way: float, dt: float, backwards: bool) -> None:
    """At one speed: that of c1 is a random walk, and a line that it bends is its integral."""
    way = -way if backwards else way
    halves = road_noise(np.array(way / 2), dt / 2)
    whole = road_noise(np.array(way), dt)
    assert whole[3, 3] == pytest.approx(2 * halves[3, 3])
    shape = np.array([way**3 / 6, way**2 / 2, way, 1.0])
    speed = max(abs(way) / dt, 5.0)
    sigma = 2.0 / speed**3 * np.sqrt(abs(way) / 10.0)
    left, cross, right = whole[:4, :4], whole[:4, 4:], whole[4:, 4:]
    assert cross == pytest.approx(sigma**2 * np.outer(shape, shape), rel=1e-9)
    for own in (left, right):  # a hundredth of the variance is of one line alone
        assert own == pytest.approx(1.01 * cross, rel=1e-9)


@pytest.fixture
def used() -> LaneFilter:
    """A filter after a scene and camera lines, whose variables are all correlated."""
    lane_filter = LaneFilter(bias_sigma=(0.05, 0.003, 5e-5, 0.02))
    A = (
        np.random.default_rng(3).standard_normal((N, 3))
        * np.tile([0.1, 1e-3, 1e-5, 1e-7], 2)[:, None]
    )
    for shift in (0.0, 0.1):
        lane_filter.update_map(LANE + shift * A[:, 0], A, OWN, None, ALL)
        lane_filter.predict(np.array([0.5, 0.0, 0.01]), np.zeros((3, 3)), 0.1, WINDOWS, 3.0)
        lane_filter.update_camera(
            LANE.reshape(2, 4), np.tile(OWN[:4, :4], (2, 1, 1)), np.ones(2, dtype=bool)
        )
    return lane_filter


def test_the_prediction_propagates_the_covariance_by_its_derivative(used: LaneFilter) -> None:
    """P' = F P F' + Q, with F by differences of the predicted mean, and Q in closed form."""
    move, cov = np.array([0.8, 0.0, 0.01]), np.diag([0.02, 0.01, 1e-3]) ** 2
    dt, time = 0.1, 2.0
    mean, P = used.mean.copy(), used.cov.copy()
    mean[:N] = [1.75, 0.01, 1e-4, 1e-5, -1.75, 0.01, 1e-4, 2e-5]
    n = len(mean)

    def predicted(at: Any, P: Any = P, cov: Any = cov) -> LaneFilter:
        used.mean, used.cov = at, P
        used.predict(move, cov, dt, WINDOWS, time)
        return used

    steps = np.append(np.tile(STEPS, 2), np.full(n - N, 1e-4))
    F = np.column_stack(
        [
            (predicted(mean + d).mean - predicted(mean - d).mean) / (2 * steps[i])
            for i, d in enumerate(np.diag(steps))
        ]
    )
    noise = predicted(mean, np.zeros((n, n)), np.zeros((3, 3))).cov.copy()
    moving = predicted(mean, np.zeros((n, n))).cov - noise
    got = predicted(mean, P, np.zeros((3, 3))).cov - noise
    scale = np.append(np.tile(AT_20, 2), np.ones(n - N))
    error = (got - F @ P @ F.T) / np.outer(scale, scale)
    assert np.abs(error).max() <= 2e-2 * np.abs(got / np.outer(scale, scale)).max()
    # Of each variable by itself: the gains of the lane and of the other variables.
    keep = np.append(np.ones(used.u.start), np.zeros(n - used.u.start))
    keep[used.u], keep[used.v], keep[used.b] = np.exp(-dt / time), 1.0, np.exp(-dt / 100.0)
    assert F[N:, N:] == pytest.approx(np.diag(keep[N:]), abs=1e-9)
    assert F[1, -1] == pytest.approx(0.02 * dt, rel=1e-3)  # a car that turns less than it says
    at = mean[:N].reshape(2, 4)
    turned = move - [0, 0, dt * 0.02 * mean[-1]]
    moved, _, G = move_lines(at, turned, WINDOWS)
    assert predicted(mean).mean[:N] == pytest.approx(moved.ravel(), rel=1e-9)
    G = G.reshape(N, 3)
    assert moving[:N, :N] == pytest.approx(G @ cov @ G.T, rel=1e-6, abs=1e-15)
    assert noise[N:, N:] == pytest.approx(np.diag(1 - keep[N:] ** 2), abs=1e-12)
    corner = noise[:N, :N] - road_noise(np.array(0.8), dt)
    share = (np.abs(moved[:, 3]).max() / 1e-3) ** 2 * 0.8 / 5.0
    expected = np.zeros((N, N))
    expected[np.ix_([0, 4], [0, 4])] = share * 0.1**2
    expected[np.ix_([1, 5], [1, 5])] = share * 0.05**2
    assert corner == pytest.approx(expected, rel=1e-6, abs=1e-15)


def test_what_a_corner_adds_is_limited() -> None:
    """Beyond the rate of a corner it is that of one, for the way in either direction."""
    found = []
    for rate, way in ((1e-3, 0.5), (-1e-2, 0.5), (1e-3, -0.5), (1e-5, 0.5)):
        lane_filter = LaneFilter()
        lane_filter.mean[[3, 7]] = rate
        lane_filter.cov[:] = 0
        lane_filter.predict(np.array([way, 0, 0]), np.zeros((3, 3)), 0.05, WINDOWS / 8, 1.0)
        found.append((lane_filter.cov[:N, :N] - road_noise(np.array(way), 0.05))[0, 0])
    assert found == pytest.approx([1e-3, 1e-3, 1e-3, 1e-7], rel=1e-9)


@pytest.mark.parametrize("handling", ["state", "consider"])
@pytest.mark.parametrize("side", [0, 1])
def test_a_camera_line_is_a_measurement_of_the_line_and_its_biases(
    used: LaneFilter, handling: Handling, side: int
) -> None:
    """The update of a Kalman filter with H = (line, sigmas of the biases), without that of v."""
    used.handle(handling)
    x, P, n = used.mean.copy(), used.cov.copy(), len(used.mean)
    rng = np.random.default_rng(8)
    A = rng.standard_normal((4, 4)) * np.array([0.05, 5e-3, 5e-4, 2e-5])[:, None]
    R = A @ A.T
    z = x[4 * side : 4 * side + 4] + np.array([0.05, 1e-3, -1e-5, 1e-7])
    H = np.zeros((4, n))
    H[:, 4 * side : 4 * side + 4] = np.eye(4)
    H[[0, 1, 2], [used.b.start, used.b.start + 1, used.b.start + 2]] = [0.05, 0.003, 5e-5]
    S = H @ P @ H.T + R
    r = z - H @ x
    K = P @ H.T @ np.linalg.inv(S)
    K[used.v] = 0
    if handling == "consider":
        K[used.u] = 0
    lines, covs = np.full((2, 4), 7.0), np.tile(np.eye(4), (2, 1, 1))
    lines[side], covs[side] = z, R
    seen = np.arange(2) == side
    distance = float(r @ np.linalg.solve(S, r))
    passed = used.update_camera(lines, covs, seen, gate=0.999 * distance)
    assert not passed.any()
    assert np.array_equal(used.mean, x)
    passed = used.update_camera(lines, covs, seen, gate=1.001 * distance)
    assert passed.tolist() == seen.tolist()
    assert used.mean == pytest.approx(x + K @ r, rel=1e-6, abs=1e-12)
    scale = np.sqrt(P.diagonal())
    expected = (np.eye(n) - K @ H) @ P @ (np.eye(n) - K @ H).T + K @ R @ K.T
    error = (used.cov - expected) / np.outer(scale, scale)
    assert np.abs(error).max() <= 1e-6
    assert np.array_equal(used.cov, used.cov.T)


def of_lines_alone(lane_filter: LaneFilter, cov: Any) -> Any:
    """Covariance of the lines without what is due to the pose error and to the biases."""
    others = np.r_[lane_filter.u, lane_filter.b]
    X = cov[:N, others]
    return cov[:N, :N] - X @ np.linalg.solve(cov[np.ix_(others, others)], X.T)


@pytest.mark.parametrize("rows", [ALL, np.arange(N) < 4])
@pytest.mark.parametrize("metres", [0.0, 1.5])
def test_scenes_are_no_more_certain_than_what_their_lines_have_of_their_own(
    metres: float, rows: Any
) -> None:
    """In no direction, however many they are: errors of the fit of a cubic, which are as a bend."""
    w = np.linspace(-1, 1, 30)
    to_cubic = np.linalg.pinv(lateral_jacobian(np.zeros(4), 20 + 40 * w))
    fit = to_cubic @ np.polynomial.chebyshev.chebvander(w, 3) * np.sqrt([0.2, 0.3, 2.0, 3.0])
    own: Any = np.kron(np.eye(2), 0.02**2 * fit @ fit.T)
    used = LaneFilter()
    for _ in range(60):
        used.predict(np.array([metres, 0, 0]), np.zeros((3, 3)), 0.1, WINDOWS, 5.0)
        own_there = own * np.outer(rows, rows)
        used.update_map(LANE * rows, loading() * rows[:, None], own_there, None, rows)
    there = np.flatnonzero(rows)
    rest = of_lines_alone(used, used.cov)[np.ix_(there, there)]
    least = eigh(rest, own[np.ix_(there, there)], eigvals_only=True)
    assert least[0] >= 1 - 1e-4
    assert np.linalg.eigvalsh(used.cov / np.outer(*[np.sqrt(used.cov.diagonal())] * 2))[0] > -1e-9


@pytest.mark.parametrize("noise", [None, 0.25 * OWN])
def test_a_scene_is_a_measurement_with_what_it_shares(used: LaneFilter, noise: Any) -> None:
    """H = (lane, loading, root of what the lines have of their own); only lane and biases learn."""
    x, P, n = used.mean.copy(), used.cov.copy(), len(used.mean)
    A, z = loading(), x[:N] + 0.01 * np.tile([1, 0, 0, 0], 2)
    H = np.zeros((N, n))
    H[:, :N], H[:, used.u], H[:, used.v] = np.eye(N), A, roots(OWN)
    R = OWN if noise is None else noise
    r = z - H @ x
    S = H @ P @ H.T + R
    if r @ np.linalg.solve(S, r) > CHANGE:
        P[:N, :N] += np.outer(r, r)
        S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    K[used.u], K[used.v] = 0, 0
    used.update_map(z, A, OWN, noise, ALL)
    assert used.mean == pytest.approx(x + K @ r, rel=1e-6, abs=1e-9)
    expected = (np.eye(n) - K @ H) @ P @ (np.eye(n) - K @ H).T + K @ R @ K.T
    own = roots(OWN) @ roots(OWN).T
    values, vectors = eigh(of_lines_alone(used, expected), own)
    lacking = own @ vectors  # v with v' own v = 1
    expected[:N, :N] += lacking * (1 - values).clip(0) @ lacking.T
    scale = np.sqrt(P.diagonal())
    assert np.abs((used.cov - expected) / np.outer(scale, scale)).max() <= 1e-6


@pytest.mark.parametrize("factor", [0.99, 1.01])
def test_a_scene_that_does_not_fit_adds_its_innovation(used: LaneFilter, factor: float) -> None:
    """Beyond the 95 % quantile of 8 variables, as variance of the lane along the innovation."""
    x, P, n = used.mean.copy(), used.cov.copy(), len(used.mean)
    H = np.zeros((N, n))
    H[:, :N], H[:, used.v] = np.eye(N), roots(OWN)
    S = H @ P @ H.T + OWN
    r = np.tile([1.0, 0, 0, 0], 2)
    r *= factor * np.sqrt(CHANGE / (r @ np.linalg.solve(S, r)))
    more = P.copy()
    more[:N, :N] += np.outer(r, r)
    P = more if factor > 1 else P
    S = H @ P @ H.T + OWN
    K = P @ H.T @ np.linalg.inv(S)
    K[used.u], K[used.v] = 0, 0
    used.update_map((H @ x) + r, np.zeros((N, 3)), OWN, None, ALL)
    assert used.mean == pytest.approx(x + K @ r, rel=1e-6, abs=1e-9)


def test_roots_cover_with_the_misfit_of_a_cubic() -> None:
    """By a variance of the curvature, and by next to nothing else; singular ones have a root."""
    for cov in (OWN, np.zeros((N, N))):
        R = roots(cov)
        got, expected = R @ R.T, cov + np.diag(np.tile([0, 0, 7e-5, 0], 2) ** 2)
        assert got == pytest.approx(expected, rel=3e-9, abs=2e-24)


# ---- a fleet of cars ----------------------------------------------------------------------------


def nees(handling: Handling, time: float, *, is_white: bool = False) -> Any:
    """Mean NEES of the lane centre at 0, 20 and 40 m of 40 cars that drive straight for 20 s.

    Each has pose errors that last for a time, a map error, a biased yaw rate, and a camera with a
    bias and with false lines, which fails for a third of the time. A filter may take the cycles as
    independent: as white noise.
    """
    cars, n, dt, speed, rng, e = 40, 100, 0.2, 15.0, np.random.default_rng(2), Errors()
    lanes, L = LaneFilter(3, handling, shape=(cars,)), np.diag(e.pose_sigma)
    pose, local, bias = (UnitGaussMarkov(rng, (cars, *shape)) for shape in ((3,), (2, 4), (3,)))
    constant = rng.standard_normal((cars, 2, 4)) * [e.map_offset, e.map_heading, 0, 0]
    scale = 1 + e.speed_scale * rng.standard_normal(cars)
    gyro = e.yaw_rate_bias * rng.standard_normal(cars)
    of_line = np.square([e.map_offset, e.map_heading, 0, 0]) + np.square(e.map_local)
    own_cov = np.broadcast_to(np.diag(np.tile(of_line, 2)), (cars, 8, 8))
    noise_cov = np.broadcast_to(np.diag(np.square(e.camera_sigma)), (cars, 2, 4, 4))
    moved = Motion.with_sigma(speed, 0.0, (e.speed_scale * speed + 0.01, e.yaw_rate_noise)).over(dt)
    windows, every = np.tile([-20.0, 80.0], (cars, 2, 1)), np.ones((cars, 8), dtype=bool)
    true = np.array([[1.75, 0, 0, 0], [-1.75, 0, 0, 0]])
    x, squares = np.array([0.0, 20.0, 40.0]), []
    for k in range(n):
        if k:
            displacement = moved.mean * np.column_stack([scale, scale, np.ones(cars)])
            displacement[:, 2] += dt * (gyro + e.yaw_rate_noise * rng.standard_normal(cars))
            displacement[:, 1] += displacement[:, 0] * displacement[:, 2] / 2
            cov = np.broadcast_to(moved.cov, (cars, 3, 3))
            lanes.predict(displacement, cov, dt, windows, time)
        delta = pose.step(dt / time) @ L.T
        own = constant + local.step(speed * dt / e.map_length) * e.map_local
        sent = transform_line_or_nan(true + own, delta[:, None], (windows[..., 0], windows[..., 1]))
        A = move_lines(sent, np.zeros((cars, 3)), windows)[2].reshape(cars, 8, 3) @ L
        if is_white:
            none = np.zeros_like(A), np.zeros_like(own_cov)
            lanes.update_map(sent.reshape(cars, 8), *none, A @ A.mT + own_cov, every)
        else:
            lanes.update_map(sent.reshape(cars, 8), A, own_cov, None, every)
        seen_bias = bias.step(dt / e.bias_time) * e.camera_bias
        if not e.outage[0] * n <= k < e.outage[1] * n:
            camera = true + rng.standard_normal((cars, 2, 4)) * e.camera_sigma
            camera[..., :3] += seen_bias[:, None]
            away = rng.choice([-1, 1], (cars, 2)) * rng.uniform(0.5, 2.0, (cars, 2))
            camera[..., 0] += (rng.random((cars, 2)) < e.false_lines) * away
            lanes.update_camera(camera, noise_cov, every[:, :2])
        left, right = lanes.mean[:, None, :4], lanes.mean[:, None, 4:8]
        J = np.concatenate([lateral_jacobian(one, x) for one in (left, right)], axis=-1) / 2
        centre = (lateral(left, x) + lateral(right, x)) / 2
        squares.append(centre**2 / np.einsum("sxi,sij,sxj->sx", J, lanes.cov[:, :8, :8], J))
    return np.mean(squares, axis=(0, 1))


@pytest.mark.parametrize("time", [1.0, 30.0])
@pytest.mark.parametrize("handling", ["state", "consider"])
def test_a_fleet_knows_its_error(handling: Handling, time: float) -> None:
    """Up to the upper bound for 40 cars; the pose error is a state, or considered (Schmidt)."""
    found = nees(handling, time)
    assert (found < 1.5).all()
    assert (found > 0.55).all()


def test_a_fleet_that_takes_cycles_as_independent_is_overconfident() -> None:
    assert nees("state", 30.0, is_white=True).max() > 3


def test_a_gauss_markov_process_keeps_its_variance_and_forgets() -> None:
    process = UnitGaussMarkov(np.random.default_rng(1), (20_000,))
    first, later = process.step(0.0), process.step(1.0)
    assert later.var() == pytest.approx(1.0, abs=0.04)
    assert np.mean(first * later) == pytest.approx(np.exp(-1), abs=0.03)
