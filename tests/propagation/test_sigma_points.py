"""The unscented transform against closed forms, filterpy and exact fractions."""

from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from closed_forms import square
from filterpy.kalman import MerweScaledSigmaPoints, unscented_transform

from maplines_can.propagation import SigmaPoints
from maplines_can.simulation.scenarios import SCENARIOS
from maplines_can.study.paper_refit import paper_refit
from maplines_can.values.gaussian import Gaussian
from maplines_can.values.line import Slot


@pytest.mark.parametrize("alpha", [1.0, 0.3, 1e-2, 1e-3])
@pytest.mark.parametrize("m", [0.0, 1.0, -3.0])
def test_sigma_points_are_exact_for_a_square(alpha: float, m: float) -> None:
    """With beta = 2 and kappa = 0 the fourth moment is exact for any alpha."""
    result = SigmaPoints(alpha)(np.square, Gaussian([m], [[0.25]]))

    rounding = 1e-14 / alpha**2  # of the values of the function
    assert np.allclose([result.mean[0], result.cov[0, 0]], square(m, 0.5), rtol=0, atol=rounding)


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

    assert np.allclose(transform.points(scene.ego), points, rtol=1e-12, atol=1e-15)
    assert np.allclose(transform.weights(3), [reference.Wm, reference.Wc], rtol=1e-12)
    for values, m, S in zip(refit(points).swapaxes(0, 1), mean, cov, strict=True):
        expected_mean, expected = unscented_transform(values, reference.Wm, reference.Wc)
        sigma = np.sqrt(S.diagonal())
        assert (np.abs(m - expected_mean) <= bound * sigma).all()
        assert (np.abs(S - expected) <= bound * np.outer(sigma, sigma)).all()


def exact_moments(values: Any, alpha: Any, n: Any, beta: int = 2) -> Any:
    """Equations 4 to 12 of the paper in exact fractions."""
    spread = Fraction(alpha) ** 2 * n
    values = [[Fraction(float(v)) for v in row] for row in values]
    w = [1 - n / spread] + [1 / (2 * spread)] * (2 * n)
    w_cov = [w[0] + 1 - Fraction(alpha) ** 2 + beta, *w[1:]]
    outputs = range(len(values[0]))
    mean = [sum(a * row[i] for a, row in zip(w, values, strict=True)) for i in outputs]
    cov = [
        [
            sum(
                a * (row[i] - mean[i]) * (row[j] - mean[j])
                for a, row in zip(w_cov, values, strict=True)
            )
            for j in outputs
        ]
        for i in outputs
    ]
    return np.array(mean, dtype=float), np.array(cov, dtype=float)


@pytest.mark.parametrize("alpha", [1.0, 0.1, 1e-3])
@pytest.mark.parametrize("name", ["production", "street-turn"])
def test_a_small_alpha_loses_no_digits(name: str, alpha: float) -> None:
    """Exact fractions give the same sums, though weights of a million cancel."""
    scene, transform = SCENARIOS[name], SigmaPoints(alpha)
    refit = paper_refit(scene, Slot.EGO_RIGHT)
    mean, cov = transform.moments(refit, scene.ego)
    expected_mean, expected = exact_moments(refit(transform.points(scene.ego)), alpha, 3)
    sigma = np.sqrt(expected.diagonal())

    assert (np.abs(mean - expected_mean) <= 1e-11 * sigma + 1e-15 * np.abs(mean)).all()
    assert (np.abs(cov - expected) <= 1e-11 * np.outer(sigma, sigma)).all()


@pytest.mark.parametrize("alpha", [1.0, 1e-2, 1e-4])
def test_a_constant_is_exact(alpha: float) -> None:
    """Bit for bit and with no variance, for any size of the weights."""
    gaussian = SCENARIOS["street-turn"].ego
    result = SigmaPoints(alpha)(lambda x: np.full((len(x), 2), [0.1, 1e9 / 3]), gaussian)

    assert np.array_equal(result.mean, [0.1, 1e9 / 3])
    assert not result.cov.any()
