"""Splits of a Gaussian, and propagation of their components."""

from itertools import permutations
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize

from maplines_can.gaussian import Gaussian
from maplines_can.propagation import Refit, SigmaPoints
from maplines_can.propagation.splitting import SPLITS, Mixture
from maplines_can.scenarios import scenario


def criterion(weights: Any, means: Any, sigma: Any, factor: Any) -> Any:
    """DeMars: squared difference to N(0, 1), less its constant, plus factor times sigma^2."""

    def normal(x: Any, v: Any) -> Any:
        return np.exp(-(x**2) / (2 * v)) / np.sqrt(2 * np.pi * v)

    cross = weights @ normal(means, 1 + sigma**2)
    own = weights @ normal(means[:, None] - means, 2 * sigma**2) @ weights
    return own - 2 * cross + factor * sigma**2


def whole_split(half_weights: Any, half_means: Any, k: Any) -> Any:
    mirror = slice(0, k // 2)
    weights = np.append(half_weights, half_weights[mirror][::-1]) / 32
    return weights, np.append(half_means, -np.asarray(half_means)[mirror][::-1])


def completed(half_weights: Any, half_means: Any, k: Any) -> Any:
    """The criterion with components whose variance gives the mixture the variance 1."""
    weights, means = whole_split(half_weights, half_means, k)
    rest = 1 - weights @ means**2
    return criterion(weights, means, np.sqrt(rest), 0.025) if rest > 0 else 9.0


def test_the_criterion_has_the_published_minimum() -> None:
    """The published 3 components (DeMars, Bishop and Jah 2013, table 1) minimise it."""
    x = np.array([0.2252246249, 1.0575154615, 0.6715662887])

    def published(x: Any) -> Any:
        weights = np.array([x[0], 1 - 2 * x[0], x[0]])
        return criterion(weights, np.array([-x[1], 0, x[1]]), x[2], 0.001)

    found = minimize(published, [0.2, 1.0, 0.7], method="Nelder-Mead", options={"xatol": 1e-9})
    assert found.x == pytest.approx(x, abs=1e-3)
    assert published(x) == pytest.approx(found.fun, abs=1e-9)


@pytest.mark.parametrize("k", [k for k in SPLITS if k > 1])
def test_splits_minimise_the_criterion(k: Any) -> None:
    """The means do to the digits given; weights a step or two away are worse with any means."""
    half_weights, half_means = (np.array(half, dtype=float) for half in SPLITS[k])

    def best(half_weights: Any) -> Any:
        def value(free: Any) -> Any:
            return completed(half_weights, np.append(free, half_means[k // 2 :]), k)

        return minimize(
            value,
            half_means[: k // 2],
            method="Nelder-Mead",
            options={"xatol": 1e-8, "fatol": 1e-15, "maxiter": 4000},
        )

    found = best(half_weights)
    assert found.x == pytest.approx(half_means[: k // 2], abs=2e-5)
    for i, j in permutations(range(len(half_weights)), 2):
        counts = np.array([1 if (k % 2 and at == k // 2) else 2 for at in (i, j)])
        steps = np.array([-2, 2]) / counts  # a middle component has no mirror image
        other = half_weights.copy()
        other[[i, j]] += steps
        if other.min() >= 1:
            assert best(other).fun > found.fun


@pytest.mark.parametrize("k", SPLITS)
def test_a_split_keeps_mean_and_covariance(k: Any) -> None:
    """For any direction, and for a singular Gaussian."""
    gaussian = Gaussian([1.0, 2.0, 3.0], np.diag([0.25, 0.0, 0.01]))  # type: ignore[arg-type]
    split = Mixture(k).split(gaussian, direction=[1.0, 2.0, -1.0])
    assert len(split.weights) == k
    assert split.overall.mean == pytest.approx(gaussian.mean, abs=1e-9)
    assert split.overall.cov == pytest.approx(gaussian.cov, abs=1e-9)


def test_one_component_is_the_result_of_the_transform() -> None:
    """Mixture(1) gives the result of SigmaPoints; moments() and a call of Mixture(3) agree."""
    scene = scenario("street-turn")
    refit = Refit(scene.polylines[0], scene.ego.mean, scene.window)
    one, plain = Mixture(1)(refit, scene.ego), SigmaPoints()(refit, scene.ego)
    assert np.array_equal(one.components[0].mean, plain.mean)
    weights, means, covs = Mixture(3).moments(refit, scene.ego)
    three = Mixture(3)(refit, scene.ego)
    assert np.allclose(means, three.means)
    assert np.allclose(covs, three.covs)
    assert np.array_equal(weights, three.weights)
