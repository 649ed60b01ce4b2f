"""Whiteness, chi-square thresholds and false alarms per hour of the consistency test."""

import math

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import block_diag
from scipy.stats import chi2, kstest

from maplines_can.consumers.residual_filter import (
    FAST,
    SLOW,
    WHITE_NOISE,
    CameraNoise,
    ResidualFilter,
    ResidualModel,
    threshold,
)
from maplines_can.consumers.residual_test import ConsistencyTest, window_lengths

DT, T = 0.05, 5.0
X = np.array([2.0, 20.0])
H = np.column_stack([np.zeros(2), -np.ones(2), -X])
MODEL = ResidualModel(
    H,
    np.diag([0.3, 0.1, 0.003]) ** 2,
    np.diag([0.02, 0.03]) ** 2,
    np.diag([0.03, 0.05]) ** 2,
    np.diag([0.05, 0.08]) ** 2,
)


def drawn(
    steps: int,
    cars: int,
    seed: int = 0,
    model: ResidualModel = MODEL,
    pose_time: float = T,
    noise_time: float = 0.0,
    heavy: bool = False,
    own_time: float = 0.0,
) -> np.ndarray:
    """(steps, cars, n) residuals, drawn from the definition of the model.

    The noise of the images lasts for a time, or has Student's t-distribution; what lines have of
    their own lasts for one time.
    """
    rng = np.random.default_rng(seed)
    z = np.zeros((steps, cars, len(model.H)))
    for cov, time, J in (
        (model.pose_cov, pose_time, model.H),
        (model.fast_cov, own_time or FAST, np.eye(2)),
        (model.slow_cov - model.fast_cov * (own_time > 0), max(own_time, SLOW), np.eye(2)),
        *([(model.noise_cov, noise_time, np.eye(2))] if noise_time else []),
    ):
        rho, root = math.exp(-DT / time), np.linalg.cholesky(cov)
        error = rng.standard_normal((cars, len(cov))) @ root.T
        for k in range(steps):
            z[k] += error @ J.T
            noise = rng.standard_normal((cars, len(cov))) @ root.T
            error = rho * error + math.sqrt(1 - rho**2) * noise
    if noise_time:
        return z
    white = rng.standard_normal(z.shape)
    if heavy:
        white *= np.sqrt(2 / rng.chisquare(4, (steps, cars, 1)))
    return z + white @ np.linalg.cholesky(model.noise_cov).T


def test_innovations_agree_with_filterpy() -> None:
    n = 2
    S = block_diag(MODEL.pose_cov, MODEL.fast_cov, MODEL.slow_cov)
    phi = np.diag(np.exp(-DT / np.repeat([T, FAST, SLOW], [3, n, n])))
    peer = KalmanFilter(dim_x=3 + 2 * n, dim_z=n)
    peer.x, peer.P, peer.F, peer.Q = np.zeros((7, 1)), S, phi, S - phi @ S @ phi.T
    peer.H, peer.R = np.hstack([H, np.eye(n), np.eye(n)]), MODEL.noise_cov
    ours = ResidualFilter()
    for k, z in enumerate(drawn(50, 1)[:, 0]):
        ours.predict(MODEL, DT if k else math.inf, T)
        w, _ = ours.update(z, MODEL)
        if k:
            peer.predict()
        peer.update(z[:, None])
        expected = float((peer.y.T @ np.linalg.inv(peer.S) @ peer.y).item())
        assert w @ w == pytest.approx(expected, rel=1e-6)


def test_innovations_are_white_and_standard_normal() -> None:
    filter_ = ResidualFilter((2000,))
    found = []
    for z in drawn(60, 2000):
        filter_.predict(MODEL, DT, T)
        found.append(filter_.update(z, MODEL)[0])
    w = np.array(found)
    assert kstest(w[-1].ravel(), "norm").pvalue > 1e-3
    for lag in (1, 2, 20):
        correlation = (w[lag:] * w[:-lag]).mean()
        assert abs(correlation) < 4 / math.sqrt(w[lag:].size)


@given(p=st.floats(1e-9, 0.5), n=st.integers(1, 16))
def test_the_threshold_is_that_of_scipy(p: float, n: int) -> None:
    assert threshold(p, n) == pytest.approx(chi2.isf(p, n), rel=1e-9)


@pytest.mark.parametrize(
    ("time", "longest"),
    [
        pytest.param(0.01, 32.0, id="shorter-than-a-cycle"),
        pytest.param(1.0, 32.0, id="1s"),
        pytest.param(5.0, 32.0, id="5s"),
        pytest.param(30.0, 128.0, id="30s"),
    ],
)
def test_the_longest_window_has_some_correlation_times(time: float, longest: float) -> None:
    """And at least 30 s, for which an error of a map or of a camera may last."""
    assert window_lengths(time)[-1] == longest


def test_false_alarms_are_as_designed() -> None:
    """At 10 per hour, 600 cars for 75 s should have 125, within 4 sigma."""
    cars, steps, rate = 600, 1500, 10.0
    test, number = ConsistencyTest(rate, (cars,)), 0
    calm = 0.0
    for z in drawn(steps, cars, seed=3):
        verdict = test.step(z, MODEL, DT, T)
        number += int(verdict.raised.sum())
        calm += (~verdict.alarm).sum() * DT / 3600
    assert abs(number - rate * calm) < 4 * math.sqrt(rate * calm)


@pytest.mark.parametrize(
    ("errors", "noise", "times"),
    [
        pytest.param({"noise_time": 1.0}, CameraNoise(1.0, heavy_tails=False), T, id="lasts-1s"),
        pytest.param({"heavy": True}, CameraNoise(), T, id="student-t4-and-lasting-stated"),
        pytest.param({"pose_time": 60.0}, WHITE_NOISE, (0.5, 60.0), id="pose-lasts-for-longer"),
    ],
)
def test_errors_in_the_stated_range_raise_no_more_alarms(
    errors: dict[str, float], noise: CameraNoise, times: float | tuple[float, float]
) -> None:
    """At 10 per hour, 400 cars for 75 s; who states less has at least 4 sigma more."""
    cars, rate = 400, 10.0
    numbers, calm = [], []
    z = drawn(1500, cars, 8, **errors)  # type: ignore[arg-type]
    for stated, time in ((noise, times), (WHITE_NOISE, np.min(times))):
        test = ConsistencyTest(rate, (cars,), stated)
        found = [test.step(row, MODEL, DT, time) for row in z]
        numbers.append(sum(int(one.raised.sum()) for one in found))
        calm.append(sum(int((~one.alarm).sum()) for one in found) * DT / 3600)
    excess = (numbers - rate * np.array(calm)) / np.sqrt(rate * np.array(calm))
    assert excess[0] < 3.3
    assert excess[1] > 4


@pytest.mark.parametrize("own_time", [5.0, 300.0])
def test_errors_of_lines_that_last_for_one_time_raise_no_more_alarms(own_time: float) -> None:
    """At 10 per hour, 400 cars for 75 s: the model does not know the time."""
    cars, rate, number, calm = 400, 10.0, 0, 0.0
    test = ConsistencyTest(rate, (cars,), WHITE_NOISE)
    for row in drawn(1500, cars, 12, own_time=own_time):
        verdict = test.step(row, MODEL, DT, T)
        number += int(verdict.raised.sum())
        calm += (~verdict.alarm).sum() * DT / 3600
    assert number - rate * calm < 3.3 * math.sqrt(rate * calm)


def test_an_outlier_is_no_alarm_and_a_jump_is() -> None:
    """Of 3 m, which is 40 sigma: for one image, and for good; the alarm lasts."""
    cars = 50
    z = drawn(400, cars, seed=9)
    for duration, first in ((1, None), (300, 8)):
        test = ConsistencyTest(0.01, (cars,), CameraNoise())
        wrong = z.copy()
        wrong[100 : 100 + duration] += 3.0
        alarm = np.array([test.step(row, MODEL, DT, (T, SLOW)).alarm for row in wrong])
        assert not alarm[:100].any()
        assert alarm[100 + (first or 0) :].all() if first else not alarm.any()


def test_an_alarm_ends_after_the_longest_window() -> None:
    test = ConsistencyTest(0.01)
    rows = drawn(2000, 1, seed=5)[:, 0]
    rows[10] += 3.0
    alarm = np.array([bool(test.step(row, MODEL, DT, T).alarm) for row in rows])
    (last,) = np.flatnonzero(np.diff(alarm.astype(int)) < 0)
    assert alarm[10]
    assert not alarm[:10].any()
    # The filter has to forget the outlier, which fails once more in the windows that contain it.
    assert 32.0 <= (last - 10) * DT < 66.0


def test_a_lasting_error_is_found_sooner_by_its_response() -> None:
    """Of 5 sigma from the beginning, by the first test that can show it; the time is 8 s or so."""
    z = drawn(700, 100, seed=10) + 0.6
    test = ConsistencyTest(0.01, (100,))
    alarms = np.array([test.step(row, MODEL, DT, (T, SLOW)).alarm for row in z])
    assert alarms[round(8.5 / DT)].mean() > 0.5
    assert alarms[-1].mean() > 0.9


@given(size=st.floats(-2.0, 2.0), steps=st.integers(1, 30), turn=st.floats(0.0, 0.02))
def test_the_response_is_what_a_constant_error_adds(size: float, steps: int, turn: float) -> None:
    """Two filters, one of which has the error from the beginning, differ by the response."""
    z = drawn(steps, 1, seed=11)[:, 0]
    for i, unit in enumerate(np.eye(3)):
        right, wrong = ResidualFilter(), ResidualFilter()
        for row in z:
            right.predict(MODEL, DT, T, turn)
            wrong.predict(MODEL, DT, T, turn)
            w, response = right.update(row, MODEL)
            other, _ = wrong.update(row + size * H @ unit, MODEL)
        assert other - w == pytest.approx(size * response[i], abs=1e-9)


def test_lines_that_come_and_go_do_not_hide_a_lasting_error() -> None:
    """The first line is always seen, the second one every other second; both are wrong for long."""
    z = drawn(3000, 1, seed=7)[:, 0] + 0.6
    one = ResidualModel(H[:1], MODEL.pose_cov, *(cov[:1, :1] for cov in MODEL[2:]))
    test = ConsistencyTest(0.01)
    alarms = [
        bool(
            test.step(row, MODEL, DT, T, keys=(0, 1)).alarm
            if k // 20 % 2
            else test.step(row[:1], one, DT, T, keys=(0,)).alarm
        )
        for k, row in enumerate(z)
    ]
    assert alarms[-1]


@pytest.mark.parametrize("frame", ["map", "ego"])
def test_whether_the_pose_error_turns_with_the_car_or_not(frame: str) -> None:
    """In a corner, sums of innovations have at most the variance that the test takes them to have.

    400 cars, 20 images of a turn by 1 rad, after some straight ones. The standard error of the mean
    square of their 800 sums is 0.05.
    """
    H = np.array([[0.0, -1.0, -2.0], [1.0, -1.0, -20.0]])
    model = ResidualModel(
        H, np.diag([0.2, 0.2, 0.003]) ** 2, 1e-6 * np.eye(2), 1e-6 * np.eye(2), 0.03**2 * np.eye(2)
    )
    rng = np.random.default_rng(2)
    cars, one = 400, ResidualFilter((400,))
    error = rng.standard_normal((cars, 3)) * [0.2, 0.2, 0.003]
    rho, squares = math.exp(-0.05 / 5.0), []
    total = np.zeros((cars, 2))
    for k in range(60):
        turn = 0.05 if k >= 40 else 0.0
        c, s = math.cos(turn), math.sin(turn)
        R = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) if frame == "map" else np.eye(3)
        new = rng.standard_normal((cars, 3)) * [0.2, 0.2, 0.003]
        error = rho * error @ R.T + math.sqrt(1 - rho**2) * new
        one.predict(model, 0.05, 5.0, turn)
        z = error @ H.T + 0.03 * rng.standard_normal((cars, 2))
        w, _ = one.update(z, model)
        total = total + w * (k >= 40)
        squares.append((w**2).mean())
    assert np.mean(squares[40:]) <= 1.05
    assert (total**2).mean() / 20 <= 1.15


@pytest.mark.parametrize("kept", [1.0, 0.5, 0.0])
def test_errors_of_a_new_fit_are_new(kept: float) -> None:
    """The variance of an innovation is that of the noise, of g, and of what f has anew."""
    own, noise = 0.08, 0.02
    eye = np.eye(2)
    model = ResidualModel(
        np.zeros((2, 3)), np.zeros((3, 3)), own**2 * eye, 1e-12 * eye, noise**2 * eye
    )
    one = ResidualFilter()
    for _ in range(400):
        one.predict(model, 0.05, 5.0)
        one.update(np.zeros(2), model)
    known = one._cov[9, 9]  # variance of f after an image
    one.predict(model, 0.05, 5.0, kept=np.full(2, kept))
    rho = min(kept, math.exp(-0.05 / 1.0))
    assert one._cov[9, 9] == pytest.approx(rho**2 * known + (1 - rho**2) * own**2, rel=1e-6)
