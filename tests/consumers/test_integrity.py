"""Protection levels against the bivariate normal distribution and simulated hours."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter
from scipy.stats import multivariate_normal

from maplines_can.consumers.integrity import (
    availability,
    multiplier,
    onset,
    protection_level,
    risk_bound,
    samples_of,
)
from maplines_can.study.integrity.sampling import excursion_probability, nominal


@pytest.mark.parametrize("K", [0.5, 1.0, 3.0, 5.0])
@pytest.mark.parametrize("rho", [0.0, 0.3, 0.9, 0.995, 0.9999])
def test_an_onset_is_that_of_the_bivariate_normal(K: float, rho: float) -> None:
    both = sum(2 * multivariate_normal([0, 0], [[1, r], [r, 1]]).cdf([-K, -K]) for r in (rho, -rho))
    assert onset(K, rho) == pytest.approx(math.erfc(K / math.sqrt(2)) - both, rel=1e-6)


@given(st.floats(1e-12, 0.5), st.floats(0, 1000), st.floats(0.001, 10))
def test_the_level_has_the_risk(risk: float, time: float, period: float) -> None:
    K = multiplier(risk, time, period)
    assert risk_bound(K, time, period) == pytest.approx(risk, rel=1e-6)


def test_independent_samples_are_the_worst_case() -> None:
    levels = [multiplier(1e-7, time) for time in (0.0, 1.0, 10.0, 100.0, 1e6)]
    assert levels == sorted(levels, reverse=True)
    assert levels[0] == pytest.approx(-ndtri_(1e-7 / 72000 / 2), rel=1e-6)
    assert levels[-1] > -ndtri_(1e-7 / 2)


def ndtri_(p: float) -> float:
    from scipy.special import ndtri

    return float(ndtri(p))


def test_the_bound_covers_simulated_hours_and_is_close() -> None:
    """At a level that is exceeded in a few per cent of the hours, of 720 samples each."""
    period, time = 5.0, 20.0
    rho, n = math.exp(-period / time), samples_of(period)
    noise = np.random.default_rng(1).standard_normal((5000, n))
    noise[:, 1:] *= math.sqrt(1 - rho**2)
    u = lfilter([1.0], [1.0, -rho], noise, axis=1)
    K = multiplier(0.05, time, period)
    share = float((np.abs(u).max(axis=1) > K).mean())
    assert 0.035 < share < 0.05 + 3 * math.sqrt(0.05 / 5000)


def test_importance_sampling_agrees_with_simulated_hours() -> None:
    n, rho, K, rng = 700, 0.97, 3.3, np.random.default_rng(2)
    noise = rng.standard_normal((10_000, n))
    noise[:, 1:] *= math.sqrt(1 - rho**2)
    share = float((np.abs(lfilter([1.0], [1.0, -rho], noise, axis=1)).max(axis=1) > K).mean())
    sampled = excursion_probability(K, rho, n, 3000, rng)
    assert sampled.low < share + 0.006
    assert sampled.high > share - 0.006


@pytest.mark.parametrize("risk", [1e-5, 1e-7])
def test_the_risk_is_at_most_the_stated_one(risk: float) -> None:
    K, rng = multiplier(risk, 5.0), np.random.default_rng(3)
    sampled = excursion_probability(K, math.exp(-0.05 / 5), 72_000, 1000, rng)
    assert 0.2 * risk < sampled.value <= sampled.high <= risk


def test_a_level_that_is_too_low_is_found() -> None:
    """The level for 1e-4 does not have the risk 1e-5."""
    K, rng = multiplier(1e-4, 5.0), np.random.default_rng(4)
    assert excursion_probability(K, math.exp(-0.05 / 5), 72_000, 500, rng).low > 1e-5


def test_levels_are_multiples_of_sigma() -> None:
    sigma = np.array([[0.0, 0.1], [0.2, 0.3]])
    levels = protection_level(sigma, 1e-5, 5.0)
    assert levels == pytest.approx(sigma * multiplier(1e-5, 5.0))
    assert availability(levels, 1.0).available.tolist() == [[True, True], [False, False]]
    assert nominal(0.0) == 1.0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: protection_level(-0.1, 1e-5, 1.0), "sigma must be 0 m or more"),
        (lambda: protection_level(0.1, 0.0, 1.0), "risk must be more than 0"),
        (lambda: protection_level(0.1, 1e-5, -1.0), "correlation_time must be 0 s or more"),
        (lambda: protection_level(0.1, 1e-5, 1.0, 0.0), "period must be more than 0 s"),
        (lambda: availability(0.1, 0.0), "alert_limit must be more than 0 m"),
    ],
)
def test_wrong_arguments(call: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()  # type: ignore[operator]
