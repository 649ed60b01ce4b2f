"""Validation of Gaussians, and their functions against independent formulas."""

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial import distance
from support.strategies import covariances, gaussians, symmetric

from maplines_can.values.gaussian import Gaussian
from maplines_can.values.linalg import ROUNDING, indefinite, nearest_covariance, square_root

EPS = np.finfo(float).eps
#: Its third pivot is rounding error. If used, the last variances would be wrong by 0.6 %.
NEARLY_SINGULAR = np.array(
    [
        [1.0, 0.8125, 1 + 2.0**-23, 1 + 2.0**-23],
        [0.8125, 0.66015625, 0.8125, 0.8125],
        [1 + 2.0**-23, 0.8125, 2.0, 2.0],
        [1 + 2.0**-23, 0.8125, 2.0, 2.0],
    ]
)


def correlation(cov: Any) -> Any:
    """The correlation matrix, with a scale of 1 for zero variances."""
    scale = np.sqrt(np.where(cov.diagonal() > 0, cov.diagonal(), 1.0))
    return cov / scale / scale[:, None]


def pair(rho: Any) -> Any:
    return np.array([[1.0, rho], [rho, 1.0]])


@pytest.mark.parametrize(
    "cov",
    [
        pytest.param(np.zeros((2, 2)), id="zero"),
        pytest.param(np.diag([1.0, 0.0]), id="one-variance-zero"),
        pytest.param(pair(1.0), id="exactly-singular"),
        pytest.param(pair(1 + 0.9e-9), id="rounding-of-the-least-eigenvalue"),
        pytest.param(np.array([[1, 0.9e-9], [0, 1]]), id="rounding-of-the-symmetry"),
        pytest.param(1e-16 * pair(0.999), id="tiny"),
        pytest.param(pair(1 + 5e-6).astype(np.float32), id="rounding-of-single-precision"),
    ],
)
def test_rounding_errors_are_accepted_and_the_covariance_made_symmetric(cov: Any) -> None:
    """Singular covariances are valid, and errors up to 1e-9 of the sigmas count as rounding."""
    kept = Gaussian([0, 0], cov).cov

    assert np.array_equal(kept, (cov + cov.T) / 2)


def test_a_gaussian_copies_its_arrays_and_makes_them_read_only() -> None:
    """A valid Gaussian stays valid."""
    mean, cov = np.zeros(2), np.eye(2)
    gaussian = Gaussian(mean, cov)
    mean[0] = cov[0, 0] = np.nan

    assert np.isfinite(gaussian.mean).all()
    assert np.isfinite(gaussian.cov).all()
    for array in (gaussian.mean, gaussian.cov, Gaussian.trusted(np.zeros(1), np.eye(1)).cov):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


@given(covariances())
@example(NEARLY_SINGULAR)
def test_square_root_is_triangular_and_reproduces_the_covariance(cov: Any) -> None:
    """L L^T is the covariance within rounding, also for nearly singular matrices."""
    L, sigma = square_root(cov), np.sqrt(cov.diagonal())

    assert np.array_equal(L, np.tril(L))
    assert (L.diagonal() >= 0).all()
    assert (np.abs(L @ L.T - cov) <= 256 * EPS * np.outer(sigma, sigma)).all()


@given(symmetric())
def test_indefinite_agrees_with_the_eigenvalues_of_the_correlation_matrix(cov: Any) -> None:
    """A matrix is indefinite if and only if its least eigenvalue is below -1e-9."""
    least = np.linalg.eigvalsh(correlation(cov))[0]

    if abs(least + ROUNDING) > 1e-13 * max(1.0, np.abs(correlation(cov)).max()):
        assert bool(indefinite(cov)) == (least < -ROUNDING)


@given(symmetric() | covariances(), st.integers(1, 4), st.sampled_from([0.0, 1e-300, 1e9, 1e300]))
@example(pair(1 + 0.9999999e-9), 2, 1.0)
@example(np.full((2, 2), np.nan), 2, 1.0)
def test_a_refused_covariance_has_a_reason(cov: Any, n: int, factor: float) -> None:
    """The core refuses, and what it is told in words is found here."""
    one = factor * cov[:n, :n]
    for matrix in (one, one * (1 + ROUNDING * np.tri(n, k=-1))):
        reason = ""
        try:
            made = Gaussian(np.zeros(n), matrix)
        except ValueError as error:
            reason = str(error)
        else:
            assert np.array_equal(made.cov, made.cov.T)
        assert "for the core" not in reason


@given(symmetric())
@example(
    np.array([[0, 0, 0, 0], [0, 2e-16, 7.5e-17, 1e-16], [0, 7.5e-17, 0, 0], [0, 1e-16, 0, 2e-16]])
)
def test_nearest_covariance_covers_the_matrix_and_is_valid(cov: Any) -> None:
    """A repair is never overconfident: result minus matrix is positive semidefinite."""
    repaired = nearest_covariance(cov)
    scale = np.sqrt(np.where(cov.diagonal() > 0, cov.diagonal(), 1.0))
    gain = np.linalg.eigvalsh((repaired - cov) / scale / scale[:, None])

    assert gain[0] >= -1e-12 * max(1.0, gain[-1])
    assert Gaussian(np.zeros(4), repaired).dimension == 4


@given(symmetric())
def test_nearest_covariance_adds_the_least_possible_trace(cov: Any) -> None:
    """The trace added is that of the negative eigenvalues, the least that can cover them."""
    values = np.linalg.eigvalsh(correlation(cov))
    scale = np.sqrt(np.where(cov.diagonal() > 0, cov.diagonal(), 1.0))
    added = np.trace((nearest_covariance(cov) - cov) / scale / scale[:, None])

    assert np.isclose(added, -values.clip(max=0).sum(), atol=1e-12 * max(1, -values[0]))


@given(gaussians(n=3), st.lists(st.sampled_from([0, 1, 2]), min_size=1, max_size=3, unique=True))
def test_marginal_selects_variables(gaussian: Any, keep: Any) -> None:
    """A marginal has the means, variances and correlations of its variables."""
    marginal = gaussian.marginal(keep)

    assert np.array_equal(marginal.mean, gaussian.mean[keep])
    assert np.array_equal(marginal.correlation, gaussian.correlation[keep][:, keep])
    assert np.array_equal(marginal.sigma, gaussian.sigma[keep])


def test_samples_have_the_moments_of_the_gaussian() -> None:
    """Mean and covariance agree within 5 standard errors; a seed gives the same draws."""
    n, cov = 100_000, np.array([[4.0, 1.9, 0], [1.9, 1.0, 0], [0, 0, 0]])
    gaussian = Gaussian([1.0, 2.0, 3.0], cov)
    draws = gaussian.sample(n, seed=3)
    bound = 5 * np.sqrt((np.outer(cov.diagonal(), cov.diagonal()) + cov**2) / n)

    assert (np.abs(draws.mean(axis=0) - gaussian.mean) <= 5 * gaussian.sigma / np.sqrt(n)).all()
    assert (np.abs(np.cov(draws.T) - cov) <= bound).all()
    assert np.array_equal(draws, gaussian.sample(n, seed=3))
    assert not np.array_equal(draws[:, 0], gaussian.sample(n, seed=4)[:, 0])


@given(gaussians(n=3), st.lists(st.floats(-9, 9), min_size=3, max_size=3))
def test_mahalanobis_agrees_with_scipy(gaussian: Any, z: Any) -> None:
    """scipy's distance with the inverse of the correlation matrix is the same."""
    scale = np.where(gaussian.sigma > 0, gaussian.sigma, 1)
    x = gaussian.mean + scale * z
    inverse = np.linalg.inv(correlation(gaussian.cov))
    expected = distance.mahalanobis(x / scale, gaussian.mean / scale, inverse)

    assert np.isclose(gaussian.mahalanobis(x), expected, rtol=1e-7, atol=1e-7)
    assert gaussian.mahalanobis(np.broadcast_to(x, (2, 5, 3))).shape == (2, 5)


def test_coverage_is_the_share_within_the_quantile() -> None:
    """The region ends at scipy's chi-square quantile and contains that share of the draws."""
    gaussian = Gaussian([1, 2, 3], [[4, 1, 0], [1, 2, 0.5], [0, 0.5, 1]])  # type: ignore[arg-type]
    edge = np.sqrt(stats.chi2.ppf(0.99, df=3)) * gaussian.root[:, 0]
    n, p = 100_000, 0.95

    assert gaussian.coverage(gaussian.mean + np.outer([0.999999, 1.000001], edge)) == 0.5
    share = gaussian.coverage(gaussian.sample(n, seed=1), mass=p)
    assert abs(share - p) <= 5 * np.sqrt(p * (1 - p) / n)


@given(gaussians(), gaussians())
def test_kl_agrees_with_its_closed_form(p: Any, q: Any) -> None:
    """The formula with trace, inverse and slogdet, in units of q, gives the same value."""
    P, Q = (g.cov / q.sigma / q.sigma[:, None] for g in (p, q))
    d = (p.mean - q.mean) / q.sigma
    inverse = np.linalg.inv(Q)
    log_det = np.linalg.slogdet(Q)[1] - np.linalg.slogdet(P)[1]
    expected = (np.trace(inverse @ P) + d @ inverse @ d - 4 + log_det) / 2

    assert np.isclose(p.kl(q), expected, rtol=1e-6, atol=1e-6)
    assert p.kl(q) >= -1e-9
    assert abs(p.kl(p)) <= 1e-9


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Gaussian([10**400, 0], np.eye(2)), "mean must be numbers .* about 1e400"),
        (lambda: Gaussian([0], [[-(10**400)]]), "cov must be numbers .* about -1e400"),
        (lambda: Gaussian([0], [[10**5000]]), "about 1e5000"),
        (lambda: Gaussian(np.array([1j]), [[1]]), "mean must be real"),
        (lambda: Gaussian([0, 0], np.eye(2) * 1e308), "cov must be finite"),
        (lambda: Gaussian([0, 0], [[1, 1e308], [-1e308, 1]]), "cov must be finite"),
        (lambda: nearest_covariance([[10**400]]), "cov must be numbers"),
        (lambda: nearest_covariance([[1, 1e308], [-1e308, 1]]), "cov must be finite"),
        (lambda: Gaussian([0], [[1]]).mahalanobis([10**400]), "x must be numbers"),
        (lambda: Gaussian([0], [[1]]).marginal([10**400]), "indices must be numbers"),
        (lambda: Gaussian([0], [[1]]).marginal([1e300]), "indices must be"),
        (lambda: Gaussian([0], [[1]]).marginal([0.5]), "indices must be"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_numbers_beyond_the_floats_raise(make: Any, words: str) -> None:
    """The message is short, names the argument, and no warning is issued."""
    with pytest.raises(ValueError, match=words) as error:
        make()
    assert len(str(error.value)) < 200
