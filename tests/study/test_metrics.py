"""Figures of merit: totals of chunks are exact, and quantiles and errors are the true ones."""

import json
import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import beta

from maplines_can.study import road
from maplines_can.study.metrics import KL_BINS, RATIO_BINS, Figure, kl_terms, share_se
from maplines_can.values.gaussian import Gaussian

NUMBERS = st.floats(allow_nan=False, allow_infinity=False, min_value=-1e150, max_value=1e150)
POSITIVE = st.floats(2.0**-8, 2.0**23)


@given(st.lists(st.lists(NUMBERS, max_size=5), min_size=1, max_size=6), st.randoms())
def test_figures_of_chunks_add_up_exactly_in_any_order(chunks: Any, random: Any) -> None:
    """Sums, squares, extremes and bins do not depend on the order; sums are exact."""
    figures = [Figure.of(np.array(chunk, dtype=float), RATIO_BINS) for chunk in chunks]
    shuffled = random.sample(figures, len(figures))
    total = sum(figures[1:], figures[0])

    assert total.as_json() == sum(shuffled[1:], shuffled[0]).as_json()
    sums = [np.array(chunk, dtype=float).sum() for chunk in chunks]
    assert total.total == sum(map(Fraction, sums))
    assert total.count == sum(map(len, chunks))
    singles = [np.array([value]) for chunk in chunks for value in chunk]
    if singles:  # rounded once, as by math.fsum
        figure = sum(map(Figure.of, singles), Figure())
        assert figure.mean == float(sum(Fraction(x[0]) for x in singles) / len(singles))


@given(st.lists(POSITIVE | st.sampled_from([0.0, math.inf, math.nan]), max_size=30))
def test_a_figure_survives_json(values: Any) -> None:
    """Written and read back, it is the same to the last bit."""
    figure = Figure.of(np.array(values, dtype=float), RATIO_BINS)
    copy = Figure.from_json(json.loads(json.dumps(figure.as_json())))

    assert copy.as_json() == figure.as_json()
    assert copy.count == len(values)


@given(st.lists(POSITIVE, min_size=1, max_size=200), st.floats(0, 1))
def test_quantiles_lie_within_a_bin_of_the_true_ones(values: Any, share: float) -> None:
    """A bin is 2^-9 of an octave wide; conventions differ on the two values around a quantile."""
    figure = Figure.of(np.array(values), RATIO_BINS)
    low, high = (
        np.quantile(values, share, method=method)
        for method in ("inverted_cdf", "closest_observation")
    )

    assert min(low, high) * (1 - 2**-9) <= figure.quantile(share)
    ordered = np.sort(values)
    nearest = np.searchsorted(ordered, max(low, high), side="right")
    assert figure.quantile(share) <= ordered[min(nearest, len(ordered) - 1)] * (1 + 2**-9)


@pytest.mark.parametrize("bins", [KL_BINS, RATIO_BINS])
def test_each_bin_counts_the_values_between_its_edges(bins: Any) -> None:
    """Including the lower edge itself and the last number below the upper edge."""
    places = np.arange(bins.count)
    edges = np.array([bins.edge(place) for place in range(bins.count + 1)])

    for values in (edges[:-1], np.nextafter(edges[1:], 0), (edges[:-1] + edges[1:]) / 2):
        assert np.array_equal(np.repeat(places, bins.histogram(values)), places)
    assert bins.histogram(np.array([0.0]))[0] == bins.histogram(np.array([np.inf]))[-1] == 1


def test_means_and_errors_are_those_of_numpy() -> None:
    """Mean, standard error and root mean square of ordinary numbers."""
    values = np.random.default_rng(1).lognormal(size=1000)
    figure = Figure.of(values[:400]) + Figure.of(values[400:])

    assert figure.mean == pytest.approx(values.mean(), rel=1e-14)
    assert figure.mean_se == pytest.approx(values.std(ddof=1) / np.sqrt(1000), rel=1e-12)
    assert figure.rms == pytest.approx(np.sqrt((values**2).mean()), rel=1e-14)
    assert math.isnan(Figure.of(np.empty(0)).mean)
    assert (Figure.of(np.array([1.0, np.inf])) + figure).mean == np.inf


@pytest.mark.parametrize("share", [0.5, 0.99])
def test_the_standard_error_of_a_quantile_is_its_scatter(share: float) -> None:
    """Estimates from 400 samples of 2000 numbers agree in the mean with the true scatter."""
    samples = np.random.default_rng(2).lognormal(size=(400, 2000))
    estimates = [Figure.of(sample, RATIO_BINS).quantile_se(share) for sample in samples]

    assert np.mean(estimates) == pytest.approx(np.quantile(samples, share, axis=1).std(), rel=0.2)


@pytest.mark.parametrize(("count", "n"), [(0, 10), (3, 10), (10, 10), (0, 10**4)])
def test_the_standard_error_of_a_share_is_that_of_laplace(count: int, n: int) -> None:
    """It is the standard deviation of the beta distribution, and not zero for none of n."""
    assert share_se(count, n) == pytest.approx(beta(count + 1, n - count + 1).std(), rel=1e-9)


def test_terms_of_the_divergence_add_up_to_it(codec: Any) -> None:
    """Compared with ``Gaussian.kl``."""
    means, covs = road(50, seed=4)
    decoded = codec.batch.decode(codec.batch.encode(means, covs)).cov
    terms = kl_terms(covs, decoded).sum(axis=(1, 2))

    expected = [
        Gaussian(np.zeros(4), S).kl(Gaussian(np.zeros(4), T))
        for S, T in zip(covs, decoded, strict=True)
    ]
    assert terms == pytest.approx(expected, rel=1e-6)
