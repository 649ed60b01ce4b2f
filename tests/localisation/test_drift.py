"""Drift of GNSS: the response of the filter to a ramp, and what is stated while GNSS has one."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from maplines_can.localisation import GaussMarkov, GnssFix, Localisation, Odometry, SensorErrors

Array = NDArray[np.float64]

START = np.diag([2.0, 2.0, 0.02]) ** 2
SPEED, WHITE, CARS = 20.0, 0.4, 8
TOLD = SensorErrors(gnss=GaussMarkov(1.5, 60.0))


def drive(
    seconds: float,
    rate: tuple[float, float] | Array,
    begin: float,
    seed: int = 0,
    cars: int = CARS,
    errors: SensorErrors = TOLD,
) -> tuple[Localisation, Array, Array]:
    """Drive straight on, with a ramp of GNSS from a time on, of all cars or (n, 2).

    Returns:
        The filter, and (k, n) normalised errors of the position and whether they are known, twice a
        second.
    """
    rng, found, known = np.random.default_rng(seed), [], []
    start = np.sqrt(START.diagonal()) * rng.standard_normal((cars, 3))
    localisation = Localisation(start, errors=errors, cov=START)
    scale, bias = 0.01 * rng.standard_normal(cars), math.radians(0.2) * rng.standard_normal(cars)
    off, phi = rng.standard_normal((cars, 2)), math.exp(-0.2 / 60.0)
    for i in range(round(seconds * 10)):
        t = 0.1 * i
        turn = math.radians(0.02) * math.sqrt(10.0) * rng.standard_normal(cars)
        localisation.add(Odometry(t, SPEED / (1 + scale), bias + turn))
        if i % 2:
            continue
        off = phi * off + math.sqrt(1 - phi**2) * rng.standard_normal((cars, 2))
        ramp = max(t - begin, 0.0) * np.array(rate)
        place = np.array([SPEED * t, 0.0])
        noise = WHITE * rng.standard_normal((cars, 2))
        localisation.add(GnssFix(t, place + ramp + 1.5 * off + noise, WHITE**2 * np.eye(2)))
        if i % 5 == 0:
            mean, cov, is_known = localisation.poses()
            e = mean[:, :2] - place
            found.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(cov[:, :2, :2]), e) ** 0.5)
            known.append(is_known)
    return localisation, np.array(found), np.array(known)


@pytest.mark.parametrize("errors", [TOLD, SensorErrors()], ids=["told", "found out"])
@pytest.mark.parametrize("rate", [(1.0, 0.0), (0.0, -1.0)], ids=["along", "across"])
def test_a_ramp_of_1_m_a_second_is_covered(rate: tuple[float, float], errors: SensorErrors) -> None:
    """For 50 s, up to 50 m: most of the cars are at most 4 stated sigmas off all the time."""
    _, sigmas, known = drive(80.0, rate, 30.0, errors=errors)
    worst = np.where(known, sigmas, 0.0).max(axis=0)
    assert np.median(worst) < 4.0
    assert (worst < 5.0).mean() >= 0.75


def test_a_slow_ramp_is_covered_if_it_is_stated() -> None:
    """Of 0.1 m/s, up to 9 m: nothing tells it from the wheel scale, or from the heading."""
    rate = (0.07, -0.07)
    _, denied, _ = drive(100.0, rate, 10.0, cars=4)
    _, stated, known = drive(100.0, rate, 10.0, cars=4, errors=replace(TOLD, gnss_drift=0.04))
    assert known.all()
    assert (denied.max(axis=0) > 4.0).all()
    assert (stated.max(axis=0) < 4.0).all()


def test_what_a_stated_ramp_adds_is_right() -> None:
    """100 cars, each with a rate of its own of that size: the mean NEES of two values is 2."""
    sigma, cars = 0.05, 100
    rates = sigma * np.random.default_rng(7).standard_normal((cars, 2))
    _, sigmas, known = drive(60.0, rates, 0.0, 5, cars, replace(TOLD, gnss_drift=sigma))
    assert (sigmas[-1, known[-1]] ** 2).mean() == pytest.approx(2.0, abs=4 * 2 / math.sqrt(cars))


def test_without_a_ramp_nothing_grows() -> None:
    """The stated covariance is that of the filter, and right, but for what 1e-3 of ramps show."""
    localisation, sigmas, known = drive(110.0, (0.0, 0.0), 0.0, seed=1)
    assert known.all()
    assert localisation.gnss_sigma().tolist() == [1.5] * CARS
    assert 0.5 < (sigmas[40:] ** 2).mean() < 4.0


def test_the_response_is_what_a_ramp_changes() -> None:
    """Of two filters, one of which has a slow ramp, since the response is to first order."""
    rate = np.array([3e-4, -2e-4])
    one, _, _ = drive(40.0, (0.0, 0.0), 0.0, seed=2, cars=2)
    begin = one._points[-1].ramps.begin
    for j in range(0, len(begin) - 1, 4):
        other, _, _ = drive(40.0, tuple(rate), float(begin[j]), seed=2, cars=2)
        points = one._points[-1], other._points[-1]
        change = points[1].mean - points[0].mean
        expected = (rate @ points[0].ramps.response[:, j]).squeeze()
        assert change == pytest.approx(expected, abs=2e-2 * np.abs(expected).max())


def test_the_squared_distances_are_chi_square() -> None:
    """With two degrees of freedom for each begin: 200 cars, by mean and 1 % quantile."""
    localisation, _, _ = drive(40.0, (0.0, 0.0), 0.0, seed=3, cars=200)
    ramps: Any = localisation._points[-1].ramps
    old = localisation.t - ramps.begin >= 5.0
    squared = ramps.squared[:, old]
    assert squared.mean(axis=0) == pytest.approx(2.0, abs=4 * 2 / math.sqrt(200))
    assert ((squared > chi2.isf(0.01, 2)).mean(axis=0) < 0.04).all()


def test_no_ramp_is_sought_in_a_canyon() -> None:
    """Fixes that jump by 10 m each 8 s: another hypothesis is the likeliest, no ramp is valid."""
    localisation = Localisation(np.zeros((1, 3)), cov=START)
    rng = np.random.default_rng(6)
    for i in range(400):
        t = 0.1 * i
        localisation.add(Odometry(t, np.array([SPEED]), np.array([0.0])))
        if i % 80 == 0:
            off = 10.0 * rng.standard_normal((1, 2))
        if i % 2 == 0:
            localisation.add(GnssFix(t, np.array([[SPEED * t, 0.0]]) + off, WHITE**2 * np.eye(2)))
        point = localisation._points[-1]
        is_open = point.bank.weight[0].argmax() == 0
        assert is_open or not point.ramps.valid.any()
    assert not is_open
