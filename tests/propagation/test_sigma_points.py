"""The unscented transform against closed forms, filterpy and exact fractions."""

from typing import Any

import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints, unscented_transform

from maplines_can.propagation import SigmaPoints
from maplines_can.simulation.scenarios import SCENARIOS
from maplines_can.study.roads import paper_refit


@pytest.mark.parametrize("name", SCENARIOS)
@pytest.mark.parametrize(("alpha", "kappa"), [(1.0, 0.0), (0.5, 0.0), (0.5, 1.5), (0.1, 0.0)])
def test_sigma_points_agree_with_filterpy(name: Any, alpha: float, kappa: float) -> None:
    """Points, weights and moments are those of filterpy for all lines of all scenarios.

    To 1e-10 of the standard deviations; filterpy's sums lose a factor 1 / alpha^2 of that.
    """
    scene, transform = SCENARIOS[name], SigmaPoints(alpha, kappa)
    refit = paper_refit(scene)
    reference = MerweScaledSigmaPoints(3, alpha=alpha, beta=2.0, kappa=kappa)
    points = reference.sigma_points(scene.ego.mean, scene.ego.cov)
    mean, cov = transform.moments(refit, scene.ego)
    bound = 1e-10 * max(1.0, 0.1 / alpha**2)

    rule = transform.rule(scene.ego)

    assert np.allclose(rule.points(scene.ego), points, rtol=1e-12, atol=1e-15)
    assert np.allclose(rule.mean_weights, reference.Wm, rtol=1e-12)
    assert np.allclose(rule.cov_weights, reference.Wc, rtol=1e-12)
    for values, m, S in zip(refit(points).swapaxes(0, 1), mean, cov, strict=True):
        expected_mean, expected = unscented_transform(values, reference.Wm, reference.Wc)
        sigma = np.sqrt(S.diagonal())
        assert (np.abs(m - expected_mean) <= bound * sigma).all()
        assert (np.abs(S - expected) <= bound * np.outer(sigma, sigma)).all()


@pytest.mark.parametrize("alpha", [1.0, 1e-2, 1e-4])
def test_a_constant_is_exact(alpha: float) -> None:
    """Bit for bit and with no variance, for any size of the weights."""
    gaussian = SCENARIOS["street-turn"].ego
    result = SigmaPoints(alpha)(lambda x: np.full((len(x), 2), [0.1, 1e9 / 3]), gaussian)

    assert np.array_equal(result.mean, [0.1, 1e9 / 3])
    assert not result.cov.any()
