"""Gaussian mixtures: validation, density and coverage."""

import numpy as np
import pytest

from maplines_can.values.gaussian import Gaussian
from maplines_can.values.mixture import GaussianMixture, moments


def test_density_and_coverage_of_a_mixture() -> None:
    """The density integrates to 1, and 99 % of its draws lie in the region of mass 0.99."""
    components = (Gaussian([-2.0], [[0.5]]), Gaussian([1.0], [[2.0]]))
    mixture = GaussianMixture([0.3, 0.7], components)
    x = np.linspace(-12, 14, 20_001)[:, None]
    assert np.trapezoid(mixture.density(x), x[:, 0]) == pytest.approx(1, abs=1e-6)
    draws = mixture.sample(100_000, seed=5)
    assert mixture.coverage(draws) == pytest.approx(0.99, abs=5 * np.sqrt(0.99 * 0.01 / 1e5) * 2)
    assert draws.mean() == pytest.approx(mixture.overall.mean[0], abs=5 * draws.std() / 316)


def test_the_moments_of_mixtures_are_sums_over_the_components() -> None:
    """Of one mixture and of many at once to the last bit."""
    rng = np.random.default_rng(0)
    weights = rng.dirichlet(np.ones(9), 20)
    means, roots = rng.normal(size=(20, 9, 3)), rng.normal(size=(20, 9, 3, 3))
    covs = roots @ roots.mT
    mean, cov = moments(weights, means, (covs + covs.mT) / 2)
    assert mean == pytest.approx(np.einsum("nk,nki->ni", weights, means), rel=1e-12)
    d = means - mean[:, None]
    spread = covs + d[..., :, None] * d[..., None, :]
    assert cov == pytest.approx(np.einsum("nk,nkij->nij", weights, spread), rel=1e-12, abs=1e-14)
    for i in range(20):
        one = moments(weights[i], means[i], (covs[i] + covs[i].mT) / 2)
        assert np.array_equal(one[0], mean[i])
        assert np.array_equal(one[1], cov[i])
