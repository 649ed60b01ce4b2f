"""All moment transforms: one battery, and outside witnesses for each."""

import warnings
from fractions import Fraction
from math import factorial

import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints, unscented_transform
from hypothesis import given
from hypothesis import strategies as st
from strategies import covariances

from maplines_can.errors import IllPosedError
from maplines_can.gaussian import Gaussian
from maplines_can.propagation import (
    Linear,
    MapError,
    MonteCarlo,
    Quadrature,
    Refit,
    SigmaPoints,
    Transform,
)
from maplines_can.scenarios import SCENARIOS, scenario

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
LEFT = scenario("street-turn")
REFIT = Refit(LEFT.polylines, LEFT.ego.mean, LEFT.window)


def affine(x):
    return x @ A.T + OFFSET


def refit_of(scene, **rest):
    return Refit(scene.polylines, scene.ego.mean, scene.window, **rest)


def quietly(call, *arguments):
    """For the street turn with 10 deg, where some points out of a million look across."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return call(*arguments)


@pytest.mark.parametrize("transform", ALL, ids=str)
@pytest.mark.parametrize(
    ("cov", "tolerance"),
    [
        pytest.param(np.zeros((3, 3)), 0.0, id="zero"),
        # Steps of 1e-8 sigma to numbers near 1 keep 8 digits, of 1e-10 keep 6.
        pytest.param(1e-12 * R * np.outer(SIGMA, SIGMA), 1e-4, id="tiny"),
        pytest.param(R * np.outer(SIGMA, SIGMA), 1e-10, id="ordinary"),
        pytest.param(np.diag([0.25, 0.09, 0.0]), 1e-10, id="known-heading"),
        pytest.param(np.outer(SIGMA, SIGMA), 1e-10, id="exactly-singular"),
    ],
)
def test_an_affine_function_is_carried_exactly(transform, cov, tolerance):
    """Mean A m + b and covariance A P A^T: to rounding, or within 5 sampling errors."""
    result = transform(affine, Gaussian(MEAN, cov))
    expected = A @ cov @ A.T
    sigma = np.sqrt(expected.diagonal())
    if isinstance(transform, MonteCarlo):
        tolerance = 5 * np.sqrt(2 / N)

    assert (np.abs(result.mean - affine(MEAN)) <= tolerance * sigma + 1e-11).all()
    assert (np.abs(result.cov - expected) <= tolerance * np.outer(sigma, sigma) + 1e-22).all()
    assert np.array_equal(result.cov, result.cov.T)


@given(covariances(n=3), st.sampled_from([Linear(), SigmaPoints(), Quadrature(3)]))
def test_any_covariance_goes_through_unchanged(cov, transform):
    """The identity of a Gaussian of any rank and any units is that Gaussian."""
    result = transform(lambda x: x, Gaussian(np.zeros(3), cov))
    sigma = np.sqrt(cov.diagonal())

    assert (np.abs(result.cov - cov) <= 1e-12 * np.outer(sigma, sigma)).all()
    assert (np.abs(result.mean) <= 1e-12 * sigma).all()


@pytest.mark.parametrize("transform", ALL, ids=str)
def test_the_function_s_own_noise_is_added(transform):
    """A map's error adds its covariance and nothing else: to each line its own."""
    noisy = refit_of(LEFT, map_error=MapError(0.1, 0.1, 0.001))
    mean, cov = transform.moments(REFIT, LEFT.ego)
    noisy_mean, noisy_cov = transform.moments(noisy, LEFT.ego)

    assert np.array_equal(noisy_mean, mean)
    assert np.allclose(noisy_cov - cov, noisy.noise_cov, rtol=1e-9, atol=1e-15)


def test_the_function_s_own_noise_shows_in_the_samples():
    """Monte Carlo's samples spread by both errors, within 5 sampling errors, line by line."""
    error = MapError(0.5, 0.5, 0.01)
    noisy, exact = refit_of(LEFT, map_error=error), MonteCarlo(N, seed=3)
    samples, plain = exact.samples(noisy, LEFT.ego), exact.samples(REFIT, LEFT.ego)
    added = samples.values - plain.values  # the same poses

    assert np.array_equal(samples.inputs, plain.inputs)
    for i, cov in enumerate(noisy.noise_cov):
        bound = 5 * np.sqrt((np.outer(cov.diagonal(), cov.diagonal()) + cov**2) / N)
        assert (np.abs(np.cov(added[:, i].T) - cov) <= bound).all()
    independent = np.column_stack([plain.inputs, added[:, 0, 0], added[:, 1, 0]])
    assert np.abs(np.tril(np.corrcoef(independent.T), -1)).max() < 5 / np.sqrt(N)


def test_the_noise_of_the_samples_has_its_own_seed():
    """The same seed repeats it, another seed draws another."""
    noisy = refit_of(LEFT, map_error=MapError(0.5))
    known = Gaussian(LEFT.ego.mean, np.zeros((3, 3)))
    first, again, other = (MonteCarlo(9, seed).samples(noisy, known).values for seed in (1, 1, 2))

    assert np.array_equal(first, again)
    assert not np.isclose(first, other).any()


def test_the_noise_of_the_samples_is_independent_of_the_draws():
    """Where both are of one dimension too: variances add up, not standard deviations."""

    def identity(x):
        return x

    identity.noise_cov = np.eye(1)
    values = MonteCarlo(N, seed=3).samples(identity, Gaussian([0.0], [[1.0]])).values

    assert abs(values.var() - 2.0) <= 5 * 2.0 * np.sqrt(2 / N)


@pytest.mark.parametrize("transform", ALL, ids=str)
def test_several_outputs_share_a_call_of_moments(transform):
    """Each output is as it would be alone; as one Gaussian they are refused."""
    mean, cov = transform.moments(REFIT, LEFT.ego)
    alone = transform(Refit(LEFT.polylines[2], LEFT.ego.mean, LEFT.window), LEFT.ego)

    assert (mean.shape, cov.shape) == ((8, 4), (8, 4, 4))
    assert np.allclose(mean[2], alone.mean, rtol=1e-9)
    assert np.allclose(cov[2], alone.cov, rtol=1e-9, atol=1e-12)
    with pytest.raises(ValueError, match=r"8 outputs; use moments\(\) for all of them at once"):
        transform(REFIT, LEFT.ego)


@pytest.mark.parametrize("transform", EXACT, ids=str)
def test_a_function_without_a_value_where_it_is_needed_is_an_error(transform):
    """Half of the points without a value leave no moments: the message tells where and the way."""

    def half(x):
        return np.where(x[:, :1] >= 0, x, np.nan)

    with pytest.raises(IllPosedError, match=r"no value at \[-.*; narrow the Gaussian or use Monte"):
        transform(half, Gaussian([0.0, 0.0], np.eye(2)))


@pytest.mark.parametrize("transform", ALL, ids=str)
def test_every_transform_is_a_value(transform):
    """Two of one kind with the same figures are one and the same, and print as they are written."""
    assert isinstance(transform, Transform)
    assert eval(repr(transform)) == transform  # noqa: S307
    assert hash(transform) == hash(eval(repr(transform)))  # noqa: S307


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Linear(step=0.0), "step must be more than 0 standard deviations, got 0.0"),
        (lambda: Linear(step=np.nan), "step must be more than 0"),
        (lambda: SigmaPoints(alpha=0.0), "alpha must be more than 0, got 0.0"),
        (lambda: SigmaPoints(alpha=np.inf), "alpha must be more than 0, got inf"),
        (lambda: SigmaPoints(kappa=-3.0).weights(3), "kappa must be more than -3 for 3 variables"),
        (lambda: Quadrature(0), "order must be a whole number from 1 to 64, got 0"),
        (lambda: Quadrature(65), "order must be a whole number from 1 to 64, got 65"),
        (lambda: Quadrature(3.0), "order must be a whole number"),
        (lambda: MonteCarlo(1), "n must be 2 or more, got 1"),
    ],
)
def test_wrong_figures_are_refused_in_words(make, words):
    """What a transform cannot work with is refused at birth."""
    with pytest.raises(ValueError, match=words):
        make()


# ---- closed forms


def square(m, s):
    """(mean, variance) of x^2."""
    return m**2 + s**2, 4 * m**2 * s**2 + 2 * s**4


def exponential(m, s):
    """(mean, variance) of exp x: log-normal."""
    return np.exp(m + s**2 / 2), np.expm1(s**2) * np.exp(2 * m + s**2)


def sine(m, s):
    """(mean, variance) of sin x."""
    mean = np.sin(m) * np.exp(-(s**2) / 2)
    return mean, (1 - np.exp(-2 * s**2) * np.cos(2 * m)) / 2 - mean**2


CLOSED = [(np.square, square), (np.exp, exponential), (np.sin, sine)]


@pytest.mark.parametrize(("function", "closed"), CLOSED)
@given(m=st.floats(-2, 2), s=st.floats(0, 1))
def test_quadrature_agrees_with_closed_forms(function, closed, m, s):
    """15 points give mean and variance of x^2, exp x and sin x of a Gaussian to 9 digits."""
    result = Quadrature(15)(function, Gaussian([m], [[s**2]]))

    assert np.allclose([result.mean[0], result.cov[0, 0]], closed(m, s), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("function", "closed"), CLOSED)
@pytest.mark.parametrize(("m", "s"), [(0.0, 0.5), (1.0, 0.5), (0.3, 1e-6)])
def test_monte_carlo_agrees_with_closed_forms(function, closed, m, s):
    """Mean and variance within 5 sampling errors, that of the variance by the fourth moment."""
    monte_carlo, gaussian = MonteCarlo(200_000, seed=5), Gaussian([m], [[s**2]])
    result, (mean, variance) = monte_carlo(function, gaussian), closed(m, s)
    d = monte_carlo.samples(function, gaussian).values - result.mean
    error = np.sqrt(((d**4).mean() - variance**2) / monte_carlo.n)

    assert abs(result.mean[0] - mean) <= 5 * np.sqrt(variance / monte_carlo.n)
    assert abs(result.cov[0, 0] - variance) <= 5 * error


@pytest.mark.parametrize("alpha", [1.0, 0.3, 1e-2, 1e-3])
@pytest.mark.parametrize("m", [0.0, 1.0, -3.0])
def test_sigma_points_are_exact_for_a_square(alpha, m):
    """With beta = 2 and kappa = 0 the fourth moment is right, whatever alpha."""
    result = SigmaPoints(alpha)(np.square, Gaussian([m], [[0.25]]))

    rounding = 1e-14 / alpha**2  # what the function's own values have lost
    assert np.allclose([result.mean[0], result.cov[0, 0]], square(m, 0.5), rtol=0, atol=rounding)


@pytest.mark.parametrize(
    ("function", "slope"), [(np.square, lambda x: 2 * x), (np.exp, np.exp), (np.sin, np.cos)]
)
@given(m=st.floats(-2, 2), s=st.floats(1e-3, 1))
def test_linear_is_the_first_order(function, slope, m, s):
    """The mean is f(m) and the sigma f'(m) s, whatever else the function does within s.

    What a fourth-order difference of step 0.01 s misses is f s^5 1e-8 / 30.
    """
    result = Linear()(function, Gaussian([m], [[s**2]]))

    assert result.mean[0] == function(m)
    assert np.isclose(result.sigma[0], abs(slope(m)) * s, rtol=0, atol=3e-9 * s**5 + 1e-12)


# ---- quadrature


@pytest.mark.parametrize("order", [1, 2, 3, 5, 8, 13])
def test_quadrature_is_exact_up_to_its_degree_and_not_beyond(order):
    """All moments below 2n are those of a Gaussian; the one of 2n is short by n!."""
    gaussian = Gaussian([0.0, 0.0], np.diag([1.0, 0.25]))
    for degree in range(2 * order):
        even = np.prod(np.arange(degree // 2 * 2 - 1.0, 0, -2))  # double factorial
        mean = Quadrature(order).moments(lambda x, k=degree: x[:, :1] ** k, gaussian).mean[0]

        assert abs(mean - (0 if degree % 2 else even)) <= 1e-10 * even
    last = Quadrature(order).moments(lambda x: x[:, :1] ** (2 * order), gaussian).mean[0]
    short = np.prod(np.arange(2.0 * order - 1, 0, -2)) - last
    assert np.isclose(short, factorial(order), rtol=1e-6)


def test_quadrature_is_exact_for_mixed_powers():
    """Over correlated variables too: E[x^2 y^2] = P00 P11 + 2 P01^2."""
    gaussian = Gaussian([0.0, 0.0], [[2.0, 0.6], [0.6, 1.0]])
    mean = Quadrature(3).moments(lambda x: x[:, :1] ** 2 * x[:, 1:] ** 2, gaussian).mean

    assert np.isclose(mean[0], 2.0 * 1.0 + 2 * 0.6**2, rtol=1e-12)


@pytest.mark.parametrize(
    ("cov", "points"),
    [(np.eye(3), 125), (np.diag([1, 1, 0]), 25), (np.ones((3, 3)), 5), (np.zeros((3, 3)), 1)],
    ids=["full", "known-heading", "rank-one", "zero"],
)
def test_quadrature_spends_no_points_on_what_is_known(cov, points):
    """order^rank points, the mean the first of them."""
    seen = []

    def watch(x):
        seen.extend(x)
        return x

    Quadrature(5)(watch, Gaussian(MEAN, cov))
    assert len(seen) == points
    assert np.allclose(seen[0], MEAN, atol=1e-15)


def test_quadrature_leaves_out_what_hardly_weighs_and_says_so():
    """Outermost points without a value are left out with a warning; weighty ones are an error."""

    def cut(limit):
        return lambda x: np.where(np.abs(x) > limit, np.nan, x**2)

    gaussian = Gaussian([0.0], [[1.0]])
    z, w = np.polynomial.hermite_e.hermegauss(13)
    kept = np.abs(z) <= 5.5
    with pytest.warns(UserWarning, match=r"2 of 13 points, which weigh 5.4e-08, are ill-posed"):
        mean = Quadrature(13)(cut(5.5), gaussian).mean[0]
    assert np.isclose(mean, w[kept] @ z[kept] ** 2 / w[kept].sum(), rtol=1e-12)
    with pytest.raises(IllPosedError, match=r"no value at \[-?3\..* weigh 0\.00"):
        Quadrature(13)(cut(3.0), gaussian)


@pytest.mark.parametrize("name", SCENARIOS)
def test_quadrature_follows_a_million_draws(name):
    """Mean and variance of two lines within 5 sampling errors, by the fourth moment."""
    scene = SCENARIOS[name]
    refit = Refit(scene.polylines[1:3], scene.ego.mean, scene.window)
    samples = quietly(MonteCarlo(1_000_000, seed=7).samples, refit, scene.ego)
    mean, cov = quietly(Quadrature().moments, refit, scene.ego)
    off = samples.values - mean
    square = off * off
    n, variance = len(off), square.mean(axis=0)
    of_variance = np.sqrt(((square * square).mean(axis=0) - variance**2) / n)

    assert samples.ill_posed <= 50  # beyond 4 sigma of the street turn with 10 deg
    assert (np.abs(off.mean(axis=0)) <= 5 * np.sqrt(variance / n)).all()
    assert (np.abs(np.diagonal(cov, axis1=1, axis2=2) - variance) <= 5 * of_variance).all()


# ---- sigma points


@pytest.mark.parametrize("name", SCENARIOS)
@pytest.mark.parametrize(("alpha", "kappa"), [(1.0, 0.0), (0.5, 0.0), (0.5, 1.5), (0.1, 0.0)])
def test_sigma_points_agree_with_filterpy(name, alpha, kappa):
    """filterpy's points, weights and unscented transform, for all lines of all scenarios.

    To 1e-10 of the standard deviations; its own sums lose 1 / alpha^2 of that.
    """
    scene, transform = SCENARIOS[name], SigmaPoints(alpha, kappa)
    refit = refit_of(scene)
    witness = MerweScaledSigmaPoints(3, alpha=alpha, beta=2.0, kappa=kappa)
    points = witness.sigma_points(scene.ego.mean, scene.ego.cov)
    mean, cov = transform.moments(refit, scene.ego)
    bound = 1e-10 * max(1.0, 0.1 / alpha**2)

    assert np.allclose(transform.points(scene.ego), points, rtol=1e-12, atol=1e-15)
    assert np.allclose(transform.weights(3), [witness.Wm, witness.Wc], rtol=1e-12)
    for values, m, S in zip(refit(points).swapaxes(0, 1), mean, cov, strict=True):
        expected_mean, expected = unscented_transform(values, witness.Wm, witness.Wc)
        sigma = np.sqrt(S.diagonal())
        assert (np.abs(m - expected_mean) <= bound * sigma).all()
        assert (np.abs(S - expected) <= bound * np.outer(sigma, sigma)).all()


def exact_moments(values, alpha, n, beta=2):
    """Equations 4 to 12 of the paper in whole numbers: no digit is lost."""
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
def test_sigma_points_lose_no_digits_to_a_small_alpha(name, alpha):
    """Weights of a million that cancel are no matter: exact fractions give the same sums."""
    scene, transform = SCENARIOS[name], SigmaPoints(alpha)
    refit = Refit(scene.polylines[1], scene.ego.mean, scene.window)
    mean, cov = transform.moments(refit, scene.ego)
    expected_mean, expected = exact_moments(refit(transform.points(scene.ego)), alpha, 3)
    sigma = np.sqrt(expected.diagonal())

    assert (np.abs(mean - expected_mean) <= 1e-11 * sigma + 1e-15 * np.abs(mean)).all()
    assert (np.abs(cov - expected) <= 1e-11 * np.outer(sigma, sigma)).all()


@pytest.mark.parametrize("alpha", [1.0, 1e-2, 1e-4])
def test_a_constant_stays_what_it_is(alpha):
    """To the last bit, with no variance, however large the weights."""
    result = SigmaPoints(alpha)(lambda x: np.full((len(x), 2), [0.1, 1e9 / 3]), LEFT.ego)

    assert np.array_equal(result.mean, [0.1, 1e9 / 3])
    assert not result.cov.any()


# ---- monte carlo


def test_monte_carlo_s_moments_are_those_of_its_samples():
    """numpy's covariance of the samples is the one returned; a seed repeats, another does not."""
    monte_carlo = MonteCarlo(1000, seed=1)
    mean, cov = monte_carlo.moments(REFIT, LEFT.ego)
    values = monte_carlo.samples(REFIT, LEFT.ego).values

    for i in range(8):
        assert np.allclose(mean[i], values[:, i].mean(axis=0), rtol=1e-12)
        assert np.allclose(cov[i], np.cov(values[:, i].T, bias=True), rtol=1e-9, atol=1e-18)
    assert np.array_equal(monte_carlo.moments(REFIT, LEFT.ego).cov, cov)
    assert not np.array_equal(MonteCarlo(1000, seed=2).moments(REFIT, LEFT.ego).cov, cov)


def test_a_function_must_return_a_row_a_point():
    """A function that is not vectorised is told so, with both shapes."""
    with pytest.raises(ValueError, match=r"one row a point, got \(2,\) for \(7, 3\)"):
        SigmaPoints()(lambda _: np.zeros(2), LEFT.ego)
