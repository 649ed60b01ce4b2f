"""Protection levels against the bivariate normal distribution and simulated hours."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from evidence.roads import random_scene
from evidence.transfer import codec_of, transferred
from evidence.witness import crossings, place_of, seen_from
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.signal import lfilter
from scipy.stats import multivariate_normal, norm

from maplines_can import Gaussian, MapError, Polyline, map_scene
from maplines_can.consumers.integrity import (
    EXACT,
    RISKS,
    Tolerance,
    availability,
    multiplier,
    onset,
    protection_level,
    risk_bound,
    samples_of,
)
from maplines_can.values.line import lateral, transform_line_or_nan


class Sampled(NamedTuple):
    """Estimate of a probability, with its 95 % confidence interval."""

    value: float
    low: float
    high: float


def excursion_probability(
    K: float, rho: float, samples: int, draws: int, rng: np.random.Generator
) -> Sampled:
    """P(max |u_k| > K) over the samples of a stationary AR(1) process of variance 1.

    The estimator is that of Adler, Blanchet, Liu (Efficient Monte Carlo for high excursions of
    Gaussian random fields, 2012). A time is drawn at random, the process there from its tails
    beyond K, and the rest of the path given that. The density of such a path relative to the true
    one is N / (samples P(|u| > K)), where N is the number of its samples beyond K. So each path
    counts samples P(|u| > K) / N: the relative error is small for any K. Only the path within
    8 correlation times is drawn; what is beyond K farther away is neglected, which makes the
    estimate slightly too large.
    """
    outside, near = math.erfc(K / math.sqrt(2)), math.ceil(8 / (1 - rho))
    tail = norm.ppf(0.5 * outside * (1 - rng.random(draws)))  # below -K
    weights = np.empty(draws)

    def beyond(start: float, n: int) -> int:
        noise = math.sqrt(1 - rho * rho) * rng.standard_normal(min(n, near))
        path = lfilter([1.0], [1.0, -rho], noise, zi=[rho * start])[0]
        return int((np.abs(path) > K).sum())

    for i, start in enumerate(tail):
        at = int(rng.integers(samples))
        # By symmetry, the side does not matter. Both directions in time are AR(1) again.
        count = 1 + beyond(start, at) + beyond(start, samples - 1 - at)
        weights[i] = samples * outside / count
    value, half = weights.mean(), 1.96 * weights.std(ddof=1) / math.sqrt(draws)
    return Sampled(float(value), float(max(0.0, value - half)), float(value + half))


@pytest.mark.parametrize("K", [0.5, 1.0, 3.0, 5.0])
@pytest.mark.parametrize("rho", [0.0, 0.3, 0.9, 0.995, 0.9999])
def test_an_onset_is_that_of_the_bivariate_normal(K: float, rho: float) -> None:
    both = sum(2 * multivariate_normal([0, 0], [[1, r], [r, 1]]).cdf([-K, -K]) for r in (rho, -rho))
    assert onset(K, rho) == pytest.approx(math.erfc(K / math.sqrt(2)) - both, rel=1e-6)


tolerances = st.builds(Tolerance, st.floats(0, 1), st.floats(1, 2))


@given(st.floats(1e-12, 0.5), st.floats(0, 1000), st.floats(0.001, 10), tolerances)
def test_the_level_has_the_risk(
    risk: float, time: float, period: float, tolerance: Tolerance
) -> None:
    K = multiplier(risk, time, period, tolerance)
    assert risk_bound(K, time, period, tolerance) == pytest.approx(risk, rel=1e-6)


@given(
    risk=st.floats(1e-12, 0.5),
    times=st.tuples(st.floats(0.01, 1000), st.floats(0.01, 1000)).map(sorted),
    tolerance=tolerances,
    where=st.tuples(*[st.floats(0, 1)] * 3),
)
def test_the_level_holds_in_the_whole_range(
    risk: float, times: list[float], tolerance: Tolerance, where: tuple[float, ...]
) -> None:
    """For each time, share of white noise and sigma, at the ends and between them."""
    level = float(protection_level(1.0, risk, times, tolerance=tolerance))
    time = times[0] + where[0] * (times[1] - times[0])
    true = Tolerance(where[1] * tolerance.white_share, 1 + where[2] * (tolerance.sigma_ratio - 1))
    assert risk_bound(level, time, tolerance=true) <= risk * (1 + 1e-6)


@given(K=st.floats(0.01, 8), r=st.tuples(st.floats(0, 1), st.floats(0, 1)).map(sorted))
def test_onsets_are_fewer_with_more_correlation(K: float, r: list[float]) -> None:
    less, more = r
    assert onset(K, more) <= onset(K, less) * (1 + 1e-9)
    assert onset(K, 1.0) == 0.0


@pytest.mark.parametrize("risk", [0.05, 1e-7])
@pytest.mark.parametrize("spread", [0.05, 0.3])
def test_a_random_sigma_is_integrated(risk: float, spread: float) -> None:
    """Against the quadrature of SciPy; the level is at most 1 % too high."""
    K = multiplier(risk, 5.0, tolerance=Tolerance(sigma_spread=spread))

    def found(level: float) -> float:
        def density(z: float) -> float:
            return norm.pdf(z) * risk_bound(level * math.exp(-spread * z), 5.0)

        return float(quad(density, -6, 9, limit=200, points=[0.0, 3.0, 6.0])[0])

    assert found(K) <= risk
    assert found(0.99 * K) > risk


@pytest.mark.parametrize(
    ("tolerance", "time", "white", "ratio"),
    [
        pytest.param(Tolerance(), 20.0, 0.0, 1.0, id="as-stated"),
        pytest.param(Tolerance(white_share=0.3), 20.0, 0.3, 1.0, id="white-share"),
        pytest.param(Tolerance(white_share=0.3), 20.0, 0.1, 1.0, id="less-white-than-stated"),
        pytest.param(Tolerance(), 5.0, 0.0, 1.0, id="shortest-time"),
        pytest.param(Tolerance(), 10.0, 0.0, 1.0, id="between"),
        pytest.param(Tolerance(sigma_ratio=1.3), 20.0, 0.0, 1.3, id="greater-sigma"),
        pytest.param(Tolerance(sigma_spread=0.3), 20.0, 0.0, None, id="sigma-at-random"),
    ],
)
def test_the_risk_is_kept_in_simulated_hours(
    tolerance: Tolerance, time: float, white: float, ratio: float | None
) -> None:
    """3000 hours of 720 samples, at a level for 5 %; the exact level is not enough for sigmas."""
    period, cars, rng = 5.0, 3000, np.random.default_rng(5)
    noise = rng.standard_normal((cars, samples_of(period)))
    rho = math.exp(-period / time)
    noise[:, 1:] *= math.sqrt(1 - rho**2)
    u = math.sqrt(1 - white) * lfilter([1.0], [1.0, -rho], noise, axis=1)
    u += math.sqrt(white) * rng.standard_normal(u.shape)
    u *= np.exp(0.3 * rng.standard_normal((cars, 1))) if ratio is None else ratio
    largest = np.abs(u).max(axis=1)
    shares = [
        float((largest > protection_level(1.0, 0.05, (5.0, 20.0), period, one)).mean())
        for one in (tolerance, EXACT)
    ]
    assert shares[0] < 0.05 + 3 * math.sqrt(0.05 * 0.95 / cars)
    if ratio != 1:
        assert shares[1] > 0.1


def test_independent_samples_are_the_worst_case() -> None:
    levels = [multiplier(1e-7, time) for time in (0.0, 1.0, 10.0, 100.0, 1e6)]
    assert levels == sorted(levels, reverse=True)
    assert levels[0] == pytest.approx(-ndtri_(1e-7 / 72000 / 2), rel=1e-6)
    assert levels[-1] > -ndtri_(1e-7 / 2)


def ndtri_(p: float) -> float:
    from scipy.special import ndtri

    return float(ndtri(p))


@pytest.mark.parametrize("risk", [1e-5, 1e-7])
def test_the_risk_is_at_most_the_stated_one(risk: float) -> None:
    K, rng = multiplier(risk, 5.0), np.random.default_rng(3)
    sampled = excursion_probability(K, math.exp(-0.05 / 5), 72_000, 1000, rng)
    assert 0.2 * risk < sampled.value <= sampled.high <= risk


def test_a_level_that_is_too_low_is_found() -> None:
    """The level for 1e-4 does not have the risk 1e-5."""
    K, rng = multiplier(1e-4, 5.0), np.random.default_rng(4)
    assert excursion_probability(K, math.exp(-0.05 / 5), 72_000, 500, rng).low > 1e-5


def test_levels_are_multiples_of_sigma() -> None:
    sigma = np.array([[0.0, 0.1], [0.2, 0.3]])
    levels = protection_level(sigma, 1e-5, 5.0)
    assert levels == pytest.approx(sigma * multiplier(1e-5, 5.0))
    assert availability(levels, 1.0).available.tolist() == [[True, True], [False, False]]


# ---- tails of received scenes -------------------------------------------------------------------

#: Errors of the pose: along [m], across [m], heading [rad]; and of each line of the map.
POSE, OF_MAP = (0.3, 0.1, 0.0035), MapError(offset_sigma=0.05, heading_sigma=0.001)


def tail_ratio(number: int, K: float, x: float) -> float:
    """P(|error of the lane centre at x| > K sigma) of a received scene, over a normal variable's.

    Errors of pose and map are drawn about the most likely ones that make the error K sigma to
    either side (mean shift), and weighted by the ratio of the densities. The error is that of the
    cubics seen from the erroneous pose, so it need not be linear or Gaussian; sigma is that of the
    decoded covariance.
    """
    rng, L, draws = np.random.default_rng(number), np.diag(POSE), 2000
    road = random_scene("rural", rng, 2)
    cov = rotated(np.diag(np.square(POSE)), road.pose[2])
    lines = {slot: Polyline(points) for slot, points in road.lines.items()}
    sent = map_scene(lines, Gaussian(road.pose, cov), map_error=OF_MAP)
    scene = transferred(codec_of("maplines-pose.dbc"), sent)
    assert scene is not None
    if len(scene.lines) < 2 or scene.x_range(list(scene.index))[1] < x:
        return math.nan
    local = [seen_from(points, road.pose[None]) for points in road.lines.values()]
    true = np.mean([crossings(one, place_of(one[0])[1], x)[0] for one in local])
    window = scene.fit_ranges[:, 0], scene.fit_ranges[:, 1]

    def centre(u: np.ndarray) -> np.ndarray:
        moved = transform_line_or_nan(scene.means, (u @ L)[:, None], window)
        return np.asarray(lateral(moved, x).mean(axis=1))

    steps = np.vstack([np.zeros(3), 1e-3 * np.eye(3)])
    gradient = np.diff(centre(steps)[[0, 1, 0, 2, 0, 3]])[::2] / 1e-3
    J = np.tile([1.0, x, x**2 / 2, x**3 / 6], 2) / 2
    sigma = math.sqrt(gradient @ gradient + J @ scene.conditional().cov @ J)
    own = np.array([OF_MAP.offset_sigma, OF_MAP.heading_sigma * x]) / math.sqrt(2)
    direction = np.append(gradient, own)
    shift = K * sigma * direction / (direction @ direction)
    u = rng.choice([-1.0, 1.0], draws)[:, None] * shift + rng.standard_normal((draws, 5))
    error = centre(u[:, :3]) + u[:, 3:] @ own - true
    error = np.where(np.isnan(error), np.inf, error)  # no line: counts as exceeded
    weights = np.exp(shift @ shift / 2) / np.cosh(u @ shift)
    return float((weights * (np.abs(error) > K * sigma)).mean() / (2 * norm.sf(K)))


def rotated(cov: np.ndarray, heading: float) -> np.ndarray:
    """A covariance in the ego frame, in the frame of the map."""
    c, s = math.cos(heading), math.sin(heading)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    turned = R @ cov @ R.T
    return (turned + turned.T) / 2


@pytest.mark.parametrize("x", [0.0, 20.0, 40.0])
@pytest.mark.parametrize("risk", RISKS)
def test_tails_of_received_scenes_are_not_heavier_than_normal_ones(risk: float, x: float) -> None:
    """In the mean over scenes: where what a cubic misses is most of the error, one may be."""
    ratios = [tail_ratio(number, multiplier(risk, 5.0), x) for number in range(30)]
    assert np.isfinite(ratios).sum() > 20
    assert np.nanmean(ratios) <= 1
