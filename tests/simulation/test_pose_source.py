"""The errors of the pose source have the stated covariance and correlation time."""

from typing import Any

import numpy as np
import pytest

from maplines_can.simulation import PoseSource

SIGMA = np.array([0.3, 0.1, 0.01])


def errors(source: PoseSource, t: Any, heading: float = 0.0) -> Any:
    """(n, 3) errors along, across and of the heading at a true pose."""
    true = np.array([1000.0, -500.0, heading])
    stated = np.array([source.pose(float(now), true).mean for now in t]) - true
    c, s = np.cos(heading), np.sin(heading)
    return stated @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def test_discretisation_is_exact_for_uneven_steps() -> None:
    """Of many sources, the covariance of two times is exp(-dt / tau) whatever the steps between."""
    times = np.array([0.0, 0.001, 0.8, 0.9, 3.0])
    runs = np.array([errors(PoseSource(SIGMA, 1.5, seed=s), times) for s in range(1500)]) / SIGMA
    found = np.einsum("rak,rbk->kab", runs, runs) / len(runs)
    expected = np.exp(-np.abs(times[:, None] - times) / 1.5)
    tolerance = 4 * np.sqrt((1 + expected**2) / len(runs))
    assert (np.abs(found - expected) < tolerance).all()


def test_covariance_turns_with_the_car() -> None:
    """sigma is along and across; the covariance is in the map frame."""
    stated = PoseSource((0.4, 0.1, 0.02)).pose(0.0, [0, 0, np.pi / 6])
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    R = np.array([[c, -s], [s, c]])
    np.testing.assert_allclose(stated.cov[:2, :2], R @ np.diag([0.16, 0.01]) @ R.T, atol=1e-15)
    np.testing.assert_allclose(stated.cov[2], [0, 0, 0.0004], atol=1e-15)


def test_ends_of_the_correlation_time() -> None:
    """0 is white noise and infinity a constant error; sigma 0 is no error."""
    e = errors(PoseSource((1.0, 1.0, 0.0), (0.0, np.inf, 1.0), seed=5), np.arange(5000) * 0.01)
    assert (e[1:, 0] * e[:-1, 0]).mean() == pytest.approx(0.0, abs=4 / np.sqrt(5000))
    assert e[:, 0].std() == pytest.approx(1.0, abs=0.05)
    assert np.ptp(e[:, 1]) < 1e-9
    assert (e[:, 2] == 0).all()


def test_the_seed_determines_the_errors() -> None:
    t = np.arange(20) * 0.05
    first, again, other = (errors(PoseSource(SIGMA, seed=seed), t) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).all()


@pytest.mark.parametrize("t", [1.0, 0.5, float("nan"), float("inf")])
def test_times_must_increase(t: float) -> None:
    """A time that is not later raises, and does not advance the errors."""
    source, other = PoseSource(SIGMA, seed=1), PoseSource(SIGMA, seed=1)
    for each in (source, other):
        each.pose(1.0, [0, 0, 0])
    with pytest.raises(ValueError, match="t must be finite and later than 1 s"):
        source.pose(t, [0, 0, 0])
    with pytest.raises(ValueError, match="true_pose must be finite"):
        source.pose(2.0, [0, 0, float("nan")])
    np.testing.assert_array_equal(source.pose(2.0, [0] * 3).mean, other.pose(2.0, [0] * 3).mean)
