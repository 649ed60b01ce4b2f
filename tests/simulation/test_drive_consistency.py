"""Whether the errors of a drive are as large as stated: a test with stated error rates."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.stats import binom

from maplines_can.simulation.accuracy import Accuracy, MapPart
from maplines_can.simulation.sender_consistency import (
    WRONG,
    SenderVerdict,
    consistency_of,
    independent_errors,
)
from maplines_can.simulation.truth import PLACES

Array = NDArray[np.float64]
PERIOD, SLOTS = 0.05, 4


def gauss_markov(n: int, T: float, seed: int) -> Array:
    """(n,) errors of variance 1 with a correlation time [s], one for each period."""
    noise, rho = np.random.default_rng(seed).standard_normal(n), np.exp(-PERIOD / T)
    noise[1:] *= np.sqrt(1 - rho**2)
    return np.asarray(lfilter([1.0], [1.0, -rho], noise))


def accuracy_of_errors(errors: Array, sigma: float = 0.1) -> Accuracy:
    """Errors [standard deviations] of all lines of each cycle, the same at all places."""
    n = len(errors)
    sigmas = np.repeat(errors, SLOTS)[:, None] * np.ones(len(PLACES))
    nothing = np.full_like(sigmas, np.nan)
    return Accuracy(
        {"lateral": sigma * sigmas, "heading": nothing, "curvature": nothing}
        | dict.fromkeys(("absolute", "relative"), nothing[:, :1]),
        np.tile(np.arange(SLOTS), n),
        np.repeat(PERIOD * np.arange(n), SLOTS),
        sigmas,
        *(SLOTS * n, 0, 0, 0, 0),
        MapPart(sigmas, sigmas, sigmas),
    )


def verdict(errors: Array) -> SenderVerdict:
    found = consistency_of(accuracy_of_errors(errors))
    assert found is not None
    return found.verdict


@pytest.mark.parametrize("T", [0.5, 5.0, 20.0])
def test_a_sender_that_is_right_is_seldom_called_wrong(T: float) -> None:
    """In drives of 60 s; the probability is at most as stated, but for that of 1e-4."""
    found = [verdict(gauss_markov(1200, T, seed)) for seed in range(60)]
    assert found.count(SenderVerdict.WRONG) <= binom.isf(1e-4, len(found), WRONG)
    assert found.count(SenderVerdict.RIGHT) >= 0.9 * len(found)


@pytest.mark.parametrize("T", [0.5, 5.0])
def test_a_sender_that_states_a_third_of_its_errors_is_wrong(T: float) -> None:
    """In drives of 300 s."""
    found = [verdict(3 * gauss_markov(6000, T, seed)) for seed in range(10)]
    assert found == [SenderVerdict.WRONG] * len(found)


def test_a_short_drive_does_not_tell() -> None:
    """One error of 3 sigma is unlikely, one of 2 sigma is not; one of 10 sigma is no chance."""
    assert verdict(np.full(100, 2.0)) is SenderVerdict.RIGHT
    assert verdict(np.full(100, 3.0)) is SenderVerdict.UNCLEAR
    assert verdict(np.full(100, 10.0)) is SenderVerdict.WRONG


@given(st.integers(2, 300), st.floats(1e-3, 1e3))
def test_the_number_of_independent_errors_is_known_at_the_limits(n: int, scale: float) -> None:
    """1 if the error persists or only changes its sign, n if each is alone; of any size."""
    signs = np.resize([1.0, -1.0], n)
    assert independent_errors(scale * np.ones(n)) == pytest.approx(1, abs=1e-6)
    assert independent_errors(scale * signs) == pytest.approx(1, abs=1e-6)
    assert independent_errors(scale * np.eye(n)[0]) == pytest.approx(n, rel=1e-6)


@pytest.mark.parametrize("T", [0.25, 1.0, 4.0])
def test_the_number_of_independent_errors_is_that_of_a_gauss_markov_error(T: float) -> None:
    """The duration over T: the integral of exp(-2 |t| / T) is T."""
    n = 20_000
    found = [independent_errors(gauss_markov(n, T, seed)) for seed in range(10)]
    assert np.mean(found) == pytest.approx(n * PERIOD / T, rel=0.2)


@pytest.mark.parametrize(
    ("scale", "sigma", "words"),
    [
        pytest.param(1.0, 0.01, ["The sender is right: ", "stated sigma of 1 to 1 cm"], id="fine"),
        pytest.param(1.0, 0.5, ["The sender is right, but its sigma is large: ", "50 to 50 cm",
                                "a smaller --sigma"], id="large"),
        pytest.param(5.0, 0.1, ["The sender is wrong: ", "states too small a covariance"],
                     id="wrong"),
    ],
)  # fmt: skip
def test_the_sentence(scale: float, sigma: float, words: list[str]) -> None:
    """Whether the sender is right, how large its errors are, and what to do."""
    accuracy = accuracy_of_errors(scale * gauss_markov(4000, 1.0, 7), sigma)
    found = consistency_of(accuracy)
    assert found is not None
    text = found.text(accuracy)
    assert text.startswith(words[0])
    assert all(word in text for word in words)
    assert f"{found.ratio:.2g} times" in text


def test_no_error_gives_no_verdict() -> None:
    assert consistency_of(accuracy_of_errors(np.empty(0))) is None
