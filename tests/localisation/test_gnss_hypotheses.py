"""The filter finds out how large the error of GNSS is, unless a fix or the caller says so."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from maplines_can import Gaussian
from maplines_can.localisation import (
    GaussMarkov,
    GnssFix,
    Localisation,
    Odometry,
    SensorErrors,
    gnss_hypotheses,
)
from maplines_can.localisation.association import Verdict
from maplines_can.localisation.gnss_hypotheses import bank, hypotheses, renewed, stated, weighed
from maplines_can.localisation.motion_model import GNSS, POSE, N, initial
from maplines_can.localisation.observation_models import Innovation

Array = NDArray[np.float64]

START = np.diag([2.0, 2.0, 0.02]) ** 2
WHITE = np.eye(2)
SPEED = 10.0
CARS = 12


def errors_of(sigma: float, time: float, seconds: float, seed: int, rate: float = 5.0) -> Array:
    """Return (k, CARS, 2) Gauss-Markov errors."""
    rng = np.random.default_rng(seed)
    phi = math.exp(-1 / (rate * time))
    found = rng.standard_normal((round(seconds * rate), CARS, 2))
    for k in range(1, len(found)):
        found[k] = phi * found[k - 1] + math.sqrt(1 - phi**2) * found[k]
    return sigma * found


def drive(
    off: Array, then: Callable[[float, Localisation], Any], cov: Array = WHITE, **settings: Any
) -> Localisation:
    """Drive on a circle, with fixes that are off by (k, CARS, 2), 5 times a second."""
    rng = np.random.default_rng(1)
    turn = 0.1
    start = np.sqrt(START.diagonal()) * rng.standard_normal((CARS, 3))
    error = settings.pop("error", None)
    localisation = Localisation(start, cov=START, **settings)
    white = rng.standard_normal(off.shape)
    for i in range(2 * len(off)):
        t = 0.1 * i
        slip = 0.05 * rng.standard_normal(CARS)
        localisation.add(Odometry(t, SPEED + slip, np.full(CARS, turn)))
        if i % 2 == 0:
            fix = place(t) + off[i // 2] + white[i // 2]
            localisation.add(GnssFix(t, fix, cov, error))
        then(t, localisation)
    return localisation


def place(t: float) -> Array:
    return np.array([math.sin(0.1 * t), 1 - math.cos(0.1 * t)]) * SPEED / 0.1


def nees(t: float, localisation: Localisation) -> Array:
    """Return (CARS,) normalised errors squared of the position."""
    mean, cov, known = localisation.poses()
    assert known.all()
    e, P = mean[:, :2] - place(t), cov[:, :2, :2]
    return np.asarray((e * np.linalg.solve(P, e[..., None])[..., 0]).sum(axis=-1))


def test_a_canyon_is_found_out() -> None:
    """An error of 15 m for 20 s: 2 is right, the mean of 12 cars and 60 s within a factor of 2."""
    found: list[Array] = []
    localisation = drive(
        errors_of(15.0, 20.0, 60.0, 3),
        lambda t, one: found.append(nees(t, one)) if round(10 * t) % 10 == 0 else None,
        10.0**2 * np.eye(2),  # all of it stated as white
    )
    assert np.mean(found) < 4
    assert np.median(localisation.gnss_sigma()) >= 10


@pytest.mark.parametrize(
    ("gnss", "least", "most"),
    [(GaussMarkov(2.1, 60.0), 0.1, 3.0), (None, 0.1, 4.0), (GaussMarkov(0.0), 20.0, math.inf)],
)
def test_a_constant_error_is_covered_unless_it_is_taken_as_white(
    gnss: GaussMarkov | None, least: float, most: float
) -> None:
    """Of 1.4 m and 0.4 m for a minute, as in a recorded drive: a state, found out, white noise."""
    found: list[Array] = []

    def evaluate(t: float, localisation: Localisation) -> None:
        if t > 30.0 and round(10 * t) % 10 == 0:
            found.append(nees(t, localisation))

    off = np.tile([1.4, 0.4], (300, CARS, 1))
    drive(off, evaluate, errors=SensorErrors(gnss=gnss))
    assert least < np.mean(found) < most


def test_the_error_is_raised_and_lowered_in_time() -> None:
    """At the begin of a canyon within 5 s, and after its end within 60 s, in most cars."""
    off = np.concatenate(
        [
            errors_of(1.5, 60.0, 20.0, 5),
            errors_of(20.0, 20.0, 30.0, 6),
            errors_of(1.5, 60.0, 60.0, 7),
        ]
    )
    at: dict[float, Array] = {}
    drive(off, lambda t, one: at.__setitem__(round(t, 1), one.gnss_sigma()))
    assert np.median(at[19.0]) == 1.5
    assert np.median(at[25.0]) >= 10
    assert np.median(at[109.0]) <= 4


def test_an_error_that_is_told_may_change_at_once() -> None:
    """A step process of 20 m and 20 s has the autocorrelation that is told, but not its increments.

    Five fixes after a step come within a second. 12 cars of 100 s have 60 steps.
    """
    rng = np.random.default_rng(21)
    off = 20.0 * rng.standard_normal((500, CARS, 2))
    stays = rng.random((500, CARS)) > -math.expm1(-0.2 / 20.0)
    for k in range(1, len(off)):
        off[k] = np.where(stays[k, :, None], off[k - 1], off[k])
    assert (~stays[1:]).sum() > 30
    told, found = GaussMarkov(20.0, 20.0), list[Array]()

    def then(t: float, localisation: Localisation) -> None:
        if t > 10.0:
            found.append(nees(t, localisation))

    drive(off, then, errors=SensorErrors(gnss=told))
    assert 0.7 < np.mean(found) < 4.0


def test_wrong_odometry_is_not_taken_for_an_error_of_gnss() -> None:
    """Cars that drive on while their odometry says that they stand have no pose soon."""
    localisation = Localisation(np.zeros((1, 3)), cov=START)
    lost = math.inf
    for i in range(400):
        t = 0.1 * i
        v = max(SPEED - max(t - 20.0, 0.0) * 8.0, 0.0)
        localisation.add(Odometry(t, np.array([v]), np.zeros(1)))
        if i % 2 == 0:
            localisation.add(GnssFix(t, np.array([[SPEED * t, 0.0]]), 0.4**2 * np.eye(2)))
        if not localisation.known[0]:
            lost = min(lost, t)
    assert 20.0 < lost < 30.0


def test_a_fix_that_states_its_error_is_as_a_filter_that_is_told() -> None:
    """From the first one on, to the last digit."""
    off = errors_of(15.0, 20.0, 10.0, 3)
    told = GaussMarkov(15.0, 20.0)
    one = drive(off, nees, errors=SensorErrors(gnss=told))
    other = drive(off, nees, errors=SensorErrors(gnss=told), error=told)
    np.testing.assert_array_equal(one.poses().mean, other.poses().mean)
    np.testing.assert_array_equal(one.poses().cov, other.poses().cov)
    np.testing.assert_array_equal(one.gnss_bias(), other.gnss_bias())
    assert np.abs(one.gnss_bias()).max() > 1.0


@pytest.mark.parametrize("gnss", [None, GaussMarkov(1.5, 60.0)], ids=["not known", "known"])
def test_what_a_fix_states_overrides_what_the_filter_holds(gnss: GaussMarkov | None) -> None:
    """The filter is as sure as one that is told so, and those that state nothing are as before."""
    error = np.full((CARS, 2), np.nan)
    error[: CARS // 2] = 15.0, 20.0
    off = errors_of(15.0, 20.0, 15.0, 3)
    told = drive(off, lambda *_: None, errors=SensorErrors(gnss=GaussMarkov(15.0, 20.0)))
    none = drive(off, lambda *_: None, errors=SensorErrors(gnss=gnss))
    some = drive(off, lambda *_: None, errors=SensorErrors(gnss=gnss), error=error)
    half = slice(0, CARS // 2)
    assert (some.gnss_sigma()[half] == 15.0).all()
    ratio = some.poses().cov[half, 0, 0] / told.poses().cov[half, 0, 0]
    # One that does not know GNSS is not sure of the odometry, either.
    assert (np.abs(ratio - 1) < 0.5).all()
    rest = slice(CARS // 2, CARS)
    np.testing.assert_allclose(some.poses().mean[rest], none.poses().mean[rest], atol=1e-9)


@pytest.mark.parametrize(("before", "after"), [(1.5, 15.0), (15.0, 1.5), (4.0, 4.0), (0.0, 2.0)])
def test_an_error_of_another_size_keeps_the_smaller_variance(before: float, after: float) -> None:
    """The covariance of both is the smaller variance; each has its own."""
    errors = SensorErrors(gnss=GaussMarkov(before, 60.0))
    held = bank(1, 0.0, errors)
    mean, cov = initial(np.zeros((1, 3)), START, errors)
    mean[:, GNSS] = 1.0
    mean, cov, factor, held = stated(mean, cov, held, np.array([[after, 20.0]]), hypotheses(errors))
    assert np.diagonal(cov[0])[GNSS] == pytest.approx(after**2)
    assert factor[0, GNSS] * before**2 == pytest.approx(min(before, after) ** 2)
    np.testing.assert_array_equal(mean[0, GNSS], factor[0, GNSS])
    assert held.gnss_sigma.tolist() == [after]


def test_a_renewal_keeps_the_pose_and_forgets_the_error() -> None:
    """After ages, each hypothesis has the pose of the bank and its own error, unknown."""
    errors = SensorErrors()
    held = bank(1, 0.0, errors)
    K = held.weight.shape[1]
    mean, cov = initial(np.ones((K, 3)), np.tile(START, (K, 1, 1)), errors, held.rows)
    mean[:, GNSS], cov[:, GNSS, GNSS] = 9.0, 0.01 * np.eye(2)
    mean, cov, factor, held = renewed(mean, cov, held, np.array([True]), 1e9)
    np.testing.assert_allclose(mean[:, POSE], 1.0)
    np.testing.assert_allclose(mean[:-1, GNSS], 0.0, atol=1e-12)
    np.testing.assert_allclose(cov[:-1, GNSS.start, GNSS.start], held.gnss_sigma[:-1] ** 2)
    np.testing.assert_allclose(held.weight[0], gnss_hypotheses.PRIOR)
    assert (factor[:-1, GNSS] == 0).all()
    assert (factor[:, POSE] == 1).all()


def test_a_fix_that_all_reject_says_nothing() -> None:
    held = bank(1, 0.0, SensorErrors())
    K = held.weight.shape[1]
    residual, S = np.full((K, 1, 2), 1e3), np.tile(np.eye(2), (K, 1, 1, 1))
    verdict = np.full((K, 1), Verdict.OUTLIER, dtype=np.intp)
    found = Innovation("gnss", residual, np.zeros((K, 1, 2, N)), S, S, verdict)
    after = weighed(held, found, np.array([True]), 10.0)
    np.testing.assert_allclose(after.weight, held.weight)


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        ((-1.0, 20.0), "COVARIANCE"),
        ((1.0, 0.0), "COVARIANCE"),
        ((math.inf, 20.0), "COVARIANCE"),
        ((1.0, math.nan), "COVARIANCE"),
        ((1.0,) * 3, "INVALID"),
        ("large", "INVALID"),
    ],
)
def test_a_wrong_statement_is_refused(error: Any, reason: str) -> None:
    """With a counted reason, and without an effect."""
    localisation = Localisation(Gaussian(np.zeros(3), START))
    localisation.add(Odometry(1.0, np.array([SPEED]), np.zeros(1)))
    before = localisation.poses()
    localisation.add(GnssFix(1.0, np.array([[30.0, 0.0]]), WHITE, error))
    np.testing.assert_array_equal(localisation.poses().mean, before.mean)
    assert localisation.counts()["GnssFix"] == {reason: 1}
