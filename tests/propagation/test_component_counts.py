"""Number of components of each line, without and within a budget."""

from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplines_can.propagation import (
    Quadrature,
    component_counts,
    nonlinearity,
    remaining_nonlinearity,
)
from maplines_can.propagation.splitting import SPLITS, standard_split
from maplines_can.values.gaussian import Gaussian

amounts = st.lists(st.floats(0, 1), min_size=1, max_size=8)
tolerances = st.floats(0.01, 1)


def largest_remaining(values: Any, counts: Any) -> Any:
    return max(remaining_nonlinearity(a, k) for a, k in zip(values, counts, strict=True))


def pooled(function: Any, gaussian: Any, k: Any) -> Any:
    """``remaining_nonlinearity`` of the worst output, measured on each component."""
    weights, means, variances = standard_split(k)
    step = gaussian.root @ nonlinearity(function, gaussian).direction
    components = [
        Gaussian(gaussian.mean + mean * step, gaussian.cov - (1 - v) * np.outer(step, step))
        for mean, v in zip(means, variances, strict=True)
    ]
    found = []
    for i in range(np.asarray(function(gaussian.mean[None])).shape[1]):

        def output(x: Any, i: Any = i) -> Any:
            return function(x)[:, [i]]

        amount = np.array([nonlinearity(output, c).amount for c in components])
        variance = np.array([Quadrature(5)(output, c).cov[0, 0] for c in components])
        found.append(np.sqrt(weights @ (amount**2 * variance) / (weights @ variance)))
    return max(found)


@pytest.mark.parametrize("k", SPLITS)
@pytest.mark.parametrize("slope", [0.0, 0.3, 1.0, 10.0])
def test_remaining_nonlinearity_of_a_parabola(slope: float, k: Any) -> None:
    """For a quadratic function of one variable the formula is exact, for any slope."""

    def parabola(x: Any) -> Any:
        return slope * x + x**2

    gaussian = Gaussian([0.0], [[1.0]])
    remaining = remaining_nonlinearity(nonlinearity(parabola, gaussian).amount, k)
    assert remaining == pytest.approx(pooled(parabola, gaussian, k), rel=1e-6)


@pytest.mark.parametrize(
    ("values", "settings", "counts"),
    [
        pytest.param([], {}, [], id="no-line"),
        pytest.param([0.0], {}, [1], id="straight"),
        pytest.param([0.3], {}, [1], id="at-the-tolerance"),
        pytest.param([0.3001], {}, [2], id="above-it"),
        pytest.param([1.0], {}, [5], id="a-vertex"),
        pytest.param([1.0], {"tolerance": 0.01}, [8], id="no-more-than-eight"),
        pytest.param([1.0] * 3, {"budget": 3}, [1, 1, 1], id="one-each"),
        pytest.param([1.0] * 3, {"budget": 5}, [2, 2, 1], id="ties-in-order"),
        pytest.param([1.0, 0.1], {"budget": 100}, [5, 1], id="no-more-than-needed"),
        pytest.param(
            [1.0, 0.5], {"budget": 100, "tolerance": 0.1}, [8, 8], id="no-more-than-eight-each"
        ),
    ],
)
def test_component_counts(values: Any, settings: Any, counts: Any) -> None:
    """Values one step from each bound."""
    assert component_counts(values, **settings) == counts


@given(amounts, tolerances, st.integers(0, 64), st.integers(0, 64))
def test_a_larger_budget_never_removes_a_component(
    values: Any, tolerance: Any, one: int, other: int
) -> None:
    """No budget is exceeded, and each line has at least one component."""
    few, many = (
        component_counts(values, tolerance=tolerance, budget=len(values) + extra)
        for extra in sorted([one, other])
    )
    assert all(1 <= a <= b <= 8 for a, b in zip(few, many, strict=True))
    assert sum(few) <= len(values) + min(one, other)
    assert sum(many) <= len(values) + max(one, other)


@given(st.lists(st.floats(0, 1), min_size=1, max_size=3), st.integers(0, 21))
def test_the_distribution_of_a_budget_is_optimal(values: Any, extra: int) -> None:
    """No other distribution has a smaller largest remaining nonlinearity."""
    budget = len(values) + extra
    counts = component_counts(values, tolerance=1e-9, budget=budget)
    others = product(range(1, 9), repeat=len(values))
    best = min(largest_remaining(values, other) for other in others if sum(other) <= budget)
    assert max(largest_remaining(values, counts), 1e-9) == max(best, 1e-9)
