"""Monte Carlo: moments, samples and their random errors."""

from typing import Any

import numpy as np
import pytest
from support.closed_forms import CLOSED

from maplines_can.propagation import MapError, MonteCarlo
from maplines_can.simulation.scenarios import scenario
from maplines_can.study.roads import paper_refit
from maplines_can.values.gaussian import Gaussian

N = 20_000
TURN = scenario("street-turn")
REFIT = paper_refit(TURN)


def test_moments_are_those_of_the_samples() -> None:
    """They are those of numpy; the same seed repeats them and another seed does not."""
    monte_carlo = MonteCarlo(1000, seed=1)
    mean, cov = monte_carlo.moments(REFIT, TURN.ego)
    values = monte_carlo.samples(REFIT, TURN.ego).values

    for i in range(8):
        assert np.allclose(mean[i], values[:, i].mean(axis=0), rtol=1e-12)
        assert np.allclose(cov[i], np.cov(values[:, i].T, bias=True), rtol=1e-9, atol=1e-18)
    assert np.array_equal(monte_carlo.moments(REFIT, TURN.ego).cov, cov)
    assert not np.array_equal(MonteCarlo(1000, seed=2).moments(REFIT, TURN.ego).cov, cov)


@pytest.mark.parametrize(("function", "closed"), CLOSED)
@pytest.mark.parametrize(("m", "s"), [(0.0, 0.5), (1.0, 0.5), (0.3, 1e-6)])
def test_monte_carlo_agrees_with_closed_forms(
    function: Any, closed: Any, m: float, s: float
) -> None:
    """Within 5 standard errors, that of the variance computed from the fourth moment."""
    monte_carlo, gaussian = MonteCarlo(200_000, seed=5), Gaussian([m], [[s**2]])
    result, (mean, variance) = monte_carlo(function, gaussian), closed(m, s)
    d = monte_carlo.samples(function, gaussian).values - result.mean
    error = np.sqrt(((d**4).mean() - variance**2) / monte_carlo.n)

    assert abs(result.mean[0] - mean) <= 5 * np.sqrt(variance / monte_carlo.n)
    assert abs(result.cov[0, 0] - variance) <= 5 * error


def test_samples_include_errors_of_noise_cov() -> None:
    """Independent of the draws, with the covariance of each line within 5 standard errors."""
    error = MapError(0.5, 0.5, 0.01)
    noisy, exact = paper_refit(TURN, map_error=error), MonteCarlo(N, seed=3)
    samples, plain = exact.samples(noisy, TURN.ego), exact.samples(REFIT, TURN.ego)
    added = samples.values - plain.values  # the same poses

    assert np.array_equal(samples.inputs, plain.inputs)
    for i, cov in enumerate(noisy.noise_cov):  # type: ignore[arg-type]
        bound = 5 * np.sqrt((np.outer(cov.diagonal(), cov.diagonal()) + cov**2) / N)
        assert (np.abs(np.cov(added[:, i].T) - cov) <= bound).all()
    independent = np.column_stack([plain.inputs, added[:, 0, 0], added[:, 1, 0]])
    assert np.abs(np.tril(np.corrcoef(independent.T), -1)).max() < 5 / np.sqrt(N)
