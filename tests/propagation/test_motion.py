"""Displacement of the car within a time, and its uncertainty."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplines_can.propagation import MonteCarlo, Motion

N = 200_000


@given(st.floats(-40, 40), st.floats(-1, 1), st.floats(-2, 2))
def test_the_displacement_is_the_integral_of_the_velocity(
    speed: float, yaw_rate: float, dt: float
) -> None:
    """Gauss-Legendre integration of v cos(w t) and v sin(w t) gives the same displacement."""
    z, weights = np.polynomial.legendre.leggauss(24)
    heading = yaw_rate * dt * (z + 1) / 2
    shift = speed * dt / 2 * np.array([weights @ np.cos(heading), weights @ np.sin(heading)])

    assert np.allclose(Motion(speed, yaw_rate).over(dt).mean, [*shift, yaw_rate * dt], atol=1e-11)


@pytest.mark.parametrize("yaw_rate", [0.0, 5e-324, 1e-300, 1e-12, -1e-9])
def test_a_yaw_rate_of_almost_zero(yaw_rate: float) -> None:
    """No value is divided by the yaw rate."""
    x, y, heading = Motion(30.0, yaw_rate).over(0.5).mean

    assert x == 15.0
    assert y == pytest.approx(15.0 * yaw_rate / 4, rel=1e-12, abs=1e-300)
    assert heading == yaw_rate / 2


@pytest.mark.parametrize(
    ("motion", "dt", "time_sigma"),
    [
        ((20.0, 0.02, (0.5, 0.01)), 0.1, 0.0),
        ((8.0, 0.4, (0.3, 0.03)), 0.25, 0.005),
        ((20.0, 0.3, (1.0, 0.1)), -1.0, 0.005),
    ],
)
def test_over_agrees_with_monte_carlo(motion: Any, dt: float, time_sigma: float) -> None:
    """Within 5 standard errors, and 0.5 % of sigma for the error of 7 points."""
    motion = Motion.with_sigma(*motion)
    got = motion.over(dt, time_sigma)
    want = motion.over(dt, time_sigma, MonteCarlo(N, seed=2))

    assert (np.abs(got.mean - want.mean) <= (5 / np.sqrt(N) + 0.005) * want.sigma).all()
    assert (np.abs(got.sigma / want.sigma - 1) <= 5 / np.sqrt(2 * N) + 0.005).all()


def test_uncertainties_of_speed_yaw_rate_and_time_add_up() -> None:
    """Straight ahead: x by speed and time, heading by yaw rate, y by half the heading times x."""
    displacement = Motion.with_sigma(20.0, 0.0, (0.5, 0.02)).over(0.1, time_sigma=0.005)
    x, y, heading = displacement.sigma

    assert x == pytest.approx(np.hypot(0.5 * 0.1, 20.0 * 0.005), rel=1e-3)
    assert heading == pytest.approx(np.hypot(0.02 * 0.1, 0.02 * 0.005), rel=1e-2)
    assert y == pytest.approx(2.0 * heading / 2, rel=2e-2)
