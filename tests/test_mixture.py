"""Mixtures: split, propagated, on the wire all or nothing, and never overconfident."""

from itertools import permutations

import numpy as np
import pytest
from dbcs import default_codec
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from maplines_can import Gaussian, MapLine, Refit, SigmaPoints, Slot, Status, scenario
from maplines_can.mixture import GaussianMixture
from maplines_can.propagation.mixture import SPLITS, Mixture, nonlinearity
from maplines_can.study import adversarial, evaluate
from maplines_can.wire import Codec, Reason
from maplines_can.wire.message.components import quantized_weights


def criterion(weights, means, sigma, factor):
    """DeMars': squared difference to N(0, 1), less its constant, plus factor times sigma^2."""

    def normal(x, v):
        return np.exp(-(x**2) / (2 * v)) / np.sqrt(2 * np.pi * v)

    cross = weights @ normal(means, 1 + sigma**2)
    own = weights @ normal(means[:, None] - means, 2 * sigma**2) @ weights
    return own - 2 * cross + factor * sigma**2


def whole_split(half_weights, half_means, k):
    mirror = slice(0, k // 2)
    weights = np.append(half_weights, half_weights[mirror][::-1]) / 32
    return weights, np.append(half_means, -np.asarray(half_means)[mirror][::-1])


def completed(half_weights, half_means, k):
    """Ours: the criterion where the variance of the parts completes that of the whole to 1."""
    weights, means = whole_split(half_weights, half_means, k)
    rest = 1 - weights @ means**2
    return criterion(weights, means, np.sqrt(rest), 0.025) if rest > 0 else 9.0


def test_the_criterion_is_the_published_one():
    """The published 3 parts (DeMars, Bishop and Jah 2013, table 1) minimise it at their factor."""
    x = np.array([0.2252246249, 1.0575154615, 0.6715662887])

    def published(x):
        weights = np.array([x[0], 1 - 2 * x[0], x[0]])
        return criterion(weights, np.array([-x[1], 0, x[1]]), x[2], 0.001)

    found = minimize(published, [0.2, 1.0, 0.7], method="Nelder-Mead", options={"xatol": 1e-9})
    assert found.x == pytest.approx(x, abs=1e-3)
    assert published(x) == pytest.approx(found.fun, abs=1e-9)


@pytest.mark.parametrize("k", [k for k in SPLITS if k > 1])
def test_splits_minimise_the_criterion(k):
    """The means, to the digits given; no weights a step or two away do better with any means."""
    half_weights, half_means = (np.array(half, dtype=float) for half in SPLITS[k])

    def best(half_weights):
        def value(free):
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
        steps = np.array([-2, 2]) / counts  # a middle part has no mirror image
        other = half_weights.copy()
        other[[i, j]] += steps
        if other.min() >= 1:
            assert best(other).fun > found.fun


def test_a_split_fits_its_steps_on_the_wire():
    """The wire rounds no weight of a split."""
    for k in SPLITS:
        weights = Mixture(k).split(Gaussian([0.0], [[1.0]])).weights
        assert np.array_equal(quantized_weights(weights[None], 32)[0], weights * 32)


@pytest.mark.parametrize("k", SPLITS)
def test_a_split_keeps_mean_and_covariance(k):
    """Along any direction, of a singular Gaussian too."""
    gaussian = Gaussian([1.0, 2.0, 3.0], np.diag([0.25, 0.0, 0.01]))
    parts = Mixture(k).split(gaussian, direction=[1.0, 2.0, -1.0])
    assert len(parts.weights) == k
    assert parts.overall.mean == pytest.approx(gaussian.mean, abs=1e-9)
    assert parts.overall.cov == pytest.approx(gaussian.cov, abs=1e-9)


def test_a_refit_bends_with_the_heading():
    """On the highway the direction is the heading, to a degree."""
    scene = scenario("highway-10deg")
    refit = Refit(scene.polylines[0], scene.ego.mean, scene.window)
    direction, amount = nonlinearity(refit, scene.ego)
    assert abs(direction[2]) > np.cos(np.radians(1))
    assert amount > 0.9  # c0 hardly depends on the heading in first order
    assert nonlinearity(lambda x: 2 * x, scene.ego).amount == pytest.approx(0, abs=1e-9)


def test_one_part_is_the_transform_itself():
    """Mixture(1) gives what SigmaPoints gives."""
    scene = scenario("street-turn")
    refit = Refit(scene.polylines[0], scene.ego.mean, scene.window)
    one, plain = Mixture(1)(refit, scene.ego), SigmaPoints()(refit, scene.ego)
    assert np.array_equal(one.components[0].mean, plain.mean)
    weights, means, covs = Mixture(3).moments(refit, scene.ego)
    three = Mixture(3)(refit, scene.ego)
    assert np.allclose(means, three.means)
    assert np.allclose(covs, three.covs)
    assert np.array_equal(weights, three.weights)


@given(st.lists(st.floats(1e-3, 1), min_size=1, max_size=8))
def test_quantized_weights_add_up(weights):
    """Whole steps, none zero, of sum one, none off by more than a step but for the raised ones."""
    w = np.array([weights]) / sum(weights)
    parts = quantized_weights(w, 32)
    assert parts.sum() == 32
    assert parts.min() >= 1
    if (w * 32 >= 1).all():
        assert np.abs(parts - w * 32).max() < 1


def random_mixtures(n, k, seed):
    means, covs = adversarial(n * k, seed, at_limit_share=0.02)
    spread = 0.05 * (means - means.reshape(n, k, 4)[:, :1].repeat(k, axis=1).reshape(-1, 4))
    means = means.reshape(n, k, 4)[:, :1] * 0.5 + spread.reshape(n, k, 4)
    weights = np.random.default_rng([seed, 7]).dirichlet(np.full(k, 2.0), n) + 1e-3
    return weights / weights.sum(axis=1, keepdims=True), means, covs.reshape(n, k, 4, 4)


def whole(weights, means, covs):
    mean = np.einsum("nk,nki->ni", weights, means)
    d = means - mean[:, None]
    return mean, np.einsum("nk,nkij->nij", weights, covs + d[..., :, None] * d[..., None, :])


@pytest.mark.parametrize("k", [2, 3, 5, 8])
def test_no_part_and_no_whole_is_overconfident(k):
    """Random mixtures, singular parts among them, weights that do not fit the steps."""
    weights, means, covs = random_mixtures(4000, k, seed=k)
    payloads = default_codec().encode_mixtures(weights, means, covs)
    batch = default_codec().decode_batch(payloads.reshape(-1, 32))
    assert batch.accepted.all()
    parts = evaluate(
        means.reshape(-1, 4),
        covs.reshape(-1, 4, 4),
        batch.mean,
        batch.cov,
        default_codec().resolution,
    )
    stated = batch.status != Status.OUT_OF_RANGE
    assert parts.positive_definite.all()
    assert not parts.overconfident[stated].any()
    w = batch.component_weight.reshape(-1, k)
    assert (w.sum(axis=1) == 1).all()
    mean, cov = whole(weights, means, covs)
    decoded = whole(w, batch.mean.reshape(-1, k, 4), batch.cov.reshape(-1, k, 4, 4))
    verdict = evaluate(mean, cov, *decoded, default_codec().resolution)
    assert not verdict.overconfident[stated.reshape(-1, k).all(axis=1)].any()


def sent_lines(n, k, seed=3):
    weights, means, covs = random_mixtures(n, k, seed)
    for w, m, S in zip(weights, means, 1e-3 * covs, strict=True):
        parts = tuple(Gaussian(mean, cov) for mean, cov in zip(m, S, strict=True))
        yield MapLine.of_mixture(Slot.CENTRE, GaussianMixture(w, parts))


@pytest.mark.parametrize("fd", [False, True])
def test_a_mixture_comes_back_whole(fd):
    """Parts wait for each other; the line has the decoded mixture and its moments."""
    fresh = Codec.from_dbc()
    decoder = fresh.decoder()
    (line,) = sent_lines(1, 5)
    frames = fresh.encode(line, fd=fd)
    assert len(frames) == 5 * (1 if fd else 4)
    answers = [decoder.feed(f.can_id, f.data, i * 1000) for i, f in enumerate(frames)]
    assert set(answers[:-1]) == {Reason.PENDING}
    back = answers[-1]
    assert back.mixture.weights.sum() == 1
    assert np.allclose(back.mixture.means, line.mixture.means, atol=0.002)
    assert np.array_equal(back.gaussian.cov, back.mixture.overall.cov)
    assert decoder.lines == 1
    assert decoder.line_frames == len(frames)
    assert decoder.pending == 0


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from([2, 3, 8]), st.booleans())
def test_no_mixture_is_made_of_two_lines(seed, k, fd):
    """Loss, duplication and local reordering: each delivered mixture is a sent one, once."""
    rng = np.random.default_rng(seed)
    fresh = Codec.from_dbc()
    sent = list(sent_lines(12, k, seed=seed % 1000))
    expected = {}
    stream = []
    for i, line in enumerate(sent):
        frames = fresh.encode(line, fd=fd)
        alone = fresh.decoder()
        (whole_line,) = [
            answer
            for frame in frames
            if isinstance(answer := alone.feed(frame.can_id, frame.data, 0), MapLine)
        ]
        expected[whole_line.mixture.means.tobytes()] = i
        stream += [frame for frame in frames for _ in range(rng.choice([0, 1, 1, 1, 1, 1, 1, 2]))]
    order = np.argsort(np.arange(len(stream)) + rng.uniform(0, 2, len(stream)))
    decoder = fresh.decoder()
    got = []
    for i, place in enumerate(order):
        answer = decoder.feed(stream[place].can_id, stream[place].data, i * 100_000)
        if isinstance(answer, MapLine):
            got.append(expected[answer.mixture.means.tobytes()])
    assert got == sorted(set(got))
    assert decoder.frames == (decoder.line_frames + sum(decoder.counts.values()) + decoder.pending)


def test_a_mixture_that_stops_half_way_times_out():
    """Its frames are counted, and the next line is delivered."""
    fresh = Codec.from_dbc()
    decoder = fresh.decoder(timeout_ms=50)
    first, second = (fresh.encode(line) for line in sent_lines(2, 3))
    for i, frame in enumerate(first[:8]):
        decoder.feed(frame.can_id, frame.data, i * 1000)
    assert decoder.pending == 8
    decoder.expire(10**9)
    assert decoder.counts == {Reason.TIMEOUT: 8}
    answers = [decoder.feed(f.can_id, f.data, 2 * 10**9 + i) for i, f in enumerate(second)]
    assert isinstance(answers[-1], MapLine)


@pytest.mark.parametrize(
    ("weights", "words"),
    [([0.5, 0.6], "sum 1"), ([1.0], "one for each"), ([1.5, -0.5], "positive")],
)
def test_a_wrong_mixture_raises(weights, words):
    """The message says what weights must be."""
    parts = (Gaussian([0.0], [[1.0]]), Gaussian([1.0], [[1.0]]))
    with pytest.raises(ValueError, match=words):
        GaussianMixture(weights, parts)


def test_density_and_coverage_of_a_mixture():
    """The density integrates to 1, and the region of 99 % holds 99 % of its own draws."""
    parts = (Gaussian([-2.0], [[0.5]]), Gaussian([1.0], [[2.0]]))
    mixture = GaussianMixture([0.3, 0.7], parts)
    x = np.linspace(-12, 14, 20_001)[:, None]
    assert np.trapezoid(mixture.density(x), x[:, 0]) == pytest.approx(1, abs=1e-6)
    draws = mixture.sample(100_000, seed=5)
    assert mixture.coverage(draws) == pytest.approx(0.99, abs=5 * np.sqrt(0.99 * 0.01 / 1e5) * 2)
    assert draws.mean() == pytest.approx(mixture.overall.mean[0], abs=5 * draws.std() / 316)


def test_eight_parts_on_a_slow_bus_are_one_line():
    """4.3 ms a record, as at 125 kbit/s: in all longer than the time-out, never between parts."""
    weights, means, covs = random_mixtures(1, 8, seed=3)
    parts = [Gaussian(mean, cov) for mean, cov in zip(means[0], covs[0], strict=True)]
    line = MapLine.of_mixture(Slot.EGO_LEFT, GaussianMixture(weights[0], tuple(parts)))
    codec = Codec.from_dbc()
    decoder = codec.decoder(timeout_ms=25)
    frames = codec.encode(line)
    answers = [decoder.feed(f.can_id, f.data, i * 1_080_000) for i, f in enumerate(frames)]
    assert len(frames) == 32
    assert isinstance(answers[-1], MapLine)
    assert len(answers[-1].mixture.weights) == 8
