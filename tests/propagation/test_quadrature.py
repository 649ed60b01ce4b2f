"""Gauss-Hermite quadrature against closed forms and Monte Carlo."""

from math import factorial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.closed_forms import CLOSED

from maplines_can.propagation import MonteCarlo, Quadrature, Refit
from maplines_can.simulation.scenarios import SCENARIOS
from maplines_can.study.roads import PAPER
from maplines_can.values.errors import IllPosedError
from maplines_can.values.gaussian import Gaussian
from maplines_can.values.line import Slot


@pytest.mark.parametrize(("function", "closed"), CLOSED)
@given(m=st.floats(-2, 2), s=st.floats(0, 1))
def test_quadrature_agrees_with_closed_forms(
    function: Any, closed: Any, m: float, s: float
) -> None:
    """15 points give mean and variance of x^2, exp x and sin x of a Gaussian to 9 digits."""
    result = Quadrature(15)(function, Gaussian([m], [[s**2]]))

    assert np.allclose([result.mean[0], result.cov[0, 0]], closed(m, s), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("order", [1, 2, 3, 5, 8, 13])
def test_quadrature_is_exact_up_to_its_degree_and_not_beyond(order: int) -> None:
    """All moments below 2n are exact; that of degree 2n is too small by n!."""
    gaussian = Gaussian([0.0, 0.0], np.diag([1.0, 0.25]))
    for degree in range(2 * order):
        even = np.prod(np.arange(degree // 2 * 2 - 1.0, 0, -2))  # double factorial
        mean = Quadrature(order).moments(lambda x, k=degree: x[:, :1] ** k, gaussian).mean[0]

        assert abs(mean - (0 if degree % 2 else even)) <= 1e-10 * even
    last = Quadrature(order).moments(lambda x: x[:, :1] ** (2 * order), gaussian).mean[0]
    missing = np.prod(np.arange(2.0 * order - 1, 0, -2)) - last
    assert np.isclose(missing, factorial(order), rtol=1e-6)


def test_points_of_small_weight_without_a_value_are_excluded() -> None:
    """They are excluded with a warning; points of larger weight raise."""

    def cut(limit: Any) -> Any:
        return lambda x: np.where(np.abs(x) > limit, np.nan, x**2)

    gaussian = Gaussian([0.0], [[1.0]])
    z, w = np.polynomial.hermite_e.hermegauss(13)
    kept = np.abs(z) <= 5.5
    with pytest.warns(
        UserWarning,
        match=r"2 of 13 points, with a total weight of 5.4e-08, are ill-posed and excluded",
    ):
        mean = Quadrature(13)(cut(5.5), gaussian).mean[0]
    assert np.isclose(mean, w[kept] @ z[kept] ** 2 / w[kept].sum(), rtol=1e-12)
    with pytest.raises(IllPosedError, match=r"no value at \[-?3\..* total weight of 0\.00"):
        Quadrature(13)(cut(3.0), gaussian)


@pytest.mark.filterwarnings("ignore::UserWarning")  # a few draws are ill-posed
@pytest.mark.parametrize("name", SCENARIOS)
def test_quadrature_agrees_with_draws(name: Any) -> None:
    """Mean and variance of two lines within 5 standard errors, from the fourth moment."""
    scene = SCENARIOS[name]
    lines = [scene.lines[slot] for slot in (Slot.EGO_RIGHT, Slot.NEXT_LEFT)]
    refit = Refit(lines, scene.ego.mean, scene.window, **PAPER)
    samples = MonteCarlo(100_000, seed=7).samples(refit, scene.ego)
    mean, cov = Quadrature().moments(refit, scene.ego)
    off = samples.values - mean
    square = off * off
    n, variance = len(off), square.mean(axis=0)
    of_variance = np.sqrt(((square * square).mean(axis=0) - variance**2) / n)

    assert samples.ill_posed <= 20  # beyond 4 sigma of the street turn with 10 deg: 8 on average
    assert (np.abs(off.mean(axis=0)) <= 5 * np.sqrt(variance / n)).all()
    assert (np.abs(np.diagonal(cov, axis1=1, axis2=2) - variance) <= 5 * of_variance).all()
