"""Prediction of the localisation: its Jacobian, its noise, and its closed forms."""

import math

import numpy as np
import pytest

from maplines_can.localisation import GaussMarkov, SensorErrors
from maplines_can.localisation.motion_model import N, initial, predict, speed_of

ERRORS = SensorErrors()
ONE = np.ones(1)


def state(rng: np.random.Generator) -> np.ndarray:
    """Return a (1, N) state of ordinary values."""
    scale = np.array([100, 100, 3, 0.1, 0.01, 0.02, 2, 2, 0.1, 0.01, 1, 1, 1])
    return (scale * rng.standard_normal(N))[None]


@pytest.mark.parametrize("seed", range(3))
def test_the_transition_is_the_derivative(seed: int) -> None:
    """f(x + w) = f(x) + F w for small w."""
    rng = np.random.default_rng(seed)
    x, P = state(rng), np.eye(N)[None]
    speed, rate, dt = 20 * ONE, 0.4 * ONE, 0.1
    mean, _, F = predict(x, P, speed, rate, dt, ERRORS)
    for i in range(N):
        w = 1e-5 * np.eye(N)[i]
        moved, _, _ = predict(x + w, P, speed, rate, dt, ERRORS)
        assert (moved - mean)[0] == pytest.approx(F[0] @ w, abs=2e-9)


def test_the_errors_stay_stationary() -> None:
    """Their variances are those of the processes at any time, and their means decay.

    That of the pose fixes decays with the way: here 150 m.
    """
    mean, cov = initial(np.zeros((1, 3)), np.zeros((3, 3)), ERRORS)
    mean[0, 3:] = ERRORS.sigmas
    for _ in range(50):
        mean, cov, _ = predict(mean, cov, 10 * ONE, 0.1 * ONE, 0.3, ERRORS)
    assert cov[0].diagonal()[3:] == pytest.approx(ERRORS.sigmas**2)
    decay = np.append(np.exp(-15.0 / ERRORS.times)[:-3], [math.exp(-150 / ERRORS.fix_distance)] * 3)
    assert mean[0, 3:] == pytest.approx(ERRORS.sigmas * decay)


def test_a_constant_error_remains() -> None:
    errors = SensorErrors(wheel_scale=GaussMarkov(0.01))
    mean, cov = initial(np.zeros((1, 3)), np.zeros((3, 3)), errors)
    mean[0, 5] = 0.01
    mean, cov, _ = predict(mean, cov, 10 * ONE, 0 * ONE, 1.0, errors)
    assert mean[0, 0] == pytest.approx(10.1)
    assert speed_of(mean, 10 * ONE) == pytest.approx(10.1)
