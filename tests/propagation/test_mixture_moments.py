"""Mixtures as a whole against the true distribution: not overconfident (issue 11, item 7)."""

import warnings
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest
from evidence.witness import crossings, place_of, seen_from
from support.dbcs import default_codec

from maplines_can import MonteCarlo, Refit, SigmaPoints, map_lines
from maplines_can.propagation import Mixture
from maplines_can.simulation.scenarios import SCENARIOS
from maplines_can.study.roads import paper_refit
from maplines_can.values.line import lateral, lateral_jacobian

DRAWS = 200_000
COUNTS = (2, 3, 5, 8)


class Truth(NamedTuple):
    """Moments of the lines of a scene, from random draws, with the error of their sigmas."""

    mean: Any  #: (L, 4)
    cov: Any  #: (L, 4, 4)
    sigma: Any  #: (L, 4)
    sigma_error: Any  #: (L, 4) standard errors, relative to sigma


@cache
def refit_of(name: str) -> Refit:
    scene = SCENARIOS[name]
    return paper_refit(scene)


@cache
def truth_of(name: str) -> Truth:
    """As in the paper, draws from which no cubic follows the points are left out: 1e-5 of them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        values = MonteCarlo(DRAWS, seed=11).samples(refit_of(name), SCENARIOS[name].ego).values
    mean = values.mean(axis=0)
    off = values - mean
    cov = np.einsum("nli,nlj->lij", off, off) / len(off)
    variance = np.diagonal(cov, axis1=1, axis2=2)
    fourth = (off**4).mean(axis=0)
    error = np.sqrt((fourth / variance**2 - 1) / len(off)) / 2
    return Truth(mean, cov, np.sqrt(variance), error)


def overall(weights: Any, means: Any, covs: Any) -> Any:
    """Mean and covariance of (k, ..., 4) components as a whole."""
    mean = np.tensordot(weights, means, 1)
    off = means - mean
    return mean, np.tensordot(weights, covs + off[..., :, None] * off[..., None, :], 1)


def worst_direction(cov: Any, true: Any) -> Any:
    """The largest eigenvalue of S^-1 S_true: how much too small the variance is."""
    sigma = np.sqrt(np.diagonal(true, axis1=-2, axis2=-1))
    scale = sigma[..., :, None] * sigma[..., None, :]
    inverse = np.linalg.inv(np.linalg.cholesky(cov / scale))
    return np.linalg.eigvalsh(inverse @ (true / scale) @ np.swapaxes(inverse, -1, -2))[..., -1]


def assert_not_overconfident(cov: Any, truth: Truth, worst: float, least: float = 0.99) -> None:
    """Sigmas within 4 standard errors of the draws, and the variance in the worst direction."""
    ratio = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1)) / truth.sigma
    assert (ratio >= least - 4 * truth.sigma_error).all(), ratio.min(axis=0)
    assert worst_direction(cov, truth.cov).max() <= worst


@pytest.mark.parametrize("k", COUNTS)
@pytest.mark.parametrize("name", SCENARIOS)
def test_item_7_a_mixture_is_not_overconfident(name: str, k: int) -> None:
    """All lines of all scenes. Draws alone raise the largest of four eigenvalues by about 1 %."""
    truth = truth_of(name)
    mean, cov = overall(*Mixture(k).moments(refit_of(name), SCENARIOS[name].ego))
    assert_not_overconfident(cov, truth, worst=1.04)
    assert (np.abs(mean - truth.mean) <= truth.sigma * (0.002 + 4 / np.sqrt(DRAWS))).all()


@pytest.mark.parametrize(
    ("k", "worst", "in_turn", "least", "least_in_turn"),
    [(3, 1.53, 2.02, 0.95, 0.93), (5, 1.16, 1.75, 0.99, 0.97), (8, 1.09, 1.55, 0.99, 0.97)],
)
@pytest.mark.parametrize("name", SCENARIOS)
def test_item_7_with_sigma_points(
    name: str, k: int, worst: float, in_turn: float, least: float, least_in_turn: float
) -> None:
    """The documented error of the cheap transform, largest in street-turn-10deg."""
    _, cov = overall(*Mixture(k, SigmaPoints()).moments(refit_of(name), SCENARIOS[name].ego))
    if name == "street-turn-10deg":
        worst, least = in_turn, least_in_turn
    assert_not_overconfident(cov, truth_of(name), worst, least)


#: Largest share of |z| > 3 of any line of a scene, as far as it is more than 0.5 %. In highway
#: and highway-10deg the lines of the map end at x = 80 m: seen from a car that is turned, some do
#: not reach the end of the range. With a heading sigma of 10 deg, z is not Gaussian.
BEYOND = {"highway": 0.006, "highway-correlated": 0.006}
BEYOND |= {"highway-10deg": 0.01, "street-turn-10deg": 0.008}


@pytest.mark.parametrize("k", [2, 5, 8])
@pytest.mark.parametrize("name", SCENARIOS)
def test_item_7_after_the_wire(name: str, k: int) -> None:
    """Lines as ``map_lines`` makes them: the decoded whole covers the given one and the road.

    z is the lateral position of the road, seen from a drawn pose, in units of the decoded band.
    """
    scene, codec = SCENARIOS[name], default_codec()
    lines = map_lines(scene.lines, scene.ego, window=scene.window, components=k)
    mixtures = [line.mixture for line in lines]
    payloads = codec.batch.encode_mixtures(
        np.array([mixture.weights for mixture in mixtures]),  # type: ignore[union-attr]
        np.array([mixture.means for mixture in mixtures]),  # type: ignore[union-attr]
        np.array([mixture.covs for mixture in mixtures]),  # type: ignore[union-attr]
        x_min=[line.x_min for line in lines],
        x_max=[line.x_max for line in lines],
    )
    poses = scene.ego.sample(4000, seed=3)
    for line, payload in zip(lines, payloads, strict=True):
        batch = codec.batch.decode(payload)
        assert batch.accepted.all()
        weights, means, covs = batch.component_weight, batch.mean, batch.cov
        assert worst_direction(overall(weights, means, covs)[1], line.gaussian.cov) <= 1 + 1e-9

        points = scene.lines[line.slot].points
        _, s = place_of(points)
        x_min, x_max = batch.x_min[0], batch.x_max[0]
        for x in {x_min, 0.0, min(20.0, x_max), min(40.0, x_max), x_max}:
            J = lateral_jacobian(means, np.full(k, x))
            within = np.einsum("ki,kij,kj->k", J, covs, J)
            mean, variance = overall(weights, lateral(means, x)[:, None], within[:, None, None])
            z = (crossings(seen_from(points, poses), s, x) - mean) / np.sqrt(variance[0])
            assert (~(np.abs(z) <= 3)).mean() <= BEYOND.get(name, 0.005)
            assert 0.8 < np.sqrt(np.nanmean(z**2)) < 1.03
