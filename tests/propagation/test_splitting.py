"""Splits of a Gaussian, and propagation of their components."""

import warnings
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise, product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm, truncnorm

from maplines_can.propagation import MonteCarlo, Quadrature, SigmaPoints
from maplines_can.propagation.splitting import SPLITS, Mixture, standard_split
from maplines_can.simulation.scenarios import pose, scenario
from maplines_can.study.roads import paper_refit
from maplines_can.values.errors import IllPosedError
from maplines_can.values.gaussian import Gaussian
from maplines_can.values.line import Slot

SEVERAL = [k for k in SPLITS if k > 1]


def whole(half_weights: Any, k: Any) -> Any:
    """The weights of all components, from those of the lower half."""
    return np.append(half_weights, half_weights[: k // 2][::-1]) / 32


def curvature_left(weights: Any) -> float:
    """Variance of z^2 about its regression line in each interval, by the midpoint rule."""
    p = (np.arange(6400) + 0.5) / 6400
    z = norm.ppf(p)
    left = 0.0
    for part in np.split(np.arange(len(p)), np.round(np.cumsum(weights)[:-1] * len(p)).astype(int)):
        a, b = z[part] - z[part].mean(), z[part] ** 2 - (z[part] ** 2).mean()
        left += (b @ b - (a @ b) ** 2 / (a @ a)) / len(p)
    return left


def halves(k: Any) -> Iterator[Any]:
    """All weights of the lower half in steps of 1/32."""
    for outer in product(range(1, 16), repeat=(k - 1) // 2):
        rest = 32 - 2 * sum(outer)  # of the middle component, or of two of them
        if rest >= 1 and (k % 2 or rest % 2 == 0):
            yield np.array([*outer, rest if k % 2 else rest // 2])


@pytest.mark.parametrize("k", SEVERAL)
def test_splits_leave_the_least_curvature(k: Any) -> None:
    """Of all weights; with more than 5 components, of those a step or two away."""
    chosen = np.array(SPLITS[k])
    others = [each for each in halves(k) if k < 6 or np.abs(each - chosen).max() <= 1]
    values = [curvature_left(whole(each, k)) for each in others]
    assert len(values) > (2 if k > 2 else 0)
    assert np.array_equal(others[int(np.argmin(values))], chosen)


@pytest.mark.parametrize("k", SPLITS)
def test_components_are_truncated_normals(k: Any) -> None:
    """Means and variances are those of scipy, between the quantiles of the weights."""
    weights, means, variances = standard_split(k)
    edges = norm.ppf(np.append(0.0, np.cumsum(weights)))
    for i, (low, high) in enumerate(pairwise(edges)):
        assert means[i] == pytest.approx(truncnorm.mean(low, high), abs=1e-9)
        assert variances[i] == pytest.approx(truncnorm.var(low, high), abs=1e-9)


def test_one_component_is_the_result_of_the_transform() -> None:
    """Mixture(1) gives the result of SigmaPoints; moments() and a call of Mixture(3) agree."""
    scene = scenario("street-turn")
    refit = paper_refit(scene, Slot.EGO_LEFT)
    for transform in (SigmaPoints(), Quadrature(5), MonteCarlo(100)):
        one, plain = Mixture(1, transform)(refit, scene.ego), transform(refit, scene.ego)
        assert np.array_equal(one.components[0].mean, plain.mean)
        assert np.array_equal(one.components[0].cov, plain.cov)
    default = Mixture(1)(refit, scene.ego).components[0]
    assert np.array_equal(default.mean, SigmaPoints()(refit, scene.ego).mean)
    weights, means, covs = Mixture(3).moments(refit, scene.ego)
    three = Mixture(3)(refit, scene.ego)
    assert np.allclose(means, three.means)
    assert np.allclose(covs, three.covs)
    assert np.array_equal(weights, three.weights)


@given(st.integers(0, 10**6), st.sampled_from(SEVERAL))
def test_a_mixture_has_the_moments_of_a_quadratic_function(seed: int, k: int) -> None:
    """In any direction: the closed form is b^T P b + tr(A P A P) / 2. One variable is known."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((3, 3)) * [1, 1, seed % 2]
    P, A, b = root @ root.T, rng.standard_normal((3, 3)), rng.standard_normal(3)
    A = A + A.T

    def quadratic(x: Any) -> Any:
        return (x @ b + np.einsum("ni,ij,nj->n", x, A, x) / 2)[:, None]

    overall = Mixture(k)(quadratic, Gaussian(np.zeros(3), P)).overall
    variance = b @ P @ b + np.trace(A @ P @ A @ P) / 2
    sigma = np.sqrt(variance)
    assert overall.mean[0] == pytest.approx(np.trace(A @ P) / 2, abs=1e-3 * sigma)
    assert overall.cov[0, 0] == pytest.approx(variance, rel=3e-3)


def test_tails_without_a_value_are_moved_inwards() -> None:
    """The share of the probability that is ill-posed grows from 1e-5 to 1e-4 and 0.7 %."""
    scene = scenario("street-turn")
    for degrees in (10.0, 12.0):
        ego = pose(0.5, 0.5, degrees)
        refit = paper_refit(replace(scene, ego=ego), Slot.EGO_RIGHT)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # corners of a weight below 1e-8
            expected = Quadrature(13)(refit, ego)
            for k in SEVERAL:
                sigma = Mixture(k)(refit, ego).overall.sigma
                assert sigma == pytest.approx(expected.sigma, rel=0.06)
    with pytest.raises(IllPosedError, match=r"in the standardised variables of component 1 of 5, "):
        Mixture(5)(refit, pose(0.5, 0.5, 18.0))
