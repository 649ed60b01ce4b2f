"""Properties that all moment transforms share."""

from typing import Any

import numpy as np
import pytest

from maplines_can.propagation import Linear, MapError, MonteCarlo, Quadrature, SigmaPoints
from maplines_can.simulation.scenarios import scenario
from maplines_can.study.roads import paper_refit
from maplines_can.values.errors import IllPosedError
from maplines_can.values.gaussian import Gaussian
from maplines_can.values.line import Slot

N = 20_000
EXACT = [
    Linear(),
    Linear(step=1.0),
    SigmaPoints(),
    SigmaPoints(alpha=0.5, kappa=1.0),
    SigmaPoints(alpha=0.01),
    Quadrature(2),
    Quadrature(5),
    Quadrature(),
]
ALL = [*EXACT, MonteCarlo(N, seed=3)]
MEAN, A, OFFSET = np.array([1.0, -2.0, 0.3]), np.arange(12.0).reshape(4, 3) % 5 - 2, np.arange(4.0)
SIGMA = np.array([0.5, 0.3, 0.1])
R = np.array([[1.0, 0.8, -0.2], [0.8, 1.0, 0.1], [-0.2, 0.1, 1.0]])
TURN = scenario("street-turn")
REFIT = paper_refit(TURN)


def affine(x: Any) -> Any:
    return x @ A.T + OFFSET


@pytest.mark.parametrize("transform", ALL, ids=str)
@pytest.mark.parametrize(
    ("cov", "tolerance"),
    [
        pytest.param(np.zeros((3, 3)), 0.0, id="zero"),
        # Steps of 1e-8 added to numbers near 1 keep 8 digits, steps of 1e-10 keep 6.
        pytest.param(1e-12 * R * np.outer(SIGMA, SIGMA), 1e-4, id="tiny"),
        pytest.param(R * np.outer(SIGMA, SIGMA), 1e-10, id="ordinary"),
        pytest.param(np.diag([0.25, 0.09, 0.0]), 1e-10, id="known-heading"),
        pytest.param(np.outer(SIGMA, SIGMA), 1e-10, id="exactly-singular"),
    ],
)
def test_an_affine_function_is_exact(transform: Any, cov: Any, tolerance: float) -> None:
    """Mean A m + b and covariance A P A^T, to rounding or within 5 standard errors."""
    result = transform(affine, Gaussian(MEAN, cov))
    expected = A @ cov @ A.T
    sigma = np.sqrt(expected.diagonal())
    if isinstance(transform, MonteCarlo):
        tolerance = 5 * np.sqrt(2 / N)

    assert (np.abs(result.mean - affine(MEAN)) <= tolerance * sigma + 1e-11).all()
    assert (np.abs(result.cov - expected) <= tolerance * np.outer(sigma, sigma) + 1e-22).all()
    assert np.array_equal(result.cov, result.cov.T)


@pytest.mark.parametrize("transform", ALL, ids=str)
def test_noise_cov_is_added(transform: Any) -> None:
    """The error of a map adds its covariance to that of each line, and changes nothing else."""
    noisy = paper_refit(TURN, map_error=MapError(0.1, 0.1, 0.001))
    mean, cov = transform.moments(REFIT, TURN.ego)
    noisy_mean, noisy_cov = transform.moments(noisy, TURN.ego)

    assert np.array_equal(noisy_mean, mean)
    assert np.allclose(noisy_cov - cov, noisy.noise_cov, rtol=1e-9, atol=1e-15)  # type: ignore[arg-type]


@pytest.mark.parametrize("transform", ALL, ids=str)
def test_moments_of_several_outputs(transform: Any) -> None:
    """Each output is as it would be alone; a single Gaussian of several outputs raises."""
    mean, cov = transform.moments(REFIT, TURN.ego)
    alone = transform(paper_refit(TURN, Slot.NEXT_LEFT), TURN.ego)

    assert (mean.shape, cov.shape) == ((8, 4), (8, 4, 4))
    assert np.allclose(mean[2], alone.mean, rtol=1e-9)
    assert np.allclose(cov[2], alone.cov, rtol=1e-9, atol=1e-12)
    with pytest.raises(ValueError, match=r"8 outputs; use moments\(\) for all of them at once"):
        transform(REFIT, TURN.ego)


@pytest.mark.parametrize("transform", EXACT, ids=str)
def test_a_point_without_a_value_raises(transform: Any) -> None:
    """The message has the point and what to do."""

    def half(x: Any) -> Any:
        return np.where(x[:, :1] >= 0, x, np.nan)

    with pytest.raises(IllPosedError, match=r"no value at \[-.*; narrow the Gaussian or use Monte"):
        transform(half, Gaussian([0.0, 0.0], np.eye(2)))
