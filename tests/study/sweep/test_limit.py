"""The rate-distortion bound: closed forms, invariance, a quantizer, sources without a bound."""

import math
from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.special import digamma

from maplines_can.study.sweep import limit as limit_module
from maplines_can.study.sweep.limit import Limit, limit_of
from maplines_can.values.gaussian import Gaussian

LN2 = np.log(2)
#: Samples; the errors of the procedure on normal ones are kept for the next test of this size.
N = 2400
NORMAL_BITS = np.log2(2 * np.pi * math.e) / 2  # entropy of a standard normal number
SIGMA0 = np.array([[1, 0.9, 0.5, 0.2], [0.9, 1, 0.7, 0.3], [0.5, 0.7, 1, 0.8], [0.2, 0.3, 0.8, 1]])


def gaussians(theta: Any, p: Any) -> Any:
    """Means and covariances of coordinates (m, ln L_ii, t_ij); without m the means are 0."""
    n = p * (p + 1) // 2
    pivots = np.exp(theta[:, -n:][:, :p])
    L = np.zeros((len(theta), p, p))
    i, j = np.tril_indices(p, -1)
    L[:, i, j] = theta[:, -n:][:, p:] * pivots[:, i]
    L[:, range(p), range(p)] = pivots
    means = theta[:, :p] if theta.shape[1] > n else np.zeros((len(theta), p))
    return means, L @ np.swapaxes(L, 1, 2)


def correlated(samples: Any, n: Any, seed: Any) -> Any:
    """(N, n) normal coordinates with correlations of 0.9^|i-j|, and their entropy [bit]."""
    root = np.linalg.cholesky(0.9 ** np.abs(np.subtract.outer(np.arange(n), np.arange(n))))
    x = np.random.default_rng(seed).standard_normal((samples, n)) @ root.T
    return x, n * NORMAL_BITS + np.log2(root.diagonal()).sum()


def wisharts(samples: Any, p: Any, seed: Any, freedom: int = 30, mean_factor: float = 3.0) -> Any:
    """Means N(0, f^2 S) and Wishart covariances S; exact h_F of all and of the covariances."""
    wishart = stats.wishart(freedom, SIGMA0[:p, :p])
    S = wishart.rvs(samples, random_state=seed).reshape(samples, p, p)
    z = np.random.default_rng(seed).standard_normal((samples, p, 1))
    means = mean_factor * (np.linalg.cholesky(S) @ z)[..., 0]
    log_det = digamma((freedom - np.arange(p)) / 2).sum() + p * LN2
    log_det += np.linalg.slogdet(SIGMA0[:p, :p])[1]
    # The Fisher volume of vech(S) is 2^(-p/2) det(S)^(-(p+1)/2), of m det(S)^(-1/2).
    covariance = wishart.entropy() / LN2 - p / 2 - (p + 1) / 2 * log_det / LN2
    return means, S, covariance + p * (NORMAL_BITS + np.log2(mean_factor)), covariance


def assert_within_errors(limit: Any, true_bits: Any, standard_errors: int = 5) -> None:
    """The true value lies between the estimate and its low end, up to standard errors."""
    error = limit.entropy_bits - true_bits
    slack = standard_errors * limit.entropy_se_bits
    assert min(0, limit.bias_bits) - slack <= error <= max(0, limit.bias_bits) + slack
    assert not limit.caveat


# -- the bound --------------------------------------------------------------------


def test_the_fisher_volume_is_that_of_the_divergence() -> None:
    """sqrt(det F) = 2^(p/2) / sqrt(det S) in these coordinates, by second differences of the KL."""
    theta = np.random.default_rng(2).standard_normal((1, 14))
    step = 1e-3
    true = Gaussian(*(a[0] for a in gaussians(theta, 4)))

    def kl(d: Any) -> Any:
        return true.kl(Gaussian(*(a[0] for a in gaussians(theta + step * d, 4))))

    e = np.eye(14)
    F = [[(kl(a + b) - kl(a - b) - kl(b - a) + kl(-a - b)) / 4 for b in e] for a in e]
    _, log_det = np.linalg.slogdet(np.array(F) / step**2)  # 2 KL = d^T F d
    _, log_volume, names = limit_module.coordinates(*gaussians(theta, 4), "all", None)  # type: ignore[call-arg]

    assert log_volume[0] == pytest.approx(log_det / 2, abs=1e-3)
    assert names[0] == "m_0"
    assert names[4] == "ln L_00"
    assert names[-1] == "t_32"


@pytest.mark.parametrize("n", [10, 14])
def test_a_decade_of_divergence_costs_the_same_bits_everywhere(n: int) -> None:
    """The divergence must be positive."""
    limit = Limit(entropy_bits=-3.0, dimension=n)
    assert np.diff(limit.bits([1e-2, 1e-3, 1e-4])) == pytest.approx(n / 2 * np.log2(10))
    for kl in (0.0, -1e-3, np.nan):
        with pytest.raises(ValueError, match="kl must be positive"):
            limit.bits([1e-3, kl])


def test_a_scalar_quantizer_loses_a_quarter_of_a_bit() -> None:
    """Equal steps of a uniform ln sigma are 1/2 log2(2 pi e / 12), or 1.53 dB, above the bound."""
    levels, width = 256, 6.0
    log_sigma = (np.arange(100_000) + 0.5) * width / 100_000
    step = width / levels
    e = log_sigma - (np.floor(log_sigma / step) + 0.5) * step
    kl = np.mean((np.exp(2 * e) - 1) / 2 - e)  # KL(N(0, s^2) || N(0, s'^2)), e = ln s / s'
    exact = Limit(entropy_bits=np.log2(width) + 0.5, dimension=1)
    sigma = np.exp(np.random.default_rng(0).uniform(0, width, size=(5000, 1, 1)))
    estimated = limit_of(np.zeros((5000, 1)), sigma**2, part="covariance")

    assert np.log2(levels) - exact.bits(kl) == pytest.approx(0.2546, abs=1e-3)
    assert_within_errors(estimated, exact.entropy_bits)


# -- closed forms -------------------------------------------------------------------


@pytest.mark.parametrize(("part", "n"), [("all", 14), ("covariance", 10)])
def test_strongly_correlated_coordinates(part: str, n: int) -> None:
    theta, h = correlated(N, n, seed=1)
    theta[:, -10:-6] *= 0.5  # the logarithms of the pivots
    if part == "all":
        h -= theta[:, 4:8].sum(axis=1).mean() / LN2  # E log2 sqrt(det S) of this very sample
    limit = limit_of(*gaussians(theta, 4), part=part)  # type: ignore[arg-type]

    assert_within_errors(limit, h - 4 + 2)
    assert (limit.dimension, limit.samples) == (n, N)
    assert limit.local_dimension == pytest.approx(n, rel=0.03)
    assert 0 < limit.entropy_se_bits < 0.35
    assert abs(limit.bias_bits) < 1


@pytest.mark.parametrize(("p", "samples"), [(1, 2000), (2, N), (4, N)])
def test_wishart_covariances_and_means_in_proportion(p: int, samples: int) -> None:
    """Compared with scipy's entropy of the Wishart distribution, in other coordinates."""
    means, covs, h_all, h_covariance = wisharts(samples, p, seed=3)

    assert_within_errors(limit_of(means, covs), h_all)
    assert_within_errors(limit_of(means, covs, part="covariance"), h_covariance)


# -- invariance ---------------------------------------------------------------------


def test_resolution_seeds_and_duplicates() -> None:
    """The first is added to the covariances; copies of samples are counted and not used."""
    means, covs, _, _ = wisharts(800, 2, seed=7)
    added, once = limit_of(means, covs + np.diag([2.0, 3.0])), limit_of(means, covs)
    assert limit_of(means, covs, resolution=[2.0, 3.0]) == added
    assert once != limit_of(means, covs, seed=2)
    twice = limit_of(np.r_[means, means[:100]], np.r_[covs, covs[:100]])
    assert twice.samples == 800
    assert twice.entropy_bits == once.entropy_bits


# -- sources that have no bound, or nearly none -------------------------------------


def test_a_curved_surface_has_a_caveat() -> None:
    """Four of ten coordinates are functions of the others, and noise of 0.1."""
    rng = np.random.default_rng(9)
    u, noise = rng.standard_normal((N, 6)), rng.standard_normal((N, 4))
    curved = np.sin(2 * u[:, :4]) + u[:, 1:5] * u[:, 2:6]
    theta = np.column_stack([0.3 * u, curved + 0.1 * noise])
    true_bits = 10 * NORMAL_BITS + 6 * np.log2(0.3) + 4 * np.log2(0.1) + 2
    limit = limit_of(*gaussians(theta, 4), part="covariance")

    assert limit.entropy_bits - true_bits > 5 * limit.entropy_se_bits  # too high
    assert limit.bias_bits > 1
    assert limit.caveat.startswith("the samples fill about")
    assert limit.local_dimension < 8.5


@pytest.mark.parametrize(
    ("change", "caveat"),
    [
        pytest.param({0: 1.0}, "m_0 has the same value in 100.0% of", id="constant"),
        pytest.param({4: 0.0}, "t_10 has the same value in 100.0% of", id="diagonal"),
        pytest.param({1: "m_0"}, "m_0, m_1 determine each other", id="dependent"),
    ],
)
def test_singular_sources_have_a_reason_instead_of_a_number(change: Any, caveat: str) -> None:
    theta, _ = correlated(1000, 5, seed=11)
    for column, value in change.items():
        theta[:, column] = theta[:, 0] * 7 if value == "m_0" else value
    limit = limit_of(*gaussians(theta, 2))

    assert np.isnan([limit.entropy_bits, limit.entropy_se_bits, *limit.bits([1e-3])]).all()
    assert limit.caveat.startswith("singular: ")
    assert caveat in limit.caveat


# -- mistakes -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("means", "covs", "options", "message"),
    [
        pytest.param(
            np.zeros((5, 2)), np.ones((5, 2)), {}, r"shapes \(N, p\) and \(N, p, p\)", id="shape"
        ),
        pytest.param(np.zeros((0, 2)), np.zeros((0, 2, 2)), {}, "shapes", id="empty"),
        pytest.param([[np.nan]], [[[1.0]]], {}, "must be finite", id="nan"),
        pytest.param([[0.0]], [[[0.0]]], {}, "add the resolution of the means", id="singular"),
        pytest.param(
            [[0.0]],
            [[[1.0]]],
            {"resolution": [-1.0]},
            r"resolution must have shape \(1,\) and values of 0 or more, got \[-1.0\]",
            id="resolution",
        ),
        pytest.param([[0.0]], [[[1.0]]], {"part": "mean"}, "'covariance', got 'mean'", id="part"),
        pytest.param(
            np.zeros((900, 1)),
            np.ones((900, 1, 1)),
            {},
            "2 parameters take at least 320 distinct samples, got 1 distinct ones of 900",
            id="one-scene-again-and-again",
        ),
    ],
)
def test_invalid_arguments_are_refused(means: Any, covs: Any, options: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        limit_of(means, covs, **options)
