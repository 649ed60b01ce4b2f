"""The covering sum of Gauss-Markov processes, against their covariances and spectra."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplines_can.consumers.error_times import cover


def covariance(t: np.ndarray, time: float) -> np.ndarray:
    """Covariance of a process of variance 1 at some times."""
    apart = np.abs(t[:, None] - t)
    return np.exp(-apart / time) if time > 0 else np.eye(len(t))


def spectrum(w: np.ndarray, time: float, period: float) -> np.ndarray:
    """Sum of the autocorrelations of a sampled process, of variance 1, at w radians a sample."""
    rho = np.exp(-period / time) if time > 0 else 0.0
    return (1 - rho**2) / np.abs(1 - rho * np.exp(-1j * w)) ** 2


times = st.one_of(st.just(0.0), st.floats(0.01, 1000.0))


@given(
    span=st.tuples(times, times).map(sorted),
    where=st.floats(0.0, 1.0),
    period=st.floats(0.01, 0.2),
    most=st.integers(2, 8),
    seen=st.sets(st.integers(0, 400), min_size=2, max_size=40),
)
def test_the_sum_covers_each_time_in_the_range(
    span: list[float], where: float, period: float, most: int, seen: set[int]
) -> None:
    """Also between the nodes, and in images of which some are missing."""
    low, high = span
    true = low + where**4 * (high - low)
    found = cover(low, high, period, most)
    t = period * np.array(sorted(seen))
    total = found.weight * sum(covariance(t, node) for node in found.times)
    assert np.linalg.eigvalsh(total - covariance(t, true))[0] > -1e-9
    assert len(found.times) <= most


@pytest.mark.parametrize(
    ("low", "high"),
    [
        pytest.param(0.0, 1.0, id="white-to-1s"),
        pytest.param(0.0, 0.1, id="white-to-two-images"),
        pytest.param(1.0, 600.0, id="unknown-pose-error"),
        pytest.param(5.0, 6.0, id="narrow"),
    ],
)
def test_two_nodes_have_the_least_weight(low: float, high: float) -> None:
    """At some frequency, the spectrum of the sum is that of some time in the range."""
    w = np.geomspace(1e-6, np.pi, 3000)
    found = cover(low, high, 0.05, 2)
    total = found.weight * sum(spectrum(w, node, 0.05) for node in found.times)
    inner = np.geomspace(max(low, 0.002), high, 400)
    needed = np.max([spectrum(w, T, 0.05) for T in [low, *inner]], axis=0)
    assert (total / needed).min() == pytest.approx(1.0, abs=1e-3)


def test_a_known_time_is_one_process() -> None:
    assert cover(0.0, 0.0, 0.05).times.tolist() == [0.0]
    assert cover(7.0, 7.0, 0.05).weight == 1.0


def test_equal_times_have_half_the_weight_each() -> None:
    """The limit of a range that gets narrow."""
    assert cover(5.0, 5.0001, 0.05).weight == pytest.approx(0.5, abs=1e-4)
