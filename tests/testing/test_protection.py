"""Tests of assert_protected: false alarms, power, and what its messages say."""

from typing import Any

import numpy as np
import pytest
from scipy.special import ndtri
from support.lasting_errors import Array, N, T, gauss_markov

from maplines_can.consumers import protection_level
from maplines_can.consumers.integrity import HOUR
from maplines_can.testing import assert_protected


def fails(error: Array, risk: float) -> bool:
    level = np.full(len(error), -ndtri(risk / 2))
    try:
        assert_protected(level, error, risk)
    except AssertionError:
        return True
    return False


@pytest.mark.parametrize("risk", [1e-5, 1e-3, 0.01, 0.2])
@pytest.mark.parametrize("time", [0, 20, 240])
def test_right_levels_pass(risk: float, time: float) -> None:
    """1 % of false alarms at most: 8 of 200 have the probability 1e-3."""
    rng = np.random.default_rng(int(time))

    assert sum(fails(gauss_markov(rng, time=time)[:, 0], risk) for _ in range(200)) < 8


@pytest.mark.parametrize(("risk", "time", "least"), [(0.01, 0, 99), (0.001, 0, 60), (0.05, 6, 50)])
def test_levels_that_are_20_percent_too_low_are_found(risk: float, time: float, least: int) -> None:
    rng = np.random.default_rng(int(time))
    runs = (1.25 * gauss_markov(rng, time=time)[:, 0] for _ in range(100))

    assert sum(fails(error, risk) for error in runs) >= least


def test_a_risk_in_a_time_is_that_of_its_spans() -> None:
    """Levels of the risk of an hour; one excess in a minute is too much."""
    level = np.full(N, protection_level(0.1, 0.2, correlation_time=1.0))
    error = np.zeros(N)
    error[100:103] = 0.6

    assert assert_protected(level, error, 0.2, per=10.0, t=T).episodes == 1
    with pytest.raises(AssertionError, match=r"1 episode, but 1e-05 are expected .* in 3600 s"):
        assert_protected(level, error, 1e-5, per=HOUR, t=T)
    error[200::200] = -0.6
    with pytest.raises(AssertionError, match=r"in 6 episodes, but 1\.2 are expected"):
        assert_protected(level, error, 0.2, per=10.0, t=T)


def test_message() -> None:
    error = np.zeros(N)
    error[[100, 101, 500, 900]] = 0.4, 0.5, -0.6, 0.4

    with pytest.raises(AssertionError) as caught:
        assert_protected(np.full(N, 0.3), error, 1e-4, t=T)
    text = str(caught.value)
    assert "4 of 1200 errors exceed their level, in 3 episodes, but 0.12 are expected" in text
    assert "from 5 to 5.05 s, with an error of 0.5 and a level of 0.3" in text
    assert "the bound is 0.005" in text
    assert "look at: the standard deviations under the levels" in text


def test_an_infinite_level_promises_nothing() -> None:
    assert assert_protected(np.full(N, np.inf), np.full(N, 1e9), 1e-7).excesses == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"risk": 1.5}, "risk must be more than 0 and less than 1, got 1.5"),
        ({"confidence": 0.2}, "confidence must be 0.5 or more"),
        ({"per": 3600.0}, "per must be more than 0 s, and needs the times t"),
        ({"levels": np.full(N, -1.0)}, "levels must be 0 or more"),
        ({"levels": np.ones(3)}, r"must be \(n,\) with n >= 1, got \(3,\) and \(1200,\)"),
        ({"risk": 0.1, "per": 3600.0, "t": T}, "too short: if each error exceeded its level"),
    ],
)
def test_a_wrong_argument_is_named(arguments: dict[str, Any], message: str) -> None:
    right: dict[str, Any] = {"levels": np.ones(N), "errors": np.zeros(N), "risk": 0.01}

    with pytest.raises(ValueError, match=message):
        assert_protected(**right | arguments)
